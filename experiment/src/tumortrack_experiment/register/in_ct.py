"""Balls of known diameter in a CT, found to a tenth of a millimetre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm, transform_points
from tumortrack.core.types import Volume
from tumortrack.imaging.grid import Box, extent_mm, grown_box
from tumortrack_experiment.kit_file import Kit
from tumortrack_experiment.register.beads import CT, NamedBeads, name_beads

Vector = np.ndarray

# Glass beads have 1,500 HU and more, ceramics and steel reach the scanner's last number (3071);
# whatever else is on the base, tumors (to 1000 HU) and prints (about 100), has less.
SEED_HU = 1000.0
_LONGEST = 1.6  # of a seed, in diameters: a screw is longer
_MOST_SEEDS = 300
_STEP_MM = 0.25  # of the blurred ball's table
_POINT_SPREADS_MM = (0.4, 0.7, 1.1)  # standard deviations of scanners, soft kernels last
_OUTSIDE = 0.04  # with less of the ball in it, a voxel shows what lies about it
_SHELL_MM = 1.8
_NEIGHBOURS = 6  # of the surroundings in a direction
_LEAST_CONTRAST_HU = 700.0
_MISFIT = 0.11  # rms of the contrast; other shapes and sizes have more
_LARGEST_HU = 30_000.0  # steel on an extended scale


@dataclass(frozen=True, eq=False)
class Ball:
    """``center_mm``: LPS; ``hu_around``: the middle of what lies about it; ``misfit``: rms
    difference from a blurred ball, as a share of its contrast."""

    center_mm: Float64[np.ndarray, " 3"]
    hu_around: float
    misfit: float


def find_balls(volume: Volume, diameter_mm: float, seed_hu: float = SEED_HU) -> list[Ball]:
    """All bright balls of a diameter. A ball blurred by the scanner and its voxels is fitted to
    each bright spot, before what is seen about it in each direction: a ball on a post has air
    above and plastic below, which draws a centroid down. What is clipped at the scale's end is
    clipped in the model too.

    Raises:
        InputError: more bright spots than a phantom on its base has (metal, a patient's CT).
    """
    from scipy import ndimage

    steps = spacing_mm(volume.lps_from_index)
    pieces, _ = ndimage.label(volume.hu >= seed_hu, np.ones((3, 3, 3)))
    most = _LONGEST * diameter_mm + 2 * steps
    seeds = [box for box in ndimage.find_objects(pieces) if (extent_mm(box, steps) <= most).all()]
    if len(seeds) > _MOST_SEEDS:
        raise InputError(
            f"the CT has {len(seeds)} spots of over {seed_hu:g} HU as small as a bead of "
            f"{diameter_mm:g} mm; at most {_MOST_SEEDS} are allowed. Is it the phantom on its base?"
        )
    models = (_Model(diameter_mm / 2, spread, steps) for spread in _POINT_SPREADS_MM)
    tries = [[ball for seed in seeds if (ball := _fit(volume, seed, one))] for one in models]
    balls = max(tries, key=lambda found: (len(found), -sum(ball.misfit for ball in found)))
    return _different(balls, diameter_mm / 2)


def beads_in_ct(kit: Kit, volume: Volume) -> NamedBeads:
    """The kit's beads in a CT, LPS. Raises InputError: as ``find_balls`` and ``name_beads``."""
    return name_beads(kit, middles_mm(find_balls(volume, kit.bead_diameter_mm)), CT)


def middles_mm(balls: list[Ball]) -> Float64[np.ndarray, "n 3"]:
    return np.array([ball.center_mm for ball in balls], np.float64).reshape(-1, 3)


class _Model:
    """How much of a ball a voxel holds, by the voxel's place relative to its middle."""

    def __init__(self, radius_mm: float, point_spread_mm: float, steps_mm: np.ndarray) -> None:
        from scipy import ndimage

        self.radius_mm, self.steps_mm = radius_mm, steps_mm
        self.blur_mm = np.sqrt(point_spread_mm**2 + steps_mm**2 / 12)  # and a voxel's own extent
        self.reach_mm = radius_mm + 2 * self.blur_mm  # no ball any more
        half = np.ceil((self.reach_mm + _SHELL_MM + 3 * steps_mm) / _STEP_MM).astype(int)
        axes = [np.arange(-n, n + 1) * _STEP_MM for n in half.tolist()]
        away = np.sqrt(sum(axis**2 for axis in np.meshgrid(*axes, indexing="ij", sparse=True)))
        filled = np.clip((radius_mm - away) / _STEP_MM + 0.5, 0, 1)
        self._table = ndimage.gaussian_filter(filled, self.blur_mm / _STEP_MM)
        self._middle = half

    def share(self, at_mm: np.ndarray) -> np.ndarray:
        from scipy import ndimage

        cells = at_mm / _STEP_MM + self._middle
        return ndimage.map_coordinates(self._table, cells.T, order=1, mode="nearest")


def _fit(volume: Volume, seed: Box, model: _Model) -> Ball | None:
    from scipy.optimize import least_squares

    top_hu = float(volume.hu.max())
    steps = model.steps_mm
    margin = np.ceil((model.reach_mm + _SHELL_MM) / steps).astype(int)
    around = grown_box(seed, volume.hu.shape, margin)
    first = np.array([side.start for side in around])
    hu = volume.hu[around].astype(np.float64)
    places_mm = (np.argwhere(np.ones(hu.shape, bool)) + first) * steps
    hu = hu.ravel()
    weight = np.clip(hu - SEED_HU / 2, 0, None)
    middle_mm = (weight[:, None] * places_mm).sum(0) / weight.sum()
    bright_hu, about = float(hu.max()), np.zeros(0)
    for _ in range(2):  # the second time round its middle
        near = np.linalg.norm((places_mm - middle_mm) / (model.reach_mm + _SHELL_MM), axis=1) <= 1
        at_mm, here = places_mm[near], hu[near]
        if len(about := _about(at_mm - middle_mm, here, model)) == 0:
            return None

        def misfit(
            x: np.ndarray,
            at: np.ndarray = at_mm,
            here: np.ndarray = here,
            about: np.ndarray = about,
        ) -> np.ndarray:
            share = model.share(at - x[:3])
            return np.asarray(np.minimum(about + (x[3] * 1000 - about) * share, top_hu) - here)

        start = np.array([*middle_mm, bright_hu / 1000])
        ends = ([-np.inf] * 3 + [0.0], [np.inf] * 3 + [_LARGEST_HU / 1000])
        fit = least_squares(misfit, start, bounds=ends, loss="soft_l1", f_scale=100.0)
        moved_mm = float(np.linalg.norm(fit.x[:3] - middle_mm))
        middle_mm, bright_hu = fit.x[:3], float(fit.x[3]) * 1000
        if moved_mm > model.radius_mm:
            return None
    contrast_hu = min(bright_hu, top_hu) - float(np.median(about))
    error = float(np.sqrt((misfit(fit.x) ** 2).mean())) / max(contrast_hu, 1.0)
    if contrast_hu < _LEAST_CONTRAST_HU or error > _MISFIT:
        return None
    center_mm = transform_points(volume.lps_from_index, (middle_mm / steps)[None])[0]
    return Ball(center_mm, float(np.median(about)), error)


def _about(at_mm: np.ndarray, hu: np.ndarray, model: _Model) -> np.ndarray:
    """What would be in each voxel without the ball: what lies behind it, seen from its middle.
    Empty: nothing is seen about it."""
    from scipy.spatial import cKDTree

    shell = np.linalg.norm(at_mm / model.reach_mm, axis=1) > 1
    if shell.sum() < 4 * _NEIGHBOURS:
        return np.zeros(0)
    away = at_mm / np.maximum(np.linalg.norm(at_mm, axis=1, keepdims=True), 1e-6)
    _, nearest = cKDTree(away[shell]).query(away, _NEIGHBOURS)
    return np.asarray(hu[shell][nearest].mean(1))


def _different(balls: list[Ball], least_mm: float) -> list[Ball]:
    """Each once, the better fit of two that nearly coincide."""
    kept: list[Ball] = []
    for ball in sorted(balls, key=lambda one: one.misfit):
        if all(np.linalg.norm(ball.center_mm - one.center_mm) > least_mm for one in kept):
            kept.append(ball)
    return kept
