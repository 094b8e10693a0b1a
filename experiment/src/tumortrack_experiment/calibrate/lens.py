"""A camera's intrinsics with lens distortion, from pictures of a board, and how sure they are."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64

from tumortrack.core.camera import plausible
from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, rigid
from tumortrack.core.store import read_json
from tumortrack.core.types import Intrinsics
from tumortrack.io.depth_files import read_intrinsics
from tumortrack_experiment.calibrate.board import Corners

_NO_RADIAL = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
_MODELS = {
    "none": _NO_RADIAL | cv2.CALIB_ZERO_TANGENT_DIST,
    "k1 k2 p1 p2": cv2.CALIB_FIX_K3,
    "k1 k2 p1 p2 k3": 0,
}
_LEAST_PICTURES, _HELD_OUT = 8, 4  # every so-many-th judges what was fitted without it
_BETTER = 0.98  # of the error there, for more distortion to be taken
_UNSURE = 0.01  # of the focal length: as sure as training's cameras are of their depth
_BAD_PX, _BAD_TIMES = 1.0, 3.0  # a picture's error, and how many times the median's
_LEAST_COVERED, _LEAST_TILT = 0.6, 20.0  # share of the image; degrees of the steepest quarter
_BENT_PX = 0.5  # 0.2 mm at 150 mm before a D405 at 848 x 480


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
    def opencv(self) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 5"]]:
        """Camera matrix and distortion."""
        matrix = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])
        return matrix, np.array(self.distortion)

    def rays(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        """Where pixels look, z = 1."""
        until = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-7
        pixels = pixels.reshape(-1, 1, 2)
        same, (matrix, bent) = np.eye(3), self.opencv
        flat = cv2.undistortPointsIter(pixels, matrix, bent, same, same, until).reshape(-1, 2)
        return np.column_stack([flat, np.ones(len(flat))])

    def place(self, seen: Corners) -> tuple[Affine, float]:
        """``camera_from_board``, and the root mean square of what it leaves, px."""
        given = seen.board_mm, seen.pixels, *self.opencv
        _, turns, shifts, errors = cv2.solvePnPGeneric(*given, flags=cv2.SOLVEPNP_IPPE)
        best = int(np.argmin(errors))
        turn, shift = cv2.solvePnPRefineLM(*given, turns[best], shifts[best])
        again = cv2.projectPoints(seen.board_mm, turn, shift, *self.opencv)[0].reshape(-1, 2)
        off_px = float(np.sqrt(((again - seen.pixels) ** 2).sum(1).mean()))
        return rigid(cv2.Rodrigues(turn)[0], shift.ravel()), off_px


def read_lens(path: Path) -> Lens:
    """A lens.json that `calibrate camera` wrote, or a camera without distortion (as `locate` takes
    it). Raises InputError: neither."""
    if "distortion" not in (data := read_json(path)):
        return lens_of(read_intrinsics(path))
    lens = from_builtins(data, Lens, str(path))
    plausible(lens.camera, str(path))
    return lens


def lens_of(one: Intrinsics, **more: Any) -> Lens:
    names = "width", "height", "fx", "fy", "cx", "cy"
    return Lens(**{name: getattr(one, name) for name in names}, **more)


@lru_cache(maxsize=4)
def pixel_rays(lens: Lens, times: int = 1) -> Float64[np.ndarray, "h w 3"]:
    """Where every pixel looks, z = 1; ``times``: so many in its place each way."""
    sizes = lens.height, lens.width
    down, right = ((np.arange(size * times) + 0.5) / times - 0.5 for size in sizes)
    pixels = np.stack(np.meshgrid(right, down), axis=-1).reshape(-1, 2)
    return lens.rays(pixels).reshape(len(down), len(right), 3)


class LensFit(NamedTuple):
    """``lens`` as it is best described, ``pinhole`` without distortion, the pictures that were
    ``used``, what is to be ``said`` of them, and warnings."""

    lens: Lens
    pinhole: Lens
    used: list[int]
    said: dict[str, Any]
    warnings: list[str]


def fit_lens(seen: dict[int, Corners], names: list[str], size: tuple[int, int]) -> LensFit:
    """From the corners in pictures, by their number. Raises InputError: they are too few, don't
    fit, or don't tell how long the focal length is."""
    if len(seen) < _LEAST_PICTURES:
        raise InputError(
            f"the board is in {len(seen)} pictures; at least {_LEAST_PICTURES} are needed, better "
            "30, tilted by 20 to 45 degrees to all sides, near and far, up to the image's corners."
        )
    _, errors_px, _ = _fit(list(seen.values()), size, "k1 k2 p1 p2")
    limit_px = max(_BAD_PX, _BAD_TIMES * float(np.median(errors_px)))
    used = [n for n, error in zip(seen, errors_px, strict=True) if error <= limit_px]
    if np.median(errors_px) > 2 * _BAD_PX or len(used) < _LEAST_PICTURES:
        raise InputError(
            f"the board's corners lie {np.median(errors_px):.1f} px off where a camera would see "
            "them: is the board flat, and --squares right?"
        )
    kept = [seen[n] for place, n in enumerate(used) if place % _HELD_OUT]
    held_out_px, model = {}, "none"
    for name in _MODELS:
        lens = _fit(kept, size, name)[0]
        off_px = [lens.place(seen[n])[1] for n in used[::_HELD_OUT]]
        held_out_px[name] = float(np.sqrt(np.mean(np.square(off_px))))
        if held_out_px[name] < _BETTER * held_out_px[model]:
            model = name
    corners = [seen[n] for n in used]
    lens, errors_px, std_px = _fit(corners, size, model)
    if lens.focal_std > _UNSURE:
        raise InputError(
            f"the focal length is unsure by {100 * lens.focal_std:.1f} %: tilt the board by 20 to "
            "45 degrees to all sides."
        )
    pinhole = _fit(corners, size, "none")[0]
    fields = np.concatenate([one.pixels for one in corners]) // [size[0] / 8, size[1] / 6]
    tilts = [float(np.degrees(np.arccos(abs(lens.place(one)[0][2, 2])))) for one in corners]
    said = {
        "pictures": len(names),
        "not_seen": [name for n, name in enumerate(names) if n not in seen],
        "left_out": [names[n] for n in seen if n not in used],
        "model": model,
        "std_px": dict(zip(("fx", "fy", "cx", "cy"), std_px.tolist(), strict=True)),
        "reprojection_rms_px": float(np.sqrt(np.mean(np.square(errors_px)))),
        "held_out_rms_px": held_out_px,
        "bent_px": float(rays_apart(lens, pinhole).max() * lens.fx),
        "covered": len(np.unique(fields @ [1, 8])) / 48,
        "tilt_degrees": [min(tilts), max(tilts)],
    }
    return LensFit(lens, pinhole, used, said, _lens_warnings(said, float(np.quantile(tilts, 0.75))))


def _lens_warnings(said: dict[str, Any], tilt: float) -> list[str]:
    warnings = [f"{name} left out: its corners do not fit" for name in said["left_out"]]
    if said["covered"] < _LEAST_COVERED:
        warnings.append(
            f"the board's corners cover {100 * said['covered']:.0f} % of the image; show it at all "
            "sides and in the corners"
        )
    if tilt < _LEAST_TILT:
        warnings.append(
            f"only a quarter of the pictures is tilted by over {tilt:.0f} degrees; "
            f"{_LEAST_TILT:g} to 45 tell the focal length"
        )
    if said["bent_px"] > _BENT_PX:
        warnings.append(
            f"these pictures are not rectified (up to {said['bent_px']:.1f} px beside a camera "
            "without distortion, which intrinsics.json is); take the stream that depth belongs to, "
            "a D405's left infrared"
        )
    return warnings


def rays_apart(one: Lens, other: Lens) -> Float64[np.ndarray, " n"]:
    """How far apart the two look, as a share of the depth, all over the image."""
    return np.linalg.norm(pixel_rays(one) - pixel_rays(other), axis=2)[::8, ::8].ravel()


def _fit(
    seen: Sequence[Corners], size: tuple[int, int], model: str
) -> tuple[Lens, Float64[np.ndarray, " n"], Float64[np.ndarray, " 4"]]:
    """The lens, each picture's error, and deviations of fx, fy, cx, cy; px."""
    points = [one.board_mm.astype(np.float32) for one in seen]
    pixels = [one.pixels.astype(np.float32) for one in seen]
    try:
        _, matrix, bent, _, _, std, _, errors = cv2.calibrateCameraExtended(
            points, pixels, size, np.zeros((3, 3)), np.zeros(5), flags=_MODELS[model]
        )
        fx, fy, cx, cy = map(float, matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
        camera = Intrinsics(*size, fx, fy, cx, cy)
        plausible(camera, "these pictures")
    except (cv2.error, InputError) as error:
        raise InputError(
            "no camera explains these pictures: tilt the board by 20 to 45 degrees to all sides, "
            "and give its true --squares."
        ) from error
    std = std.ravel()[:4]
    focal_std = float(np.max(std[:2] / [camera.fx, camera.fy]))
    five = tuple(map(float, np.ravel(bent)[:5]))
    return lens_of(camera, distortion=five, focal_std=focal_std), errors.ravel(), std
