"""The planner: outlines, the paper's method, which tumor, and when there is no plan. What facets
keep and cut: ``test_facets``."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh

from plan_objects import HALF_MM, MIDDLE_MM, RADIUS_MM, TUMOR_MM, located, sphere
from refused import refused
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.mesh_query import contains
from tumortrack.core.report import Finding
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.live.values import PublishedFrame
from tumortrack_benchmarks.physics.cut import cut as cut_out
from tumortrack_resection.budget import planned_budgets
from tumortrack_resection.drafts import exophytic_shares, plan_resection
from tumortrack_resection.files import as_builtins, from_plain
from tumortrack_resection.outline import concave_hull
from tumortrack_resection.planning import plan_cuts
from tumortrack_resection.values import POOR_ESTIMATE, WEAK_CASE, Located, ResectionConfig

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
    convex = shapely.MultiPoint(points).convex_hull
    assert overlap > convex.intersection(shape).area / convex.union(shape).area


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
    with pytest.raises(NoPlan):
        concave_hull(points)


# The paper's method -------------------------------------------------------------------------------


def test_the_published_plan_is_the_papers():
    seen = located()
    tumor = seen.points_of(2)
    plan = plan_resection(seen, PUBLISHED)
    assert plan.tumor == "tumor_1"
    assert plan.grasp_mm == pytest.approx([*tumor[:, :2].mean(0), tumor[:, 2].max()])
    assert [cut.sweep for cut in plan.cuts] == [1, 2]
    low, high = tumor[:, 2].min(), tumor[:, 2].max()
    assert [cut.path_mm[0, 2] for cut in plan.cuts] == pytest.approx([(low + high) / 2, low])
    for cut in plan.cuts:
        assert cut.closed
        assert cut.axis is None  # level, from wherever the arms manage
        assert np.ptp(cut.path_mm[:, 2]) == 0
        steps = np.linalg.norm(np.diff(cut.path_mm, axis=0), axis=1)
        assert steps.max() <= PUBLISHED.spacing_mm + 1e-9
    # The part of the contour in the organ's projection keeps the margin; elsewhere it is the
    # organ's own outline.
    off = np.linalg.norm(plan.cuts[0].path_mm[:, :2] - TUMOR_MM[:2], axis=1)
    deep = plan.cuts[0].path_mm[:, 1] > TUMOR_MM[1]
    assert off[deep].max() == pytest.approx(RADIUS_MM + 5, abs=0.8)
    assert off[~deep].min() < RADIUS_MM + 1
    assert plan.facets.shape == (0, 4)
    assert plan.lift == pytest.approx([0, 0, 1])
    assert (plan.taken, plan.keep_mm) == (("tumor_1",), {})


def test_the_published_piece_is_the_organ_over_the_lower_sweep_within_its_contour():
    seen = located()
    plan = plan_resection(seen, PUBLISHED)
    outline = shapely.Polygon(plan.cuts[1].path_mm[:, :2])
    points = np.random.default_rng(0).uniform(*seen.organ.box_mm, (20_000, 3))
    within = shapely.contains_xy(outline, *points[:, :2].T) & (
        points[:, 2] > seen.points_of(2)[:, 2].min()
    )
    organ = contains(seen.organ, points)
    assert (contains(plan.piece, points) == (within & organ)).mean() > 0.998
    ml, piece_ml = plan.volumes_ml, (within & organ).sum() / organ.sum() * seen.organ.volume_ml
    assert plan.piece.closed
    assert plan.piece.volume_ml == pytest.approx(piece_ml, rel=0.04)
    assert ml["piece"] == pytest.approx(piece_ml, rel=0.06)
    assert ml["piece"] == pytest.approx(ml["tumor"] + ml["healthy"])
    assert "kerf" not in ml  # level directions are the arms' choice


# Which tumor, and whether -------------------------------------------------------------------------


def test_how_much_of_a_tumor_is_outside_is_told_apart():
    deep = sphere(MIDDLE_MM + [-20, 0, 0], 10)
    half = sphere(TUMOR_MM, RADIUS_MM)
    seen = located(deep, half)
    shares = exophytic_shares(seen, [2, 3])
    assert shares[2] == 0
    middle_out = (((TUMOR_MM - MIDDLE_MM) / HALF_MM) ** 2).sum() ** 0.5
    assert 0.2 < shares[3] < 0.8
    assert middle_out > 0.85
    for config in (OURS, PUBLISHED):
        plan = plan_resection(seen, config)
        assert (plan.tumor, plan.label) == ("tumor_2", 3)
        assert plan.exophytic == shares[3]
        with refused(NoPlan, "tumor_1"):
            plan_resection(seen, ResectionConfig(method=config.method, tumor="tumor_1"))
        with pytest.raises(NoPlan):
            plan_resection(located(deep), config)
    with refused(InputError, "tumor_1, tumor_2"):
        plan_resection(seen, ResectionConfig(tumor="tumor_7"))


@pytest.mark.parametrize("config", [PUBLISHED, OURS], ids=["published", "margin"])
def test_too_much_healthy_tissue_is_no_plan(config):
    with pytest.raises(NoPlan):
        plan_resection(located(), ResectionConfig(method=config.method, most_healthy=0.02))


@pytest.mark.parametrize("kept", [0, 12])
def test_a_tumor_of_few_points_is_no_plan(kept):
    seen = located()
    keep = np.concatenate(
        [np.flatnonzero(seen.labels == 1), np.flatnonzero(seen.labels == 2)[:kept]]
    )
    few = Located(seen.points_mm[keep], seen.labels[keep])
    with refused(NoPlan, *filter(None, [kept])):
        plan_resection(few, PUBLISHED)
    bare = Located(seen.points_mm[:0], seen.labels[:0])
    with pytest.raises(NoPlan):
        plan_resection(bare, PUBLISHED)


@pytest.mark.parametrize("config", [PUBLISHED, OURS], ids=["published", "margin"])
def test_what_has_no_surface_is_no_plan(config):
    seen = located()
    for gone in seen.meshes:
        others = {name: mesh for name, mesh in seen.meshes.items() if name != gone}
        with refused(NoPlan, gone if gone.startswith("tumor") else "organ"):
            plan_resection(replace(seen, meshes=others), config)
    open_organ = Mesh(seen.organ.vertices_mm, seen.organ.faces[:-40])
    with refused(InputError, "organ"):
        plan_resection(replace(seen, meshes={**seen.meshes, "kidney": open_organ}), config)


WRONG = {
    "margin_mm": (-1, 20.1, float("nan")), "spacing_mm": (0.1,), "lead_mm": (31.0,),
    "most_facets": (0, 13), "least_exophytic": (1.1,), "most_healthy": (-0.1,),
}  # fmt: skip


@pytest.mark.parametrize("wrong", [{n: v} for n, values in WRONG.items() for v in values])
def test_nonsense_is_refused(wrong):
    with refused(InputError, *wrong):
        ResectionConfig(**wrong)


# A plan as a value --------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [PUBLISHED, OURS], ids=["published", "margin"])
def test_a_plan_comes_back_from_json(config):
    plan = plan_resection(located(), config)
    data = as_builtins(plan)
    again = from_plain(data, plan.piece)
    assert as_builtins(again) == data
    assert again.facets.shape == plan.facets.shape
    assert [cut.axis is None for cut in again.cuts] == [cut.axis is None for cut in plan.cuts]
    # What is stored to fewer digits is still in its plane, and keeps what it kept.
    for cut, plane in zip(again.cuts, again.facets, strict=False):
        assert np.abs(cut.path_mm @ plane[:3] - plane[3]).max() < 0.02
    with pytest.raises(KeyError):
        from_plain(data, None)


# Against the truth --------------------------------------------------------------------------------


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
    assert margin_mm <= done.margin_mm < margin_mm + 0.3
    assert planned_budgets(plan, seen)[0].margin_mm == pytest.approx(done.margin_mm, abs=0.3)


def test_an_organ_that_reaches_deeper_than_was_estimated_is_cut_through():
    """A slab whose lower side was estimated 1.7 mm too high."""
    tumor = sphere([10.0, -30.0, 140.0], RADIUS_MM)

    def slab(bottom_mm):
        box = trimesh.creation.box(bounds=[[-55, -30, bottom_mm], [55, 30, 150]])
        return mesh_of(solid_of(Mesh(box.vertices, box.faces), "o") + solid_of(tumor, "t"))

    estimated, true = slab(123.0), slab(121.3)
    rng = np.random.default_rng(0)
    points = rng.uniform(*estimated.box_mm, (20_000, 3))
    in_tumor = np.linalg.norm(points - [10.0, -30.0, 140.0], axis=1) < RADIUS_MM
    in_slab = (np.abs(points[:, 1]) < 30) & (points[:, 2] > 123)
    labels = np.where(in_tumor, 2, in_slab).astype(np.uint8)
    seen = Located(points[labels > 0], labels[labels > 0], {"kidney": estimated, "tumor_1": tumor})
    plan = plan_resection(seen, OURS)
    done = cut_out(Anatomy((true, tumor)), plan)
    assert done.detached
    assert done.removed_share == 1.0
    assert done.margin_mm > 5.0


def test_what_weakens_a_case_or_an_estimate_is_said_first():
    weak = replace(
        located(),
        weak=(Finding("cut", {"part": "kidney", "voxels": 9.0, "area_cm2": 1.0}),),
        doubt="it is seen through",
    )
    frames = PublishedFrame("table", np.eye(4))
    with pytest.raises(InputError):
        plan_cuts(weak, OURS, frames, accept_poor=False)
    notes = plan_cuts(weak, OURS, frames, accept_poor=True).plan.warnings
    assert [n.split(":")[0] for n in notes[:2]] == [POOR_ESTIMATE, WEAK_CASE]
