"""Balls of known diameter in a CT, found to a tenth of a millimetre."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm, transform_points
from tumortrack.core.grid import Box, extent_mm, grown_box
from tumortrack.core.types import Volume

# Glass beads have 1,500 HU and more, ceramics and steel reach the scanner's last number (3071);
# whatever else is on the base, tumors (to 1000 HU) and prints (about 100), has less.
_SEED_HU = 1000.0
_LONGEST = 1.6  # of a seed, in diameters: a screw is longer
_MOST_SEEDS = 300
_STEP_MM = 0.25  # of the blurred ball's table
_POINT_SPREADS_MM = (0.4, 0.7, 1.1)  # standard deviations of sharp, usual and soft kernels
_SHELL_MM = 1.8  # beyond the ball, where what lies about it is seen
_NEIGHBOURS = 6  # of it in a direction
_LEAST_CONTRAST_HU = 700.0
_MISFIT = 0.11  # rms of the contrast; other shapes and sizes have more
_LARGEST_HU = 30_000.0  # steel on an extended scale


class Ball(NamedTuple):
    """``center_mm``: LPS; ``hu_around``: the middle of what lies about it; ``misfit``: rms
    difference from a blurred ball, as a share of its contrast."""

    center_mm: Float64[np.ndarray, " 3"]
    hu_around: float
    misfit: float


def find_balls(volume: Volume, diameter_mm: float) -> list[Ball]:
    """All bright balls of a diameter. A ball blurred by the scanner and its voxels is fitted to
    each bright spot, before what is seen about it in each direction: a ball on a post has air
    above and plastic below, which draws a centroid down. What is clipped at the scale's end is
    clipped in the model too.

    Raises:
        InputError: more bright spots than a phantom on its base has (metal, a patient's CT).
    """
    steps, top_hu = spacing_mm(volume.lps_from_index), float(volume.hu.max())
    most_mm = _LONGEST * diameter_mm + 2 * steps
    boxes = ndimage.find_objects(ndimage.label(volume.hu >= _SEED_HU, np.ones((3, 3, 3)))[0])
    seeds = [box for box in boxes if (extent_mm(box, steps) <= most_mm).all()]
    if len(seeds) > _MOST_SEEDS:
        raise InputError(
            f"the CT has {len(seeds)} spots of over {_SEED_HU:g} HU as small as a bead of "
            f"{diameter_mm:g} mm; at most {_MOST_SEEDS} are allowed. Is it the phantom on its base?"
        )
    models = (_Model(diameter_mm / 2, spread, steps, top_hu) for spread in _POINT_SPREADS_MM)
    tries = [[ball for box in seeds if (ball := _fit(volume, box, one))] for one in models]
    return max(tries, key=lambda found: (len(found), -sum(ball.misfit for ball in found)))


def middles_mm(balls: list[Ball]) -> Float64[np.ndarray, "n 3"]:
    return np.array([ball.center_mm for ball in balls], np.float64).reshape(-1, 3)


class _Model:
    """A ball as the scanner sees it: ``share`` of it in a voxel, and HU clipped at ``top_hu``."""

    def __init__(
        self, radius_mm: float, point_spread_mm: float, steps_mm: np.ndarray, top_hu: float
    ) -> None:
        self.radius_mm, self.steps_mm, self._top_hu = radius_mm, steps_mm, top_hu
        blur_mm = np.sqrt(point_spread_mm**2 + steps_mm**2 / 12)  # and a voxel's own extent
        self.reach_mm = radius_mm + 2 * blur_mm  # no ball any more
        self._half = np.ceil((self.reach_mm + _SHELL_MM + 3 * steps_mm) / _STEP_MM).astype(int)
        axes = [np.arange(-n, n + 1) * _STEP_MM for n in self._half.tolist()]
        away_mm = np.sqrt(sum(axis**2 for axis in np.meshgrid(*axes, indexing="ij", sparse=True)))
        filled = np.clip((radius_mm - away_mm) / _STEP_MM + 0.5, 0, 1)
        self._table = ndimage.gaussian_filter(filled, blur_mm / _STEP_MM)

    def misfit(self, x: np.ndarray, at: np.ndarray, hu: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Of a ball at x[:3] (mm) with x[3] thousand HU in voxels at ``at`` that have ``hu``, and
        would have ``out`` without it."""
        cells = (at - x[:3]) / _STEP_MM + self._half
        share = ndimage.map_coordinates(self._table, cells.T, order=1, mode="nearest")
        return np.asarray(np.minimum(out + (x[3] * 1000 - out) * share, self._top_hu) - hu)

    def around(self, at_mm: np.ndarray, hu: np.ndarray) -> np.ndarray:
        """What would be in voxels, relative to the ball's middle, without it: what lies behind
        them, seen from there. Empty: nothing is seen about it."""
        shell = np.linalg.norm(at_mm / self.reach_mm, axis=1) > 1
        if shell.sum() < 4 * _NEIGHBOURS:
            return np.zeros(0)
        away = at_mm / np.maximum(np.linalg.norm(at_mm, axis=1, keepdims=True), 1e-6)
        _, nearest = cKDTree(away[shell]).query(away, _NEIGHBOURS)
        return np.asarray(hu[shell][nearest].mean(1))


def _fit(volume: Volume, seed: Box, model: _Model) -> Ball | None:
    steps, reach_mm = model.steps_mm, model.reach_mm + _SHELL_MM
    box = grown_box(seed, volume.hu.shape, np.ceil(reach_mm / steps).astype(int))
    places_mm = (np.argwhere(np.ones(volume.hu[box].shape)) + [s.start for s in box]) * steps
    hu = volume.hu[box].ravel().astype(np.float64)
    weight = np.clip(hu - _SEED_HU / 2, 0, None)
    x = np.array([*(weight @ places_mm / weight.sum()), hu.max() / 1000])
    ends = ([-np.inf] * 3 + [0.0], [np.inf] * 3 + [_LARGEST_HU / 1000])
    for _ in range(2):  # the second time round its middle
        near = np.linalg.norm((places_mm - x[:3]) / reach_mm, axis=1) <= 1
        out = model.around(places_mm[near] - x[:3], hu[near])
        if len(out) == 0:
            return None
        seen, before = (places_mm[near], hu[near], out), x
        x = least_squares(model.misfit, x, bounds=ends, loss="soft_l1", f_scale=100.0, args=seen).x
        if np.linalg.norm((x - before)[:3]) > model.radius_mm:
            return None
    hu_around = float(np.median(out))
    contrast_hu = max(min(x[3] * 1000, float(hu.max())) - hu_around, 1.0)
    error = float(np.sqrt((model.misfit(x, *seen) ** 2).mean())) / contrast_hu
    if contrast_hu < _LEAST_CONTRAST_HU or error > _MISFIT:
        return None
    center_mm = transform_points(volume.lps_from_index, (x[:3] / steps)[None])[0]
    return Ball(center_mm, hu_around, error)
