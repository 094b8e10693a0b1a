"""Cameras by their published noise (sensors.toml): errors that a frame has, and a unit has.

Stereo errs by a disparity, so with z^2 / (f b) in depth; time of flight by a polynomial. Of each
there is a random part, another in every frame, and a frozen one, which time does not average away.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, Literal

import msgspec
import numpy as np
from jaxtyping import Float32

from tumortrack.core.errors import InputError
from tumortrack.core.tables import read_table
from tumortrack.core.types import DepthError, DepthFrame
from tumortrack.io.depth_files import MOST_LEFT_MM
from tumortrack.simulation.noise import SENSORS, NoiseConfig

Grade = Literal["measured", "second-hand", "vendor", "computed", "assumed"]
Image = Float32[np.ndarray, "h w"]
_Figures = dict[str, dict[str, tuple[Any, Grade, str]]]  # value, grade, source

FIGURES = read_table("tumortrack.simulation", "sensors.toml", _Figures)
_HOLE_PX = 2.0  # a hole's size over the length of the noise (assumed)


class SensorConfig(NoiseConfig, frozen=True, kw_only=True):
    """A camera; what it has of ``NoiseConfig`` comes first, its noise after that, its steps last.
    All px are its own, of an image ``native_px`` wide, and scaled to the simulated image.

    nearest_mm: nothing nearer is seen.
    focal_px, baseline_mm: of stereo. temporal_px, frozen_px: standard deviations of a disparity.
    temporal_mm, frozen_mm: further ones of a depth: polynomials of the depth in m, constant first.
    white_share: of the random variance, independent in each pixel; the rest, and all that is
        frozen, is correlated, with 1/e at temporal_length_px and frozen_length_px.
    step_px, step_mm: of stored disparities, of stored depths; 0: none.
    scale, offset_mm, warp_mm: largest bias of a unit: share of the depth, constant, slow over the
        image. A ``calibrated`` unit has none.
    fill, edge_slope, edge_power: a pixel is seen with probability fill / (1 + (g / edge_slope)^
        edge_power), g the depth's relative change per radian; edge_slope 0: fill.
    bridge_px: edges are smooth over so much, and reach so far beyond what ends.
    tissue: seen is tissue, which multiplies noise by tissue_noise, fills no more than tissue_fill,
        and is seen too deep by what each unit draws from tissue_mm.
    unit: the seed of what one camera has in all its frames.
    """

    native_px: int
    nearest_mm: float = 0.0
    focal_px: float = 0.0
    baseline_mm: float = 0.0
    temporal_px: float = 0.0
    frozen_px: float = 0.0
    temporal_mm: tuple[float, ...] = ()
    frozen_mm: tuple[float, ...] = ()
    white_share: float = 0.0
    temporal_length_px: float = 1.0
    frozen_length_px: float = 1.0
    step_px: float = 0.0
    step_mm: float = 0.0
    scale: float = 0.0
    warp_mm: float = 0.0
    offset_mm: float = 0.0
    fill: float = 1.0
    edge_slope: float = 0.0
    edge_power: float = 1.0
    bridge_px: float = 0.0
    tissue_noise: float = 1.0
    tissue_fill: float = 1.0
    tissue_mm: tuple[float, float] = (0.0, 0.0)
    tissue: bool = False
    calibrated: bool = True
    unit: int = 0

    def noise_mm(self, depth_mm: Any) -> tuple[Any, Any]:
        """Standard deviations at depths: of the random part, of the frozen one."""
        metres, fb = depth_mm / 1000, self.focal_px * self.baseline_mm or np.inf
        worse = self.tissue_noise if self.tissue else 1.0
        parts = (self.temporal_mm, self.temporal_px), (self.frozen_mm, self.frozen_px)
        temporal, frozen = (
            worse * (np.polyval(mm[::-1], metres) + px / fb * depth_mm**2) for mm, px in parts
        )
        return temporal, frozen

    @property
    def bias(self) -> tuple[float, float, float]:
        """The unit's: scale, offset and the largest slow error, mm; with the tissue's offset."""
        rng = np.random.default_rng([self.unit, 0])
        scale, offset, warp = rng.uniform(-1, 1, 3) * (not self.calibrated)
        deep_mm = rng.uniform(*self.tissue_mm) * self.tissue
        return scale * self.scale, offset * self.offset_mm + deep_mm, warp * self.warp_mm

    @property
    def depth_error(self) -> DepthError | None:
        return DepthError() if self.calibrated and not self.bias[1] else None

    def measured(self, frame: DepthFrame, seed: int) -> DepthFrame:
        shape, depth_mm = frame.depth_mm.shape, frame.depth_mm
        zoom = shape[1] / self.native_px
        if self.bridge_px:
            depth_mm = _bridged(depth_mm, self.bridge_px * zoom, self.edge_mm)
        first = {name: getattr(self, name) for name in NoiseConfig.__struct_fields__}
        edges = NoiseConfig(**{**first, "edge_px": max(1, round(self.edge_px * zoom))})
        out_mm = edges.measured(frame.with_depth(depth_mm), seed).depth_mm + self._bias(depth_mm)
        lengths = self.temporal_length_px * zoom, self.frozen_length_px * zoom
        temporal_mm, frozen_mm = self.noise_mm(depth_mm)
        random = math.sqrt(1 - self.white_share) * _smooth(shape, lengths[0], (seed, 2))
        if self.white_share:
            white = np.random.default_rng((seed, 3)).standard_normal(shape, np.float32)
            random += math.sqrt(self.white_share) * white
        out_mm += temporal_mm * random + frozen_mm * _frozen(shape, lengths[1], (self.unit, 1))
        fill = min(self.fill, self.tissue_fill) if self.tissue else self.fill
        if fill < 1 or self.edge_slope:
            out_mm[self._lost(frame, fill, _HOLE_PX * lengths[0], (seed, 4))] = np.nan
        fb = self.focal_px * self.baseline_mm
        with np.errstate(divide="ignore"):  # far off, the disparity is less than half a step
            if self.step_px:
                out_mm = fb / (np.rint(fb / out_mm / self.step_px) * self.step_px)
            if self.step_mm:
                out_mm = np.rint(out_mm / self.step_mm) * self.step_mm
        out_mm[~((out_mm >= max(self.nearest_mm, 1.0)) & np.isfinite(out_mm))] = np.nan
        return frame.with_depth(out_mm)

    def _bias(self, depth_mm: Image) -> Any:
        from tumortrack.core import depth_kernels as kernels

        scale, offset_mm, peak_mm = self.bias
        bias_mm = scale * depth_mm + offset_mm
        if peak_mm:
            rng = np.random.default_rng([self.unit, 5])
            field, factor = kernels.slow_shape(depth_mm.shape, peak_mm, rng)
            bias_mm += field * factor
        return bias_mm

    def _lost(
        self, frame: DepthFrame, fill: float, size_px: float, seed: tuple[int, int]
    ) -> np.ndarray:
        from scipy.special import ndtri

        chance: Any = fill
        if self.edge_slope:
            true_mm, camera = frame.depth_mm, frame.intrinsics
            beside = np.pad(true_mm, 1, constant_values=np.nan)
            left, right = beside[1:-1, :-2], beside[1:-1, 2:]
            above, below = beside[:-2, 1:-1], beside[2:, 1:-1]
            left, right, above, below = (
                np.where(np.isnan(side), true_mm, side) for side in (left, right, above, below)
            )
            slope = np.hypot(camera.fx * (right - left), camera.fy * (below - above)) / 2 / true_mm
            chance = fill / (1 + (slope / self.edge_slope) ** self.edge_power)
        return _smooth(frame.depth_mm.shape, size_px, seed) > ndtri(chance)


def _smooth(shape: tuple[int, int], length_px: float, seed: tuple[int, int]) -> Image:
    """Standard normal in each pixel, with Gaussian correlation: 1/e at ``length_px``."""
    from scipy.ndimage import gaussian_filter, gaussian_filter1d

    white = np.random.default_rng(seed).standard_normal(shape, np.float32)
    impulse = np.zeros(8 * int(length_px + 1) + 1)
    impulse[len(impulse) // 2] = 1
    kept = np.sum(gaussian_filter1d(impulse, length_px / 2) ** 2)  # of the variance, along an axis
    return gaussian_filter(white, length_px / 2, mode="wrap") / np.float32(kept)


_frozen = lru_cache(maxsize=4)(_smooth)


def _bridged(depth_mm: Image, reach_px: float, edge_mm: float) -> Image:
    """A depth image whose edges are ramps; where nothing lies behind one, the surface goes on."""
    from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

    known, size = np.isfinite(depth_mm), 2 * round(reach_px) + 1
    nearest = minimum_filter(np.where(known, depth_mm, np.inf), size)
    farthest = maximum_filter(np.where(known, depth_mm, -np.inf), size)
    total, weight = (
        gaussian_filter(values.astype(np.float32), reach_px / 2)
        for values in (np.where(known, depth_mm, 0), known)
    )
    edge = np.where(known, farthest - nearest > edge_mm, np.isfinite(nearest))
    return np.where(edge, total / np.maximum(weight, np.float32(1e-6)), depth_mm)


def simulated(
    name: str, *, unit: int = 0, uncalibrated: bool = False, tissue: bool = False
) -> NoiseConfig:
    """A camera by its name. Raises InputError: none has it, or the options are not for it."""
    plain: dict[str, NoiseConfig] = {str(key): noise for key, noise in SENSORS.items()}
    if name in plain:
        if uncalibrated or tissue:
            raise InputError(
                f"--sensor {name} has no units and no tissue. Leave --uncalibrated and --tissue "
                f"out, or choose one of {', '.join(FIGURES)}."
            )
        return plain[name]
    if name not in FIGURES:
        raise InputError(f"there is no sensor {name!r}; allowed: {', '.join([*plain, *FIGURES])}.")
    figures = {key: value for key, (value, _, _) in FIGURES[name].items()}
    options = {"unit": unit, "calibrated": not uncalibrated, "tissue": tissue}
    return msgspec.convert({**figures, **options}, SensorConfig)


def depth_error_of(stated: str | float) -> DepthError:
    """``--depth-error``: of a calibrated camera, mm; or a camera's kind, which nobody calibrated:
    its published bias, with what tissue adds. Raises InputError: it is neither."""
    if stated in FIGURES:
        camera = SensorConfig(**{key: value for key, (value, _, _) in FIGURES[str(stated)].items()})
        return DepthError(camera.offset_mm + camera.warp_mm + camera.tissue_mm[1], camera.scale)
    try:
        left_mm = float(stated)
    except ValueError:
        left_mm = -1.0
    if not 0 <= left_mm <= MOST_LEFT_MM:
        raise InputError(
            f"--depth-error {stated} is not understood. Allowed: 0 to {MOST_LEFT_MM:g} (mm that "
            f"the camera's calibration leaves), or a camera: {', '.join(FIGURES)}."
        )
    return DepthError(left_mm)
