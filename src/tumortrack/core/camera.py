"""The pinhole depth camera: the D405's intrinsics, pixels to points and back.

Camera frame as in OpenCV: x right, y down, z forward, mm. Pixel centres lie at whole numbers,
so the image spans -0.5 .. width - 0.5, as in librealsense.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple, overload

import numpy as np
from jaxtyping import Float, Float32, Float64, Integer

from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthError, DepthFrame, Intrinsics, SensorCloud

# Depth field of view of the RealSense D405 (depth module D401) at 16:9. The D400 family's
# datasheet gives 87 x 58 degrees, +-3 degrees from lens to lens.
D405_FOV_DEGREES = (87.0, 58.0)


def d405(width: int = 848, height: int = 480) -> Intrinsics:
    """A RealSense D405 with its nominal depth field of view and centred principal point; fx and fy
    differ by 3 %. For real frames use the intrinsics that the device reports.

    Raises InputError: the size is not 16:9 within 1 % (other modes crop the field of view).
    """
    if width <= 0 or height <= 0 or abs(width / height * 9 / 16 - 1) > 0.01:
        raise InputError(
            f"a D405 depth image of {width} x {height} is not 16:9; choose for example "
            "1280 x 720, 848 x 480, 640 x 360, 480 x 270 or 424 x 240."
        )
    half_x, half_y = (math.radians(degrees) / 2 for degrees in D405_FOV_DEGREES)
    fx, fy = width / 2 / math.tan(half_x), height / 2 / math.tan(half_y)
    return Intrinsics(width, height, fx, fy, cx=(width - 1) / 2, cy=(height - 1) / 2)


def plausible(camera: Intrinsics, where: str) -> Intrinsics:
    """Return ``camera``; raise InputError, which starts with ``where``, if no depth camera can have
    these intrinsics."""
    side = max(camera.width, camera.height)
    if not all(0.1 * side < focal < 5 * side for focal in (camera.fx, camera.fy)):
        raise InputError(
            f"{where}: focal lengths {camera.fx:g}, {camera.fy:g} px are no depth camera's of "
            f"{camera.width} x {camera.height}; 0.1 to 5 times the longer side are allowed (fields "
            "of view of 11 to 157 degrees). Give those of the image's own size, in pixels."
        )
    middles = camera.cx, camera.cy  # 0 is what programs write that do not know it
    if not all(-side < middle < 2 * side and middle for middle in middles):
        raise InputError(
            f"{where}: the optical axis is at {camera.cx:g}, {camera.cy:g} px of an image of "
            f"{camera.width} x {camera.height}. Give it in pixels of this image."
        )
    return camera


class Pinhole(NamedTuple):
    """Focal lengths and principal point, px, in the form that compiled kernels take."""

    fx: float
    fy: float
    cx: float
    cy: float


def pinhole_of(intrinsics: Intrinsics) -> Pinhole:
    return Pinhole(intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)


def deproject_pixels(
    index: Integer[np.ndarray, " n"], depth_mm: Float[np.ndarray, " n"], intrinsics: Intrinsics
) -> Float32[np.ndarray, "n 3"]:
    """Camera-frame points of pixels given by flat (row-major) index and depth."""
    row, column = np.divmod(index, intrinsics.width)
    x = (column - intrinsics.cx) * (depth_mm / intrinsics.fx)
    y = (row - intrinsics.cy) * (depth_mm / intrinsics.fy)
    return np.stack([x, y, depth_mm], axis=1).astype(np.float32)


def deproject(frame: DepthFrame) -> Float32[np.ndarray, "n 3"]:
    """All pixels with a return as camera-frame points, mm, in row-major pixel order."""
    depth_mm = frame.depth_mm.ravel()
    index = np.flatnonzero(np.isfinite(depth_mm))
    return deproject_pixels(index, depth_mm[index].astype(np.float64), frame.intrinsics)


def project(
    points_mm: Float[np.ndarray, "n 3"], intrinsics: Intrinsics
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Pixel coordinates (column, row), not rounded, possibly outside the image, and depth in mm.
    A point at or behind the camera's centre has no pixel and gets NaN."""
    points = np.asarray(points_mm, np.float64)
    depth_mm = points[:, 2].copy()
    in_front = np.where(depth_mm > 0, depth_mm, np.nan)
    fx, fy, cx, cy = pinhole_of(intrinsics)
    return points[:, :2] / in_front[:, None] * [fx, fy] + [cx, cy], depth_mm


@overload
def with_depth_error(content: DepthFrame, error: DepthError | None) -> DepthFrame: ...
@overload
def with_depth_error(
    content: DepthFrame | SensorCloud, error: DepthError | None
) -> DepthFrame | SensorCloud: ...
def with_depth_error(
    content: DepthFrame | SensorCloud, error: DepthError | None
) -> DepthFrame | SensorCloud:
    """The same, of a camera whose depths err so."""
    if isinstance(content, DepthFrame):
        return replace(content, intrinsics=replace(content.intrinsics, depth_error=error))
    return replace(content, depth_error=error)
