"""A stereo camera's errors, a model that shares no code with ``simulation.noise``: errors arise in
disparity and are correlated between near pixels and successive frames, rectification leaves some
distortion, and wet tissue gives highlights.

Depth is z = f b / d, so an error of e pixels of disparity moves it by z^2 e / (f b): growth with
distance squared. Constants and where they come from:

- ``subpixel_px`` 0.03 to 0.12: for a well calibrated camera 0.032 at best, 0.08 to be used (Intel's
  own, github.com/realsenseai/librealsense issue 3904); 0.12 for poor texture is an assumption.
- ``baseline_mm`` 18: D405 datasheet. Pixels are those of 848 x 480, at which cameras match.
- growth with the angle of view: 1 + 0.05 a^2 / (pi/2 - a)^2, the form and about the ratio measured
  by Nguyen, Izadi and Lovell 2012 (doi 10.1109/3DIMPVT.2012.84) on another triangulating sensor.
- ``bias_px`` 0.2 (one standard deviation of a whole image; half of it again as a slow variation):
  an assumption; at 200 mm it is 1 mm, within the D405's stated 1.4 % (2.8 mm) there (issue 15016).
- correlation over 4 pixels (a matching window), 0.7 of the variance standing still while the scene
  does, the rest fading by 0.5 a frame: assumptions.
- ``lens_px`` 0.5, residual distortion in the corner: an assumption, as large as calibrations allow.
- ``slant_px`` 0.03: bias by tan^2 of the angle, as a window averages over a slanted surface: an
  assumption, with either sign.
- ``edges``: a matching window sees what is nearer a pixel too wide, and beside it lies a band that
  one of both cameras alone sees: geometry.
- ``gloss_degrees`` 5: surfaces within this angle of mirroring the lamp have no texture, and three
  of four such pixels no return; the film of fluid tilts by 6 degrees: assumptions.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import gaussian_filter, map_coordinates, minimum_filter

from tumortrack.core.config import Config
from tumortrack.core.types import DepthError, DepthFrame, Intrinsics

_MATCHED_PX = 848  # width of the images that are matched
_FATTEN_MM = 5.0  # a step that a matching window sees as an edge
_STEEPEST_DEGREES = 82.0  # no return beyond
_SLOW_PX, _FILM_PX = 60.0, 5.0  # of the image: how far slow errors and ripples of fluid reach

Image = Float64[np.ndarray, "h w"]


class StereoConfig(Config, frozen=True, kw_only=True):
    """See the module. Zero switches a part off."""

    subpixel_px: float = 0.08
    baseline_mm: float = 18.0
    correlation_px: float = 4.0
    still_share: float = 0.7
    fading: float = 0.5
    bias_px: float = 0.2
    lens_px: float = 0.5
    slant_px: float = 0.03
    edges: bool = True
    gloss_degrees: float = 5.0
    film_degrees: float = 6.0
    gloss_share: float = 0.75
    quantum_mm: float = 0.1

    def depth_error(self, camera: Intrinsics, depth_mm: float) -> DepthError:
        """What a calibration of such a camera leaves at a depth: as wide as ``bias_px`` and its
        slow variation are there."""
        bias_px = 1.25**0.5 * self.bias_px
        focal_baseline = camera.fx * _MATCHED_PX / camera.width * self.baseline_mm
        return DepthError(round(3**0.5 * bias_px * depth_mm**2 / focal_baseline, 1))


class StereoCamera:
    """One camera before one scene; ``see`` simulates successive frames."""

    def __init__(self, camera: Intrinsics, config: StereoConfig, rng: np.random.Generator) -> None:
        self._camera, self._config, self._rng = camera, config, rng
        shape = camera.height, camera.width
        self._matched = _MATCHED_PX / camera.width  # pixels that were matched per pixel here
        self._focal_baseline = camera.fx * self._matched * config.baseline_mm
        smooth = config.correlation_px / self._matched
        self._smooth_px = smooth
        self._still, self._faded = (_field(shape, smooth, rng) for _ in range(2))
        slow = _field(shape, min(_SLOW_PX, camera.width / 4), rng) / 2
        self._bias_px = config.bias_px * (rng.normal() + slow)
        self._slant = config.slant_px * rng.uniform(-1, 1)
        self._lens = rng.uniform(-1, 1, 4)
        self._lamp = rng.normal(0, 60.0, 3) * [1, 1, 0]  # beside the camera, mm
        self._film = np.deg2rad(config.film_degrees) * np.stack(
            [_field(shape, _FILM_PX, rng) for _ in range(2)], axis=-1
        )

    def see(self, depth_mm: Float32[np.ndarray, "h w"], stamp_ns: int = 0) -> DepthFrame:
        """The measured frame for these true depths (NaN: nothing)."""
        config, rng = self._config, self._rng
        true = np.asarray(depth_mm, float)
        true = self._half_seen(_fattened(true)) if config.edges else true
        true = self._bent(true)
        normal, to_camera = _normals(true, self._camera)
        cosine = np.clip((normal * to_camera).sum(-1), 0.0, 1.0)
        angle = np.minimum(np.arccos(cosine), np.deg2rad(_STEEPEST_DEGREES))
        fresh = np.sqrt(1 - config.fading**2) * _field(true.shape, self._smooth_px, rng)
        self._faded = config.fading * self._faded + fresh
        still = config.still_share
        noise = np.sqrt(still) * self._still + np.sqrt(1 - still) * self._faded
        noise *= config.subpixel_px * (1 + 0.05 * angle**2 / (np.pi / 2 - angle) ** 2)
        noise += self._bias_px + self._slant * np.tan(np.minimum(angle, 1.2)) ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            out = self._focal_baseline / (self._focal_baseline / true + noise)
            out[np.arccos(cosine) > np.deg2rad(_STEEPEST_DEGREES)] = np.nan
        out[
            self._glossy(true, normal, to_camera) & (rng.random(out.shape) < config.gloss_share)
        ] = np.nan
        if config.quantum_mm > 0:
            out = np.round(out / config.quantum_mm) * config.quantum_mm
        out[~(out > 1.0)] = np.nan
        return DepthFrame(out.astype(np.float32), self._camera, stamp_ns)

    def _half_seen(self, true: Image) -> Image:
        """Without what the second camera, to the right, does not see behind a nearer object: a band
        along that object's left edge."""
        columns = np.arange(true.shape[1]) * self._matched
        there = np.nan_to_num(columns - self._focal_baseline / true, nan=np.inf)
        right = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
        hidden = there[:, :-1] > right[:, 1:] + 1.0
        return np.where(np.pad(hidden, ((0, 0), (0, 1))), np.nan, true)

    def _bent(self, true: Image) -> Image:
        """The image with the residual distortion of the lenses."""
        if self._config.lens_px == 0:
            return true
        height, width = true.shape
        v, u = np.indices(true.shape).astype(float)
        half = width / 2
        x, y = (u - width / 2) / half, (v - height / 2) / half
        k1, k2, p1, p2 = self._lens * self._config.lens_px / self._matched
        r2 = x * x + y * y
        du = x * (k1 * r2 + k2 * r2 * r2) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dv = y * (k1 * r2 + k2 * r2 * r2) + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        bent = map_coordinates(
            1 / np.nan_to_num(true, nan=np.inf), (v + dv, u + du), order=1, mode="nearest"
        )
        with np.errstate(divide="ignore"):
            out = 1 / bent
        nearest = map_coordinates(true, (v + dv, u + du), order=0, mode="nearest")
        return np.where(np.isfinite(nearest) & np.isfinite(out), out, np.nan)

    def _glossy(self, true: Image, normal: np.ndarray, to_camera: np.ndarray) -> np.ndarray:
        """Where the surface mirrors the lamp into the camera."""
        if self._config.gloss_degrees == 0:
            return np.zeros(true.shape, bool)
        to_lamp = self._lamp - points_of(true, self._camera)
        to_lamp /= np.linalg.norm(to_lamp, axis=-1, keepdims=True)
        half = to_camera + to_lamp
        half /= np.linalg.norm(half, axis=-1, keepdims=True)
        wet = normal.copy()
        wet[..., :2] += self._film
        wet /= np.linalg.norm(wet, axis=-1, keepdims=True)
        return (wet * half).sum(-1) > np.cos(np.deg2rad(self._config.gloss_degrees))


def _field(shape: tuple[int, int], reach_px: float, rng: np.random.Generator) -> Image:
    """Gaussian noise of variance 1 whose correlation falls as exp(-(d / 2 reach)^2)."""
    if reach_px < 0.3:
        return rng.normal(size=shape)
    field = gaussian_filter(rng.normal(size=shape), reach_px, mode="wrap")
    impulse = np.zeros(shape)
    impulse[0, 0] = 1.0
    return field / np.linalg.norm(gaussian_filter(impulse, reach_px, mode="wrap"))


def _fattened(true: Image) -> Image:
    """Near objects grow by a pixel: a matching window that contains their edge matches there."""
    near = minimum_filter(np.nan_to_num(true, nan=np.inf), 3)
    with np.errstate(invalid="ignore"):
        wins = ~(true - near < _FATTEN_MM) & np.isfinite(near)
    return np.where(wins, near, true)


def points_of(depth_mm: Image, camera: Intrinsics) -> Float64[np.ndarray, "h w 3"]:
    v, u = np.indices(depth_mm.shape)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([x * depth_mm, y * depth_mm, depth_mm], axis=-1)


def _normals(depth_mm: Image, camera: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals towards the camera, and unit vectors to it; a plane's where nothing is seen."""
    points = points_of(depth_mm, camera)
    to_camera = -points / np.linalg.norm(points, axis=-1, keepdims=True)
    normal = np.cross(_slope(points, 0), _slope(points, 1))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    bad = ~np.isfinite(normal).all(-1)
    normal[bad] = to_camera[bad]
    to_camera = np.nan_to_num(to_camera)
    return np.nan_to_num(normal), to_camera


def _slope(points: np.ndarray, axis: int) -> np.ndarray:
    """Differences to a neighbour along an axis, to the one that is nearer in depth: at an edge the
    surface ends, but does not turn."""
    step = np.diff(points, axis=axis)
    first, last = ((0, 1), (0, 0), (0, 0)), ((1, 0), (0, 0), (0, 0))
    pads = [np.roll(np.array(pad), axis, axis=0) for pad in (first, last)]
    after, before = (np.pad(step, pad, mode="edge") for pad in pads)
    jump = [np.nan_to_num(np.abs(way[..., 2:]), nan=np.inf) for way in (after, before)]
    return np.where(jump[0] <= jump[1], after, before)
