"""Kinematics, collisions and motions of both arms."""

import itertools
import xml.etree.ElementTree as ET
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from arm_objects import CREEPING_MRAD, bare, flange_pose, nearest_mm, organ, plan
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack_resection.arms import body, kinematics, trajectory
from tumortrack_resection.arms.cell import ArmCell, Blocked, PlanningGroup
from tumortrack_resection.arms.config import Base, CellConfig
from tumortrack_resection.arms.paths import connect
from tumortrack_resection.arms.procedure import plan_motions, search_bases
from tumortrack_resection.arms.reach import ArmsReach
from tumortrack_resection.motions import CUTTER, HOLDER, JOINTS
from tumortrack_resection.values import Cut

MODELS = pytest.mark.parametrize("model", kinematics.MODELS.values(), ids=lambda model: model.name)
HOLDING = ("grasp", "hold", "lift", "release")
HOLDS = {"approach": (), "home": ()} | dict.fromkeys(HOLDING, (HOLDER,))
LAST = ["lift", "release", "home"]


@pytest.fixture(scope="module")
def cell():
    return ArmCell(organ=organ())


@pytest.fixture(scope="module")
def motions(cell):
    return plan_motions(plan(), cell, cell.organ)


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


@MODELS
def test_the_description_s_kinematics_are_the_maker_s_numbers(model):
    import pinocchio as pin

    built = pin.buildModelFromXML(body.cell_urdf(CellConfig(cutter_model=model.name)))
    data = built.createData()
    base, flange = (built.getFrameId(f"cutter_{link}") for link in ("base_link", "flange"))
    for joints in np.random.default_rng(1).uniform(-np.pi, np.pi, (50, 6)):
        plain = flange_pose(model, joints)
        plain[:3, 3] /= 1000
        pin.framesForwardKinematics(built, data, np.r_[joints, np.zeros(6)])
        found = data.oMf[base].inverse() * data.oMf[flange]
        assert np.abs(found.homogeneous - plain).max() < 1e-9


@MODELS
def test_an_arm_stretched_out_reaches_what_its_lengths_add_up_to(model):
    flange = flange_pose(model, np.zeros(6))
    assert flange[0, 3] == pytest.approx(model.a_mm[1] + model.a_mm[2])
    assert abs(flange[0, 3]) == pytest.approx(model.reach_mm, rel=0.1)


def test_turns_by_whole_turns_stay_within_limits():
    rng = np.random.default_rng(3)
    joints, near = rng.uniform(-np.pi, np.pi, (50, 6)), rng.uniform(-6, 6, 6)
    turned = kinematics.nearest_turn(kinematics.UR5, joints, near)
    assert (np.abs(turned) <= kinematics.UR5.limits_rad).all()
    assert np.allclose(np.exp(1j * turned), np.exp(1j * joints))
    assert (np.abs(turned - near)[:, :2] <= np.abs(joints - near)[:, :2] + 1e-9).all()


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


def test_shapes_are_made_once_and_end_where_the_tips_are(cell):
    joints = cell.home_rad + 0.1
    shapes = {shape.name: shape for shape in cell.shapes(joints)}
    assert len(shapes) == len(cell.shapes(joints))
    again = {shape.name: shape for shape in cell.shapes(cell.home_rad)}
    assert all(again[name].mesh is shape.mesh for name, shape in shapes.items())
    assert {"table", "stand", "cutter/forearm", "holder/cup"} <= set(shapes)
    for arm, part in ((CUTTER, "cutter/electrode"), (HOLDER, "holder/cup")):
        shape = shapes[part]
        points = transform_points(shape.published_from_shape, shape.mesh.vertices_mm)
        off = np.linalg.norm(points - cell.tips(joints)[arm][:3, 3], axis=1)
        assert off.min() < 1e-6
        assert shape.mesh.volume_mm3 > 0


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


def test_clearances_agree_with_distances(cell):
    rng, seen, touch = np.random.default_rng(5), set(), bare(cell)
    for joints in cell.home_rad + rng.normal(0, 0.25, (80, 12)):
        met, near = touch.collisions(joints), cell.collisions(joints)
        distance_mm = nearest_mm(cell, joints)
        assert (met is not None) == (distance_mm <= 1e-6)
        if distance_mm > cell.config.clearance_mm + 0.01:
            assert near is None
        elif distance_mm < cell.config.organ_clearance_mm - 0.01:
            assert near is not None
        seen.add((met is None, near is None))
    assert seen == {(True, True), (True, False), (False, False)}


@pytest.mark.parametrize(
    ("touching", "least_mm"), [((), 3.0), ((HOLDER,), 3.0), ((CUTTER, HOLDER), 1.5)]
)
def test_between_two_places_it_is_tested_as_densely_as_the_least_clearance_asks(
    cell, monkeypatch, touching, least_mm
):
    """While both tools work, electrode and cup may come to 1.5 mm, and are tested every 3 mm."""
    start, tested = cell.home_rad, []
    goal = start[:6] + 0.1
    group = PlanningGroup(cell, CUTTER, start, touching)
    monkeypatch.setattr(PlanningGroup, "collides", lambda _, joints: tested.append(joints))
    assert group.segment_collides(start[:6], goal) is None
    places = sorted([start[:6], *tested, goal], key=lambda joints: joints[0])
    levers_mm = cell.levers_mm(start, group.all_joints(goal))[:6]
    assert (np.diff(places, axis=0) @ levers_mm).max() <= 2 * least_mm
    assert (np.diff(places, axis=0) @ levers_mm).max() > 1.9 * least_mm


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


def test_the_procedure_has_its_stages_without_gaps(cell, motions):
    names = [stage.name for stage in motions.stages]
    assert names == ["approach", "grasp", "hold", "sweep 1", "sweep 2", "lift", "release", "home"]
    assert np.array_equal(motions.stages[0].joints_rad[0], cell.home_rad)
    assert np.allclose(motions.stages[-1].joints_rad[-1], cell.home_rad, atol=1e-9)
    for one, other in itertools.pairwise(motions.stages):
        assert np.array_equal(one.joints_rad[-1], other.joints_rad[0])
    held = cell.tips(motions.stages[2].joints_rad[0])[HOLDER]
    assert np.abs(held[:3, 3] - plan().grasp_mm).max() < 0.01
    assert held[2, 2] == pytest.approx(1.0)


def test_joints_keep_their_limits(cell, motions):
    for stage in motions.stages:
        assert (np.abs(stage.joints_rad) <= cell.limits_rad).all()
        steps_s = np.diff(stage.times_s)[:, None]
        speeds = np.diff(stage.joints_rad, axis=0) / steps_s
        assert (np.abs(speeds) <= 1.01 * cell.speeds_rad_s).all()
        between_s = (steps_s[1:] + steps_s[:-1]) / 2
        accelerations = np.diff(speeds, axis=0) / between_s
        assert np.abs(accelerations).max(initial=0) <= 1.05 * kinematics.ACCELERATION_RAD_S2
        for end in (speeds[:1], speeds[-1:]):  # it begins and ends at rest
            assert np.abs(end).max() <= kinematics.ACCELERATION_RAD_S2 * steps_s.max() + 1e-9


def test_nothing_collides_between_the_tested_places(cell, motions):
    touch = bare(cell)
    for stage in motions.stages:
        touching = HOLDS.get(stage.name, (CUTTER, HOLDER))
        for time_s in np.arange(0, stage.seconds, 0.013):
            assert touch.collisions(stage.at(time_s), touching) is None


def test_the_instrument_is_level_and_on_its_path(cell, motions):
    paths = {f"sweep {cut.sweep}": cut.path_mm for cut in plan().cuts}
    fine = {
        name: np.concatenate([np.linspace(a, b, 20) for a, b in itertools.pairwise(path)])
        for name, path in paths.items()
    }
    trees = {name: cKDTree(points) for name, points in fine.items()}
    tips = {name: [] for name in paths}
    for name, tip in _cutting_tips(cell, motions):
        assert abs(tip[2, 0]) < np.sin(np.radians(0.1))
        assert tip[2, 2] > np.cos(np.radians(0.1))
        assert trees[name].query(tip[:3, 3])[0] < 0.2
        tips[name].append(tip[:3, 3])
    for name, path in paths.items():
        assert cKDTree(np.array(tips[name])).query(path)[0].max() < 0.2  # nothing is left out


def test_the_tip_is_no_faster_than_asked_on_a_cut(cell, motions):
    for stage in motions.stages:
        tips = np.array([cell.tips(joints)[CUTTER][:3, 3] for joints in stage.joints_rad])
        speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / np.diff(stage.times_s)
        cutting = stage.cutting[1:] & stage.cutting[:-1]
        assert speeds[cutting].max(initial=0) <= 1.01 * cell.config.cutting_mm_s
        if cutting.any():
            assert np.median(speeds[cutting]) > 0.9 * cell.config.cutting_mm_s


def test_both_arms_go_home_together(cell, motions):
    joints = motions.stages[-1].joints_rad
    turns = joints[-1] - joints[0]
    moving = np.abs(turns) > 1e-3
    assert moving[:6].any()
    assert moving[6:].any()
    share = (joints - joints[0])[:, moving] / turns[moving]
    assert np.ptp(share, axis=1).max() < 1e-6
    assert (np.diff(share[:, 0]) > 0).all()


def test_the_same_every_time(motions):
    again = plan_motions(plan(), ArmCell(), organ())
    for one, other in zip(motions.stages, again.stages, strict=True):
        assert np.array_equal(one.joints_rad, other.joints_rad)
        assert np.array_equal(one.times_s, other.times_s)


@pytest.mark.slow
def test_a_cut_round_the_cup_is_made_from_several_sides(cell):
    ring = plan()
    above = ring.cuts[0].path_mm + [0.0, 0.0, 8.0 + ring.grasp_mm[2] - ring.cuts[0].height_mm]
    motions = plan_motions(replace(ring, cuts=(Cut(1, above),)), cell, cell.organ)
    sweep = motions.stages[3]
    begins = np.flatnonzero(np.diff(sweep.cutting.astype(int)) == 1)
    assert len(begins) >= 2
    tips = np.array([tip[:3, 3] for _, tip in _cutting_tips(cell, motions)])
    assert cKDTree(tips).query(above)[0].max() < 0.2
    touch = bare(cell)
    for time_s in np.arange(0, sweep.seconds, 0.03):
        assert touch.collisions(sweep.at(time_s), (CUTTER, HOLDER)) is None


@pytest.mark.parametrize(
    ("altered", "message"),
    [
        (lambda p: replace(p, grasp_mm=p.grasp_mm + [0, 2000, 0]), "holder does not reach"),
        (lambda p: replace(p, grasp_mm=p.grasp_mm - [12, 8, 25]), "below the organ's surface"),
        (
            lambda p: replace(p, cuts=(Cut(1, p.cuts[0].path_mm - [0, 0, 138]),)),
            "cutter/.* would meet (table|stand)",
        ),
    ],
)
def test_no_plan_says_why(cell, altered, message):
    with pytest.raises(NoPlan, match=message):
        plan_motions(altered(plan()), cell, cell.organ)


def test_arms_begin_anew_in_the_middle_of_a_cut(cell, motions):
    sweep = motions.stages[3]
    middle = sweep.joints_rad[np.flatnonzero(sweep.cutting)[200]]
    anew = plan_motions(plan((0, 3, 0)), cell, organ((0, 3, 0)), middle, from_sweep=1)
    assert [stage.name for stage in anew.stages] == ["sweep 1", "sweep 2", *LAST]
    joints = anew.stages[0].joints_rad
    assert np.array_equal(joints[0], middle)
    assert np.array_equal(joints[:, 6:], np.repeat(middle[None, 6:], len(joints), 0))  # it holds
    tips = [cell.tips(each)[CUTTER] for each in joints[:100]]
    back = np.array([tip[:3, 3] for tip in tips]) - tips[0][:3, 3]
    ahead = tips[0][:3, 0]
    assert (back @ ahead < 1e-6).all()
    assert np.abs(back - np.outer(back @ ahead, ahead)).max() < 0.1  # straight back
    whole = plan_motions(plan((0, 3, 0)), cell, organ((0, 3, 0)), middle)
    assert [stage.name for stage in whole.stages] == [stage.name for stage in motions.stages]
    assert np.array_equal(whole.stages[0].joints_rad[0], middle)  # both withdraw first
    only = plan_motions(plan(), cell, cell.organ, motions.stages[5].joints_rad[0], from_sweep=3)
    assert [stage.name for stage in only.stages] == LAST


@pytest.mark.parametrize("turn_rad", [2e-6, 1e-4, 0.1, 3.0])
def test_ways_of_any_length_are_timed(turn_rad):
    path = np.linspace(np.zeros(6), turn_rad * np.arange(1, 7) / 6, 3)
    for times, joints in (
        trajectory.along(path, np.ones(6)),
        trajectory.together(path[0], path[-1], np.ones(6)),
    ):
        assert (np.diff(times) > 0).all()
        assert np.allclose(joints[[0, -1]], path[[0, -1]], atol=1e-9)


def test_starts_that_are_none_are_refused(cell):
    with pytest.raises(InputError, match="start_rad"):
        plan_motions(plan(), cell, cell.organ, from_sweep=1)
    with pytest.raises(InputError, match="within their limits"):
        plan_motions(plan(), cell, cell.organ, np.full(12, 7.0))


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
    with pytest.raises(Blocked, match="on the way"):
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
def test_places_for_the_bases_are_searched():
    shift = (0.0, 150.0, 0.0)
    far = Base(position_mm=(-900.0, -380.0, 150.0), yaw_deg=180.0)
    config = msgspec.structs.replace(CellConfig(), holder_base=far)
    with pytest.raises(NoPlan, match="does not reach"):
        plan_motions(plan(shift), ArmCell(config), organ(shift))
    cell, motions, message = search_bases(plan(shift), config, organ(shift))
    assert cell.config.holder_base != far
    assert f"{cell.config.holder_base.position_mm[0]:g}" in message
    assert motions.stages[-1].name == "home"
    tip = cell.tips(motions.stages[2].joints_rad[0])[HOLDER]
    assert np.abs(tip[:3, 3] - plan(shift).grasp_mm).max() < 0.01
    same, _, nothing = search_bases(plan(), CellConfig(), organ())
    assert (same.config, nothing) == (CellConfig(), "")


def test_no_motion_creeps(monkeypatch):
    path_rad, speeds_rad_s = CREEPING_MRAD / 1000, np.radians([60.0, 60, 90, 90, 90, 90])
    times_s, joints_rad = trajectory.along(path_rad, speeds_rad_s)
    assert times_s[-1] < 4
    speed = np.abs(np.diff(joints_rad, axis=0)) / np.diff(times_s)[:, None]
    assert (speed <= 1.001 * speeds_rad_s).all()
    monkeypatch.setattr(trajectory, "_FINER", (1.0,))
    assert trajectory.along(path_rad, speeds_rad_s)[0][-1] > 100  # else this path shows nothing


# What the tips can touch --------------------------------------------------------------------------

FAR = Base(position_mm=(3000.0, 0.0, 100.0), yaw_deg=0.0)


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


def test_what_stands_in_the_way_is_not_reached():
    surface = organ()
    place = surface.vertices_mm[surface.vertices_mm[:, 2].argmax()]
    up = np.array([0.0, 0, 1])
    free, cell = CellConfig(), ArmCell(CellConfig())
    assert ArmsReach(free, surface, cell.home_rad)(place, up)
    there = _at_tip(cell, CUTTER, place + [0, 0, 60.0], 0.0)[0]  # the instrument hangs over it
    assert not ArmsReach(free, surface, there)(place, up)
