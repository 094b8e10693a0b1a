"""Recordings: what was written comes back, also cut off or damaged; at the pace of its stamps."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from clock import PATIENCE_S, Clock
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
from recording_objects import PERIOD_NS, frame_number, record, update_number, write_bag
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.evidence import Free, Held, Landmark, Outline, Touch
from tumortrack.core.geometry import rigid
from tumortrack.core.mesh_files import write_anatomy
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.values import (
    CameraView,
    Observation,
    PublishedFrame,
    SourceEnded,
    SourceLost,
)
from tumortrack.sense.ply import write_cloud_ply
from tumortrack_devices.recording.mcap import CHUNK_S
from tumortrack_devices.sinks.recording import RecordingSinkConfig as RecordTo
from tumortrack_devices.sources.recording import RecordingSourceConfig

TURNED = PublishedFrame("table", rigid(np.diag([-1.0, -1.0, 1.0]), np.array([50.0, -20, 9])))


def play(path: Path, **options) -> list[Observation | InputError]:
    """Everything to the end, errors in their place."""
    source = RecordingSourceConfig(path=path, **({"rate": 0} | options)).open()
    got: list[Observation | InputError] = []
    try:
        while True:
            try:
                seen = source.read(0.2)
            except InputError as error:
                seen = error
            if seen is not None:
                got.append(seen)
    except SourceEnded:
        return got
    finally:
        source.close()
        source.close()


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


def test_clouds_come_back(tmp_path):
    points_mm = small_estimate().cloud.points_mm
    cloud = SensorCloud(points_mm, STAMP_NS)
    (seen,) = play(record(tmp_path / "r", [update_number(0, cloud)]))
    assert seen.stamp_ns == STAMP_NS
    np.testing.assert_allclose(seen.content.points_mm, points_mm, rtol=2e-7)
    assert abs(seen.arrived_ns - time.time_ns()) < 600e9


def test_evidence_comes_back_with_its_frame_and_its_camera_to_the_last_bit(tmp_path):
    place, many = (1 / 3, np.pi, 1e3 / 7), ((0.1, 0.2, 130.3), (1e-9, -2 / 3, 99.0))
    one = (
        Touch(place_mm=place, part="tumor_1", tip_mm=1.5, stamp_ns=STAMP_NS - 7, tool="probe"),
        Held(point_ct=place, place_mm=place, point_std_mm=2 / 3, tool="grasper"),
        Outline(places_mm=many, part="tumor_2"),
    )
    other = (Free(places_mm=many, tip_mm=4.0), Landmark(point_ct=place, place_mm=place))
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
    ("text", "wrong"),
    [
        ("{", "truncated"),
        ('{"stamp_ns": 1, "evidence": [{"kind": "smell"}]}', "smell"),
        (
            '{"stamp_ns": 1, "evidence": [{"kind": "touch", "place_mm": [0, 0, 1e9]}]}',
            "reaches 1e\\+09; allowed: up to 2000",
        ),
    ],
)
def test_damaged_evidence_costs_its_frame_alone(text, wrong, tmp_path, monkeypatch):
    updates = [update_number(n) for n in range(3)]
    updates[1] = replace(updates[1], evidence=(Free(places_mm=((0.0, 0.0, 90.0),)),))
    damaging = SimpleNamespace(json=SimpleNamespace(encode=lambda _: text.encode()))
    monkeypatch.setattr("tumortrack_devices.recording.mcap.msgspec", damaging)
    bad = record(tmp_path / "r", updates)
    monkeypatch.undo()
    before, error, after = play(bad)
    assert (before.stamp_ns, after.stamp_ns) == (updates[0].stamp_ns, updates[2].stamp_ns)
    assert re.search(rf"its /camera/evidence is damaged: .*{wrong}", str(error))


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


def test_without_a_picture_there_are_estimates_only(tmp_path):
    path = record(tmp_path / "r", [empty_update(0)])
    with AnyReader([path]) as reader:
        theirs = {name for name in reader.topics if not name.startswith("/tumortrack/")}
        assert theirs == {"/tf", "/diagnostics"}
    with pytest.raises(InputError, match="no depth images"):
        RecordingSourceConfig(path=path).open()


def test_an_existing_folder_is_never_written_into(tmp_path):
    path = record(tmp_path / "mcap", [update_number(0)])
    about = json.loads((path / "recording.json").read_text())
    assert (about["kind"], about["parts"]) == ("recording", list(PARTS))
    assert about["patient"] == {"id": "P1", "side": "left"}
    (tmp_path / "other").mkdir()
    for there in (path, tmp_path / "other", path / "recording.json"):
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(InputError, match="exists"):
            record(there, [])
        assert sorted(tmp_path.rglob("*")) == before
    assert json.loads((path / "recording.json").read_text()) == about
    assert len(play(path)) == 1


def test_a_file_cut_anywhere_gives_the_frames_before(tmp_path):
    """As a killed program leaves it. Frames are those of the whole file, from the first on."""
    sink = RecordTo(path=tmp_path / "r").open(small_setting())
    ends = []
    for n in range(6):
        sink.publish(update_number(n))
        sink._bag.flush()  # as time does
        ends.append(sink._bag._whole)
    sink.close()
    raw = (tmp_path / "r" / "r.mcap").read_bytes()
    found, cut_file = [], tmp_path / "cut.mcap"
    for size in range(len(raw) - 1, ends[0], -len(raw) // 30):
        cut_file.write_bytes(raw[:size])
        got = play(cut_file)
        assert stamps(got) == [STAMP_NS + n * PERIOD_NS for n in range(len(got))]
        assert got[-1].content.depth_mm[0, 0] == pytest.approx(120 + 0.1 * (len(got) - 1))
        assert len(got) - sum(end <= size for end in ends) in (0, 1)  # its index may be cut off
        found.append(len(got))
    assert set(found) >= {6, 5, 4, 3, 2}
    cut_file.write_bytes(raw[: ends[2]] + bytes(5000))  # a disk that filled the rest with zeros
    assert len(play(cut_file)) == 3
    cut_file.write_bytes(raw[: ends[0] // 2])
    with pytest.raises(InputError, match="no depth images"):
        play(cut_file)


CHILD = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from recording_objects import RecordTo, small_setting, update_number
sink = RecordTo(path=Path(sys.argv[1])).open(small_setting())
for n in range(1000):
    sink.publish(update_number(n))
    print(n, time.monotonic(), flush=True)
    time.sleep(0.02)
"""


def test_a_killed_recorder_loses_less_than_a_second(tmp_path):
    here = str(Path(__file__).parents[2] / "tests" / "support")
    command = [sys.executable, "-c", CHILD, str(tmp_path / "r"), here]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as child:
        lines = []
        try:
            for line in child.stdout:
                lines.append(line.split())
                if float(line.split()[1]) > float(lines[0][1]) + 1.5:
                    break
        finally:
            os.killpg(child.pid, signal.SIGKILL)
        lines += [line.split() for line in child.stdout]
    assert not (tmp_path / "r" / "metadata.yaml").exists()
    got = play(tmp_path / "r")
    assert stamps(got) == [STAMP_NS + n * PERIOD_NS for n in range(len(got))]
    came_s = np.array([float(at_s) for _, at_s in lines])
    lost_s = came_s[-1] - came_s[min(len(got), len(came_s) - 1)]
    # A chunk ends with the first frame after its time; how far apart frames come is not its matter.
    assert CHUNK_S < 1
    assert lost_s <= CHUNK_S + np.diff(came_s).max()


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
    with full_disk_at(1_700_000):
        for n in range(150):
            try:
                sink.publish(update_number(n))
                written += 1
            except StorageError as error:
                said.append(str(error))
        sink.close()
    assert len(set(said)) == 1
    assert len(said) == 150 - written > 5
    got = play(tmp_path / "r")
    assert stamps(got) == [STAMP_NS + n * PERIOD_NS for n in range(len(got))]
    assert written > len(got) > 5
    assert "File too large" in said[0]


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


def test_clouds_in_metres(tmp_path):
    folder = tmp_path / "m"
    folder.mkdir()
    np.savez(folder / "a.npz", points=np.array([[0.001, 0.002, 0.13]]))
    (seen,) = play(folder, unit="m")
    np.testing.assert_allclose(seen.content.points_mm, [[1, 2, 130]], rtol=1e-6)


def test_depth_images_beside_one_camera(tmp_path):
    write_intrinsics(tmp_path / "intrinsics.json", CAMERA)
    for n in range(3):
        write_depth_png(tmp_path / f"{n}.png", frame_number(n))
    got = play(tmp_path)
    for n, seen in enumerate(got):
        np.testing.assert_allclose(seen.content.depth_mm, frame_number(n).depth_mm, rtol=2e-7)
    assert len(got) == 3
    (tmp_path / "intrinsics.json").unlink()
    with pytest.raises(InputError, match=r"intrinsics\.json"):
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
        with pytest.raises(InputError, match="has no"):
            RecordingSourceConfig(path=path, **options).open()


def test_two_candidates_are_named_rather_than_guessed(tmp_path):
    frames = [frame_number(0)]
    topics = {
        "/left/depth": ("depth/image_rect", frames),
        "/right/depth": ("depth/image_rect", frames),
    }
    path = write_bag(tmp_path / "r", topics, "mcap")
    with pytest.raises(InputError, match="/left/depth, /right/depth"):
        RecordingSourceConfig(path=path).open()
    with pytest.raises(InputError, match="camera_info"):
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


def test_a_bag_damaged_in_the_middle_is_said_and_ends(tmp_path):
    """A chunk whose own records do not add up: nothing behind it can be trusted."""
    sink = RecordTo(path=tmp_path / "r").open(small_setting())
    ends = []
    for n in range(4):
        sink.publish(update_number(n))
        sink._bag.flush()
        ends.append(sink._bag._whole)
    sink.close()
    path = tmp_path / "r" / "r.mcap"
    raw = bytearray(path.read_bytes())
    raw[ends[1] + 50 : ends[1] + 58] = b"\xff" * 8  # the length of the chunk's first record
    path.write_bytes(raw)
    got = play(tmp_path / "r")
    assert [isinstance(seen, InputError) for seen in got[:3]] == [False, False, True]
    assert len(got) == 3


def test_a_bad_cloud_in_a_bag_is_said_and_passed(tmp_path):
    clouds = [SensorCloud(np.float32([[n + 1, 2, 130]]), STAMP_NS + n) for n in range(3)]
    path = write_bag(tmp_path / "d", {"/points": ("points", clouds)}, "mcap") / "d.mcap"
    raw = path.read_bytes()
    name = b"\x02\0\0\0y\0"  # of a field, in each message
    begin = raw.find(name, raw.find(name) + 6)
    path.write_bytes(raw[:begin] + b"\xff" * 4 + raw[begin + 4 :])
    assert first_x(play(path)) == [1, None, 3]


@pytest.mark.parametrize("name", ["r.mcap", "r.db3", "r.bag", "metadata.yaml"])
def test_rubbish_is_no_recording(tmp_path, name):
    (tmp_path / name).write_bytes(np.random.default_rng(1).bytes(3000))
    path = tmp_path if name == "metadata.yaml" else tmp_path / name
    with pytest.raises(InputError, match="bag"):
        RecordingSourceConfig(path=path).open()


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "film.avi").touch()
    for path in (tmp_path / "empty", tmp_path / "film.avi", tmp_path / "nowhere"):
        with pytest.raises(InputError):
            RecordingSourceConfig(path=path).open()
    for options in ({"rate": -1}, {"rate": float("nan")}, {"fps": 0}, {"unit_mm": 0}):
        with pytest.raises(InputError):
            RecordingSourceConfig(path=tmp_path, **options)


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


def test_close_ends_a_read_that_waits(tmp_path, monkeypatch):
    monkeypatch.setattr("tumortrack_devices.sources.recording._LONGEST_WAIT_S", 10 * PATIENCE_S)
    folder = cloud_files(tmp_path / "c", ["1000000000000.ply", "9000000000000.ply"])
    source = RecordingSourceConfig(path=folder).open()
    source.read(0)
    threading.Timer(0.1, source.close).start()
    start = time.monotonic()
    with pytest.raises(SourceLost):
        source.read(10 * PATIENCE_S)
    assert time.monotonic() - start < PATIENCE_S


def test_the_second_of_two_that_begin_to_record_into_one_folder_is_refused(tmp_path):
    first = RecordTo(path=tmp_path / "tape").open(small_setting())
    with pytest.raises(InputError, match="exists"):
        RecordTo(path=tmp_path / "tape").open(small_setting())
    first.publish(update_number(0))
    first.close()
    assert stamps(play(tmp_path / "tape")) == [frame_number(0).stamp_ns]


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
