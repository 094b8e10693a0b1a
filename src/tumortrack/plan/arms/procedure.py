"""From a resection plan to motions of both arms: approach, grasp, hold, sweeps, release, home."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.types import Mesh
from tumortrack.plan.arms import strokes, timing
from tumortrack.plan.arms.cell import TOUCHES, Cell
from tumortrack.plan.arms.course import Course
from tumortrack.plan.arms.situation import Blocked
from tumortrack.plan.arms.tracks import follow, solve
from tumortrack.plan.arms.transfer import connect
from tumortrack.plan.motions import CUTTER, HOLDER, JOINTS, Motions
from tumortrack.plan.values import ResectionPlan

SETTLE_S = 0.5  # until the vacuum holds
LET_GO_S = 0.3
_ABOVE_MM = 60.0  # the cup comes from here, and goes back
_STEP_MM = 5.0
_GRIPS = 3  # ways of holding that are tried
_HOLDER_YAWS = 12


def plan_motions(
    plan: ResectionPlan,
    cell: Cell,
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
            from 1.

    Raises:
        NoPlan: a place out of reach, or a collision that could not be avoided, and what to do.
        InputError: a start that is none.
    """
    course = _begin(cell, organ, start_rad, seed)
    tissue = strokes.Tissue(plan.layers, organ)
    if from_sweep is not None:
        if start_rad is None:
            raise InputError("from_sweep needs start_rad: where the arms are while one holds.")
        _withdraw(course, tissue, holding=True)
        try:
            return _cut_and_finish(course, plan, tissue, from_sweep)
        except Blocked as blocked:
            raise _no_plan(blocked) from blocked
    _withdraw(course, tissue, holding=False)
    reason: Blocked | None = None
    for n, grip in enumerate(_grips(course, plan.grasp_mm)):
        try:
            held = _grasp(course.copy(), grip)
            return _cut_and_finish(held, plan, tissue, 1)
        except Blocked as blocked:
            reason = reason or blocked
            if n + 1 == _GRIPS or not _in_the_way(blocked):
                break
    raise _no_plan(reason or Blocked("the grasper does not reach the tumor from above"))


def plan_home(
    cell: Cell, organ: Mesh, start_rad: Float64[np.ndarray, " 12"], seed: int = 0
) -> Motions:
    """From anywhere: out of the tissue, let go, and home.

    Raises:
        NoPlan: something is in the way.
    """
    course = _begin(cell, organ, start_rad, seed)
    tissue = strokes.Tissue((), organ)
    try:
        _withdraw(course, tissue, holding=False)
        course.close("release")
        return _home(course)
    except Blocked as blocked:
        raise _no_plan(blocked) from blocked


def _begin(cell: Cell, organ: Mesh, start_rad: np.ndarray | None, seed: int) -> Course:
    cell = cell if cell.organ is organ else cell.with_organ(organ)
    start = cell.home_rad if start_rad is None else np.asarray(start_rad, float)
    if start.shape != (len(JOINTS),) or not (np.abs(start) <= cell.limits_rad).all():
        raise InputError("the arms' start must be twelve joint angles within their limits.")
    return Course(cell, start, np.random.default_rng(seed))


def _no_plan(blocked: Blocked) -> NoPlan:
    return NoPlan(
        f"the arms can't carry this out: {blocked}. Place the arms or the organ otherwise, or plan "
        "with other margins."
    )


def _in_the_way(blocked: Blocked) -> bool:
    """Whether holding otherwise could help."""
    return blocked.pair is None or any(name.startswith(HOLDER) for name in blocked.pair)


# Grasping -----------------------------------------------------------------------------------------


def _down(grasp_mm: np.ndarray, yaw_rad: float) -> np.ndarray:
    """Poses of the cup from above down to where it holds."""
    heights = np.linspace(_ABOVE_MM, 0, int(_ABOVE_MM / _STEP_MM) + 1)
    return strokes.poses(grasp_mm + heights[:, None] * [0.0, 0.0, 1.0], yaw_rad)


def _grips(course: Course, grasp_mm: np.ndarray) -> Iterator[np.ndarray]:
    """Joint paths (n, 6) straight down onto the grasp, those near the arm's present place first.

    Raises:
        Blocked: none at all, and why.
    """
    situation = course.situation(HOLDER, touching=(HOLDER,))
    turns = []
    for yaw in np.linspace(-np.pi, np.pi, _HOLDER_YAWS, endpoint=False):
        for joints in solve(situation, _down(grasp_mm, yaw)[0]):
            off = np.abs(joints - situation.here_rad).max()
            turns.append((float(off), float(yaw), joints))
    reason: Blocked | None = None
    found = False
    for _, yaw, joints in sorted(turns, key=lambda turn: turn[0]):
        try:
            yield follow(situation, _down(grasp_mm, yaw), joints)
            found = True
        except Blocked as blocked:
            reason = reason or blocked
    if not found and reason is not None:
        raise _no_plan(reason)


def _grasp(course: Course, grip_rad: np.ndarray) -> Course:
    """Approach, grasp and hold."""
    situation = course.situation(HOLDER)
    course.go(HOLDER, connect(situation, grip_rad[0], course.rng))
    course.close("approach")
    course.go(HOLDER, grip_rad, tip_mm_s=course.cell.config.grasping_mm_s)
    course.close("grasp")
    course.still(SETTLE_S)
    course.close("hold")
    return course


# Cutting ------------------------------------------------------------------------------------------


def _cut_and_finish(
    course: Course, plan: ResectionPlan, tissue: strokes.Tissue, first: int
) -> Motions:
    for sweep in range(first, plan.sweeps + 1):
        cuts = tuple(cut for cut in plan.cuts if cut.sweep == sweep)
        for one in strokes.passes(cuts):
            _cut(course, one, tissue)
        course.close(f"sweep {sweep}")
    _let_go(course)
    course.close("release")
    return _home(course)


def _cut(course: Course, one: strokes.Pass, tissue: strokes.Tissue) -> None:
    """One pass, from the best direction from which it can be done.

    Raises:
        Blocked: from none; the reason is that of the best one.
    """
    away, inside = course.situation(CUTTER, (HOLDER,)), course.situation(CUTTER, (CUTTER, HOLDER))
    reason: Blocked | None = None
    for yaw in strokes.directions(one, tissue, inside):
        enter, leave = strokes.in_and_out(one, tissue, yaw)
        tips = np.concatenate([enter[:-1], one.points_mm, leave[1:]])
        try:
            path = follow(inside, strokes.poses(tips, yaw))
            way = connect(away, path[0], course.rng)
        except Blocked as blocked:
            reason = reason or blocked
            continue
        a, b = len(enter) - 1, len(enter) - 1 + len(one.points_mm)
        speed = course.cell.config.cutting_mm_s
        course.go(CUTTER, way)
        course.go(CUTTER, path[: a + 1], tip_mm_s=speed)
        for run in strokes.smooth_runs(one.points_mm):
            course.go(CUTTER, path[a:b][run], tip_mm_s=speed, cutting=True)
        course.go(CUTTER, path[b - 1 :], tip_mm_s=speed)
        return
    x, y, z = one.points_mm[0]
    raise reason or Blocked(f"the {CUTTER} does not reach ({x:.0f}, {y:.0f}, {z:.0f}) mm")


# Leaving ------------------------------------------------------------------------------------------


def _withdraw(course: Course, tissue: strokes.Tissue, holding: bool) -> None:
    """Straight back with an instrument that is in tissue or at it, and up with a cup on it."""
    pair = course.cell.collisions(course.joints_rad, (HOLDER,))
    if pair is not None and TOUCHES[CUTTER] in pair:
        tip = course.cell.tips(course.joints_rad)[CUTTER]
        yaw = float(np.arctan2(tip[1, 0], tip[0, 0]))
        _, leave = strokes.in_and_out(strokes.Pass(tip[None, :3, 3]), tissue, yaw)
        course.follow(CUTTER, strokes.poses(leave, yaw), course.cell.config.cutting_mm_s)
    pair = course.cell.collisions(course.joints_rad, (CUTTER,))
    if not holding and pair is not None and TOUCHES[HOLDER] in pair:
        _let_go(course)


def _let_go(course: Course) -> None:
    """Vacuum off, then straight up."""
    course.still(LET_GO_S)
    tip = course.cell.tips(course.joints_rad)[HOLDER]
    yaw = float(np.arctan2(tip[1, 0], tip[0, 0]))
    course.follow(HOLDER, _down(tip[:3, 3], yaw)[::-1], course.cell.config.grasping_mm_s)


def _home(course: Course) -> Motions:
    """Both arms at once: the straight way if it is free."""
    both, home = course.situation(None), course.cell.home_rad
    for place in (both.joints_rad, home):
        if pair := both.collides(place):
            raise Blocked(f"{pair[0]} would meet {pair[1]} on the way home", pair)
    if both.way_collides(both.joints_rad, home) is None:
        course.add(timing.together(both.joints_rad, home, course.cell.speeds_rad_s))
    else:
        way = connect(both, home, course.rng)
        course.add(timing.along(way, course.cell.speeds_rad_s))
    course.close("home")
    return course.motions()
