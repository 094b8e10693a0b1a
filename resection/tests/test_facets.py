"""The piece's plane facets: what the electrode's whole line keeps, cuts and leaves. No arms."""

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cut_objects import beyond, gap_mm, holds, on_axes, swept
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
from refused import refused
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Mesh
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.facets import Tools
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
BODY = sphere(MIDDLE_MM, HALF_MM)


def turned(seen: Located, vector: tuple[float, float, float]) -> Located:
    """About the organ's middle."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    b_from_a[:3, 3] = MIDDLE_MM - b_from_a[:3, :3] @ MIDDLE_MM
    return seen.transformed(b_from_a)


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


@IN_ALL
def test_what_a_plan_says_it_keeps_cuts_and_takes_away(name):
    holds(planned(name), scene(name), KEEPING.get(name, OURS), Tools())


def test_everything_that_is_to_be_kept_is_named():
    assert planned("side").keep_mm == {}
    assert planned("a second tumor").keep_mm == {"tumor_2": OURS.margin_mm}
    assert planned("a second tumor").taken == ("tumor_1",)
    assert planned("an artery").keep_mm == {"artery": 3.0}
    assert not any(note.startswith(UNGUARDED) for note in planned("an artery").notes)
    unguarded = plan_resection(scene("an artery"), OURS)
    assert unguarded.keep_mm == {}
    (note,) = [note for note in unguarded.warnings if note.startswith(UNGUARDED)]
    assert "artery" in note
    without = plan_resection(replace(scene("an artery"), structures={}), OURS)
    assert np.array_equal(unguarded.facets, without.facets)  # it is named, and nothing else


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
    count = len(seen.points_of(1))
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
def test_it_is_held_on_the_piece_and_on_the_side_from_which_the_cup_comes(name):
    seen, plan = scene(name), planned(name)
    gap, _ = cKDTree(seen.organ.spread_mm(1.0)).query(plan.grasp_mm)
    assert gap < 1.8  # it is the highest point of a column 2 mm wide
    assert (beyond(plan.facets, plan.grasp_mm[None]) <= -RADIUS - 4.0).all()
    above = plan.grasp_mm + np.arange(3.0, 120.0, 1.0)[:, None] * plan.lift
    assert not contains(seen.organ, above).any()
    for label in seen.tumors:
        if name_of(label) not in plan.taken:
            off = np.linalg.norm(seen.meshes[name_of(label)].spread_mm(1.0) - plan.grasp_mm, axis=1)
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
    with refused(NoPlan, "15 mm"):
        plan_resection(scene("side"), OURS, Tools(electrode_mm=15.0))


# Other tumors -------------------------------------------------------------------------------------


def apart(gap_mm: float, other_mm: float = 12.0) -> Located:
    """A small tumor on the organ's side, and so far beside it a large one."""
    one, way = np.array([-20.0, -24.0, 150.0]), np.array([0.99875, 0.05, 0.0])
    large = sphere(one + (7.0 + gap_mm + other_mm) * way, other_mm)
    return located(sphere(one, 7.0), large, n=20_000)


@pytest.mark.parametrize(("distance_mm", "share"), [(11.0, 0.5), (9.0, 0.2)])
def test_where_there_is_little_room_it_keeps_less_and_the_plan_says_so(distance_mm, share):
    """An electrode fits between the two, but not with both margins; out with both would come four
    times as much."""
    seen = apart(distance_mm)
    plan = plan_resection(seen, ResectionConfig(tumor="tumor_1"))
    assert plan.taken == ("tumor_1",)
    assert plan.keep_mm == {"tumor_2": pytest.approx(share * OURS.margin_mm)}
    (note,) = [note for note in plan.warnings if note.startswith(NO_ROOM)]
    assert "tumor_2" in note
    assert plan.keep_mm["tumor_2"] - 0.1 < gap_mm(plan, seen.meshes["tumor_2"]) < OURS.margin_mm
    assert gap_mm(plan, seen.meshes["tumor_1"]) >= OURS.margin_mm
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


def test_the_first_tumor_keeps_the_distance_that_is_asked_for_when_the_second_is_cut_out():
    both = ResectionConfig(tumor="tumor_2", keep_away={"tumor_1": 3.0})
    plan = plan_resection(scene("a second tumor"), both)
    assert (plan.tumor, plan.keep_mm) == ("tumor_2", {"tumor_1": 3.0})
    assert gap_mm(plan, scene("a second tumor").meshes["tumor_1"]) > 3.0 - 0.1
    with refused(InputError, 'keep_away="tumor_1"'):
        plan_resection(scene("side"), ResectionConfig(keep_away={"tumor_1": 3.0}))


def test_between_tumors_that_touch_there_is_no_way():
    """And both together would be more than is allowed."""
    seen = beside(TUMOR_MM + [-(RADIUS_MM + 8.0), 5.0, 1.0], 9.0)
    alone = plan_resection(seen, ResectionConfig(tumor="tumor_1", most_healthy=1.0))
    assert set(alone.taken) == {"tumor_1", "tumor_2"}
    lost = (alone.volumes_ml["healthy"] + alone.volumes_ml["kerf"]) / alone.volumes_ml["parenchyma"]
    with pytest.raises(NoPlan):
        plan_resection(seen, ResectionConfig(tumor="tumor_1", most_healthy=lost / 4))


# Structures, and other things to keep away from ---------------------------------------------------


def with_artery(off_mm: float) -> Located:
    """A ball of 1 mm radius in the organ, so far beyond the margin."""
    away = RADIUS_MM + OURS.margin_mm + off_mm + 1.0
    ball = sphere(TUMOR_MM + [0.0, away, 0.0], 1.0)
    return replace(located(n=12_000), structures={"artery": ball})


@pytest.mark.parametrize("off_mm", [0.0, 3.0, 12.0])
@pytest.mark.parametrize("keep_mm", [1.0, 5.0])
def test_cuts_keep_the_distance_from_a_structure(off_mm, keep_mm):
    """Beside it or beyond it: the piece is another where it lies in the way."""
    seen = with_artery(off_mm)
    plan = plan_resection(seen, ResectionConfig(keep_away={"artery": keep_mm}))
    assert plan.keep_mm == {"artery": keep_mm}
    assert gap_mm(plan, seen.structures["artery"]) > keep_mm - 0.05
    assert gap_mm(plan, seen.meshes["tumor_1"]) >= OURS.margin_mm


def test_a_structure_round_the_tumor_is_no_plan_by_its_name():
    seen = replace(located(n=12_000), structures={"vein": sphere(TUMOR_MM, RADIUS_MM + 5.0)})
    with refused(NoPlan, "vein"):
        plan_resection(seen, ResectionConfig(keep_away={"vein": 3.0}))


def test_an_open_structure_keeps_its_distance_too():
    """It crosses the edges between facets."""
    corners = TUMOR_MM + np.array([[-30.0, 22, -30], [30, 22, -30], [30, 22, 30], [-30, 22, 30]])
    sheet = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    seen = replace(located(), structures={"fascia": sheet})
    plan = plan_resection(seen, ResectionConfig(keep_away={"fascia": 1.0}))
    assert gap_mm(plan, sheet) > 1.0 - 0.05


def test_what_cannot_be_kept_away_from_is_refused():
    with refused(InputError, "vein", "artery"):
        plan_resection(with_artery(2.0), ResectionConfig(keep_away={"vein": 3.0}))
    with refused(InputError, 'keep_away="tumor_2"'):
        plan_resection(with_artery(2.0), ResectionConfig(keep_away={"tumor_2": 3.0}))
    for mm in (0.0, -1.0, 51.0, float("nan")):
        with refused(InputError, "keep_away"):
            ResectionConfig(keep_away={"artery": mm})


def test_a_tumor_with_a_surface_and_no_points_is_kept_away_from():
    """As of a tumor that is smaller than the spacing of the cloud's points."""
    seen = located(sphere(TUMOR_MM, RADIUS_MM), n=12_000)
    ball = sphere(TUMOR_MM + [0.0, RADIUS_MM + OURS.margin_mm + 6.0, 0.0], 1.0)
    seen = replace(seen, meshes={**seen.meshes, "tumor_2": ball})
    assert seen.tumors == (2, 3)
    plan = plan_resection(seen, ResectionConfig(tumor="tumor_1", keep_away={"tumor_2": 2.0}))
    assert gap_mm(plan, ball) > 2.0 - 0.05
    with pytest.raises(NoPlan):
        plan_resection(seen, ResectionConfig(tumor="tumor_2"))
