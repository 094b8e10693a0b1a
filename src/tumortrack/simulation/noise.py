"""Sensor errors of a stereo depth camera, each switchable (zero = off): noise and calibration.

Order as in the sensor: the matcher errs at edges (flying pixels) and everywhere (noise growing
with z^2, slow distortion), fails in places (holes), invents some matches (scattered points), and
the result is stored in whole units. Stereo endoscopes have two errors more: the nearer surface
spreads over edges, and what only one camera sees has no match.

Axial noise: a disparity error of s pixels is a depth error of z^2 s / (f b). For a D405 at
848 x 480 (f = 447 px, baseline b = 18 mm) and the s = 0.08 that RealSense's engineers advise (0.032
at best; github.com/realsenseai/librealsense issue 3904) this is 0.22 mm (0.09 mm) at 150 mm.
Neighbouring pixels share most of a matching window, so their errors are correlated.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from tumortrack.core.camera import pinhole_of
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthError, DepthFrame

if TYPE_CHECKING:
    from tumortrack.core.depth_kernels import Seen

_NO_RETURN_MM = np.float32(1e6)
REFERENCE_MM = 150.0  # the distance for which ``axial_mm`` is stated


class CalibrationConfig(Config, frozen=True, kw_only=True):
    """Largest calibration errors of a camera, as stereo cameras drift with temperature and shocks;
    zero switches one off. Each frame draws its own, uniformly to either side and the same for all
    pixels. ``offset_mm`` is added to every depth, ``scale`` is a share of the depth."""

    offset_mm: float = 0.0
    scale: float = 0.0

    def __post_init__(self) -> None:
        self.check_ranges("calibration", offset_mm=20.0, scale=0.2)

    @property
    def depth_error(self) -> DepthError:
        return DepthError(self.offset_mm, self.scale)


CALIBRATED = CalibrationConfig()

# Standard deviations of a camera's place relative to another's, along and about each axis:
# calibrations with 3D cameras err by about 0.9 mm and 0.27 degrees (arXiv 2311.01335).
CAMERA_STD = np.array([1.0] * 3 + [0.01] * 3)  # mm at the organ, rad


def miscalibrate(
    frame: DepthFrame, config: CalibrationConfig, rng: np.random.Generator
) -> DepthFrame:
    """The frame as a miscalibrated camera would measure it; ``rng`` does not advance."""
    if config == CALIBRATED:
        return frame
    offset, scale = rng.spawn(1)[0].uniform(-1, 1, 2)
    factor = np.float32(1 + scale * config.scale)
    return frame.with_depth(frame.depth_mm * factor + np.float32(offset * config.offset_mm))


class NoiseConfig(Config, frozen=True, kw_only=True):
    """Strength of each part; zero switches it off.

    axial_mm: standard deviation at 150 mm; grows with z^2.
    correlated_share: share of that variance that is common to neighbours within correlation_px.
    flying_share: share of edge pixels that end up anywhere between the edge and what lies behind
        it, at most ``flying_mm`` behind.
    edge_px, edge_mm: at an edge, depth grows by edge_mm or ends within edge_px.
    hole_share: share of pixels lost in random blobs about ``hole_px`` wide.
    grazing_share: share lost where the surface is turned away by over ``grazing_degrees``.
    distortion_mm: largest slow depth error; each frame's peak is uniform in 0..distortion_mm.
    scatter_share: false points per true one, in pixels without return, at depths uniform over the
        true ones and ``scatter_mm`` to either side.
    quantum_mm: depth unit of the sensor.
    fatten_px: how far the nearer surface spreads over what lies ``edge_mm`` or more behind an edge:
        standard deviation of a half-normal distribution, correlated over about ``hole_px``.
    shadow_px_mm: focal length times baseline; what the right camera does not see is lost.
    """

    axial_mm: float = 0.0
    correlated_share: float = 0.0
    correlation_px: int = 5
    flying_share: float = 0.0
    flying_mm: float = 10.0
    edge_px: int = 2
    edge_mm: float = 3.0
    hole_share: float = 0.0
    hole_px: int = 8
    grazing_share: float = 0.0
    grazing_degrees: float = 75.0
    distortion_mm: float = 0.0
    scatter_share: float = 0.0
    scatter_mm: float = 10.0
    quantum_mm: float = 0.0
    fatten_px: float = 0.0
    shadow_px_mm: float = 0.0

    def __post_init__(self) -> None:
        for name in NoiseConfig.__struct_fields__:
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise InputError(f"noise {name} is {value}; it must be 0 (off) or positive.")
            if name.endswith("_share") and value > 1:
                raise InputError(f"noise {name} is {value}; a share lies in 0..1.")
            if name in ("correlation_px", "edge_px", "hole_px") and value < 1:
                raise InputError(f"noise {name} is {value}; at least 1 pixel is needed.")
        if not self.grazing_degrees < 90:
            raise InputError(f"noise grazing_degrees is {self.grazing_degrees}; it must be < 90.")

    @property
    def nearest_mm(self) -> float:
        """Nothing nearer is seen."""
        return 0.0

    @property
    def depth_error(self) -> DepthError | None:
        """Beside noise; None: the camera is not calibrated."""
        return DepthError()

    def measured(self, frame: DepthFrame, seed: int) -> DepthFrame:
        """The frame with these errors; each part hashes its own stream from the seed."""
        return _measured(frame, self, seed)


CLEAN = NoiseConfig()

D405_NOISE = NoiseConfig(
    axial_mm=0.2,
    correlated_share=0.5,
    flying_share=0.3,
    hole_share=0.02,
    grazing_share=0.5,
    distortion_mm=1.0,
    scatter_share=0.005,
    quantum_mm=0.1,
)


def stereo_noise(focal_px: float, baseline_mm: float, disparity_px: float = 0.3) -> NoiseConfig:
    """Noise of semi-global matching with an endoscope's ``focal_px`` and ``baseline_mm``;
    ``disparity_px``: standard deviation of its matches (docs/method.md). Lengths in pixels are
    for images 424 wide, as in training."""
    return NoiseConfig(
        axial_mm=REFERENCE_MM**2 * disparity_px / (focal_px * baseline_mm),
        correlated_share=0.95,
        hole_share=0.02,
        grazing_share=0.5,
        distortion_mm=1.0,
        fatten_px=2.0,
        shadow_px_mm=220 * baseline_mm,
    )


# Lenses and baseline as of a surgical robot's endoscope at 1280 x 1024.
STEREO_NOISE = stereo_noise(1040.0, 4.4)

Sensor = Literal["d405", "stereo"]
SENSORS: dict[Sensor, NoiseConfig] = {"d405": D405_NOISE, "stereo": STEREO_NOISE}


def add_noise(frame: DepthFrame, config: NoiseConfig, rng: np.random.Generator) -> DepthFrame:
    """The frame as a noisy sensor would have measured it.

    Whatever is on, one number is drawn from ``rng``, and each part hashes its own stream from it:
    switching one part off does not change the others' random numbers.
    """
    seed = int(rng.integers(2**62))
    if config == CLEAN:
        return frame
    return config.measured(frame, seed)


def _measured(frame: DepthFrame, config: NoiseConfig, seed: int) -> DepthFrame:
    from tumortrack.core.depth_kernels import seen_pixels

    if config.fatten_px or config.shadow_px_mm:
        frame = frame.with_depth(_matched(frame.depth_mm, config, seed + 6))
    true_mm = frame.depth_mm
    seen = seen_pixels(true_mm)
    depths_mm = true_mm.ravel()[seen.pixels]
    scatter = _scatter(true_mm.size, seen.pixels, depths_mm, config, seed)
    _disturb(frame, depths_mm, seen, config, seed)
    out_mm = np.full(true_mm.shape, np.nan, np.float32)
    quantum_mm = np.float32(config.quantum_mm)
    for pixels, values_mm in ((seen.pixels, depths_mm), scatter):
        if quantum_mm:
            values_mm /= quantum_mm
            np.rint(values_mm, out=values_mm)
            values_mm *= quantum_mm
        out_mm.ravel()[pixels] = values_mm
    return frame.with_depth(out_mm)


def _matched(true_mm: np.ndarray, config: NoiseConfig, seed: int) -> np.ndarray:
    """Depths where both cameras see the surface; those of nearer surfaces spread over edges."""
    from scipy.ndimage import minimum_filter

    from tumortrack.core import depth_kernels as kernels

    out_mm = true_mm.copy()
    disparity_px = config.shadow_px_mm / np.nan_to_num(true_mm, nan=float(_NO_RETURN_MM))
    lost = disparity_px > np.arange(true_mm.shape[1])  # outside the right image
    for k in range(1, int(disparity_px.max()) + 1):  # hidden by a surface k pixels to the right
        lost[:, :-k] |= disparity_px[:, k:] - disparity_px[:, :-k] > k + 0.5
    out_mm[lost] = np.nan
    if not config.fatten_px:
        return out_mm
    every_pixel = kernels.seen_pixels(np.zeros(true_mm.shape, np.float32))
    smooth = kernels.smooth_at(every_pixel, true_mm.shape, config.hole_px, seed)
    wide_px = config.fatten_px * np.abs(smooth.reshape(true_mm.shape))
    depth_mm = np.nan_to_num(true_mm, nan=float(_NO_RETURN_MM))
    near_mm = minimum_filter(depth_mm, 3)
    # Only from jumps: on a slope, too, some neighbours are nearer.
    near_mm[depth_mm - near_mm < config.edge_mm] = _NO_RETURN_MM
    for step in range(1, int(wide_px.max() + 0.5) + 1):
        fat = (near_mm < depth_mm - config.edge_mm) & (wide_px > step - 0.5)
        out_mm[fat] = np.fmin(out_mm, near_mm)[fat]
        near_mm = minimum_filter(near_mm, 3)
    return out_mm


def _disturb(
    frame: DepthFrame, depths_mm: np.ndarray, seen: Seen, config: NoiseConfig, seed: int
) -> None:
    """Add edge effects, slow distortion, noise and holes to the seen depths, in place."""
    from scipy.special import ndtri

    from tumortrack.core import depth_kernels as kernels

    true_mm, shape = np.ascontiguousarray(frame.depth_mm), frame.depth_mm.shape
    if config.flying_share:
        flying = config.flying_share, config.flying_mm, config.edge_px, config.edge_mm
        kernels.fly(true_mm, depths_mm, seen, seed + 1, flying)
    if config.grazing_share:
        pinhole = pinhole_of(frame.intrinsics)
        cosine = math.cos(math.radians(config.grazing_degrees))
        across = ((np.arange(shape[1]) - pinhole.cx) / pinhole.fx) ** 2
        lost = seed + 2, config.grazing_share, cosine
        kernels.lose_grazing(true_mm, depths_mm, seen, *lost, pinhole, across)
    if config.distortion_mm:
        rng = np.random.default_rng((seed, 1))
        field, scale = kernels.slow_shape(shape, config.distortion_mm * rng.random(), rng)
        depths_mm += field.ravel()[seen.pixels] * scale
    if config.axial_mm:
        relative = config.axial_mm / REFERENCE_MM**2
        smooth = kernels.smooth_at(seen, shape, config.correlation_px, seed + 3)
        kernels.jitter(depths_mm, seen, seed + 4, relative, config.correlated_share, smooth)
    if config.hole_share:
        smooth = kernels.smooth_at(seen, shape, config.hole_px, seed + 5)
        depths_mm[smooth < ndtri(config.hole_share)] = np.nan


def _scatter(
    size: int, seen: np.ndarray, depths_mm: np.ndarray, config: NoiseConfig, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (flat indices of an image of ``size``) that get a false point, and its depth."""
    rng = np.random.default_rng((seed, 0))
    n_empty = size - len(seen)
    count = rng.poisson(config.scatter_share * len(seen)) if config.scatter_share else 0
    if not n_empty or not count:
        return seen[:0], depths_mm[:0]
    number = rng.integers(n_empty, size=count)
    # The k-th empty pixel comes after all seen ones with at most k empty ones before them.
    pixels = number + np.searchsorted(seen - np.arange(len(seen)), number, side="right")
    near_mm = max(depths_mm.min() - config.scatter_mm, 1.0)
    values_mm = rng.uniform(near_mm, depths_mm.max() + config.scatter_mm, count)
    return pixels, values_mm.astype(np.float32)
