"""The large plane behind the organ: table, drape.

Random sample consensus (Fischler, Bolles 1981, doi 10.1145/358669.358692) with graded inliers
(MSAC; Torr, Zisserman 2000, doi 10.1006/cviu.1999.0832). A background has objects in front of it
and nothing close behind it; an organ's flat side has the rest of the organ behind it. So points a
little behind a plane count against it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tumortrack.native import F32, F64, I64, U8, kernel
from tumortrack.segmentation.working_image import (
    DEPTH,
    NO_RETURN,
    PLANE,
    TANGENTS,
    RegionConfig,
    WorkingImage,
)

_SAMPLED = 1200  # pixels
_TRIES = 150
_BEYOND_MM = 120.0  # points up to this far beyond the range are used for the fit
_DEEPEST_MM = 60.0  # no organ is deeper: what lies farther behind a plane is no part of it
_MOST_BEHIND = 0.03  # share of the points on it; more is a cavity, in which the organ may lie
_NARROWEST_MM = 120.0  # extent of a background across its long side

# Points; triples of them, which come from their number; tolerance and greatest depth of an organ;
# the best plane's normal and offset. Returns its score.
consensus = kernel(
    "plane_consensus",
    *(F32["n", 3].any_value, I64["tries", 3], (float, float), F32[3].out, F64[1].out),
    result=float,
)
# Depths, states, height over the plane by column and row, its offset, tolerance; the step.
_remove_below = kernel(
    "remove_below",
    *(DEPTH, U8["height", "width"].out, *TANGENTS, float, float, int),
)


class Plane(NamedTuple):
    """``normal @ point = offset``, mm; the unit normal points to the camera. ``half_mm``: points up
    to this far from it belong to it. ``middle``, ``wide_mm``: of its visible part."""

    normal: np.ndarray
    offset: float
    half_mm: float
    middle: np.ndarray
    wide_mm: float


def remove_plane(image: WorkingImage, config: RegionConfig, rng: np.random.Generator) -> None:
    """Remove the background plane and what lies behind it, if there is one."""
    if (plane := find_plane(image, config, rng)) is not None:
        (x, y, z), offset, half_mm = plane[:3]
        (height, width), (fx, fy, cx, cy) = image.depth_mm.shape, image.pinhole
        right, down = x * (np.arange(width) - cx) / fx, y * (np.arange(height) - cy) / fy + z
        _remove_below(image.depth_mm, image.pixel_class, right, down, offset, half_mm, PLANE)


def find_plane(image: WorkingImage, config: RegionConfig, rng: np.random.Generator) -> Plane | None:
    """The background plane, searched for in all pixels, also those that earlier steps removed."""
    points = _sampled_points(image, config.crop.far_mm + _BEYOND_MM, rng)
    if len(points) < 50:
        return None
    # The drape's unevenness plus three standard deviations of noise.
    most_mm = config.plane_mm + 3 * config.noise_mm * float(np.median(points[:, 2]) / 150) ** 2
    triples = rng.integers(len(points), size=(_TRIES, 3))
    normal, offsets = np.zeros(3, np.float32), np.zeros(1)
    score = consensus(points, triples, (most_mm, _DEEPEST_MM), normal, offsets)
    if score < config.plane_share / 2 * len(points):
        return None
    half_mm, offset = most_mm, float(offsets[0])
    for _ in range(3):
        height = points @ normal - offset
        inliers = points[np.abs(height) < half_mm]
        if len(inliers) < 20:
            return None
        middle = inliers.mean(0)
        centred = inliers - middle
        variances, axes = np.linalg.eigh(centred.T @ centred / len(centred))
        normal = axes[:, 0] * -np.sign(axes[2, 0] or 1.0)
        offset = float(normal @ middle)
        residuals = np.abs(centred @ normal)
        half_mm = float(np.clip(4.5 * np.median(residuals), 1.5, most_mm))
    height = points @ normal - offset
    on = np.count_nonzero(np.abs(height) < half_mm)
    behind = np.count_nonzero((height < -half_mm) & (height > -_DEEPEST_MM))
    # A strip or disc of uniform density is sqrt(12) or 4 standard deviations wide.
    wide_mm = np.sqrt(12 * variances[1])
    if (
        on < config.plane_share * len(points)
        or behind > _MOST_BEHIND * on
        or wide_mm < _NARROWEST_MM
    ):
        return None
    return Plane(normal.astype(np.float64), offset, half_mm, middle.astype(np.float64), wide_mm)


def _sampled_points(image: WorkingImage, far_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Points (n, 3), float32, of random pixels nearer than ``far_mm``."""
    height, width = image.depth_mm.shape
    pixel = rng.integers(height * width, size=3 * _SAMPLED)
    z = image.depth_mm.ravel()[pixel]
    valid = np.flatnonzero((image.pixel_class.ravel()[pixel] != NO_RETURN) & (z < far_mm))[
        :_SAMPLED
    ]
    row, column = np.divmod(pixel[valid], width)
    (fx, fy, cx, cy), z = image.pinhole, z[valid]
    return np.stack([(column - cx) / fx * z, (row - cy) / fy * z, z], axis=1).astype(np.float32)
