"""A wrong touch is named before anything else, and touches alone are not told to free a view."""

from types import SimpleNamespace

import numpy as np
import pytest

from live_objects import small_estimate
from tumortrack.assessment.bound import POOR_MM
from tumortrack.assessment.verdict import _doubt
from tumortrack.core.assessment import ErrorBound
from tumortrack.core.estimate import FollowOptions
from tumortrack.core.geometry import HERE
from tumortrack.core.report import Cause, EvidenceReport, Likely, PartReport
from tumortrack.core.types import Look, SensorCloud
from tumortrack.tracking import tracker

HIDDEN = (Likely(Cause.HIDDEN, 0.43),)


@pytest.fixture
def explained(monkeypatch):
    monkeypatch.setattr(tracker, "likely_causes", lambda *_: HIDDEN)
    mine = tracker.Tracker.__new__(tracker.Tracker)
    mine.model, mine._weakness = SimpleNamespace(), ""

    def explain(evidence=(), cloud=None, known=(), in_sight=None):
        points = SensorCloud(small_estimate().organ_mesh.vertices_mm)
        looks = (Look(points, points if cloud is None else cloud, HERE),)
        estimate = small_estimate().reporting(
            evidence=evidence, timings={"total": 0.0}, in_sight=in_sight
        )
        how = FollowOptions(known={"other": known} if known else {})
        return mine._explained(estimate, looks, how)

    return explain


def piece(off_mm, left_out=True):
    return EvidenceReport(name="touch", off_mm=off_mm, news=1.0, left_out=left_out)


def test_the_piece_that_lies_farthest_is_the_likeliest_cause(explained):
    told = explained((piece(1.0, False), piece(9.0), piece(331.0), piece(20.0)))
    assert [(likely.cause, likely.number) for likely in told.causes] == [
        (Cause.EVIDENCE, 3),
        (Cause.HIDDEN, 0.43),
    ]
    plain = explained((piece(1.0, False),))
    assert plain.causes == HIDDEN
    assert "look" in plain.assessment.advice
    assert "look" not in told.assessment.advice


def test_it_is_no_cause_of_later_frames(explained):
    known = (Likely(Cause.EVIDENCE, 3), *HIDDEN)
    assert explained(known=known).causes == HIDDEN


def test_touches_alone_hide_nothing(explained):
    told = explained(cloud=SensorCloud(np.zeros((0, 3), np.float32)))
    assert [likely.cause for likely in told.causes] == [Cause.VIEW]
    assert told.assessment.advice
    assert "view" not in told.assessment.advice


@pytest.mark.parametrize("over_mm", [0.4, 0.04, 0.004, 0.0004])
def test_what_is_over_the_limit_reads_as_over_it(over_mm):
    parts = {n: PartReport(label=1, found=True) for n in ("kidney",)}
    parts["tumor_1"] = PartReport(label=2, found=True)
    report = small_estimate().reporting(parts=parts, evidence=()).report
    finding = _doubt(report, {"tumor_1": ErrorBound(POOR_MM + over_mm)})
    assert finding.kind == "miss"
    shown = [float(word.rstrip(".")) for word in finding.words.split() if word[0].isdigit()]
    assert shown[0] > shown[1]


@pytest.mark.parametrize(("in_sight", "cause"), [(0.97, Cause.VIEW), (0.6, Cause.HIDDEN)])
def test_a_hidden_side_is_blamed_only_where_something_hides_it(explained, in_sight, cause):
    told = explained(in_sight=in_sight)
    assert [likely.cause for likely in told.causes] == [cause]
    assert told.assessment.advice
