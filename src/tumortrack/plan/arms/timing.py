"""When a path is where: as fast as joints may turn and accelerate, and no faster than asked.

Pham and Pham 2018, 'A new approach to time-optimal path parameterization based on reachability
analysis' (toppra), DOI 10.1109/TRO.2018.2819195; Berscheid and Kroeger 2021, 'Jerk-limited
real-time trajectory generation with arbitrary target states' (ruckig), arXiv:2105.04830.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.arms.dh import ACCELERATION_RAD_S2, JERK_RAD_S3
from tumortrack.plan.arms.situation import Blocked

STEP_S = 0.02  # between two samples; straight lines between them stay within 0.05 mm
_TIP_SPEED_UP_S = 0.2  # until a tip has its speed
_GRID = 80
_FINER = (1.0, 1.7, 2.9, 4.3)  # grids that are tried, in points of the first
_CRAWL, _CRAWL_S = 2.0, 3.0  # a motion longer than so many times the least, and so much, crawls
_SLACK = 0.97  # of the acceleration: toppra keeps its limits at grid points only

Timed = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n d"]]


def along(
    path_rad: Float64[np.ndarray, "m d"],
    speeds_rad_s: Float64[np.ndarray, " d"],
    tip_mm: Float64[np.ndarray, "m 3"] | None = None,
    tip_mm_s: float = 0.0,
) -> Timed:
    """Times from 0 and joints (n, d) along a path, at rest at both ends.

    Args:
        tip_mm: where the tip is at each point; its speed stays below ``tip_mm_s``.

    Raises:
        Blocked: no such motion (the path has a kink that can't be taken).
    """
    import toppra
    from toppra import algorithm, constraint

    logging.getLogger("toppra").setLevel(logging.ERROR)
    width = path_rad.shape[1]
    acceleration = np.full(width, _SLACK * ACCELERATION_RAD_S2)
    if tip_mm is not None:
        # The way of the tip is one more joint, with limits of its own.
        steps = np.linalg.norm(np.diff(tip_mm, axis=0), axis=1)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        path_rad = np.column_stack([path_rad, way])
        speeds_rad_s = np.append(speeds_rad_s, tip_mm_s)
        acceleration = np.append(acceleration, tip_mm_s / _TIP_SPEED_UP_S)
        knots = way
    else:
        knots = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(path_rad, axis=0), axis=1))]
        )
    keep = np.r_[True, np.diff(knots) > 1e-9 * knots[-1]]
    curve = toppra.SplineInterpolator(knots[keep], path_rad[keep])
    limits = [
        constraint.JointVelocityConstraint(np.column_stack([-speeds_rad_s, speeds_rad_s])),
        constraint.JointAccelerationConstraint(np.column_stack([-acceleration, acceleration])),
    ]
    # On some grids toppra crawls through a place for minutes; another grid does not share it.
    least_s = _least_s(path_rad, speeds_rad_s)
    best: Any = None
    for finer in _FINER:
        grid = np.linspace(0, knots[-1], round(finer * max(_GRID, keep.sum())))
        solver = algorithm.TOPPRA(
            limits, curve, gridpoints=grid, parametrizer="ParametrizeConstAccel"
        )
        course = solver.compute_trajectory(0, 0)
        if course is not None and (best is None or course.duration < best.duration):
            best = course
        if best is not None and best.duration < _CRAWL * least_s + _CRAWL_S:
            break
    if best is None:
        raise Blocked("a path can't be gone within the joints' limits")
    course = best
    times = np.linspace(0, course.duration, int(np.ceil(course.duration / STEP_S)) + 1)
    return times, course(times)[:, :width]


def _least_s(
    path_rad: Float64[np.ndarray, "m d"], speeds_rad_s: Float64[np.ndarray, " d"]
) -> float:
    """No motion along the path is shorter: each step at its slowest joint's full speed."""
    return float((np.abs(np.diff(path_rad, axis=0)) / speeds_rad_s).max(axis=1).sum())


def together(
    start_rad: Float64[np.ndarray, " d"],
    goal_rad: Float64[np.ndarray, " d"],
    speeds_rad_s: Float64[np.ndarray, " d"],
) -> Timed:
    """Every joint leaves at the same time and arrives at the same time, on the straight way."""
    import ruckig

    # One joint that goes from 0 to 1, as slowly as the slowest of them needs: so all are on the
    # straight way that was tested, which synchronised ends alone would not mean.
    turns = np.maximum(np.abs(goal_rad - start_rad), 1e-9)
    longest = float(turns.max())
    wish = ruckig.InputParameter(1)
    wish.current_position, wish.target_position = [0.0], [1.0]
    wish.max_velocity = [float((speeds_rad_s / turns).min())]
    wish.max_acceleration = [ACCELERATION_RAD_S2 / longest]
    wish.max_jerk = [JERK_RAD_S3 / longest]
    course = ruckig.Trajectory(1)
    outcome = ruckig.Ruckig(1).calculate(wish, course)
    if outcome not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise Blocked(f"no synchronous motion ({outcome})")
    times = np.linspace(0, course.duration, int(np.ceil(course.duration / STEP_S)) + 1)
    share = np.array([course.at_time(time)[0] for time in times]).reshape(-1, 1)
    return times, start_rad + share * (goal_rad - start_rad)
