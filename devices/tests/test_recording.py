"""Recordings: what was written comes back, also cut off or damaged; at the pace of its stamps."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from camera_objects import ASIDE, BASE, Led, Tape, played
from clock import Clock
from depth_files import write_depth_png, write_intrinsics
from live_objects import (
    CAMERA,
    PARTS,
    STAMP_NS,
    empty_update,
    small_anatomy,
    small_estimate,
    small_setting,
)
from recording_objects import PERIOD_NS, frame_number, play, record, update_number, write_bag
from refused import refused
from tumortrack.core import store
from tumortrack.core.camera import d405
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.evidence import FreeSpace, Grasp, Landmark, Outline, Touch
from tumortrack.core.geometry import IDENTITY, rigid
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.io.mesh_files import write_anatomy
from tumortrack.io.ply import write_cloud_ply
from tumortrack.live.cameras import camera_setup
from tumortrack.live.poses import FilePoses
from tumortrack.live.values import (
    CameraView,
    Observation,
    PublishedFrame,
    SourceEnded,
)
from tumortrack.report.inspection import describe
from tumortrack_devices.recording.mcap import McapBag, camera_messages
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.sinks.recording import RecordingSinkConfig
from tumortrack_devices.sinks.recording import RecordingSinkConfig as RecordTo
from tumortrack_devices.sources.recording import RecordingSourceConfig

LARGE = d405(848, 480)
TURNED = PublishedFrame("table", rigid(np.diag([-1.0, -1.0, 1.0]), np.array([50.0, -20, 9])))


def stamps(got: list) -> list[int]:
    return [seen.stamp_ns for seen in got]


def test_depth_images_come_back(tmp_path):
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[3:9, 4:40] = True
    rgb = np.random.default_rng(0).integers(0, 255, (CAMERA.height, CAMERA.width, 3), np.uint8)
    one = update_number(1, mask=mask, picture=rgb)
    updates = [update_number(0), one, empty_update(2), update_number(3, picture=rgb[..., 0])]
    got = play(record(tmp_path / "r", updates))
    assert stamps(got) == [updates[n].stamp_ns for n in (0, 1, 3)]
    for seen, n in zip(got, (0, 1, 3), strict=True):
        sent, back = frame_number(n), seen.content
        assert back.intrinsics == sent.intrinsics
        np.testing.assert_array_equal(np.isnan(back.depth_mm), np.isnan(sent.depth_mm))
        np.testing.assert_array_equal(np.rint(back.depth_mm * 10), np.rint(sent.depth_mm * 10))
        np.testing.assert_allclose(back.depth_mm, sent.depth_mm, rtol=2e-7)
    assert got[0].mask is got[2].mask is None
    np.testing.assert_array_equal(got[1].mask, mask)
    assert got[0].picture is None
    np.testing.assert_array_equal(got[1].picture, rgb)
    np.testing.assert_array_equal(got[2].picture, rgb[..., 0])
    assert all(seen.truth is None for seen in got)


def test_a_compressed_recording_is_smaller_and_brings_the_same(tmp_path):
    updates = [update_number(n) for n in range(4)]
    plain, packed = record(tmp_path / "r", updates), tmp_path / "p"
    sink = RecordTo(path=packed, compressed=True).open(small_setting())
    for update in updates:
        sink.publish(update)
    sink.close()
    sizes = [sum(path.stat().st_size for path in one.glob("*.mcap")) for one in (plain, packed)]
    assert sizes[1] < 0.7 * sizes[0]
    for one, other in zip(play(plain), play(packed), strict=True):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(one.content.depth_mm, other.content.depth_mm)
    assert all_messages(plain) == all_messages(packed)
    end = packed / "p.mcap"
    end.write_bytes(end.read_bytes()[:-200])  # without its end, as after a crash
    assert stamps(play(end)) == [update.stamp_ns for update in updates]


def all_messages(bag: Path) -> list[tuple[str, bytes]]:
    """Topics and contents; without those of diagnostics, which have ages."""
    with AnyReader([bag]) as reader:
        messages = [(connection.topic, bytes(data)) for connection, _, data in reader.messages()]
    return [(topic, b"" if "diagnostics" in topic else data) for topic, data in messages]


def test_evidence_comes_back_with_its_frame_and_its_camera_to_the_last_bit(tmp_path):
    place, many = (1 / 3, np.pi, 1e3 / 7), ((0.1, 0.2, 130.3), (1e-9, -2 / 3, 99.0))
    one = (
        Touch(place_mm=place, part="tumor_1", tip_mm=1.5, stamp_ns=STAMP_NS - 7, tool="probe"),
        Grasp(point_ct=place, place_mm=place, point_std_mm=2 / 3, tool="grasper"),
        Outline(places_mm=many, part="tumor_2"),
    )
    other = (FreeSpace(places_mm=many, tip_mm=4.0), Landmark(point_ct=place, place_mm=place))
    known = one, (), other
    updates = [replace(update_number(n), evidence=each) for n, each in enumerate(known)]
    got = play(record(tmp_path / "r", updates))
    assert tuple(seen.evidence for seen in got) == known
    # Of two cameras, that of the second, which leads, is its own.
    first, second = (Observation(frame_number(n), STAMP_NS) for n in (0, 0))
    views = tuple(CameraView(n, seen, np.eye(4)) for n, seen in ((2, second), (1, first)))
    both = replace(update_number(0), observation=second, views=views, evidence=one)
    path = record(tmp_path / "two", [both])
    for camera, its in (("camera", ()), ("camera_2", one)):
        (seen,) = play(path, topic=f"/{camera}/depth/image_rect")
        assert seen.evidence == its
    cloud = SensorCloud(small_estimate().cloud.points_mm, STAMP_NS)
    (seen,) = play(record(tmp_path / "c", [replace(update_number(0, cloud), evidence=other)]))
    assert seen.evidence == other


@pytest.mark.parametrize(
    "text",
    [
        "{",
        '{"stamp_ns": 1, "evidence": [{"kind": "smell"}]}',
        '{"stamp_ns": 1, "evidence": [{"kind": "touch", "place_mm": [0, 0, 1e9]}]}',
    ],
)
def test_damaged_evidence_costs_its_frame_alone(text, tmp_path, monkeypatch):
    updates = [update_number(n) for n in range(3)]
    updates[1] = replace(updates[1], evidence=(FreeSpace(places_mm=((0.0, 0.0, 90.0),)),))
    damaging = SimpleNamespace(json=SimpleNamespace(encode=lambda _: text.encode()))
    monkeypatch.setattr("tumortrack_devices.recording.mcap.msgspec", damaging)
    bad = record(tmp_path / "r", updates)
    monkeypatch.undo()
    before, error, after = play(bad)
    assert (before.stamp_ns, after.stamp_ns) == (updates[0].stamp_ns, updates[2].stamp_ns)
    assert "/camera/evidence" in str(error)


def test_an_mcap_is_read_by_rosbags_with_its_estimates(tmp_path):
    updates = [update_number(0), empty_update(1, "the drape hides it"), update_number(2)]
    updates = [replace(update, published_frame=TURNED) for update in updates]
    path = record(tmp_path / "r", updates, meshes_hz=0.0)
    with AnyReader([path]) as reader:
        counts = {topic: about.msgcount for topic, about in reader.topics.items()}
        said = {
            (c.topic, n): reader.deserialize(raw, c.msgtype)
            for n, (c, _, raw) in enumerate(reader.messages())
        }
        times = [t for _, t, _ in reader.messages()]
    estimates = ("cloud", "meshes", "diagnostics", "report", *(f"{p}/center" for p in PARTS))
    assert counts == {
        **{f"/tumortrack/{name}": 3 for name in estimates},
        **{"/camera/depth/image_rect": 2, "/camera/depth/camera_info": 2},
        **{"/tf": 2 + 3, "/diagnostics": 3},  # the camera, and each result
    }
    assert times == sorted(times)

    def on(topic: str) -> list:
        return [message for (name, _), message in said.items() if name == topic]

    assert [cloud.width for cloud in on("/tumortrack/cloud")] == [500, 0, 500]
    assert len(on("/tumortrack/meshes")[0].markers[0].points) == 3 * 320
    reports = [json.loads(message.data) for message in on("/tumortrack/report")]
    assert [report["reason"] for report in reports] == ["", "the drape hides it", ""]
    assert reports[0]["estimate"]["parts"]["tumor_1"]["label"] == 2
    assert {m.header.frame_id for m in on("/camera/depth/image_rect")} == {"camera"}
    (transform,) = on("/tf")[0].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("table", "camera")
    shift, turn = transform.transform.translation, transform.transform.rotation
    np.testing.assert_allclose([shift.x, shift.y, shift.z], [0.05, -0.02, 0.009])
    np.testing.assert_allclose(np.abs([turn.x, turn.y, turn.z, turn.w]), [0, 0, 1, 0], atol=1e-12)


def large(n: int) -> DepthFrame:
    """Each of these ends a chunk of the file."""
    depth_mm = np.full((480, 848), 120 + 0.1 * n, np.float32)
    return DepthFrame(depth_mm, LARGE, STAMP_NS + n * PERIOD_NS)


def test_a_file_cut_anywhere_gives_the_frames_before(tmp_path):
    """As a crash leaves it. Frames are those of the whole file, from the first on."""
    path = record(tmp_path / "r", [update_number(n, large(n)) for n in range(5)])
    raw = (path / "r.mcap").read_bytes()
    found, cut_file = [], tmp_path / "cut.mcap"
    for size in range(len(raw) - 1, len(raw) * 9 // 20, -len(raw) // 15):
        cut_file.write_bytes(raw[:size])
        got = play(cut_file)
        assert stamps(got) == [STAMP_NS + n * PERIOD_NS for n in range(len(got))]
        assert got[-1].content.depth_mm[0, 0] == pytest.approx(120 + 0.1 * (len(got) - 1))
        assert len(got) >= int(5 * size / len(raw) - 0.2)
        found.append(len(got))
        cut_file.write_bytes(raw[:size] + bytes(5000))  # a disk that filled the rest with zeros
        assert len(play(cut_file)) in (found[-1], found[-1] + 1)
    assert set(found) >= {5, 4, 3, 2}
    cut_file.write_bytes(raw[: len(raw) // 10])
    with refused(InputError, cut_file):
        play(cut_file)
    damaged, begins = bytearray(raw), [8]
    while raw[begins[-1]] != 0x0F:  # https://mcap.dev/spec: opcode, length, content
        size = int.from_bytes(raw[begins[-1] + 1 : begins[-1] + 9], "little")
        begins.append(begins[-1] + 9 + size)
    third = [begin for begin in begins if raw[begin] == 0x06][2]
    damaged[third + 50 : third + 58] = b"\xff" * 8  # the length of the chunk's first record
    cut_file.write_bytes(damaged)
    got = play(cut_file)
    assert isinstance(got[-1], InputError)
    assert 0 < len(got) < 5


CHILD = """
import sys, time
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_recording import RecordTo, large, small_setting, update_number
sink = RecordTo(path=Path(sys.argv[1])).open(small_setting())
for n in range(1000):
    sink.publish(update_number(n, large(n)))
    print(n, flush=True)
    time.sleep(0.02)
"""


def test_a_killed_recorder_loses_a_frame_at_most(tmp_path):
    here = [str(Path(__file__).parent), str(Path(__file__).parents[2] / "tests" / "support")]
    command = [sys.executable, "-c", CHILD, str(tmp_path / "r"), *here]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as child:
        for line in child.stdout:
            if int(line) == 10:
                os.killpg(child.pid, signal.SIGKILL)
    assert not (tmp_path / "r" / "metadata.yaml").exists()
    got = play(tmp_path / "r")
    assert stamps(got) == [STAMP_NS + n * PERIOD_NS for n in range(len(got))]
    assert len(got) >= 10


def test_what_is_there_is_never_written_into_and_what_is_no_recording_is_refused(tmp_path):
    path = record(tmp_path / "mcap", [update_number(0)])
    about = json.loads((path / "recording.json").read_text())
    assert (about["kind"], about["parts"]) == ("recording", list(PARTS))
    assert about["patient"] == {"id": "P1", "side": "left"}
    (tmp_path / "other").mkdir()
    (tmp_path / "film.avi").touch()
    for there in (path, tmp_path / "other", path / "recording.json"):
        before = sorted(tmp_path.rglob("*"))
        with refused(InputError, there):
            record(there, [])
        assert sorted(tmp_path.rglob("*")) == before
    assert len(play(path)) == 1
    blind = record(tmp_path / "blind", [empty_update(0)])  # estimates only
    for there in (blind, tmp_path / "other", tmp_path / "film.avi", tmp_path / "nowhere"):
        with pytest.raises(InputError):
            RecordingSourceConfig(path=there).open()
    for options in ({"rate": -1}, {"rate": float("nan")}, {"fps": 0}, {"unit_mm": 0}):
        with pytest.raises(InputError):
            RecordingSourceConfig(path=tmp_path, **options)


@contextmanager
def full_disk_at(size: int):
    """No file may grow beyond ``size`` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def test_a_full_disk_is_said_and_leaves_what_was_whole(tmp_path):
    sink = RecordTo(path=tmp_path / "r").open(small_setting())
    said, written = [], 0
    with full_disk_at(5_000_000):
        for n in range(12):
            try:
                sink.publish(update_number(n, large(n)))
                written += 1
            except StorageError as error:
                said.append(str(error))
        sink.close()
    assert len(set(said)) == 1
    assert len(said) == 12 - written > 5
    got = play(tmp_path / "r")
    assert stamps(got) == [STAMP_NS + n * PERIOD_NS for n in range(len(got))]
    assert written >= len(got) > 2


def cloud_files(folder: Path, names: list[str]) -> Path:
    folder.mkdir()
    for n, name in enumerate(names):
        write_cloud_ply(folder / name, np.float32([[n + 1, 2, 130], [3, 4, 140]]))
    return folder


def first_x(got: list) -> list[float | None]:
    return [None if isinstance(s, InputError) else float(s.content.points_mm[0, 0]) for s in got]


def test_a_damaged_file_among_good_ones_is_said_and_passed(tmp_path):
    folder = cloud_files(tmp_path / "c", ["a.ply", "b.ply", "c.ply"])
    (folder / "b.ply").write_bytes((folder / "b.ply").read_bytes()[:-5])
    got = play(folder, fps=10)
    assert first_x(got) == [1, None, 3]
    assert "b.ply" in str(got[1])
    assert got[2].stamp_ns - got[0].stamp_ns == 200_000_000


def test_stamps_of_files(tmp_path):
    named = cloud_files(tmp_path / "n", ["1790000000000000500.ply", "1790000000040000007.ply"])
    assert stamps(play(named)) == [1790000000000000500, 1790000000040000007]
    numbered = cloud_files(tmp_path / "m", ["000.ply", "001.ply"])
    assert np.diff(stamps(play(numbered, fps=4))) == [250_000_000]


def test_depth_images_beside_one_camera(tmp_path):
    write_intrinsics(tmp_path / "intrinsics.json", CAMERA)
    for n in range(3):
        write_depth_png(tmp_path / f"{n}.png", frame_number(n))
    got = play(tmp_path)
    for n, seen in enumerate(got):
        np.testing.assert_allclose(seen.content.depth_mm, frame_number(n).depth_mm, rtol=2e-7)
    assert len(got) == 3
    (tmp_path / "intrinsics.json").unlink()
    with refused(InputError, "intrinsics.json"):
        RecordingSourceConfig(path=tmp_path).open()


def test_scenes_bring_their_truth(tmp_path):
    for n, name in enumerate(("one", "two")):
        scene = tmp_path / name
        scene.mkdir()
        write_anatomy(scene, small_anatomy())
        write_cloud_ply(scene / "cloud.ply", small_estimate().cloud.points_mm)
        (scene / "meta.json").write_text(json.dumps({"stamp_ns": 5000 + n}))
    write_intrinsics(tmp_path / "two" / "intrinsics.json", CAMERA)
    write_depth_png(tmp_path / "two" / "depth.png", frame_number(0))
    one, two = play(tmp_path)
    assert (one.stamp_ns, two.stamp_ns) == (5000, 5001)
    assert isinstance(one.content, SensorCloud)
    assert isinstance(two.content, DepthFrame)
    assert one.truth.names == PARTS
    volume_mm3 = small_anatomy().parts[1].volume_mm3
    assert two.truth.parts[1].volume_mm3 == pytest.approx(volume_mm3, rel=1e-5)


@pytest.mark.parametrize("kind", ["mcap", "packed mcap", "sqlite3", "packed sqlite3", "bag"])
def test_bags_of_every_kind_are_played(tmp_path, kind):
    frames = [frame_number(n) for n in range(3)]
    cloud = SensorCloud(np.float32([[1, 2, 130]]), STAMP_NS)
    topics = {
        "/arm/depth/image": ("depth/image_rect", frames),
        "/arm/depth/camera_info": ("depth/camera_info", frames),
        "/other/camera_info": ("depth/camera_info", frames),
        "/arm/points": ("points", [cloud]),
    }
    path = write_bag(tmp_path / "r.bag", topics, kind)
    got = play(path)
    assert stamps(got) == stamps(frames)
    for seen, frame in zip(got, frames, strict=True):
        np.testing.assert_allclose(seen.content.depth_mm, frame.depth_mm, rtol=2e-7)
    (seen,) = play(path, topic="/arm/points")
    np.testing.assert_allclose(seen.content.points_mm, cloud.points_mm, rtol=2e-7)
    if kind in ("mcap", "packed mcap", "sqlite3"):
        (file,) = [p for p in path.iterdir() if p.suffix in (".mcap", ".db3")]
        assert stamps(play(file)) == stamps(frames)
    for options in ({"topic": "/nowhere"}, {"info_topic": "/arm/points"}):
        with refused(InputError, *options.values()):
            RecordingSourceConfig(path=path, **options).open()


def test_two_candidates_are_named_rather_than_guessed(tmp_path):
    frames = [frame_number(0)]
    topics = {
        "/left/depth": ("depth/image_rect", frames),
        "/right/depth": ("depth/image_rect", frames),
    }
    path = write_bag(tmp_path / "r", topics, "mcap")
    with refused(InputError, "/left/depth, /right/depth"):
        RecordingSourceConfig(path=path).open()
    with refused(InputError, "camera_info"):
        RecordingSourceConfig(path=path, topic="/left/depth").open()


def test_a_bad_image_in_a_bag_is_said_and_passed(tmp_path):
    frames = [frame_number(n) for n in range(3)]
    topics = {
        "/d/image": ("depth/image_rect", frames),
        "/d/camera_info": ("depth/camera_info", frames),
    }
    path = write_bag(tmp_path / "d", topics, "mcap") / "d.mcap"
    raw = bytearray(path.read_bytes())
    begin = raw.find(b"32FC1", raw.find(b"32FC1") + 5)
    for damage, said in ((b"bgra8", "bgra8"), (b"\xff" * 5, "no sensor_msgs/msg/Image")):
        raw[begin : begin + 5] = damage
        path.write_bytes(raw)
        got = play(path)
        assert [isinstance(seen, InputError) for seen in got] == [False, True, False]
        assert said in str(got[1])


@pytest.mark.parametrize("name", ["r.mcap", "r.db3", "r.bag", "metadata.yaml"])
def test_rubbish_is_no_recording(tmp_path, name):
    (tmp_path / name).write_bytes(np.random.default_rng(1).bytes(3000))
    path = tmp_path if name == "metadata.yaml" else tmp_path / name
    with refused(InputError, path):
        RecordingSourceConfig(path=path).open()


@pytest.fixture
def clock(monkeypatch):
    """The recording's, which the test turns."""
    one = Clock()
    monkeypatch.setattr("tumortrack_devices.sources.recording.time", one)
    return one


@pytest.mark.parametrize("rate", [1, 4])
def test_frames_come_at_the_pace_of_their_stamps(tmp_path, clock, rate):
    folder = cloud_files(tmp_path / "c", [f"{n}.ply" for n in range(5)])
    start, arrivals = clock.monotonic(), []
    source = clock.of(RecordingSourceConfig(path=folder, rate=rate, fps=10).open())
    assert (source.lossless, source.host_clock) == (False, False)
    while len(arrivals) < 5:
        if source.read(0.05) is not None:
            arrivals.append((clock.monotonic() - start) * rate)
    assert source.dropped == 0
    assert arrivals == pytest.approx(0.1 * np.arange(5), abs=1e-6)
    with pytest.raises(SourceEnded):
        source.read(0.05)


def test_frames_that_are_late_are_dropped_and_the_newest_given(tmp_path, clock):
    folder = cloud_files(tmp_path / "c", [f"{n}.ply" for n in range(6)])
    source = clock.of(RecordingSourceConfig(path=folder, fps=20).open())
    assert first_x([source.read(0)]) == [1]
    clock.sleep(0.22)  # frames 2 to 5 were due meanwhile
    assert first_x([source.read(0)]) == [5]
    assert source.dropped == 3


def test_a_long_pause_is_cut_short_of_a_frozen_source(tmp_path, clock):
    folder = cloud_files(tmp_path / "c", ["1000000000000.ply", "9000000000000.ply"])
    source = clock.of(RecordingSourceConfig(path=folder, rate=2).open())
    assert source.read(0).stamp_ns == 10**12
    start = clock.monotonic()
    while (seen := source.read(0.5)) is None:
        pass
    assert seen.stamp_ns == 9 * 10**12
    assert clock.monotonic() - start == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize(
    "published", [PublishedFrame(), PublishedFrame("base", np.diag([-1, -1, 1, 1.0]))]
)
@pytest.mark.parametrize(("name", "kept"), [("left_optical", "left_optical"), ("", "camera")])
def test_a_recorded_bag_keeps_the_name_of_its_camera(tmp_path, published, name, kept):
    """By which the calibration knows it, when the recording is played."""
    updates = [update_number(n, frame_id=name) for n in range(2)]
    path = record(tmp_path / "bag", [replace(one, published_frame=published) for one in updates])
    source = RecordingSourceConfig(path=path, rate=0).open()
    got = source.read(1.0)
    source.close()
    assert got is not None
    assert got.frame_id == kept


def test_a_recording_of_a_moving_camera_keeps_its_poses(tmp_path):
    published = PublishedFrame("base", IDENTITY, calibrated=True, moves=True)
    told, _ = played([Tape(0, 33, 66, 99)], Led(), published)
    context = replace(small_setting(), published_frame=published)
    sink = RecordingSinkConfig(path=tmp_path / "run").open(context)
    for one in told:
        sink.publish(one)
    sink.close()
    source = RecordingSourceConfig(path=tmp_path / "run", rate=0).open()
    again, _ = played([source], FilePoses(tmp_path / "run" / "poses.csv"), published)
    assert len(again) == 4
    for one, other in zip(told, again, strict=True):
        assert other.stamp_ns == one.stamp_ns
        np.testing.assert_allclose(
            other.published_frame.published_from_camera,
            one.published_frame.published_from_camera,
            atol=1e-5,
        )


def test_a_recording_of_several_cameras_is_played_as_several(tmp_path):
    places = (BASE, BASE @ ASIDE)
    told, _ = played([Tape(0, 33, 66), Tape(5, 38, 71, of=5.0)], places)
    context = replace(small_setting(), published_frame=told[0].published_frame, cameras=places)
    sink = RecordingSinkConfig(path=tmp_path / "run").open(context)
    for one in told:
        sink.publish(one)
    sink.close()
    topics = [f"/camera{n}/depth/image_rect" for n in ("", "_2")]
    texts = [f"recording:{tmp_path / 'run'}?rate=0&topic={topic}" for topic in topics]
    setup = camera_setup(texts, tmp_path / "run" / "poses.json", "", None)
    assert setup.published.frame_id == "base"
    np.testing.assert_allclose(setup.still, places, atol=1e-9)
    again, _ = played([one.open() for one in setup.sources.values()], setup.still)
    assert [one.cameras for one in again] == ["cameras 1, 2"] * 3
    for one, other in zip(told, again, strict=True):
        for mine, its in zip(one.views, other.views, strict=True):
            assert mine.seen.stamp_ns == its.seen.stamp_ns
            np.testing.assert_allclose(
                its.seen.content.depth_mm, mine.seen.content.depth_mm, atol=0.06
            )


@pytest.mark.parametrize("ended", [True, False])
def test_a_recording_its_length_rate_and_whether_its_depths_were_corrected(tmp_path, ended):
    """Also one without its end, as a killed recorder leaves it."""
    folder, messages = tmp_path / "seen", Messages()
    bag = McapBag(folder, messages, "")
    for n in range(12):  # the last one ends a chunk
        depth = DepthFrame(np.full((240, 424), 150.0, np.float32), d405(424, 240), 10**18 + n)
        seen = Observation(depth, 10**18 + n * 10**8)
        bag.write(seen.arrived_ns, camera_messages(seen, IDENTITY, "camera", messages))
    if ended:
        bag.close()
    patient = {"id": "P1", "side": "left"}
    store.write_json(folder / "recording.json", {"patient": patient, "corrected": True})
    said = "\n".join(describe(folder if ended else folder / "seen.mcap"))
    assert "a recording of 1.1 s" in said
    assert "/camera/depth/image_rect: 12 frames, 10.0 a second" in said
    assert "patient P1, side left" in said
    assert "its depths were corrected" in said
