"""Depth images against the plane of the board that a picture of the same moment shows."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame
from tumortrack.simulation.noise import REFERENCE_MM, CalibrationConfig
from tumortrack_experiment.calibrate.board import Corners
from tumortrack_experiment.calibrate.lens import Lens, pixel_rays

NEAR_MM, FAR_MM, _BIN_MM = 70.0, 200.0, 20.0  # where organs are, before a D405
_FAR_OFF_MM, _FAR_OFF = 10.0, 0.1  # farther from the plane is another thing: mm, share of depth
_INSET_PX, _LEAST_PIXELS = 4, 500  # within the outermost corners; in an image, or a field of it
_STEEPEST = np.cos(np.radians(50))
_STILL_PX = 0.3  # of corners, between pictures of one pose
_LEAST_POSES, _LEAST_SPAN_MM = 6, 60.0  # without so much, scale and offset are one number
_TRAINED = CalibrationConfig(offset_mm=2.0, scale=0.01)  # elastic's cameras (training/presets.py)
_WRONG_SIZE = 0.05  # of depth: no camera's error
_DOWN, _ACROSS = 8, 12  # fields of the image


class PlaneErrors(NamedTuple):
    """Of one depth image: ``error_mm`` of the pixels (flat indices), measured minus true; the
    board's true depth there; ``pose``: equal for images of one pose."""

    pixels: np.ndarray
    error_mm: Float64[np.ndarray, " n"]
    depth_mm: Float64[np.ndarray, " n"]
    pose: int


def plane_errors(frame: DepthFrame, lens: Lens, seen: Corners, pose: int) -> PlaneErrors | None:
    """None: too little of the board has depth, or it is too steep."""
    mask = np.zeros(frame.depth_mm.shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(seen.pixels).astype(np.int32)), 1)
    inner = cv2.erode(mask, np.ones((2 * _INSET_PX + 1,) * 2, np.uint8))
    pixels = np.flatnonzero((inner > 0) & np.isfinite(frame.depth_mm))
    camera_from_board, _ = lens.place(seen)
    normal, shift = camera_from_board[:3, 2], camera_from_board[:3, 3]
    depth_mm = (normal @ shift) / (pixel_rays(lens).reshape(-1, 3)[pixels] @ normal)
    error_mm = frame.depth_mm.ravel()[pixels] - depth_mm
    near = np.abs(error_mm) < _FAR_OFF_MM + _FAR_OFF * depth_mm
    if near.sum() < _LEAST_PIXELS or abs(normal[2]) < _STEEPEST:
        return None
    return PlaneErrors(pixels[near], error_mm[near], depth_mm[near], pose)


def same_pose(one: Corners, other: Corners) -> bool:
    """Whether neither camera nor board moved between two pictures."""
    where = {tuple(place): pixel for place, pixel in zip(*one, strict=True)}
    apart = [
        p - where[tuple(place)] for place, p in zip(*other, strict=True) if tuple(place) in where
    ]
    if len(apart) < len(one.pixels) / 2:
        return False
    return bool(np.sqrt(np.square(apart).sum(1).mean()) < _STILL_PX)


def depth_report(found: list[PlaneErrors], lens: Lens) -> tuple[dict[str, Any], list[str]]:
    """Scale and offset with deviations (measured = (1 + scale) * true + offset_mm), what remains,
    and tables by distance; warnings. Raises InputError: the board's size or a unit is wrong."""
    poses = sorted({one.pose for one in found})
    at_mm, off_mm = (
        np.array(
            [np.mean([getattr(one, name).mean() for one in found if one.pose == n]) for n in poses]
        )
        for name in ("depth_mm", "error_mm")
    )
    if abs(ratio := float(np.median(off_mm / at_mm))) > _WRONG_SIZE:
        raise InputError(
            f"by the depth images the board is {1 + ratio:.2f} times as far away as by the "
            "pictures: give the true --square-mm, and depth images in their true unit "
            "(depth_unit_mm in intrinsics.json)."
        )
    lows_mm = np.arange(NEAR_MM - _BIN_MM / 2, max(FAR_MM, at_mm.max()) + _BIN_MM, _BIN_MM)
    rows = [row for low in lows_mm if (row := _row(found, float(low), lens.width))]
    said = {
        "images": len(found),
        "poses": len(poses),
        "from_mm": float(at_mm.min()),
        "to_mm": float(at_mm.max()),
        "by_distance": rows,
        "fields_at_150_mm": _fields(found, lens),
    }
    warnings = []
    if at_mm.min() > NEAR_MM + _BIN_MM or at_mm.max() < FAR_MM - _BIN_MM:
        warnings.append(
            f"depth was compared from {at_mm.min():.0f} to {at_mm.max():.0f} mm, and nothing is "
            f"known beyond; {NEAR_MM:g} to {FAR_MM:g} mm should be covered"
        )
    if all(row["noise_mm"] is None for row in rows):
        warnings.append("no two images of one pose: temporal noise is unknown")
    if len(poses) >= _LEAST_POSES and np.ptp(at_mm) >= _LEAST_SPAN_MM:
        return said | _scale(at_mm, off_mm, lens.focal_std, warnings), warnings
    warnings.append(
        f"{len(poses)} poses of the board over {np.ptp(at_mm):.0f} mm of distance do not tell "
        "scale from offset, so no correction is written; "
        f"{_LEAST_POSES} over {_LEAST_SPAN_MM:g} mm would"
    )
    worst_mm = float(np.abs(off_mm).max())
    return said | {"error_mm": worst_mm, "left_mm": worst_mm, "corrected": False}, warnings


def _scale(
    at_mm: np.ndarray, off_mm: np.ndarray, focal_std: float, warnings: list[str]
) -> dict[str, Any]:
    """The line through the poses' errors; what it leaves is asked of each pose without itself. The
    board is as much farther away as the focal length is longer."""
    design = np.column_stack([at_mm, np.ones(len(at_mm))])
    inverse = np.linalg.inv(design.T @ design)
    scale, offset_mm = inverse @ design.T @ off_mm
    rest_mm = off_mm - design @ [scale, offset_mm]
    std = np.sqrt(np.diag(inverse) * (rest_mm @ rest_mm) / (len(at_mm) - 2))
    alone_mm = rest_mm / (1 - np.einsum("ij,jk,ik->i", design, inverse, design))
    before_mm, left_mm = (float(np.quantile(np.abs(x), 0.95)) for x in (off_mm, alone_mm))
    left_mm += 2 * focal_std * float(at_mm.max())
    inside = abs(offset_mm) <= _TRAINED.offset_mm and abs(scale) <= _TRAINED.scale
    if not inside:
        warnings.append(
            f"depth is off by {100 * scale:+.1f} % and {offset_mm:+.1f} mm; a camera is presumed "
            f"to have up to {100 * _TRAINED.scale:g} % and {_TRAINED.offset_mm:g} mm. The "
            "intrinsics.json that is written here corrects it; the camera itself should be "
            "calibrated again"
        )
    return {
        "scale": float(scale),
        "scale_std": float(np.hypot(std[0], focal_std)),
        "offset_mm": float(offset_mm),
        "offset_std_mm": float(std[1]),
        "inside_training": bool(inside),
        "error_mm": before_mm,
        "left_mm": min(left_mm, before_mm),
        "corrected": left_mm < before_mm,
    }


def correction(said: dict[str, Any]) -> dict[str, float]:
    """What intrinsics.json says of it: true = depth_scale * measured + depth_offset_mm, right to
    depth_left_mm."""
    if "scale" not in said:  # too few poses tell nothing of other distances
        return {}
    left = {"depth_left_mm": said["left_mm"]}
    if not said["corrected"]:
        return left
    per = 1 / (1 + said["scale"])
    return {"depth_scale": per, "depth_offset_mm": -said["offset_mm"] * per, **left}


def _row(found: list[PlaneErrors], low_mm: float, width: int) -> dict[str, Any] | None:
    """Of the images about one distance: mean error and its deviation between poses, flatness (root
    mean square beside each image's own plane, median), temporal noise of a pixel."""
    here = [one for one in found if low_mm <= one.depth_mm.mean() < low_mm + _BIN_MM]
    if not here:
        return None
    by_pose = [[a.error_mm.mean() for a in here if a.pose == n] for n in {a.pose for a in here}]
    errors_mm = [np.mean(one) for one in by_pose]
    noise_mm = [_noise_mm(a, b) for a, b in pairwise(here) if a.pose == b.pose]
    return {
        "from_mm": low_mm,
        "to_mm": low_mm + _BIN_MM,
        "images": len(here),
        "error_mm": float(np.mean(errors_mm)),
        "between_poses_mm": float(np.std(errors_mm, ddof=1)) if len(errors_mm) > 1 else None,
        "flatness_mm": float(np.median([_flatness_mm(one, width) for one in here])),
        "noise_mm": float(np.median(noise_mm)) if noise_mm else None,
    }


def _noise_mm(one: PlaneErrors, other: PlaneErrors) -> float:
    """Of one pixel in one image, robustly: two images of one pose differ by root two of it."""
    _, a, b = np.intersect1d(one.pixels, other.pixels, return_indices=True)
    differ_mm = one.error_mm[a] - other.error_mm[b]
    return float(1.4826 * np.median(np.abs(differ_mm - np.median(differ_mm))) / np.sqrt(2))


def _flatness_mm(one: PlaneErrors, width: int) -> float:
    """Beside the plane that fits best: 1 / depth of a plane is linear in the pixels, and so is a
    small error of one over its depth squared."""
    design = np.column_stack([*np.divmod(one.pixels, width), np.ones(len(one.pixels))])
    per = one.error_mm / one.depth_mm**2
    rest = per - design @ np.linalg.lstsq(design, per, rcond=None)[0]
    return float(np.sqrt(np.mean((rest * one.depth_mm**2) ** 2)))


def _fields(found: list[PlaneErrors], lens: Lens) -> list[list[float | None]]:
    """What all images share beside each one's mean, in 8 x 12 fields of the image, mm; as it is at
    150 mm, for errors of disparity grow with depth squared. None: too little was seen there."""
    total, count = np.zeros((2, _DOWN * _ACROSS))
    for one in found:
        per_mm = (one.error_mm - one.error_mm.mean()) * (REFERENCE_MM / one.depth_mm) ** 2
        rows, columns = np.divmod(one.pixels, lens.width)
        field = rows * _DOWN // lens.height * _ACROSS + columns * _ACROSS // lens.width
        total += np.bincount(field, per_mm, len(total))
        count += np.bincount(field, minlength=len(count))
    flat = [None if n < _LEAST_PIXELS else mm / n for mm, n in zip(total, count, strict=True)]
    return [flat[n : n + _ACROSS] for n in range(0, len(flat), _ACROSS)]
