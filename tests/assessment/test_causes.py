"""What a poor answer, or none, is put down to: the phantom's clouds, each spoilt in one way."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from live_objects import small_estimate
from refused import refused
from tumortrack.assessment.causes import explained, likely_causes, words
from tumortrack.case.surface import surfaces
from tumortrack.core.assessment import Assessment
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import IDENTITY
from tumortrack.core.report import Cause, EvidenceReport, Likely
from tumortrack.core.types import Anatomy, PointNoise, SensorCloud, View
from tumortrack.io.run_folder import report_entry
from tumortrack.simulation.deform import DragConfig
from tumortrack.simulation.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.simulation.scene import SceneRecipe, Simulator
from tumortrack.tracking.follower import Follower, FollowerConfig
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker

BASE_MM, TILT = [450.0, -120.0, 260.0], Rotation.from_euler("xz", [165, 40], degrees=True)
SPOILT = {
    "mirrored": (Cause.MIRRORED, lambda points: points * [-1, 1, 1]),
    "y up": (Cause.MIRRORED, lambda points: points * [1, -1, 1]),
    "x and y swapped": (Cause.MIRRORED, lambda points: points[:, [1, 0, 2]]),
    "x and z swapped": (Cause.FRAME, lambda points: points[:, [2, 1, 0]]),
    "axes in a turn": (Cause.FRAME, lambda points: points[:, [1, 2, 0]]),
    "as OpenGL has it": (Cause.FRAME, lambda points: points * [1, -1, -1]),
    "a robot's": (Cause.FRAME, lambda points: TILT.apply(points) + BASE_MM),
    "inches": (Cause.UNIT, lambda points: points / 25.4),
    "1 mm steps read as 0.1": (Cause.UNIT, lambda points: points / 10),
    "0.1 mm steps read as 1": (Cause.UNIT, lambda points: points * 10),
    "doubled focal length": (Cause.SCALE, lambda points: points * [0.5, 0.5, 1]),
    "a fifth of it": (  # of a third of it the answer is right, and good
        Cause.HIDDEN,
        lambda points: points[points[:, 0] > np.quantile(points[:, 0], 0.8)],
    ),
    "a table": (Cause.OBJECT, lambda points: points * [1, 1, 0] + [0, 0, 150.0]),
    "a table behind": (
        Cause.BACKGROUND,
        lambda points: np.concatenate([points, 3 * points * [1, 1, 0] + [0, 0, 190.0]]),
    ),
}


@pytest.fixture(scope="module")
def tracker(elastic_model):
    return Tracker(load_model(elastic_model, "cpu"))


def seen(tracker: Tracker, anatomy: Anatomy, number: int) -> np.ndarray:
    """Points of an organ alone, as the model's scenes have it."""
    scene = tracker.model.config.scene
    alone = msgspec.structs.replace(
        scene,
        free_range=1.0,
        free_nearest_mm=(120.0, 180.0),
        deform=(DragConfig(steps=()),),
        occlusion=msgspec.structs.replace(scene.occlusion, scenes=0.0),
        clutter=msgspec.structs.replace(scene.clutter, scenes=0.0),
        calibration=type(scene.calibration)(),
        pose=msgspec.structs.replace(scene.pose, tilt_deg=10.0),
    )
    drawn = Simulator(anatomy, (0.0, -1.0, 0.0), alone).render(SceneRecipe(6, "test", number))
    return drawn.cloud.points_mm.astype(float)


@pytest.fixture(scope="module")
def points(tracker):
    return seen(tracker, tracker.anatomy_ct, 0)


def answer(tracker: Tracker, points: np.ndarray) -> tuple[str, str, tuple[Likely, ...]]:
    """Verdict, reason and causes."""
    try:
        found = tracker.locate(SensorCloud(points.astype(np.float32)), grid=16)
    except NoEstimate as refused:
        return "none", str(refused), refused.causes
    stored = json.loads(json.dumps(report_entry(found)["assessment"]))
    assert msgspec.convert(stored, Assessment) == found.assessment
    return found.quality, found.reason, found.causes


def test_a_right_cloud_is_good_and_has_no_cause_and_metres_are_refused_as_such(tracker, points):
    assert answer(tracker, points) == ("good", "", ())
    with refused(InputError, "1000"):
        answer(tracker, points / 1000)


@pytest.mark.parametrize("how", SPOILT)
def test_what_was_done_to_a_cloud_is_named_first(tracker, points, how):
    cause, spoil = SPOILT[how]
    verdict, reason, causes = answer(tracker, spoil(points))
    assert verdict != "good"
    assert causes[0].cause is cause
    if cause is not Cause.FRAME:  # of points behind the camera the error says it in other words
        assert words(causes[:1], "").split(";")[0] in reason
    if cause is Cause.UNIT:
        assert np.allclose(spoil(points) * causes[0].number, points)
    if cause is Cause.SCALE:
        assert causes[0].number == 2.0
    if cause is Cause.HIDDEN:
        assert 0.5 < causes[0].number < 0.85
    tried = [one.fit for one in causes if one.fit is not None]
    assert not tried or min(tried) < 1.0


@pytest.mark.parametrize("size_mm", [(80.0, 66.0, 95.0), (80.0, 70.0, 120.0)])
def test_another_patients_organ_is_named_as_such_unless_noise_is_large(tracker, size_mm):
    another = PhantomParameters(size_mm=size_mm, bend_mm=2.0, shape_seed=3, taper=0.3)
    anatomy, _ = surfaces(phantom_labels(another, voxel_mm=2.0))
    for number in range(2):
        places = seen(tracker, anatomy, number)
        verdict, reason, causes = answer(tracker, places)
        assert verdict != "good"
        assert causes[0].cause is Cause.ANOTHER_PATIENT
        assert words(causes[:1], "").split(";")[0] in reason
    cloud = SensorCloud(places.astype(np.float32), noise=PointNoise(1.6, 0.3, 0.01))
    causes = likely_causes(tracker.model, cloud, tracker.locate(cloud, grid=16))
    assert (causes[0].cause, causes[0].number) == (Cause.NOISE, 1.6)
    assert Cause.ANOTHER_PATIENT not in [one.cause for one in causes]


def test_causes_are_sought_once_a_second_at_most(tracker, points):
    follower, mirrored = Follower(tracker, FollowerConfig()), (points * [-1, 1, 1]).astype("f4")
    first = []
    for frame in range(8):  # 200 ms apart
        found = follower.locate(SensorCloud(mirrored, 10**9 + frame * 2 * 10**8))
        assert found.quality == "poor"
        assert found.causes[0].cause is Cause.MIRRORED
        if not any(found.causes[0] is one for one in first):  # the same one: not searched again
            first.append(found.causes[0])
    assert 2 <= len(first) <= 4  # for each check that fails; it may change


# --- what was found before, and evidence ---

FOUND_BEFORE = Likely(Cause.HIDDEN, 0.43)


def explained_causes(model, evidence=(), alone=False, in_sight=None, known=(FOUND_BEFORE,)):
    """Of an estimate that fails another check, with causes of a frame before; and the advice."""
    estimate = small_estimate().reporting(evidence=evidence, in_sight=in_sight)
    points = SensorCloud(estimate.organ_mesh.vertices_mm)
    seen = SensorCloud(np.zeros((0, 3), np.float32)) if alone else points
    causes, advice = explained(model, (View(points, seen, IDENTITY),), estimate, {"other": known})
    return [(one.cause, one.number) for one in causes], advice


def piece(off_mm, rejected=True):
    return EvidenceReport(name="touch", off_mm=off_mm, information_gain=1.0, rejected=rejected)


HIDDEN, VIEW = (Cause.HIDDEN, 0.43), (Cause.VIEW, None)


@pytest.mark.parametrize(
    ("given", "causes"),
    [
        ({"evidence": (piece(1.0, False), piece(9.0), piece(331.0), piece(20.0))},
         [(Cause.EVIDENCE, 3), HIDDEN]),  # the piece that lies the farthest off
        ({"evidence": (piece(1.0, False),)}, [HIDDEN]),
        ({"known": (Likely(Cause.EVIDENCE, 3), FOUND_BEFORE)}, [HIDDEN]),  # of that frame alone
        ({"alone": True}, [VIEW]),  # touches hide nothing
        ({"in_sight": 0.97}, [VIEW]),  # nor does anything else here
        ({"in_sight": 0.6}, [HIDDEN]),
    ],
)  # fmt: skip
def test_what_evidence_and_frames_before_tell_comes_first(tracker, given, causes):
    found, advice = explained_causes(tracker.model, **given)
    assert found == causes
    assert advice
    assert ("view" not in advice and "look" not in advice) == (
        "alone" in given or causes[0][0] is Cause.EVIDENCE
    )
