"""Depth image or cloud -> the working picture that all steps share; and back to points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.sense.camera import Pinhole, deproject_pixels

MOST_PIXELS = 110_000  # of a working picture: 424 x 240, and every second pixel of 848 x 480
_POINTS_PER_PIXEL = 2
_WIDEST = 2.0  # tangent of the largest angle from the optical axis in a rasterised cloud

# What became of a pixel: still the organ's, or the step that took it.
ORGAN, NO_RETURN, RANGE, BOX, MASK, LAST_BOX, PLANE, FLYING, THIN, PIECES = range(10)
STEPS = (
    *("organ", "no return", "range", "box", "mask"),
    *("last box", "plane", "flying", "thin", "other pieces"),
)


jit = numba.njit(cache=True, nogil=True)


@dataclass(frozen=True, eq=False)
class Picture:
    """A depth image at working size, and what the steps have decided about its pixels so far.

    Attributes:
        depth_mm: (h, w) float32, NaN where there was no return.
        taken: (h, w) uint8, one of the numbers above; the steps write into it.
        pinhole: of the working picture.
        left: ``taken`` -> which points of the content are still called ORGAN, (n,) int.
        points: some of these -> points (n, 3), camera frame, mm, float32.
    """

    depth_mm: np.ndarray
    taken: np.ndarray
    pinhole: Pinhole
    left: Callable[[np.ndarray], np.ndarray]
    points: Callable[[np.ndarray], np.ndarray]

    @property
    def footprint(self) -> float:
        """Width of a pixel at distance 1."""
        return 2 / (self.pinhole.fx + self.pinhole.fy)

    def take(self, where: np.ndarray, step: int) -> None:
        """Give the pixels (h, w, bool) that are still the organ's to a step."""
        self.taken[where & (self.taken == ORGAN)] = step

    def remaining(self) -> tuple[slice, slice]:
        """The rows and columns that hold what is left, and one more to each side."""
        rows, columns = (np.flatnonzero((self.taken == ORGAN).any(axis)) for axis in (1, 0))
        if not len(rows):
            return slice(0, 1), slice(0, 1)
        tall, wide = (slice(max(int(i[0]) - 1, 0), int(i[-1]) + 2) for i in (rows, columns))
        return tall, wide

    def part(self, window: tuple[slice, slice]) -> Picture:
        """Those rows and columns alone; what is decided there must be written back."""
        fx, fy, cx, cy = self.pinhole
        pinhole = Pinhole(fx, fy, cx - window[1].start, cy - window[0].start)
        depth_mm, taken = self.depth_mm[window].copy(), self.taken[window].copy()
        return Picture(depth_mm, taken, pinhole, self.left, self.points)

    def counts(self) -> dict[str, int]:
        """Pixels by what became of them."""
        return dict(zip(STEPS, _count(self.taken, len(STEPS)).tolist(), strict=True))


def picture_of_frame(frame: DepthFrame, mask: np.ndarray | None) -> Picture:
    """Every pixel of a small frame, every second, third ... of a large one.

    Raises:
        InputError: the mask's shape is not the image's.
    """
    camera = frame.intrinsics
    step = int(np.ceil(np.sqrt(frame.depth_mm.size / MOST_PIXELS)))
    some = (slice(step // 2, None, step), slice(step // 2, None, step))
    depth_mm = frame.depth_mm[some].copy()
    taken = np.isnan(depth_mm).view(np.uint8) * np.uint8(NO_RETURN)

    def left(taken: np.ndarray) -> np.ndarray:
        return np.flatnonzero(taken == ORGAN)

    def points(pixel: np.ndarray) -> np.ndarray:
        row, column = np.divmod(pixel, depth_mm.shape[1])
        row, column = step // 2 + row * step, step // 2 + column * step
        seen_mm = frame.depth_mm[row, column].astype(np.float64)
        return deproject_pixels(row * camera.width + column, seen_mm, camera)

    pinhole = Pinhole(
        camera.fx / step,
        camera.fy / step,
        (camera.cx - step // 2) / step,
        (camera.cy - step // 2) / step,
    )
    picture = Picture(depth_mm, taken, pinhole, left, points)
    if mask is not None:
        if mask.shape != frame.depth_mm.shape:
            raise InputError(
                f"the mask is {mask.shape[1]} x {mask.shape[0]}, the depth image {camera.width} x "
                f"{camera.height}; give a mask of the depth image's pixels."
            )
        picture.take(~mask[some], MASK)
    return picture


def picture_of_cloud(cloud: SensorCloud) -> Picture:
    """A cloud in any order as a pinhole camera at its origin sees it: the nearest point a pixel.

    Points at or behind the camera's centre are left out, and so are those behind another.
    """
    points_mm = cloud.points_mm
    tangents, low, high, inner = _spread(points_mm.copy(), _WIDEST)
    # Stray points widen the picture, but don't coarsen it.
    pixels = max(len(tangents) / _POINTS_PER_PIXEL, 64.0)
    most = np.prod(high - low + 1e-3) / MOST_PIXELS
    size = float(np.sqrt(max(np.prod(inner + 1e-3) / pixels, most)))
    width, height = (int(n) for n in np.floor((high - low) / size) + 1)
    pinhole = Pinhole(1 / size, 1 / size, float(-low[0] / size), float(-low[1] / size))
    depth_mm, pixel = _rasterise(tangents, points_mm[:, 2].copy(), pinhole, height, width)
    taken = np.isnan(depth_mm).view(np.uint8) * np.uint8(NO_RETURN)

    def left(taken: np.ndarray) -> np.ndarray:
        seen = np.flatnonzero(pixel >= 0)
        seen = seen[taken.ravel()[pixel[seen]] == ORGAN]
        behind_mm = points_mm[seen, 2] - depth_mm.ravel()[pixel[seen]]
        return seen[behind_mm < 2 + 2 * size * points_mm[seen, 2]]

    return Picture(depth_mm, taken, pinhole, left, lambda some: points_mm[some])


def keep_inside(picture: Picture, corners_mm: np.ndarray, step: int) -> None:
    """Take everything outside a box: two corners (2, 3), camera frame, mm, in any order."""
    low, high = np.sort(np.asarray(corners_mm, np.float64), axis=0)
    _keep_inside(picture.depth_mm, picture.taken, picture.pinhole, low, high, step)


@jit
def _keep_inside(depth_mm, taken, pinhole, low, high, step):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = pinhole
    height, width = depth_mm.shape
    for v in range(height):
        slope_y = (v - cy) / fy
        for u in range(width):
            if taken[v, u]:
                continue
            z = depth_mm[v, u]
            x, y = (u - cx) / fx * z, slope_y * z
            inside = low[2] < z < high[2] and low[1] < y < high[1] and low[0] < x < high[0]
            if not inside:
                taken[v, u] = step


@jit
def _spread(points_mm, widest):  # type: ignore[no-untyped-def]
    """x / z and y / z (n, 2), NaN where not before the camera or wider than ``widest``; their
    extremes (2,) and (2,); and how far the middle 96 % spread (2,), from a histogram: the order of
    the points doesn't matter."""
    tangents = np.full((len(points_mm), 2), np.nan, np.float32)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    count = 0
    for i in range(len(points_mm)):
        z = points_mm[i, 2]
        if z > 1.0:
            x, y = points_mm[i, 0] / z, points_mm[i, 1] / z
            if abs(x) < widest and abs(y) < widest:
                tangents[i, 0], tangents[i, 1] = x, y
                low[0], low[1] = min(low[0], x), min(low[1], y)
                high[0], high[1] = max(high[0], x), max(high[1], y)
                count += 1
    if count == 0:
        return tangents, np.zeros(2), np.zeros(2), np.zeros(2)
    return tangents, low, high, _inner_spread(tangents, low, high, count)


@jit
def _inner_spread(tangents, low, high, count):  # type: ignore[no-untyped-def]
    bins = 1000
    found = np.zeros((2, bins), np.int64)
    for i in range(len(tangents)):
        if not np.isnan(tangents[i, 0]):
            for k in range(2):
                share = (tangents[i, k] - low[k]) / max(high[k] - low[k], 1e-9)
                found[k, min(int(share * bins), bins - 1)] += 1
    inner = np.zeros(2)
    for k in range(2):
        total = 0
        for one in found[k]:
            total += one
            if 0.02 * count < total < 0.98 * count:
                inner[k] += (high[k] - low[k]) / bins
    return inner


@jit
def _rasterise(tangents, z_mm, pinhole, height, width):  # type: ignore[no-untyped-def]
    """The nearest depth in each pixel (h, w), and each point's pixel (n,), -1 outside."""
    fx, fy, cx, cy = pinhole
    depth_mm = np.full(height * width, np.nan, np.float32)
    pixel = np.full(len(tangents), -1, np.int32)
    for i in range(len(tangents)):
        if np.isnan(tangents[i, 0]):
            continue
        u = int(fx * tangents[i, 0] + cx + 0.5)
        v = int(fy * tangents[i, 1] + cy + 0.5)
        if 0 <= u < width and 0 <= v < height:
            place = v * width + u
            pixel[i] = place
            if not depth_mm[place] <= z_mm[i]:
                depth_mm[place] = z_mm[i]
    return depth_mm.reshape(height, width), pixel


@jit
def _count(taken, kinds):  # type: ignore[no-untyped-def]
    found = np.zeros(kinds, np.int64)
    for v in range(len(taken)):
        for u in range(taken.shape[1]):
            found[taken[v, u]] += 1
    return found
