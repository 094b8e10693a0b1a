"""Depth image -> sensor cloud, for simulated and real images alike; checks of clouds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from tumortrack.core.camera import deproject_pixels
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.report import Cause, Finding, Likely
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.core.units import Unit, unit_advice

FEWEST_POINTS = 200  # fewer do not determine an organ's shape and pose
_FARTHEST_MM = 20_000.0  # beyond any depth camera
_NEAREST_MM = 40.0  # minimum range of a D405, the shortest of all depth cameras
# mm per step: the D405's; other depth cameras'; whole mm; floats in metres.
_DEPTH_UNITS_MM = (0.1, 0.125, 0.25, 1.0, 1000.0)
_MOST_FAR = 0.01  # share of a cloud's points that may be outliers
_LONGEST_M = 0.6  # longest organ in metres; in inches no organ's side is shorter
# Least standard deviation along the second axis: in mm, and over that along the first. An organ has
# over 10 mm and half of the first.
_THINNEST_MM, _THINNEST = 1.0, 0.1
_LEAST_FAR_MM = 5.0  # no camera sees so near


class CloudConfig(Config, frozen=True, kw_only=True):
    """Depths strictly between near and far (mm) become the cloud. The defaults are the paper's."""

    near_mm: float = 110.0
    far_mm: float = 150.0
    n_points: int = 1000

    def __post_init__(self) -> None:
        _check_range(self.near_mm, self.far_mm)
        if self.n_points < FEWEST_POINTS:
            raise InputError(f"n_points is {self.n_points}; at least {FEWEST_POINTS} are needed.")


def cloud_from_depth(
    frame: DepthFrame, config: CloudConfig, rng: np.random.Generator
) -> SensorCloud:
    """Crop by depth, draw ``n_points`` distinct random pixels (all if fewer lie in range), and
    deproject them. Raises NoEstimate: fewer than 200 pixels lie in range."""
    depth_mm = frame.depth_mm.ravel()
    index = np.flatnonzero((depth_mm > config.near_mm) & (depth_mm < config.far_mm))
    if len(index) < FEWEST_POINTS:
        raise _too_few(len(index), frame, config.near_mm, config.far_mm)
    chosen = rng.choice(index, min(len(index), config.n_points), replace=False)
    points_mm = deproject_pixels(chosen, depth_mm[chosen].astype(np.float64), frame.intrinsics)
    return SensorCloud(points_mm, frame.stamp_ns, depth_error=frame.depth_error)


def thin_cloud(cloud: SensorCloud, n_points: int, rng: np.random.Generator) -> SensorCloud:
    """``n_points`` distinct random points of the cloud (all of them if it has no more)."""
    count = len(cloud.points_mm)
    chosen = rng.choice(count, min(count, n_points), replace=False)
    return _points_of(cloud, chosen)


def crop_cloud(cloud: SensorCloud, near_mm: float, far_mm: float) -> SensorCloud:
    """The points with near_mm < z < far_mm, in their order. Raises InputError: not
    0 <= near < far; NoEstimate: fewer than 200 points lie in range."""
    _check_range(near_mm, far_mm)
    z = cloud.points_mm[:, 2]
    inside = (z > near_mm) & (z < far_mm)
    if inside.sum() < FEWEST_POINTS:
        raise _too_few(int(inside.sum()), cloud, near_mm, far_mm)
    return _points_of(cloud, inside)


def _points_of(cloud: SensorCloud, chosen: np.ndarray) -> SensorCloud:
    points_mm = cloud.points_mm[chosen]
    return SensorCloud(points_mm, cloud.stamp_ns, depth_error=cloud.depth_error)


def seen_points(
    points_mm: Float32[np.ndarray, "n 3"], name: str
) -> tuple[Float32[np.ndarray, "m 3"], tuple[str, ...]]:
    """The points that a camera can have measured, and notes on what was dropped: points without
    return (NaN, infinite, or exactly 0, 0, 0, as in RealSense's and organised clouds), and up to
    1 % beyond 20 m. Raises InputError, which names the cloud, if more lie beyond."""
    # The largest float: what some cameras write for no return.
    returned = (np.abs(points_mm) < np.finfo(np.float32).max).all(axis=1)
    returned &= (points_mm != 0).any(axis=1)
    near = np.abs(points_mm).max(axis=1, initial=0) <= _FARTHEST_MM
    missing, far = len(points_mm) - int(returned.sum()), int((returned & ~near).sum())
    if far > _MOST_FAR * returned.sum():
        raise InputError(
            f"{name}: {far} of {len(points_mm)} points lie more than 20 m away: it looks like "
            "millimetres read as metres (leave out --unit m), or damaged."
        )
    dropped = {"without return (NaN or 0, 0, 0)": missing, "more than 20 m away": far}
    kept = points_mm if not missing + far else points_mm[returned & near]
    return kept, tuple(
        f"dropped {count} of {len(points_mm)} points {kind}"
        for kind, count in dropped.items()
        if count
    )


def check_cloud(cloud: SensorCloud, fewest: int = FEWEST_POINTS) -> None:
    """Refuse a cloud that cannot show an organ in front of the camera, in mm. Raises InputError:
    the unit is evidently not mm, or a point lies more than 20 m away; NoEstimate: fewer than so
    many distinct points, all on one line, or none before the camera."""
    points_mm = cloud.points_mm
    ordered = np.sort(points_mm.T, axis=1)
    distinct = 1 + int(np.count_nonzero(np.diff(ordered[0])))  # cheap, and mostly enough
    for some in (points_mm[:2000], points_mm):  # sorting all of a large cloud takes a while
        if distinct < fewest:
            distinct = len(np.unique(some, axis=0))
    if distinct < fewest:
        raise NoEstimate(Finding("sparse", {"points": distinct, "fewest": fewest}))
    few = len(points_mm) // 100
    low, middle, high = ordered[:, [few, len(points_mm) // 2, -1 - few]].T
    extent_mm = float((high - low).max())
    # A D405 measures nothing nearer than 40 mm, and an organ is larger than 5 mm.
    if abs(middle[2]) < 5 and extent_mm < 5:
        unit = Unit.METRE if extent_mm < _LONGEST_M else Unit.INCH
        raise InputError(
            f"the cloud is {extent_mm:.3g} wide and {middle[2]:.3g} away, which in mm is no organ: "
            f"{unit.of_cloud}."
        )
    farthest_mm = float(np.abs(ordered[:, [0, -1]]).max())
    if farthest_mm > _FARTHEST_MM:
        all_far = abs(middle[2]) > _FARTHEST_MM
        fault = Unit.MICROMETRE.of_cloud if all_far else "remove such points"
        raise InputError(f"points are up to {farthest_mm:.4g} mm away: {fault}.")
    some = points_mm[:: max(1, len(points_mm) // 2000)]
    inner = some[((some >= low) & (some <= high)).all(axis=1)].astype(float)
    _, second, first = np.linalg.eigvalsh(np.cov(inner.T))
    if second < min(_THINNEST_MM**2, _THINNEST**2 * first):
        raise NoEstimate(Finding("line"))
    if not (points_mm[:, 2] > 0).any():
        raise NoEstimate(Finding("behind_camera"), (Likely(Cause.FRAME),))


def check_depth_unit(frame: DepthFrame, unit_mm: float, near_mm: float, far_mm: float) -> None:
    """Refuse a depth image whose unit (mm per step) cannot be right: too much is nearer than any
    camera measures, or hardly anything lies in range that would with another unit. Raises
    InputError, which names the unit that fits."""
    depths = _finite_depths(frame)
    if not len(depths):
        return

    def in_range(unit: float) -> int:
        depth_mm = depths * (unit / unit_mm)
        return int(((depth_mm > near_mm) & (depth_mm < far_mm)).sum())

    low, high = np.quantile(depths, (0.05, 0.95))
    likely = max(_DEPTH_UNITS_MM, key=in_range)
    fits = in_range(likely) >= FEWEST_POINTS and likely != unit_mm
    impossible = low < _NEAREST_MM
    if not impossible and (in_range(unit_mm) >= FEWEST_POINTS or not fits):
        return
    fault = f"hardly any lies between {near_mm:g} and {far_mm:g} mm"
    fault = "nearer than any depth camera sees" if impossible else f"and {fault}"
    what = f"with {unit_mm:g} mm a step most depths run from {low:.4g} to {high:.4g} mm, {fault}"
    if not fits:
        raise InputError(f"{what}. Say how many mm a step of this image is (--depth-unit).")
    low, high = (value * likely / unit_mm for value in (low, high))
    move = "" if impossible else ". If the unit is right, move the camera, or give --range"
    raise InputError(
        f"{what}. Did you mean {likely:g} mm a step ({low:.4g} to {high:.4g} mm)? Give "
        f"--depth-unit {likely:g}{move}."
    )


def _check_range(near_mm: float, far_mm: float) -> None:
    given = f"the depth range {near_mm:g}..{far_mm:g} mm"
    if not 0 <= near_mm < far_mm < np.inf:
        raise InputError(f"{given} is empty; allowed: 0 <= near < far.")
    if far_mm < _LEAST_FAR_MM:
        raise InputError(f"{given} looks like metres; give it in mm.")


def _finite_depths(content: DepthFrame | SensorCloud) -> Float32[np.ndarray, " n"]:
    depth_mm = content.depth_mm if isinstance(content, DepthFrame) else content.points_mm[:, 2]
    return depth_mm[np.isfinite(depth_mm)]


def _too_few(
    count: int, content: DepthFrame | SensorCloud, near_mm: float, far_mm: float
) -> NoEstimate:
    depths, where = _finite_depths(content), "the sensor had no return at all"
    if len(depths):
        span = f"{depths.min():.1f} to {depths.max():.1f} mm"
        where = f"the {len(depths)} depths seen run from {span}"
    do = unit_advice(content, near_mm, far_mm) or "move the camera, or choose another depth range"
    values: dict[str, float | str] = {"points": count, "near_mm": near_mm, "far_mm": far_mm}
    values |= {"seen": where, "fewest": FEWEST_POINTS, "advice": do}
    return NoEstimate(Finding("few_in_range", values))
