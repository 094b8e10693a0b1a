"""A pass of the instrument: from which sides, and the motions."""

from __future__ import annotations

from collections import Counter

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.arms.situation import Blocked, Situation
from tumortrack.plan.arms.strokes import Leg, Surroundings, leg, level_poses
from tumortrack.plan.arms.tracks import follow, solve
from tumortrack.plan.arms.trajectory import TrajectoryBuilder
from tumortrack.plan.arms.transfer import connect
from tumortrack.plan.motions import CUTTER, HOLDER

_YAWS = 24
_PROBE_STEP = 3  # every so many points of a pass, directions are compared
_TISSUE_BIN_MM = 3.0  # differences in cut tissue below this do not count
_MOST_LEGS = 8  # of a pass
_FAR_RAD = 2.0  # the arm turns a joint farther than that only if nothing else is possible
_LONG_WAYS = 4  # directions for which a long way round is searched
# On the way elsewhere the tip may go back and up first, mm: what most often is free
DETOURS_MM = ((60.0, 0.0), (0.0, 70.0), (60.0, 70.0), (0.0, 140.0))


def cut_pass(
    course: TrajectoryBuilder, way_mm: Float64[np.ndarray, "n 3"], around: Surroundings
) -> None:
    """The instrument along a pass: in one direction all along if that is possible, else in as few
    legs as are; between them it leaves and comes from another side.

    Raises:
        Blocked: no direction is possible somewhere; the reason is the most frequent one.
    """
    for _ in range(_MOST_LEGS):
        done = _cut_leg(course, way_mm, around)
        if done == len(way_mm) - 1:
            return
        way_mm = way_mm[done:]
    raise Blocked(f"a cut would need more than {_MOST_LEGS} directions of the {CUTTER}")


def _cut_leg(course: TrajectoryBuilder, way_mm: np.ndarray, around: Surroundings) -> int:
    """The first leg, as long as it can be; returns the number of the point where it ended."""
    away, inside = course.situation(CUTTER, (HOLDER,)), course.situation(CUTTER, (CUTTER, HOLDER))
    reasons: list[Blocked] = []
    later: list[tuple[float, Leg, np.ndarray]] = []
    for yaw, last in _directions(way_mm, around, inside):
        one = leg(way_mm[: last + 1], yaw, around)
        try:
            path = follow(inside, one.poses)
            turn = float(np.abs(path[0] - away.here_rad).max())
            later.append((turn, one, path))
            if turn > _FAR_RAD:
                continue
            way = connect(away, path[0], detours=_detours(away, one))
        except Blocked as blocked:
            reasons.append(blocked)
            continue
        _carry_out(course, one, way, path)
        return last
    for _, one, path in sorted(later, key=lambda each: each[0])[:_LONG_WAYS]:
        try:
            way = connect(away, path[0], course.rng, _detours(away, one))
        except Blocked:
            continue
        _carry_out(course, one, way, path)
        return len(one.cut_mm) - 1
    if reasons:
        often = Counter(str(blocked) for blocked in reasons).most_common(1)[0][0]
        raise next(blocked for blocked in reasons if str(blocked) == often)
    x, y, z = way_mm[0]
    raise Blocked(
        f"from no direction the {CUTTER} comes to ({x:.0f}, {y:.0f}, {z:.0f}) mm without its grip "
        f"in the organ or the electrode at the {HOLDER}"
    )


def _directions(
    way_mm: np.ndarray, around: Surroundings, situation: Situation
) -> list[tuple[float, int]]:
    """Where the instrument may point (yaw, radians) and up to which point of the way, the best
    first: what goes farthest, then what cuts least healthy tissue beside the outline, then what
    turns the arm's joints least from where they are."""
    probes = np.unique(np.r_[np.arange(0, len(way_mm), _PROBE_STEP), len(way_mm) - 1])
    tip = situation.cell.tips(situation.joints_rad)[CUTTER]
    yaws = np.arctan2(tip[1, 0], tip[0, 0]) + np.linspace(0, 2 * np.pi, _YAWS, endpoint=False)
    fits = around.fits(way_mm[probes], yaws)
    tissue_mm = around.tissue_mm(way_mm[probes], yaws)
    scores = []
    for n, yaw in enumerate(yaws):
        run = int(np.argmin(np.r_[fits[n], False])) - 1  # the last probe before the first misfit
        if run < 1:
            continue
        turns = solve(situation, level_poses(way_mm[:1], yaw)[0]) - situation.here_rad
        if len(turns):
            bins = round(float(tissue_mm[n, : run + 1].mean()) / _TISSUE_BIN_MM)
            scores.append((-run, bins, float(np.abs(turns).max(1).min()), float(yaw)))
    return [(yaw, int(probes[-run])) for run, _, _, yaw in sorted(scores)]


def _detours(situation: Situation, one: Leg) -> list[np.ndarray]:
    """Corners of ways round: back and up, across, and down again."""
    there = level_poses(one.enter_mm[:1], one.yaw_rad)[0]
    here = situation.cell.tips(situation.joints_rad)[CUTTER]
    ways = [[aside(situation, pose, *by) for pose in (here, there)] for by in DETOURS_MM]
    return [np.array(corners) for corners in ways if all(len(corner) for corner in corners)]


def aside(
    situation: Situation, table_from_tip: Float64[np.ndarray, "4 4"], back_mm: float, up_mm: float
) -> Float64[np.ndarray, " d"]:
    """The moving arm with its tip so far back and up from a pose; empty if that is out of reach."""
    moved = table_from_tip.copy()
    moved[:3, 3] += [0.0, 0.0, up_mm] - back_mm * table_from_tip[:3, 0]
    found = solve(situation, moved)
    if not len(found):
        return np.zeros(0)
    return found[np.abs(found - situation.here_rad).max(1).argmin()]


def _carry_out(
    course: TrajectoryBuilder, one: Leg, way_rad: np.ndarray, path_rad: np.ndarray
) -> None:
    course.go(CUTTER, way_rad)
    for run, cutting in one.runs:
        course.go(CUTTER, path_rad[run], course.cell.config.cutting_mm_s, cutting)
