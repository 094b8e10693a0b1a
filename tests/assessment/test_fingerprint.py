"""The answers that name the method's version are still its answers."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "src/tumortrack/assessment/answers.json"


@pytest.mark.slow
def test_the_recorded_answers_are_those_of_this_code():
    command = [sys.executable, ROOT / "tools/replay.py", "check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_place_that_moved_or_a_figure_that_changed_is_another_method(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import replay

    known = json.loads(KEPT.read_text())["answers"]
    assert len(known) == 30
    assert replay.stands(known, known)
    for name, each in known.items():
        for by_mm, stands in ((0.04, True), (0.06, False)):
            places = [list(place) for place in each["places_mm"]]
            places[-1][2] += by_mm
            assert replay.stands({**known, name: {**each, "places_mm": places}}, known) == stands
    name, each = next(iter(known.items()))
    figure = next(iter(each["figures"]))
    for by, stands in ((1.01, True), (1.03, False)):
        figures = {**each["figures"], figure: by * each["figures"][figure]}
        assert replay.stands({**known, name: {**each, "figures": figures}}, known) == stands
    assert not replay.stands({**known, name: {"input_mm": {}, "verdict": "none: outliers"}}, known)
    assert not replay.stands(dict(list(known.items())[1:]), known)
