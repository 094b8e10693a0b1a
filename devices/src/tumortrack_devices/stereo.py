"""Depth from two cameras side by side, such as a stereo endoscope: OpenCV's rectification and
semi-global matching (Hirschmüller 2008, doi 10.1109/TPAMI.2007.1166).

The depth image is the rectified left camera's. That one stands where the left camera does, and is
turned against it by ``StereoRig.rectified_from_left``, mostly by less than a few degrees.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, UInt8

from tumortrack.core.camera import plausible
from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import read_rigid
from tumortrack.core.packages import to_install
from tumortrack.core.store import read_file
from tumortrack.core.types import DepthFrame, Intrinsics

Rows = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]

_LARGEST_FILE = 2**20  # bytes, of a calibration
# Of OpenCV's YAML, which is no YAML: a matrix, and a number or word, each at a line's beginning.
_MATRIX = re.compile(
    r"^(\w+): *!!opencv-matrix\s+rows: *(\d+)\s+cols: *(\d+)\s+dt: *\w+\s+data: *\[([^\]]*)\]", re.M
)
_PLAIN = re.compile(r'^(\w+): *("?[\w.+-]+"?) *$', re.M)
_BASELINE_MM = (1.0, 300.0)  # a stereo endoscope has 4 to 6
_LARGEST_TURN = 0.5  # rad: cameras that look elsewhere share too little
_STEPS = 16  # SGBM's disparities are in sixteenths of a pixel, and their range in whole 16 pixels
_SAME_PX = 1  # the check from right to left
_SPECKLE = 200, 2  # a patch of fewer pixels whose disparity differs by more is a false match


class StereoCalibration(Config, frozen=True, kw_only=True):
    """What ``cv2.stereoCalibrate`` finds, by OpenCV's names: each camera's matrix (px) and lens
    distortion, and ``R``, ``T``, which carry points of the left camera into the right one's frame.
    ``unit``: of T, which is that of the board's squares."""

    width: int  # of the pictures, px
    height: int
    K1: Rows
    D1: tuple[float, ...]
    K2: Rows
    D2: tuple[float, ...]
    R: Rows
    T: tuple[float, float, float]
    unit: Literal["mm", "m"] = "mm"


def read_calibration(path: Path) -> StereoCalibration:
    """From JSON or YAML: matrices as ``cv2.FileStorage`` writes them, or plain lists of JSON; what
    else the file holds is ignored. OpenCV's own reader is not asked: damaged files end it, and the
    process with it. Raises InputError: missing, damaged, or it lacks something."""
    text = read_file(path, _LARGEST_FILE).decode("utf-8", "replace")
    try:
        found = _of_yaml(text) if text.startswith("%YAML") else json.loads(text)
        names = found.keys() & set(StereoCalibration.__struct_fields__)
        given = {name: _value(found[name]) for name in names}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path} is no calibration in JSON or in OpenCV's YAML. Write it by cv2.FileStorage, "
            "as .json or .yaml."
        ) from error
    for name in given.keys() & {"D1", "D2", "T"}:  # columns, or rows
        rows = given[name]
        if isinstance(rows, list) and all(isinstance(row, list) for row in rows):
            given[name] = [number for row in rows for number in row]
    return from_builtins(given, StereoCalibration, str(path))


def _of_yaml(text: str) -> dict[str, Any]:
    """The numbers, words and matrices at the top."""
    matrices = {
        name: {"rows": int(rows), "cols": int(cols), "data": list(map(float, data.split(",")))}
        for name, rows, cols, data in _MATRIX.findall(text)
    }
    plain = {name: word.strip('"') for name, word in _PLAIN.findall(text)}
    return matrices | {name: int(w) if w.isdecimal() else w for name, w in plain.items()}


def _value(given: Any) -> Any:
    """Rows of a matrix, or what is none as it is. ValueError: its size is not what it claims."""
    if not isinstance(given, dict):
        return given
    return np.reshape(given["data"], (given["rows"], given["cols"])).tolist()


class StereoRig:
    """Two calibrated cameras. ``intrinsics``: of the rectified left one, in pixels; ``baseline_mm``
    between the two. Depths from ``near_mm`` to ``far_mm`` are looked for, by blocks of ``block_px``
    (odd) pixels a side."""

    def __init__(
        self,
        calibration: StereoCalibration,
        near_mm: float = 50.0,
        far_mm: float = 400.0,
        block_px: int = 7,
        where: str = "stereo",
    ) -> None:
        """Raises InputError, which ``where`` opens: numbers that can be no such pair's, or depths
        too near for it; OpenCV is missing."""
        cv2, given = opencv(), calibration
        size, left, right = (given.width, given.height), np.array(given.K1), np.array(given.K2)
        for name, k in (("K1", left), ("K2", right)):
            camera = Intrinsics(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
            plausible(camera, f"{where}: {name}")
        rows = [[*turn, shift] for turn, shift in zip(given.R, given.T, strict=True)]
        right_from_left = read_rigid([*rows, [0, 0, 0, 1]], given.unit, f"{where}: R, T")
        turn, shift_mm = right_from_left[:3, :3], right_from_left[:3, 3]
        _check_place(turn, shift_mm, where)
        lenses = left, np.array(given.D1), right, np.array(given.D2)
        try:
            # alpha=0: only pixels that both cameras have.
            turn1, turn2, p1, p2, *_ = cv2.stereoRectify(*lenses, size, turn, shift_mm, alpha=0)
            self._maps = [
                cv2.initUndistortRectifyMap(*lens, to, p[:, :3], size, cv2.CV_32FC1)
                for lens, to, p in ((lenses[:2], turn1, p1), (lenses[2:], turn2, p2))
            ]
        except cv2.error as error:
            raise InputError(f"{where}: cannot be rectified by OpenCV ({error}).") from error
        self.rectified_from_left: Float64[np.ndarray, "3 3"] = turn1
        self.baseline_mm = float(np.linalg.norm(shift_mm))
        camera = Intrinsics(*size, p1[0, 0], p1[1, 1], p1[0, 2], p1[1, 2])
        self.intrinsics = plausible(camera, f"{where}, rectified")
        self._cv2 = cv2
        per_mm = self.intrinsics.fx * self.baseline_mm
        least = int(per_mm / far_mm)
        count = -(-int(per_mm / near_mm + 2 - least) // _STEPS) * _STEPS
        if count > self.intrinsics.width // 2:
            raise InputError(
                f"{where}: at near_mm={near_mm:g} things are {per_mm / near_mm:.0f} pixels apart "
                "in the two pictures, too far to be matched. Give a larger near_mm."
            )
        self._matcher = cv2.StereoSGBM_create(
            minDisparity=least,
            numDisparities=count,
            blockSize=block_px,
            P1=8 * block_px**2,  # both as OpenCV's documentation advises
            P2=32 * block_px**2,
            disp12MaxDiff=_SAME_PX,
            uniquenessRatio=5,
            speckleWindowSize=_SPECKLE[0],
            speckleRange=_SPECKLE[1],
        )

    def rectified(
        self, left: UInt8[np.ndarray, "h w *rgb"], right: UInt8[np.ndarray, "h w *rgb"]
    ) -> tuple[UInt8[np.ndarray, "h w *rgb"], UInt8[np.ndarray, "h w *rgb"]]:
        """Both pictures with the same things in the same rows. Raises InputError: of another size
        than the calibration's."""
        size = self.intrinsics.height, self.intrinsics.width
        if {left.shape[:2], right.shape[:2]} != {size}:
            sizes = " and ".join(f"{one.shape[1]} x {one.shape[0]}" for one in (left, right))
            raise InputError(
                f"pictures of {sizes} came; the calibration is for {size[1]} x {size[0]}. "
                "Calibrate at the size that is used."
            )
        cv2, (to_left, to_right) = self._cv2, self._maps
        one = cv2.remap(left, *to_left, cv2.INTER_LINEAR)
        return one, cv2.remap(right, *to_right, cv2.INTER_LINEAR)

    def depth(
        self,
        left: UInt8[np.ndarray, "h w *rgb"],
        right: UInt8[np.ndarray, "h w *rgb"],
        stamp_ns: int = 0,
    ) -> DepthFrame:
        """The depth image of rectified pictures, mm. No return (NaN): no match, one of several like
        ones, or another match from right to left."""
        grey = [
            self._cv2.cvtColor(one, self._cv2.COLOR_RGB2GRAY) if one.ndim == 3 else one
            for one in (left, right)
        ]
        disparity_px = self._matcher.compute(*grey).astype(np.float32) / _STEPS
        found = disparity_px > self._matcher.getMinDisparity()
        depth_mm = np.full(disparity_px.shape, np.nan, np.float32)
        np.divide(self.intrinsics.fx * self.baseline_mm, disparity_px, depth_mm, where=found)
        return DepthFrame(depth_mm, self.intrinsics, stamp_ns)


def _check_place(turn: np.ndarray, shift_mm: np.ndarray, where: str) -> None:
    """Raises InputError: the right camera can't stand there."""
    baseline_mm, (low, high) = float(np.linalg.norm(shift_mm)), _BASELINE_MM
    if not low <= baseline_mm <= high:
        looks = "it looks like metres: write unit m" if baseline_mm < low else "is it in mm?"
        raise InputError(
            f"{where}: T says that the cameras are {baseline_mm:g} mm apart; allowed: {low:g} to "
            f"{high:g} mm ({looks}; it has the unit of the squares)."
        )
    if np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) > _LARGEST_TURN:
        raise InputError(f"{where}: R turns by more than 29 degrees; both must look the same way.")
    if -shift_mm[0] < 0.9 * baseline_mm:
        raise InputError(
            f"{where}: T is ({', '.join(f'{x:.3g}' for x in shift_mm)}) mm. The second camera must "
            "stand to the right of the first, so T is mainly -x: exchange the two, or turn both "
            "pictures if they stand above each other."
        )


def opencv() -> ModuleType:
    """OpenCV. Raises InputError where it is missing."""
    try:
        import cv2
    except ImportError as error:
        raise InputError(
            f"stereo pictures need OpenCV: {to_install('tumortrack-devices[stereo]')} ({error})."
        ) from error
    return cv2
