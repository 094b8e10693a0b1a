"""Margins as a model states them: kept with it, stated or refused with an estimate."""

from __future__ import annotations

import dataclasses
import json

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from live_objects import small_estimate
from reports import NOWHERE, poor, report_of, reporting
from tumortrack.assessment.bound import MissModel
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError
from tumortrack.core.report import MarginReport
from tumortrack.core.types import SensorCloud
from tumortrack.tracking import margins as stored
from tumortrack.tracking import misses
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.margins import (
    ModelMargins,
    Radius,
    Shells,
    stated_margin,
    stated_radius,
    with_margin,
)
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from warp_objects import ANATOMY, placed


def _shells(confidence: float, factor: float) -> Shells:
    tumor = Radius(used="scaled", constant_mm=4.0, scaled=factor, offset_mm=0.5)
    organ = Radius(used="constant", constant_mm=factor)
    return Shells(confidence=confidence, radii={"tumor": tumor, "organ": organ})


MARGINS = ModelMargins(
    fingerprint=fingerprint(), tumortrack="0", model_sha256="", table_sha256="abc", seed=0,
    widest_mm=20.0, limits={"fit_cost": 1.0}, shells=(_shells(0.8, 2.0), _shells(0.9, 3.0)),
    groups=(), joined={}, risk_bound=0.1, accepted=1.0, missed=0.0,
)  # fmt: skip


def test_stored_margins_are_refused_where_anything_differs(tmp_path):
    (tmp_path / store.MANIFEST).write_text("{}")
    assert stored.read_margins(tmp_path) is None
    path = stored.keep_margins(tmp_path, MARGINS)
    digest = store.sha256_of(tmp_path / store.MANIFEST)
    assert stored.read_margins(tmp_path) == replace(MARGINS, model_sha256=digest)
    content = json.loads(path.read_text())
    content["margins"]["shells"][0]["radii"]["tumor"]["constant_mm"] = 0.1
    path.write_text(json.dumps(content))
    with pytest.raises(ArtifactError, match="was changed after it was written"):
        stored.read_margins(tmp_path)
    stored.keep_margins(tmp_path, MARGINS)
    (tmp_path / store.MANIFEST).write_text('{"another": 1}')
    with pytest.raises(ArtifactError, match="is of another model"):
        stored.read_margins(tmp_path)
    stored.keep_margins(tmp_path, MARGINS)
    stored.keep_margins(tmp_path, replace(MARGINS, fingerprint="of another method"))
    with pytest.raises(ArtifactError, match="of another method"):
        stored.read_margins(tmp_path)


def test_an_estimate_states_its_margins_or_why_it_has_none():
    parts = {"kidney": {"surface_std_mm": 2.0}, "tumor_1": {"surface_std_mm": 1.0}}
    report = report_of(parts=parts)
    said = stated_margin(report, MARGINS, good=True)
    radius = MARGINS.shells[1].radii["tumor"]
    assert stated_radius(said, "tumor_1").mm == radius.at(1.0, {})
    assert stated_radius(said, "tumor_1").words == f"90 % margin {radius.at(1.0, {}):.1f} mm"
    assert stated_radius(said, "kidney").mm == MARGINS.shells[1].radii["organ"].at(2.0, {})
    assert stated_radius(said, "tumor_1", 0.8).mm < radius.at(1.0, {})
    assert stated_radius(said, "tumor_1", 0.95) is None
    assert stated_radius(said, "map") is None  # no scene had targets
    assert stated_margin(report, None, good=True).stated == ()
    assert stated_margin(report, MARGINS, good=False).stated == ()
    smoothed = report_of(parts=parts, smoothing={"time_s": 0.2})
    assert "smoothed" in stated_margin(smoothed, MARGINS, good=True).reason


def test_an_estimate_beyond_a_limit_is_poor_and_says_which():
    rare = replace(MARGINS, limits={"rarity": 1.0, "unseen": 0.5})

    def judged(rarity, cloud, finding=None):
        estimate = small_estimate().assessed(finding=finding)
        parts = {name: {"surface_std_mm": 1.0} for name in estimate.report.parts}
        estimate = reporting(estimate, parts=parts, motion={**NOWHERE, "rarity": rarity})
        return with_margin(estimate, cloud, rare)

    organ = small_estimate().meshes["kidney"].vertices_mm
    whole = SensorCloud(organ.astype(np.float32))
    fine = judged(0.9, whole)
    assert (fine.quality, len(fine.report.margin.stated)) == ("good", 2)
    far = judged(1.2, whole)
    assert (far.quality, far.report.margin.stated) == ("poor", ())
    assert far.reason == "rarity is 1.2; margins are known up to 1"
    assert far.finding.values == {"figure": "rarity", "value": 1.2, "limit": 1.0}
    end = SensorCloud(organ[organ[:, 0] < np.quantile(organ[:, 0], 0.2)].astype(np.float32))
    assert "unseen is 0." in judged(0.9, end).reason  # worked out here: an image was judged
    before = judged(0.9, whole, poor("it is hidden"))
    assert before.report.margin == MarginReport(reason="a poor estimate has no margin")
    without = with_margin(small_estimate().assessed(finding=None), whole, None)
    assert without.quality == "good"
    assert without.report.margin.reason.startswith("the model was not calibrated")


def _with(evidence: dict[str, int], factor: float) -> ModelMargins:
    return replace(MARGINS, evidence=evidence, shells=(_shells(0.9, factor),))


def _using(left_out=0, **numbers):
    """A report of an estimate that used so many pieces of each kind."""
    parts = {"kidney": {"surface_std_mm": 2.0}, "tumor_1": {"surface_std_mm": 1.0}}
    pieces = [
        {"name": name, "part": "tumor_1", "off_mm": 0.0, "news": 0.5, "left_out": n < left_out}
        for name, number in numbers.items()
        for n in range(number)
    ]
    return report_of(parts=parts, evidence=pieces)


SEVERAL = replace(MARGINS, others=(
    _with({"touch": 12}, 5.0), _with({"touch": 6}, 7.0), _with({"outline": 1, "touch": 6}, 9.0),
))  # fmt: skip


def test_an_estimate_with_evidence_states_the_margin_of_its_own_group():
    def factor(report):
        said = stated_margin(report, SEVERAL, good=True)
        return stated_radius(said, "kidney").mm  # constant: the factor

    assert [factor(_using(touch=n)) for n in (0, 6, 11, 12, 40)] == [3.0, 7.0, 7.0, 5.0, 5.0]
    assert factor(_using(touch=13, left_out=2)) == 5.0  # as in calibrations, which have false ones
    assert factor(_using(touch=11, left_out=2)) == 7.0
    assert factor(_using(touch=12, outline=1)) == 9.0
    told = stated_margin(_using(touch=12), SEVERAL, good=True)
    assert stated_radius(told, "tumor_1").mm == 5.0 * (0.5 + 1.0)


def test_an_estimate_with_other_evidence_states_no_margin_and_says_how_to_get_one():
    def reason(report, margins=SEVERAL):
        said = stated_margin(report, margins, good=True)
        assert said.stated == ()
        return said.reason

    asked = "with held1+touch12 were not calibrated (tumortrack margins MODEL SCENES --evidence "
    assert asked + "held1+touch12)" in reason(_using(touch=12, held=1))
    assert "with touch5 were not" in reason(_using(touch=5))
    assert "with outline1 were not" in reason(_using(outline=1))
    assert "with touch12 were not" in reason(_using(touch=12), MARGINS)
    parts = {name: {"surface_std_mm": 1.0} for name in ("kidney", "tumor_1", "tumor_2")}
    some = replace(_using(outline=2, touch=6), parts=report_of(parts=parts).parts)
    assert "of outlines of every tumor" in reason(some)  # none of tumor_2
    early = _using(touch=12)
    early = replace(early, evidence=tuple(replace(e, before=True) for e in early.evidence))
    assert "not of earlier frames" in reason(early)
    assert "not of touches alone" in reason(report_of(parts=parts, points=24))


def test_margins_with_evidence_are_kept_beside_those_of_clouds_alone(tmp_path):
    (tmp_path / store.MANIFEST).write_text("{}")
    path = stored.keep_margins(tmp_path, SEVERAL)
    assert stored.read_margins(tmp_path).others == SEVERAL.others
    assert "with touch12 or more beside the cloud:" in stored.described(SEVERAL)
    content = json.loads(path.read_text())["margins"]
    before = {name: each for name, each in content.items() if name not in ("others", "evidence")}
    store.write_json(path, {"sha256": stored._digest(before), "margins": before})
    old = stored.read_margins(tmp_path)  # as an earlier version wrote it
    assert (old.others, old.evidence, old.shells) == ((), {}, MARGINS.shells)


def test_the_limits_of_an_estimate_are_those_of_its_group():
    def judged(touches):
        estimate = small_estimate().assessed(finding=None)
        parts = {name: {"surface_std_mm": 1.0} for name in estimate.report.parts}
        pieces = msgspec.to_builtins(_using(touch=touches).evidence)
        estimate = reporting(
            estimate, parts=parts, motion={**NOWHERE, "rarity": 1.2}, evidence=pieces
        )
        alone = replace(MARGINS, limits={"rarity": 1.0})
        wider = replace(_with({"touch": 12}, 5.0), limits={"rarity": 2.0})
        cloud = SensorCloud(estimate.meshes["kidney"].vertices_mm.astype(np.float32))
        return with_margin(estimate, cloud, replace(alone, others=(wider,)))

    assert judged(0).quality == judged(11).quality == "poor"
    assert (judged(12).quality, len(judged(12).report.margin.stated)) == ("good", 1)


def test_a_weak_models_answer_states_no_margin(slim_model, monkeypatch):
    sure = MissModel(fingerprint(), 0.0, {}, {})
    monkeypatch.setattr(misses, "shipped", lambda: sure)
    moved = placed(share=0.3).carry(ANATOMY.organ.vertices_mm)
    cloud = SensorCloud(moved[((moved - moved.mean(0)) * moved).sum(1) < 0].astype(np.float32))
    known = load_model(slim_model, "cpu")
    stated = {}
    for far in (0.0, 0.9):  # share of the scenes in which no answer was right
        provenance = {**known.provenance, "validation_far": far}
        model = dataclasses.replace(known, provenance=provenance, margins=MARGINS)
        found = Tracker(model).locate(cloud, 16, 0)
        stated[found.finding and found.finding.kind] = bool(found.report.margin.stated)
    assert stated == {None: True, "model": False}
