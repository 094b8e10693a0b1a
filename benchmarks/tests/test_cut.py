"""A plan cuts the true anatomy: volumes, margins and wounds of bodies that can be reckoned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, Mesh
from tumortrack_benchmarks.physics.cut import CutResult, Swept, cut, electrode_margin_mm, swept_by
from tumortrack_resection.values import Cut, ResectionPlan

ML = 1e-3
RADIUS_MM, KERF_MM = 1.2, 2.4
BALL_ML = 4 / 3 * np.pi * ML
HALF_MM = np.array([30.0, 20.0, 15.0])  # of the box, whose middle is the origin
X, Y, Z = np.eye(3)


def ball(radius_mm, center_mm) -> Mesh:
    solid = trimesh.creation.icosphere(4, radius_mm)
    return Mesh(solid.vertices + np.array(center_mm, float), solid.faces)


def block(low, high) -> Mesh:
    solid = trimesh.creation.box(bounds=[low, high])
    return Mesh(solid.vertices, solid.faces)


def boxed(*tumors: Mesh) -> Anatomy:
    return Anatomy((block(-HALF_MM, HALF_MM), *tumors))


def transformed(truth: Anatomy, turn: np.ndarray) -> Anatomy:
    return Anatomy(tuple(part.with_vertices(part.vertices_mm @ turn.T) for part in truth.parts))


def plan(*cuts: Cut, grasp_mm=(0.0, 0.0, 15.0), tumor="tumor_1") -> ResectionPlan:
    """What a plan promises is not used."""
    grasp = np.array(grasp_mm, float)
    return ResectionPlan(
        method="margin", tumor=tumor, label=2, grasp_mm=grasp, cuts=cuts, piece=ball(1, grasp),
        taken=(tumor,), keep_mm={}, facets=np.zeros((0, 4)), lift=Z, margin_mm=5.0, volumes_ml={},
        exophytic=0.5,
    )  # fmt: skip


def straight(start, end, axis=-Z, sweep=1) -> Cut:
    """Of the tip; from the pencil to the tip the electrode points along ``axis``."""
    axis = np.asarray(axis, float)
    return Cut(sweep, np.array([start, end], float), axis / np.linalg.norm(axis))


def across(x_mm, tip_mm=-25.0) -> Cut:
    """A plane across the box at x, the electrode upright, its tip below the box or in it."""
    return straight((x_mm, -30, tip_mm), (x_mm, 30, tip_mm))


def turned(one: Cut, turn: np.ndarray) -> Cut:
    assert one.axis is not None
    return replace(one, path_mm=one.path_mm @ turn.T, axis=turn @ one.axis)


def parts_ml(result: CutResult) -> float:
    """Of the tumor."""
    return result.tumor_ml * (result.removed_share + result.cut_share + result.left_share)


@pytest.mark.parametrize("angle_rad", [0.0, 0.3, 0.8])
def test_one_plane_cuts_off_an_end_with_a_kerf_of_twice_the_radius(angle_rad):
    """At x = 10 of a box of 60 x 40 x 30, whose section is 1200 mm2; about any angle."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    truth = transformed(boxed(ball(6, (20, 0, 3))), turn)
    result = cut(truth, plan(turned(across(10), turn), grasp_mm=turn @ [20, 0, 15]))
    assert result.detached
    assert result.tumor_ml == pytest.approx(BALL_ML * 6**3, rel=0.01)
    assert (result.removed_share, result.cut_share, result.left_ml) == (1.0, 0.0, 0.0)
    assert result.piece_ml == pytest.approx((20 - 1.2) * 1200 * ML, rel=0.01)
    assert result.kerf_ml == pytest.approx(1200 * KERF_MM * ML, rel=0.02)
    assert result.healthy_ml == pytest.approx(result.piece_ml - result.tumor_ml + result.kerf_ml)
    assert result.kerf_area_mm2 == pytest.approx(1200, rel=0.03)
    assert result.margin_mm == pytest.approx(20 - 10 - 6 - RADIUS_MM, abs=0.03)
    assert result.hurt == ()


@pytest.mark.parametrize(
    ("axis_mm", "margin_mm"),
    [(5.0, 3.8), (1.3, 0.1), (1.0, 0.0), (0.2, 0.0), (-0.2, -0.2), (-5, -5)],
)
def test_the_margin_is_that_of_the_electrodes_surface_and_in_the_tumor_that_of_its_axis(
    axis_mm, margin_mm
):
    """A ball of 8 mm, so far from a plane in which the electrode's axis lies."""
    result = cut(boxed(ball(8, (8 + axis_mm, 0, 2))), plan(across(0)))
    assert result.margin_mm == pytest.approx(margin_mm, abs=0.03)
    assert (result.cut_share > 0) == (axis_mm < RADIUS_MM)


@pytest.mark.parametrize("seed", range(6))
def test_the_margin_of_electrodes_anywhere_is_that_reckoned_for_a_ball(seed):
    """Near, far and through it; the last three seeds have one in the tumor."""
    rng = np.random.default_rng(seed)
    tips, away = rng.normal(0, 60, (40, 3)), rng.normal(0, 1, (40, 3))
    ends = np.stack([tips, tips + 70 * away / np.linalg.norm(away, axis=1)[:, None]], axis=1)
    if seed > 2:
        ends[7] = [rng.normal(0, 2, 3), [0, 0, 70]]
    way = ends[:, 1] - ends[:, 0]
    share = np.clip(-(ends[:, 0] * way).sum(1) / (way**2).sum(1), 0, 1)
    off_mm = np.linalg.norm(ends[:, 0] + share[:, None] * way, axis=1).min() - 8
    expected_mm = off_mm if off_mm < 0 else max(0.0, off_mm - RADIUS_MM)
    assert electrode_margin_mm(ball(8, (0, 0, 0)), Swept(ends)) == pytest.approx(
        expected_mm, abs=0.05
    )


def test_an_electrode_whose_length_goes_through_the_tumor_cuts_it_though_its_tip_keeps_clear():
    """The tip goes along a line 6 mm below the ball, the electrode upright through its middle."""
    truth = boxed(ball(8, (0, 0, 3)))
    below = straight((0, -30, -11), (0, 30, -11))
    tips = Swept(np.repeat(below.path_mm[:, None], 2, axis=1))
    assert electrode_margin_mm(truth.tumors[0], tips) > 6
    result = cut(truth, plan(below))
    assert result.margin_mm == pytest.approx(-8, abs=0.05)
    slab = np.pi * (8**2 * KERF_MM - 2 * RADIUS_MM**3 / 3)  # of a ball's middle
    assert result.cut_share == pytest.approx(slab * ML / result.tumor_ml, rel=0.04)
    assert not result.detached
    assert result.left_share == pytest.approx(1 - result.cut_share)
    assert parts_ml(result) == pytest.approx(result.tumor_ml)
    level = straight((0, -30, -11), (0, 30, -11), axis=X)  # the same tips, the electrode beside it
    beside = cut(truth, plan(level))
    assert beside.cut_share == 0
    assert beside.margin_mm == pytest.approx(3 + 11 - 8 - RADIUS_MM, abs=0.05)


def test_a_tumor_cut_in_two_comes_away_in_part():
    """A plane 2 mm beside the middle of a ball of 8 mm in the end that comes away."""
    truth = boxed(ball(8, (12, 0, 0)))
    result = cut(truth, plan(across(10), grasp_mm=(25, 0, 15)))
    left = np.pi * (8 - 3.2) ** 2 * (3 * 8 - 4.8) / 3 * ML
    cap = np.pi * (8 - 0.8) ** 2 * (3 * 8 - 7.2) / 3 * ML
    removed = result.tumor_ml - cap
    assert result.detached
    assert result.left_ml == pytest.approx(left, rel=0.03)
    assert result.removed_share == pytest.approx(removed / result.tumor_ml, rel=0.02)
    assert result.cut_share * result.tumor_ml == pytest.approx(cap - left, rel=0.04)
    assert parts_ml(result) == pytest.approx(result.tumor_ml)
    assert result.margin_mm == pytest.approx(-6, abs=0.05)


@pytest.mark.parametrize(("tip_mm", "detached"), [(-12.0, False), (-13.7, True), (-25.0, True)])
def test_a_cut_that_stops_short_leaves_a_bridge(tip_mm, detached):
    """The tip's end reaches 1.2 mm deeper; 0.1 mm of tissue below it tears, 1.8 mm holds."""
    result = cut(boxed(ball(6, (20, 0, 3))), plan(across(10, tip_mm), grasp_mm=(20, 0, 15)))
    assert result.detached == detached
    assert result.removed_share == float(detached)
    assert (result.piece_ml > 0) == detached
    lost = result.piece_ml - result.tumor_ml * detached + result.kerf_ml
    assert result.healthy_ml == pytest.approx(lost, abs=0.05)
    if not detached:
        assert result.left_ml == result.tumor_ml
        # Both walls and the bottom of the trench, whose end is round.
        wall, section = 15 + 12, 40 * (np.pi * RADIUS_MM)
        assert result.kerf_area_mm2 == pytest.approx(2 * 40 * wall + section, rel=0.03)
        trench = 40 * (wall * KERF_MM + np.pi * RADIUS_MM**2 / 2) * ML
        assert result.kerf_ml == pytest.approx(trench, rel=0.02)


def wedge(z_mm=-6.0, beyond_mm=1.5) -> tuple[Cut, Cut]:
    """Two planes along y, which open upwards by 45 degrees each and meet at this height; the tips
    reach so far beyond their edge."""
    cuts = []
    for sweep, side in ((1, 1.0), (2, -1.0)):
        back = np.array([side, 0, 1]) / np.sqrt(2)
        tip = np.array([0, 0, z_mm]) - beyond_mm * back
        cuts.append(straight(tip - 30 * Y, tip + 30 * Y, -back, sweep))
    return cuts[0], cuts[1]


def test_two_planes_cut_out_a_wedge():
    """21 mm deep and 42 mm wide on top, in which the kerfs' inner walls lie sqrt(2) of the radius
    higher; the tumor sticks out above."""
    truth = boxed(ball(6, (0, 0, 10)))
    result = cut(truth, plan(*wedge()))
    assert result.detached
    assert result.removed_share == 1.0
    inner = 21 - np.sqrt(2) * RADIUS_MM
    above = np.pi * 1**2 * (18 - 1) / 3  # of the ball, above the box
    assert result.piece_ml == pytest.approx((40 * inner**2 + above) * ML, rel=0.01)
    side = 21 * np.sqrt(2) + 1.5  # of each plane, from the tip to the top
    assert result.kerf_ml == pytest.approx(2 * side * 40 * KERF_MM * ML, rel=0.04)
    # Beyond the edge both walls of each kerf are what stays.
    assert result.kerf_area_mm2 == pytest.approx(40 * (2 * side + 2 * 1.5 + 1.2 * np.pi), rel=0.05)
    assert result.margin_mm == pytest.approx(16 / np.sqrt(2) - 6 - RADIUS_MM, abs=0.05)


def test_the_piece_is_what_the_cup_holds_and_what_is_loose_beside_it_is_lost():
    """The box in three: the middle, the largest, stays; both ends come off."""
    truth, cuts = boxed(ball(6, (20, 0, 3))), (across(10), across(-15))
    end = cut(truth, plan(*cuts, grasp_mm=(20, 0, 16)))
    other = cut(truth, plan(*cuts, grasp_mm=(-25, 0, 14)))
    middle = cut(truth, plan(*cuts, grasp_mm=(0, 0, 15)))
    nothing = cut(truth, plan(*cuts, grasp_mm=(20, 0, 27)))
    assert [end.detached, other.detached, middle.detached] == [True, True, False]
    assert not nothing.detached
    assert end.piece_ml == pytest.approx(18.8 * 1200 * ML, rel=0.01)
    assert other.piece_ml == pytest.approx(13.8 * 1200 * ML, rel=0.01)
    assert (end.removed_share, other.removed_share, middle.removed_share) == (1.0, 0.0, 0.0)
    assert other.left_share == 1.0
    lost = (18.8 + 13.8 + 2 * KERF_MM) * 1200 * ML - end.tumor_ml
    assert end.healthy_ml == pytest.approx(lost, rel=0.01)
    assert other.healthy_ml == middle.healthy_ml == end.healthy_ml


def test_another_tumor_that_the_electrode_touches_is_hurt():
    """A plane 10 mm beside the middles of both, of 9.5 and 4 mm; the axis passes both."""
    near, far = ball(9.5, (0, 0, 0)), ball(4, (0, 14, 0))
    truth = boxed(ball(6, (20, 0, 3)), near, far)
    result = cut(truth, plan(across(10), grasp_mm=(20, 0, 15)))
    assert result.hurt == ("tumor_2",)
    swept = swept_by(plan(across(10)))
    margins_mm = [electrode_margin_mm(part, swept) for part in (near, far)]
    assert margins_mm == pytest.approx([0, 10 - 4 - RADIUS_MM], abs=0.03)
    assert result.removed_share == 1.0


def test_poses_of_motions_go_before_the_plan():
    """The electrode was 2 mm nearer to the tumor than planned, and was off in the first half."""
    truth, planned = boxed(ball(6, (20, 0, 3))), plan(across(10), grasp_mm=(20, 0, 15))
    ends = swept_by(planned).ends_mm + [2.0, 0.0, 0.0]
    result = cut(truth, planned, Swept(ends))
    assert result.margin_mm == pytest.approx(4 - 2 - RADIUS_MM, abs=0.05)
    assert result.detached
    half = cut(truth, planned, Swept(ends[ends[:, 0, 1] > 0]))
    assert not half.detached
    assert half.kerf_ml == pytest.approx(result.kerf_ml / 2, rel=0.05)


def test_a_plan_is_followed_in_small_steps_over_its_whole_length():
    path = np.array([[0, 0, 0], [10, 0, 0], [10, 5.5, 0]], float)
    swept = swept_by(plan(Cut(1, path, -Z), across(4)), electrode_mm=50.0)
    tips, rears = swept.ends_mm[:, 0], swept.ends_mm[:, 1]
    assert np.allclose(rears - tips, 50 * Z)
    first = tips[: np.flatnonzero((tips == path[-1]).all(1))[0] + 1]
    steps = np.linalg.norm(np.diff(first, axis=0), axis=1)
    assert steps.max() <= 0.3 + 1e-9
    assert steps.sum() == pytest.approx(15.5)
    assert (tips[len(first)] == [4, -30, -25]).all()


def test_what_cannot_be_cut_is_refused():
    truth = boxed(ball(6, (20, 0, 3)))
    with refused(InputError, "tumor_2", "kidney, tumor_1"):
        cut(truth, plan(across(10), tumor="tumor_2"))
    published = plan(replace(across(10), axis=None))
    with pytest.raises(InputError):
        cut(truth, published)
    with pytest.raises(InputError):
        Swept(np.zeros((0, 2, 3)))
    given = swept_by(plan(across(10)))
    assert cut(truth, published, given) == cut(truth, plan(across(10)))
