"""From a resection plan to motions of both arms: approach, grasp, hold, sweeps, release, home."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.types import Mesh
from tumortrack.plan.arms.cell import TOUCHES, ArmCell, Blocked
from tumortrack.plan.arms.cutting import DETOURS_MM, aside, cut_pass
from tumortrack.plan.arms.kinematics import yaw_of
from tumortrack.plan.arms.paths import connect, follow, out_of_reach
from tumortrack.plan.arms.strokes import Surroundings, leg, level_poses, passes
from tumortrack.plan.arms.trajectory import TrajectoryBuilder, along, together
from tumortrack.plan.motions import CUTTER, HOLDER, JOINTS, Joints, Motions
from tumortrack.plan.values import ResectionPlan

_SETTLE_S = 0.5  # until the vacuum holds
_LET_GO_S = 0.3
_ABOVE_MM = 60.0  # the cup comes from here, and goes back
_STEP_MM = 5.0
_GRIPS = 4  # ways of holding that are tried


def plan_motions(
    plan: ResectionPlan,
    cell: ArmCell,
    organ: Mesh,
    start_rad: Joints | None = None,
    from_sweep: int | None = None,
    seed: int = 0,
) -> Motions:
    """Both arms through the whole procedure; the same every time.

    Args:
        organ: the whole organ as it lies now, closed, table frame, mm.
        start_rad: where the arms are (twelve joints), if not at home. An instrument in tissue first
            leaves straight back.
        from_sweep: the grasper holds already and stays where it is; begin with this sweep, counted
            from 1; one more than there are: release and go home.

    Raises:
        NoPlan: a place out of reach, or a collision that could not be avoided, and what to do.
        InputError: an invalid start.
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
    """By whichever grip leaves the instrument its path; the reason is the first grip's."""
    deep_mm = around.depth_mm(plan.grasp_mm)
    if deep_mm > builder.cell.config.cup_mm:
        raise Blocked(f"the grasp point lies {deep_mm:.0f} mm below the organ's surface")
    reason: Blocked | None = None
    for grip in _grips(builder, plan.grasp_mm):
        try:
            return _cut_and_finish(_grasp(builder.copy(), grip), plan, around, 1)
        except Blocked as blocked:
            reason = reason or blocked
            if blocked.pair and not any(name.startswith(HOLDER) for name in blocked.pair):
                break  # the holder is not in the way
    assert reason is not None
    raise reason


def _lowering(grasp_mm: np.ndarray, yaw_rad: float) -> np.ndarray:
    """Poses of the cup from above down to where it holds."""
    heights = np.linspace(_ABOVE_MM, 0, int(_ABOVE_MM / _STEP_MM) + 1)
    return level_poses(grasp_mm + heights[:, None] * [0.0, 0.0, 1.0], yaw_rad)


def _grips(builder: TrajectoryBuilder, grasp_mm: np.ndarray) -> Iterator[np.ndarray]:
    """Joint paths (n, 6) straight down onto the grasp, those near the arm's present place first.

    How the cup is turned does not matter: it is round, and turns about the last joint alone.

    Raises:
        Blocked: none at all, and why.
    """
    group = builder.group(HOLDER, touching=(HOLDER,))
    poses = _lowering(grasp_mm, yaw_of(builder.tip(HOLDER)))
    starts = group.inverse_kinematics(poses[0])
    if not len(starts):
        raise out_of_reach(group, poses[0])
    reason: Blocked | None = None
    found = 0
    for start in sorted(starts, key=lambda start: np.abs(start - group.current_rad).max()):
        try:
            path = follow(group, poses, start)
        except Blocked as blocked:
            reason = reason or blocked
            continue
        if np.abs(path[0] - start).max() < 1e-6 and found < _GRIPS:
            found += 1
            yield path
    if not found and reason is not None:
        raise reason


def _grasp(builder: TrajectoryBuilder, grip_rad: np.ndarray) -> TrajectoryBuilder:
    """Approach, grasp and hold."""
    builder.go(HOLDER, connect(builder.group(HOLDER), grip_rad[0], builder.rng))
    builder.close("approach")
    builder.go(HOLDER, grip_rad, builder.cell.config.grasping_mm_s)
    builder.close("grasp")
    builder.wait(_SETTLE_S)
    builder.close("hold")
    return builder


def _cut_and_finish(
    builder: TrajectoryBuilder, plan: ResectionPlan, around: Surroundings, first: int
) -> Motions:
    for sweep in range(first, plan.sweeps + 1):
        for path_mm in passes(tuple(cut for cut in plan.cuts if cut.sweep == sweep)):
            cut_pass(builder, path_mm, around)
        builder.close(f"sweep {sweep}")
    _let_go(builder)
    builder.close("release")
    return _home(builder)


def _withdraw(builder: TrajectoryBuilder, around: Surroundings, holding: bool) -> None:
    """Straight back with an instrument that is in tissue or at it, and up with a cup on it."""
    pair = builder.cell.collisions(builder.joints_rad, (HOLDER,))
    if pair is not None and TOUCHES[CUTTER] in pair:
        tip = builder.tip(CUTTER)
        yaw = yaw_of(tip)
        leave = leg(tip[None, :3, 3], yaw, around).leave_mm
        builder.follow(CUTTER, level_poses(leave, yaw), builder.cell.config.cutting_mm_s)
    pair = builder.cell.collisions(builder.joints_rad, (CUTTER,))
    if not holding and pair is not None and TOUCHES[HOLDER] in pair:
        _let_go(builder)


def _let_go(builder: TrajectoryBuilder) -> None:
    """Vacuum off, then straight up."""
    builder.wait(_LET_GO_S)
    tip = builder.tip(HOLDER)
    rising = _lowering(tip[:3, 3], yaw_of(tip))[::-1]
    builder.follow(HOLDER, rising, builder.cell.config.grasping_mm_s)


def _home(builder: TrajectoryBuilder) -> Motions:
    """Both arms at once: straight in joint space if that is free."""
    both, home, speeds = builder.group(None), builder.cell.home_rad, builder.cell.speeds_rad_s
    for place in (both.joints_rad, home):
        if pair := both.collides(place):
            raise Blocked.by(pair, " on the way home")
    if both.segment_collides(both.joints_rad, home) is None:
        builder.add(together(both.joints_rad, home, speeds))
    else:
        cutter, tip = builder.group(CUTTER), builder.tip(CUTTER)
        corners = [aside(cutter, tip, *by) for by in DETOURS_MM]
        detours = [cutter.all_joints(corner)[None] for corner in corners if len(corner)]
        builder.add(along(connect(both, home, builder.rng, detours), speeds))
    builder.close("home")
    return builder.motions()
