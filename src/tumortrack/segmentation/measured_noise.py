"""The noise of a depth image or cloud, measured in it: what local quadratics leave.

A tissue's surface is smooth over a few millimetres, and noise is not. So a quadratic is fitted in
windows; of what it leaves, the semivariogram over lags of 1 to 9 pixels tells the white part, which
is whole at the first lag, from the correlated one, which comes with the lag (Cressie 1993, doi
10.1002/9781119115151). What a quadratic takes away of either is known, and is given back.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tumortrack.core.types import DepthFrame, PointNoise, SensorCloud

_WINDOW_MM = 12.0  # a quadratic leaves 0.01 mm of a ball's surface of 25 mm radius
_SIDES_PX = 9, 31  # of a window, at least and at most
_LAGS = np.arange(1, 10)
_LENGTHS_PX = np.geomspace(1.0, 15.0, 13)  # that are tried, up to half a window
_MOST_WINDOWS = 400  # a hundredth of the noise is then known; 10 ms
_FEWEST = 12
_ROUGH = 4.0  # times the median variance: an edge, a fold, a window with an outlier
_EDGES = 8.0  # times an image's decile: nine tenths of its windows may have such
_NEIGHBOURS, _SPARSE_MM = 40, 3.0
_WIDER = 4.0  # times the noise: the radius within which neighbours lie
_STEP_OFF, _LEAST_STEP_MM = 0.02, 1e-3  # of a step, and of one: rounding of stored numbers
_MOST_POINTS, _MOST_MIDDLES = 5000, 200  # of a cloud: more are hardly more certain
TERMS = 6  # of a quadratic
CROWD, LONELY = 8, 2.0  # a stray's so many neighbours reach more than so many times the usual
_MOST_VALUES = 20_000  # depths among which the step is looked for


class DepthNoise(NamedTuple):
    """Standard deviations along the line of sight, mm, at ``depth_mm``, where they were measured.

    ``white_mm`` is independent in each pixel or point, ``correlated_mm`` shared by neighbours, with
    1/e at ``correlation_px``; of a cloud, whose pixels are unknown, all is white. ``step_mm``:
    between the depths that occur, 0 where none is seen. ``bound``: it is at most so large: it lies
    below half a step, or the points are too sparse to tell it from the surface's shape.
    """

    white_mm: float
    correlated_mm: float
    correlation_px: float
    step_mm: float
    depth_mm: float
    bound: bool

    @property
    def whole_mm(self) -> float:
        return float(np.hypot(self.white_mm, self.correlated_mm))

    def of_points(self, count: int, window_px: int = 0) -> PointNoise:
        """Of points of ``count`` pixels, each averaged over a window of so many pixels to either
        side."""
        point_mm, mean_mm = self.mean_mm((2 * window_px + 1) ** 2), self.mean_mm(max(count, 1))
        return PointNoise(self.whole_mm, point_mm, mean_mm)

    def mean_mm(self, pixels: int) -> float:
        """Of the mean of neighbouring pixels. Correlated noise is as if so many patches of its
        length were independent."""
        patch_px = max(np.pi * self.correlation_px**2, 1.0)
        shared = self.correlated_mm**2 * min(patch_px / pixels, 1.0)
        return float(np.sqrt(self.white_mm**2 / pixels + shared))

    @property
    def message(self) -> str:
        """As a clause."""
        at = f"{self.whole_mm:.2g} mm at {self.depth_mm:.0f} mm"
        if self.bound:
            return f"noise of at most {at}"
        if self.correlated_mm < self.white_mm / 3:
            return f"noise {at}"
        return f"noise {at}, most of it shared over {self.correlation_px:.0f} pixels"

    @property
    def entry(self) -> dict[str, float | bool]:
        """For JSON."""
        return {"mm": self.whole_mm, **self._asdict()}


def noise_of(content: DepthFrame | SensorCloud) -> DepthNoise | None:
    """``image_noise`` or ``cloud_noise``."""
    return image_noise(content) if isinstance(content, DepthFrame) else cloud_noise(content)


def image_noise(frame: DepthFrame) -> DepthNoise | None:
    """Of a depth image; None: it has no smooth surface of some size."""
    depth_mm = frame.depth_mm
    step_mm = depth_step_mm(depth_mm)
    found = depth_mm[np.isfinite(depth_mm)]
    if not len(found):
        return None
    pixel_mm = float(np.median(found)) / frame.intrinsics.fx
    side = int(np.clip(_WINDOW_MM / pixel_mm, *_SIDES_PX)) // 2 * 2 + 1
    windows = _windows(depth_mm, side)
    if len(windows) < _FEWEST:
        return None
    residuals = windows - (windows @ (basis := _quadratics(side))) @ basis.T
    variances = np.mean(residuals**2, axis=1)
    smooth = variances <= _EDGES * np.quantile(variances, 0.1)
    seen = _semivariogram(residuals[smooth].reshape(-1, side, side))
    white_mm, correlated_mm, length_px = _parts(seen, side)
    at_mm = float(np.median(windows[smooth].mean(1)))
    bound = bool(np.hypot(white_mm, correlated_mm) < step_mm / 2)
    if bound:
        white_mm, correlated_mm = step_mm / 2, 0.0
    return DepthNoise(white_mm, correlated_mm, length_px, step_mm, at_mm, bound)


def cloud_noise(cloud: SensorCloud) -> DepthNoise | None:
    """Of a cloud of any density; None: it has too few points."""
    if len(cloud.points_mm) < 2 * _NEIGHBOURS:
        return None
    points, middles, distance_mm2 = _around(cloud)
    distance_mm = float(np.sqrt(np.median(np.partition(distance_mm2, 1, axis=1)[:, 1])))
    while True:
        near = np.argpartition(distance_mm2, _NEIGHBOURS, axis=1)[:, :_NEIGHBOURS]
        local = points[near] - middles[:, None]
        _, left = local_quadratics(local)
        variances = np.sum(left**2, axis=1) / (_NEIGHBOURS - TERMS)
        smooth = variances <= _ROUGH * np.median(variances)
        white_mm = float(np.sqrt(variances[smooth].mean()))
        reach_mm = float(np.median(np.sqrt((local**2).sum(2)).max(1)))
        # Neighbours within little more than the noise have no direction of a surface.
        if reach_mm > _WIDER * white_mm or len(points) < 4 * _NEIGHBOURS:
            break
        points, distance_mm2 = points[::2], distance_mm2[:, ::2]
    at_mm = float(np.median(points[:, 2]))
    return DepthNoise(white_mm, 0.0, 0.0, 0.0, at_mm, distance_mm > _SPARSE_MM)


def local_quadratics(
    local: Float[np.ndarray, "n k 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n k"]]:
    """Through neighbours of points, relative to these: by how much the surface there lies off each
    point, along the normal; and how far the neighbours lie from it."""
    middle = local.mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", local - middle, local - middle))
    height, u, v = np.einsum("nki,nij->jnk", local, axes)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1)
    normal = np.einsum("nkt,nks->nts", terms, terms)
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(TERMS)
    found = np.linalg.solve(normal, np.einsum("nkt,nk->nt", terms, height)[..., None])[..., 0]
    left = height - np.einsum("nkt,nt->nk", terms, found)
    return found[:, :1] * axes[:, :, 0], left


def scattered_share(cloud: SensorCloud) -> float:
    """The share of the points that have few neighbours: about that of outliers."""
    if len(cloud.points_mm) < 2 * _NEIGHBOURS:
        return 0.0
    _, _, distance_mm2 = _around(cloud)
    reach_mm2 = np.partition(distance_mm2, CROWD, axis=1)[:, CROWD]
    return float(np.mean(reach_mm2 > (LONELY**2) * np.median(reach_mm2)))


def _around(cloud: SensorCloud) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a cloud, some of these, and the squares of the distances between them. Not by
    scipy's tree, whose import takes longer."""
    points = np.asarray(cloud.points_mm, float)
    points = points[:: len(points) // _MOST_POINTS + 1]
    middles = points[:: len(points) // _MOST_MIDDLES + 1]
    half = (points**2).sum(1) - 2 * middles @ points.T
    return points, middles, np.maximum(half + (middles**2).sum(1)[:, None], 0.0)


def depth_step_mm(depth_mm: Float[np.ndarray, "h w"]) -> float:
    """Between neighbouring values that occur, at the median depth: all apart by whole numbers of a
    step in depth, or in its inverse, as of a camera that stores disparities; 0: neither."""
    values = np.unique(depth_mm[np.isfinite(depth_mm)][:_MOST_VALUES].astype(float))
    if len(values) < 3:
        return 0.0
    middle = float(np.median(values))
    for scale, back in ((values, 1.0), (1 / values[::-1], middle**2)):
        apart = np.diff(scale)
        steps = apart / (step := apart.min())
        whole = np.abs(steps - np.rint(steps)).max() < _STEP_OFF * len(steps) ** 0.5
        if whole and step * back > _LEAST_STEP_MM:
            return float(step * back)
    return 0.0


def _windows(depth_mm: np.ndarray, side: int) -> Float[np.ndarray, "n pixels"]:
    """Whole windows, evenly drawn from the image, as rows of pixels."""
    view = np.lib.stride_tricks.sliding_window_view(depth_mm, (side, side))
    every = max(1, side // 3)
    whole = np.isfinite(view[::every, ::every]).all((2, 3))
    rows, columns = np.nonzero(whole)
    drawn = np.linspace(0, len(rows) - 1, min(len(rows), _MOST_WINDOWS)).astype(int)
    chosen = view[every * rows[drawn], every * columns[drawn]]
    return chosen.reshape(len(drawn), side * side).astype(float)


@lru_cache(maxsize=32)
def _quadratics(side: int) -> Float[np.ndarray, "pixels 6"]:
    """An orthonormal basis of them."""
    x = np.linspace(-1, 1, side)
    v, u = (grid.ravel() for grid in np.meshgrid(x, x, indexing="ij"))
    return np.linalg.qr(np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], 1))[0]


def _semivariogram(left: Float[np.ndarray, "n side side"]) -> Float[np.ndarray, " lags"]:
    """Over both axes, and the variance at last; medians over the windows, as folds and edges have
    more."""
    lags = _LAGS[: left.shape[1] // 2 - 1]
    plane = (1, 2)
    along = [
        np.mean((left[:, h:] - left[:, :-h]) ** 2, plane)
        + np.mean((left[..., h:] - left[..., :-h]) ** 2, plane)
        for h in lags
    ]
    return np.median([*(np.array(along) / 4), np.mean(left**2, plane)], axis=1)


def _parts(seen: Float[np.ndarray, " lags"], side: int) -> tuple[float, float, float]:
    """Standard deviation of the white and of the correlated part, and its length, px."""
    fits = []
    for length_px, expected in _expected(side):
        parts = expected / seen[:, None]
        for free in ([0, 1], [0], [1]):  # neither variance is below 0
            found, *_ = np.linalg.lstsq(parts[:, free], np.ones(len(seen)))
            if (found >= 0).all():
                variances = np.zeros(2)
                variances[free] = found
                fits.append((float(np.sum((parts @ variances - 1) ** 2)), length_px, variances))
    _, length_px, (white, correlated) = min(fits, key=lambda fit: fit[0])
    return float(np.sqrt(white)), float(np.sqrt(correlated)), length_px if correlated else 0.0


@lru_cache(maxsize=32)
def _expected(side: int) -> list[tuple[float, Float[np.ndarray, "lags 2"]]]:
    """For each length that can be told in such a window, the semivariogram that quadratics leave of
    white noise and of correlated noise of variance 1 each."""
    white = _left_of(np.eye(side), side)
    lengths = _LENGTHS_PX[side / 2 >= _LENGTHS_PX]
    gap = np.abs(np.subtract.outer(np.arange(side), np.arange(side)))
    return [
        (float(one), np.stack([white, _left_of(np.exp(-((gap / one) ** 2)), side)], 1))
        for one in lengths
    ]


def _left_of(along: Float[np.ndarray, "side side"], side: int) -> Float[np.ndarray, " lags"]:
    """Of noise whose covariance is ``along`` each axis, and their product in the plane."""
    basis = _quadratics(side)
    grid = basis.reshape(side, side, -1)
    spread = np.einsum("ij,jkt->ikt", along, np.einsum("jkt,kl->jlt", grid, along))
    inner = basis.T @ spread.reshape(side * side, -1)

    def covariance(h: int, axis: int) -> Float[np.ndarray, "a b"]:
        """Between pixels h apart along an axis, of what is left."""
        one, two = (slice(h, None), slice(None, side - h))
        a = (one, slice(None)) if axis == 0 else (slice(None), one)
        b = (two, slice(None)) if axis == 0 else (slice(None), two)
        before = along[h, 0] * along[0, 0]
        pixel_class = np.einsum("ijt,ijt->ij", grid[a], spread[b])
        pixel_class += np.einsum("ijt,ijt->ij", spread[a], grid[b])
        back = np.einsum("ijt,ts,ijs->ij", grid[a], inner, grid[b])
        return before - pixel_class + back

    own = covariance(0, 0)
    lags = _LAGS[: side // 2 - 1]
    out = []
    for h in lags:
        sides = [
            (own[h:].mean() + own[: side - h].mean()) / 2 - covariance(int(h), 0).mean(),
            (own[:, h:].mean() + own[:, : side - h].mean()) / 2 - covariance(int(h), 1).mean(),
        ]
        out.append(sum(sides) / 2)
    return np.array([*out, own.mean()])
