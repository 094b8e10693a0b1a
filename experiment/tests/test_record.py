"""`record`: what was seen comes back by state, with what came with it, however it was stopped."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from record_objects import SPEC, SmallBenchConfig
from refused import refused
from tumortrack.cli.main import run
from tumortrack.core.errors import InputError
from tumortrack.io.csv_tables import COLUMNS
from tumortrack.live.spec import SOURCES
from tumortrack.live.values import SourceEnded
from tumortrack_experiment.record.attachments import attachments_of
from tumortrack_experiment.record.folder import RecordingFolder
from tumortrack_experiment.record.read import WHOLE, read_recorded

POSE = [[0.0, -1, 0, 10], [1, 0, 0, -20], [0, 0, 1, 300], [0, 0, 0, 1]]
KIT = {
    "case_sha256": "0",
    "bead_diameter_mm": 6.0,
    "beads": [{"name": f"b{n}", "center_mm": [n * 20, n % 2 * 30, 3]} for n in range(4)],
    "base_from_ct": np.eye(4).tolist(),
    "organ_ml": 100.0,
    "tumors_ml": [3.0],
    "states": ["rest", "D1", "D2"],
    "parts": [
        {"name": "plate", "file": "p.stl", "purpose": "squeezes", "volume_ml": 1, "state": "D1"}
    ],
}


@pytest.fixture(autouse=True)
def bench(monkeypatch):
    monkeypatch.setitem(SOURCES.built_in, "small", SPEC)
    SmallBenchConfig.taken.clear()


def record(folder: Path, *options: str, source: str = "small", seconds: str = "0.5") -> int:
    default = () if "--kit" in options else ("--states", "rest", "D1")
    always = ["--seconds", seconds, "--countdown", "0", "--yes"]
    return run(["record", source, str(folder), *default, *always, *options])


def said_of(folder: Path, state: str) -> str:
    about = json.loads((folder / "recording.json").read_text())
    return "; ".join(about["done"][state]["warnings"])


def test_an_experiment_from_its_kit_to_what_is_read_and_played_of_it(tmp_path, capsys):
    (tmp_path / "kit.json").write_text(json.dumps(KIT))
    frame = {"frame_id": "base", "unit": "mm", "robot_from_camera": POSE}
    (tmp_path / "frame.json").write_text(json.dumps(frame))
    beside = ("--kit", str(tmp_path), "--frame", str(tmp_path / "frame.json"))
    assert record(tmp_path / "r", *beside, source="small?grey=120") == 0
    said = capsys.readouterr().out
    assert "state 2 of 3: D1\n  set up plate: squeezes\n" in said
    assert "17 frames, depth 100% in range" in said
    assert ", still, light 119 of 255, 30 fps, 0 dropped" in said
    inside = {path.name for path in (tmp_path / "r").iterdir()}
    assert inside == {"recording.json", "recording.mcap", "metadata.yaml"}

    recorded = read_recorded(tmp_path / "r")
    assert recorded.states == ("rest", "D1", "D2")
    sent = {seen.stamp_ns: seen for seen in SmallBenchConfig.taken}
    stamps = []
    for state in recorded.states:
        moments = list(recorded.moments(state))
        assert len(moments) == 17
        for moment in moments:
            seen = sent[moment.depth.stamp_ns]
            np.testing.assert_allclose(moment.depth.depth_mm, seen.content.depth_mm, rtol=2e-7)
            assert moment.depth.intrinsics == seen.content.intrinsics
            np.testing.assert_array_equal(moment.picture, seen.picture)
            np.testing.assert_allclose(moment.fixed_from_camera, POSE, atol=1e-9)
            stamps.append(moment.depth.stamp_ns)
    assert stamps == sorted(stamps)
    assert len(set(stamps)) == 51

    files = {name: (tmp_path / name).read_bytes() for name in ("kit.json", "frame.json")}
    files["calibration.json"] = files.pop("frame.json")
    about = json.loads(recorded.attachments.pop("recording.json"))
    assert recorded.attachments == files
    assert about["files"] == {n: hashlib.sha256(data).hexdigest() for n, data in files.items()}
    assert about == json.loads((tmp_path / "r" / "recording.json").read_text())

    source = SOURCES.parse(f"recording:{tmp_path / 'r'}?rate=0").open()
    assert [source.read(0.1).stamp_ns for _ in stamps] == stamps
    with pytest.raises(SourceEnded):
        source.read(0.1)
    with AnyReader([tmp_path / "r"]) as reader:
        messages = [(c.topic, reader.deserialize(m, c.msgtype)) for c, _, m in reader.messages()]
    assert [m.data for topic, m in messages if topic == "/state"] == ["rest", "D1", "D2"]
    colours = [m for topic, m in messages if topic == "/camera/color/image_raw"]
    assert (len(colours), colours[0].encoding) == (51, "rgb8")
    assert {m.transforms[0].header.frame_id for topic, m in messages if topic == "/tf"} == {"base"}


def test_a_killed_recording_goes_on_with_what_is_missing(tmp_path, capsys):
    with refused(InputError, tmp_path / "r"):
        read_recorded(tmp_path / "r")
    if not (child := os.fork()):  # killed in the second state's middle
        record(tmp_path / "r", source="small?kill_at=30")
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    before = read_recorded(tmp_path / "r")
    assert before.states == ("rest",)
    rest = [moment.depth for moment in before.moments("rest")]
    assert len(rest) == 17
    capsys.readouterr()
    assert record(tmp_path / "r", "--states", "rest", "D2") == 2
    assert 'begun with other states: ["rest", "D1"]' in capsys.readouterr().err
    assert record(tmp_path / "r", "--frame", __file__) == 2
    assert record(tmp_path / "r", "--only", "D7") == 2
    assert "no state 'D7', but rest, D1" in capsys.readouterr().err
    assert record(tmp_path / "r") == 0
    assert capsys.readouterr().out.startswith("state 2 of 2: D1")
    after = read_recorded(tmp_path / "r")
    assert after.states == ("rest", "D1")
    for moment, kept in zip(after.moments("rest"), rest, strict=True):
        assert moment.depth.stamp_ns == kept.stamp_ns
        np.testing.assert_array_equal(moment.depth.depth_mm, kept.depth_mm)
    assert record(tmp_path / "r") == 0  # nothing is missing
    assert record(tmp_path / "r", "--only", "D1") == 2
    assert "is finished" in capsys.readouterr().err


def test_a_state_alone_and_anew(tmp_path):
    """In the checklist's order, whichever came first."""
    assert record(tmp_path, "--only", "D1") == 0
    first = next(read_recorded(tmp_path).moments("D1")).depth.stamp_ns
    assert record(tmp_path, "--only", "D1") == 0
    second = next(read_recorded(tmp_path).moments("D1")).depth.stamp_ns
    assert second > first
    assert record(tmp_path) == 0
    recorded = read_recorded(tmp_path)
    assert recorded.states == ("rest", "D1")
    assert next(recorded.moments("D1")).depth.stamp_ns == second
    assert next(recorded.moments("rest")).depth.stamp_ns > second


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("small", ""),
        ("small:wobbles", "moved: wait until all is still"),
        ("small:sinks", "moved: wait until all is still"),
        ("small?lift_mm=-110", "nearer than 70 mm"),
        ("small?lift_mm=400", "farther than 500 mm: move nearer; only 0% is in range"),
        ("small?noise_mm=1.5", "noise is over 1."),
        ("small?hole_share=0.4", "has no depth"),
        ("small?grey=255", "of the picture is white"),
        ("small?grey=3", "the picture's mean is"),
        ("small?lost_at=2", "the source was silent for"),
        ("small?noise_mm=0", "the source is frozen: the same image for"),
    ],
)
def test_what_is_wrong_with_a_state_is_said(tmp_path, source, words, monkeypatch):
    monkeypatch.setattr("tumortrack.live.workers._AGAIN_S", 0.01)
    if "lost" in source:  # 1.1 s by its stamps
        monkeypatch.setattr("record_objects.PERIOD_NS", 600_000_000)
    assert record(tmp_path, "--only", "rest", source=source, seconds="1.1") == 0
    said = said_of(tmp_path, "rest")
    assert words in said
    assert bool(words) == bool(said)


def test_a_camera_that_moved_between_states_is_noticed(tmp_path):
    states = ("--states", "rest", "D1", "D2", "--only")
    assert record(tmp_path, *states, "rest", seconds="1.4") == 0
    assert record(tmp_path, *states, "D1", source="small?lift_mm=3", seconds="1.4") == 0
    moved = "the camera or the table has moved: the table lies 3.0 mm off"
    assert said_of(tmp_path, "rest") == ""
    assert moved in said_of(tmp_path, "D1")
    assert record(tmp_path, *states, "D1", seconds="1.4") == 0
    assert said_of(tmp_path, "D1") == ""


def test_another_camera_than_the_calibrations_is_noticed(tmp_path):
    frame = {"frame_id": "base", "unit": "mm", "robot_from_camera": POSE, "camera_frame_id": "lens"}
    (tmp_path / "f.json").write_text(json.dumps(frame))
    for name, words in (("lens", ""), ("other", "'other', and the calibration is for 'lens'")):
        folder, beside = tmp_path / name, ("--frame", str(tmp_path / "f.json"))
        assert record(folder, *beside, "--only", "D1", source=f"small?frame_id={name}") == 0
        assert words in said_of(folder, "D1")
        assert bool(words) == bool(said_of(folder, "D1"))
        for moment in read_recorded(folder).moments("D1"):
            np.testing.assert_allclose(moment.fixed_from_camera, POSE, atol=1e-9)


def test_poses_of_a_moving_camera_come_back(tmp_path):
    from record_objects import BEGIN_NS, PERIOD_NS

    now = SmallBenchConfig.number[0]
    rows = [f"{BEGIN_NS + n * PERIOD_NS},base,{n},0,0,1,0,0,0" for n in range(now, now + 60)]
    (tmp_path / "poses.csv").write_text("\n".join([COLUMNS, *rows, ""]))
    assert record(tmp_path / "r", "--moving", f"file:{tmp_path / 'poses.csv'}") == 0
    for state in ("rest", "D1"):
        for moment in read_recorded(tmp_path / "r").moments(state):
            n = (moment.depth.stamp_ns - BEGIN_NS) / PERIOD_NS
            np.testing.assert_allclose(moment.fixed_from_camera[:3, 3], [n, 0, 0], atol=1e-9)


def test_a_full_disk_is_one_error_and_costs_no_state(tmp_path, monkeypatch, capsys):
    def fails() -> None:
        with monkeypatch.context() as full:
            full.setattr("rosbags.rosbag2.Writer.write", no_room)
            assert record(tmp_path) == 2
        said = capsys.readouterr().err
        assert "No space left on device. What is finished stays. Free some" in said
        assert said.count("\n") == 1

    def no_room(self, *data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    assert record(tmp_path, "--only", "rest") == 0
    fails()  # in the second state
    assert read_recorded(tmp_path).states == ("rest",)
    with monkeypatch.context() as full:  # where all are put together
        full.setattr(RecordingFolder, "finish", lambda folder: folder.path)
        assert record(tmp_path) == 0
    fails()
    assert read_recorded(tmp_path).states == ("rest", "D1")
    assert not (tmp_path / WHOLE).exists()
    assert record(tmp_path) == 0
    assert read_recorded(tmp_path).states == ("rest", "D1")
    assert (tmp_path / WHOLE).is_file()


def test_the_user_is_asked_and_may_repeat_or_end(tmp_path, monkeypatch, capsys):
    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        always = ["record", "small", str(tmp_path), "--states", "rest", "D1", "--seconds", "0.5"]
        for answers, states in (("\nr\n\n\n\nq\n", ("rest",)), ("\n\n", ("rest", "D1"))):
            os.write(ours, answers.encode())
            assert run(always) == 0
            assert read_recorded(tmp_path).states == states
            assert not (tmp_path / ".part").exists()
        os.close(ours)
    said = capsys.readouterr().out
    assert said.count("rest: 17 frames") == 2
    assert "missing: D1. The same command goes on." in said


@pytest.mark.parametrize(
    ("source", "options", "words"),
    [
        ("nothing", (), "no kind 'nothing'"),
        ("small?cloud=true", (), "gives clouds; a recording needs depth images"),
        ("small?frames=20", (), "the source is at its end, and states are missing"),
        ("small", ("--states", "a", "a"), "each once"),
        ("small", ("--states", "../a"), "cannot be called '../a'"),
        ("small", ("--seconds", "0"), "--seconds must lie in"),
        ("small", ("--range", "200", "100"), "--range is NEAR FAR"),
        ("small", ("--frame", "none.json"), "none.json does not exist"),
        ("small", ("--kit", "none"), "none does not exist"),
        ("small", ("--moving", "file:none.csv"), "none.csv does not exist"),
    ],
)
def test_what_cannot_be_recorded_is_one_error(tmp_path, capsys, source, options, words):
    assert record(tmp_path / "r", *options, source=source) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_other_folders_are_left_alone(tmp_path, capsys):
    (tmp_path / "other.txt").write_text("mine")
    assert record(tmp_path) == 2
    assert "exists already, and is no recording" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["other.txt"]
    assert run(["record", "small", str(tmp_path / "r"), "--states", "rest"]) == 2
    assert "Give --yes" in capsys.readouterr().err


def test_damage_is_said(tmp_path):
    assert record(tmp_path, source="small?grey=99", seconds="0.1") == 0
    whole = (tmp_path / WHOLE).read_bytes()
    (tmp_path / WHOLE).write_bytes(whole.replace(b'"kind": "experiment"', b'"kind": "experimenT"'))
    with refused(InputError, tmp_path / WHOLE):
        attachments_of(tmp_path / WHOLE)
    (tmp_path / WHOLE).write_bytes(whole[:-9])
    with refused(InputError, tmp_path):
        read_recorded(tmp_path)
    rng, read = np.random.default_rng(0), 0
    for at in (
        rng.integers(len(whole), size=8).tolist() + (len(whole) - 2 ** np.arange(12)).tolist()
    ):
        changed = bytearray(whole)
        changed[at] ^= 1 << rng.integers(8)
        (tmp_path / WHOLE).write_bytes(changed)
        with suppress(InputError):  # and nothing else
            recorded = read_recorded(tmp_path)
            read += sum(len(list(recorded.moments(state))) for state in recorded.states)
    assert read > 17
