"""The large plane behind the organ: table, drape.

Random sample consensus (Fischler, Bolles 1981, doi 10.1145/358669.358692) with graded inliers
(MSAC; Torr, Zisserman 2000, doi 10.1006/cviu.1999.0832). A background has objects in front of it
and nothing close behind it; an organ's flat side has the rest of the organ behind it. So points a
little behind a plane count against it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tumortrack.sense.region.working_image import NO_RETURN, PLANE, RegionConfig, WorkingImage, jit

_SAMPLED = 1200  # pixels
_TRIES = 150
_BEYOND_MM = 120.0  # points up to this far beyond the range are used for the fit
_STEEPEST = 0.35  # cosine of the largest angle between the plane's normal and the optical axis
_DEEPEST_MM = 60.0  # no organ is deeper: what lies farther behind a plane is no part of it
_BEHIND_COST = 2.0  # one point behind the plane cancels this many on it
_MOST_BEHIND = 0.03  # share of the points on it; more is a cavity, in which the organ may lie
_NARROWEST_MM = 120.0  # extent of a background across its long side


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
        normal, offset, half_mm = plane[:3]
        _remove_below(image.depth_mm, image.taken, image.pinhole, normal, offset, half_mm)


def find_plane(image: WorkingImage, config: RegionConfig, rng: np.random.Generator) -> Plane | None:
    """The background plane, searched for in all pixels, also those that earlier steps removed."""
    points = _sampled_points(image, config.crop.far_mm + _BEYOND_MM, rng)
    if len(points) < 50:
        return None
    # The drape's unevenness plus three standard deviations of noise.
    most_mm = config.plane_mm + 3 * config.noise_mm * float(np.median(points[:, 2]) / 150) ** 2
    triples = rng.integers(len(points), size=(_TRIES, 3))
    score, normal, offset = _consensus(points, triples, most_mm)
    if score < config.plane_share / 2 * len(points):
        return None
    half_mm = most_mm
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
    valid = np.flatnonzero((image.taken.ravel()[pixel] != NO_RETURN) & (z < far_mm))[:_SAMPLED]
    row, column = np.divmod(pixel[valid], width)
    (fx, fy, cx, cy), z = image.pinhole, z[valid]
    return np.stack([(column - cx) / fx * z, (row - cy) / fy * z, z], axis=1).astype(np.float32)


@jit
def _consensus(points, triples, tolerance):  # type: ignore[no-untyped-def]
    """Score, normal and offset of the best plane through three points. A tenth of the points
    suffices to reject hopeless planes."""
    best, best_offset = -np.inf, 0.0
    best_normal = np.zeros(3, np.float32)
    few = len(points) // 10
    for t in range(len(triples)):
        a, b, c = points[triples[t, 0]], points[triples[t, 1]], points[triples[t, 2]]
        bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        cx, cy, cz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length < 100.0 or abs(nz) < _STEEPEST * length:  # mm^2: slivers are ill-conditioned
            continue
        to_camera = -1 / length if nz > 0 else 1 / length
        nx, ny, nz = nx * to_camera, ny * to_camera, nz * to_camera
        offset = nx * a[0] + ny * a[1] + nz * a[2]
        score = _score(points[:few], nx, ny, nz, offset, tolerance)
        if score < 0.05 * best:
            continue
        score += _score(points[few:], nx, ny, nz, offset, tolerance)
        if score > best:
            best, best_offset = score, offset
            best_normal[0], best_normal[1], best_normal[2] = nx, ny, nz
    return best, best_normal, best_offset


@jit
def _score(points, nx, ny, nz, offset, tolerance):  # type: ignore[no-untyped-def]
    score = np.float32(0)
    for i in range(len(points)):
        height = nx * points[i, 0] + ny * points[i, 1] + nz * points[i, 2] - offset
        share = height / tolerance
        if abs(share) < 1:
            score += 1 - share * share
        elif -_DEEPEST_MM < height < 0:
            score -= np.float32(_BEHIND_COST)
    return score


@jit
def _remove_below(depth_mm, taken, pinhole, normal, offset, half):  # type: ignore[no-untyped-def]
    """Remove what lies less than ``half`` (mm) above the plane."""
    fx, fy, cx, cy = pinhole
    height, width = depth_mm.shape
    for v in range(height):
        across = normal[1] * (v - cy) / fy + normal[2]
        for u in range(width):
            if taken[v, u] == 0:
                above = depth_mm[v, u] * (normal[0] * (u - cx) / fx + across) - offset
                if above < half:
                    taken[v, u] = PLANE
