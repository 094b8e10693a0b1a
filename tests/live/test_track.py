"""`tumortrack track` as a user runs it: from a moving world to the report."""

from __future__ import annotations

import pytest

from stories import refusal, tumortrack
from track_objects import World, ended_when, estimates, start, told, virtual, wait_for

pytestmark = pytest.mark.slow


@pytest.fixture
def world(phantom_case, elastic_model):
    return World(phantom_case, elastic_model)


def test_a_moving_case_is_followed_and_the_report_says_how_well(world, tmp_path):
    report = tmp_path / "report.json"
    process = start(world, virtual(world, fps=10), "--report", report)
    ended_when(process, lambda: estimates(report) >= 3)
    found = told(report)
    assert sum(found["estimates"].values()) >= 3
    assert found["center_error_mm"]["kidney"]["p50"] < 3
    assert found["center_error_mm"]["kidney"]["p50"] > 0.05
    assert found["latency_ms"]["p50"] > 0
    assert found["latency_from"] == "stamp"
    assert found["defects"] == []
    assert found["config"]["follower"]["rescan_s"] == 1.0
    assert len(found["model_sha256"]) == 64


def test_a_report_that_cannot_be_written_ends_nothing(world, tmp_path):
    folder = tmp_path / "gone"
    process = start(world, virtual(world, fps=10), "--report", folder / "report.json")
    wait_for(process, "tracking")
    folder.rmdir()
    wait_for(process, "good:|poor:")
    said = ended_when(process, lambda: True)
    assert str(folder) in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["camera"], "realsense, recording, rehearsal, ros2, stereo, virtual"),
        (["virtual"], "virtual:CASE"),
        (["virtual:CASE", "screen"], "moveit, openigtlink, recording, ros2, ur, viewer"),
        (["virtual:CASE", "--smoothing", "9"], "5 s"),
        (["virtual:CASE", "--range", "200", "100"], "200"),
        (["virtual:CASE", "--frame", "none.json"], "none.json"),
        (["virtual:no_case"], "no_case"),
        (["virtual:CASE", "--tool", "pen:1"], "NAME=KIND"),
        (["virtual:CASE", "--tool", "a=pen:1"], "file, openigtlink, ros2, ur"),
    ],
)
def test_bad_options_are_answered_in_one_line(world, tmp_path, arguments, said):
    given = [virtual(world) if a == "virtual:CASE" else a for a in arguments]
    done = tumortrack("track", world.model, *given, "--report", tmp_path / "r.json")
    assert said in refusal(done)
