"""Sensor noise of a stereo depth camera, each part switchable (zero = off).

Order as in the sensor: the matcher errs at edges (flying pixels) and everywhere (noise growing
with z^2, slow distortion), fails in places (holes), invents some matches (scattered points), and
the result is stored in whole units.

Axial noise: the error of a disparity of s pixels is z^2 s / (f b). For a D405 at 848 x 480
(f = 447 px, baseline b = 18 mm) and the s = 0.08 that RealSense's engineers advise (0.032 at best;
github.com/realsenseai/librealsense issue 3904) this is 0.22 mm (0.09 mm) at 150 mm. Correlation:
one matching window spans several pixels, so near pixels err together.
"""

from __future__ import annotations

import numpy as np

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame

REFERENCE_MM = 150.0  # the distance at which ``axial_mm`` is stated


class NoiseConfig(Config, frozen=True, kw_only=True):
    """Strength of each part; zero switches it off.

    axial_mm: standard deviation at 150 mm; grows with z^2.
    correlated_share: share of that variance that neighbouring pixels have in common, 0..1.
    correlation_px: the distance over which they do.
    flying_share: share of edge pixels that fly; they end up anywhere between the edge and what
        lies behind it, at most ``flying_mm`` behind.
    edge_px, edge_mm: a pixel is at an edge where, so near, depth falls back by so much or ends.
    hole_share: share of pixels lost in random blobs about ``hole_px`` wide.
    grazing_share: share lost where the surface is turned away by over ``grazing_degrees``.
    distortion_mm: largest slow depth error; each frame's peak is uniform in 0..distortion_mm.
    scatter_share: false points per true one, in pixels without return; their depths are uniform
        from the nearest true depth to the farthest, and ``scatter_mm`` to either side.
    quantum_mm: depth unit of the sensor.
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

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise InputError(f"noise {name} is {value}; it must be 0 (off) or positive.")
            if name.endswith("_share") and value > 1:
                raise InputError(f"noise {name} is {value}; a share lies in 0..1.")
            if name.endswith("_px") and value < 1:
                raise InputError(f"noise {name} is {value}; at least 1 pixel is needed.")
        if not self.grazing_degrees < 90:
            raise InputError(f"noise grazing_degrees is {self.grazing_degrees}; it must be < 90.")


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


def add_noise(frame: DepthFrame, config: NoiseConfig, rng: np.random.Generator) -> DepthFrame:
    """The frame as a noisy sensor would have seen it; the frame itself if all parts are off.

    One number is drawn from ``rng``, whatever is on; each part hashes its own stream from it.
    So the same generator gives the same frame bit for bit, and switching one part off leaves
    the random numbers of the others as they were.
    """
    seed = int(rng.integers(2**62))
    if config == CLEAN:
        return frame
    out_mm = frame.depth_mm.copy()
    _err_at_edges(frame, out_mm, config, seed)
    _err_everywhere(out_mm, config, seed)
    if config.scatter_share:
        _scatter(frame.depth_mm, out_mm, config, np.random.default_rng((seed, 0)))
    if config.quantum_mm:
        out_mm /= np.float32(config.quantum_mm)
        np.rint(out_mm, out=out_mm)
        out_mm *= np.float32(config.quantum_mm)
    return DepthFrame(out_mm, frame.intrinsics, frame.stamp_ns)


def _err_at_edges(frame: DepthFrame, out_mm: np.ndarray, config: NoiseConfig, seed: int) -> None:
    from tumortrack.sense import noise_kernels as kernels

    true_mm = frame.depth_mm
    if config.flying_share:
        edge = (config.edge_px, config.edge_mm)
        kernels.fly(true_mm, out_mm, seed + 1, config.flying_share, config.flying_mm, edge)
    if config.grazing_share:
        pinhole = kernels.pinhole(frame.intrinsics)
        kernels.lose_grazing(
            true_mm, out_mm, seed + 2, config.grazing_share, config.grazing_degrees, pinhole
        )


def _err_everywhere(out_mm: np.ndarray, config: NoiseConfig, seed: int) -> None:
    from scipy.special import ndtri

    from tumortrack.sense import noise_kernels as kernels

    height, width = out_mm.shape
    if config.distortion_mm:
        rng = np.random.default_rng((seed, 1))
        out_mm += kernels.slow_field((height, width), config.distortion_mm * rng.random(), rng)
    if config.axial_mm:
        relative = config.axial_mm / REFERENCE_MM**2
        grid = kernels.normal_grid(height, width, config.correlation_px, seed + 3)
        kernels.jitter(
            out_mm, seed + 4, relative, config.correlated_share, grid, config.correlation_px
        )
    if config.hole_share:
        grid = kernels.normal_grid(height, width, config.hole_px, seed + 5)
        kernels.lose_blobs(out_mm, ndtri(config.hole_share), grid, config.hole_px)


def _scatter(
    true_mm: np.ndarray, out_mm: np.ndarray, config: NoiseConfig, rng: np.random.Generator
) -> None:
    empty = np.flatnonzero(np.isnan(true_mm))
    count = rng.poisson(config.scatter_share * (true_mm.size - len(empty)))
    if len(empty) and count:
        pixels = empty[rng.integers(len(empty), size=count)]
        near_mm = max(np.nanmin(true_mm) - config.scatter_mm, 1.0)
        out_mm.flat[pixels] = rng.uniform(near_mm, np.nanmax(true_mm) + config.scatter_mm, count)
