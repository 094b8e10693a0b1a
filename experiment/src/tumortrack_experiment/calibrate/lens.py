"""A camera's intrinsics with lens distortion, from pictures of a board, and how sure they are."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, rigid
from tumortrack.core.store import read_json
from tumortrack.core.types import Intrinsics
from tumortrack.sense.camera import plausible
from tumortrack.sense.files import read_intrinsics
from tumortrack_experiment.calibrate.board import Corners

LENS_FILE = "lens.json"
_NO_TANGENT = cv2.CALIB_ZERO_TANGENT_DIST
_NO_RADIAL = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
MODELS = {"none": _NO_TANGENT | _NO_RADIAL, "k1 k2 p1 p2": cv2.CALIB_FIX_K3, "k1 k2 p1 p2 k3": 0}
_LEAST_PICTURES = 8
_HELD_OUT = 4  # every so-many-th picture judges the models that were fitted without it
_BETTER = 0.98  # of the error of held-out pictures, for a model with more distortion to be taken
_UNSURE = 0.01  # of the focal length: as sure as training's cameras are of their depth
_BAD_PX, _BAD_TIMES = 1.0, 3.0  # a picture's error, and how many times the median's


class Lens(Config, frozen=True, kw_only=True):
    """Pixels; ``distortion``: k1, k2, p1, p2, k3 as OpenCV's; ``focal_std``: of the focal length,
    as a share of it; 0: nobody says."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0,) * 5
    focal_std: float = 0.0

    @property
    def camera(self) -> Intrinsics:
        """Without distortion."""
        return Intrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    @property
    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def rays(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        """Where pixels look, z = 1."""
        criteria = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-7
        flat = cv2.undistortPointsIter(
            pixels.reshape(-1, 1, 2), self.matrix, np.array(self.distortion), None, None, criteria
        ).reshape(-1, 2)
        return np.column_stack([flat, np.ones(len(flat))])

    def place(self, seen: Corners) -> tuple[Affine, float]:
        """``camera_from_board``, and the root mean square of what it leaves, px."""
        given = seen.board_mm, seen.pixels, self.matrix, np.array(self.distortion)
        _, turns, shifts, errors = cv2.solvePnPGeneric(*given, flags=cv2.SOLVEPNP_IPPE)
        best = int(np.argmin(errors))
        turn, shift = cv2.solvePnPRefineLM(*given, turns[best], shifts[best])
        again = cv2.projectPoints(seen.board_mm, turn, shift, *given[2:])[0].reshape(-1, 2)
        off_px = float(np.sqrt(((again - seen.pixels) ** 2).sum(1).mean()))
        return rigid(cv2.Rodrigues(turn)[0], shift.ravel()), off_px


def read_lens(path: Path) -> Lens:
    """A lens.json that `calibrate camera` wrote, or a camera without distortion (as `locate` takes
    it). Raises InputError: neither."""
    data = read_json(path)
    if "distortion" in data:
        lens = from_builtins(data, Lens, str(path))
        plausible(lens.camera, str(path))
        return lens
    one = read_intrinsics(path)
    return lens_of(one, np.zeros(5))


def lens_of(one: Intrinsics, distortion: np.ndarray, focal_std: float = 0.0) -> Lens:
    names = "width", "height", "fx", "fy", "cx", "cy"
    values: dict[str, Any] = {name: getattr(one, name) for name in names}
    k1, k2, p1, p2, k3 = map(float, np.ravel(distortion)[:5])
    return Lens(**values, distortion=(k1, k2, p1, p2, k3), focal_std=focal_std)


@lru_cache(maxsize=4)
def pixel_rays(lens: Lens, times: int = 1) -> Float64[np.ndarray, "h w 3"]:
    """Where every pixel looks, z = 1; ``times``: so many in its place each way."""
    down, right = (
        (np.arange(size * times) + 0.5) / times - 0.5 for size in (lens.height, lens.width)
    )
    pixels = np.stack(np.meshgrid(right, down), axis=-1).reshape(-1, 2)
    return lens.rays(pixels).reshape(len(down), len(right), 3)


class LensFit(NamedTuple):
    """``lens`` as it is best described, and ``pinhole`` without distortion, from the same pictures;
    ``std_px``: of fx, fy, cx, cy; ``held_out_px``: root mean square errors by model; ``used``: the
    pictures' numbers."""

    lens: Lens
    pinhole: Lens
    model: str
    std_px: tuple[float, ...]
    rms_px: float
    held_out_px: dict[str, float]
    used: list[int]


def fit_lens(seen: dict[int, Corners], size: tuple[int, int]) -> LensFit:
    """From the corners in several pictures, by their number. Raises InputError: too few, or none
    that tell how long the focal length is."""
    if len(seen) < _LEAST_PICTURES:
        raise InputError(
            f"the board is in {len(seen)} pictures; at least {_LEAST_PICTURES} are needed, better "
            "30, tilted by 20 to 45 degrees to all sides, near and far, up to the image's corners."
        )
    numbers = sorted(seen)
    _, errors_px, _ = _fit([seen[n] for n in numbers], size, MODELS["k1 k2 p1 p2"])
    limit_px = max(_BAD_PX, _BAD_TIMES * float(np.median(errors_px)))
    used = [n for n, error in zip(numbers, errors_px, strict=True) if error <= limit_px]
    kept = [corners for n, corners in enumerate(seen[n] for n in used) if n % _HELD_OUT]
    out = [seen[n] for n in used[::_HELD_OUT]]
    if len(kept) < _LEAST_PICTURES // 2:
        raise InputError(
            f"the board's corners lie {np.median(errors_px):.1f} px off where a camera would see "
            "them: is the board flat, and --squares right?"
        )
    held_out_px = {
        name: float(
            np.sqrt(np.mean([_fit(kept, size, flags)[0].place(one)[1] ** 2 for one in out]))
        )
        for name, flags in MODELS.items()
    }
    model = "none"
    for name, off_px in held_out_px.items():
        if off_px < _BETTER * held_out_px[model]:
            model = name
    lens, errors_px, std_px = _fit([seen[n] for n in used], size, MODELS[model])
    if lens.focal_std > _UNSURE:
        raise InputError(
            f"the focal length is unsure by {100 * lens.focal_std:.1f} %: tilt the board by 20 to "
            "45 degrees to all sides."
        )
    pinhole = _fit([seen[n] for n in used], size, MODELS["none"])[0]
    rms_px = float(np.sqrt(np.mean(np.square(errors_px))))
    return LensFit(lens, pinhole, model, tuple(std_px.tolist()), rms_px, held_out_px, used)


def _fit(
    seen: Sequence[Corners], size: tuple[int, int], flags: int
) -> tuple[Lens, Float64[np.ndarray, " n"], Float64[np.ndarray, " 4"]]:
    """The lens, each picture's error, and deviations of fx, fy, cx, cy; px."""
    points = [one.board_mm.astype(np.float32) for one in seen]
    pixels = [one.pixels.astype(np.float32) for one in seen]
    try:
        _, matrix, bent, _, _, std, _, errors = cv2.calibrateCameraExtended(
            points, pixels, size, None, None, flags=flags
        )
        camera = Intrinsics(*size, *map(float, matrix[[0, 1, 0, 1], [0, 1, 2, 2]]))
        plausible(camera, "these pictures")
    except (cv2.error, InputError) as error:
        raise InputError(
            "no camera explains these pictures: tilt the board by 20 to 45 degrees to all sides, "
            "and give its true --squares."
        ) from error
    std = std.ravel()[:4]
    focal_std = float(np.max(std[:2] / [camera.fx, camera.fy]))
    return lens_of(camera, bent, focal_std), errors.ravel(), std
