"""`tumortrack track` as a user runs it: recorded, played again, and sent."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

import clients
from dvrk_files import open_cv
from ros2_objects import own_graph, process
from stories import refusal, succeeded, tumortrack
from track_objects import PATIENT, World, ended_when, start, told, virtual, wait_for
from tumortrack.core.camera import d405, project
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.io.csv_tables import COLUMNS, CONTACT
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.values import SourceEnded
from tumortrack_devices.sources.recording import RecordingSourceConfig

pytestmark = pytest.mark.slow

SUPPORT = Path(__file__).parent / "support"


@pytest.fixture
def world(phantom_case, elastic_model):
    return World(phantom_case, elastic_model)


def reports(recording):
    """What an MCAP says of every result."""
    with AnyReader([recording]) as reader:
        wanted = [c for c in reader.connections if c.topic == "/tumortrack/report"]
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(wanted)]
    return [json.loads(message.data) for message in messages]


def recorded(world, folder, count, *arguments):
    """Record at least so many frames, however long they take."""

    def enough():
        with contextlib.suppress(InputError):  # nothing is in it yet
            return len(evidence(folder)) >= count

    report = ("--report", folder.with_suffix(".json"))
    return ended_when(start(world, *arguments, f"recording:{folder}", *report), enough)


def evidence(recording):
    """What became known with each frame, by its stamp."""
    seen = RecordingSourceConfig(path=recording, rate=0).open()
    known = {}
    while True:
        try:
            if (frame := seen.read(1.0)) is not None:
                known[frame.stamp_ns] = frame.evidence
        except SourceEnded:
            seen.close()
            return known


def touched_place(recording):
    """What the tip of a tool that touches the organ's front in the first frame is at, as in a
    table, and the frames' stamps."""
    found = [one for one in reports(recording) if one["seen"]]
    first = next(one for one in found if one["estimate"])
    seen = RecordingSourceConfig(path=recording, rate=0).open()
    image = seen.read(30.0).content
    seen.close()
    centre_mm = np.array([first["estimate"]["parts"]["kidney"]["center_mm"]])
    ((column, row),), _ = project(centre_mm, image.intrinsics)
    row, column = round(row), round(column)
    z = np.nanmedian(image.depth_mm[row - 3 : row + 4, column - 3 : column + 4])
    x, y, z = (centre_mm[0] * z / centre_mm[0, 2] - [0, 0, 2.0]).tolist()  # a ball of 2 mm
    return f"{x},{y},{z}", [one["stamp_ns"] for one in found]


def test_a_replay_with_the_evidence_of_tools_is_the_same_to_the_last_bit(world, tmp_path):
    """A probe that touches the organ's front, and a shaft towards the camera."""
    live, first, again = (tmp_path / name for name in ("live", "first", "again"))
    source = virtual(world, fps=10, camera_motion="false")
    recorded(world, live, 22, source)
    place_mm, stamps = touched_place(live)
    # 50 Hz; it touches during four of ten frames, from the first one on.
    times = range(stamps[0], stamps[-1] + 40_000_000, 20_000_000)
    frames = np.searchsorted(stamps, times, side="right") - 1
    rows = [
        f"{at},camera,{place_mm},1,0,0,0,{int(frame % 10 < 4)}"
        for at, frame in zip(times, frames, strict=True)
    ]
    (tmp_path / "probe.csv").write_text("\n".join([COLUMNS + CONTACT, *rows]) + "\n")
    rows = [row.rpartition(",")[0] for row in rows]
    (tmp_path / "shaft.csv").write_text("\n".join([COLUMNS, *rows]) + "\n")
    report = tmp_path / "first.json"
    probe, shaft = (f"file:{tmp_path}/{name}.csv" for name in ("probe", "shaft"))
    tools = "--tool", f"probe={probe}?tip_mm=2", "--tool", f"shaft={shaft}?tip=0,0,-40&shaft_mm=20"
    run = f"recording:{live}?rate=0", f"recording:{first}", *tools, "--report", report
    succeeded(tumortrack("track", world.model, *run))
    counts = told(report)["tools"]
    assert counts["probe"]["touch"] >= 2
    assert counts["shaft"]["free_space"] >= len(stamps) / 2
    given = evidence(first)
    assert {piece.name for known in given.values() for piece in known} == {"touch", "free_space"}
    run = f"recording:{first}?rate=0", f"recording:{again}", "--report", tmp_path / "again.json"
    succeeded(tumortrack("track", world.model, *run))
    assert evidence(again) == given
    # On a busy machine the source is said to be opening first, in results that are counted.
    frames = ([one for one in reports(folder) if one["seen"]] for folder in (first, again))
    for one, other in zip(*frames, strict=True):
        for volatile in ("sequence", "seconds", "latency_ms", "arrived_ns"):
            one.pop(volatile), other.pop(volatile)
        for each in (one, other):
            (each["estimate"] or {}).pop("timings", None)
        assert one == other


def test_depths_that_were_corrected_are_not_corrected_again(world, tmp_path):
    camera = tmp_path / "camera.json"
    fields = ("width", "height", "fx", "fy", "cx", "cy")
    values = {name: getattr(d405(424, 240), name) for name in fields}
    camera.write_text(json.dumps({**values, "depth_scale": 1.002, "depth_offset_mm": -0.3}))
    given = ("--intrinsics", camera, "--report")
    recorded(world, tmp_path / "live", 3, virtual(world, fps=10), *given[:2])
    assert told(tmp_path / "live" / "recording.json")["corrected"] is True
    again = ("track", world.model, f"recording:{tmp_path / 'live'}?rate=0", *given)
    line = refusal(tumortrack(*again, tmp_path / "again.json"))
    assert "--intrinsics" in line
    camera.write_text(json.dumps(values))
    succeeded(tumortrack(*again, tmp_path / "again.json"))


def test_ctrl_c_ends_cleanly_and_flushes(world, tmp_path):
    folder, report = tmp_path / "kept", tmp_path / "report.json"
    process = start(world, virtual(world, fps=10), f"recording:{folder}", "--report", report)
    wait_for(process, "no check failed|poor")
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert "Traceback" not in said
    found = told(report)
    name = next(iter(found["sinks"]))
    assert found["sinks"][name]["delivered"] == found["updates"]
    assert (folder / "metadata.yaml").is_file()


def test_a_robot_gets_its_own_frame(world, tmp_path):
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    turn[:3, 3] = [0.4, 0.1, 0.7]
    calibration = tmp_path / "hand_eye.json"
    calibration.write_text(
        json.dumps({"frame_id": "base_link", "unit": "m", "robot_from_camera": turn.tolist()})
    )
    out, report = tmp_path / "out", tmp_path / "out.json"
    said = recorded(world, out, 3, virtual(world, fps=5), "--frame", calibration)
    assert "in frame 'base_link'" in said
    found = told(report)
    assert found["frame"]["frame_id"] == "base_link"
    assert found["frame"]["published_from_camera"][2][3] == pytest.approx(700)
    about = told(out / "recording.json")
    assert about["frame_id"] == "base_link"
    whose = {"id": "P1", "side": "right"}
    assert about["patient"] == found["patient"] == whose
    estimate = next(one["estimate"] for one in reports(out) if one["estimate"])
    assert estimate["patient"] == whose


def test_several_cameras_and_one_that_moves_are_tracked_from_recordings(world, tmp_path):
    tape, poses = tmp_path / "tape", tmp_path / "poses.json"
    source = f"recording:{tape}?rate=0"
    recorded(world, tape, 6, virtual(world, fps=10, camera_motion="false"))
    rows = np.eye(4).tolist()
    poses.write_text(
        json.dumps({"unit": "mm", "frame_id": "base", "fixed_from_camera": [rows, rows]})
    )
    two = tumortrack(
        *("track", world.model, source, f"recording:{tmp_path / 'two'}"),
        *("--views", f"{source}&fps=30", "--poses", poses, "--report", tmp_path / "two.json"),
        *PATIENT,
    )
    assert "cameras 1, 2" in succeeded(two)
    found = told(tmp_path / "two.json")
    assert found["cameras"]["1"] == found["cameras"]["2"] >= 2
    assert found["frame"]["frame_id"] == "base"
    with AnyReader([tmp_path / "two"]) as reader:
        assert "/camera_2/depth/image_rect" in reader.topics
    stamps = [one["stamp_ns"] for one in reports(tape) if one["seen"]]
    table = "stamp_ns,frame_id,x_mm,y_mm,z_mm,qw,qx,qy,qz\n" + "".join(
        f"{stamp},base,{n},0,0,0,1,0,0\n" for n, stamp in enumerate(stamps[:-1])
    )
    (tmp_path / "poses.csv").write_text(table)
    moved = tumortrack(
        *("track", world.model, source, f"recording:{tmp_path / 'moved'}"),
        *("--moving", f"file:{tmp_path / 'poses.csv'}", "--report", tmp_path / "moved.json"),
        *PATIENT,
    )
    succeeded(moved)
    found = told(tmp_path / "moved.json")
    assert found["frame"] == {"frame_id": "base", "published_from_camera": None}
    assert sum(found["estimates"].values()) >= 2
    assert any("last pose is older than the frame" in reason for reason in found["reasons"])
    kept = (tmp_path / "moved" / "poses.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in kept[1:]] == [str(one) for one in stamps[:-1]]
    alone = tumortrack("track", world.model, source, "--views", f"{source}&fps=30")
    assert "--views needs --poses" in refusal(alone)


def test_a_dvrk_that_touches_the_organ_is_evidence_in_track(world, tmp_path) -> None:
    """With the file that dVRK's camera registration wrote, and an arm of rclpy. The tip stands on
    the organ where the camera sees it, and its jaw closes once a second."""
    live = tmp_path / "live"
    source = virtual(world, fps=10, camera_motion="false", breathing="false", instrument="false")
    recorded(world, live, 5, source)
    words, _ = touched_place(live)
    camera_mm = np.array([[float(word) for word in words.split(",")]])
    frame = tmp_path / "PSM1-registration-open-cv.json"
    frame.write_text(open_cv("camera"))
    base_from_camera = read_frames(frame).published_from_camera
    place_m = transform_points(base_from_camera, camera_mm)[0] / 1000
    report = tmp_path / "report.json"
    tool = "psm1=crtk:/PSM1?pose=local/measured_cp&tip_mm=2&via=dds"
    given = source, "--frame", frame, "--tool", tool, "--report", report
    peer = sys.executable, SUPPORT / "crtk_peer.py", "arm", *place_m.tolist()
    with own_graph(), ExitStack() as running:
        environment = clients.environment("ros-jazzy-rclpy")
        running.enter_context(process(*peer, environment=environment)).line()

        def enough() -> bool:
            counts = told(report)["tools"]["psm1"] if report.exists() else {}
            return counts.get("touch", 0) >= 3

        ended_when(start(world, *given, f"recording:{tmp_path / 'seen'}"), enough)
    pieces = [piece for known in evidence(tmp_path / "seen").values() for piece in known]
    assert {(piece.name, piece.tool) for piece in pieces} == {("touch", "psm1")}
    places_mm = np.array([piece.place_mm for piece in pieces])
    np.testing.assert_allclose(places_mm, np.tile(camera_mm, (len(pieces), 1)), atol=1e-3)
    counts = told(report)["tools"]["psm1"]
    assert counts.get("rejected", 0) == 0, counts
    found = [one["estimate"] for one in reports(tmp_path / "seen") if one["estimate"]]
    used = [each for one in found for each in one.get("evidence", ())]
    assert any(not each["rejected"] for each in used)
