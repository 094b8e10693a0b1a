"""The planner: outlines, margins, what comes away, and when there is no plan."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import shapely.affinity
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from plan_objects import HALF_MM, MIDDLE_MM, RADIUS_MM, TUMOR_MM, located, sphere
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack_lab.cut import cut as cut_out
from tumortrack_resection.budget import planned_budget
from tumortrack_resection.files import as_builtins, from_plain
from tumortrack_resection.outline import arcs, concave_hull, evenly, grown, polygon_of
from tumortrack_resection.resection import exophytic_shares, inside, plan_resection
from tumortrack_resection.values import CutLayer, Located, ResectionConfig

PUBLISHED, OURS = ResectionConfig(method="published"), ResectionConfig()


def horseshoe():
    """A shape whose convex hull is no answer."""
    return shapely.Point(0, 0).buffer(30, 64).difference(shapely.box(-8, -40, 8, 10))


def bean():
    return shapely.Point(0, 0).buffer(20, 64).difference(shapely.Point(22, 0).buffer(12, 64))


@pytest.mark.parametrize(
    ("shape", "n", "least"),
    [
        *((bean(), n, 0.85 if n < 300 else 0.92) for n in (150, 400, 2_000, 10_000)),
        *((horseshoe(), n, 0.88 if n < 1_000 else 0.92) for n in (500, 2_000, 10_000)),
    ],
)
def test_a_hull_is_the_shape_that_its_points_were_drawn_from_at_every_density(shape, n, least):
    rng = np.random.default_rng(n)
    points = rng.uniform(-30, 30, (8 * n, 2))
    points = points[shapely.contains_xy(shape, *points.T)][:n]
    assert len(points) == n
    hull = concave_hull(points)
    overlap = hull.intersection(shape).area / hull.union(shape).area
    assert overlap > least
    assert overlap > points_overlap_of_convex(points, shape)


def points_overlap_of_convex(points, shape):
    hull = shapely.MultiPoint(points).convex_hull
    return hull.intersection(shape).area / hull.union(shape).area


def test_a_far_cluster_is_not_part_of_the_hull():
    rng = np.random.default_rng(0)
    disc = rng.normal(size=(400, 2))
    disc *= (10 * np.sqrt(rng.random(400)) / np.linalg.norm(disc, axis=1))[:, None]
    stray = rng.normal([80, 0], 1, (15, 2))
    hull = concave_hull(np.concatenate([stray, disc]))
    assert hull.bounds[2] < 15
    assert hull.area == pytest.approx(np.pi * 100, rel=0.15)


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 2)), np.zeros((1, 2)), np.zeros((50, 2)), np.linspace([0, 0], [9, 9], 40)],
    ids=["none", "one", "all at one place", "on a line"],
)
def test_points_without_an_area_have_no_outline(points):
    with pytest.raises(NoPlan, match=r"line|area"):
        concave_hull(points)


def test_a_circle_grows_by_the_margin():
    disc = shapely.Point(3, -4).buffer(12, 256)
    assert grown(disc, 5).area == pytest.approx(np.pi * 17**2, rel=2e-3)


@given(st.integers(4, 60), st.floats(0.3, 7))
@settings(max_examples=30, deadline=None)
def test_points_lie_evenly_on_the_line_they_were_asked_for(n, spacing):
    turn = np.linspace(0, 5, n)
    line = np.stack([20 * np.cos(turn), 9 * np.sin(turn)], axis=1)
    found = evenly(line, spacing)
    assert np.allclose(found[[0, -1]], line[[0, -1]])
    way = shapely.LineString(line)
    assert shapely.distance(way, shapely.points(found)).max() < 1e-6
    at = shapely.line_locate_point(way, shapely.points(found))
    steps = np.diff(at[1:-1])
    assert steps.max(initial=0) <= spacing + 1e-6
    assert np.ptp(steps) < 1e-6 if len(steps) else True


@given(st.lists(st.booleans(), min_size=6, max_size=40), st.integers(0, 3))
@settings(max_examples=100, deadline=None)
def test_runs_of_a_ring_hold_what_is_wanted_and_its_leads_and_no_more(wanted, lead):
    wanted = np.array(wanted)
    n = len(wanted)
    ring = np.stack([np.arange(n), np.arange(n) * 2.0], axis=1)
    expected = {(k + s) % n for k in np.flatnonzero(wanted) for s in range(-lead, lead + 1)}
    found = arcs(ring, wanted, lead)
    if len(expected) == n:
        assert len(found) == 1
        assert np.array_equal(found[0][0], found[0][-1])
        found = [found[0][:-1]]
    numbers = [int(x) for line in found for x in line[:, 0]]
    assert sorted(numbers) == sorted(expected)  # each once
    for line in found:
        assert all((b - a) % n == 1 for a, b in zip(line[:-1, 0], line[1:, 0], strict=True))


def test_the_published_plan_is_the_papers():
    seen = located()
    tumor = seen.of(2)
    plan = plan_resection(seen, PUBLISHED)
    assert plan.tumor == "tumor_1"
    assert plan.grasp_mm == pytest.approx([*tumor[:, :2].mean(0), tumor[:, 2].max()])
    assert [cut.sweep for cut in plan.cuts] == [1, 2]
    low, high = tumor[:, 2].min(), tumor[:, 2].max()
    assert [cut.height_mm for cut in plan.cuts] == pytest.approx([(low + high) / 2, low])
    for cut in plan.cuts:
        assert cut.closed
        assert np.ptp(cut.path_mm[:, 2]) == 0
        steps = np.linalg.norm(np.diff(cut.path_mm, axis=0), axis=1)
        assert steps.max() <= PUBLISHED.spacing_mm + 1e-9
    # The part of the contour in the organ's projection keeps the margin; elsewhere it is the
    # organ's own outline.
    off = np.linalg.norm(plan.cuts[0].path_mm[:, :2] - TUMOR_MM[:2], axis=1)
    deep = plan.cuts[0].path_mm[:, 1] > TUMOR_MM[1]
    assert off[deep].max() == pytest.approx(RADIUS_MM + 5, abs=0.8)
    assert off[~deep].min() < RADIUS_MM + 1


@pytest.mark.parametrize("margin_mm", [1.0, 3.0, 5.0, 10.0])
def test_our_margin_round_a_sphere_is_exact(margin_mm):
    seen = located()
    config = ResectionConfig(margin_mm=margin_mm, layer_mm=2.0, most_healthy=1.0)
    plan = plan_resection(seen, config)
    whole = RADIUS_MM + margin_mm
    for cut in plan.cuts:
        flat = np.linalg.norm(cut.path_mm[:, :2] - TUMOR_MM[:2], axis=1)
        if cut.kind == "wall":  # no nearer, and no farther than the next layer's outline
            top = min(TUMOR_MM[2], cut.height_mm + 2.0)
            outer = np.sqrt(max(whole**2 - (TUMOR_MM[2] - top) ** 2, 0))
            assert flat.max() < outer + 0.15
            assert flat.min() > outer - 0.6  # corners of a polygon, near the flat pole
        distance = np.linalg.norm(cut.path_mm - TUMOR_MM, axis=1)
        assert distance.min() > whole - 0.3
    floor = min(layer.bottom_mm for layer in plan.layers)
    assert floor == pytest.approx(TUMOR_MM[2] - whole, abs=0.05)
    # The whole grown sphere below its equator comes away, and its column above.
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (4000, 3)) * (whole + 2) + TUMOR_MM
    off = np.linalg.norm(points - TUMOR_MM, axis=1)
    assert inside(plan.layers, points[off < whole - 0.3]).all()
    aside = np.linalg.norm(points[:, :2] - TUMOR_MM[:2], axis=1)
    assert not inside(plan.layers, points[aside > whole + 0.15]).any()


def test_uncertainty_widens_the_margin_and_too_much_of_it_is_no_plan():
    seen = located(std_mm=1.5)
    plain = plan_resection(seen, OURS)
    wider = plan_resection(seen, ResectionConfig(sigmas=2.0))
    low = [min(layer.bottom_mm for layer in plan.layers) for plan in (plain, wider)]
    assert low[0] - low[1] == pytest.approx(3.0, abs=0.05)
    assert wider.volumes_ml["healthy"] > plain.volumes_ml["healthy"]
    with pytest.raises(NoPlan, match=r"20\.\d mm|unsure"):
        plan_resection(located(std_mm=8.0), ResectionConfig(sigmas=2.0))
    with pytest.raises(NoPlan, match="does not say how unsure"):
        plan_resection(located(), ResectionConfig(sigmas=2.0))


def test_only_kidney_is_cut_and_the_strokes_reach_beyond_it():
    plan = plan_resection(located(), OURS)
    walls = [cut for cut in plan.cuts if cut.kind == "wall"]
    assert walls
    assert not any(cut.closed for cut in walls)  # the tumor bulges out: one side is air
    for cut in walls:
        at_rest = (((cut.path_mm - MIDDLE_MM) / HALF_MM) ** 2).sum(1)
        assert at_rest.min() < 1  # goes through the organ
        ends = at_rest[[0, -1]]
        assert (ends > 1).all()  # and out of it at both ends
    heights = [cut.height_mm for cut in plan.cuts]
    assert heights == sorted(heights, reverse=True)  # from the top down
    gaps = [
        np.linalg.norm(a.path_mm[-1] - b.path_mm[0])
        for a, b in zip(plan.cuts, plan.cuts[1:], strict=False)
    ]
    assert max(gaps) < 25  # each begins on the side where the last one ended


def turn_of(stroke):
    """1: anticlockwise about the tumor, seen from above."""
    x, y = (stroke.path_mm[:, :2] - TUMOR_MM[:2]).T
    return np.sign((x[:-1] * np.diff(y) - y[:-1] * np.diff(x)).sum())


def test_order_and_direction_of_strokes_can_be_chosen():
    down = plan_resection(located(), OURS)
    up = plan_resection(located(), ResectionConfig(order="up"))
    heights = [stroke.height_mm for stroke in up.cuts]
    assert heights == sorted(heights)
    assert [stroke.sweep for stroke in up.cuts] == sorted(stroke.sweep for stroke in up.cuts)
    assert {round(s.length_mm, 6) for s in up.cuts} == {round(s.length_mm, 6) for s in down.cuts}
    for direction, sign in (("anticlockwise", 1), ("clockwise", -1)):
        plan = plan_resection(located(), ResectionConfig(direction=direction))
        for stroke in plan.cuts:
            assert turn_of(stroke) == sign
    walls = [stroke for stroke in down.cuts if stroke.kind == "wall"]
    turns = [turn_of(wall) for wall in walls]
    assert turns == [turns[0] * (-1) ** n for n in range(len(turns))]  # to and fro


def test_the_floor_is_cut_where_the_next_layer_is_smaller():
    plan = plan_resection(located(), ResectionConfig(stroke_mm=3.0))
    lowest = polygon_of(plan.layers[-1].rings_mm)
    strokes = [cut for cut in plan.cuts if cut.height_mm == plan.layers[-1].bottom_mm]
    swept = shapely.union_all(
        [shapely.LineString(cut.path_mm[:, :2]).buffer(3.0) for cut in strokes]
    )
    assert any(cut.kind == "floor" for cut in strokes)
    across = np.sqrt(1 - ((strokes[0].height_mm - MIDDLE_MM[2]) / HALF_MM[2]) ** 2) * HALF_MM
    organ = shapely.affinity.scale(shapely.Point(0, 0).buffer(1, 64), across[0], across[1])
    there = lowest.intersection(organ)
    assert there.area > 30
    assert there.difference(swept).area < 0.05 * there.area


def test_volumes_are_those_of_the_bodies():
    seen = located()
    plan = plan_resection(seen, OURS)
    assert plan.volumes_ml["tumor"] == pytest.approx(4 / 3 * np.pi * 1.2**3, rel=0.05)
    assert plan.volumes_ml["piece"] > plan.volumes_ml["tumor"]
    surface_ml = {name: mesh.volume_mm3 / 1000 for name, mesh in seen.meshes.items()}
    assert plan.volumes_ml["tumor"] == pytest.approx(surface_ml["tumor_1"])  # as `locate` states it
    whole = plan.volumes_ml["parenchyma"] + plan.volumes_ml["tumor"]
    assert whole == pytest.approx(surface_ml["kidney"]) == pytest.approx(plan.volumes_ml["organ"])
    assert plan.volumes_ml["piece"] == pytest.approx(
        plan.volumes_ml["tumor"] + plan.volumes_ml["healthy"], rel=1e-6
    )


def test_the_grasp_point_lies_on_the_piece():
    plan = plan_resection(located(), OURS)
    assert inside(plan.layers, plan.grasp_mm[None] - [0, 0, 1.0]).all()
    on_tumor = np.linalg.norm(plan.grasp_mm - TUMOR_MM) - RADIUS_MM
    assert abs(on_tumor) < 2.5  # the highest point in a column of 2 mm


def test_how_much_of_a_tumor_is_outside_is_told_apart():
    deep = sphere(MIDDLE_MM + [-20, 0, 0], 10)
    half = sphere(TUMOR_MM, RADIUS_MM)
    seen = located(deep, half)
    shares = exophytic_shares(seen, [2, 3])
    assert shares[2] == 0
    middle_out = (((TUMOR_MM - MIDDLE_MM) / HALF_MM) ** 2).sum() ** 0.5
    assert 0.2 < shares[3] < 0.8
    assert middle_out > 0.85
    assert plan_resection(seen, OURS).tumor == "tumor_2"
    for config in (OURS, PUBLISHED):
        with pytest.raises(NoPlan, match=r"tumor_1 lies wholly inside .* no contour"):
            plan_resection(seen, ResectionConfig(method=config.method, tumor="tumor_1"))
        with pytest.raises(NoPlan, match="wholly inside"):
            plan_resection(located(deep), config)
    with pytest.raises(InputError, match="tumor_1, tumor_2"):
        plan_resection(seen, ResectionConfig(tumor="tumor_7"))


def test_a_cut_through_another_tumor_is_no_plan_and_a_swallowed_one_is_said():
    bulging = sphere(TUMOR_MM, RADIUS_MM)
    for far_mm in (19.0, 21.0):  # in the second the surface alone is grazed, no point of the cloud
        beside = sphere(TUMOR_MM + [far_mm, 8, -4], 6)
        with pytest.raises(NoPlan, match="would go through tumor_2"):
            plan_resection(located(bulging, beside), OURS)
    tiny = sphere(TUMOR_MM + [0.0, 14, 0], 1.8)
    plan = plan_resection(located(bulging, tiny), ResectionConfig(tumor="tumor_1", margin_mm=8))
    assert any("tumor_2 comes away" in note for note in plan.notes)


def test_too_much_healthy_tissue_is_no_plan():
    with pytest.raises(NoPlan, match="healthy tissue would come away"):
        plan_resection(located(), ResectionConfig(most_healthy=0.05))


@pytest.mark.parametrize("kept", [0, 12])
def test_a_tumor_of_few_points_is_no_plan(kept):
    seen = located()
    keep = np.concatenate(
        [np.flatnonzero(seen.labels == 1), np.flatnonzero(seen.labels == 2)[:kept]]
    )
    few = type(seen)(seen.points_mm[keep], seen.labels[keep])
    with pytest.raises(NoPlan, match="no tumor was located" if kept == 0 else "only 12 points"):
        plan_resection(few, PUBLISHED)
    for gone in seen.meshes:
        others = {name: mesh for name, mesh in seen.meshes.items() if name != gone}
        part = gone if gone.startswith("tumor") else "the organ"
        with pytest.raises(NoPlan, match=f"{part} has no surface"):
            plan_resection(replace(seen, meshes=others), OURS)
    bare = type(seen)(seen.points_mm[:0], seen.labels[:0])
    with pytest.raises(NoPlan, match="no organ"):
        plan_resection(bare, PUBLISHED)


@pytest.mark.parametrize("config", [PUBLISHED, OURS], ids=["published", "margin"])
def test_a_plan_comes_back_from_json(config):
    plan = plan_resection(located(), config)
    again = from_plain(as_builtins(plan))
    assert as_builtins(again) == as_builtins(plan)
    assert again.layers[0].top_mm == np.inf


@pytest.mark.parametrize("config", [PUBLISHED, OURS], ids=["published", "margin"])
def test_a_turned_and_shifted_world_has_a_turned_and_shifted_plan(config):
    seen = located(n=20_000)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shift = np.array([40.0, -13.0, 6.0])
    moved = type(seen)(
        seen.points_mm @ turn.T + shift,
        seen.labels,
        {name: mesh.moved(mesh.vertices_mm @ turn.T + shift) for name, mesh in seen.meshes.items()},
    )
    a, b = plan_resection(seen, config), plan_resection(moved, config)
    assert b.grasp_mm == pytest.approx(turn @ a.grasp_mm + shift, abs=1.6)
    assert b.volumes_ml["healthy"] == pytest.approx(a.volumes_ml["healthy"], rel=0.05)
    length = [sum(cut.length_mm for cut in plan.cuts) for plan in (a, b)]
    assert length[1] == pytest.approx(length[0], rel=0.06)


@pytest.mark.parametrize(("finer", "margin_mm"), [(0, 2.0), (1, 2.0), (1, 5.0)])
def test_coarse_surfaces_are_cut_through_and_keep_the_margin(finer, margin_mm):
    """Edges of 12.6 and 6.6 mm on the tumor, 58 and 30 mm on the organ."""
    tumor = sphere(TUMOR_MM, RADIUS_MM, finer)
    organ = mesh_of(solid_of(sphere(MIDDLE_MM, HALF_MM, finer), "o") + solid_of(tumor, "t"))
    fine = located(sphere(TUMOR_MM, RADIUS_MM))
    seen = Located(fine.points_mm, fine.labels, {"kidney": organ, "tumor_1": tumor})
    plan = plan_resection(seen, ResectionConfig(margin_mm=margin_mm))
    done = cut_out(Anatomy((organ, tumor)), plan)
    assert done.detached
    assert done.removed_share == 1.0
    assert done.margin_mm > margin_mm - 0.3
    assert planned_budget(plan, seen).margin_mm == pytest.approx(done.margin_mm, abs=0.4)


def test_nonsense_is_refused():
    with pytest.raises(InputError, match="margin_mm is -1; allowed: 1 to 20"):
        ResectionConfig(margin_mm=-1)
    with pytest.raises(InputError, match="layer from 5 up to 5"):
        CutLayer(5.0, 5.0, ())


@pytest.mark.parametrize("off_mm", [-1.5, 0.0, 1.5])
def test_the_piece_comes_free_of_an_organ_that_is_a_little_larger_than_was_estimated(off_mm):
    plan = plan_resection(located(), OURS)
    ball = sphere(MIDDLE_MM, HALF_MM + off_mm)
    tumor = sphere(TUMOR_MM, RADIUS_MM)
    done = cut_out(Anatomy((mesh_of(solid_of(ball, "o") + solid_of(tumor, "t")), tumor)), plan)
    assert done.detached
    assert done.removed_share == 1.0
    assert done.margin_mm > 4.5


def test_an_organ_that_reaches_into_the_next_layer_is_not_left_hanging_on_it():
    """Estimated to end 1 mm above the lowest layer, it ends 0.7 mm within."""
    tumor = sphere([10.0, -30.0, 135.0], RADIUS_MM)

    def slab(bottom_mm):
        box = trimesh.creation.box(bounds=[[-55, -30, bottom_mm], [55, 30, 150]])
        return mesh_of(solid_of(Mesh(box.vertices, box.faces), "o") + solid_of(tumor, "t"))

    estimated, true = slab(123.0), slab(121.3)
    rng = np.random.default_rng(0)
    points = rng.uniform(*estimated.box_mm, (20_000, 3))
    in_tumor = np.linalg.norm(points - [10.0, -30.0, 135.0], axis=1) < RADIUS_MM
    in_slab = (np.abs(points[:, 1]) < 30) & (points[:, 2] > 123)
    labels = np.where(in_tumor, 2, in_slab).astype(np.uint8)
    seen = Located(points[labels > 0], labels[labels > 0], {"kidney": estimated, "tumor_1": tumor})
    plan = plan_resection(seen, OURS)
    assert min(layer.bottom_mm for layer in plan.layers) == pytest.approx(118, abs=0.05)
    done = cut_out(Anatomy((true, tumor)), plan)
    assert done.detached
    assert done.removed_share == 1.0
