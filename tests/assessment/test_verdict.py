"""The same judgement of files and live frames: what makes an estimate poor, and what refuses it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from live_objects import small_estimate
from reports import looked, report_of, reporting
from stories import answered, refusal, succeeded, tumortrack
from tumortrack.assessment.bound import POOR_MM
from tumortrack.assessment.sight import Sight, cloud_shares, seen_through
from tumortrack.assessment.verdict import Disputes, finding_of, judged
from tumortrack.core import store
from tumortrack.core.assessment import ErrorBound
from tumortrack.core.camera import d405, deproject
from tumortrack.core.errors import NoEstimate
from tumortrack.core.render import render_depth
from tumortrack.core.report import EvidenceReport
from tumortrack.core.types import DepthFrame, Mesh, PointNoise, SensorCloud
from tumortrack.io.model_folder import reliability_warning
from tumortrack.registration.motion import ElasticMotion
from tumortrack.tracking.follower import Follower, FollowerConfig
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from warp_objects import ANATOMY, PLACE_MM, TURNED

CAMERA = d405(424, 240)
COST = {"now": 1.0, "without_outliers": 1.0, "usual": 2.0, "outliers": 0.0}
SURE = {"center_std_mm": 1.0, "probability": 0.9}


def others(distance_mm):
    return [{"more": 1.0, "distance_mm": {"kidney": 0.4, "tumor_1": distance_mm}}]


@pytest.mark.parametrize(
    ("entries", "kind"),
    [
        ({}, None),
        ({"fit_cost": COST | {"now": 2.1}}, "fit"),
        ({"size": {"times": 1.07, "gain": 9.1}}, None),
        ({"size": {"times": 1.07, "gain": 9.3}}, "size"),
        ({"fit_cost": COST | {"others": others(2.9)}}, None),
        ({"fit_cost": COST | {"others": others(5.2)}}, "alternative"),
        *(
            ({"fit_cost": COST | {"excluded_pose": {"less": 0.1, "tilt_degrees": tilt}}}, kind)
            for tilt, kind in ((40.0, "not_turned"), (80.0, "tilted"), (172.0, "upside_down"))
        ),
        ({"parts": {"kidney": SURE, "tumor_1": SURE | {"center_std_mm": 3.4}}}, "unsure"),
        ({"parts": {"kidney": SURE, "tumor_1": SURE | {"probability": 0.5}}}, "improbable"),
        ({"parts": {"kidney": SURE, "tumor_1": {"found": False}}}, "missing"),
    ],
)
def test_where_no_bound_is_known_other_figures_decide(entries, kind):
    usual = {"fit_cost": COST, "parts": {"kidney": SURE, "tumor_1": SURE}}
    finding = finding_of(report_of(**{**usual, **entries}), {}, Sight())
    assert (finding and finding.kind) == kind


@pytest.mark.parametrize("over_mm", [-0.1, 0.4, 0.04, 0.004, 0.0004])
@pytest.mark.parametrize("part", ["tumor_1", "kidney"])
def test_a_bound_decides_and_what_is_over_the_limit_reads_as_over_it(part, over_mm):
    """Of an organ without tumors its own."""
    report = report_of(parts={"kidney": SURE, part: SURE})
    finding = finding_of(report, {part: ErrorBound(POOR_MM + over_mm)}, Sight())
    assert (finding is not None) == (over_mm > 0)
    if finding is not None:
        shown = [float(word.rstrip(".")) for word in finding.message.split() if word[0].isdigit()]
        assert finding.kind == "miss"
        assert shown[0] > shown[1]


@pytest.mark.parametrize(
    ("cost", "rim", "strictly", "kind"),
    [
        ({"without_outliers": 3.9, "outliers": 0.49}, 0.0, False, "fit"),
        ({"without_outliers": 3.9, "outliers": 0.49}, 1.0, False, None),  # a wrong place would show
        ({"without_outliers": 3.9, "outliers": 0.49}, 1.0, True, "fit"),
        ({"without_outliers": 4.1, "outliers": 0.49}, 1.0, False, "fit"),
        ({"without_outliers": 3.9, "outliers": 0.51}, 1.0, False, "outliers"),
    ],
)
def test_where_the_surroundings_are_seen_strays_are_no_part_of_the_fit(cost, rim, strictly, kind):
    report = report_of(fit_cost=COST | {"now": 99.0} | cost, parts={"kidney": SURE})
    finding = finding_of(report, {}, Sight(rim=rim), strictly=strictly)
    assert (finding and finding.kind) == kind


# --- what cameras see ---


@pytest.fixture(scope="module")
def sure(tracker, stages):
    """An estimate against which nothing speaks; no bound is known."""
    found = tracker.follow(stages[0].cloud)
    parts = {name: SURE for name in ANATOMY.names}
    exact = {"times": 1.0, "gain": 0.0}
    return reporting(found, fit_cost=COST, size=exact, parts=parts, motion=None, evidence=())


def image(organ: Mesh) -> DepthFrame:
    return render_depth(organ.vertices_mm, organ.faces, CAMERA)


def test_an_organ_that_the_camera_sees_through_is_refused(sure):
    organ = sure.meshes["kidney"]
    alone = image(organ)
    behind_mm = np.float32(np.nanmax(alone.depth_mm) + 30)
    table = alone.with_depth(np.fmin(alone.depth_mm, behind_mm))
    assert seen_through(organ, alone) == (0, 0, 1)
    assert seen_through(organ, table) == (0, 1, 1)
    rows = np.flatnonzero(np.isfinite(alone.depth_mm).any(1))
    area = np.cumsum(np.isfinite(alone.depth_mm[rows]).sum(1))
    holed = {}
    for share in (0.07, 0.3):
        depth_mm = table.depth_mm.copy()  # the table where the organ is said to be
        depth_mm[rows[: np.searchsorted(area, share * area[-1])]] = behind_mm
        holed[share] = table.with_depth(depth_mm)
        assert seen_through(organ, holed[share])[0] == pytest.approx(share, abs=0.02)
    before = judged(sure, looked(holed[0.07]))
    assert before.finding.kind == "seen_through"
    assert before.report.seen_through == pytest.approx(0.07, abs=0.02)
    with pytest.raises(NoEstimate):
        judged(sure, looked(holed[0.3]))
    hidden = table.depth_mm.copy()
    hidden[:, :200] = behind_mm - 90  # a hand before it hides it, and proves nothing
    by_hand = looked(table.with_depth(hidden))
    hides = np.isfinite(alone.depth_mm[:, :200]).sum() / np.isfinite(alone.depth_mm).sum()
    assert 0.1 < hides < 0.9
    assert seen_through(organ, by_hand[0].full_view)[::2] == (0, pytest.approx(1 - hides, abs=0.02))
    assert judged(sure, by_hand).quality == "good"
    still = judged(sure, by_hand, last=before)  # what showed it a moment ago is hidden
    assert still.finding.kind == "hidden_now"
    assert judged(sure, by_hand, last=still).finding.kind == "hidden_now"
    assert judged(sure, looked(table), last=still).quality == "good"
    aside = {
        name: mesh.with_vertices(mesh.vertices_mm + 12.0) for name, mesh in sure.meshes.items()
    }
    assert judged(sure, by_hand, last=replace(before, meshes=aside)).quality == "good"


@pytest.mark.parametrize("spacing", [1, 5, 40])
def test_a_cloud_tells_what_lies_behind_the_organ_and_what_it_does_not_show(sure, spacing):
    organ = sure.meshes["kidney"]
    points_mm = deproject(image(organ)).astype(float)[::spacing]

    def cloud(points):
        return SensorCloud(points.astype(np.float32))

    through, unseen = cloud_shares(organ, cloud(points_mm))
    assert through < 0.01
    assert unseen < 0.03
    ends = np.quantile(points_mm[:, 0], 0.4)
    half = points_mm[points_mm[:, 0] > ends]  # what is near a point is not called unseen
    assert 0.2 < cloud_shares(organ, cloud(half))[1] < 0.4
    assert judged(sure, looked(cloud(half))).finding.kind == "unseen"
    beyond = points_mm * np.where(points_mm[:, :1] > ends, 1.0, 1.4)  # a table shines through
    assert cloud_shares(organ, cloud(beyond))[0] == pytest.approx(0.4, abs=0.1)
    assert judged(sure, looked(cloud(beyond))).finding.kind == "seen_through"
    hand = np.concatenate([half, points_mm[points_mm[:, 0] <= ends] * 0.8])  # hides, proves nothing
    assert cloud_shares(organ, cloud(hand))[1] < 0.06
    close = organ.with_vertices(organ.vertices_mm - [0, 0, organ.vertices_mm[:, 2].mean()])
    assert cloud_shares(close, cloud(points_mm)) == (0.0, 1.0)  # round the camera


def test_what_fits_worse_all_of_a_sudden_is_poor(tracker, stages):
    """It may be another organ, put there; from a first view on, the same fit may be good."""
    points, rng = stages[0].cloud.points_mm, np.random.default_rng(8)
    clean = tracker.follow(stages[0].cloud)
    alone = image(clean.meshes["kidney"])
    table = alone.with_depth(np.fmin(alone.depth_mm, np.float32(np.nanmax(alone.depth_mm) + 30)))
    low, high = points.min(0), points.max(0)
    anywhere = low + (high - low) * rng.uniform(-0.1, 1.1, points.shape)
    outliers = np.where(rng.random((len(points), 1)) < 0.35, anywhere, points)
    first = tracker.follow(SensorCloud(outliers), full_view=table)
    cost = first.report.fit_cost
    assert cost.now > cost.usual
    kept = tracker.follow(SensorCloud(outliers, noise=PointNoise())).report.fit_cost
    assert 0.15 < kept.outliers < 0.35  # measured already: nothing is cleaned away
    assert kept.without_outliers < 0.3 * kept.now  # what lies within 2 mm still counts
    first, clean = (one.assessed(finding=None) for one in (first, clean))
    # The ellipsoid's half turn, and its bound, are another matter.
    sudden = tracker.follow(SensorCloud(outliers), clean, full_view=table)
    later = tracker.follow(SensorCloud(outliers), sudden, full_view=table)
    usual = tracker.follow(SensorCloud(outliers), first, full_view=table)
    kinds = [one.finding and one.finding.kind for one in (sudden, later, usual)]
    assert kinds[:2] == ["fit", "fit"]
    assert kinds[2] != "fit"


@pytest.mark.parametrize("known", [True, False])
def test_following_goes_on_to_say_that_another_place_fits_as_well(tracker, known):
    """The organ is an ellipsoid: end for end it fits as well, its tumor 40 mm away."""
    shape, half_turn = tracker.model.shape, np.diag([-1.0, 1.0, -1.0])

    def lies(frame: int, turn: np.ndarray) -> ElasticMotion:
        place_mm = PLACE_MM + [0.5 * frame, 0.0, 0.0]
        return ElasticMotion(shape, TURNED @ turn, place_mm, shape.body.mean)

    def cloud(frame: int) -> SensorCloud:
        organ = ANATOMY.organ.with_vertices(
            lies(frame, np.eye(3)).forward(ANATOMY.organ.vertices_mm)
        )
        points_mm = deproject(image(organ))[::5]
        return SensorCloud(points_mm.astype(np.float32), (frame + 1) * 33_000_000)

    follower = Follower(tracker, FollowerConfig(rescan_s=100.0))
    first = follower.locate(cloud(0))
    alternatives = ((lies(0, half_turn), 0.5),) if known else ()
    start = replace(lies(0, np.eye(3)), alternatives=alternatives)  # whatever the first view found
    follower.begin(replace(first, unsmoothed=start))
    for frame in (1, 2, 3):
        found = follower.locate(cloud(frame))
        others = found.report.fit_cost.others
        assert len(others) == known
        if known:
            assert found.quality == "poor"
            assert others[0].distance_mm["tumor_1"] == pytest.approx(40.0, abs=1.5)


def test_an_organ_that_looks_the_same_after_half_a_turn_is_in_doubt(slim_model, stages):
    """The ellipsoid: whichever way round it is found, the other one is found too."""
    model = load_model(slim_model, "cpu")
    trained = replace(model, provenance={**model.provenance, "validation_far": 0.0})
    for stage in stages[:4]:
        estimate = Tracker(trained).follow(stage.cloud)
        assert estimate.quality == "poor"
        away_mm = max(one.distance_mm["tumor_1"] for one in estimate.report.fit_cost.others)
        assert away_mm > 10  # of 16, 40 and 43 mm that the half-turns move it


# --- what contradicted an answer, until it is acknowledged ---

SURFACE_MM = small_estimate().organ_mesh.vertices_mm
FOOT_MM = SURFACE_MM[SURFACE_MM[:, 2].argmin()]  # nearest to the camera
FAR_MM = SURFACE_MM[SURFACE_MM[:, 2].argmax()]


def told(place_mm, name="touch", **more):
    return EvidenceReport(
        name=name, off_mm=22.0, information_gain=0.0, places_mm=(tuple(place_mm),), **more
    )


FALSE = told(FOOT_MM + [0, 0, 22.0], rejected=True)
THERE = told(FOOT_MM + [3.0, 0, 0], rejected=False)
ELSEWHERE = told(FAR_MM, rejected=False)
OLD = [told(FAR_MM, rejected=out, before=True) for out in (True, True, False)]
MOMENTARY = [told(FAR_MM, name, rejected=True) for name in ("grasp", "free_space")]


@pytest.mark.parametrize(
    ("frames", "kinds"),
    [
        ([[ELSEWHERE, THERE, THERE, THERE, FALSE], [], []], [True, True, True]),
        ([[FALSE], [THERE, THERE], []], [True, True, True]),
        ([[FALSE], [ELSEWHERE] * 40, []], [True, True, True]),
        ([[FALSE], [FALSE] * 3, []], [True, True, True]),  # they say the same: the answer is wrong
        ([[FALSE], [], [THERE] * 3], [True, True, False]),
        ([[FALSE], [], "acknowledged"], [True, True, False]),
        ([[ELSEWHERE, THERE], MOMENTARY, []], [False] * 3),
        ([OLD, []], [True, True]),  # most of the earlier ones no longer agree
        ([OLD[1:], []], [False, False]),
    ],
)
def test_it_holds_until_three_later_ones_there_agree(frames, kinds):
    disputes, found = Disputes(), []
    for pieces in frames:
        if pieces == "acknowledged":
            disputes.acknowledge()
            pieces = []
        finding = disputes.update(small_estimate().reporting(evidence=tuple(pieces)))
        found.append(finding is not None and finding.kind == "disputed")
    assert found == kinds


# --- what the model and the commands say ---


def test_a_model_that_was_mostly_wrong_says_so_in_every_estimate(slim_model, stages):
    model = load_model(slim_model, "cpu")
    bad = replace(model, provenance={**model.provenance, "validation_far": 0.4})
    found = Tracker(bad).follow(stages[0].cloud)
    assert (found.quality, found.finding.kind) == ("poor", "model")
    assert found.assessment.shown == {}
    assert reliability_warning({"validation_far": 0.1}) == reliability_warning({}) == ""
    assert reliability_warning({"half_turn_mm": 0.4})


def test_locate_says_its_verdict_and_plan_heeds_it(tmp_path, phantom_case, elastic_model):
    succeeded(tumortrack("simulate", phantom_case, tmp_path / "scenes", "--scenes", 1))
    run, cloud = tmp_path / "run", tmp_path / "scenes" / "0000" / "cloud.ply"
    done = tumortrack("locate", elastic_model, cloud, "--out", run, "--device", "cpu")
    said, quality = answered(done), store.read_json(run / "report.json")["quality"]
    assert done.returncode == {"good": 0, "poor": 4}[quality["verdict"]]
    assert said.startswith(f"{quality['verdict']}: ")
    assert f"<h1>{quality['verdict'].upper()}</h1>" in (run / "index.html").read_text()
    manifest = store.read_json(run / store.MANIFEST)
    hides = {"kind": "model", "values": {"message": "the organ hides"}}
    for verdict, finding in (("good", None), ("poor", hides)):
        report = store.read_json(run / "report.json")
        report["assessment"] |= {"finding": finding, "advice": ""}
        store.write_json(run / "report.json", report)
        manifest["files"]["report.json"] = store.sha256_of(run / "report.json")
        store.write_json(run / store.MANIFEST, manifest)
        out = tmp_path / f"plan-{verdict}"
        command = ("plan", run, out, "--no-arms")
        if verdict == "poor":
            line = refusal(tumortrack(*command))
            assert "the organ hides" in line
            assert "--accept-poor" in line
            assert not out.exists()
            command = (*command, "--accept-poor")
        said = succeeded(tumortrack(*command, "--accept-budget"))
        notes = store.read_json(out / "plan.json")["plan"]["notes"]
        assert ("the organ hides" in said) == (verdict == "poor")
        assert any("the organ hides" in note for note in notes) == (verdict == "poor")
