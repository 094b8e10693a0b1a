"""The same judgement of files and live frames: what makes an estimate poor, and what refuses it."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from elastic_objects import UP
from reports import looked, reporting
from stories import answered, refusal, succeeded, tumortrack
from tumortrack.assessment import bound
from tumortrack.assessment.verdict import cloud_shares, doubt_if_hidden, judged, seen_through
from tumortrack.core import store
from tumortrack.core.errors import NoEstimate
from tumortrack.core.types import DepthFrame, Mesh, PointNoise, SensorCloud
from tumortrack.models.folder import weakness_of
from tumortrack.registration.motion import ElasticMotion
from tumortrack.sense.camera import d405
from tumortrack.sense.render import render_depth
from tumortrack.simulate.scene import SceneRecipe, Simulator, body_for
from tumortrack.tracking.files import report_entry
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Follower, FollowerConfig, Tracker
from warp_objects import ANATOMY, PLACE_MM, TURNED, slim_clinic

COST = {"now": 1.0, "without_strays": 1.0, "usual": 2.0, "strays": 0.0}
EXACT = {"times": 1.0, "gain": 0.0}


@pytest.fixture(autouse=True)
def misses_unknown(monkeypatch):
    """An ellipsoid may slip far along itself; that is not what is tested here."""
    monkeypatch.setattr(bound, "figures", lambda *_: None)


@pytest.fixture(scope="module")
def tracker(slim_model):
    return Tracker(load_model(slim_model, "cpu"))


@pytest.fixture(scope="module")
def stages():
    config = slim_clinic().scene
    simulator = Simulator(ANATOMY, UP, config, body_for(ANATOMY, UP, config, 77))
    return [simulator.render(SceneRecipe(5, "test", index)) for index in range(4)]


def doubted(estimate, seen, **report):
    """A judgement in which only what is given speaks against the estimate."""
    sure = {"fit_cost": COST, "size": EXACT, "parts": sure_parts(estimate), **report}
    found = judged(reporting(estimate, **sure), looked(seen))
    said = report_entry(found)["quality"]
    assert (said["verdict"], said["reason"]) == (found.quality, found.reason)
    assert bool(said["check"]) == (found.quality == "poor")
    return found


def sure_parts(estimate):
    parts = msgspec.to_builtins(estimate.report.parts)
    return {n: {**part, "probability": 0.9, "center_std_mm": 1.0} for n, part in parts.items()}


def seen_side(organ: Mesh, spacing: int = 1) -> np.ndarray:
    """Points (n, 3) of the organ's side before the camera."""
    camera = d405(424, 240)
    depth_mm = render_depth(organ.vertices_mm, organ.faces, camera).depth_mm
    rows, columns = np.nonzero(np.isfinite(depth_mm))
    z_mm = depth_mm[rows, columns].astype(float)
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.column_stack([x * z_mm, y * z_mm, z_mm])[::spacing]


def test_a_worse_fit_is_flagged(tracker, stages):
    cloud = stages[0].cloud
    estimate = tracker.follow(cloud)
    good = doubted(estimate, cloud)
    assert (good.quality, good.reason) == ("good", "")
    worse = doubted(estimate, cloud, fit_cost=COST | {"now": 2.1})
    assert worse.quality == "poor"
    assert "worse than in most" in worse.reason
    parts = sure_parts(good)
    parts["tumor_1"]["center_std_mm"] = 3.4
    assert "tumor_1 is unsure by 3.4 mm" in doubted(estimate, cloud, parts=parts).reason
    for gain, verdict in ((9.1, "good"), (9.3, "poor")):
        scaled = doubted(estimate, cloud, size={"times": 1.07, "gain": gain})
        assert scaled.quality == verdict
    assert "1.07 times as large" in scaled.reason
    for apart_mm, verdict in ((2.9, "good"), (5.2, "poor")):
        others = [{"more": 1.0, "apart_mm": {"kidney": 0.4, "tumor_1": apart_mm}}]
        rival = doubted(estimate, cloud, fit_cost=COST | {"others": others})
        assert rival.quality == verdict
    assert "tumor_1 may as well lie 5.2 mm away" in rival.reason
    beyond = {"less": 0.1, "tilt_degrees": 172.0}
    over = doubted(estimate, cloud, fit_cost=COST | {"beyond": beyond})
    assert over.quality == "poor"
    assert "may lie upside down: it fits the points as well tilted by 172 degrees" in over.reason


def test_strays_are_no_part_of_the_fit_that_is_judged(tracker, stages):
    points, rng = stages[0].cloud.points_mm, np.random.default_rng(8)
    clean = tracker.follow(stages[0].cloud)
    low, high = points.min(0), points.max(0)
    anywhere = low + (high - low) * rng.uniform(-0.1, 1.1, points.shape)
    strays = np.where(rng.random((len(points), 1)) < 0.35, anywhere, points)
    spoiled = SensorCloud(strays, noise=PointNoise())  # measured already: nothing is cleaned away
    found = tracker.follow(spoiled)
    away = found.motion.centre_mm - clean.motion.centre_mm  # an ellipsoid may lie both ways round
    assert np.linalg.norm(away) < 2
    cost, before = (one.report.fit_cost for one in (found, clean))
    assert 0.15 < cost.strays < 0.35  # the others lie near the surface
    assert cost.now > before.now + 0.8 * 300 * cost.strays
    assert cost.without_strays < 0.3 * cost.now  # what lies within 2 mm still counts


def test_what_fits_worse_all_of_a_sudden_is_poor(tracker, stages):
    """It may be another organ, put there; from a first look on, the same fit may be good."""
    points, rng = stages[0].cloud.points_mm, np.random.default_rng(8)
    clean = tracker.follow(stages[0].cloud)
    camera = d405(424, 240)
    alone = render_depth(clean.meshes["kidney"].vertices_mm, clean.meshes["kidney"].faces, camera)
    table = DepthFrame(np.fmin(alone.depth_mm, np.float32(np.nanmax(alone.depth_mm) + 30)), camera)
    low, high = points.min(0), points.max(0)
    anywhere = low + (high - low) * rng.uniform(-0.1, 1.1, points.shape)
    spoiled = SensorCloud(np.where(rng.random((len(points), 1)) < 0.35, anywhere, points))
    first = tracker.follow(spoiled, seen=table)
    cost = first.report.fit_cost
    assert cost.now > cost.usual
    worse = "worse than in most"
    assert worse not in first.reason  # the ellipsoid's half turn is another matter
    first, clean = (one.assessed(finding=None) for one in (first, clean))
    assert worse not in tracker.follow(spoiled, first, seen=table).reason
    sudden = tracker.follow(spoiled, clean, seen=table)
    assert worse in sudden.reason
    assert worse in tracker.follow(spoiled, sudden, seen=table).reason


@pytest.mark.parametrize("known", [True, False])
def test_following_goes_on_to_say_that_another_place_fits_as_well(tracker, known, monkeypatch):
    """The organ is an ellipsoid: end for end it fits as well, its tumor 40 mm away."""
    shape, half_turn = tracker.model.shape, np.diag([-1.0, 1.0, -1.0])

    def lies(frame: int, turn: np.ndarray) -> ElasticMotion:
        place_mm = PLACE_MM + [0.5 * frame, 0.0, 0.0]
        return ElasticMotion(shape, TURNED @ turn, place_mm, shape.body.mean)

    follower, found = Follower(tracker, FollowerConfig(rescan_s=100.0)), []
    for frame in range(4):
        organ = ANATOMY.organ.moved(lies(frame, np.eye(3)).carry(ANATOMY.organ.vertices_mm))
        points_mm = seen_side(organ, 5).astype(np.float32)
        found.append(follower.locate(SensorCloud(points_mm, (frame + 1) * 33_000_000)))
        if frame == 0:  # whatever the first look found
            rivals = ((lies(0, half_turn), 0.5),) if known else ()
            start = replace(lies(0, np.eye(3)), rivals=rivals)
            monkeypatch.setattr(follower, "_last", replace(found[0], unsmoothed=start))
    for one in found[1:]:
        others = one.report.fit_cost.others
        assert len(others) == known
        assert ("tumor_1 may as well lie" in one.reason) == known
        if known:
            assert one.quality == "poor"
            assert others[0].apart_mm["tumor_1"] == pytest.approx(40.0, abs=1.5)


def test_an_organ_that_the_camera_sees_through_is_refused(tracker, stages):
    estimate = tracker.follow(stages[0].cloud)
    camera = d405(424, 240)
    organ = estimate.meshes["kidney"]
    alone = render_depth(organ.vertices_mm, organ.faces, camera)
    behind_mm = np.float32(np.nanmax(alone.depth_mm) + 30)
    table = DepthFrame(np.fmin(alone.depth_mm, behind_mm), camera)
    assert seen_through(organ, alone) == (0, 0, 1)
    assert seen_through(organ, table) == (0, 1, 1)
    costly = COST | {"now": 99.0, "without_strays": 3.9, "strays": 0.49}
    assert doubted(estimate, alone, fit_cost=costly).quality == "poor"
    assert doubted(estimate, table, fit_cost=costly).quality == "good"  # a wrong place would show
    assert doubted(estimate, table, fit_cost=costly | {"without_strays": 4.1}).quality == "poor"
    many = doubted(estimate, table, fit_cost=costly | {"strays": 0.51})
    assert "51 % of the points do not lie" in many.reason
    rows = np.flatnonzero(np.isfinite(alone.depth_mm).any(1))
    for share, expected in ((0.07, "poor"), (0.3, "none")):
        area = np.cumsum(np.isfinite(alone.depth_mm[rows]).sum(1))
        few = rows[: np.searchsorted(area, share * area[-1])]
        depth_mm = table.depth_mm.copy()
        depth_mm[few] = behind_mm  # the table where the organ is said to be
        holed = DepthFrame(depth_mm, camera)
        assert seen_through(organ, holed)[0] == pytest.approx(share, abs=0.02)
        if expected == "poor":
            found = doubted(estimate, holed)
            assert found.quality == "poor"
            assert found.report.seen_through == pytest.approx(share, abs=0.02)
        else:
            with pytest.raises(NoEstimate, match="sees through 3"):
                doubted(estimate, holed)
    hidden = table.depth_mm.copy()
    hidden[:, :200] = behind_mm - 90  # a hand before it hides it, and proves nothing
    by_hand = DepthFrame(hidden, camera)
    hides = np.isfinite(alone.depth_mm[:, :200]).sum() / np.isfinite(alone.depth_mm).sum()
    assert 0.1 < hides < 0.9
    assert seen_through(organ, by_hand)[::2] == (0, pytest.approx(1 - hides, abs=0.02))
    depth_mm = table.depth_mm.copy()
    depth_mm[rows[: len(rows) // 8]] = behind_mm
    before = doubted(estimate, DepthFrame(depth_mm, camera))
    covered, free = doubted(estimate, by_hand), doubted(estimate, table)
    assert (before.quality, covered.quality) == ("poor", "good")
    still = doubt_if_hidden(covered, before)
    assert still.quality == "poor"
    assert "what showed that is hidden" in still.reason
    assert doubt_if_hidden(doubted(estimate, by_hand), still).quality == "poor"
    assert doubt_if_hidden(free, still).quality == "good"
    aside = {name: mesh.moved(mesh.vertices_mm + 12.0) for name, mesh in estimate.meshes.items()}
    elsewhere = replace(before, meshes=aside)
    assert doubt_if_hidden(doubted(estimate, by_hand), elsewhere).quality == "good"


@pytest.mark.parametrize("spacing", [1, 5, 40])
def test_a_cloud_tells_what_lies_behind_the_organ_and_what_it_does_not_show(
    tracker, stages, spacing
):
    estimate = tracker.follow(stages[0].cloud)
    organ = estimate.meshes["kidney"]
    points_mm = seen_side(organ, spacing)

    def shares(points):
        return cloud_shares(organ, SensorCloud(points.astype(np.float32)))

    through, unseen = shares(points_mm)
    assert through < 0.01
    assert unseen < 0.03
    ends = np.quantile(points_mm[:, 0], 0.4)
    half = points_mm[points_mm[:, 0] > ends]  # what is near a point is not called unseen
    assert 0.2 < shares(half)[1] < 0.4
    assert doubted(estimate, SensorCloud(half.astype(np.float32))).quality == "poor"
    beyond = points_mm * np.where(points_mm[:, :1] > ends, 1.0, 1.4)  # a table shines through
    assert shares(beyond)[0] == pytest.approx(0.4, abs=0.1)
    found = doubted(estimate, SensorCloud(beyond.astype(np.float32)))
    assert found.quality == "poor"
    assert "sees through" in found.reason
    hand = np.concatenate([half, points_mm[points_mm[:, 0] <= ends] * 0.8])  # hides, proves nothing
    assert shares(hand)[1] < 0.06


def test_an_organ_round_the_camera_is_not_seen(tracker, stages):
    organ = tracker.follow(stages[0].cloud).meshes["kidney"]
    close = organ.moved(organ.vertices_mm - [0, 0, organ.vertices_mm[:, 2].mean()])
    assert cloud_shares(close, stages[0].cloud) == (0.0, 1.0)


def test_an_organ_that_looks_the_same_after_half_a_turn_is_in_doubt(slim_model, stages):
    """The ellipsoid: whichever way round it is found, the other one is found too."""
    model = load_model(slim_model, "cpu")
    trained = replace(model, provenance={**model.provenance, "validation_far": 0.0})
    for stage in stages:
        estimate = Tracker(trained).follow(stage.cloud)
        assert estimate.quality == "poor"
        doubt, _, advice = estimate.reason.partition("; ")
        if "may as well" in doubt:
            assert "tumor_1 may as well lie" in doubt
            assert "look" in advice
        away_mm = max(one.apart_mm["tumor_1"] for one in estimate.report.fit_cost.others)
        assert away_mm > 10  # of 16, 40 and 43 mm that the half-turns move it


def test_a_model_that_was_mostly_wrong_says_so_in_every_estimate(slim_model, stages):
    model = load_model(slim_model, "cpu")
    bad = replace(model, provenance={**model.provenance, "validation_far": 0.4})
    found = Tracker(bad).follow(stages[0].cloud)
    assert found.quality == "poor"
    assert "40 % of the simulated scenes on which this model was checked" in found.reason
    assert found.finding.kind == "model"
    assert found.assessment.shown == {}
    assert weakness_of({"validation_far": 0.1}) == weakness_of({}) == ""
    assert "without a network" in weakness_of({"half_turn_mm": 0.4})


def test_train_and_inspect_say_what_speaks_against_a_model(phantom_case, clinic_model):
    weakness = weakness_of(store.read_json(clinic_model / store.MANIFEST)["provenance"])
    assert "validation_far" in store.read_json(clinic_model / store.MANIFEST)["provenance"]
    said = succeeded(tumortrack("inspect", clinic_model))
    assert ("on which this model was checked" in said) == bool(weakness)


def test_locate_says_its_verdict_and_plan_heeds_it(tmp_path, phantom_case, clinic_model):
    succeeded(tumortrack("simulate", phantom_case, tmp_path / "scenes", "--scenes", 1))
    run, cloud = tmp_path / "run", tmp_path / "scenes" / "0000" / "cloud.ply"
    done = tumortrack("locate", clinic_model, cloud, run, "--device", "cpu")
    said, quality = answered(done), store.read_json(run / "report.json")["quality"]
    assert done.returncode == {"good": 0, "poor": 4}[quality["verdict"]]
    assert said.startswith(f"{quality['verdict']}: ")
    assert ("no check failed; its place is not verified" in said) == (quality["verdict"] == "good")
    page = (run / "index.html").read_text()
    assert f"<h1>{quality['verdict'].upper()}</h1>" in page
    manifest = store.read_json(run / store.MANIFEST)
    hides = {"kind": "model", "values": {"words": "the organ hides"}}
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
            assert "the estimate is poor: the organ hides" in line
            assert "--accept-poor" in line
            assert not out.exists()
            command = (*command, "--accept-poor")
        said = succeeded(tumortrack(*command, "--accept-budget"))
        notes = store.read_json(out / "plan.json")["plan"]["notes"]
        assert ("PLANNED ON A POOR ESTIMATE: the organ hides" in said) == (verdict == "poor")
        assert any("POOR ESTIMATE" in note for note in notes) == (verdict == "poor")
