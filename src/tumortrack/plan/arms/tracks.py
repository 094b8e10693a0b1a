"""A tip that follows poses: one branch of the inverse kinematics all along, without a jump."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.arms.ik import branches, nearest_turn
from tumortrack.plan.arms.situation import Blocked, Situation

_TURN = 2 * np.pi
_FEW = 12  # every so many poses are looked at before all are
_JUMP_RAD = 0.35  # more than any joint turns between neighbouring poses of one branch


def solve(
    situation: Situation, table_from_tip: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "k 6"]:
    """All branches that bring the moving arm's tip to a pose, collisions not regarded, each joint
    turned to be near where it is."""
    config, arm = situation.cell.config, str(situation.arm)
    base_from_table, tip_from_flange = situation.cell.around_arm(arm)
    found = branches(config.model(arm), base_from_table @ table_from_tip @ tip_from_flange)
    return nearest_turn(config.model(arm), found, situation.here_rad)


def follow(
    situation: Situation,
    poses: Float64[np.ndarray, "n 4 4"],
    near_rad: Float64[np.ndarray, " 6"] | None = None,
) -> Float64[np.ndarray, "n 6"]:
    """Joint angles of the moving arm along poses of its tip (mm), free of collisions.

    The cheapest way through all branches (Viterbi): it starts near ``near_rad`` (without: where
    the arm is) and turns joints as little as it can. Only what lies on the cheapest way is tested
    for collisions, then struck out, until a way is free.

    Raises:
        Blocked: a pose out of reach, no way without a jump, or collisions on all of them.
    """
    near = situation.here_rad if near_rad is None else near_rad
    _reject_early(situation, poses)
    joints = _options(situation, poses)
    barred = np.isnan(joints[..., 0])
    tested = np.zeros_like(barred)
    pair: tuple[str, str] | None = None
    while (way := _cheapest(joints, barred, near)) is not None:
        hit = _first_hit(situation, joints, way, tested)
        if hit is None:
            path = np.unwrap(joints[np.arange(len(way)), way], axis=0)
            path += (
                nearest_turn(situation.cell.config.model(str(situation.arm)), path[0], near)
                - path[0]
            )
            return _checked_between(situation, _within_limits(path, situation.limits_rad))
        at, pair = hit
        barred[at, way[at]] = True
    if pair is None:
        raise Blocked(f"the {situation.arm} would have to jump between two configurations")
    raise Blocked(f"{pair[0]} would meet {pair[1]}", pair)


def _reject_early(situation: Situation, poses: np.ndarray) -> None:
    """Most ways that can't be gone show it at a few of their poses.

    Raises:
        Blocked: no branch is free at one of them.
    """
    for option in _options(situation, poses[_FEW // 2 :: _FEW]):
        pair: tuple[str, str] | None = None
        for joints in option[~np.isnan(option[:, 0])]:
            pair = situation.collides(joints)
            if pair is None:
                break
        else:
            assert pair is not None
            raise Blocked(f"{pair[0]} would meet {pair[1]}", pair)


def _options(situation: Situation, poses: np.ndarray) -> np.ndarray:
    """All branches of all poses (n, most, 6), filled up with NaN."""
    options = [solve(situation, pose) for pose in poses]
    for pose, option in zip(poses, options, strict=True):
        if not len(option):
            x, y, z = pose[:3, 3]
            raise Blocked(f"the {situation.arm} does not reach ({x:.0f}, {y:.0f}, {z:.0f}) mm")
    joints = np.full((len(poses), max(map(len, options), default=0), 6), np.nan)
    for row, option in zip(joints, options, strict=True):
        row[: len(option)] = option
    return joints


def _cheapest(joints: np.ndarray, barred: np.ndarray, near_rad: np.ndarray) -> np.ndarray | None:
    """Which branch at each pose (n,), by dynamic programming; None if there is no way."""
    cost = np.where(barred[0], np.inf, (_turn(joints[0] - near_rad) ** 2).sum(-1))
    came = np.zeros(joints.shape[:2], int)
    for n in range(1, len(joints)):
        step = _turn(joints[n][:, None] - joints[n - 1][None])
        edge = np.where(np.abs(step).max(-1) <= _JUMP_RAD, (step**2).sum(-1), np.inf)
        total = cost[None] + edge
        came[n] = total.argmin(1)
        cost = np.where(barred[n], np.inf, total.min(1))
    if not np.isfinite(cost).any():
        return None
    way = [int(cost.argmin())]
    for n in range(len(joints) - 1, 0, -1):
        way.append(int(came[n][way[-1]]))
    return np.array(way[::-1])


def _first_hit(
    situation: Situation, joints: np.ndarray, way: np.ndarray, tested: np.ndarray
) -> tuple[int, tuple[str, str]] | None:
    """A collision on this way: coarsely first, since what blocks rarely blocks one pose alone."""
    for n in (n for stride in (16, 4, 1) for n in range(0, len(way), stride)):
        if not tested[n, way[n]]:
            if pair := situation.collides(joints[n, way[n]]):
                return n, pair
            tested[n, way[n]] = True
    return None


def _checked_between(situation: Situation, path_rad: np.ndarray) -> np.ndarray:
    """The path, if the ways between its points are free too."""
    for here, there in itertools.pairwise(path_rad):
        if pair := situation.way_collides(here, there):
            raise Blocked(f"{pair[0]} would meet {pair[1]}", pair)
    return path_rad


def _turn(angles_rad: np.ndarray) -> np.ndarray:
    return angles_rad - _TURN * np.round(angles_rad / _TURN)


def _within_limits(path_rad: np.ndarray, limits_rad: np.ndarray) -> np.ndarray:
    """The path, each joint moved by a whole turn where it would leave its limits.

    Raises:
        Blocked: it turns by more than the limits leave.
    """
    path_rad = np.where((path_rad > limits_rad).any(0), path_rad - _TURN, path_rad)
    path_rad = np.where((path_rad < -limits_rad).any(0), path_rad + _TURN, path_rad)
    if (np.abs(path_rad) > limits_rad).any():
        raise Blocked("a joint would turn beyond its limit")
    return path_rad
