"""A stored run whose verdict and finding disagree is not believed."""

import json
from dataclasses import replace

import numpy as np
import pytest

import tumortrack as tt
from live_objects import small_estimate
from reports import poor
from tumortrack.core import store
from tumortrack.core.types import CameraLabels
from tumortrack.tracking.files import write_estimate

VOLUME = CameraLabels(np.ones((4, 4, 4), np.uint8), np.eye(4))


def stored(finding):
    return replace(small_estimate(), volume=VOLUME).assessed(finding=finding)


@pytest.mark.parametrize("finding", [None, poor("the organ hides")])
def test_what_was_written_is_read(tmp_path, finding):
    write_estimate(tmp_path / "run", stored(finding))
    back = tt.load_estimate(tmp_path / "run")
    assert (back.finding, back.quality) == (finding, "good" if finding is None else "poor")


@pytest.mark.parametrize(
    ("finding", "change"),
    [
        (None, {"verdict": "poor"}),
        (poor("it hides"), {"verdict": "good"}),
        (poor("it hides"), {"finding": None}),
        (poor("it hides"), {"finding": {"kind": "rival", "values": {"part": "tumor_1"}}}),
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
    with pytest.raises(tt.errors.ArtifactError, match="is no whole run"):
        tt.load_estimate(run)
