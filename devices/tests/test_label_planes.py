"""A tracked ultrasound probe: IMAGEs of labels beside its TRANSFORM, sent by pyigtl."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyigtl
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from clock import until
from live_objects import STAMP_NS, small_anatomy, small_estimate, small_frame, small_setting
from refused import refused
from track_objects import World, ended_when, start, told, virtual
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.evidence import Outline
from tumortrack.core.geometry import RAS_FROM_LPS, rigid, transform_points
from tumortrack.core.mesh_query import labels_of
from tumortrack.core.types import Anatomy
from tumortrack.live.poses import PoseBuffer
from tumortrack.live.values import CameraView, Observation, PublishedFrame
from tumortrack_devices.igtl.message import HEADER_SIZE, ProtocolError, unpack_labels
from tumortrack_devices.sources.virtual import VirtualSourceConfig
from tumortrack_devices.tools.label_planes import LabelPlanes
from tumortrack_devices.tools.openigtlink import OpenIgtLinkToolConfig

MS = 1_000_000
PEERS = Path(__file__).parent / "support"
PARTS = ("kidney", "tumor_1", "tumor_2")
TRACKER_FROM_CAMERA = rigid(
    Rotation.from_rotvec([0.3, -2.0, 0.4]).as_matrix(), np.array([300.0, -50, 900])
)
CALIBRATED = PublishedFrame("tracker", TRACKER_FROM_CAMERA, calibrated=True, error_mm=1.5)
# Pixels of 0.5 x 0.4 mm, turned about the probe's marker.
PROBE_FROM_IMAGE = rigid(
    Rotation.from_rotvec([0.1, 0.2, 1.2]).as_matrix(), np.array([-20.0, 8, 55])
) @ np.diag([0.5, 0.4, 0.45, 1])
TRACKER_FROM_PROBE = TRACKER_FROM_CAMERA @ rigid(
    Rotation.from_rotvec([-0.5, 0.2, 0.3]).as_matrix(), np.array([10.0, -20, 100])
)


def ball_image(dtype=np.uint8, kidney=1, tumor=2):
    """A circle of 20 mm about column 80, row 100, and one of 6 mm about column 88, row 110."""
    rows, columns = np.mgrid[:220, :170]
    labels = np.zeros(rows.shape, dtype)
    labels[np.hypot((columns - 80) * 0.5, (rows - 100) * 0.4) < 20] = kidney
    labels[np.hypot((columns - 88) * 0.5, (rows - 110) * 0.4) < 6] = tumor
    return labels


def matrix_file(path, probe_from_image=PROBE_FROM_IMAGE, unit="mm", **others):
    rows = np.array(probe_from_image, float)
    rows[:3] /= 1000 if unit == "m" else 1
    path.write_text(json.dumps({"probe_from_image": rows.tolist(), "unit": unit, **others}))
    return path


def setting(published=CALIBRATED):
    return replace(small_setting(), anatomy_ct=small_anatomy(), published_frame=published)


@contextmanager
def connected(published=CALIBRATED, **options):
    """The tool as a server, and pyigtl's client of it."""
    config = OpenIgtLinkToolConfig(address="0", image="Labels", **options)
    tool = config.open(setting(published), "probe")
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", tool.link.port)
    try:
        until(lambda: tool.link.receivers, "connection")
        yield tool, client
    finally:
        client.stop()
        tool.close()


def sent(client, *messages):
    for message in messages:
        client.send_message(message, wait=False)


def pose_message(tracker_from_probe, stamp_s):
    return pyigtl.TransformMessage(
        tracker_from_probe, timestamp=stamp_s, device_name="ProbeToTracker"
    )


def image_message(image, stamp_s, **about):
    return pyigtl.ImageMessage(image[None], timestamp=stamp_s, device_name="Labels", **about)


def outlines(tool):
    """What the tool gives in a frame; it learns that the organ is found."""
    now_ns = time.time_ns()
    view = CameraView(1, Observation(small_frame(now_ns), now_ns), TRACKER_FROM_CAMERA)
    pieces = tool.evidence(view)
    tool.located(view, small_estimate())
    return pieces


def check_circles(pieces, camera_from_pixel=None):
    """That the two parts are where the labels, the matrix and the pose have them."""
    if camera_from_pixel is None:
        camera_from_tracker = np.linalg.inv(TRACKER_FROM_CAMERA)
        camera_from_pixel = camera_from_tracker @ TRACKER_FROM_PROBE @ PROBE_FROM_IMAGE
    by_part = {piece.part: piece for piece in pieces}
    assert set(by_part) == {"kidney", "tumor_1"}
    for part, middle, radius_mm in (("kidney", (80, 100), 20), ("tumor_1", (88, 110), 6)):
        piece = by_part[part]
        assert isinstance(piece, Outline)
        assert (piece.tool, piece.shared_std_mm, piece.std_mm) == ("probe", 1.5, 1.0)
        places_px = transform_points(np.linalg.inv(camera_from_pixel), np.array(piece.places_mm))
        np.testing.assert_allclose(places_px[:, 2], 0, atol=1e-3)
        away_mm = np.linalg.norm((places_px[:, :2] - middle) * (0.5, 0.4), axis=1)
        # A border lies halfway between two pixels: half a diagonal off at most.
        np.testing.assert_allclose(away_mm, radius_mm, atol=0.33)
        assert 8 <= len(places_px) <= 12
        # All about it, not in one corner.
        assert np.linalg.norm((places_px[:, :2] - middle).mean(0) * (0.5, 0.4)) < radius_mm / 3


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16])
@pytest.mark.parametrize("space", ["ras", "lps"])
def test_labels_become_outlines_where_the_probe_is(dtype, space, tmp_path):
    axes = RAS_FROM_LPS if space == "ras" else np.eye(4)  # that the sender has
    file = matrix_file(tmp_path / "probe.json", unit="m" if space == "ras" else "mm")
    options = {"name": "ProbeToTracker", "image_to_probe": file, "space": space, "clock": "sender"}
    with connected(**options) as (tool, client):
        image, now_s = ball_image(dtype), time.time()
        poses = [pose_message(axes @ TRACKER_FROM_PROBE, now_s + dt) for dt in (-0.02, 0.02)]
        sent(client, poses[0], image_message(image, now_s), poses[1])
        pieces = until(lambda: outlines(tool), "outlines")
    camera_from_tracker = np.linalg.inv(TRACKER_FROM_CAMERA)
    check_circles(pieces, camera_from_tracker @ TRACKER_FROM_PROBE @ PROBE_FROM_IMAGE)
    assert abs(pieces[0].stamp_ns - now_s * 1e9) < 1000
    assert tool.counts["outline"] == 2


@pytest.mark.parametrize("flag", ["ras", "lps"])
def test_an_image_may_state_its_pose_itself(flag):
    """Spacing, axes and, of the whole image, the middle; in the axes that it names."""
    tracker_from_pixel = TRACKER_FROM_PROBE @ PROBE_FROM_IMAGE
    sent_from_pixel = (RAS_FROM_LPS if flag == "ras" else np.eye(4)) @ tracker_from_pixel
    with connected() as (tool, client):
        about = {"ijk_to_world_matrix": sent_from_pixel, "world_coordinate_system": flag}
        sent(client, image_message(ball_image(), time.time(), **about))
        pieces = until(lambda: outlines(tool), "outlines")
    check_circles(pieces)


def test_a_mask_is_of_the_part_that_is_named(tmp_path):
    options = {"name": "ProbeToTracker", "space": "lps", "part": "tumor_2", "clock": "sender"}
    options["image_to_probe"] = matrix_file(tmp_path / "probe.json")
    with connected(**options) as (tool, client):
        now_s = time.time()
        poses = [pose_message(TRACKER_FROM_PROBE, now_s + dt) for dt in (-0.02, 0.02)]
        mask = 255 * (ball_image() == 2).astype(np.uint8)
        sent(client, poses[0], image_message(mask, now_s), poses[1])
        (piece,) = until(lambda: outlines(tool), "an outline")
    assert piece.part == "tumor_2"


def test_lag_places_an_image_where_the_probe_was(tmp_path):
    """20 mm/s along the tracker's x, images 0.3 s late: 6 mm."""
    file = matrix_file(tmp_path / "probe.json")
    options = {"name": "ProbeToTracker", "image_to_probe": file, "space": "lps"}
    middles = {}
    for lag_s in (0.0, 0.3):
        with connected(clock="sender", lag_s=lag_s, **options) as (tool, client):
            begin_s = time.time()
            for n in range(30):
                pose = TRACKER_FROM_PROBE.copy()
                pose[0, 3] += 20 * 0.02 * n
                sent(client, pose_message(pose, begin_s + 0.02 * n))
            sent(client, image_message(ball_image(), begin_s + 0.5))
            pieces = until(lambda tool=tool: outlines(tool), "outlines")
        kidney = next(piece for piece in pieces if piece.part == "kidney")
        in_tracker = transform_points(TRACKER_FROM_CAMERA, np.array(kidney.places_mm))
        middles[lag_s] = in_tracker.mean(0)
        assert abs(kidney.stamp_ns - (begin_s + 0.5 - lag_s) * 1e9) < 1000
    np.testing.assert_allclose(middles[0.0] - middles[0.3], (6, 0, 0), atol=1e-3)


def test_several_megabytes_come_beside_poses_on_one_connection(tmp_path):
    options = {"name": "ProbeToTracker", "space": "lps", "clock": "sender"}
    options["image_to_probe"] = matrix_file(
        tmp_path / "probe.json", np.diag([0.04, 0.04, 0.04, 1.0])
    )
    with connected(**options) as (tool, client):
        client.stop()  # it breaks off what takes it longer than 10 ms
        until(lambda: not tool.link.receivers, "its leaving")
        sender = socket.create_connection(("127.0.0.1", tool.link.port))
        (receiver,) = until(lambda: tool.link.receivers, "connection")

        def sent(*messages):
            for message in messages:
                sender.sendall(message.pack())

        large = np.zeros((2000, 3000), np.uint8)  # 6 MB
        large[500:1500, 600:2400] = 1
        given = []
        for n in range(8):
            now_s = time.time()
            moved = TRACKER_FROM_PROBE @ rigid(np.eye(3), np.array([4.0 * n, 0, 0]))
            for dt in (0.0, 0.05):
                sent(pose_message(moved, now_s + dt))
            sent(image_message(large, now_s + 0.03))
            given += until(lambda: outlines(tool), "an outline")
            until(lambda now_s=now_s: time.time() > now_s + 0.12)
        assert [piece.part for piece in given] == ["kidney"] * 8
        too_large = image_message(np.zeros((4200, 4200), np.uint8), time.time())
        sent(too_large)

        def named():
            outlines(tool)
            return str(len(too_large.pack()) - HEADER_SIZE) in tool.trouble

        until(named, "the size that is refused")
        assert tool.link.receivers == [receiver]  # it was never dropped
        sender.close()


# The stream, by the clock of its stamps


def content_of(image, **about):
    """An IMAGE's own bytes, as pyigtl packs them."""
    return image_message(image, 1.0, **about)._pack_content()  # it has no public way


def swept(pose_at, seconds, image=None, hz=30.0, file=None):
    """Stamps and poses of the planes that count of a stream, asked at 10 Hz."""
    planes, poses = LabelPlanes(PARTS, "", np.eye(4), file), PoseBuffer()
    content, given = content_of(ball_image() if image is None else image), []
    for n in range(round(seconds * hz)):
        stamp_ns = STAMP_NS + round(n / hz * 1e9)
        planes.hear(stamp_ns, content)
        poses.add(stamp_ns, pose_at(n / hz))
        if n % 3 == 2:
            given += planes.pieces(poses, 0)
    stamps_ns = sorted({piece.stamp_ns for piece in given})
    assert len(given) == 2 * len(stamps_ns)
    at_s = np.array([(stamp_ns - STAMP_NS) * 1e-9 for stamp_ns in stamps_ns])
    return at_s, given


@pytest.fixture
def file(tmp_path):
    return matrix_file(tmp_path / "probe.json")


def test_a_probe_at_rest_is_one_plane_every_half_second(file):
    at_s, given = swept(lambda _: TRACKER_FROM_PROBE, 3.0, file=file)
    np.testing.assert_allclose(np.diff(at_s), 0.5, atol=0.1)
    assert len(at_s) == 6
    assert sum(len(piece.places_mm) for piece in given) <= 6 * 24


@pytest.mark.parametrize(
    ("speed_mm_s", "speed_deg_s", "step_s"), [(10, 0, 0.3), (0, 20, 0.3), (1, 1, 0.5)]
)
def test_a_plane_counts_once_the_probe_has_moved_or_turned(speed_mm_s, speed_deg_s, step_s, file):
    def pose(t_s):
        turn = Rotation.from_rotvec([0, 0, np.radians(speed_deg_s) * t_s]).as_matrix()
        return rigid(turn, np.array([100.0, 50 + speed_mm_s * t_s, 0]))

    # A tool's x-y plane is seen edge on: turns about its z axis are seen whole.
    at_s, _ = swept(pose, 3.0, file=matrix_file(file, np.diag([0.5, 0.4, 1, 1])))
    np.testing.assert_allclose(np.diff(at_s), step_s, atol=0.034)


def test_a_fast_sweep_is_a_plane_each_tenth_of_a_second(file):
    at_s, _ = swept(lambda t_s: rigid(np.eye(3), np.array([500 * t_s, 0, 0])), 2.0, file=file)
    assert (np.diff(at_s) >= 0.1 - 1e-6).all()
    assert len(at_s) >= 15


def test_a_frame_that_takes_long_does_not_make_the_next_one_longer(file):
    """3 s of a sweep until a frame asks: it gets the newest planes, of which the fit keeps all."""
    planes, poses = LabelPlanes(PARTS, "", np.eye(4), file), PoseBuffer()
    for n in range(90):
        stamp_ns = STAMP_NS + round(n / 30 * 1e9)
        poses.add(stamp_ns, rigid(np.eye(3), np.array([2.0 * n, 0, 0])))
        planes.hear(stamp_ns, content_of(ball_image()))
    given = list(planes.pieces(poses, 0))
    assert 0 < sum(len(piece.places_mm) for piece in given) <= 200
    assert max(piece.stamp_ns for piece in given) >= STAMP_NS + 2_800 * MS


def test_images_without_labels_do_not_count(file):
    assert len(swept(lambda _: TRACKER_FROM_PROBE, 0.3, file=file)[0]) == 1
    empty = np.zeros((50, 60), np.uint8)
    assert len(swept(lambda _: TRACKER_FROM_PROBE, 1.0, empty, file=file)[0]) == 0


def test_images_whose_pose_never_comes_are_named(file):
    planes, poses = LabelPlanes(PARTS, "", np.eye(4), file), PoseBuffer()
    poses.add(STAMP_NS, TRACKER_FROM_PROBE)
    content = content_of(ball_image())
    planes.hear(STAMP_NS - 50 * MS, content)  # from before the first pose
    with pytest.raises(NoEstimate):
        list(planes.pieces(poses, 0))
    for n in range(60):  # from after the last one
        planes.hear(STAMP_NS + (200 + 100 * n) * MS, content)
    with pytest.raises(NoEstimate):
        list(planes.pieces(poses, 0))


# What an IMAGE may be


def test_a_part_of_an_image_lies_where_the_whole_has_it():
    """``DI``, ``DJ`` and the sizes after them, by the protocol's document; other fields as they
    are. Its border does not end where it does."""
    matrix = TRACKER_FROM_PROBE @ PROBE_FROM_IMAGE
    image = ball_image()
    whole = content_of(image, ijk_to_world_matrix=matrix)
    head = whole[:60] + struct.pack(">6H", 30, 60, 0, 100, 90, 1)
    cut = unpack_labels(head + image[60:150, 30:130].tobytes())
    np.testing.assert_array_equal(cut.labels, image[60:150, 30:130])
    np.testing.assert_allclose(cut.sent_from_pixel[:3, :3], matrix[:3, :3], atol=1e-5)
    first_mm = transform_points(matrix, np.array([[30.0, 60, 0]]))[0]
    np.testing.assert_allclose(cut.sent_from_pixel[:3, 3], first_mm, atol=2e-3)
    assert (unpack_labels(whole).sent_from_pixel[:3, 3] - matrix[:3, 3] < 2e-3).all()


def test_big_endian_numbers_are_read():
    image = ball_image(np.uint16)
    content = altered(4, "B", 1)(content_of(image)[:72]) + image.astype(">u2").tobytes()
    np.testing.assert_array_equal(unpack_labels(content).labels, image)


def altered(at, form, *values):
    def change(content):
        size = struct.calcsize(form)
        return content[:at] + struct.pack(form, *values) + content[at + size :]

    return change


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content[:71],  # its header is cut off
        lambda content: content[:-1],
        lambda content: content + b"\0",
        altered(2, "B", 3),  # colours
        altered(3, "B", 11),  # float64
        altered(3, "B", 0),
        altered(3, "B", 5),  # of two bytes, which are not there
        altered(66, ">3H", 65535, 65535, 1),
        altered(66, ">3H", 65535, 65535, 65535),
        altered(66, ">3H", 0, 0, 1),
        altered(66, ">3H", 170, 110, 2),  # two slices
        altered(60, ">3H", 1, 0, 0),  # beyond the whole image
        altered(12, ">f", float("nan")),
        altered(48, ">f", float("inf")),
        altered(12, ">3f", 0, 0, 0),  # pixels of no width
        altered(12, ">3f", 1e30, 0, 0),
        altered(100, "B", 4),  # no part
    ],
)
def test_what_is_no_image_of_labels_is_refused(change):
    planes = LabelPlanes(PARTS, "", np.eye(4), None)
    content = content_of(ball_image())
    with refused(ProtocolError):
        planes.hear(STAMP_NS, change(content))
    planes.hear(STAMP_NS + 200 * MS, content)
    assert len(list(planes.pieces(PoseBuffer(), 0))) == 2  # the next one is heard


@pytest.mark.parametrize(
    "options",
    [
        {"name": "Probe"},  # but not where the image is in the probe's frame
        {"image_to_probe": Path("x.json")},
        {"lag_s": 0.2},  # of what no pose is known
        {"lag_s": -0.5, "name": "Probe", "image_to_probe": Path("x.json")},
        {"lag_s": 3.0, "name": "Probe", "image_to_probe": Path("x.json")},
    ],
)
def test_what_cannot_be_placed_is_refused(options):
    with refused(InputError, "lag_s" if "lag_s" in options else "image_to_probe=FILE"):
        OpenIgtLinkToolConfig(image="Labels", **options)


def test_an_image_needs_the_calibration():
    with refused(InputError, "frame=FILE"):
        OpenIgtLinkToolConfig(image="Labels").open(setting(PublishedFrame()), "probe")


@pytest.mark.parametrize(
    "written",
    [
        {"probe_from_image": np.eye(4).tolist()},
        {"probe_from_image": np.eye(4).tolist(), "unit": "inch"},
        {"probe_from_image": np.eye(3).tolist(), "unit": "mm"},
        {"probe_from_image": (2 * np.eye(4)).tolist(), "unit": "mm"},
        {"probe_from_image": [[float("nan")] * 4] * 4, "unit": "mm"},
        {"probe_from_image": np.eye(4).tolist(), "unit": "mm", "scale": 2},
    ],
)
def test_a_damaged_matrix_is_refused(written, tmp_path):
    path = tmp_path / "probe.json"
    path.write_text(json.dumps(written))
    with refused(InputError, str(path)):
        LabelPlanes(PARTS, "", np.eye(4), path)
    path.unlink()
    with refused(InputError, str(path)):
        LabelPlanes(PARTS, "", np.eye(4), path)


# As a user runs it


@pytest.mark.slow
def test_a_swept_probe_is_evidence_in_use(phantom_case, elastic_model, tmp_path):
    """A simulated room at rest; 30 images a second of the truth in 41 planes across the organ."""
    world = World(phantom_case, elastic_model)
    still = ("breathing", "instrument", "camera_motion")
    room = VirtualSourceConfig(case=phantom_case, **dict.fromkeys(still, False)).player()
    truth = room.truth(room.state_at(0.0), 0.0)
    anatomy = Anatomy(truth.parts)
    low_mm, high_mm = truth.parts[0].box_mm
    rows, columns = np.mgrid[:200, :200]
    places_px = np.column_stack([columns.ravel(), rows.ravel(), np.zeros(rows.size)])
    probe_from_image = np.diag([0.6, 0.6, 1, 1])  # 12 cm
    probe_from_image[:3, 3] = -60, -60, 12
    poses, images = [], []
    for z_mm in np.linspace(low_mm[2] + 5, high_mm[2] - 5, 41):
        middle_mm = (low_mm + high_mm) / 2
        camera_from_probe = rigid(np.eye(3), np.array([*middle_mm[:2], z_mm - 12]))
        poses.append(TRACKER_FROM_CAMERA @ camera_from_probe)
        places_mm = transform_points(camera_from_probe @ probe_from_image, places_px)
        images.append(labels_of(anatomy, places_mm).reshape(rows.shape))
    assert set(np.unique(images)) == set(range(len(truth.parts) + 1))
    np.savez(tmp_path / "sweep.npz", tracker_from_probe=poses, labels=images)
    file = matrix_file(tmp_path / "probe.json", probe_from_image)
    frame = {"robot_from_camera": TRACKER_FROM_CAMERA.tolist(), "unit": "mm"}
    frame |= {"frame_id": "tracker", "error_mm": 1.0, "error_deg": 0.2}
    (tmp_path / "tracker.json").write_text(json.dumps(frame))
    report, lines = tmp_path / "report.json", tmp_path / "recording"
    with subprocess.Popen(
        [sys.executable, PEERS / "probe_peer.py", tmp_path / "sweep.npz"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # that we leave is an error to it
        text=True,
    ) as peer:
        try:
            port = int(peer.stdout.readline())
            # Sender's: a machine that lags for a second would count their arrival.
            tool = f"us=openigtlink:127.0.0.1:{port}?name=ProbeToTracker&image=Labels&clock=sender"
            source = virtual(world, fps=5, **dict.fromkeys(still, "false"))
            frames = ("--frame", tmp_path / "tracker.json", "--report", report)
            arguments = (source, f"recording:{lines}", *frames)
            process = start(world, *arguments, "--tool", f"{tool}&image_to_probe={file}")

            def enough():
                return report.exists() and told(report)["tools"]["us"].get("outline", 0) >= 20

            said = ended_when(process, enough)
        finally:
            peer.kill()
    counts = told(report)["tools"]["us"]
    assert counts.get("rejected", 0) < counts["outline"] / 4, said
    with AnyReader([lines]) as reader:
        wanted = [c for c in reader.connections if c.topic == "/tumortrack/report"]
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(wanted)]
    found = [one["estimate"] for one in map(json.loads, (each.data for each in messages))]
    used = [piece for one in found if one for piece in one["evidence"] if not piece["rejected"]]
    assert {piece["part"] for piece in used} == {"kidney", "tumor_1", "tumor_2"}
    assert {piece["tool"] for piece in used} == {"us"}
    # The truth's, halfway between pixels of 0.6 mm.
    assert np.median([piece["off_mm"] for piece in used]) < 1.0
