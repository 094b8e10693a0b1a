"""A script's types: mypy, strict, as users run it on theirs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
SETTING = """
import numpy as np
import tumortrack as tt

points = np.zeros((300, 3))
cloud = tt.SensorCloud(points)
view, touch = tt.View(cloud, cloud, np.eye(4)), tt.Touch(place_mm=(0.0, 0.0, 100.0))
case = tt.load_case("CASE")
tracker = tt.Tracker(case)
estimate = tracker.locate(points)
(scene,) = tt.simulate_scenes(case)
"""
NUMBER, MAYBE = "int", "float | None"
ESTIMATE = "tumortrack.core.estimate.Estimate"
ARRAY = re.compile(r"numpy\.ndarray\[.*\]")
TYPES = {
    'tt.locate("CASE", points)': ESTIMATE,
    "tt.locate(case, cloud, views=[view], evidence=[touch], full_view=cloud, grid=8)": ESTIMATE,
    'tracker.locate(points, views=[view], evidence=(touch,), frame="camera")': ESTIMATE,
    'tt.locate_files("CASE", ["a.png"], intrinsics="c.json").estimate': f"{ESTIMATE} | None",
    'estimate.tumors["tumor_1"].center_mm': ARRAY,
    'estimate.tumors["tumor_1"].error_bound95_mm': MAYBE,
    "estimate.forward(points)": ARRAY,
    "estimate.quality": re.compile(r".*'good'.*'poor'.*"),
    'tt.prepare("CT", "CASE", side="left", tilt=20.0)': "tumortrack.io.case.Case",
    'tt.evaluate(tracker, [scene]).errors["good"].estimate.center_mm': re.compile(".*Spread.*"),
    "tt.evaluate(tracker, [scene]).scenes[0].parts['tumor_1'].center_mm": MAYBE,
    "tt.evaluate(tracker, [scene]).good": NUMBER,
    'tt.track(tracker, "virtual:CASE", smoothing=0.1).latency_ms.p50': MAYBE,
}
MISTAKES = {  # and mypy's names of them
    'tt.locate("CASE", points, gird=8)': "call-arg",
    'tt.locate("CASE", points, evidence=[view])': "list-item",
    'tt.locate("CASE", points, views=[touch])': "list-item",
    "tracker.locate(points, 8)": "call-arg",
    'tt.locate_files("CASE", "cloud.ply", gird=8)': "call-arg",
    'tt.track(tracker, "virtual:CASE", smoothing="much")': "arg-type",
    'tt.prepare("CT", up=3)': "arg-type",
    "estimate.report = estimate.report": "misc",
    'estimate.meshes["kidney"] = scene.reference.organ': "index",
    "estimate.center": "attr-defined",
}


def said_by_mypy(*files: Path) -> list[str]:
    words = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", *map(str, files)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert not done.stderr
    return done.stdout.splitlines()


def test_every_option_and_result_has_its_type(tmp_path):
    before = SETTING.count("\n") + 1
    lines = [*(f"reveal_type({use})" for use in TYPES), *MISTAKES]
    (tmp_path / "use.py").write_text(SETTING + "\n".join(lines) + "\n")
    said: dict[int, list[str]] = {}
    for line in said_by_mypy(tmp_path / "use.py"):
        if found := re.match(r".*use\.py:(\d+): (.+)", line):
            said.setdefault(int(found[1]) - before, []).append(found[2])
    assert set(said) == set(range(len(lines)))
    for number, (use, wanted) in enumerate(TYPES.items()):
        (note,) = said[number]
        revealed = note.split('"')[1].replace("builtins.", "")
        pattern = wanted if isinstance(wanted, re.Pattern) else re.escape(wanted)
        assert re.fullmatch(pattern, revealed), use
    for number, (use, code) in enumerate(MISTAKES.items(), start=len(TYPES)):
        assert any(line.endswith(f"[{code}]") for line in said[number]), (use, said[number])


def test_the_examples_have_types():
    assert said_by_mypy(*sorted((ROOT / "examples").glob("*.py"))) == []
