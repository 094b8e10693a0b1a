"""What the steps of finding the organ work on: settings, and the working image, made from a
depth image or a cloud and mapped back to points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tumortrack.core.camera import Pinhole, deproject_pixels
from tumortrack.core.cloud import CloudConfig
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.native import F32, F64, I32, I64, U8, kernel
from tumortrack.segmentation.measured_noise import DepthNoise
from tumortrack.segmentation.smoothing import smoothed, window_px

MOST_PIXELS = 110_000  # 424 x 240 as it is, of 848 x 480 every second pixel
_POINTS_PER_PIXEL = 2
_BINS = 1000  # of the histogram of tangents

# Each pixel's state: still the organ's, or the step that removed it.
ORGAN, NO_RETURN, RANGE, BOX, MASK, LAST_BOX, COLOUR, PLANE, FLYING, THIN, PIECES = range(11)
STEPS = (
    *("organ", "no return", "range", "box", "mask", "last box"),
    *("colour", "plane", "flying", "thin", "other pieces"),
)

# Of a working image: depths (NaN: no return), and what ``tangents`` has.
DEPTH = F32["height", "width"].any_value
TANGENTS = F64["width"].any_value, F64["height"].any_value

# Depths, states, tangents of the columns and rows, the box's corners; the step that removes.
_keep_inside = kernel(
    "keep_inside",
    *(DEPTH, U8["height", "width"].out, *TANGENTS, (float,) * 3, (float,) * 3, int),
)
# Points; their tangents, room for two histograms, and ends of the tangents.
_cloud_tangents = kernel(
    "cloud_tangents",
    *(F32["n", 3].any_value, F32["n", 2].out, I64[2, _BINS].out, F64[3, 2].out),
)
# Tangents, depths and camera; the image, and each point's pixel.
rasterise = kernel(
    "rasterise",
    *(F32["n", 2].any_value, F32["n"].any_value, (float,) * 4),
    *(F32["height", "width"].out, I32["n"].out),
)


class RegionConfig(Config, frozen=True, kw_only=True):
    """From a whole depth image to the organ's points; camera frame, mm.

    crop: depths kept, and how many points are drawn at the end.
    box_mm: region of interest, two opposite corners; None: everywhere.
    last_margin_mm: the last estimate's organ box, enlarged by this much on every side, narrows the
        crop; zero switches that off.
    plane: remove the large plane behind the organ (table, drape), and what lies behind it.
    plane_mm: largest tolerance of the plane: how uneven a drape may be.
    plane_share: at least this share of all points must lie on it.
    flying: remove flying pixels, which have few neighbours at their depth.
    pieces: choose one connected piece; zero ``opening_mm`` leaves it as it is.
    opening_mm: what is narrower than twice this is no piece and connects none: shafts, the strip
        where a finger touches.
    crease_mm: a valley deeper than this over 4 mm to either side separates two pieces, if nothing
        is like an organ otherwise; zero: never.
    steepest_degrees: neighbouring pixels are separated if their depths differ by more than noise
        and a surface tilted by this much explain.
    noise_mm: standard deviation of depth at 150 mm; grows with z^2.
    organ_mm: shortest and longest extent of pieces that may be the organ, where no hint selects it.
    """

    crop: CloudConfig = CloudConfig()
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    last_margin_mm: float = 20.0
    plane: bool = True
    plane_mm: float = 5.0
    plane_share: float = 0.15
    flying: bool = True
    pieces: bool = True
    opening_mm: float = 3.0
    crease_mm: float = 1.2
    steepest_degrees: float = 75.0
    noise_mm: float = 0.2
    organ_mm: tuple[float, float] = (30.0, 160.0)

    def __post_init__(self) -> None:
        self.check_ranges(
            *("region", "0"),
            last_margin_mm=1e3,
            plane_mm=50,
            plane_share=1,
            opening_mm=20,
            crease_mm=20,
            steepest_degrees=89,
            noise_mm=10,
        )
        if not 0 < self.organ_mm[0] < self.organ_mm[1]:
            raise InputError(
                f"region organ_mm is {self.organ_mm}; give two sizes in mm, the smaller first."
            )
        if self.box_mm is not None and not all(
            abs(a - b) > 1 for a, b in zip(*self.box_mm, strict=True)
        ):
            raise InputError(
                f"region box_mm is {self.box_mm}; give two opposite corners (x y z, camera frame, "
                "mm) at least 1 mm apart along each axis."
            )


@dataclass(frozen=True, eq=False)
class WorkingImage:
    """A depth image at working size, and the state of its pixels.

    ``depth_mm`` (h, w) is float32, NaN without a return; ``pixel_class`` (h, w), uint8, holds the
    states above, which the steps write. Each of its pixels is one of ``step_px`` by ``step_px`` of
    the frame's, averaged over ``window_px`` to either side. ``remaining(taken)``: indices (n,) of
    the frame's or cloud's points that are still ORGAN; ``points(indices)``: these (n, 3), camera
    frame, mm.
    """

    depth_mm: np.ndarray
    pixel_class: np.ndarray
    pinhole: Pinhole
    remaining: Callable[[np.ndarray], np.ndarray]
    points: Callable[[np.ndarray], np.ndarray]
    step_px: int = 1
    window_px: int = 0

    @property
    def footprint(self) -> float:
        """Width of a pixel at distance 1."""
        return 2 / (self.pinhole.fx + self.pinhole.fy)

    @cached_property
    def tangents(self) -> tuple[np.ndarray, np.ndarray]:
        """x / z of the columns (w,) and y / z of the rows (h,)."""
        (height, width), (fx, fy, cx, cy) = self.depth_mm.shape, self.pinhole
        return (np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy

    @property
    def pixel_mm(self) -> float:
        """Width of a pixel at the median depth."""
        depths = self.depth_mm[::4, ::4]
        depths = depths[depths > 0]
        return self.footprint * float(np.median(depths)) if depths.size else 1.0

    def remove(self, where: np.ndarray, step: int) -> None:
        """Mark pixels (h, w, bool) as removed by a step, except those already removed."""
        self.pixel_class[where & (self.pixel_class == ORGAN)] = step

    def cropped(self) -> tuple[tuple[slice, slice], WorkingImage]:
        """The rows and columns of the remaining pixels, with one more to each side, and a copy of
        that part; its ``pixel_class`` must be written back."""
        rows = columns = slice(0, 1)
        organ = self.pixel_class == ORGAN
        if organ.any():
            ends = (np.flatnonzero(organ.any(axis))[[0, -1]].tolist() for axis in (1, 0))
            rows, columns = (slice(max(first - 1, 0), last + 2) for first, last in ends)
        fx, fy, cx, cy = self.pinhole
        pinhole = Pinhole(fx, fy, cx - columns.start, cy - rows.start)
        depth_mm, pixel_class = (
            self.depth_mm[rows, columns].copy(),
            self.pixel_class[rows, columns].copy(),
        )
        part = WorkingImage(depth_mm, pixel_class, pinhole, self.remaining, self.points)
        return (rows, columns), part

    def counts(self) -> dict[str, int]:
        counts = np.bincount(self.pixel_class.ravel(), minlength=len(STEPS))
        return dict(zip(STEPS, counts.tolist(), strict=True))


def sampled_pixels(frame: DepthFrame) -> tuple[slice, slice]:
    """Rows and columns of the working image: all of a small frame, each second ... of a large
    one."""
    step = int(np.ceil(np.sqrt(frame.depth_mm.size / MOST_PIXELS)))
    return slice(step // 2, None, step), slice(step // 2, None, step)


def image_of_frame(
    frame: DepthFrame, mask: np.ndarray | None, noise: DepthNoise | None = None
) -> WorkingImage:
    """A frame's ``sampled_pixels``, rid of white noise, without those outside a mask. InputError:
    of another size."""
    camera, sampled = frame.intrinsics, sampled_pixels(frame)
    step = sampled[0].step
    reach = 0 if noise is None else window_px(frame, noise)
    if noise is not None and reach:
        depth_mm = smoothed(frame, sampled, noise, reach)
    else:
        depth_mm = frame.depth_mm[sampled].copy()
    pixel_class = np.isnan(depth_mm).view(np.uint8) * np.uint8(NO_RETURN)

    def points(pixel: np.ndarray) -> np.ndarray:
        z_mm = depth_mm.ravel()[pixel].astype(np.float64)
        row, column = np.divmod(pixel, depth_mm.shape[1])
        row, column = step // 2 + row * step, step // 2 + column * step
        return deproject_pixels(row * camera.width + column, z_mm, camera)

    cx, cy = (camera.cx - step // 2) / step, (camera.cy - step // 2) / step
    pinhole = Pinhole(camera.fx / step, camera.fy / step, cx, cy)

    def remaining(pixel_class: np.ndarray) -> np.ndarray:
        return np.flatnonzero(pixel_class == ORGAN)

    image = WorkingImage(depth_mm, pixel_class, pinhole, remaining, points, step, reach)
    if mask is not None:
        if mask.shape != frame.depth_mm.shape:
            raise InputError(
                f"the mask is {mask.shape[1]} x {mask.shape[0]}, the depth image {camera.width} x "
                f"{camera.height}; give a mask of the depth image's pixels."
            )
        image.remove(~mask[sampled], MASK)
    return image


def image_of_cloud(cloud: SensorCloud) -> WorkingImage:
    """A cloud, in any order, as a pinhole camera at its origin sees it: the nearest point in each
    pixel. Points at or behind the camera's centre are left out, and so are occluded ones."""
    points_mm = np.ascontiguousarray(cloud.points_mm)
    tangents, (low, high, inner) = tangents_of(points_mm)
    z = points_mm[:, 2].copy()
    # Stray points widen the image, but don't coarsen it.
    pixels = max(len(points_mm) / _POINTS_PER_PIXEL, 64.0)
    most = np.prod(high - low + 1e-3) / MOST_PIXELS
    size = float(np.sqrt(max(np.prod(inner + 1e-3) / pixels, most)))
    width, height = (int(n) for n in np.floor((high - low) / size) + 1)
    pinhole = Pinhole(1 / size, 1 / size, float(-low[0] / size), float(-low[1] / size))
    depth_mm = np.full((height, width), np.nan, np.float32)
    pixel = np.empty(len(z), np.int32)
    rasterise(tangents, z, pinhole, depth_mm, pixel)
    pixel_class = np.isnan(depth_mm).view(np.uint8) * np.uint8(NO_RETURN)

    def remaining(pixel_class: np.ndarray) -> np.ndarray:
        index = np.flatnonzero(pixel >= 0)
        index = index[pixel_class.ravel()[pixel[index]] == ORGAN]
        return index[z[index] - depth_mm.ravel()[pixel[index]] < 2 + 2 * size * z[index]]

    return WorkingImage(depth_mm, pixel_class, pinhole, remaining, lambda index: points_mm[index])


def tangents_of(points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x / z and y / z (n, 2), NaN for points behind the camera or too far aside; and (3, 2) their
    minima, maxima, and the spread of the middle 96 %."""
    tangents, ends = np.empty((len(points_mm), 2), np.float32), np.empty((3, 2))
    _cloud_tangents(points_mm, tangents, np.empty((2, _BINS), np.int64), ends)
    return tangents, ends


def keep_inside(image: WorkingImage, corners_mm: np.ndarray, step: int) -> None:
    """Remove everything outside a box: two corners (2, 3), camera frame, mm, in any order."""
    low, high = np.sort(np.asarray(corners_mm, np.float64), axis=0)
    _keep_inside(image.depth_mm, image.pixel_class, *image.tangents, low, high, step)
