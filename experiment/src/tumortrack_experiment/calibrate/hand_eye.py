"""Where a camera is on a robot's tool, or before its base, from pictures of a board.

One equation holds both: ``fixed_from_moving @ moving_from_camera @ camera_from_board`` is the same
in all pictures. Eye in hand: fixed is the base, moving the tool. A board on the tool: fixed is the
tool, moving the base. OpenCV's solvers answer it. Least squares follow on how far robot and board
disagree, seen from the tool, where the robot errs: on the corners' pixels they were 1.4 to
1.8 times worse than Park's solver, here they are up to a quarter better
(docs/decisions/050-hand-eye-on-pixels.md).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, rigid, transform_points

Poses = Float64[np.ndarray, "n 4 4"]

LEAST_POSES = 8  # six numbers, and something left to judge them by
_LEAST_TURN, _FEW_TURN = 4.0, 10.0  # degrees about the second axis: refused, warned of
_UNIT = 50.0  # times that robot and camera may move differently
_OUTLIER_TIMES, _OUTLIER_MM = 4.0, 0.5  # of the median, and at least, at the organ
_MOST_DROPPED, _FAR_OFF_MM = 0.25, 5.0  # share; median: poses of other pictures
_WRONG_SIZE, _DOUBTED, _DOUBTED_SIZE = 0.02, 2.5, 1e-3  # of the board: refused; deviations, share
_ARM_MM = 150.0  # per radian: robots that err by 0.05 mm err by 0.02 degrees
_CONFIDENCE, _DRAWS = 0.95, 4000
# Of the distance: two deviations of the focal length, each of which moves the answer by 1.7 of it.
_LENS, _UNKNOWN_FOCAL = 3.5, 1e-3  # a device states no deviation
_BAND = 1 / 3  # of the stated distance, to either side, in which the written bound holds
_HAND, _WORLD = "CALIB_HAND_EYE_", "CALIB_ROBOT_WORLD_HAND_EYE_"
_SOLVERS: dict[str, int] = {
    name: getattr(cv2, (_WORLD if name in ("Shah", "Li") else _HAND) + name.upper())
    for name in ("Tsai", "Park", "Horaud", "Andreff", "Daniilidis", "Shah", "Li")
}
_FREE = "least squares, board's size free"
_LEAST_SQUARES = {"least squares": 12, _FREE: 13}  # unknown numbers
_SCALES = np.array([0.01, 0.01, 0.01, 1, 1, 1, 0.01, 0.01, 0.01, 1, 1, 1, 0.01])


class HandEyeData(NamedTuple):
    """By picture: ``fixed_from_moving`` and ``camera_from_board``, mm. ``to_hand``: the tool is
    what is fixed, with the board on it."""

    moving: Poses
    board: Poses
    to_hand: bool = False

    def only(self, kept: np.ndarray) -> HandEyeData:
        return HandEyeData(self.moving[kept], self.board[kept], self.to_hand)


class _Answer(NamedTuple):
    """``moving_from_camera``, ``fixed_from_board``, and the board's ``size`` by the robot's
    millimetres, times that which was stated."""

    camera: Affine
    board: Affine
    size: float = 1.0

    def off(self, data: HandEyeData) -> Poses:
        """Where the robot has what moves, by where it is by the board."""
        seen = data.board.copy()
        seen[:, :3, 3] *= self.size
        return np.linalg.inv(data.moving) @ self.board @ np.linalg.inv(self.camera @ seen)

    def off_mm(self, data: HandEyeData, at_mm: float) -> Float64[np.ndarray, " n"]:
        """By picture: how far the two disagree so far before the camera."""
        point = self.camera @ [0, 0, at_mm, 1]
        return np.linalg.norm((self.off(data) @ point - point)[:, :3], axis=1)


def solve(
    data: HandEyeData, names: list[str], at_mm: float, focal_std: float = 0.0
) -> tuple[Affine, dict[str, Any], list[str]]:
    """``moving_from_camera``, a report with bounds of its error so far before the camera, and
    warnings. ``focal_std``: of the focal length, as a share; 0: unknown. Raises InputError: the
    poses do not determine it, or don't fit."""
    _check_unit(data)
    turned(data.moving)
    good = _agreeing(data, at_mm)
    data, about = data.only(np.flatnonzero(good)), turned(data.moving[good])
    warnings = [f"{names[n]} left out: it does not fit the others" for n in np.flatnonzero(~good)]
    if about[1] < _FEW_TURN:
        warnings.append(
            f"the wrist turned by {about[0]:.0f} degrees about one axis, and by {about[1]:.0f} "
            "about others (root mean square): turn it by 20 or more about two axes"
        )
    methods = *_SOLVERS, *_LEAST_SQUARES
    tried = {name: one for name in methods if (one := _left_out(name, data)) is not None}
    rms_mm = {name: _left_out_mm(data, each, at_mm) for name, (_, each) in tried.items()}
    best = min(rms_mm, key=lambda name: rms_mm[name])
    answer, each = tried[best]
    sized, others = tried[_FREE]
    size, size_std = sized.size, np.sqrt((len(others) - 1) * np.var([one.size for one in others]))
    if abs(size - 1) > _WRONG_SIZE:
        raise InputError(
            f"by the robot's millimetres the board is {size:.3f} times as large as stated: give "
            "the true --square-mm, these pictures' lens, and poses in their true unit."
        )
    if abs(size - 1) > max(_DOUBTED * size_std, _DOUBTED_SIZE):
        warnings.append(
            f"by the robot's millimetres the board is {100 * (size - 1):+.2f} % larger than stated "
            f"(+- {100 * size_std:.2f}): measure its print, and calibrate the camera again"
        )
    points_mm = _points(at_mm)
    said = {
        "pictures": len(names),
        "used": int(good.sum()),
        "left_out": [names[n] for n in np.flatnonzero(~good)],
        "turned_degrees": about.tolist(),
        "at_mm": at_mm,
        "method": best,
        "left_out_rms_mm": rms_mm,
        "from_chosen_mm": {
            name: float(_distance_mm(one.camera, answer.camera, points_mm).max())
            for name, (one, _) in tried.items()
        },
        "board_size": float(size),
        "board_size_std": float(size_std),
        **_bounds(answer, each, at_mm, focal_std or _UNKNOWN_FOCAL),
    }
    return answer.camera, said, warnings


def described(said: dict[str, Any]) -> list[str]:
    """Lines of a report."""
    lines = [
        f"{name}: {rms_mm:.2f} mm off where it was left out (root mean square), "
        f"{said['from_chosen_mm'][name]:.2f} mm from the chosen one"
        for name, rms_mm in said["left_out_rms_mm"].items()
    ]
    return [
        *lines,
        f"{said['method']}, {said['used']} of {said['pictures']} poses: with "
        f"{100 * said['confidence']:g} % confidence within {said['bound_mm']:.2f} mm at "
        f"{said['at_mm']:g} mm",
    ]


def _check_unit(data: HandEyeData) -> None:
    """Raises InputError: too few, or robot and camera moved by lengths that are thousands apart."""
    if len(data.moving) < LEAST_POSES:
        raise InputError(
            f"the board is in {len(data.moving)} pictures; at least {LEAST_POSES} are needed, "
            "better 20, with the wrist turned by 20 degrees or more about two axes."
        )
    robot_mm, camera_mm = (
        float(np.median(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)))
        for poses in (data.moving, np.linalg.inv(data.board))
    )
    if not camera_mm / _UNIT < robot_mm < camera_mm * _UNIT:
        raise InputError(
            f"between pictures the robot moved by {robot_mm:.3g} mm (median) and the camera before "
            f"the board by {camera_mm:.3g} mm: is the poses' unit (mm or m) right?"
        )


def turned(poses: Poses) -> Float64[np.ndarray, " 3"]:
    """Root mean square turns between any two poses about their main axes, degrees, largest first.
    Raises InputError: about one axis alone, or hardly any."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    first, second = np.triu_indices(len(poses), 1)
    vectors = np.degrees((turns[first].inv() * turns[second]).as_rotvec())
    about = np.sqrt(np.linalg.eigvalsh(vectors.T @ vectors / len(vectors))[::-1].clip(0))
    if about[1] < _LEAST_TURN:
        raise InputError(
            f"the poses do not determine where the camera is: the wrist turned by {about[0]:.0f} "
            f"degrees about one axis, and by {about[1]:.1f} about any other (root mean square). "
            "Turn it by at least 20 degrees about two axes."
        )
    return about


def _agreeing(data: HandEyeData, at_mm: float) -> np.ndarray:
    """Which pictures fit together. Raises InputError: too few do."""

    def off_mm(data: HandEyeData) -> np.ndarray:
        start = _solved(data)
        fitted = _fit(data, start, 13, loss="cauchy", f_scale=0.3)  # a wrong size is said later
        return _moved(start, fitted.x).off_mm(data, at_mm)

    each_mm = off_mm(data)
    middle_mm = float(np.median(each_mm))
    good = each_mm <= max(_OUTLIER_TIMES * middle_mm, _OUTLIER_MM)
    if middle_mm > _FAR_OFF_MM or np.mean(~good) > _MOST_DROPPED or good.sum() < LEAST_POSES:
        hint = "are they in the pictures' order, and of the same moments?"
        if (
            np.median(off_mm(HandEyeData(np.linalg.inv(data.moving), data.board, not data.to_hand)))
            < 0.2 * middle_mm
        ):
            hint = (
                "inverted they do. Where the board is on the tool and the camera stands, add "
                "--eye-to-hand; where the camera is on the tool, leave that out. Only if that is "
                "right already the file holds tool_from_base: give base_from_tool."
            )
        far = int((~good).sum())
        others = f", {far} of {len(good)} much farther" if far else ""
        raise InputError(
            f"poses and pictures do not fit together: they are {middle_mm:.1f} mm off at the organ "
            f"(median){others}; {hint}"
        )
    return good


def _opencv(name: str, data: HandEyeData) -> _Answer | None:
    """None: this solver has no answer."""

    def parts(poses: Poses) -> tuple[list[np.ndarray], list[np.ndarray]]:
        return list(poses[:, :3, :3]), list(poses[:, :3, 3])

    try:
        if name in ("Shah", "Li"):
            given = *parts(data.board), *parts(np.linalg.inv(data.moving))
            *_, turn, shift = cv2.calibrateRobotWorldHandEye(*given, method=_SOLVERS[name])
            camera = np.linalg.inv(rigid(turn, shift.ravel()))
        else:
            given = *parts(data.moving), *parts(data.board)
            turn, shift = cv2.calibrateHandEye(*given, method=_SOLVERS[name])
            camera = rigid(turn, shift.ravel())
    except (cv2.error, np.linalg.LinAlgError):
        return None
    if not np.isfinite(camera).all() or abs(np.linalg.det(camera) - 1) > 1e-3:
        return None
    boards = data.moving @ camera @ data.board
    turn = Rotation.from_matrix(boards[:, :3, :3]).mean().as_matrix()
    return _Answer(camera, rigid(turn, np.median(boards[:, :3, 3], axis=0)))


def _moved(answer: _Answer, by: np.ndarray) -> _Answer:
    """``by``: camera's turn (rad) and shift (mm), board's, and perhaps its growth."""
    camera, board = (
        rigid(Rotation.from_rotvec(by[n : n + 3]).as_matrix(), by[n + 3 : n + 6]) for n in (0, 6)
    )
    size = answer.size * (1 + by[12:].sum())
    return _Answer(answer.camera @ camera, answer.board @ board, size)


def _solved(data: HandEyeData) -> _Answer:
    """The solver's answer whose pictures agree best."""
    found = [one for name in _SOLVERS if (one := _opencv(name, data)) is not None]
    if not found:
        raise InputError("no solver finds where the camera is from these poses and pictures.")
    return min(found, key=lambda one: float(np.median(one.off_mm(data, _ARM_MM))))


def _fit(data: HandEyeData, start: _Answer, unknown: int = 12, **loss: Any) -> Any:
    """SciPy's least squares: six residuals a picture."""

    def rest(by: np.ndarray) -> np.ndarray:
        off = _moved(start, by).off(data)
        if data.to_hand:
            off = data.moving @ np.linalg.inv(data.moving @ off)
        turns = Rotation.from_matrix(off[:, :3, :3]).as_rotvec()
        return np.column_stack([off[:, :3, 3], _ARM_MM * turns]).ravel()

    return least_squares(rest, np.zeros(unknown), x_scale=_SCALES[:unknown], **loss)


def _left_out(name: str, data: HandEyeData) -> tuple[_Answer, list[_Answer]] | None:
    """A method's answer, and those without one picture each, of least squares by one step; None:
    one of them has none."""
    if unknown := _LEAST_SQUARES.get(name):
        start = _solved(data)
        answer = _moved(start, _fit(data, start, unknown).x)
        end = _fit(data, answer, unknown)
        jacobians, rests = end.jac.reshape(-1, 6, unknown), end.fun.reshape(-1, 6)
        whole = end.jac.T @ end.jac
        each = [
            _moved(answer, np.linalg.solve(whole - its.T @ its, its.T @ rest))
            for its, rest in zip(jacobians, rests, strict=True)
        ]
        return answer, each
    every = np.arange(len(data.moving))
    parts = [data.only(np.delete(every, n)) for n in every]
    answers = [_opencv(name, part) for part in (data, *parts)]
    found = [one for one in answers if one is not None]
    return (found[0], found[1:]) if len(found) == len(answers) else None


def _left_out_mm(data: HandEyeData, each: list[_Answer], at_mm: float) -> float:
    """How far each picture is off by the answer that it took no part in, root mean square."""
    off_mm = [one.off_mm(data.only(np.array([n])), at_mm)[0] for n, one in enumerate(each)]
    return float(np.sqrt(np.mean(np.square(off_mm))))


def _points(at_mm: float) -> Float64[np.ndarray, "5 3"]:
    """So far before the camera: in the middle, and at the sides of a field of 40 degrees."""
    across = 0.36 * at_mm * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    return np.column_stack([across, np.full(5, at_mm)])


def _distance_mm(one: Affine, other: Affine, points_mm: np.ndarray) -> np.ndarray:
    distance_mm = transform_points(one, points_mm) - transform_points(other, points_mm)
    return np.linalg.norm(distance_mm, axis=1)


def _bounds(answer: _Answer, each: list[_Answer], at_mm: float, focal_std: float) -> dict[str, Any]:
    """By the jackknife: the answers without one picture scatter as the answer does about the truth,
    after Student's t; the lens's own error comes on top. ``error_mm`` and ``error_deg`` are the
    line, least at the stated distance, that is above the bound from 2 / 3 to 4 / 3 of it."""
    count = len(each)
    apart = [np.linalg.inv(answer.camera) @ one.camera for one in each]
    turns = Rotation.from_matrix([one[:3, :3] for one in apart]).as_rotvec()
    steps = np.column_stack([turns, [one[:3, 3] for one in apart]])
    steps = (steps - steps.mean(0)) * np.sqrt((count - 1) / count)
    rng, free = np.random.default_rng(0), count - 2
    draws = rng.normal(size=(_DRAWS, count)) @ steps
    draws *= np.sqrt(free / rng.chisquare(free, (_DRAWS, 1)))

    def bound_mm(distance_mm: float) -> float:
        off_mm = np.cross(draws[:, None, :3], _points(distance_mm)) + draws[:, None, 3:]
        scatter_mm = np.quantile(np.linalg.norm(off_mm, axis=2).max(1), _CONFIDENCE)
        return float(scatter_mm + _LENS * focal_std * distance_mm)

    distances_mm = at_mm * np.linspace(1 - _BAND, 1 + _BAND, 5)
    bounds_mm = np.array([bound_mm(one) for one in distances_mm])
    slopes = np.linspace(0, bounds_mm.max() / distances_mm[0], 50)
    bases = (bounds_mm - slopes[:, None] * distances_mm).max(1)
    best = int(np.argmin(np.where(bases > 0, bases + slopes * at_mm, np.inf)))
    return {
        "confidence": _CONFIDENCE,
        "bound_mm": bound_mm(at_mm),
        "holds_mm": [float(distances_mm[0]), float(distances_mm[-1])],
        "error_mm": float(bases[best]),
        "error_deg": float(np.degrees(slopes[best])),
    }
