"""The elastic library's model error: a smooth displacement beside it, estimated in each frame.

Spatially correlated residuals are model error, not noise: no state of the library displaces the
organ as it is displaced there. A place is therefore taken to lie where pose and state put it, plus
a Gaussian process: three independent components of one amplitude, correlated over ``LENGTH_MM``.
Amplitude and noise of a frame are those under which its residuals are most likely. Given the
residuals, the process is Gaussian in closed form: certain where the surface is seen, as uncertain
as the amplitude far from it; and pose and state are the less certain the more of the residuals may
be discrepancy. Source: Kennedy and O'Hagan 2001 (doi 10.1111/1467-9868.00294).

Only the covariance is used. The process's mean, added to the motion, moved tumors away from their
true places in training's scenes (0.5 to 0.6 mm on average, across the line of sight), and changed
little in others (with a drag 0.9 and 0.9 mm, in the twin's 0.55 to 0.5 mm, its median upwards).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from tumortrack.core.mesh_kernels import farthest
from tumortrack.registration import kernels

# 15 and 30 mm rank and cover the errors of training's and the twin's scenes equally well.
LENGTH_MM = 20.0
_GROUPS = 64  # of neighbouring points, some 8 mm apart; 128 see discrepancy where there is none
# Values that are tried. The distance field itself errs by more than the least; residuals of several
# millimetres are those of points that do not belong to the organ.
AMPLITUDES_MM = np.array([0.0, 0.15, 0.3, 0.6, 1.2, 2.4, 4.8])
NOISES_MM = np.array([0.15, 0.3, 0.6, 1.2, 2.4])  # of one point
FARTHEST = 2.0  # widths of the robust kernel: what lies beyond weighs less than 1/25
_ROUNDING_MM2 = 1e-4


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """The process, given groups of residuals.

    Attributes:
        places_ct, normals: of the groups, organ at rest (CT frame, mm).
        amplitude_mm: one standard deviation along any axis, before anything is seen; ``noise_mm``:
            of one point.
        precision: of the residuals; ``cross``: the unknowns' covariance with them, times that.
    """

    places_ct: Float64[np.ndarray, "m 3"]
    normals: Float64[np.ndarray, "m 3"]
    amplitude_mm: float
    noise_mm: float
    precision: Float64[np.ndarray, "m m"]
    cross: Float64[np.ndarray, "p m"]

    def widened(
        self,
        effects: Float64[np.ndarray, "n 3 p"],
        covariance: Float64[np.ndarray, "p p"],
        points_ct: Float32[np.ndarray, "n 3"],
    ) -> Float64[np.ndarray, "n 3 3"]:
        """The covariance of points (organ's axes, mm^2), on which the unknowns have these effects,
        with the process."""
        if self.amplitude_mm == 0:
            return products(effects, covariance)
        square = self.amplitude_mm**2
        near = square * _alike(points_ct, self.places_ct)
        both = np.concatenate([effects, near[:, None] * self.normals.T], axis=2)
        joint = np.block([[covariance, self.cross], [self.cross.T, -self.precision]])
        return products(both, joint) + square * np.eye(3)


def products(
    rows: Float64[np.ndarray, "n 3 p"], middle: Float64[np.ndarray, "p p"]
) -> Float64[np.ndarray, "n 3 3"]:
    """``row @ middle @ row.T`` of each."""
    return (rows.reshape(-1, len(middle)) @ middle).reshape(rows.shape) @ rows.transpose(0, 2, 1)


def fit_discrepancy(
    rows: Float64[np.ndarray, "n q"],
    rest_ct: Float64[np.ndarray, "n 3"],
    prior: Float64[np.ndarray, "p p"],
    off: Float64[np.ndarray, " p"],
    width_mm: float,
) -> tuple[Float64[np.ndarray, "p p"], Discrepancy]:
    """The covariance of the unknowns, and the process, from residuals.

    Args:
        rows: what each unknown does to the signed distance of a point to the surface, and that
            distance (mm) last; ``rest_ct``: where the points lie, carried back.
        prior: covariance of the unknowns; ``off``: from the fit to its mean.
        width_mm: of the robust kernel.
    """
    distances = np.abs(rows[:, -1])
    least = min(_GROUPS, len(distances))
    nearest_mm = np.partition(distances, least - 1)[least - 1]
    kept = distances <= max(FARTHEST * width_mm, nearest_mm)
    rows, rest_ct = rows[kept], rest_ct[kept]
    weights = 1 / (1 + (rows[:, -1] / width_mm) ** 2) ** 2
    group = _grouped(rest_ct)
    shares = (group == np.arange(group.max() + 1)[:, None]) * weights
    shares /= shares.sum(1, keepdims=True)
    per_noise = (shares**2).sum(1)  # variance of a group's mean, of one point's
    places_ct, means = shares @ rest_ct, shares @ rows
    slopes, normals = means[:, :-1], -means[:, :3]
    spread = prior @ slopes.T
    explained = slopes @ spread + _ROUNDING_MM2 * np.eye(len(places_ct))
    alike = _alike(places_ct, places_ct) * (normals @ normals.T)
    residuals = means[:, -1] + slopes @ off
    tried = AMPLITUDES_MM, NOISES_MM
    amplitude, noise = kernels.most_likely(explained, alike, per_noise, residuals, tried)
    explained += amplitude**2 * alike + np.diag(noise**2 * per_noise)
    precision = np.linalg.inv(explained)
    cross = spread @ precision
    left = prior - cross @ spread.T
    process = Discrepancy(places_ct, normals, amplitude, noise, precision, cross)
    return (left + left.T) / 2, process


def _grouped(points_ct: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """The number of each point's group: of the nearest of some that lie far apart."""
    points = np.ascontiguousarray(points_ct.T[None], np.float32)
    away = points[0] - points[0].mean(axis=1, keepdims=True)
    first = np.array([(away**2).sum(axis=0).argmax()])
    chosen = np.empty((1, min(_GROUPS, len(points_ct))), np.int64)
    farthest(points, first, chosen)
    chosen = chosen[0]
    nearest = _squares_mm2(points_ct, points_ct[chosen]).argmin(axis=1)
    return np.unique(nearest, return_inverse=True)[1]  # where points coincide some have none


def _alike(
    a: Float32[np.ndarray, "n 3"] | Float64[np.ndarray, "n 3"], b: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, "n m"]:
    """The process's correlation between places."""
    return np.exp(_squares_mm2(a, b) / (-2 * LENGTH_MM**2))


def _squares_mm2(
    a: Float32[np.ndarray, "n 3"] | Float64[np.ndarray, "n 3"], b: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, "n m"]:
    """Of the distances of each to each."""
    x, y, z = (np.subtract.outer(a[:, axis].astype(float), b[:, axis]) for axis in range(3))
    return x * x + y * y + z * z
