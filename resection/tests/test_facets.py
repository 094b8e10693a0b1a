"""The piece's plane facets: what the electrode's whole line keeps, cuts and leaves. No arms."""

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cut_objects import beyond, in_box, in_plane, on_axes, swept, to_axes
from plan_objects import (
    HALF_MM,
    MIDDLE_MM,
    RADIUS_MM,
    TUMOR_MM,
    located,
    located_of,
    sphere,
    united,
)
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Anatomy, Mesh
from tumortrack_lab.cut import cut as cut_out
from tumortrack_resection.facets import Tools
from tumortrack_resection.resection import plan_resection
from tumortrack_resection.values import (
    NO_ROOM,
    UNGUARDED,
    Located,
    ResectionConfig,
    ResectionPlan,
    name_of,
)

OURS = ResectionConfig()
RADIUS = Tools().radius_mm  # of the electrode
SLACK_MM = 0.1  # by which planes may lie farther off than they have to
BODY = sphere(MIDDLE_MM, HALF_MM)
NEAR_MM = 0.3  # of a plane


def turned(seen: Located, vector: tuple[float, float, float]) -> Located:
    """About the organ's middle."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    b_from_a[:3, 3] = MIDDLE_MM - b_from_a[:3, :3] @ MIDDLE_MM
    return seen.moved(b_from_a)


def beside(middle_mm, radius_mm=5.0) -> Located:
    """The usual tumor and a second one."""
    return located(sphere(TUMOR_MM, RADIUS_MM), sphere(middle_mm, radius_mm), n=30_000)


SCENES = {
    "side": lambda: located(n=12_000),
    "top": lambda: located(sphere([5, 0, 168], 11), n=12_000),
    "shoulder": lambda: located(sphere([-20, 20, 160], 10), n=12_000),
    "sideways below": lambda: located(sphere([10, -22, 130], 10), n=12_000),
    "end": lambda: located(sphere([-52, 0, 145], 10), n=12_000),
    "mostly inside": lambda: located(sphere([10, -19, 148], 13), n=12_000),
    "two lobes": lambda: located_of(
        BODY, united(sphere([10, -26, 150], 9), sphere([22, -22, 156], 8))
    ),
    "waisted organ": lambda: located_of(
        united(sphere([-25, 0, 145], [30, 26, 24]), sphere([25, 4, 147], [30, 24, 22])),
        sphere([4, -16, 152], 9),
    ),
    "turned": lambda: turned(located(n=12_000), (0.4, -0.5, 0.9)),
    "upside down": lambda: turned(located(sphere([5, 0, 168], 11), n=12_000), (2.6, 0.3, 0.0)),
    "a second tumor": lambda: beside([-24, -18, 158]),
    "an artery": lambda: replace(
        located(n=12_000), structures={"artery": sphere([10, 0, 148], [40, 2, 2])}
    ),
}
KEEPING = {"an artery": ResectionConfig(keep_away={"artery": 3.0})}


@cache
def scene(name: str) -> Located:
    return SCENES[name]()


@cache
def planned(name: str) -> ResectionPlan:
    return plan_resection(scene(name), KEEPING.get(name, OURS))


IN_ALL = pytest.mark.parametrize("name", SCENES)


def dense(mesh: Mesh) -> np.ndarray:
    return mesh.spread_mm(1.0)  # 5 mm are at most 0.04 mm too long


# What is kept -------------------------------------------------------------------------------------


@IN_ALL
def test_the_whole_tumor_lies_inside_all_planes_by_margin_and_radius_and_hardly_more(name):
    seen, plan = scene(name), planned(name)
    assert np.linalg.norm(plan.facets[:, :3], axis=1) == pytest.approx(1.0, abs=1e-12)
    depths = -beyond(plan.facets, seen.meshes[plan.tumor].vertices_mm).max(0)
    assert (depths >= plan.margin_mm + RADIUS - 1e-9).all()
    assert (depths <= plan.margin_mm + RADIUS + SLACK_MM + 1e-9).all()


@IN_ALL
def test_the_electrode_lies_in_its_facet_and_so_near_to_nothing(name):
    """Its whole length, all along the cut: distances of dense points of surfaces."""
    seen, plan = scene(name), planned(name)
    assert [cut.sweep for cut in plan.cuts] == [*range(1, len(plan.facets) + 1)]
    surfaces = {**seen.meshes, **seen.structures}
    kept = {**dict.fromkeys(plan.taken, plan.margin_mm), **plan.keep_mm}
    for cut, plane in zip(plan.cuts, plan.facets, strict=True):
        ends = swept(cut)
        assert np.linalg.norm(cut.axis) == pytest.approx(1.0, abs=1e-12)
        assert np.abs(beyond(plane[None], ends.reshape(-1, 3))).max() < 1e-6
        for other, least_mm in kept.items():
            gaps = to_axes(dense(surfaces[other]), ends) - RADIUS
            assert gaps.min() > least_mm - (0.0 if other == plan.tumor else 0.1), other


def test_everything_that_is_to_be_kept_is_named():
    assert planned("side").keep_mm == {}
    assert planned("a second tumor").keep_mm == {"tumor_2": OURS.margin_mm}
    assert planned("an artery").keep_mm == {"artery": 3.0}
    assert not any(note.startswith(UNGUARDED) for note in planned("an artery").notes)
    unguarded = plan_resection(scene("an artery"), OURS)
    assert unguarded.keep_mm == {}
    (note,) = [note for note in unguarded.warnings if note.startswith(UNGUARDED)]
    assert "artery" in note


@IN_ALL
def test_the_electrode_cuts_nothing_but_the_facet(name):
    seen, plan = scene(name), planned(name)
    for number, cut in enumerate(plan.cuts):
        points = on_axes(swept(cut)).reshape(-1, 3)
        points = points[in_box(seen.organ, points)]
        points = points[contains(seen.organ, points)]
        others = np.delete(plan.facets, number, axis=0)
        assert len(points)
        assert beyond(others, points).max(initial=0) < 1.5


# What comes away ----------------------------------------------------------------------------------


@IN_ALL
def test_the_sweeps_leave_no_bridge_between_the_piece_and_what_stays(name):
    """Of the organ, all that lies near to a plane and within the others is in a kerf."""
    seen, plan = scene(name), planned(name)
    for number, (cut, plane) in enumerate(zip(plan.cuts, plan.facets, strict=True)):
        ends, others = swept(cut), np.delete(plan.facets, number, axis=0)
        for off_mm in (-NEAR_MM, 0.0, NEAR_MM):
            points = in_plane(plane + [0, 0, 0, off_mm], seen.organ)
            points = points[in_box(seen.organ, points)]
            points = points[(beyond(others, points) <= 0).all(1)]
            points = points[contains(seen.organ, points)]
            assert to_axes(points, ends).max(initial=0) < RADIUS


@IN_ALL
def test_strokes_begin_and_end_outside_the_organ(name):
    seen, plan = scene(name), planned(name)
    for cut in plan.cuts:
        ends = on_axes(swept(cut)[[0, -1]], 0.5).reshape(-1, 3)
        assert not contains(seen.organ, ends).any()
        steps = np.linalg.norm(np.diff(cut.path_mm, axis=0), axis=1)
        assert steps.max() <= OURS.spacing_mm + 1e-9


@IN_ALL
def test_the_electrode_s_bare_length_reaches_through_the_organ(name):
    seen, plan = scene(name), planned(name)
    for cut in plan.cuts:
        rear = swept(cut, Tools().electrode_mm - 4.0)[:, 1]
        assert not contains(seen.organ, rear).any()


@IN_ALL
def test_volumes_are_those_of_the_surfaces(name):
    seen, plan = scene(name), planned(name)
    ml = plan.volumes_ml
    assert plan.piece.closed
    assert ml["organ"] == pytest.approx(seen.organ.volume_ml)
    assert ml["tumor"] == pytest.approx(seen.meshes[plan.tumor].volume_ml)
    tumors_ml = {name_of(n): seen.meshes[name_of(n)].volume_ml for n in seen.tumors}
    assert ml["parenchyma"] == pytest.approx(ml["organ"] - sum(tumors_ml.values()))
    taken_ml = sum(tumors_ml[tumor] for tumor in plan.taken)
    assert ml["piece"] == pytest.approx(ml["healthy"] + taken_ml)
    # The piece begins where kerfs end, and all of it is organ.
    assert beyond(plan.facets, plan.piece.vertices_mm).max() <= -RADIUS + 1e-6
    points = np.random.default_rng(3).uniform(*plan.piece.box_mm, (4_000, 3))
    inner = (beyond(plan.facets, points) <= -RADIUS).all(1)
    assert (contains(plan.piece, points) == (contains(seen.organ, points) & inner)).mean() > 0.999
    # Shares are counted with the points of the cloud.
    count = len(seen.of(1))
    healthy_ml = plan.piece.volume_ml - taken_ml
    assert ml["healthy"] == pytest.approx(healthy_ml, abs=counted_to(ml, healthy_ml, count))
    points = np.random.default_rng(4).uniform(*seen.organ.box_mm, (60_000, 3))
    points = points[contains(seen.organ, points)]
    outside = beyond(plan.facets, points)
    kerf = (outside <= RADIUS).all(1) & ~(outside <= -RADIUS).all(1)
    kerf_ml = kerf.mean() * ml["organ"]
    assert ml["kerf"] == pytest.approx(kerf_ml, abs=counted_to(ml, kerf_ml, count))


def counted_to(ml: dict[str, float], part_ml: float, count: int) -> float:
    """Four standard deviations of a volume that is a share of so many points."""
    share = part_ml / ml["parenchyma"]
    return 4 * ml["parenchyma"] * np.sqrt(share * (1 - share) / count)


@IN_ALL
def test_voxels_of_the_organ_fall_apart_into_the_piece_and_what_stays(name):
    seen, plan = scene(name), planned(name)
    tumors = [seen.meshes[name_of(label)] for label in seen.tumors]
    done = cut_out(Anatomy((seen.organ, *tumors)), plan, voxel_mm=0.7)
    assert done.detached
    assert (done.removed_share, done.cut_share, done.left_share) == (1.0, 0.0, 0.0)
    assert done.hurt == ()
    assert plan.margin_mm <= done.margin_mm < plan.margin_mm + 0.3
    assert done.piece_ml == pytest.approx(plan.piece.volume_ml, rel=0.03)


@pytest.mark.parametrize("spacing_mm", [0.5, 1.0, 2.0])
def test_however_far_apart_points_of_strokes_are_the_piece_comes_free(spacing_mm):
    seen = scene("side")
    plan = plan_resection(seen, ResectionConfig(spacing_mm=spacing_mm))
    for number, (cut, plane) in enumerate(zip(plan.cuts, plan.facets, strict=True)):
        others = np.delete(plan.facets, number, axis=0)
        wall = in_plane(plane, seen.organ)
        wall = wall[in_box(seen.organ, wall) & (beyond(others, wall) <= 0).all(1)]
        wall = wall[contains(seen.organ, wall)]
        assert to_axes(wall, swept(cut)).max(initial=0) < RADIUS


@IN_ALL
def test_the_piece_comes_free_the_way_it_is_lifted_and_the_cup_comes(name):
    plan = planned(name)
    assert np.linalg.norm(plan.lift) == pytest.approx(1.0)
    assert plan.lift[2] >= 0
    assert (plan.facets[:, :3] @ plan.lift).max() < -0.04


@IN_ALL
def test_it_is_held_on_the_piece_and_on_the_side_from_which_the_cup_comes(name):
    seen, plan = scene(name), planned(name)
    gap, _ = cKDTree(dense(seen.organ)).query(plan.grasp_mm)
    assert gap < 1.8  # it is the highest point of a column 2 mm wide
    assert (beyond(plan.facets, plan.grasp_mm[None]) <= -RADIUS - 4.0).all()
    above = plan.grasp_mm + np.arange(3.0, 120.0, 1.0)[:, None] * plan.lift
    assert not contains(seen.organ, above).any()
    for label in seen.tumors:
        if name_of(label) not in plan.taken:
            off = np.linalg.norm(dense(seen.meshes[name_of(label)]) - plan.grasp_mm, axis=1)
            assert off.min() > Tools().cup_radius_mm


# Choices ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["side", "sideways below", "mostly inside", "two lobes"])
def test_what_can_be_cut_with_few_facets_can_be_with_more_and_takes_no_more(name):
    """A piece that opens sideways counts as up to 1.3 times as much: so much more it may take."""
    lost = []
    for most in (1, 2, 3, 6):
        plan = plan_resection(scene(name), ResectionConfig(most_facets=most))
        assert 1 <= len(plan.facets) <= most
        lost.append(plan.volumes_ml["healthy"] + plan.volumes_ml["kerf"])
    assert all(after <= 1.3 * before for before, after in itertools.pairwise(lost))
    assert lost[-1] < 0.7 * lost[0]


def test_a_wider_margin_takes_more():
    healthy = []
    for margin_mm in (1.0, 3.0, 5.0, 8.0):
        plan = plan_resection(scene("side"), ResectionConfig(margin_mm=margin_mm))
        depths = -beyond(plan.facets, scene("side").meshes["tumor_1"].vertices_mm).max(0)
        assert depths == pytest.approx(margin_mm + RADIUS + SLACK_MM)
        healthy.append(plan.volumes_ml["healthy"])
    assert healthy == sorted(healthy)
    assert healthy[-1] > 2 * healthy[0]


def test_the_same_input_has_the_same_plan():
    one, other = (plan_resection(located(n=12_000), OURS) for _ in range(2))
    for name in ("facets", "grasp_mm", "lift"):
        assert np.array_equal(getattr(one, name), getattr(other, name))
    for a, b in zip(one.cuts, other.cuts, strict=True):
        assert np.array_equal(a.path_mm, b.path_mm)
        assert np.array_equal(a.axis, b.axis)
    assert np.array_equal(one.piece.vertices_mm, other.piece.vertices_mm)
    assert (one.volumes_ml, one.notes) == (other.volumes_ml, other.notes)


@pytest.mark.parametrize("most_healthy", [0.02, 0.05])
def test_too_much_healthy_tissue_is_no_plan(most_healthy):
    with pytest.raises(NoPlan, match=f"{most_healthy:.0%}"):
        plan_resection(scene("side"), ResectionConfig(most_healthy=most_healthy))
    plan = planned("side")
    lost = plan.volumes_ml["healthy"] + plan.volumes_ml["kerf"]
    assert 0.05 < lost / plan.volumes_ml["parenchyma"] < 0.5


# The electrode's length ---------------------------------------------------------------------------


def test_an_electrode_that_is_too_short_is_refused_and_one_that_is_long_enough_is_not():
    deepest = 0.0
    for cut in planned("side").cuts:
        points = on_axes(swept(cut), 0.5)
        within = contains(scene("side").organ, points.reshape(-1, 3)).reshape(points.shape[:2])
        deepest = max(deepest, 0.5 * (within * np.arange(points.shape[1])).max())
    enough = plan_resection(scene("side"), OURS, Tools(electrode_mm=float(deepest + 12)))
    for cut in enough.cuts:
        assert not contains(scene("side").organ, swept(cut, deepest + 12 - 4)[:, 1]).any()
    with pytest.raises(NoPlan, match=r"electrode of 15 mm"):
        plan_resection(scene("side"), OURS, Tools(electrode_mm=15.0))


# Other tumors -------------------------------------------------------------------------------------


def test_where_there_is_room_the_other_tumor_keeps_the_whole_margin():
    plan = planned("a second tumor")
    assert plan.taken == ("tumor_1",)
    assert not any(note.startswith(NO_ROOM) for note in plan.notes)


def gap_mm(plan: ResectionPlan, seen: Located, other: str) -> float:
    points = dense(seen.meshes[other])
    return min(to_axes(points, swept(cut)).min() for cut in plan.cuts) - RADIUS


def apart(gap_mm: float, other_mm: float = 12.0) -> Located:
    """A small tumor on the organ's side, and so far beside it a large one."""
    one, way = np.array([-20.0, -24.0, 150.0]), np.array([0.99875, 0.05, 0.0])
    large = sphere(one + (7.0 + gap_mm + other_mm) * way, other_mm)
    return located(sphere(one, 7.0), large, n=20_000)


@pytest.mark.parametrize(("apart_mm", "share"), [(11.0, 0.5), (9.0, 0.2)])
def test_where_there_is_little_room_it_keeps_less_and_the_plan_says_so(apart_mm, share):
    """An electrode fits between the two, but not with both margins; out with both would come four
    times as much."""
    seen = apart(apart_mm)
    plan = plan_resection(seen, ResectionConfig(tumor="tumor_1"))
    assert plan.taken == ("tumor_1",)
    assert plan.keep_mm == {"tumor_2": pytest.approx(share * OURS.margin_mm)}
    (note,) = [note for note in plan.warnings if note.startswith(NO_ROOM)]
    assert "tumor_2" in note
    assert plan.keep_mm["tumor_2"] - 0.1 < gap_mm(plan, seen, "tumor_2") < OURS.margin_mm
    assert gap_mm(plan, seen, "tumor_1") >= OURS.margin_mm
    # With the whole margin there is none.
    asked = ResectionConfig(tumor="tumor_1", keep_away={"tumor_2": share * OURS.margin_mm})
    less = plan_resection(seen, asked)
    assert np.array_equal(less.facets, plan.facets)
    assert not any(note.startswith(NO_ROOM) for note in less.notes)


def test_tumors_too_near_to_be_cut_apart_come_away_together():
    seen = beside(TUMOR_MM + [-(RADIUS_MM + 2.0 + 5.0), 7.0, 2.0])
    plan = plan_resection(seen, ResectionConfig(tumor="tumor_1"))
    assert plan.taken == ("tumor_1", "tumor_2")
    assert plan.keep_mm == {}
    assert any("tumor_2" in note for note in plan.notes)
    depths = -beyond(plan.facets, seen.meshes["tumor_2"].vertices_mm).max(0)
    assert (depths >= OURS.margin_mm + RADIUS).all()
    assert contains(plan.piece, seen.meshes["tumor_2"].vertices_mm).mean() > 0.99
    with_it = seen.meshes["tumor_1"].volume_ml + seen.meshes["tumor_2"].volume_ml
    assert plan.volumes_ml["piece"] == pytest.approx(plan.volumes_ml["healthy"] + with_it)


def test_a_tumor_that_the_piece_swallows_is_named_and_keeps_its_distance():
    seen = beside(TUMOR_MM + [0.0, 14.0, 0.0], 1.8)
    plan = plan_resection(seen, ResectionConfig(tumor="tumor_1", margin_mm=8.0))
    assert plan.taken == ("tumor_1", "tumor_2")
    assert any("tumor_2" in note for note in plan.notes)
    assert gap_mm(plan, seen, "tumor_2") > 8.0 - 0.1


@pytest.mark.parametrize("mm", [3.0, 8.0])
def test_another_tumor_keeps_the_distance_that_is_asked_for(mm):
    seen = beside([-24, -18, 158])
    plan = plan_resection(seen, ResectionConfig(tumor="tumor_1", keep_away={"tumor_2": mm}))
    assert plan.keep_mm == {"tumor_2": mm}
    assert plan.taken == ("tumor_1",)
    assert gap_mm(plan, seen, "tumor_2") > mm - 0.1


def test_the_first_tumor_keeps_the_distance_that_is_asked_for_when_the_second_is_cut_out():
    both = ResectionConfig(tumor="tumor_2", keep_away={"tumor_1": 3.0})
    plan = plan_resection(scene("a second tumor"), both)
    assert (plan.tumor, plan.keep_mm) == ("tumor_2", {"tumor_1": 3.0})
    assert gap_mm(plan, scene("a second tumor"), "tumor_1") > 3.0 - 0.1
    with pytest.raises(InputError, match="--keep-away tumor_1"):
        plan_resection(scene("side"), ResectionConfig(keep_away={"tumor_1": 3.0}))


def test_between_tumors_that_touch_there_is_no_way():
    """And both together would be more than is allowed."""
    seen = beside(TUMOR_MM + [-(RADIUS_MM + 8.0), 5.0, 1.0], 9.0)
    alone = plan_resection(seen, ResectionConfig(tumor="tumor_1", most_healthy=1.0))
    assert set(alone.taken) == {"tumor_1", "tumor_2"}
    lost = (alone.volumes_ml["healthy"] + alone.volumes_ml["kerf"]) / alone.volumes_ml["parenchyma"]
    with pytest.raises(NoPlan):
        plan_resection(seen, ResectionConfig(tumor="tumor_1", most_healthy=lost / 4))
