"""From a resection plan to motions of both arms: approach, grasp, hold, sweeps, lift, release,
home.

Also the worker that replans beside the live loop, in a process of its own.
"""

from __future__ import annotations

import itertools
import signal
from collections.abc import Iterator
from copy import copy

import msgspec
import numpy as np

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.types import Mesh
from tumortrack_resection.arms import cutting
from tumortrack_resection.arms.cell import TOUCHES, ArmCell, Blocked, PlanningGroup
from tumortrack_resection.arms.config import Base, CellConfig
from tumortrack_resection.arms.cutting import Surroundings, level_poses
from tumortrack_resection.arms.kinematics import level_pose, yaw_of
from tumortrack_resection.arms.paths import connect, follow, out_of_reach
from tumortrack_resection.arms.trajectory import TrajectoryBuilder, along, first_hit, together
from tumortrack_resection.motions import (
    ARMS,
    CUTTER,
    HOLD,
    HOLDER,
    JOINTS,
    LIFT,
    PULL,
    RELEASE,
    TAUT,
    Joints,
    Motions,
)
from tumortrack_resection.operation import Planned, ResectionProgress
from tumortrack_resection.resection import plan_resection
from tumortrack_resection.values import Located, ResectionConfig, ResectionPlan

_VACUUM_S = 0.5  # until the cup holds
_LET_GO_S = 0.3
_TAUT_S = 1.0  # until the pulled tumor has been located
_ABOVE_MM = 60.0  # the cup comes from here, and goes back
_STEP_MM = 5.0
_GRIPS = 4  # ways of holding that are tried
# Places of a base round the organ: distance as a share of the arm's reach, and direction (degrees
# from the present one), in the order of trying.
_DISTANCES = (0.65, 0.5, 0.8)
_SIDES_DEG = (0.0, 30.0, -30.0, 60.0, -60.0)
_YAWS = 8  # in which the instrument is asked to reach
_MOST_TRIED = 8  # pairs of places for which motions are planned
_EDGE_MM = 120.0  # a base's middle is no nearer to the table's edge


def plan_motions(
    plan: ResectionPlan,
    cell: ArmCell,
    organ: Mesh,
    start_rad: Joints | None = None,
    from_sweep: int | None = None,
    seed: int = 0,
) -> Motions:
    """Both arms through the whole procedure; the same every time. Raises NoPlan: a place out of
    reach, or a collision that could not be avoided, and what to do; InputError: an invalid start.

    Args:
        organ: the whole organ as it lies now, closed, table frame, mm.
        start_rad: where the arms are (twelve joints), if not at home. An instrument in tissue first
            leaves straight back.
        from_sweep: the grasper holds already and stays where it is; begin with this sweep, counted
            from 1; one more than there are: lift, release and go home.
    """
    cell = cell if cell.organ is organ else ArmCell(cell.config, organ)
    start = cell.home_rad if start_rad is None else np.array(start_rad, float)
    if start.shape != (len(JOINTS),) or not (np.abs(start) <= cell.limits_rad).all():
        raise InputError("the arms' start must be twelve joint angles within their limits.")
    if from_sweep is not None and start_rad is None:
        raise InputError("from_sweep needs start_rad: where the arms are while one holds.")
    builder = TrajectoryBuilder(cell, start, np.random.default_rng(seed))
    around = Surroundings(organ, cell.config, plan)
    try:
        _withdraw(builder, around, holding=from_sweep is not None)
        if from_sweep is not None:
            return _cut_and_finish(builder, plan, around, from_sweep)
        return _grasp_and_cut(builder, plan, around)
    except Blocked as blocked:
        raise NoPlan(
            f"the arms can't carry this out: {blocked}. Place the arms or the organ otherwise, or "
            "plan with other margins."
        ) from blocked


def _grasp_and_cut(
    builder: TrajectoryBuilder, plan: ResectionPlan, around: Surroundings
) -> Motions:
    """By the first grip that leaves the instrument a path; Blocked: the first grip's reason."""
    deep_mm = around.depth_mm(plan.grasp_mm)
    if deep_mm > builder.cell.config.cup_mm:
        raise Blocked(f"the grasp point lies {deep_mm:.0f} mm below the organ's surface")
    reason: Blocked | None = None
    for grip in _grips(builder, plan.grasp_mm):
        try:
            attempt = copy(builder)
            _grasp(attempt, grip)
            return _cut_and_finish(attempt, plan, around, 1)
        except Blocked as blocked:
            reason = reason or blocked
            if blocked.pair and not any(name.startswith(HOLDER) for name in blocked.pair):
                break  # the holder is not in the way
    assert reason is not None
    raise reason


def _lowering(grasp_mm: np.ndarray, yaw_rad: float, above_mm: float = _ABOVE_MM) -> np.ndarray:
    """Poses of the cup from above down to where it holds."""
    heights = np.linspace(above_mm, 0, max(2, int(above_mm / _STEP_MM)) + 1)
    return level_poses(grasp_mm + heights[:, None] * [0.0, 0.0, 1.0], yaw_rad)


def _grips(builder: TrajectoryBuilder, grasp_mm: np.ndarray) -> Iterator[np.ndarray]:
    """Joint paths (n, 6) straight down onto the grasp, those near the arm's present place first;
    Blocked where there is none.

    How the cup is turned does not matter: it is round, and turns about the last joint alone.
    """
    group = builder.group(HOLDER, touching=(HOLDER,))
    poses = _lowering(grasp_mm, yaw_of(builder.tip(HOLDER)))
    starts = group.inverse_kinematics(poses[0])
    if not len(starts):
        raise out_of_reach(group, poses[0])
    reason: Blocked | None = None
    count = 0
    for start in sorted(starts, key=lambda start: np.abs(start - group.current_rad).max()):
        try:
            path = follow(group, poses, start)
        except Blocked as blocked:
            reason = reason or blocked
            continue
        if np.abs(path[0] - start).max() < 1e-6 and count < _GRIPS:
            count += 1
            yield path
    if not count and reason is not None:
        raise reason


def _grasp(builder: TrajectoryBuilder, grip_rad: np.ndarray) -> None:
    """Approach, grasp, hold and pull."""
    builder.go(HOLDER, connect(builder.group(HOLDER), grip_rad[0], builder.rng))
    builder.close("approach")
    builder.go(HOLDER, grip_rad, builder.cell.config.grasping_mm_s)
    builder.close("grasp")
    builder.wait(_VACUUM_S)
    builder.close(HOLD)
    if pull_mm := builder.cell.config.pull_mm:
        _rise(builder, pull_mm, builder.cell.config.cutting_mm_s)
        builder.close(PULL)
        builder.wait(_TAUT_S)
        builder.close(TAUT)


def _cut_and_finish(
    builder: TrajectoryBuilder, plan: ResectionPlan, around: Surroundings, first: int
) -> Motions:
    for sweep in range(first, plan.sweeps + 1):
        for path_mm in cutting.passes(cut for cut in plan.cuts if cut.sweep == sweep):
            cutting.cut_pass(builder, path_mm, around)
        builder.close(f"sweep {sweep}")
    _rise(builder)
    builder.close(LIFT)
    builder.wait(_LET_GO_S)
    builder.close(RELEASE)
    _go_home(builder)
    builder.close("home")
    return Motions(builder.stages)


def _withdraw(builder: TrajectoryBuilder, around: Surroundings, holding: bool) -> None:
    """Straight back with an instrument that is in tissue or at it, and up with a cup on it."""
    pair = builder.cell.collisions(builder.joints_rad, (HOLDER,))
    if pair is not None and TOUCHES[CUTTER] in pair:
        tip = builder.tip(CUTTER)
        yaw = yaw_of(tip)
        leave = cutting.leg(tip[None, :3, 3], yaw, around).leave_mm
        builder.follow(CUTTER, level_poses(leave, yaw), builder.cell.config.cutting_mm_s)
    pair = builder.cell.collisions(builder.joints_rad, (CUTTER,))
    if not holding and pair is not None and TOUCHES[HOLDER] in pair:
        builder.wait(_LET_GO_S)
        _rise(builder)


def _rise(builder: TrajectoryBuilder, by_mm: float = _ABOVE_MM, mm_s: float | None = None) -> None:
    """The holder goes straight up, after the last cut with the piece."""
    tip = builder.tip(HOLDER)
    rising = _lowering(tip[:3, 3], yaw_of(tip), by_mm)[::-1]
    builder.follow(HOLDER, rising, mm_s or builder.cell.config.grasping_mm_s)


def _go_home(builder: TrajectoryBuilder) -> None:
    """Both arms at once: straight in joint space if that is free."""
    both, home, speeds = builder.group(None), builder.cell.home_rad, builder.cell.speeds_rad_s
    for place in (both.joints_rad, home):
        if pair := both.collides(place):
            raise Blocked.by(pair, " on the way home")
    if both.segment_collides(both.joints_rad, home) is None:
        builder.add(together(both.joints_rad, home, speeds))
    else:
        cutter, tip = builder.group(CUTTER), builder.tip(CUTTER)
        corners = [cutting.aside(cutter, tip, *by) for by in cutting.DETOURS_MM]
        detours = [cutter.all_joints(corner)[None] for corner in corners if len(corner)]
        builder.add(along(connect(both, home, builder.rng, detours), speeds))


def search_bases(
    plan: ResectionPlan, config: CellConfig, organ: Mesh, seed: int = 0
) -> tuple[ArmCell, Motions, str]:
    """The motions from where the arms stand, or else from elsewhere round the table; the workcell
    that they are for, with the organ; and a note for the user on what was changed, empty: nothing.

    A small fixed grid of places for both bases, on their pedestals and facing as they do: first
    those within reach of every stroke, near to where the arms stand now; then the first for which
    the whole procedure can be planned. Raises NoPlan: no place will do; the reason is the one for
    the places where the arms stand now."""
    cell = ArmCell(config, organ)
    try:
        return cell, plan_motions(plan, cell, organ, seed=seed), ""
    except NoPlan as failure:
        reason = failure
    for moved in itertools.islice(_reachable_cells(plan, config), _MOST_TRIED):
        cell = ArmCell(moved, organ)
        if cell.collisions(cell.home_rad) is not None:
            continue
        try:
            return cell, plan_motions(plan, cell, organ, seed=seed), _note(moved)
        except NoPlan:
            continue
    raise NoPlan(f"{reason} Other places for the arms round the table were tried in vain.")


def _reachable_cells(plan: ResectionPlan, config: CellConfig) -> Iterator[CellConfig]:
    """Configurations in which both arms reach all they have to, the least change first."""
    # Ends and middles of all strokes
    strokes = np.concatenate([cut.path_mm[[0, len(cut.path_mm) // 2, -1]] for cut in plan.cuts])
    targets = {CUTTER: strokes, HOLDER: plan.grasp_mm[None] + [[0, 0, 0], [0, 0, 60.0]]}
    good = []
    for arm in ARMS:
        places = [
            msgspec.structs.replace(config, **{f"{arm}_base": base})
            for base in _places(config, arm, plan.grasp_mm[:2])
        ]
        good.append([place.base(arm) for place in places if _reaches(place, arm, targets[arm])])
    pairs = itertools.product(*map(enumerate, good))
    for (_, cutter), (_, holder) in sorted(pairs, key=lambda pair: pair[0][0] + pair[1][0]):
        yield msgspec.structs.replace(config, cutter_base=cutter, holder_base=holder)


def _places(config: CellConfig, arm: str, middle_mm: np.ndarray) -> list[Base]:
    """Where this arm could stand on the table, its present place first."""
    now = config.base(arm)
    off = np.array(now.position_mm[:2]) - middle_mm
    facing = np.arctan2(off[1], off[0])
    half = np.array(config.table_mm) / 2 - _EDGE_MM
    bases = [now]
    for side, share in itertools.product(_SIDES_DEG, _DISTANCES):
        angle = facing + np.radians(side)
        far = share * config.model(arm).reach_mm
        x, y = middle_mm + far * np.array([np.cos(angle), np.sin(angle)])
        if abs(x - config.middle_mm[0]) <= half[0] and abs(y - config.middle_mm[1]) <= half[1]:
            place = (round(float(x)), round(float(y)), now.position_mm[2])
            bases.append(Base(position_mm=place, yaw_deg=now.yaw_deg + side))
    return bases


def _reaches(config: CellConfig, arm: str, targets_mm: np.ndarray) -> bool:
    """Whether the arm's tip comes to all its targets, each time pointing in any direction."""
    cell = ArmCell(config)
    group = PlanningGroup(cell, arm, cell.home_rad)
    yaws = np.linspace(0, 2 * np.pi, _YAWS if arm == CUTTER else 1, endpoint=False)
    return all(
        any(len(group.inverse_kinematics(level_pose(target, yaw))) for yaw in yaws)
        for target in targets_mm
    )


def _note(config: CellConfig) -> str:
    places = []
    for arm in ARMS:
        (x, y, z), yaw_deg = config.base(arm).position_mm, config.base(arm).yaw_deg
        places.append(f"{arm}'s base at ({x:g}, {y:g}, {z:g}) mm, turned by {yaw_deg:g} degrees")
    return f"the arms do not manage from where they stand; planned with the {', the '.join(places)}"


_setting: list[tuple[ResectionConfig, ArmCell]] = []  # of the worker


def begin_worker(config: ResectionConfig, cell: CellConfig) -> None:
    """Called once in the new process, which ignores Ctrl-C: the live loop handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _setting.append((config, ArmCell(cell)))


def warm_up() -> None:
    """Loads in the worker what is slow to load."""
    import ruckig  # noqa: F401
    import toppra  # noqa: F401


def replan(located: Located, joints_rad: Joints, progress: ResectionProgress) -> Planned:
    """The plan for the organ as it lies now, from where the arms are; see ``plan_motions``. Raises
    NoPlan: there is none."""
    config, cell = _setting[0]
    plan = plan_resection(located, config)
    organ = located.organ
    from_sweep = progress.first_sweep(plan, located.meshes[plan.tumor])
    motions = plan_motions(plan, cell, organ, start_rad=joints_rad, from_sweep=from_sweep)
    if hit := first_hit(motions, cell.config, organ, begun=True):
        raise NoPlan(f"the arms can't carry this out: {hit}")
    planned = Planned(plan, located.meshes, motions)
    _ = planned.kept_mm  # computed here, as it takes time
    return planned
