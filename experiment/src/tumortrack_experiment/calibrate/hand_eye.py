"""Where a camera is on a robot's tool, or before its base, from pictures of a board.

One equation holds both: ``fixed_from_moving @ moving_from_camera @ camera_from_board`` is the same
in all pictures. Eye in hand: fixed is the base, moving the tool. A board on the tool: fixed is the
tool, moving the base. OpenCV solves it; least squares on the corners' pixels follow, in which the
robot's millimetres are the measure: the board's size is free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, rigid, transform_points
from tumortrack_experiment.calibrate.board import Corners
from tumortrack_experiment.calibrate.lens import Lens

Poses = Float64[np.ndarray, "n 4 4"]

LEAST_POSES = 8  # six numbers, and something left to judge them by
# Root mean square turns between pictures about the second axis: with less, errors of 0.05 degrees
# in single pictures turn the answer by a degree or more.
_LEAST_TURN, _FEW_TURN = 4.0, 10.0  # degrees: refused, warned of
_UNIT = 50.0  # times that tool and camera may move differently
_OUTLIER_TIMES, _OUTLIER_MM = 4.0, 0.5  # of the median, and at least, at the organ
_MOST_DROPPED = 0.25
_FAR_OFF_MM = 5.0  # median: poses and pictures that do not belong together
_WRONG_SIZE, _DOUBTED_SIZE = 0.02, 2.5  # of the board: refused; standard deviations: warned of
_CONFIDENCE, _DRAWS = 0.95, 4000
_BAND = 1 / 3  # of the stated distance, to either side, in which the written bound holds

_METHODS = {
    name: getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}")
    for name in ("Tsai", "Park", "Horaud", "Andreff", "Daniilidis")
} | {name: getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}") for name in ("Shah", "Li")}
REFINED = "least squares"


@dataclass(frozen=True, eq=False)
class _Data:
    """Of the pictures that are used."""

    fixed_from_moving: Poses
    camera_from_board: Poses
    rays: list[Float64[np.ndarray, "n 3"]]  # where corners are seen, z = 1
    board_mm: list[Float64[np.ndarray, "n 3"]]
    focal_px: float

    def only(self, kept: np.ndarray) -> _Data:
        """Of these pictures' numbers."""
        lists = [[those[n] for n in kept] for those in (self.rays, self.board_mm)]
        return _Data(
            self.fixed_from_moving[kept], self.camera_from_board[kept], *lists, self.focal_px
        )


@dataclass(frozen=True, eq=False)
class _Answer:
    """``moving_from_camera`` and ``fixed_from_board``; ``size``: of the board by the robot's
    millimetres, times that which was stated."""

    moving_from_camera: Affine
    fixed_from_board: Affine
    size: float = 1.0


def solve(
    fixed_from_moving: Poses,
    seen: list[Corners],
    names: list[str],
    lens: Lens,
    distance_mm: float,
) -> tuple[Affine, dict[str, Any], list[str]]:
    """``moving_from_camera``, a report with the bounds of its error ``distance_mm`` before the
    camera, and warnings. Raises InputError: the poses do not determine it, or don't fit."""
    places = [lens.place(one)[0] for one in seen]
    data = _Data(
        fixed_from_moving,
        np.array(places),
        [lens.rays(one.pixels) for one in seen],
        [one.board_mm for one in seen],
        lens.fx,
    )
    _check_unit(data)
    _turns(data.fixed_from_moving)
    kept, dropped_mm = _agreeing(data, distance_mm)
    data, warnings = data.only(kept), []
    turned = _turns(data.fixed_from_moving)
    if turned[1] < _FEW_TURN:
        warnings.append(
            f"between pictures the wrist turned by {turned[0]:.0f} degrees about one axis, and by "
            f"{turned[1]:.0f} about others (root mean square): turn it by 20 degrees or more about "
            "two axes"
        )
    dropped = {names[n]: round(off_mm, 2) for n, off_mm in dropped_mm.items()}
    warnings += [f"{name} left out: {off} mm off at the organ" for name, off in dropped.items()]
    answers = {name: _with_each_left_out(name, data) for name in (*_METHODS, REFINED)}
    tried = {name: both for name, both in answers.items() if both is not None}
    loo_mm = {name: _left_out_mm(data, each, distance_mm) for name, (_, each) in tried.items()}
    best = min(tried, key=lambda name: float(np.sqrt(np.mean(loo_mm[name] ** 2))))
    answer, each = tried[best]
    at_mm = _points(distance_mm)
    spread_mm = {
        name: float(_apart_mm(one.moving_from_camera, answer.moving_from_camera, at_mm).max())
        for name, (one, _) in tried.items()
    }
    bound = _bounds(answer, each, distance_mm)
    size, size_std = _size(tried[REFINED])
    if abs(size - 1) > _WRONG_SIZE:
        raise InputError(
            f"by the robot's millimetres the board is {size:.3f} times as large as stated: give "
            "the true --square-mm, intrinsics of these pictures, and poses in their true unit."
        )
    if abs(size - 1) > max(_DOUBTED_SIZE * size_std, 1e-3):
        warnings.append(
            f"by the robot's millimetres the board is {100 * (size - 1):+.2f} % larger than stated "
            f"(+- {100 * size_std:.2f}): measure its print, and calibrate the camera again"
        )
    report = {
        "pictures": len(seen),
        "used": len(kept),
        "left_out_mm": dropped,
        "turns_degrees": [round(float(one), 1) for one in turned],
        "distance_mm": distance_mm,
        "method": best,
        "methods": {
            name: {
                "leave_one_out_rms_mm": float(np.sqrt(np.mean(loo_mm[name] ** 2))),
                "leave_one_out_largest_mm": float(loo_mm[name].max()),
                "from_chosen_mm": spread_mm[name],
            }
            for name in tried
        },
        "failed": [name for name, both in answers.items() if both is None],
        "board_size": size,
        "board_size_std": size_std,
        "confidence": _CONFIDENCE,
        **bound,
    }
    return answer.moving_from_camera, report, warnings


def _check_unit(data: _Data) -> None:
    """Raises InputError: too few, or tool and camera moved by lengths that are thousands apart."""
    count = len(data.fixed_from_moving)
    if count < LEAST_POSES:
        raise InputError(
            f"the board is in {count} pictures with poses; at least {LEAST_POSES} are needed, "
            "better 20, with the wrist turned by 20 degrees or more about two axes."
        )
    robot_mm, camera_mm = (
        float(np.median(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)))
        for poses in (np.linalg.inv(data.fixed_from_moving), np.linalg.inv(data.camera_from_board))
    )
    if not camera_mm / _UNIT < robot_mm < camera_mm * _UNIT:
        raise InputError(
            f"between pictures the robot moved by {robot_mm:.3g} mm (median) and the camera before "
            f"the board by {camera_mm:.3g} mm: is the poses' unit (mm or m) right?"
        )


def _turns(poses: Poses) -> Float64[np.ndarray, " 3"]:
    """Root mean square turns between any two poses about their main axes, degrees, largest first.
    Raises InputError: about one axis alone, or hardly any."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    first, second = np.triu_indices(len(poses), 1)
    vectors = np.degrees((turns[first].inv() * turns[second]).as_rotvec())
    about = np.sqrt(np.linalg.eigvalsh(vectors.T @ vectors / len(vectors))[::-1].clip(0))
    if about[1] < _LEAST_TURN:
        raise InputError(
            f"the poses do not determine where the camera is: between pictures the wrist turned by "
            f"{about[0]:.0f} degrees about one axis, and by {about[1]:.1f} about any other (root "
            "mean square). Turn the wrist by at least 20 degrees about two axes."
        )
    return about


def _agreeing(data: _Data, distance_mm: float) -> tuple[np.ndarray, dict[int, float]]:
    """Numbers of the pictures that fit together, and how far off the others are, mm. Raises
    InputError: too few do."""

    def off_mm(data: _Data) -> np.ndarray:
        return _off_mm(data, _refined(data, _start(data), robust=True), distance_mm)

    each_mm = off_mm(data)
    middle_mm = float(np.median(each_mm))
    good = each_mm <= max(_OUTLIER_TIMES * middle_mm, _OUTLIER_MM)
    if middle_mm > _FAR_OFF_MM or np.mean(~good) > _MOST_DROPPED or good.sum() < LEAST_POSES:
        turned = _Data(
            np.linalg.inv(data.fixed_from_moving), data.camera_from_board, data.rays,
            data.board_mm, data.focal_px,
        )  # fmt: skip
        hint = "are they in the pictures' order, and of the same moments?"
        if float(np.median(off_mm(turned))) < 0.2 * middle_mm:
            hint = (
                "inverted they do. Give base_from_tool, --eye-to-hand where the board is on the "
                "tool, and leave that out where the camera is."
            )
        raise InputError(
            f"poses and pictures do not fit together: {middle_mm:.1f} mm at the organ (median), "
            f"{int((~good).sum())} of {len(good)} pictures far off; {hint}"
        )
    return np.flatnonzero(good), {int(n): float(each_mm[n]) for n in np.flatnonzero(~good)}


def _opencv(name: str, data: _Data) -> _Answer | None:
    """None: this solver has no answer."""
    camera, moving = data.camera_from_board, data.fixed_from_moving
    back = np.linalg.inv(moving)
    try:
        if name in ("Shah", "Li"):
            *_, turn, shift = cv2.calibrateRobotWorldHandEye(
                list(camera[:, :3, :3]), list(camera[:, :3, 3]),
                list(back[:, :3, :3]), list(back[:, :3, 3]), method=_METHODS[name],
            )  # fmt: skip
            moving_from_camera = np.linalg.inv(rigid(turn, shift.ravel()))
        else:
            turn, shift = cv2.calibrateHandEye(
                list(moving[:, :3, :3]), list(moving[:, :3, 3]),
                list(camera[:, :3, :3]), list(camera[:, :3, 3]), method=_METHODS[name],
            )  # fmt: skip
            moving_from_camera = rigid(turn, shift.ravel())
    except (cv2.error, np.linalg.LinAlgError):
        return None
    turn = moving_from_camera[:3, :3]
    if not np.isfinite(moving_from_camera).all() or abs(np.linalg.det(turn) - 1) > 1e-3:
        return None
    boards = moving @ moving_from_camera @ camera
    middle = rigid(
        Rotation.from_matrix(boards[:, :3, :3]).mean().as_matrix(), np.median(boards[:, :3, 3], 0)
    )
    return _Answer(moving_from_camera, middle)


def _start(data: _Data) -> _Answer:
    """The solver's answer whose pictures agree best."""
    found = [one for name in _METHODS if (one := _opencv(name, data)) is not None]
    if not found:
        raise InputError("no solver finds where the camera is from these poses and pictures.")
    return min(found, key=lambda one: float(np.median(_off_mm(data, one, 1.0))))


def _moved(answer: _Answer, by: np.ndarray) -> _Answer:
    """``by``: camera's turn (rad) and shift (mm), board's, and its size (13)."""
    turns = Rotation.from_rotvec(by[[[0, 1, 2], [6, 7, 8]]]).as_matrix()
    camera, board = (rigid(turns[n], by[6 * n + 3 : 6 * n + 6]) for n in (0, 1))
    return _Answer(
        answer.moving_from_camera @ camera,
        answer.fixed_from_board @ board,
        answer.size * (1 + by[12]),
    )


def _residuals(data: _Data, answer: _Answer) -> np.ndarray:
    """Of all corners, px."""
    camera_from_fixed = np.linalg.inv(data.fixed_from_moving @ answer.moving_from_camera)
    each = camera_from_fixed @ answer.fixed_from_board
    rest = []
    for camera_from_board, on_mm, rays in zip(each, data.board_mm, data.rays, strict=True):
        at = on_mm @ camera_from_board[:3, :3].T * answer.size + camera_from_board[:3, 3]
        rest.append((at[:, :2] / at[:, 2:] - rays[:, :2]).ravel())
    return np.concatenate(rest) * data.focal_px


def _fit(data: _Data, start: _Answer, robust: bool) -> Any:
    loss = {"loss": "cauchy", "f_scale": 1.0} if robust else {}
    scale = np.array([0.01, 0.01, 0.01, 1, 1, 1] * 2 + [0.01])
    return least_squares(
        lambda by: _residuals(data, _moved(start, by)), np.zeros(13), x_scale=scale, **loss
    )


def _refined(data: _Data, start: _Answer, robust: bool = False) -> _Answer:
    return _moved(start, _fit(data, start, robust).x)


def _with_each_left_out(name: str, data: _Data) -> tuple[_Answer, list[_Answer]] | None:
    """The answer, and that without each of the pictures; of least squares by one step from it."""
    count = len(data.rays)
    if name != REFINED:
        every = np.arange(count)
        answer = _opencv(name, data)
        each = [_opencv(name, data.only(np.delete(every, n))) for n in every]
        found = [one for one in each if one is not None]
        return None if answer is None or len(found) < count else (answer, found)
    answer = _refined(data, _start(data))
    again = _fit(data, answer, False)
    ends = np.cumsum([2 * len(one) for one in data.rays])[:-1]
    jacobians, rests = np.split(again.jac, ends), np.split(again.fun, ends)
    whole = again.jac.T @ again.jac
    steps = [
        np.linalg.solve(whole - its.T @ its, its.T @ rest)
        for its, rest in zip(jacobians, rests, strict=True)
    ]
    answer = _moved(answer, again.x)
    return answer, [_moved(answer, step) for step in steps]


def _off_mm(data: _Data, answer: _Answer, distance_mm: float) -> np.ndarray:
    """By picture: how far a point so far before the camera is by the robot from where it is by the
    board."""
    point = np.array([0, 0, distance_mm, 1.0])
    by_board = answer.fixed_from_board @ np.linalg.inv(_sized(data.camera_from_board, answer.size))
    by_robot = data.fixed_from_moving @ answer.moving_from_camera
    return np.linalg.norm(((by_robot - by_board) @ point)[:, :3], axis=1)


def _sized(camera_from_board: Poses, size: float) -> Poses:
    """The board's places if it is so much larger than stated."""
    places = camera_from_board.copy()
    places[:, :3, 3] *= size
    return places


def _left_out_mm(data: _Data, each: list[_Answer], distance_mm: float) -> np.ndarray:
    """The same, each picture by the answer that it took no part in."""
    return np.array(
        [_off_mm(data.only(np.array([n])), one, distance_mm)[0] for n, one in enumerate(each)]
    )


def _points(distance_mm: float) -> Float64[np.ndarray, "5 3"]:
    """So far before the camera: in the middle, and at the sides of a field of 40 degrees."""
    side = 0.36 * distance_mm
    across = np.array([[0, 0], [side, 0], [-side, 0], [0, side], [0, -side]])
    return np.column_stack([across, np.full(5, distance_mm)])


def _apart_mm(one: Affine, other: Affine, points_mm: np.ndarray) -> np.ndarray:
    return np.linalg.norm(
        transform_points(one, points_mm) - transform_points(other, points_mm), axis=1
    )


def _bounds(answer: _Answer, each: list[_Answer], distance_mm: float) -> dict[str, Any]:
    """By the jackknife: how far the answers without one picture each are from the answer is how far
    that is from the truth, as Student's t of as many degrees of freedom as pictures are beyond the
    unknowns of the camera's place. ``error_mm`` and ``error_deg`` are the line, least at the stated
    distance, that is above the bound from 2 / 3 to 4 / 3 of it."""
    count = len(each)
    back = np.linalg.inv(answer.moving_from_camera)
    apart = [back @ one.moving_from_camera for one in each]
    turns = Rotation.from_matrix([one[:3, :3] for one in apart]).as_rotvec()
    steps = np.column_stack([turns, [one[:3, 3] for one in apart]])
    spread = (count - 1) / count * (steps - steps.mean(0)).T @ (steps - steps.mean(0))
    free = count - 6
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(spread + 1e-18 * np.eye(6))
    draws = rng.normal(size=(_DRAWS, 6)) @ root.T
    draws *= np.sqrt(free / rng.chisquare(free, (_DRAWS, 1)))

    def bound_mm(at_mm: float) -> float:
        points = _points(at_mm)
        shifted = np.cross(draws[:, None, :3], points) + draws[:, None, 3:]
        return float(np.quantile(np.linalg.norm(shifted, axis=2).max(1), _CONFIDENCE))

    low, high = (1 - _BAND) * distance_mm, (1 + _BAND) * distance_mm
    at_mm = np.linspace(low, high, 5)
    bounds_mm = np.array([bound_mm(one) for one in at_mm])
    slopes = np.linspace(0, bounds_mm.max() / low, 50)
    bases = np.array([(bounds_mm - slope * at_mm).max() for slope in slopes])
    best = int(np.argmin(np.where(bases > 0, bases + slopes * distance_mm, np.inf)))
    return {
        "error_at_organ_mm": bound_mm(distance_mm),
        "error_turn_degrees": float(
            np.degrees(np.quantile(np.linalg.norm(draws[:, :3], axis=1), _CONFIDENCE))
        ),
        "holds_from_mm": low,
        "holds_to_mm": high,
        "error_mm": float(bases[best]),
        "error_deg": float(np.degrees(slopes[best])),
    }


def _size(both: tuple[_Answer, list[_Answer]]) -> tuple[float, float]:
    """The board's, and its deviation."""
    answer, each = both
    sizes = np.array([one.size for one in each])
    return answer.size, float(np.sqrt((len(sizes) - 1) * np.var(sizes)))
