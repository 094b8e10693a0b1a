"""Balls of known diameter in a depth image."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from scipy import ndimage
from scipy.optimize import least_squares

from tumortrack.core.camera import project
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points
from tumortrack.core.types import DepthFrame

_CELL_MM = 1.0  # of the votes for a ball's middle
_NORMAL_MM = 2.0  # window over which a normal is taken
_LEAST_VOTES = 0.15  # of the pixels that a ball covers
_MOST_PLACES = 800  # that are looked at more closely, the most voted first
_RANGE_MM = (60.0, 450.0)  # nearer a D405 sees nothing; farther a bead has few pixels
_FACING = 0.82  # of the radius: farther out the surface is turned away, and edges fly
_BESIDE = (1.25, 1.9)  # radii: the ring about a ball, where the image must fall back
_FALLS_BACK = 0.65  # of that ring; a ball's own post may be in it
_LEAST_PIXELS = 25
_LEAST_SEEN = 0.5
_REFERENCE_MM, _NOISE_MM = 150.0, 0.25  # a D405's, which grows with the distance squared
_MISFIT = 2.2  # times that noise
_OFF_MM = 3.0  # a pixel so far from the ball shows something else


def find_balls_seen(frame: DepthFrame, diameter_mm: float) -> Float64[np.ndarray, "n 3"]:
    """Middles (camera frame, mm) of all that looks like a ball of a diameter: each pixel votes for
    the place one radius behind it, along its normal, and to where many agree a ball is fitted.

    Raises:
        InputError: nothing of the image is in range.
    """
    radius_mm = diameter_mm / 2
    places = _voted(frame, radius_mm)
    found = [ball for at in places if (ball := fit_ball_seen(frame, at, diameter_mm)) is not None]
    kept: list[np.ndarray] = []
    for _, at in sorted(found, key=lambda ball: ball[0]):
        if all(np.linalg.norm(at - one) > radius_mm for one in kept):
            kept.append(at)
    return np.array(kept, np.float64).reshape(-1, 3)


def _voted(frame: DepthFrame, radius_mm: float) -> Points:
    """Where balls may be, most voted first."""
    camera, z = frame.intrinsics, frame.depth_mm.astype(np.float64)
    z = np.where((z > _RANGE_MM[0]) & (z < _RANGE_MM[1]), z, np.nan)
    seen = np.isfinite(z)
    if not seen.any():
        raise InputError(
            f"the depth image has nothing between {_RANGE_MM[0]:g} and {_RANGE_MM[1]:g} mm, where "
            "beads can be seen. Move the camera."
        )
    z = ndimage.median_filter(np.where(seen, z, 0), 5)  # fills pinholes, takes away single points
    z = np.where(z > 0, z, np.nan)
    pitch_mm = np.nanmedian(z) / camera.fx
    half = max(1, round(_NORMAL_MM / pitch_mm / 2))
    down, across = _slopes(z, half)
    u, v = np.arange(camera.width) - camera.cx, np.arange(camera.height)[:, None] - camera.cy
    normal = np.stack([camera.fx * across, camera.fy * down, -(z + u * across + v * down)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    points = np.stack([u * z / camera.fx, v * z / camera.fy, z], axis=-1)
    middles = (points - radius_mm * normal)[np.isfinite(normal).all(-1)]
    if not len(middles):
        return np.zeros((0, 3))
    low = middles.min(0)
    cells = np.floor((middles - low) / _CELL_MM).astype(int)
    shape = cells.max(0) + 1
    votes = np.bincount(np.ravel_multi_index(cells.T, shape), minlength=shape.prod())
    two = ndimage.uniform_filter(votes.reshape(shape).astype(np.float32), 2, mode="constant") * 8
    # Pixels that a ball at this distance covers.
    covered = (
        np.pi * radius_mm**2 * camera.fx * camera.fy / (low[2] + np.arange(shape[2]) + 0.5) ** 2
    )
    share = two / covered
    peaks = np.argwhere((share == ndimage.maximum_filter(share, 5)) & (share > _LEAST_VOTES))
    best = peaks[np.argsort(-share[tuple(peaks.T)])[:_MOST_PLACES]]
    return low + best * _CELL_MM  # the corner that the two cells on each axis share


def _slopes(z: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth per pixel down and across: the slope of a plane through a window, NaN at its gaps."""
    ramp = np.arange(-half, half + 1, dtype=float)
    flat = np.ones(2 * half + 1)
    per = (ramp**2).sum() * len(flat)

    def slope(axis: int) -> np.ndarray:
        first = ndimage.correlate1d(z, ramp, axis, mode="constant", cval=np.nan)
        return ndimage.correlate1d(first, flat / per, 1 - axis, mode="constant", cval=np.nan)

    return slope(0), slope(1)


def fit_ball_seen(
    frame: DepthFrame, near_mm: Float[np.ndarray, " 3"], diameter_mm: float
) -> tuple[float, Float64[np.ndarray, " 3"]] | None:
    """A ball fitted to the depths about a place (camera frame, mm), along the pixels' rays, as
    that is how depths err: rms of what is left, and its middle. None: no ball is seen there."""
    radius_mm, camera = diameter_mm / 2, frame.intrinsics
    at = np.asarray(near_mm, np.float64)
    z = frame.depth_mm
    for _ in range(4):
        if not _RANGE_MM[0] < at[2] < _RANGE_MM[1]:
            return None
        (u, v), pixels = project(at[None], camera)[0][0], radius_mm * camera.fx / at[2]
        reach = int(np.ceil(2 * pixels)) + 2
        left, top = round(float(u)) - reach, round(float(v)) - reach
        if left < 0 or top < 0:
            return None
        rows, columns = np.mgrid[top : top + 2 * reach + 1, left : left + 2 * reach + 1]
        if rows[-1, 0] >= camera.height or columns[0, -1] >= camera.width:
            return None
        depth = z[rows, columns].astype(np.float64)
        rays = np.stack(
            [
                (columns - camera.cx) / camera.fx,
                (rows - camera.cy) / camera.fy,
                np.ones(rows.shape),
            ],
            axis=-1,
        )
        lengths = np.linalg.norm(rays, axis=-1)
        rays /= lengths[..., None]
        beside = np.linalg.norm(np.cross(rays, at), axis=-1) / radius_mm
        facing = beside < _FACING
        ring = (beside > _BESIDE[0]) & (beside < _BESIDE[1])
        behind = ~(depth[ring] < at[2] - 0.3 * radius_mm)  # no return counts as behind
        if behind.mean() < _FALLS_BACK:
            return None
        front = _front_mm(at, rays, radius_mm) / lengths
        good = facing & (np.abs(depth - front) < _OFF_MM)
        if good.sum() < max(_LEAST_PIXELS, _LEAST_SEEN * facing.sum()):
            return None
        scale_mm = _NOISE_MM * max(1.0, (at[2] / _REFERENCE_MM) ** 2)

        def left_over(
            x: np.ndarray, rays: np.ndarray = rays[good], far: np.ndarray = (depth * lengths)[good]
        ) -> np.ndarray:
            return np.asarray(_front_mm(x, rays, radius_mm) - far)

        fit = least_squares(left_over, at, loss="soft_l1", f_scale=scale_mm)
        at = fit.x
    misfit_mm = float(np.sqrt((left_over(at) ** 2).mean()))
    return (misfit_mm, at) if misfit_mm < _MISFIT * scale_mm else None


def _front_mm(at: np.ndarray, rays: np.ndarray, radius_mm: float) -> np.ndarray:
    """Where rays from the camera meet a ball's front, along them."""
    along = rays @ at
    return np.asarray(along - np.sqrt(np.maximum(along**2 - at @ at + radius_mm**2, 0)))
