"""Depth images against the plane of the board that a picture of the same moment shows."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine
from tumortrack.core.types import DepthFrame
from tumortrack.sense.noise import REFERENCE_MM, CalibrationConfig
from tumortrack_experiment.calibrate.board import Corners
from tumortrack_experiment.calibrate.lens import Lens, pixel_rays

NEAR_MM, FAR_MM, BIN_MM = 70.0, 200.0, 20.0  # where organs are, before a D405
_FAR_OFF_MM, _FAR_OFF = 10.0, 0.1  # farther from the plane is another thing: mm, share of depth
_INSET_PX = 4  # within the outermost corners
_LEAST_PIXELS = 500
_STEEPEST = np.cos(np.radians(50))
_STILL_PX = 0.3  # of corners, between pictures of one pose
_LEAST_POSES, _LEAST_SPAN_MM = 6, 60.0  # without so much, scale and offset are one number
_TRAINED = CalibrationConfig(offset_mm=2.0, scale=0.01)  # a clinic model's cameras (presets.py)
_WRONG_SIZE = 0.05  # of depth: no camera's error


class PlaneErrors(NamedTuple):
    """Of one depth image: ``error_mm`` of the pixels (flat indices), measured minus true; the
    board's true depth there; ``pose``: equal for images of one pose."""

    pixels: np.ndarray
    error_mm: Float64[np.ndarray, " n"]
    depth_mm: Float64[np.ndarray, " n"]
    pose: int


def plane_errors(
    frame: DepthFrame, lens: Lens, seen: Corners, camera_from_board: Affine, pose: int
) -> PlaneErrors | None:
    """None: too little of the board has depth, or it is too steep."""
    inside = _inside(seen, frame.depth_mm.shape)
    normal, shift = camera_from_board[:3, 2], camera_from_board[:3, 3]
    rays = pixel_rays(lens).reshape(-1, 3)
    pixels = np.flatnonzero(inside & np.isfinite(frame.depth_mm))
    depth_mm = (normal @ shift) / (rays[pixels] @ normal)
    error_mm = frame.depth_mm.ravel()[pixels] - depth_mm
    near = np.abs(error_mm) < _FAR_OFF_MM + _FAR_OFF * depth_mm
    if near.sum() < _LEAST_PIXELS or abs(normal[2]) < _STEEPEST:
        return None
    return PlaneErrors(pixels[near], error_mm[near], depth_mm[near], pose)


def _inside(seen: Corners, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(seen.pixels).astype(np.int32)), 1)
    return cv2.erode(mask, np.ones((2 * _INSET_PX + 1,) * 2, np.uint8)) > 0


def same_pose(one: Corners, other: Corners) -> bool:
    """Whether neither camera nor board moved between two pictures."""
    where = {tuple(place): pixel for place, pixel in zip(one.board_mm, one.pixels, strict=True)}
    pairs = [
        (where[tuple(place)], pixel)
        for place, pixel in zip(other.board_mm, other.pixels, strict=True)
        if tuple(place) in where
    ]
    if len(pairs) < len(one.pixels) / 2:
        return False
    first, second = np.array(pairs).transpose(1, 0, 2)
    return bool(np.sqrt(((first - second) ** 2).sum(1).mean()) < _STILL_PX)


def depth_report(found: list[PlaneErrors], lens: Lens) -> tuple[dict[str, Any], list[str]]:
    """Scale and offset with deviations, what remains, tables by distance, and warnings. ``scale``
    and ``offset_mm``: measured = (1 + scale) * true + offset."""
    poses = sorted({one.pose for one in found})
    at_mm = np.array([_mean(found, pose, "depth_mm") for pose in poses])
    off_mm = np.array([_mean(found, pose, "error_mm") for pose in poses])
    ratio = float(np.median(off_mm / at_mm))
    if abs(ratio) > _WRONG_SIZE:
        raise InputError(
            f"by the depth images the board is {1 + ratio:.2f} times as far away as by the "
            "pictures: give the true --square-mm, and depth images in their true unit "
            "(depth_unit_mm in intrinsics.json)."
        )
    warnings = []
    edges_mm = np.arange(NEAR_MM - BIN_MM / 2, FAR_MM + BIN_MM, BIN_MM)
    rows = [_row(found, low, low + BIN_MM, lens.width) for low in edges_mm]
    table = [row for row in rows if row]
    if at_mm.min() > NEAR_MM + BIN_MM or at_mm.max() < FAR_MM - BIN_MM:
        warnings.append(
            f"depth was compared from {at_mm.min():.0f} to {at_mm.max():.0f} mm; nothing is known "
            f"outside that. {NEAR_MM:g} to {FAR_MM:g} mm should be covered"
        )
    report: dict[str, Any] = {
        "images": len(found),
        "poses": len(poses),
        "from_mm": float(at_mm.min()),
        "to_mm": float(at_mm.max()),
        "by_distance": table,
        "shape": _shape(found, lens),
        "noise_measured": any(row["noise_mm"] is not None for row in table),
    }
    if not report["noise_measured"]:
        warnings.append("no two images of one pose: temporal noise is unknown")
    span_mm = float(np.ptp(at_mm))
    if len(poses) < _LEAST_POSES or span_mm < _LEAST_SPAN_MM:
        warnings.append(
            f"{len(poses)} poses of the board over {span_mm:.0f} mm of distance do not tell scale "
            f"from offset; at least {_LEAST_POSES} over {_LEAST_SPAN_MM:g} mm are needed. No "
            "correction is written"
        )
        worst_mm = float(np.abs(off_mm).max())
        return report | {"error_mm": worst_mm, "left_mm": worst_mm, "corrected": False}, warnings
    return report | _scale(at_mm, off_mm, warnings), warnings


def _scale(at_mm: np.ndarray, off_mm: np.ndarray, warnings: list[str]) -> dict[str, Any]:
    """The line through the poses' errors; what it leaves is asked of each pose without itself."""
    design = np.column_stack([at_mm, np.ones(len(at_mm))])
    inverse = np.linalg.inv(design.T @ design)
    (scale, offset_mm) = inverse @ design.T @ off_mm
    rest_mm = off_mm - design @ [scale, offset_mm]
    std = np.sqrt(np.diag(inverse) * (rest_mm @ rest_mm) / (len(at_mm) - 2))
    alone_mm = rest_mm / (1 - np.einsum("ij,jk,ik->i", design, inverse, design))
    before_mm, left_mm = (float(np.quantile(np.abs(x), 0.95)) for x in (off_mm, alone_mm))
    inside = abs(offset_mm) <= _TRAINED.offset_mm and abs(scale) <= _TRAINED.scale
    if not inside:
        warnings.append(
            f"depth is off by {100 * scale:+.1f} % and {offset_mm:+.1f} mm; models are trained for "
            f"up to {100 * _TRAINED.scale:g} % and {_TRAINED.offset_mm:g} mm. The intrinsics.json "
            "that is written here corrects it; the camera itself should be calibrated again"
        )
    corrected = left_mm < before_mm
    if not corrected:
        warnings.append("a correction of scale and offset would not help; none is written")
    return {
        "scale": float(scale),
        "scale_std": float(std[0]),
        "offset_mm": float(offset_mm),
        "offset_std_mm": float(std[1]),
        "inside_training": bool(inside),
        "error_mm": before_mm,
        "left_mm": min(left_mm, before_mm),
        "corrected": corrected,
    }


def correction(report: dict[str, Any]) -> dict[str, float]:
    """What intrinsics.json says of it: true = depth_scale * measured + depth_offset_mm."""
    if not report.get("corrected"):
        return {}
    per = 1 / (1 + report["scale"])
    return {"depth_scale": per, "depth_offset_mm": -report["offset_mm"] * per}


def _mean(found: list[PlaneErrors], pose: int, name: str) -> float:
    return float(np.mean([getattr(one, name).mean() for one in found if one.pose == pose]))


def _row(
    found: list[PlaneErrors], low_mm: float, high_mm: float, width: int
) -> dict[str, Any] | None:
    """Of the images in this range: mean error and its deviation between poses, flatness (root mean
    square beside each image's own plane, median), and temporal noise of a pixel."""
    here = [one for one in found if low_mm <= one.depth_mm.mean() < high_mm]
    if not here:
        return None
    poses = sorted({one.pose for one in here})
    errors_mm = [_mean(here, pose, "error_mm") for pose in poses]
    noise_mm = [_noise_mm(a, b) for a, b in pairwise(here) if a.pose == b.pose]
    return {
        "from_mm": float(low_mm),
        "to_mm": float(high_mm),
        "images": len(here),
        "poses": len(poses),
        "error_mm": float(np.mean(errors_mm)),
        "between_poses_mm": float(np.std(errors_mm, ddof=1)) if len(poses) > 1 else None,
        "flatness_mm": float(np.median([_flatness_mm(one, width) for one in here])),
        "noise_mm": float(np.median(noise_mm)) if noise_mm else None,
    }


def _noise_mm(one: PlaneErrors, other: PlaneErrors) -> float:
    """Of one pixel in one image, robustly: two images of one pose differ by root two of it."""
    both, a, b = np.intersect1d(one.pixels, other.pixels, return_indices=True)
    differ_mm = one.error_mm[a] - other.error_mm[b] if len(both) else np.zeros(1)
    return float(1.4826 * np.median(np.abs(differ_mm - np.median(differ_mm))) / np.sqrt(2))


def _flatness_mm(one: PlaneErrors, width: int) -> float:
    """Beside the plane that fits best: 1 / depth of a plane is linear in the pixels, and so is a
    small error of one over its depth squared."""
    rows, columns = np.divmod(one.pixels, width)
    design = np.column_stack([rows, columns, np.ones(len(rows))]).astype(float)
    per = one.error_mm / one.depth_mm**2
    rest = per - design @ np.linalg.lstsq(design, per, rcond=None)[0]
    return float(np.sqrt(np.mean((rest * one.depth_mm**2) ** 2)))


def _shape(found: list[PlaneErrors], lens: Lens) -> dict[str, Any]:
    """What all images share beside scale and offset, as it is at 150 mm (errors of disparity grow
    with depth squared): the coefficients of x, y, x^2, x y, y^2, which run from -1 to 1 over the
    image; the mean in its 8 x 12 fields, null where too little was seen; their range."""
    fields = np.zeros((2, 8 * 12))
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for one in found:
        rows, columns = np.divmod(one.pixels, lens.width)
        y, x = 2 * rows / lens.height - 1, 2 * columns / lens.width - 1
        per_mm = (one.error_mm - one.error_mm.mean()) * (REFERENCE_MM / one.depth_mm) ** 2
        design = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
        normal += design.T @ design
        right += design.T @ per_mm
        field = rows * 8 // lens.height * 12 + columns * 12 // lens.width
        fields += [np.bincount(field, per_mm, 96), np.bincount(field, minlength=96)]
    seen = fields[1] >= _LEAST_PIXELS
    mean_mm = np.where(seen, fields[0] / np.maximum(fields[1], 1), np.nan)
    return {
        "coefficients_mm": np.linalg.lstsq(normal, right, rcond=None)[0][1:].tolist(),
        "range_mm": float(np.ptp(mean_mm[seen])) if seen.any() else 0.0,
        "fields_mm": [[None if np.isnan(v) else round(v, 3) for v in row]
                      for row in mean_mm.reshape(8, 12).tolist()],
    }  # fmt: skip
