"""Kinematics, collisions and motions of both arms."""

import itertools
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from arm_objects import CREEPING_MRAD, bare, flange_pose, organ, plan, seen
from plan_objects import sphere
from refused import refused
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import contains
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Mesh
from tumortrack_resection.arms import body, kinematics, procedure, trajectory
from tumortrack_resection.arms.cell import (
    ArmCell,
    ArmsReach,
    Blocked,
    PlanningGroup,
    blocked_between,
)
from tumortrack_resection.arms.config import Base, CellConfig
from tumortrack_resection.arms.cutting import Outside
from tumortrack_resection.arms.paths import connect
from tumortrack_resection.arms.procedure import Start, plan_motions, search_bases
from tumortrack_resection.check import TOLERANCE_MM, checked, clearances
from tumortrack_resection.motions import CUTTER, HOLDER, JOINTS, Execution, Motions, Stage
from tumortrack_resection.operation import ResectionProgress
from tumortrack_resection.strokes import trimmed
from tumortrack_resection.urdf import UrdfCell
from tumortrack_resection.values import Located, ResectionConfig, ResectionPlan

MODELS = pytest.mark.parametrize("model", kinematics.MODELS.values(), ids=lambda model: model.name)
HOLDING = ("grasp", "hold")
HOLDS = {"approach": (), "home": ()} | dict.fromkeys(HOLDING, (HOLDER,))
FIRST, LAST = ["approach", "grasp", "hold"], ["lift", "release", "home"]
CONFIG = CellConfig()
FAR = Base(position_mm=(3000.0, 0.0, 100.0), yaw_deg=0.0)
OURS, PUBLISHED = ResectionConfig(), ResectionConfig(method="published")
HOME = np.array(CONFIG.home_rad)


@pytest.fixture(scope="module")
def cell():
    return ArmCell(organ=organ())


@pytest.fixture(scope="module", params=[OURS, PUBLISHED], ids=["margin", "published"])
def made(request):
    """A plan and its motions."""
    return plan_motions(seen(), request.param, CONFIG)


@pytest.fixture(scope="module")
def ours():
    return plan_motions(seen(), OURS, CONFIG)


def sweeps(plan: ResectionPlan) -> list[str]:
    return [f"sweep {n}" for n in range(1, plan.sweeps + 1)]


def _at_tip(cell, arm, tip_mm, yaw_rad, joints_rad=None):
    """All twelve joints with an arm's tip there, for each branch."""
    joints_rad = cell.home_rad if joints_rad is None else joints_rad
    group = PlanningGroup(cell, arm, joints_rad)
    pose = kinematics.level_pose(np.array(tip_mm, float), yaw_rad)
    return [group.all_joints(found) for found in group.inverse_kinematics(pose)]


def _cutting_tips(cell, motions, between=4):
    """Poses of the instrument's tip at all times on a cut, and between those."""
    for stage in motions.stages:
        both = stage.cutting[1:] & stage.cutting[:-1]
        for n in np.flatnonzero(both):
            for share in np.arange(between) / between:
                joints = stage.joints_rad[n] * (1 - share) + stage.joints_rad[n + 1] * share
                yield stage.name, cell.tips(joints)[CUTTER]


# Kinematics ---------------------------------------------------------------------------------------


# The cell -----------------------------------------------------------------------------------------


def test_the_cell_s_description_names_the_joints_and_agrees_with_the_numbers(cell):
    import pinocchio as pin

    text = body.cell_urdf(cell.config)
    root = ET.fromstring(text)
    links = [link.get("name") for link in root.iter("link")]
    children = [joint.find("child").get("link") for joint in root.iter("joint")]
    assert len(set(links)) == len(links)
    assert set(links) - set(children) == {"table"}  # one tree
    assert not list(root.iter("mesh"))
    assert tuple(pin.buildModelFromXML(text).names)[1:] == JOINTS
    joints = np.random.default_rng(4).uniform(-3, 3, 12)
    for n, arm in enumerate((CUTTER, HOLDER)):
        config = cell.config
        flange = flange_pose(config.model(arm), joints[6 * n : 6 * n + 6])
        expected = config.base(arm).table_from_base @ flange @ config.flange_from_tip(arm)
        assert np.abs(cell.tips(joints)[arm] - expected).max() < 1e-6


def test_collisions_on_purpose_are_found(cell):
    assert cell.collisions(cell.home_rad) is None
    low = _at_tip(cell, CUTTER, [350, 0, 2], np.pi)
    pairs = [cell.collisions(joints) for joints in low]
    assert None not in pairs
    assert any("table" in pair for pair in pairs)
    holding = _at_tip(cell, HOLDER, [-200, 0, 300], 0)[2]
    across = [
        cell.collisions(joints) for joints in _at_tip(cell, CUTTER, [-240, 0, 380], np.pi, holding)
    ]
    assert across
    assert all(pair is not None for pair in across)
    assert any({name.split("/")[0] for name in pair} == {CUTTER, HOLDER} for pair in across)


def test_only_the_electrode_and_the_cup_may_touch_the_organ(cell):
    tip = plan().cuts[0].path_mm[0] - [5.0, 5.0, 0.0]
    free = [
        joints
        for joints in _at_tip(cell, CUTTER, tip, -2.6)
        if cell.collisions(joints, (CUTTER,)) is None
    ]
    assert free
    assert cell.collisions(free[0]) == ("cutter/electrode", "organ")
    assert cell.collisions(free[0], (HOLDER,)) == ("cutter/electrode", "organ")
    deep = _at_tip(cell, CUTTER, tip - [60.0, 40.0, 0.0], -2.6)
    pairs = {cell.collisions(joints, (CUTTER,)) for joints in deep}
    assert ("cutter/pencil", "organ") in pairs


def test_the_electrode_alone_keeps_a_distance_and_more_in_free_motions(cell):
    """Beside a ball of 4 mm radius, along the electrode's axis and across it."""
    config, tip = cell.config, np.array([250.0, 0.0, 300.0])
    joints = next(j for j in _at_tip(cell, CUTTER, tip, np.pi) if cell.collisions(j) is None)
    names = ("cutter/electrode", "the margin of tumor_1")

    def found(off_mm, touching, along_mm=-30.0, keep_mm=5.0):
        # The instrument points towards -x.
        middle = tip - [along_mm, 0.0, off_mm + 4.0 + 1.2]
        keeping = ArmCell(config, keep={"tumor_1": (sphere(middle, 4.0), keep_mm)})
        assert keeping.keep_mm == {names[1]: keep_mm}
        return keeping.collisions(joints, touching)

    for touching, more_mm in (((CUTTER,), 0.0), ((), config.organ_clearance_mm)):
        assert found(5.0 + more_mm - 0.1, touching) == names
        assert found(5.0 + more_mm + 0.1, touching) is None
    assert found(7.9, (CUTTER,), keep_mm=8.0) == names
    assert found(-6.0, (CUTTER,), along_mm=-100.0) is None  # the pencil may


def test_what_is_not_tested_between_two_places_is_free(cell):
    """The same answer as with a test of every pose, by fewer tests."""
    rng, counts, tests = np.random.default_rng(8), {True: 0, False: 0}, []

    def look(group, places, k, room_mm):
        tests.append(k)
        return group.collides(places[k], room_mm)

    poses = 0
    for _ in range(60):
        start, goal = cell.home_rad[:6] + rng.normal(0, 0.5, (2, 6))
        group = PlanningGroup(cell, CUTTER, cell.home_rad, (HOLDER,))
        places = np.linspace(start, goal, int(rng.integers(3, 60)))
        levers_mm = cell.levers_mm(group.all_joints(start), group.all_joints(goal))[:6]
        moved_mm = np.abs(np.diff(places, axis=0)) @ levers_mm
        last = len(places) - 1
        found = blocked_between(0, last, moved_mm, partial(look, group, places))
        hits = [k for k in range(1, last) if group.collides(places[k])]
        assert (found is None) == (not hits)
        assert found is None or found[0] in hits
        counts[found is None] += 1
        poses += last - 1
    assert min(counts.values()) > 5
    assert len(tests) < poses


def test_a_bent_tip_is_where_its_cell_has_it():
    """By its own kinematics and by those of the URDF: 30 degrees down from the level grip."""
    config = CellConfig(bend_deg=30.0)
    urdf = UrdfCell(body.cell_urdf(config))
    ends_mm = dict(
        zip([s.name for s in urdf.solids], urdf.ends(urdf.solids, HOME[None]), strict=True)
    )
    (tip, rear), (front, _) = ends_mm["electrode"][0], ends_mm["pencil"][0]
    level = rear + np.array([-1.0, 0.0, 0.0]) * config.electrode_mm
    down = np.radians(30.0)
    assert rear == pytest.approx(front, abs=0.01)
    assert tip - rear == pytest.approx(
        config.electrode_mm * np.array([-np.cos(down), 0.0, -np.sin(down)]), abs=0.05
    )
    assert np.linalg.norm(tip - level) == pytest.approx(2 * 70 * np.sin(down / 2), abs=0.05)
    pose = ArmCell(config).tips(HOME)[CUTTER]
    assert pose[:3, 3] == pytest.approx(tip, abs=0.01)
    assert pose[:3, 0] == pytest.approx((tip - rear) / config.electrode_mm, abs=1e-6)


def test_no_point_moves_farther_than_the_levers_say(cell):
    rng = np.random.default_rng(6)
    for _ in range(30):
        one = rng.uniform(-3, 3, 12)
        other = one + rng.uniform(-0.05, 0.05, 12)
        for before, after in zip(cell.shapes(one), cell.shapes(other), strict=True):
            if "/" not in before.name or "pedestal" in before.name:
                continue
            own = slice(0, 6) if before.name.startswith(CUTTER) else slice(6, 12)
            most_mm = (np.abs(other - one) * cell.levers_mm(one, other))[own].sum()
            points = [
                transform_points(shape.published_from_shape, shape.mesh.vertices_mm)
                for shape in (before, after)
            ]
            assert np.linalg.norm(points[1] - points[0], axis=1).max() <= most_mm


@pytest.mark.parametrize(
    "wrong", [{"home_rad": (0.0,) * 6}, {"rod_mm": 15.0}, {"speed_share": 0.0}, {"pencil_mm": -1.0}]
)
def test_cells_that_can_t_be_are_refused(wrong):
    with pytest.raises(InputError):
        CellConfig(**wrong)


# Motions ------------------------------------------------------------------------------------------


def test_the_procedure_has_its_stages_without_gaps(cell, made):
    plan, motions = made
    assert [stage.name for stage in motions.stages] == [*FIRST, *sweeps(plan), *LAST]
    assert np.array_equal(motions.stages[0].joints_rad[0], cell.home_rad)
    assert np.allclose(motions.stages[-1].joints_rad[-1], cell.home_rad, atol=1e-9)
    for one, other in itertools.pairwise(motions.stages):
        assert np.array_equal(one.joints_rad[-1], other.joints_rad[0])
    held = cell.tips(motions.stages[2].joints_rad[0])[HOLDER]
    assert np.abs(held[:3, 3] - plan.grasp_mm).max() < 0.01
    assert held[:3, 2] == pytest.approx(plan.lift, abs=1e-6)


def test_the_cup_comes_and_goes_along_the_lift_and_the_cutter_is_home_before(cell, made):
    plan, motions = made
    grasp, lift = motions.stages[1], motions.stages[-3]
    ways = [np.array([cell.tips(joints)[HOLDER] for joints in s.joints_rad]) for s in (grasp, lift)]
    for poses in ways:
        off = poses[:, :3, 3] - plan.grasp_mm
        along = off @ plan.lift
        assert np.abs(off - np.outer(along, plan.lift)).max() < 0.1
        assert np.abs(poses[:, :3, 2] - plan.lift).max() < 1e-3
        assert along.max() > 30.0
    assert (np.diff(ways[0][:, :3, 3] @ plan.lift) < 1e-6).all()
    assert (np.diff(ways[1][:, :3, 3] @ plan.lift) > -1e-6).all()
    rising = np.abs(np.diff(lift.joints_rad[:, 6:], axis=0)).max(1) > 1e-9
    assert np.abs(lift.joints_rad[1:][rising][:, :6] - cell.home_rad[:6]).max() < 1e-9
    for stage in motions.stages[3:-3]:  # it holds
        assert np.ptp(stage.joints_rad[:, 6:], axis=0).max() == 0
    assert np.ptp(motions.stages[-1].joints_rad[:, :6], axis=0).max() < 1e-9


def test_joints_keep_their_limits(cell, made):
    for stage in made[1].stages:
        assert (np.abs(stage.joints_rad) <= cell.limits_rad).all()
        steps_s = np.diff(stage.times_s)[:, None]
        speeds = np.diff(stage.joints_rad, axis=0) / steps_s
        assert (np.abs(speeds) <= 1.01 * cell.speeds_rad_s).all()
        between_s = (steps_s[1:] + steps_s[:-1]) / 2
        accelerations = np.diff(speeds, axis=0) / between_s
        assert np.abs(accelerations).max(initial=0) <= 1.05 * kinematics.ACCELERATION_RAD_S2
        for end in (speeds[:1], speeds[-1:]):  # it begins and ends at rest
            assert np.abs(end).max() <= kinematics.ACCELERATION_RAD_S2 * steps_s.max() + 1e-9


def test_nothing_collides_between_the_tested_places(cell, made):
    touch = bare(cell)
    for stage in made[1].stages:
        touching = HOLDS.get(stage.name, (CUTTER, HOLDER))
        for time_s in np.arange(0, stage.seconds, 0.013):
            assert touch.collisions(stage.at(time_s), touching) is None


def test_the_tip_follows_its_path_and_leaves_nothing_out(cell, made):
    plan, motions = made
    tips = {name: [] for name in sweeps(plan)}
    for name, tip in _cutting_tips(cell, motions):
        tips[name].append(tip)
    for name, cut in zip(sweeps(plan), plan.cuts, strict=True):
        fine = [np.linspace(a, b, 20) for a, b in itertools.pairwise(cut.path_mm)]
        places = np.array([tip[:3, 3] for tip in tips[name]])
        assert cKDTree(np.concatenate(fine)).query(places)[0].max() < 0.2
        assert cKDTree(places).query(cut.path_mm)[0].max() < 0.2
        ahead = np.array([tip[:3, 0] for tip in tips[name]])
        if cut.axis is None:  # level
            assert np.abs(ahead[:, 2]).max() < np.sin(np.radians(0.1))
        else:
            assert np.abs(ahead - cut.axis).max() < np.sin(np.radians(0.1))
            # In the order of motion
            assert np.linalg.norm(places[0] - cut.path_mm[0]) < 0.5
            assert np.linalg.norm(places[-1] - cut.path_mm[-1]) < 0.5


def test_the_tip_is_no_faster_than_asked_on_a_cut(cell, made):
    for stage in made[1].stages:
        tips = np.array([cell.tips(joints)[CUTTER][:3, 3] for joints in stage.joints_rad])
        speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / np.diff(stage.times_s)
        cutting = stage.cutting[1:] & stage.cutting[:-1]
        assert (
            speeds[cutting].max(initial=0) <= 1.05 * cell.config.cutting_mm_s
        )  # at grid points alone it is kept
        if cutting.any():
            assert np.median(speeds[cutting]) > 0.9 * cell.config.cutting_mm_s
        # The electrode is as slow wherever it is in the organ.
        joints = stage.joints_rad[1:][speeds > 1.05 * cell.config.cutting_mm_s]
        for each in joints[::5]:
            tip = cell.tips(each)[CUTTER]
            along = tip[:3, 3] - np.outer(np.arange(0.0, 70.0, 2.0), tip[:3, 0])
            assert not contains(cell.organ, along).any()


def test_the_same_every_time(ours):
    plan, motions = ours
    again, same = plan_motions(seen(), OURS, CONFIG)
    assert np.array_equal(again.facets, plan.facets)
    assert np.array_equal(again.grasp_mm, plan.grasp_mm)
    for one, other in zip(motions.stages, same.stages, strict=True):
        assert np.array_equal(one.joints_rad, other.joints_rad)
        assert np.array_equal(one.times_s, other.times_s)


@pytest.mark.parametrize(
    "config", [pytest.param(OURS, marks=pytest.mark.slow), PUBLISHED], ids=["margin", "published"]
)
@pytest.mark.parametrize(
    ("shift_mm", "cell_changes", "names"),
    [
        ((0.0, 2000.0, 0.0), {}, {"holder"}),
        ((0.0, 0.0, -140.0), {}, {"table", "stand", "organ"}),
        ((0.0, 0.0, 0.0), {"cutter_base": FAR}, {CUTTER}),
    ],
)
def test_no_plan_says_what_is_in_the_way(config, shift_mm, cell_changes, names):
    with pytest.raises(NoPlan) as raised:
        plan_motions(seen(shift_mm), config, CellConfig(**cell_changes))
    assert any(name in str(raised.value) for name in names)


# Where the arms begin -----------------------------------------------------------------------------


def middle_of(motions: Motions, number: int, share: float = 0.5) -> np.ndarray:
    """Joints on a cut, so far along it."""
    sweep = next(stage for stage in motions.stages if stage.sweep == number)
    on = np.flatnonzero(sweep.cutting)
    return sweep.joints_rad[on[int(share * len(on))]]


def is_straight_back(cell: ArmCell, joints_rad: np.ndarray, off_mm: float = 0.1) -> bool:
    tips = np.array([cell.tips(each)[CUTTER] for each in joints_rad])
    back, ahead = tips[:, :3, 3] - tips[0, :3, 3], tips[0, :3, 0]
    aside = np.linalg.norm(back - np.outer(back @ ahead, ahead), axis=1).max()
    return bool((back @ ahead < 1e-6).all() and aside < off_mm)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_arms_begin_anew_in_the_middle_of_a_cut(cell, made, share):
    plan, motions = made
    middle = middle_of(motions, 1, share)
    config = OURS if plan.method == "margin" else PUBLISHED
    like = plan if len(plan.facets) else None
    there = seen((0.0, 3.0, 0.0))
    again, later = plan_motions(there, config, CONFIG, Start(middle, 1), like)
    assert [stage.name for stage in later.stages] == [Stage.WITHDRAW, *sweeps(again), *LAST]
    joints = later.stages[0].joints_rad
    assert np.array_equal(joints[0], middle)
    for stage in later.stages[: 1 + again.sweeps]:  # it holds
        assert np.ptp(stage.joints_rad[:, 6:], axis=0).max() == 0
    assert is_straight_back(cell, joints)
    assert not later.stages[0].cutting.any()
    tip = cell.tips(joints[-1])[CUTTER]
    along = tip[:3, 3] - np.outer(np.arange(0.0, 70.0, 1.0), tip[:3, 0])
    assert cKDTree(there.organ.spread_mm(1.0)).query(along)[0].min() > CONFIG.organ_clearance_mm
    assert np.array_equal(again.facets[:, :3], plan.facets[:, :3])
    checked(again, later, body.cell_urdf(CONFIG), there)


def grooved(located: Located, planes: np.ndarray, number: int, kerf_mm: float = 2.4) -> Located:
    """The organ with one facet's kerf."""
    inner, outer = planes.copy(), planes.copy()
    inner[number - 1, 3] -= kerf_mm / 2
    outer[number - 1, 3] += kerf_mm / 2
    whole = solid_of(located.organ, "the organ")
    kerf = trimmed(whole, outer, 0.0) - trimmed(whole, inner, 0.0)
    return replace(located, meshes={**located.meshes, "kidney": mesh_of(whole - kerf)})


def test_what_is_cut_stays_cut_and_the_rest_is_planned_on_the_organ_with_its_groove(ours, cell):
    plan, motions = ours
    first, open_ = sweeps(plan)[0], grooved(seen(), plan.facets, 1)
    end = next(stage for stage in motions.stages if stage.name == first).joints_rad[-1]
    again, later = plan_motions(open_, OURS, CONFIG, Start(end, 2), plan)
    assert [stage.name for stage in later.stages] == [*sweeps(plan)[1:], *LAST]
    assert np.array_equal(again.facets[:, :3], plan.facets[:, :3])
    assert np.array_equal(again.cuts[0].path_mm, plan.cuts[0].path_mm)
    assert np.array_equal(again.grasp_mm, plan.grasp_mm)  # the cup stays where it holds
    assert np.array_equal(again.lift, plan.lift)
    kept = checked(again, later, body.cell_urdf(CONFIG), open_).least_mm["tumor_1"]
    assert kept > OURS.margin_mm - TOLERANCE_MM
    # Its sweep had not ended: there is nothing left to cut of it, and it is gone past at once.
    _, later = plan_motions(open_, OURS, CONFIG, Start(end, 1), plan)
    assert [stage.name for stage in later.stages] == [*sweeps(plan), *LAST]
    assert later.stages[0].seconds == 0
    execution = Execution(later)
    assert (execution.sweep, execution.holds) == (1, True)
    execution.step(0.1)
    assert execution.sweep == 2
    with pytest.raises(NoPlan):  # as nothing holds it, it could be another piece
        plan_motions(open_, OURS, CONFIG, Start(end), plan)


@pytest.mark.slow
def test_a_short_instrument_leaves_an_organ_that_its_grip_touches(monkeypatch):
    config = msgspec.structs.replace(CONFIG, electrode_mm=35.0)
    setting = [(OURS, config, body.cell_urdf(config))]
    monkeypatch.setattr(procedure, "_setting", setting)
    plan, motions = plan_motions(seen(), OURS, config)
    for sweep in range(1, plan.sweeps + 1):
        middle, cell = middle_of(motions, sweep), ArmCell(config)
        there = seen(tuple(-8.0 * cell.tips(middle)[CUTTER][:3, 0]))
        met = ArmCell(config, there.organ).collisions(middle, (CUTTER, HOLDER))
        assert met == ("cutter/pencil", "organ")
        made = procedure.replan(there, middle, ResectionProgress(True, sweep - 1), plan)
        assert made.motions.stages[0].name == Stage.WITHDRAW
        assert is_straight_back(cell, made.motions.stages[0].joints_rad)
        assert np.array_equal(made.plan.facets[:, :3], plan.facets[:, :3])


@pytest.mark.slow
def test_an_instrument_beside_the_cup_is_withdrawn():
    """At work it may come nearer to that than the arms' clearance, so on its way back, too."""
    config = ResectionConfig(tumor="tumor_1", margin_mm=2.0, most_facets=3)
    plan, motions = plan_motions(seen(), config, CONFIG)
    cell = ArmCell(CONFIG)
    beside = [
        (joints, stage.sweep)
        for stage in motions.stages
        for joints in stage.joints_rad[stage.cutting]
        if cell.collisions(joints) == ("cutter/electrode", "holder/cup")
    ]
    joints, number = beside[len(beside) // 2]
    assert cell.collisions(joints, (CUTTER, HOLDER)) is None
    _, again = plan_motions(seen(), config, CONFIG, Start(joints, number), plan)
    assert again.stages[0].name == Stage.WITHDRAW
    assert is_straight_back(cell, again.stages[0].joints_rad)


@pytest.mark.slow
def test_arms_that_do_not_hold_yet_begin_from_wherever_they_are(cell, made):
    plan, motions = made
    config = OURS if plan.method == "margin" else PUBLISHED
    there = seen((0.0, 3.0, 0.0))
    for start, first in (
        (middle_of(motions, 1), [Stage.WITHDRAW, *FIRST]),
        (motions.stages[2].joints_rad[0], FIRST),
        (motions.stages[0].joints_rad[len(motions.stages[0].times_s) // 2], FIRST),
    ):
        again, later = plan_motions(there, config, CONFIG, Start(start))
        assert [stage.name for stage in later.stages] == [*first, *sweeps(again), *LAST]
        assert np.array_equal(later.stages[0].joints_rad[0], start)
        held = cell.tips(later.stages[first.index("hold")].joints_rad[0])[HOLDER]
        assert np.abs(held[:3, 3] - again.grasp_mm).max() < 0.01
        for one, other in itertools.pairwise(later.stages):
            assert np.array_equal(one.joints_rad[-1], other.joints_rad[0])
        checked(again, later, body.cell_urdf(CONFIG), there)


@pytest.mark.parametrize(
    "start",
    [
        Start(np.full(12, 7.0)),
        Start(np.full(12, np.nan)),
        Start(HOME, 0),
        Start(HOME, -1),
        Start(HOME, 99),
    ],
)
def test_starts_that_are_none_are_refused(start):
    with pytest.raises(InputError):
        plan_motions(seen(), PUBLISHED, CONFIG, start)


# The instrument's way -----------------------------------------------------------------------------


def test_an_instrument_goes_back_until_it_is_clear_of_the_organ_and_of_the_cup():
    ball = sphere([0.0, 0.0, 200.0], 20.0, 5)
    cell = ArmCell(CONFIG, ball, {"tumor_1": (ball, 6.0)})
    up, ahead = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    things = [(ball, 0.0), (ball, 6.0)]
    outside = Outside(cell, things, np.array([0.0, 0.0, 220.0]), up)
    room_mm = 6.0 + CONFIG.organ_clearance_mm
    for tip, least_mm in (
        ([0.0, 0.0, 200.0], 20.0 + room_mm),
        ([30.0, 0.0, 200.0], 50.0 + room_mm),  # right through
        ([0.0, 19.0, 200.0], np.sqrt(max((20 + room_mm) ** 2 - 19**2, 0))),
        ([0.0, 0.0, 300.0], CONFIG.cup_radius_mm + CONFIG.clearance_mm),
        ([-60.0, 0.0, 200.0], 0.0),
        ([0.0, 90.0, 200.0], 0.0),
    ):
        far = outside.back_mm(np.array(tip), ahead)
        assert (far == 0) == (least_mm == 0)
        if least_mm:
            assert least_mm < far < least_mm + 8.0
            along = tip - np.outer(np.arange(far, far + CONFIG.electrode_mm, 0.5), ahead)
            assert np.linalg.norm(along - [0, 0, 200], axis=1).min() > 20 + room_mm


def test_a_way_round_is_found_and_the_same_for_the_same_seed(cell):
    holding = next(
        joints
        for joints in _at_tip(cell, HOLDER, [0, 0, 250], 0)
        if cell.collisions(joints) is None
    )
    sides = []
    for y in (-230.0, 230.0):
        found = _at_tip(cell, CUTTER, [30.0, y, 290.0], -np.sign(y) * np.pi / 2, holding)
        sides.append([joints for joints in found if cell.collisions(joints) is None])
    start, goal = min(itertools.product(*sides), key=lambda pair: np.abs(pair[0] - pair[1]).max())
    group = PlanningGroup(cell, CUTTER, start)
    with pytest.raises(Blocked):
        connect(group, goal[:6])  # straight
    ways = [connect(group, goal[:6], np.random.default_rng(7)) for _ in range(2)]
    assert np.array_equal(*ways)
    assert np.array_equal(ways[0][0], start[:6])
    assert np.allclose(ways[0][-1], goal[:6])
    touch = bare(cell)
    for one, other in itertools.pairwise(ways[0]):
        for share in np.linspace(0, 1, 20):
            joints = group.all_joints(one + share * (other - one))
            assert touch.collisions(joints) is None


@pytest.mark.slow
@pytest.mark.parametrize("config", [OURS, PUBLISHED], ids=["margin", "published"])
def test_places_for_the_bases_are_searched(config):
    there = seen((0.0, 150.0, 0.0))
    far = Base(position_mm=(-900.0, -380.0, 150.0), yaw_deg=180.0)
    asked = msgspec.structs.replace(CellConfig(), holder_base=far)
    with refused(NoPlan, "holder"):
        plan_motions(there, config, asked)
    found, plan, motions, note = search_bases(there, config, asked)
    assert found.holder_base != far
    assert f"{found.holder_base.position_mm[0]:g}" in note
    assert [stage.name for stage in motions.stages] == [*FIRST, *sweeps(plan), *LAST]
    tip = ArmCell(found).tips(motions.stages[2].joints_rad[0])[HOLDER]
    assert np.abs(tip[:3, 3] - plan.grasp_mm).max() < 0.01
    checked(plan, motions, body.cell_urdf(found), there)


@pytest.mark.parametrize("shift_mm", [(0.0, 0.0, 0.0), (-20.0, 15.0, 0.0)])
def test_the_cell_that_the_page_shows_plans_from_its_bases(shift_mm):
    page = (Path(__file__).parents[2] / "docs" / "resection.md").read_text(encoding="utf-8")
    (text,) = [block for block in page.split("```") if '"cutter_base"' in block]
    shown = msgspec.json.decode(text.removeprefix("json"), type=CellConfig)
    assert shown.holder_base.position_mm[2] == 0  # on the table
    there = seen(shift_mm)
    found, plan, motions, _ = search_bases(there, OURS, shown)
    assert (found.cutter_base, found.holder_base) == (shown.cutter_base, shown.holder_base)
    checked(plan, motions, body.cell_urdf(found), there)


def test_a_base_out_of_reach_is_blamed_for_that_and_nothing_that_it_would_meet():
    for z_mm in (0.0, 100.0):
        far = Base(position_mm=(3000.0, 0.0, z_mm), yaw_deg=0.0)
        with pytest.raises(NoPlan) as raised:
            plan_motions(seen(), OURS, CellConfig(cutter_base=far))
        assert raised.value.__cause__.pair is None


def test_no_motion_creeps():
    path_rad, speeds_rad_s = CREEPING_MRAD / 1000, np.radians([60.0, 60, 90, 90, 90, 90])
    times_s, joints_rad = trajectory.along(path_rad, speeds_rad_s)
    assert times_s[-1] < 6
    speed = np.abs(np.diff(joints_rad, axis=0)) / np.diff(times_s)[:, None]
    assert (speed <= 1.001 * speeds_rad_s).all()


# What the tips can touch --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "top", "side"),
    [({}, True, True), ({"holder_base": FAR}, False, True), ({"cutter_base": FAR}, True, False)],
)
def test_the_cup_reaches_the_top_and_the_electrode_the_sides(changes, top, side):
    """Of a ball on the post; nothing comes from below."""
    ball = trimesh.creation.icosphere(4, 30.0)
    surface = Mesh(ball.vertices + [0.0, 0, 150], ball.faces)
    config = CellConfig(**changes)
    reach = ArmsReach(config, surface, ArmCell(config).home_rad)
    ways = np.array([[0.0, 0, 1], [1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]])
    middle = np.array([0.0, 0, 150])
    reached = [reach(middle + 30.0 * way, way) for way in ways]
    assert reached == [top, side, side, False]
    assert not reach(middle + [0, 0, 1500.0], ways[0])


def test_tools_that_must_not_touch_the_organ_do_not(made):
    """Only electrode and cup may."""
    found = clearances(body.cell_urdf(CONFIG), made[1], {"kidney": organ()}, ())
    least = {each.solid: each.least_mm for each in found}
    assert least["electrode"] < 0
    assert abs(least["cup"]) < 1.0
    for solid in ("bracket", "pencil"):
        assert least[solid] > CONFIG.organ_clearance_mm / 2
    assert least["rod"] > CONFIG.cup_mm / 2
