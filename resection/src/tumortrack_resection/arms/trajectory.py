"""From paths to trajectories, as fast as the limits of joints and tips allow (Pham and Pham
2018, toppra, DOI 10.1109/TRO.2018.2819195)."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Collection
from functools import partial
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float64

from tumortrack.core.types import Mesh
from tumortrack_resection.arms.cell import (
    ArmCell,
    Blocked,
    CollidingPair,
    PlanningGroup,
    blocked_between,
)
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.arms.kinematics import ACCELERATION_RAD_S2, Pose
from tumortrack_resection.arms.paths import arc_lengths, follow
from tumortrack_resection.motions import ARMS, CUTTER, HOLDER, Joints, Motions, MotionStage, Stage

_STEP_S = 0.02  # between two samples; straight segments between them stay within 0.05 mm
_TIP_SPEED_UP_S = 0.2  # until a tip has its speed
_GRID, _DENSE = 80, 6  # least number of grid points, and how many to a point of the path
_FINER = (1.0, 1.7, 2.9, 4.3)  # numbers of grid points tried, relative to the first
_CRAWL, _CRAWL_S = 2.0, 3.0  # a motion crawls if longer than this factor times the least + this
_TIP_SLACK = 0.92  # of a tip's speed: between its points a path's spline is faster
_SLACK = 0.97  # of the acceleration: toppra keeps its limits at grid points only
_THERE_RAD = 1e-6  # a thousandth of a millimetre at the tip: no motion to be timed

# Which tools may touch the organ; in sweeps, lift and release both
_TOUCHING: dict[str, tuple[str, ...]] = {
    "approach": (),
    "grasp": (HOLDER,),
    Stage.HOLD: (HOLDER,),
    Stage.PULL: (HOLDER,),
    Stage.TAUT: (HOLDER,),
    "home": (),
}
_OVER = 1.05  # tip speeds: toppra keeps them at grid points only

Timed = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n d"]]


class TrajectoryBuilder:
    """The arms' present joints, and their motion so far. Additions to a copy leave it as it is."""

    def __init__(self, cell: ArmCell, start_rad: Joints, rng: np.random.Generator) -> None:
        self.cell, self.joints_rad, self.rng = cell, start_rad, rng
        self.stages: tuple[MotionStage, ...] = ()
        self._pieces: tuple[tuple[np.ndarray, np.ndarray, bool], ...] = ()

    def take(self, other: TrajectoryBuilder) -> None:
        """Go on with what was added to a copy."""
        self.joints_rad, self.stages, self._pieces = other.joints_rad, other.stages, other._pieces

    def group(self, arm: str, touching: Collection[str] = ()) -> PlanningGroup:
        return PlanningGroup(self.cell, arm, self.joints_rad, touching)

    def tip(self, arm: str) -> Pose:
        return self.cell.tips(self.joints_rad)[arm]

    def go(
        self,
        arm: str,
        path_rad: Float64[np.ndarray, "m 6"],
        tip_mm_s: float | None = None,
        cutting: bool = False,
    ) -> None:
        """One arm along a path that begins where it is; its tip no faster than ``tip_mm_s``."""
        if np.ptp(path_rad, axis=0).max() < _THERE_RAD:
            return
        group = self.group(arm)
        tips: np.ndarray | None = None
        if tip_mm_s is not None:
            everything = map(group.all_joints, path_rad)
            tips = np.array([self.cell.tips(joints)[arm][:3, 3] for joints in everything])
        times, own = along(path_rad, self.cell.speeds_rad_s[group.own], tips, tip_mm_s or 0.0)
        joints = np.repeat(self.joints_rad[None], len(times), axis=0)
        joints[:, group.own] = own
        self.add((times, joints), cutting)

    def follow(self, arm: str, poses: Float64[np.ndarray, "n 4 4"], tip_mm_s: float) -> None:
        """One arm's tip along poses that begin where it is, in the organ or not. Raises Blocked."""
        self.go(arm, follow(self.group(arm, (CUTTER, HOLDER)), poses), tip_mm_s)

    def wait(self, seconds: float) -> None:
        self.add((np.array([0.0, seconds]), np.repeat(self.joints_rad[None], 2, axis=0)))

    def add(self, timed: Timed, cutting: bool = False) -> None:
        """All twelve joints (n, 12) over time, from where they are."""
        times, joints = timed
        joints[0] = self.joints_rad
        self._pieces += ((times, joints, cutting),)
        self.joints_rad = joints[-1]

    def close(self, name: str) -> None:
        """Make a stage of this name of everything added since the last one."""
        pieces = self._pieces
        times = [np.zeros(1)]
        joints = [pieces[0][1][:1] if pieces else self.joints_rad[None]]
        cutting = [np.array([bool(pieces) and pieces[0][2]])]
        for piece_times, piece_joints, cuts in pieces:
            cutting[-1][-1] |= cuts  # a corner between lead-in and cut is on the cut
            times.append(times[-1][-1] + piece_times[1:])
            joints.append(piece_joints[1:])
            cutting.append(np.full(len(piece_times) - 1, cuts))
        arrays = (np.concatenate(parts) for parts in (times, joints, cutting))
        self.stages += (MotionStage(name, *arrays),)
        self._pieces = ()


def along(
    path_rad: Float64[np.ndarray, "m d"],
    speeds_rad_s: Float64[np.ndarray, " d"],
    tip_mm: Float64[np.ndarray, "m 3"] | None = None,
    tip_mm_s: float = 0.0,
) -> Timed:
    """Times from 0 and joints (n, d) along a path, at rest at both ends; the tip, at ``tip_mm``,
    stays below ``tip_mm_s``. Raises Blocked: the path has a kink that can't be taken."""
    import toppra
    from toppra import constraint

    logging.getLogger("toppra").setLevel(logging.ERROR)
    width = path_rad.shape[1]
    acceleration = np.full(width, _SLACK * ACCELERATION_RAD_S2)
    knots = arc_lengths(path_rad if tip_mm is None else tip_mm)
    if tip_mm is not None:
        # The tip's arc length is one more joint, with limits of its own.
        path_rad = np.column_stack([path_rad, knots])
        tip_mm_s *= _TIP_SLACK
        speeds_rad_s = np.append(speeds_rad_s, tip_mm_s)
        acceleration = np.append(acceleration, tip_mm_s / _TIP_SPEED_UP_S)
    keep = np.r_[True, np.diff(knots) > 1e-9 * knots[-1]]
    curve = toppra.SplineInterpolator(knots[keep], path_rad[keep])
    limits = [
        constraint.JointVelocityConstraint(np.column_stack([-speeds_rad_s, speeds_rad_s])),
        constraint.JointAccelerationConstraint(np.column_stack([-acceleration, acceleration])),
    ]
    # No motion is shorter: each step at its slowest joint's full speed. On some grids toppra crawls
    # through a place for minutes; another grid does not share it.
    least_s = float((np.abs(np.diff(path_rad, axis=0)) / speeds_rad_s).max(axis=1).sum())
    best: Any = None
    for finer in _FINER:
        grid = np.linspace(0, knots[-1], round(finer * max(_GRID, _DENSE * keep.sum())))
        solver = toppra.algorithm.TOPPRA(limits, curve, grid, parametrizer="ParametrizeConstAccel")
        trajectory = solver.compute_trajectory(0, 0)
        if trajectory is not None and (best is None or trajectory.duration < best.duration):
            best = trajectory
        if best is not None and best.duration < _CRAWL * least_s + _CRAWL_S:
            break
    if best is None:
        raise Blocked("a path can't be gone within the joints' limits")
    times = np.linspace(0, best.duration, int(np.ceil(best.duration / _STEP_S)) + 1)
    joints = best(times)[:, :width]
    return times * _stretched(times, joints), joints


def _stretched(times: np.ndarray, joints: np.ndarray) -> float:
    """Between toppra's grid points, in tight curves, a motion may be too sudden: how many times as
    long it has to take."""
    accelerations = np.diff(joints, 2, axis=0) / np.diff(times)[1:, None] ** 2
    most = float(np.abs(accelerations).max(initial=0.0))
    return max(1.0, np.sqrt(most / ACCELERATION_RAD_S2))


def first_hit(motions: Motions, config: CellConfig, organ: Mesh, begun: bool = False) -> str:
    """A collision of these motions, and when; empty: none. With half of the planner's
    clearances, as between the places that it tests its motions come nearer. An electrode or cup
    may touch the organ only where its tip is as slow as planned there. An instrument that
    withdraws from an organ that has come too near to more than its electrode is not tested
    against that. ``begun``: both tools may be at the organ in the first stage too."""
    halves = {
        name: max(getattr(config, name) / 2, 0.5)
        for name in ("clearance_mm", "organ_clearance_mm", "contact_mm")
    }
    config = msgspec.structs.replace(config, **halves)
    with_organ = ArmCell(config, organ)
    slow_mm_s = _OVER * np.array([config.cutting_mm_s, config.grasping_mm_s])
    for number, stage in enumerate(motions.stages):
        cell = with_organ
        if stage.name == Stage.WITHDRAW and cell.collisions(stage.joints_rad[0], ARMS) is not None:
            cell = ArmCell(config)
        touching = ARMS if begun and not number else _TOUCHING.get(stage.name, ARMS)
        # An arm is longest where its elbow, somewhere between the ends, is straightest.
        ends = stage.joints_rad.min(0), stage.joints_rad.max(0)
        turns = np.abs(np.diff(stage.joints_rad, axis=0)) @ cell.levers_mm(*ends)
        moved_mm = np.append(0.0, np.cumsum(turns))  # at most, of any point
        steps = int(np.ceil(moved_mm[-1] / (2 * cell.config.least_clearance_mm(touching))))
        at_mm = np.linspace(0, moved_mm[-1], steps + 1)
        joints = np.stack(
            [np.interp(at_mm, moved_mm, joint) for joint in stage.joints_rad.T], axis=1
        )
        times_s = np.interp(at_mm, moved_mm, stage.times_s)
        allowed = _slow(cell, stage, moved_mm, at_mm, slow_mm_s) & np.isin(ARMS, touching)
        turned = np.ptp(stage.joints_rad, axis=0).reshape(len(ARMS), 6).any(1)
        moving = [arm for arm, turns in zip(ARMS, turned.tolist(), strict=True) if turns]
        test = partial(_test, cell, joints, allowed, moving[0] if len(moving) == 1 else None)

        # Poses at which the same may touch the organ
        edges = np.flatnonzero((allowed[1:] != allowed[:-1]).any(1))
        for first, last in itertools.pairwise([-1, *edges.tolist(), steps]):
            step_mm = np.full(last - first + 1, moved_mm[-1] / max(steps, 1))
            if found := blocked_between(first, last + 1, step_mm, test):
                k, pair = found
                return (
                    f"{pair[0]} would meet {pair[1]} {times_s[k]:.1f} s after {stage.name} begins"
                )
    return ""


def _test(
    cell: ArmCell, joints: np.ndarray, allowed: np.ndarray, moving: str | None, k: int,
    room_mm: float,
) -> CollidingPair | None:  # fmt: skip
    """At one of a stage's poses; what stands still is tested at the first alone."""
    now = [arm for arm, may in zip(ARMS, allowed[k], strict=True) if may]
    return cell.collisions(joints[k], now, moving if k else None, room_mm)


def _slow(
    cell: ArmCell,
    stage: MotionStage,
    moved_mm: Float64[np.ndarray, " n"],
    at_mm: Float64[np.ndarray, " k"],
    slow_mm_s: Float64[np.ndarray, " 2"],
) -> Bool[np.ndarray, "k 2"]:
    """Whether each arm's tip is so slow just before or after each of these places."""
    if len(stage.times_s) < 2:
        return np.ones((len(at_mm), len(ARMS)), bool)
    poses = [cell.tips(joints_rad) for joints_rad in stage.joints_rad]
    tips = np.array([[pose[:3, 3] for pose in each.values()] for each in poses])
    speeds = np.linalg.norm(np.diff(tips, axis=0), axis=2) / np.diff(stage.times_s)[:, None]
    before = np.clip(np.searchsorted(moved_mm, at_mm, "left") - 1, 0, len(speeds) - 1)
    after = np.clip(np.searchsorted(moved_mm, at_mm, "right") - 1, 0, len(speeds) - 1)
    return np.minimum(speeds[before], speeds[after]) <= slow_mm_s
