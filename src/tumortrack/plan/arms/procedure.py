"""From a resection plan to motions of both arms: approach, grasp, hold, sweeps, release, home."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.types import Mesh
from tumortrack.plan.arms import timing
from tumortrack.plan.arms.cell import TOUCHES, ArmCell
from tumortrack.plan.arms.cutting import DETOURS_MM, aside, cut_pass
from tumortrack.plan.arms.situation import Blocked
from tumortrack.plan.arms.strokes import Surroundings, leg, level_poses, passes
from tumortrack.plan.arms.tracks import follow, solve
from tumortrack.plan.arms.trajectory import TrajectoryBuilder
from tumortrack.plan.arms.transfer import connect
from tumortrack.plan.motions import CUTTER, HOLDER, JOINTS, Motions
from tumortrack.plan.values import ResectionPlan

SETTLE_S = 0.5  # until the vacuum holds
LET_GO_S = 0.3
_ABOVE_MM = 60.0  # the cup comes from here, and goes back
_STEP_MM = 5.0
_GRIPS = 4  # ways of holding that are tried


def plan_motions(
    plan: ResectionPlan,
    cell: ArmCell,
    organ: Mesh,
    start_rad: Float64[np.ndarray, " 12"] | None = None,
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
        InputError: a start that is none.
    """
    course = _begin(cell, organ, start_rad, seed)
    around = Surroundings(organ, course.cell.config, plan)
    try:
        if from_sweep is not None:
            if start_rad is None:
                raise InputError("from_sweep needs start_rad: where the arms are while one holds.")
            _withdraw(course, around, holding=True)
            return _cut_and_finish(course, plan, around, from_sweep)
        _withdraw(course, around, holding=False)
        return _grasp_and_cut(course, plan, around)
    except Blocked as blocked:
        raise NoPlan(
            f"the arms can't carry this out: {blocked}. Place the arms or the organ otherwise, or "
            "plan with other margins."
        ) from blocked


def plan_home(
    cell: ArmCell, organ: Mesh, start_rad: Float64[np.ndarray, " 12"], seed: int = 0
) -> Motions:
    """From anywhere: out of the tissue, let go, and home.

    Raises:
        NoPlan: something is in the way.
    """
    course = _begin(cell, organ, start_rad, seed)
    try:
        _withdraw(course, Surroundings(organ, course.cell.config), holding=False)
        course.close("release")
        return _home(course)
    except Blocked as blocked:
        raise NoPlan(f"the arms can't go home by themselves: {blocked}.") from blocked


def _begin(
    cell: ArmCell, organ: Mesh, start_rad: np.ndarray | None, seed: int
) -> TrajectoryBuilder:
    cell = cell if cell.organ is organ else cell.with_organ(organ)
    start = cell.home_rad if start_rad is None else np.array(start_rad, float)
    if start.shape != (len(JOINTS),) or not (np.abs(start) <= cell.limits_rad).all():
        raise InputError("the arms' start must be twelve joint angles within their limits.")
    return TrajectoryBuilder(cell, start, np.random.default_rng(seed))


def _grasp_and_cut(course: TrajectoryBuilder, plan: ResectionPlan, around: Surroundings) -> Motions:
    """With whichever way of holding leaves the instrument its way; the reason is the first's."""
    deep_mm = around.depth_mm(plan.grasp_mm)
    if deep_mm > course.cell.config.cup_mm:
        raise Blocked(f"the grasp point lies {deep_mm:.0f} mm below the organ's surface")
    reason: Blocked | None = None
    for grip in _grips(course, plan.grasp_mm):
        try:
            return _cut_and_finish(_grasp(course.copy(), grip), plan, around, 1)
        except Blocked as blocked:
            reason = reason or blocked
            if blocked.pair and not any(name.startswith(HOLDER) for name in blocked.pair):
                break  # the holder is not in the way
    assert reason is not None
    raise reason


def _down(grasp_mm: np.ndarray, yaw_rad: float) -> np.ndarray:
    """Poses of the cup from above down to where it holds."""
    heights = np.linspace(_ABOVE_MM, 0, int(_ABOVE_MM / _STEP_MM) + 1)
    return level_poses(grasp_mm + heights[:, None] * [0.0, 0.0, 1.0], yaw_rad)


def _grips(course: TrajectoryBuilder, grasp_mm: np.ndarray) -> Iterator[np.ndarray]:
    """Joint paths (n, 6) straight down onto the grasp, those near the arm's present place first.

    How the cup is turned does not matter: it is round, and turns about the last joint alone.

    Raises:
        Blocked: none at all, and why.
    """
    situation = course.situation(HOLDER, touching=(HOLDER,))
    tip = course.cell.tips(course.joints_rad)[HOLDER]
    poses = _down(grasp_mm, float(np.arctan2(tip[1, 0], tip[0, 0])))
    starts = solve(situation, poses[0])
    if not len(starts):
        x, y, z = poses[0][:3, 3]
        raise Blocked(f"the {HOLDER} does not reach ({x:.0f}, {y:.0f}, {z:.0f}) mm")
    reason: Blocked | None = None
    found = 0
    for start in sorted(starts, key=lambda start: np.abs(start - situation.here_rad).max()):
        try:
            path = follow(situation, poses, start)
        except Blocked as blocked:
            reason = reason or blocked
            continue
        if np.abs(path[0] - start).max() < 1e-6 and found < _GRIPS:
            found += 1
            yield path
    if not found and reason is not None:
        raise reason


def _grasp(course: TrajectoryBuilder, grip_rad: np.ndarray) -> TrajectoryBuilder:
    """Approach, grasp and hold."""
    course.go(HOLDER, connect(course.situation(HOLDER), grip_rad[0], course.rng))
    course.close("approach")
    course.go(HOLDER, grip_rad, course.cell.config.grasping_mm_s)
    course.close("grasp")
    course.still(SETTLE_S)
    course.close("hold")
    return course


def _cut_and_finish(
    course: TrajectoryBuilder, plan: ResectionPlan, around: Surroundings, first: int
) -> Motions:
    for sweep in range(first, plan.sweeps + 1):
        for way in passes(tuple(cut for cut in plan.cuts if cut.sweep == sweep)):
            cut_pass(course, way, around)
        course.close(f"sweep {sweep}")
    _let_go(course)
    course.close("release")
    return _home(course)


def _withdraw(course: TrajectoryBuilder, around: Surroundings, holding: bool) -> None:
    """Straight back with an instrument that is in tissue or at it, and up with a cup on it."""
    pair = course.cell.collisions(course.joints_rad, (HOLDER,))
    if pair is not None and TOUCHES[CUTTER] in pair:
        tip = course.cell.tips(course.joints_rad)[CUTTER]
        yaw = float(np.arctan2(tip[1, 0], tip[0, 0]))
        leave = leg(tip[None, :3, 3], yaw, around).leave_mm
        course.follow(CUTTER, level_poses(leave, yaw), course.cell.config.cutting_mm_s)
    pair = course.cell.collisions(course.joints_rad, (CUTTER,))
    if not holding and pair is not None and TOUCHES[HOLDER] in pair:
        _let_go(course)


def _let_go(course: TrajectoryBuilder) -> None:
    """Vacuum off, then straight up."""
    course.still(LET_GO_S)
    tip = course.cell.tips(course.joints_rad)[HOLDER]
    yaw = float(np.arctan2(tip[1, 0], tip[0, 0]))
    course.follow(HOLDER, _down(tip[:3, 3], yaw)[::-1], course.cell.config.grasping_mm_s)


def _home(course: TrajectoryBuilder) -> Motions:
    """Both arms at once: the straight way if it is free."""
    both, home = course.situation(None), course.cell.home_rad
    for place in (both.joints_rad, home):
        if pair := both.collides(place):
            raise Blocked(f"{pair[0]} would meet {pair[1]} on the way home", pair)
    if both.way_collides(both.joints_rad, home) is None:
        course.add(timing.together(both.joints_rad, home, course.cell.speeds_rad_s))
    else:
        cutter = course.situation(CUTTER)
        tip = course.cell.tips(course.joints_rad)[CUTTER]
        corners = [aside(cutter, tip, *by) for by in DETOURS_MM]
        detours = [cutter.whole(corner)[None] for corner in corners if len(corner)]
        way = connect(both, home, course.rng, detours)
        course.add(timing.along(way, course.cell.speeds_rad_s))
    course.close("home")
    return course.motions()
