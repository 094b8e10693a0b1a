"""A pass of the instrument: from which sides, and the motions."""

from __future__ import annotations

from collections import Counter

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.arms.cell import Blocked, PlanningGroup
from tumortrack.plan.arms.kinematics import Pose, level_pose, yaw_of
from tumortrack.plan.arms.paths import connect, follow
from tumortrack.plan.arms.strokes import Leg, Surroundings, leg
from tumortrack.plan.arms.trajectory import TrajectoryBuilder
from tumortrack.plan.motions import CUTTER, HOLDER

_YAWS = 24
_PROBE_STEP = 3  # every so many points of a pass, directions are compared
_TISSUE_BIN_MM = 3.0  # differences in cut tissue below this do not count
_MOST_LEGS = 8  # of a pass
_FAR_RAD = 2.0  # the arm turns a joint farther than that only if nothing else is possible
_SEARCHED = 4  # directions for which a path is searched at length
# Between passes the tip may go back and up first, mm: what most often is free
DETOURS_MM = ((60.0, 0.0), (0.0, 70.0), (60.0, 70.0), (0.0, 140.0))


def cut_pass(
    builder: TrajectoryBuilder, path_mm: Float64[np.ndarray, "n 3"], around: Surroundings
) -> None:
    """The instrument along a pass: in one direction throughout if that is possible, else in as few
    legs as are; between them it leaves and comes from another side.

    Raises:
        Blocked: no direction is possible somewhere; the reason is the most frequent one.
    """
    for _ in range(_MOST_LEGS):
        done = _cut_leg(builder, path_mm, around)
        if done == len(path_mm) - 1:
            return
        path_mm = path_mm[done:]
    raise Blocked(f"a cut would need more than {_MOST_LEGS} directions of the {CUTTER}")


def _cut_leg(builder: TrajectoryBuilder, path_mm: np.ndarray, around: Surroundings) -> int:
    """The first leg, as long as it can be; returns the number of the point where it ended."""
    away, inside = builder.group(CUTTER, (HOLDER,)), builder.group(CUTTER, (CUTTER, HOLDER))
    reasons: list[Blocked] = []
    later: list[tuple[float, Leg, np.ndarray]] = []
    for yaw, last in _directions(path_mm, around, inside):
        one = leg(path_mm[: last + 1], yaw, around)
        try:
            joints = follow(inside, one.poses)
            turn = float(np.abs(joints[0] - away.current_rad).max())
            later.append((turn, one, joints))
            if turn > _FAR_RAD:
                continue
            approach = connect(away, joints[0], detours=_detours(away, one))
        except Blocked as blocked:
            reasons.append(blocked)
            continue
        return _execute(builder, one, approach, joints)
    for _, one, joints in sorted(later, key=lambda each: each[0])[:_SEARCHED]:
        try:
            approach = connect(away, joints[0], builder.rng, _detours(away, one))
        except Blocked:
            continue
        return _execute(builder, one, approach, joints)
    if reasons:
        often = Counter(str(blocked) for blocked in reasons).most_common(1)[0][0]
        raise next(blocked for blocked in reasons if str(blocked) == often)
    x, y, z = path_mm[0]
    raise Blocked(
        f"from no direction the {CUTTER} comes to ({x:.0f}, {y:.0f}, {z:.0f}) mm without its grip "
        f"in the organ or the electrode at the {HOLDER}"
    )


def _directions(
    path_mm: np.ndarray, around: Surroundings, group: PlanningGroup
) -> list[tuple[float, int]]:
    """Where the instrument may point (yaw, radians) and up to which point of the path, the best
    first: what goes farthest, then what cuts least healthy tissue beside the outline, then what
    turns the arm's joints least from where they are."""
    probes = np.unique(np.r_[np.arange(0, len(path_mm), _PROBE_STEP), len(path_mm) - 1])
    now = yaw_of(group.cell.tips(group.joints_rad)[CUTTER])
    yaws = now + np.linspace(0, 2 * np.pi, _YAWS, endpoint=False)
    fits = around.fits(path_mm[probes], yaws)
    tissue_mm = around.tissue_mm(path_mm[probes], yaws)
    scores = []
    for n, yaw in enumerate(yaws):
        run = int(np.argmin(np.r_[fits[n], False])) - 1  # the last probe before the first misfit
        if run < 1:
            continue
        turns = group.inverse_kinematics(level_pose(path_mm[0], yaw)) - group.current_rad
        if len(turns):
            bins = round(float(tissue_mm[n, : run + 1].mean()) / _TISSUE_BIN_MM)
            scores.append((-run, bins, float(np.abs(turns).max(1).min()), float(yaw)))
    return [(yaw, int(probes[-run])) for run, _, _, yaw in sorted(scores)]


def _detours(group: PlanningGroup, one: Leg) -> list[np.ndarray]:
    """Corners of detours: back and up, across, and down again."""
    there = level_pose(one.enter_mm[0], one.yaw_rad)
    here = group.cell.tips(group.joints_rad)[CUTTER]
    detours = [[aside(group, pose, *by) for pose in (here, there)] for by in DETOURS_MM]
    return [np.array(corners) for corners in detours if all(len(corner) for corner in corners)]


def aside(
    group: PlanningGroup, table_from_tip: Pose, back_mm: float, up_mm: float
) -> Float64[np.ndarray, " d"]:
    """The moving arm with its tip so far back and up from a pose; empty if that is out of reach."""
    moved = table_from_tip.copy()
    moved[:3, 3] += [0.0, 0.0, up_mm] - back_mm * table_from_tip[:3, 0]
    found = group.inverse_kinematics(moved)
    if not len(found):
        return np.zeros(0)
    return found[np.abs(found - group.current_rad).max(1).argmin()]


def _execute(
    builder: TrajectoryBuilder, one: Leg, approach_rad: np.ndarray, joints_rad: np.ndarray
) -> int:
    builder.go(CUTTER, approach_rad)
    for run, cutting in one.runs:
        builder.go(CUTTER, joints_rad[run], builder.cell.config.cutting_mm_s, cutting)
    return len(one.cut_mm) - 1
