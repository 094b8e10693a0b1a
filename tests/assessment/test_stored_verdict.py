"""A stored run whose verdict and finding disagree is not believed."""

import json
from dataclasses import replace

import numpy as np
import pytest

import tumortrack as tt
from live_objects import small_estimate
from refused import refused
from reports import poor
from tumortrack.core import store
from tumortrack.core.assessment import Assessment, ErrorBound
from tumortrack.core.report import Cause, Finding, Likely, NextEvidence
from tumortrack.core.types import CameraLabels
from tumortrack.io.run_folder import write_estimate

VOLUME = CameraLabels(np.ones((4, 4, 4), np.uint8), np.eye(4))


def stored(finding):
    return replace(small_estimate(), volume=VOLUME).assessed(finding=finding)


def test_an_assessment_survives_writing_and_reading(tmp_path):
    said = Assessment(
        bounds={"tumor_1": ErrorBound(4.5, (0.0, 0.6, 0.8)), "tumor_2": ErrorBound(np.float64(2))},
        factor=1.25,
        finding=Finding(
            "miss", {"part": "t", "error_bound95_mm": 4.5, "limit_mm": 4.0, "digits": "1"}
        ),
        causes=(Likely(Cause.SCALE, 1.5, 0.25), Likely(Cause.VIEW)),
        advice=": look elsewhere",
        next_evidence=(
            NextEvidence(
                kind="touch", part="tumor_1", place_mm=(1.0, 2.0, 3.0), direction=(0.0, 0.0, 1.0),
                std_mm=2.0, then_std_mm=1.0,
            ),
        ),
    )  # fmt: skip
    write_estimate(tmp_path / "run", replace(stored(None), assessment=said))
    assert tt.load_estimate(tmp_path / "run").assessment == said


@pytest.mark.parametrize(
    ("finding", "change"),
    [
        (None, {"verdict": "poor"}),
        (poor("it hides"), {"verdict": "good"}),
        (poor("it hides"), {"finding": None}),
        (poor("it hides"), {"finding": {"kind": "alternative", "values": {"part": "tumor_1"}}}),
        (poor("it hides"), {"finding": {"kind": "fit", "values": {"times": "many"}}}),
        (poor("it hides"), {"finding": {"kind": "unheard_of", "values": {}}}),
    ],
)
def test_a_verdict_that_does_not_follow_from_its_finding_is_refused(tmp_path, finding, change):
    run = tmp_path / "run"
    write_estimate(run, stored(finding))
    report = json.loads((run / "report.json").read_text())
    for section in report.keys() & {"quality", "assessment"}:
        report[section] |= {k: v for k, v in change.items() if k in report[section]}
    store.write_json(run / "report.json", report)
    store.seal(run, "run", {}, "camera")
    with refused(tt.errors.ArtifactError, run):
        tt.load_estimate(run)
