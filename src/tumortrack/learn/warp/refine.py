"""Lay the organ's surface on the observed points: a few Gauss-Newton steps.

Unknown are a rigid motion and the coefficients of the body's modes. The most likely ones, given
points with errors and the library of states as a Gaussian prior, minimise

    n_effective / n * sum of rho(distance of a point, carried back to the CT, to the organ / sigma)
    + the squared Mahalanobis distance of the coefficients from the library's mean.

The distance is looked up in a field, so no nearest point is searched. The same curvature is the
estimate's uncertainty. Source: surface registration as maximum a posteriori with a statistical
shape prior, e.g. Heimann and Meinzer 2009 (doi 10.1016/j.media.2009.05.004); rho: Geman and
McClure 1987.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.config import Config
from tumortrack.learn.warp import kernels
from tumortrack.learn.warp.motion import WarpMotion
from tumortrack.learn.warp.shape import Shape
from tumortrack.learn.warp.sharing import share
from tumortrack.simulate.elastic.flow import steps_for

Placed = tuple[np.ndarray, np.ndarray, np.ndarray]  # rotation, centre_mm, coefficients

_AT_ONCE = 256  # points: a thread's part


class RefineConfig(Config, frozen=True):
    """``n_effective``: independent points that a cloud is worth: neighbours err alike.

    ``sigma_mm``: of a point that belongs to the organ, model errors included. ``first_mm`` and
    ``last_mm``: the distance where a point's pull is greatest falls from the one to the other;
    points far beyond do not count. ``shift_mm``, ``turn_rad``: how far the start may be off.
    """

    steps: int = 20
    n_effective: float = 300.0
    sigma_mm: float = 1.0
    first_mm: float = 5.0
    last_mm: float = 1.0
    narrowing: float = 0.7
    shift_mm: float = 20.0
    turn_rad: float = 0.5
    enough_mm: float = 0.02  # a step that moves less is the last


@dataclass(frozen=True, eq=False)
class Refined:
    """A motion, the squared error it minimises, and the distances left (signed, mm)."""

    motion: WarpMotion
    cost: float
    distances_mm: Float[np.ndarray, " n"]
    steps: int


def refine(
    shape: Shape,
    points_mm: Float[np.ndarray, "n 3"],
    start: WarpMotion,
    config: RefineConfig,
) -> Refined:
    """The motion near ``start`` that fits points (camera frame, mm) and the library best."""
    precision = _prior(shape, config)
    mean = shape.body.mean
    rotation, centre = start.rotation, start.centre_mm
    coefficients = start.coefficients.astype(float)
    moved = np.zeros(6)  # from the start: shift and turn
    weight = min(config.n_effective / len(points_mm), 1.0) / config.sigma_mm**2
    observed = np.ascontiguousarray(points_mm, np.float32)
    done = 0
    for step in range(config.steps + 1):
        width = max(config.last_mm, config.first_mm * config.narrowing**step)
        distance, normal = _normal(shape, observed, (rotation, centre, coefficients), width)
        curvature = weight * normal[:-1, :-1] + precision
        off = np.concatenate([moved, coefficients - mean])
        if step == config.steps or done:
            break
        change = -np.linalg.solve(curvature, weight * normal[:-1, -1] + precision @ off)
        centre = centre + rotation @ change[:3]
        rotation = rotation @ Rotation.from_rotvec(change[3:6]).as_matrix()
        coefficients = coefficients + change[6:]
        moved += change[:6]
        settled = np.abs(change).max() < config.enough_mm and width == config.last_mm
        done = step + 1 if settled else 0
    square = (distance / config.last_mm) ** 2
    fit = weight * config.last_mm**2 * float((square / (1 + square)).sum())
    motion = WarpMotion(shape, rotation, centre, coefficients, np.linalg.inv(curvature))
    return Refined(motion, fit + float(off @ precision @ off), distance, step)


def _prior(shape: Shape, config: RefineConfig) -> Float64[np.ndarray, "p p"]:
    modes = len(shape.body.mean)
    precision = np.zeros((6 + modes, 6 + modes))
    precision[:3, :3] = np.eye(3) / config.shift_mm**2
    precision[3:6, 3:6] = np.eye(3) / config.turn_rad**2
    precision[6:, 6:] = shape.body.precision
    return precision


def _normal(
    shape: Shape, points_mm: Float32[np.ndarray, "n 3"], placed: Placed, width_mm: float
) -> tuple[Float32[np.ndarray, " n"], Float64[np.ndarray, "columns columns"]]:
    """Signed distances of the points carried back, and the sum over points of the pull times a
    row times itself: a row has the distance's derivatives by shift, turn and coefficients, and
    then the distance."""
    known = _known(shape, *placed)
    columns = kernels.POSE + len(placed[2]) + 1
    distance = np.empty(len(points_mm), np.float32)
    sums = np.empty((-(-len(points_mm) // _AT_ONCE), columns, columns), np.float32)

    def add(part: slice) -> None:
        out = sums[part.start // _AT_ONCE]
        width = np.float32(width_mm)
        kernels.normal_equations(*known, width, points_mm[part], distance[part], out)

    share(add, len(points_mm), _AT_ONCE)
    return distance, sums.sum(0, dtype=float)


def _residuals(
    shape: Shape, points_mm: Float[np.ndarray, "n 3"], placed: Placed
) -> Float32[np.ndarray, "n columns"]:
    """The rows that ``_normal`` adds up."""
    known = _known(shape, *placed)
    rows = np.empty((len(points_mm), kernels.POSE + len(placed[2]) + 1), np.float32)
    kernels.residuals(*known, np.ascontiguousarray(points_mm, np.float32), rows)
    return rows


def _known(
    shape: Shape,
    rotation: Float64[np.ndarray, "3 3"],
    centre_mm: Float64[np.ndarray, " 3"],
    coefficients: Float64[np.ndarray, " m"],
) -> tuple[tuple, int, np.ndarray, tuple, tuple]:
    """What the kernels need besides points."""
    body, field = shape.body, shape.distances[0]
    velocity = body.velocity(-coefficients)
    return (
        (velocity, body.origin_mm, np.float32(body.spacing_mm)),
        steps_for(velocity, body.spacing_mm),
        body.modes,
        (body.center_ct, rotation, centre_mm),
        (field.values_mm, field.origin_mm, np.float32(field.spacing_mm)),
    )
