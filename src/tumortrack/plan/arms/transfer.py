"""From one configuration to another without touching anything: straight, or by RRT-Connect.

Kuffner and LaValle 2000, 'RRT-Connect: an efficient approach to single-query path planning',
DOI 10.1109/ROBOT.2000.844730. Own and short because it must be repeatable from a seed: OMPL's
generators take theirs from one global seed that can be set once per process.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.arms.situation import Blocked, Situation

_STEP_RAD = 0.3  # how far a tree grows at once
_ROOM_RAD = (0.6, 1.5, 3.0)  # how far beyond start and goal joints may stray, tried in turn
_SAMPLES = 150  # in each
_COARSE = 4.0  # spacing of tests while trees grow; the way found is tested without gaps
_SHORTCUTS = 30
_ROUNDING_RAD = (0.3, 0.15, 0.07, 0.03)  # how widely corners are rounded, tried in turn
_POINT_RAD = 0.05  # between points of a path


def connect(
    situation: Situation,
    goal_rad: Float64[np.ndarray, " d"],
    rng: np.random.Generator | None = None,
    detours: Sequence[Float64[np.ndarray, "c d"]] = (),
) -> Float64[np.ndarray, "m d"]:
    """A smooth path of the moving joints from where they are to a goal.

    Args:
        rng: for the search; None: only the straight way and the detours are tried.
        detours: corners of ways to try before a search, in joint space.

    Raises:
        Blocked: start or goal collide, or no way was found.
    """
    start_rad = situation.here_rad
    for place, joints in (("where it is", start_rad), ("where it should go", goal_rad)):
        if pair := situation.collides(joints):
            raise Blocked(f"{pair[0]} would meet {pair[1]} {place}", pair)
    pair = situation.way_collides(start_rad, goal_rad)
    if pair is None:
        return _straight(start_rad, goal_rad)
    for corners in detours:
        path = _through(situation, np.stack([start_rad, *corners, goal_rad]))
        if path is not None:
            return path
    if rng is None:
        raise Blocked(f"{pair[0]} would meet {pair[1]} on the way", pair)
    for room in _ROOM_RAD:
        lower = np.maximum(np.minimum(start_rad, goal_rad) - room, -situation.limits_rad)
        upper = np.minimum(np.maximum(start_rad, goal_rad) + room, situation.limits_rad)
        way = _grow(situation, goal_rad, (lower, upper), rng)
        if way is not None:
            path = _smooth(situation, _shortcut(situation, way, rng))
            if path is not None:
                return path
    raise Blocked(f"no way round was found where {pair[0]} would meet {pair[1]}", pair)


def _through(situation: Situation, corners: np.ndarray) -> np.ndarray | None:
    """The way through these corners, rounded, if it is free."""
    for corner in corners[1:-1]:
        if situation.collides(corner):
            return None
    for here, there in itertools.pairwise(corners):
        if situation.way_collides(here, there, _COARSE):
            return None
    return _smooth(situation, corners)


def _straight(start_rad: np.ndarray, goal_rad: np.ndarray) -> np.ndarray:
    """Points (m, d) on the straight way in joint space."""
    steps = max(2, int(np.ceil(np.abs(goal_rad - start_rad).max() / _POINT_RAD)))
    return np.linspace(start_rad, goal_rad, steps + 1)


class _Tree:
    def __init__(self, root: np.ndarray) -> None:
        self.nodes, self.parents = [root], [-1]

    def extend(self, target: np.ndarray, situation: Situation) -> bool:
        """Grow towards the target until it is reached (True) or something is in the way."""
        at = int(((np.array(self.nodes) - target) ** 2).sum(1).argmin())
        while True:
            here = self.nodes[at]
            far = float(np.abs(target - here).max())
            if far < 1e-9:
                return True
            there = target if far <= _STEP_RAD else here + (target - here) * (_STEP_RAD / far)
            if situation.collides(there) or situation.way_collides(here, there, _COARSE):
                return False
            self.nodes.append(there)
            self.parents.append(at)
            at = len(self.nodes) - 1

    def branch(self) -> list[np.ndarray]:
        """From the newest node back to the root."""
        way, node = [], len(self.nodes) - 1
        while node >= 0:
            way.append(self.nodes[node])
            node = self.parents[node]
        return way


def _grow(
    situation: Situation,
    goal_rad: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> np.ndarray | None:
    """Corners of a free way (k, d), or None: two trees that grow towards each other."""
    start_rad = situation.here_rad
    one, other = _Tree(start_rad), _Tree(goal_rad)
    for _ in range(_SAMPLES):
        one.extend(rng.uniform(*box), situation)
        if other.extend(one.nodes[-1], situation):
            way = one.branch()[::-1] + other.branch()[1:]
            return np.array(way if way[0] is start_rad else way[::-1])
        one, other = other, one
    return None


def _shortcut(situation: Situation, corners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Fewer corners, closer to the straight way: pieces between any two places on it are replaced
    by straight lines where those are free."""
    way = corners
    for _ in range(_SHORTCUTS):
        if len(way) == 2:
            break
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        # Half of the tries from end to end or corner to corner: most often that is free.
        low, high = np.sort(
            rng.choice(along, 2, False) if rng.random() < 0.5 else rng.uniform(0, along[-1], 2)
        )
        ends = np.array([[np.interp(at, along, axis) for axis in way.T] for at in (low, high)])
        between = ((along > low) & (along < high)).sum()
        if between and situation.way_collides(ends[0], ends[1], _COARSE) is None:
            way = np.concatenate([way[along < low], ends, way[along > high]])
    return way


def _smooth(situation: Situation, corners: np.ndarray) -> np.ndarray | None:
    """The same way with its corners rounded by a cubic B-spline, as widely as there is room."""
    from scipy.interpolate import BSpline

    for spacing in _ROUNDING_RAD:
        pieces = [
            np.linspace(a, b, max(2, int(np.ceil(np.abs(b - a).max() / spacing))) + 1)[:-1]
            for a, b in itertools.pairwise(corners)
        ]
        control = np.concatenate([*pieces, corners[-1:]])
        control = np.insert(control, [1, -1], (control[[0, -2]] + control[[1, -1]]) / 2, axis=0)
        knots = np.concatenate([[0.0] * 3, np.linspace(0, 1, len(control) - 2), [1.0] * 3])
        length = np.abs(np.diff(control, axis=0)).max(1).sum()
        points = BSpline(knots, control, 3)(
            np.linspace(0, 1, int(np.ceil(length / _POINT_RAD)) + 4)
        )
        hits = (
            situation.collides(b) or situation.way_collides(a, b)
            for a, b in itertools.pairwise(points)
        )
        if not any(hits):
            return points
    return None
