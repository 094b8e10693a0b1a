"""What an estimate advises: what to learn next of a part; towards the side that is not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from refused import refused
from report_objects import ball
from reports import looked, report_of
from tumortrack.assessment.advice import Advisor, advise
from tumortrack.assessment.causes import where_to_look
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import OccupancyCloud, SensorCloud, View
from tumortrack.registration.motion import ElasticMotion
from warp_objects import ANATOMY, shape

CENTRE = np.array([20.0, -10.0, 180.0])
SIDES = {
    "the left (the camera's -x)": (-1, 0),
    "the right (the camera's +x)": (1, 0),
    "the top (the camera's -y)": (0, -1),
    "the bottom right (the camera's +y, +x)": (0.7, 0.7),
}


ORGAN = ball(40.0, CENTRE, 4)


def estimate(axis, tumor_mm=(0.0, 0.0, 0.0), motion=None) -> Estimate:
    """Of a ball with a tumor that lies so far from its middle, least sure along this axis."""
    axes = np.linalg.qr(np.column_stack([axis, [0.3, 0.2, 0.9], [0.5, -0.8, 0.1]]))[0].T
    tumor = {"center_axes": axes.tolist(), "center_axes_std_mm": [4.0, 1.0, 1.0]}
    inside = OccupancyCloud(CENTRE[None], np.ones(1), np.ones(1))
    meshes = {"kidney": ORGAN, "tumor_1": ball(8.0, CENTRE + tumor_mm, 4)}
    return Estimate(inside, None, meshes, report_of(parts={"kidney": {}, "tumor_1": tumor}), motion)


def seen(towards=None) -> SensorCloud:
    """All points of the ball's near side, or all but those on one side of the picture."""
    off = ORGAN.vertices_mm - CENTRE
    near = (off * ORGAN.vertices_mm).sum(1) < 0
    if towards is not None:
        near &= off[:, :2] @ np.array(towards) < 10
    return SensorCloud(ORGAN.vertices_mm[near])


@pytest.mark.parametrize(("words", "side"), SIDES.items())
def test_a_hidden_side_is_named(words, side):
    said = where_to_look(estimate([0, 0, 1]), looked(seen(towards=side)))
    assert said == f"free the view of the organ's side towards {words}, or look from there"
    open_side = where_to_look(estimate(CENTRE), looked(seen()))
    assert open_side == "look more from another side, by about 30 degrees"


def test_what_another_camera_saw_is_not_hidden():
    side = SIDES[towards := "the left (the camera's -x)"]
    first, rest = seen(towards=side), SensorCloud(ORGAN.vertices_mm)
    aside = rigid(np.diag([-1.0, 1, -1]), np.array([90.0, 0, 200]))
    there = SensorCloud(transform_points(np.linalg.inv(aside), rest.points_mm.astype(float)))
    unsure = estimate([side[0], side[1], 0], (12 * side[0], 12 * side[1], 0))
    assert towards in where_to_look(unsure, looked(first))
    said = where_to_look(unsure, [*looked(first), View(there, there, aside)])
    assert said == "look more from another side, by about 30 degrees"


def unsure_along(axis, motion):
    """Of shift along an axis of the camera alone."""
    covariance = 1e-4 * np.eye(6 + len(motion.coefficients))
    along = motion.rotation.T @ axis
    covariance[:3, :3] += 9.0 * np.outer(along, along)
    return replace(motion, covariance=covariance)


LYING = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # the organ's long axis, the CT's z, across


@pytest.mark.parametrize("words", ["left", "right", "top"])
def test_a_look_along_the_least_sure_axis_tells_most(words):
    side = np.array([*SIDES[next(name for name in SIDES if f"the {words} (" in name)], 0.0])
    fit = ElasticMotion(shape(), LYING, CENTRE, shape().body.mean)
    views = list(Advisor(unsure_along(side, fit), 1).views())
    best = min(views, key=lambda view: view.then_std_mm)
    assert abs(np.array(best.direction) @ side) > 0.45  # 30 degrees from the line of sight
    assert best.std_mm == pytest.approx(3.0, rel=0.01)
    assert best.then_std_mm < 1.2
    found = estimate([0, 0, 1], motion=unsure_along(side, fit))
    vertices = fit.forward(ANATOMY.organ.vertices_mm)
    found.meshes["kidney"] = ANATOMY.organ.with_vertices(vertices)
    other = {"left": "right", "right": "left", "top": "bottom"}[words]
    said = where_to_look(found, looked(SensorCloud(vertices)))
    assert any(f"look more from the {side} (" in said for side in (words, other))


def test_a_touch_where_another_fit_differs_tells_most():
    """A long organ across the picture; the other fit has it turned about its right end."""
    mean, end_mm = shape().body.mean, CENTRE + [48.0, 0, 0]
    turn = Rotation.from_euler("z", 25, degrees=True).as_matrix()
    other = ElasticMotion(shape(), turn @ LYING, end_mm + turn @ (CENTRE - end_mm), mean)
    fit = ElasticMotion(shape(), LYING, CENTRE, mean, alternatives=((other, 0.4),))
    fit = replace(unsure_along(np.array([1.0, 0, 0]), fit), alternatives=fit.alternatives)
    best = Advisor(fit, 1).touches(1)[0]
    assert best.place_mm[0] < CENTRE[0] - 20  # towards the left end
    assert best.then_std_mm < 0.6 * best.std_mm


def test_advice_is_for_the_part_asked_for_and_for_touches_within_reach():
    fit = ElasticMotion(shape(), LYING, CENTRE, shape().body.mean)
    found = estimate([0, 0, 1], motion=unsure_along(np.array([1.0, 0, 0]), fit))
    anywhere, of_organ = advise(found, "tumor_1"), advise(found, "kidney")
    assert {each.part for each in anywhere} == {"tumor_1"}
    assert {each.part for each in of_organ} == {"kidney"}
    kinds = [each.kind for each in anywhere]
    assert kinds == ["touch", "touch", "touch", "outline", "view"]
    asked, first = [], anywhere[0]

    def reach(place_mm, normal):
        assert np.linalg.norm(normal) == pytest.approx(1)
        asked.append(place_mm)
        return (place_mm[0] - CENTRE[0]) * (first.place_mm[0] - CENTRE[0]) < 0

    other_side = advise(found, "tumor_1", reach)
    assert asked[0] == pytest.approx(first.place_mm)  # the best of all is asked for first
    sides = [each.place_mm[0] < CENTRE[0] for each in (first, *other_side[:3])]
    assert sides == [sides[0], *[not sides[0]] * 3]
    assert other_side[0].then_std_mm >= first.then_std_mm
    assert [each.kind for each in advise(found, "tumor_1", lambda *_: False)] == kinds[3:]
    with refused(InputError, "cyst"):
        advise(found, "cyst")
    with pytest.raises(InputError):  # no motion is known
        advise(estimate([0, 0, 1]), "tumor_1")
