"""Collision-free paths in joint space: of a tip along poses, and from one configuration to
another by RRT-Connect (Kuffner and LaValle 2000, DOI 10.1109/ROBOT.2000.844730). Our own, as it
must be repeatable from a seed: OMPL's generators share one that can be set once per process."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline

from tumortrack_resection.arms.cell import Blocked, CollidingPair, PlanningGroup
from tumortrack_resection.arms.kinematics import TURN, Pose, nearest_turn, wrapped

_FEW = 12  # every so many poses are checked before all are
_JUMP_RAD = 0.35  # more than any joint turns between neighbouring poses of one branch
_STEP_RAD = 0.3  # how far a tree grows at once
_ROOM_RAD = (0.6, 1.5, 3.0)  # how far beyond start and goal joints may stray, tried in turn
_SAMPLES = 150  # in each
_COARSE = 4.0  # spacing of tests while trees grow; the path found is tested without gaps
_SHORTCUTS = 30
_ROUNDING_RAD = (0.3, 0.15, 0.07, 0.03)  # how widely corners are rounded, tried in turn
_POINT_RAD = 0.05  # between points of a path


def follow(
    group: PlanningGroup,
    poses: Float64[np.ndarray, "n 4 4"],
    near_rad: Float64[np.ndarray, " 6"] | None = None,
) -> Float64[np.ndarray, "n 6"]:
    """Joint angles of the moving arm along poses of its tip (mm), free of collisions: the
    cheapest path through all branches of the inverse kinematics (Viterbi), near ``near_rad``
    (default: where the arm is). Only what lies on it is tested, then struck out, until a path is
    free. Raises Blocked: a pose out of reach, no path without a jump, or collisions on all of
    them."""
    near = group.current_rad if near_rad is None else near_rad
    _reject_early(group, poses)
    joints = _branches(group, poses)
    barred = np.isnan(joints[..., 0])
    collides = cache(lambda n, branch: group.collides(joints[n, branch]))
    pair: CollidingPair | None = None
    while (choice := _cheapest(joints, barred, near)) is not None:
        # Coarsely first: obstacles rarely block a single pose
        order = (n for stride in (16, 4, 1) for n in range(0, len(choice), stride))
        hit = next((n for n in order if collides(n, choice[n])), None)
        if hit is None:
            path = np.unwrap(joints[np.arange(len(choice)), choice], axis=0)
            path += nearest_turn(group.model, path[0], near) - path[0]
            return _checked(group, path)
        pair = collides(hit, choice[hit])
        barred[hit, choice[hit]] = True
    if pair is None:
        raise Blocked(f"the {group.arm} would have to jump between two configurations")
    raise Blocked.by(pair)


def _reject_early(group: PlanningGroup, poses: np.ndarray) -> None:
    """Raises Blocked: at one of a few poses no branch is free, as on most blocked paths."""
    for branches in _branches(group, poses[_FEW // 2 :: _FEW]):
        pair: CollidingPair | None = None
        for joints in branches[~np.isnan(branches[:, 0])]:
            if (pair := group.collides(joints)) is None:
                break
        if pair is not None:
            raise Blocked.by(pair)


def _branches(group: PlanningGroup, poses: np.ndarray) -> np.ndarray:
    """All branches of the inverse kinematics of all poses (n, most, 6), filled up with NaN."""
    solutions = [group.inverse_kinematics(pose) for pose in poses]
    joints = np.full((len(poses), max(map(len, solutions), default=0), 6), np.nan)
    for row, branches, pose in zip(joints, solutions, poses, strict=True):
        if not len(branches):
            raise out_of_reach(group, pose)
        row[: len(branches)] = branches
    return joints


def out_of_reach(group: PlanningGroup, table_from_tip: Pose) -> Blocked:
    """By a pose of the tip for which there is no inverse kinematics."""
    x, y, z = table_from_tip[:3, 3]
    return Blocked(f"the {group.arm} does not reach ({x:.0f}, {y:.0f}, {z:.0f}) mm")


def _cheapest(joints: np.ndarray, barred: np.ndarray, near_rad: np.ndarray) -> np.ndarray | None:
    """Which branch at each pose (n,), by dynamic programming; None if there is no path."""
    cost = np.where(barred[0], np.inf, (wrapped(joints[0] - near_rad) ** 2).sum(-1))
    previous = np.zeros(joints.shape[:2], int)
    for n in range(1, len(joints)):
        step = wrapped(joints[n][:, None] - joints[n - 1][None])
        edge = np.where(np.abs(step).max(-1) <= _JUMP_RAD, (step**2).sum(-1), np.inf)
        total = cost[None] + edge
        previous[n] = total.argmin(1)
        cost = np.where(barred[n], np.inf, total.min(1))
    if not np.isfinite(cost).any():
        return None
    choice = [int(cost.argmin())]
    for n in range(len(joints) - 1, 0, -1):
        choice.append(int(previous[n][choice[-1]]))
    return np.array(choice[::-1])


def _checked(group: PlanningGroup, path_rad: np.ndarray) -> np.ndarray:
    """The path, joints moved by whole turns into their limits. Blocked: too far, or a collision."""
    limits_rad = group.limits_rad
    path_rad = np.where((path_rad > limits_rad).any(0), path_rad - TURN, path_rad)
    path_rad = np.where((path_rad < -limits_rad).any(0), path_rad + TURN, path_rad)
    if (np.abs(path_rad) > limits_rad).any():
        raise Blocked("a joint would turn beyond its limit")
    for here, there in itertools.pairwise(path_rad):
        if pair := group.segment_collides(here, there):
            raise Blocked.by(pair)
    return path_rad


def connect(
    group: PlanningGroup,
    goal_rad: Float64[np.ndarray, " d"],
    rng: np.random.Generator | None = None,
    detours: Sequence[Float64[np.ndarray, "c d"]] = (),
) -> Float64[np.ndarray, "m d"]:
    """A smooth path of the moving joints to a goal: straight, by ``detours`` (their corners), or
    with ``rng`` by a search. Raises Blocked: start or goal collide, or no path was found."""
    start_rad = group.current_rad
    for place, joints in (("where it is", start_rad), ("where it should go", goal_rad)):
        if pair := group.collides(joints):
            raise Blocked.by(pair, f" {place}")
    pair = group.segment_collides(start_rad, goal_rad)
    if pair is None:
        steps = max(2, int(np.ceil(np.abs(goal_rad - start_rad).max() / _POINT_RAD)))
        return np.linspace(start_rad, goal_rad, steps + 1)
    for between in detours:
        corners = np.stack([start_rad, *between, goal_rad])
        free = not any(group.collides(corner) for corner in between) and not any(
            group.segment_collides(a, b, _COARSE) for a, b in itertools.pairwise(corners)
        )
        if free and (path := _smooth(group, corners)) is not None:
            return path
    if rng is None:
        raise Blocked.by(pair, " on the way")
    for room in _ROOM_RAD:
        lower = np.maximum(np.minimum(start_rad, goal_rad) - room, -group.limits_rad)
        upper = np.minimum(np.maximum(start_rad, goal_rad) + room, group.limits_rad)
        grown = _grow(group, goal_rad, (lower, upper), rng)
        if grown is not None:
            path = _smooth(group, _shortcut(group, grown, rng))
            if path is not None:
                return path
    raise Blocked(f"no way round was found where {pair[0]} would meet {pair[1]}", pair)


class _Tree:
    def __init__(self, root: np.ndarray) -> None:
        self.nodes, self.parents = [root], [-1]

    def extend(self, target: np.ndarray, group: PlanningGroup) -> bool:
        """Grow towards the target until it is reached (True) or something collides."""
        at = int(((np.array(self.nodes) - target) ** 2).sum(1).argmin())
        while (far := float(np.abs(target - self.nodes[at]).max())) >= 1e-9:
            here = self.nodes[at]
            there = target if far <= _STEP_RAD else here + (target - here) * (_STEP_RAD / far)
            if group.collides(there) or group.segment_collides(here, there, _COARSE):
                return False
            self.nodes.append(there)
            self.parents.append(at)
            at = len(self.nodes) - 1
        return True

    def branch(self) -> list[np.ndarray]:
        """From the newest node back to the root."""
        nodes, at = [], len(self.nodes) - 1
        while at >= 0:
            nodes.append(self.nodes[at])
            at = self.parents[at]
        return nodes


def _grow(
    group: PlanningGroup,
    goal_rad: np.ndarray,
    box: tuple[np.ndarray, ...],
    rng: np.random.Generator,
) -> np.ndarray | None:
    """Corners of a free path (k, d), or None: two trees that grow towards each other."""
    start_rad = group.current_rad
    tree, other = _Tree(start_rad), _Tree(goal_rad)
    for _ in range(_SAMPLES):
        tree.extend(rng.uniform(*box), group)
        if other.extend(tree.nodes[-1], group):
            path = tree.branch()[::-1] + other.branch()[1:]
            return np.array(path if path[0] is start_rad else path[::-1])
        tree, other = other, tree
    return None


def _shortcut(group: PlanningGroup, path: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pieces between any two places are replaced by straight segments where those are free."""
    for _ in range(_SHORTCUTS):
        if len(path) == 2:
            break
        along = arc_lengths(path)
        # Half of the tries from end to end or corner to corner: most often that is free.
        low, high = np.sort(
            rng.choice(along, 2, False) if rng.random() < 0.5 else rng.uniform(0, along[-1], 2)
        )
        ends = np.array([[np.interp(at, along, axis) for axis in path.T] for at in (low, high)])
        between = ((along > low) & (along < high)).any()
        if between and group.segment_collides(ends[0], ends[1], _COARSE) is None:
            path = np.concatenate([path[along < low], ends, path[along > high]])
    return path


def _smooth(group: PlanningGroup, corners: np.ndarray) -> np.ndarray | None:
    """With corners rounded by a cubic B-spline, as widely as there is room."""
    for spacing in _ROUNDING_RAD:
        control = resampled(corners, spacing, np.inf, 2)
        control = np.insert(control, [1, -1], (control[[0, -2]] + control[[1, -1]]) / 2, axis=0)
        knots = np.concatenate([[0.0] * 3, np.linspace(0, 1, len(control) - 2), [1.0] * 3])
        length = np.abs(np.diff(control, axis=0)).max(1).sum()
        at = np.linspace(0, 1, int(np.ceil(length / _POINT_RAD)) + 4)
        points = BSpline(knots, control, 3)(at)
        if not any(
            group.collides(b) or group.segment_collides(a, b) for a, b in itertools.pairwise(points)
        ):
            return points
    return None


def arc_lengths(points: Float64[np.ndarray, "n d"]) -> Float64[np.ndarray, " n"]:
    """How far along a polyline each of its points lies."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def resampled(
    points: Float64[np.ndarray, "n d"], step: float, norm: float = 2, least: int = 1
) -> Float64[np.ndarray, "m d"]:
    """Points on a polyline, at most a step apart in this norm, its corners among them."""
    pieces = [
        np.linspace(a, b, max(least, int(np.ceil(np.linalg.norm(b - a, norm) / step))) + 1)[:-1]
        for a, b in itertools.pairwise(points)
    ]
    return np.concatenate([*pieces, points[-1:]])
