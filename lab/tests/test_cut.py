"""A plan cuts the true anatomy: volumes, margins and bridges of bodies that can be reckoned.

Walls on quarters of a millimetre lie midway between voxels here, where volumes are exact.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
import trimesh

from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack_lab.cut import Severed, cut, pieces_of, within
from tumortrack_resection.values import Cut, CutLayer, ResectionPlan

ML = 1e-3


def ball(radius_mm, center_mm, semi_axes=(1, 1, 1)):
    solid = trimesh.creation.icosphere(5, radius_mm)
    return Mesh(solid.vertices * np.array(semi_axes) + np.array(center_mm), solid.faces)


def block(low, high):
    solid = trimesh.creation.box(bounds=[low, high])
    return Mesh(solid.vertices, solid.faces)


def united(organ, *tumors):
    whole = solid_of(organ, "organ")
    for tumor in tumors:
        whole = whole + solid_of(tumor, "tumor")
    return Anatomy((mesh_of(whole), *tumors))


def circle(radius_mm, n=180):
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return radius_mm * np.stack([np.cos(angle), np.sin(angle)], 1)


def square(low, high):
    (x0, y0), (x1, y1) = low, high
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def stroke(points, height_mm, closed=True):
    """Along these points, every half millimetre."""
    path = np.concatenate([points, points[:1]]) if closed else np.asarray(points, float)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    way = np.concatenate([[0], np.cumsum(steps)])
    at = np.unique(np.concatenate([way, np.arange(0, way[-1], 0.5)]))
    flat = [np.interp(at, way, axis) for axis in path.T]
    return Cut(1, np.column_stack([*flat, np.full(len(at), float(height_mm))]))


def plan(layers, cuts=None, tumor="tumor_1"):
    if cuts is None:
        cuts = [stroke(ring, layer.bottom_mm) for layer in layers for ring in layer.rings_mm]
    return ResectionPlan(
        "margin", tumor, 2, np.zeros(3), tuple(cuts), tuple(layers), 5.0, {}, exophytic=0.5
    )


def prism(ring, bottom_mm=0.0):
    return CutLayer(bottom_mm, np.inf, (ring,))


@pytest.fixture(scope="module")
def half_sunk():
    """A kidney-sized ellipsoid with a ball of 12 mm, half sunk, on its top."""
    return united(ball(1, (0, 0, 0), (50, 30, 25)), ball(12, (0, 0, 25)))


def test_a_half_sunk_ball_comes_away_with_the_healthy_tissue_below_it(half_sunk):
    result = cut(half_sunk, plan([prism(circle(17), 8.0)]))
    assert result.tumor_ml == pytest.approx(4 / 3 * np.pi * 12**3 * ML, rel=0.005)
    assert (result.removed_share, result.enclosed_share) == (1.0, 1.0)
    assert result.left_ml == 0.0
    assert result.detached
    assert result.bridge_mm2 == 0.0
    assert result.margin_mm == pytest.approx(5.0, abs=0.05)  # of the sheet; the walls have more
    assert result.healthy_ml == pytest.approx(_healthy_ml(17, 8), rel=0.02)
    assert result.piece_ml == pytest.approx(result.tumor_ml + result.healthy_ml)
    assert result.hurt == ()


def _healthy_ml(radius_mm, bottom_mm):
    """Of that ellipsoid, within a cylinder and above a height, without that ball: by quadrature."""
    r, a = np.meshgrid(np.arange(0.05, radius_mm, 0.1), np.arange(0, 2 * np.pi, 0.01))
    x, y = r * np.cos(a), r * np.sin(a)
    top = 25 * np.sqrt(1 - (x / 50) ** 2 - (y / 30) ** 2)
    half = np.sqrt(np.maximum(144 - r**2, 0))
    ball_in = np.where(half > 0, np.clip(top - (25 - half), 0, None), 0)
    return float(((top - bottom_mm - ball_in) * r).sum() * 0.1 * 0.01) * ML


@pytest.mark.parametrize("voxel_mm", [0.5, 0.7])
def test_a_prism_cut_has_the_volumes_of_blocks(voxel_mm):
    """A tumor of 10 x 10 x 10 in a corner of an organ of 40 x 30 x 20, cut by a prism of 16 x 14
    x 13, of which 15 x 13 x 13 lie in the organ."""
    truth = Anatomy((block([0, 0, 0], [40, 30, 20]), block([0.2, 0.2, 9.8], [10, 10, 19.8])))
    result = cut(truth, plan([prism(square((-1, -1), (15, 13)), 7.0)]), voxel_mm)
    edge_ml = voxel_mm * 500 * ML  # of half a voxel all round
    assert result.piece_ml == pytest.approx(15 * 13 * 13 * ML, abs=edge_ml)
    assert result.healthy_ml == pytest.approx((15 * 13 * 13 - 9.8 * 9.8 * 10) * ML, abs=edge_ml)
    assert result.removed_share == 1.0
    assert result.margin_mm == pytest.approx(2.8, abs=0.01)


def test_layers_that_grow_narrower_come_away_as_a_staircase():
    truth = Anatomy((block([-20, -20, 0], [20, 20, 20]), ball(4, (0, 0, 13))))
    stairs = [
        prism(square((-12, -12), (12, 12)), 14.0),
        CutLayer(9.0, 14.0, (square((-9, -9), (9, 9)),)),
        CutLayer(6.0, 9.0, (square((-6, -6), (6, 6)),)),
    ]
    result = cut(truth, plan(stairs))
    assert result.detached
    assert result.bridge_mm2 == 0.0
    assert result.piece_ml == pytest.approx((24**2 * 6 + 18**2 * 5 + 12**2 * 3) * ML, rel=0.05)
    assert result.margin_mm == pytest.approx(3.0, abs=0.05)  # below; beside it is 5


def test_a_layer_wider_than_the_one_above_it_still_hangs_by_its_rim():
    truth = Anatomy((block([-20, -20, 0], [20, 20, 20]), ball(4, (0, 0, 10))))
    layers = [
        prism(square((-6, -6), (6, 6)), 14.0),
        CutLayer(4.0, 14.0, (square((-9, -9), (9, 9)),)),
    ]
    result = cut(truth, plan(layers))
    assert not result.detached
    assert (result.removed_share, result.enclosed_share, result.healthy_ml) == (0.0, 1.0, 0.0)
    assert result.bridge_mm2 == pytest.approx(18**2 - 12**2, rel=0.05)
    assert result.margin_mm == pytest.approx(2.0, abs=0.05)


def test_a_stroke_with_a_gap_in_tissue_leaves_a_bridge():
    """Four walls of 20 mm, 15 mm high; the last 4 mm of the way are not cut."""
    truth = Anatomy((block([-20, -20, 0], [20, 20, 20]), ball(5, (0, 0, 14))))
    ring = square((-10, -10), (10, 10))
    open_way = np.concatenate([ring, [[-10, -6]]])
    result = cut(truth, plan([prism(ring, 5.0)], [stroke(open_way, 5.0, closed=False)]))
    assert not result.detached
    assert (result.removed_share, result.left_ml) == (0.0, result.tumor_ml)
    assert (result.enclosed_share, result.piece_ml) == (1.0, 0.0)
    assert result.bridge_mm2 == pytest.approx((4 - 2 * 0.5) * 15, rel=0.1)  # 0.5 mm beside its ends
    through = cut(truth, plan([prism(ring, 5.0)]))
    assert through.detached
    assert through.removed_share == 1.0


def test_a_stroke_may_be_open_where_there_is_no_tissue(half_sunk):
    """An organ's end is cut off from the front to the back, by an arc that both ends leave."""
    truth = Anatomy((half_sunk.organ, ball(5, (42, 0, 0))))
    at = 30.25
    arc = stroke([[at, 40.0], [at, -40.0]], -30.0, closed=False)
    result = cut(truth, plan([prism(square((at, -40), (70, 40)), -30.0)], [arc]))
    assert result.detached
    assert result.bridge_mm2 == 0.0
    cap = np.pi * 30 * 25 * 50 * (2 / 3 - at / 50 + (at / 50) ** 3 / 3)
    assert result.piece_ml == pytest.approx(cap * ML, rel=0.005)
    assert result.margin_mm == pytest.approx(42 - 5 - at, abs=0.05)


@pytest.mark.parametrize("beyond_mm", [1.0, 3.0, 6.0])
def test_a_tumor_that_lies_elsewhere_is_cut_as_deep_and_left_as_much_as_it_is_off(beyond_mm):
    """A wall 4.25 mm beside where a ball of 8 mm was thought, which lies further that way."""
    truth = Anatomy((block([-30, -20, 0], [30, 20, 30]), ball(8, (4.25 + beyond_mm, 0, 15))))
    result = cut(truth, plan([prism(square((-12, -14), (12.25, 14)), 3.0)]))
    cap = np.pi * beyond_mm**2 * (24 - beyond_mm) / 3
    assert result.left_ml == pytest.approx(cap * ML, rel=0.03)
    assert result.removed_share == pytest.approx(1 - result.left_ml / result.tumor_ml)
    assert result.margin_mm == pytest.approx(-beyond_mm, abs=0.1)


def test_a_strand_that_tears_holds_nothing():
    """The gap is 1.5 mm wide at the top of the wall alone, where 1 mm of tissue is."""
    truth = Anatomy((block([-20, -20, 0], [20, 20, 20]), ball(5, (0, 0, 14))))
    ring = square((-10, -10), (10, 10))
    layers = [prism(ring, 19.0), CutLayer(5.0, 19.0, (ring,))]
    gap = np.concatenate([ring, [[-10.0, -7.5]]])
    whole = stroke(ring, 5.0)
    result = cut(truth, plan(layers, [stroke(gap, 19.0, closed=False), whole]))
    assert result.bridge_mm2 == pytest.approx(1.5, rel=0.3)
    assert result.detached
    assert result.removed_share == 1.0
    longer = np.concatenate([ring, [[-10.0, -4.5]]])
    held = cut(truth, plan(layers, [stroke(longer, 19.0, closed=False), whole]))
    assert held.bridge_mm2 == pytest.approx(4.5, rel=0.25)
    assert not held.detached


def test_what_comes_off_beside_the_piece_is_not_removed():
    """A wall goes through a tumor that lies in an organ's end: its rest is off, but loose."""
    truth = Anatomy((block([-40, -10, 0], [14.25, 10, 20]), ball(8, (6.25, 0, 10))))
    ring = square((-15, -12), (10.25, 12))
    result = cut(truth, plan([prism(ring, 0.0)]))
    cap = np.pi * 16 * (24 - 4) / 3 * ML
    assert result.detached
    assert result.loose_share * result.tumor_ml == pytest.approx(cap, rel=0.03)
    assert result.removed_share == pytest.approx(1 - result.loose_share)
    assert result.enclosed_share == pytest.approx(result.removed_share)
    assert result.left_ml == pytest.approx(cap, rel=0.03)
    assert result.piece_ml == pytest.approx((25.25 * 20 * 20) * ML, rel=0.03)


@pytest.mark.parametrize("wall_mm", [12.0, 12.1, 12.4])
def test_volumes_err_by_half_a_voxel_at_each_of_their_ends_at_most(wall_mm):
    truth = Anatomy((block([-30, -20, 0], [30, 20, 30]), ball(4, (0, 0, 20))))
    result = cut(truth, plan([prism(square((-30, -30), (wall_mm, 30)), 10.0)]))
    assert result.piece_ml == pytest.approx((wall_mm + 30) * 40 * 20 * ML, abs=0.5 * 40 * 20 * ML)


@pytest.mark.parametrize("margin_mm", [0.7, 5.0])
def test_the_margin_of_a_ball_is_exact(margin_mm):
    truth = Anatomy((block([-30, -30, 0], [30, 30, 40]), ball(10, (0, 0, 20))))
    result = cut(truth, plan([prism(circle(10 + margin_mm), 1.0)]))
    assert result.margin_mm == pytest.approx(margin_mm, abs=0.03)


def test_turned_about_the_vertical_the_same_comes_away(half_sunk):
    ring = np.array([[-15.0, -17], [16, -15], [22, 8], [-4, 19], [-21, 3]])
    straight = cut(half_sunk, plan([prism(ring, 10.0)]))
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    parts = tuple(part.moved(part.vertices_mm @ turn.T) for part in half_sunk.parts)
    turned = cut(Anatomy(parts), plan([prism(ring @ turn[:2, :2].T, 10.0)]))
    assert turned.piece_ml == pytest.approx(straight.piece_ml, rel=0.01)
    assert turned.margin_mm == pytest.approx(straight.margin_mm, abs=0.05)
    assert turned.detached
    assert straight.detached


def test_another_tumor_in_the_way_is_hurt_and_one_beside_is_not():
    organ = block([-30, -20, 0], [30, 20, 30])
    truth = Anatomy((organ, ball(6, (0, 0, 20)), ball(5, (12, 0, 20)), ball(4, (-22, 0, 20))))
    result = cut(truth, plan([prism(circle(11), 8.0)]))
    assert result.hurt == ("tumor_2",)
    assert result.margin_mm == pytest.approx(5.0, abs=0.05)


def test_a_cut_in_the_air_does_nothing():
    truth = Anatomy((block([-20, -20, 0], [20, 20, 20]), ball(5, (0, 0, 10))))
    result = cut(truth, plan([prism(square((40, -5), (50, 5)), 2.0)]))
    assert (result.removed_share, result.piece_ml, result.detached) == (0.0, 0.0, False)
    assert result.margin_mm is None
    above = cut(truth, plan([prism(circle(15), 21.0)]))
    assert above.margin_mm is None
    assert above.enclosed_share == 0.0


def test_a_plan_for_another_anatomy_is_refused(half_sunk):
    with pytest.raises(InputError, match=r"tumor_2.*kidney, tumor_1"):
        cut(half_sunk, plan([prism(circle(17), 8.0)], tumor="tumor_2"))
    with pytest.raises(InputError, match="none of the plan's layers"):
        cut(half_sunk, plan([prism(circle(17), 8.0)], [stroke(circle(17), 4.0)]))


@pytest.mark.parametrize("seed", range(4))
def test_what_is_severed_agrees_with_walking_from_voxel_to_voxel(seed):
    rng = np.random.default_rng(seed)
    tissue = rng.random((7, 6, 5)) < 0.9
    severed = Severed(tissue.shape)
    for faces in severed.faces:
        faces |= rng.random(faces.shape) < 0.5
    found = pieces_of(tissue, severed)
    expected = _walked(tissue, severed.faces)
    assert len(expected) > 3
    assert np.array_equal(found > 0, tissue)
    assert found.max() == len(expected)
    sizes = []
    for number in range(1, found.max() + 1):
        piece = {tuple(v) for v in np.argwhere(found == number).tolist()}
        assert piece in expected
        sizes.append(len(piece))
    assert sizes == sorted(sizes, reverse=True)


def _walked(tissue, faces):
    """The pieces, by breadth-first search."""
    left, pieces = {tuple(v) for v in np.argwhere(tissue).tolist()}, []
    while left:
        piece, todo = set(), deque([left.pop()])
        while todo:
            here = todo.popleft()
            piece.add(here)
            for axis in range(3):
                for step in (-1, 1):
                    there = tuple(n + step * (a == axis) for a, n in enumerate(here))
                    face = min(here, there)
                    if there in left and not faces[axis][face]:
                        left.remove(there)
                        todo.append(there)
        pieces.append(piece)
    return pieces


@pytest.mark.parametrize("whole", [True, False])
def test_closed_strokes_sever_just_what_they_enclose(whole):
    """Also where they run exactly through voxels' centres (``whole``)."""
    rng = np.random.default_rng(5)
    tissue = np.ones((30, 28, 3), bool)
    for _ in range(20):
        angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
        ring = 14 + rng.uniform(4, 12, (9, 1)) * np.stack([np.cos(angles), np.sin(angles)], 1)
        ring = np.rint(ring) if whole else ring
        severed = Severed(tissue.shape)
        severed.wall(np.concatenate([ring, ring[:1]]), 1, 3)
        columns = within((ring,), tissue.shape[:2])
        severed.sheet(columns, 1)
        expected = columns[:, :, None] & np.array([False, True, True])
        away = pieces_of(tissue, severed) > 1
        # A corner less wide than a voxel may leave single voxels by themselves.
        assert np.array_equal(away & expected, expected)
        assert (away & ~expected).sum() <= 4
        assert 20 < columns.sum() < 600


def test_within_agrees_with_shapely():
    import shapely

    rng = np.random.default_rng(1)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 40))
    ring = 20 + rng.uniform(6, 18, (40, 1)) * np.stack([np.cos(angles), np.sin(angles)], 1)
    i, j = np.mgrid[0:40, 0:40]
    expected = shapely.contains_xy(shapely.Polygon(ring), i, j)
    assert np.array_equal(within((ring,), (40, 40)), expected)
    assert within((ring, ring), (40, 40)).sum() == 0
