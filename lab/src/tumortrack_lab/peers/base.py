"""What a peer is: a method that moves the pre-operative anatomy onto one observed cloud.

A peer is made for one patient (the work that does not need the cloud is done and timed there) and
fitted to scenes one by one. Its answer is a map of points, from which organ, tumors and labels
follow; so peers and network are compared by the same ``report.protocol.compare``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float64

import tumortrack
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, CameraLabels, OccupancyCloud
from tumortrack.models.report import describe_parts, grid_over
from tumortrack.report.metrics import label_grid
from tumortrack.simulate.scene_folder import Scene

CLOUD_POINTS = 40_000  # of an estimate, as many as the tracker asks for

Carry = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]


@dataclass(frozen=True, eq=False)
class Fit:
    """A peer's answer for one scene.

    Attributes:
        carry: points of the undeformed CT frame (LPS, mm) -> the camera frame (mm).
        seconds: what a frame costs, preparation excluded.
        report: JSON types: ``start`` used, ``iterations``, ``residual_mm``, whatever explains it.
    """

    carry: Carry
    seconds: float
    report: dict = field(default_factory=dict)


class Peer(Protocol):
    """A method made ready for one patient."""

    name: str
    prepare_s: float  # spent before the first frame

    def fit(self, scene: Scene) -> Fit:
        """Locate the anatomy in a scene. All but the bound look at ``scene.cloud`` alone.

        Raises:
            NoEstimate: the cloud says too little.
            InputError: the cloud or the peer's settings cannot be used.
        """
        ...


def rigid_carry(camera_from_ct: Float64[np.ndarray, "4 4"]) -> Carry:
    """The map of points of a rigid pose."""
    return lambda points_ct: transform_points(camera_from_ct, points_ct)


def estimate_of(fit: Fit, anatomy_ct: Anatomy, stamp_ns: int = 0, grid: int = 160) -> Estimate:
    """A fit as the tracker's value: surfaces moved, labels voxelised from them.

    Args:
        fit: the peer's answer.
        anatomy_ct: the patient's anatomy (CT frame).
        stamp_ns: of the cloud.
        grid: voxels along the longest side of the dense volume, as in ``Tracker.locate``.

    Raises:
        InputError: the fit carries points to places that are no numbers.
    """
    moved = Anatomy(
        tuple(part.moved(_finite(fit.carry(part.vertices_mm))) for part in anatomy_ct.parts)
    )
    camera_from_index, shape = grid_over(moved.organ.vertices_mm, grid)
    labels = label_grid(moved, camera_from_index, shape)
    inside = _cloud_of(labels, camera_from_index, stamp_ns)
    meshes = dict(zip(moved.names, moved.parts, strict=True))
    report = {
        "tumortrack": tumortrack.__version__,
        "units": "mm",
        "frame": "camera",
        "stamp_ns": stamp_ns,
        "voxel_mm": float(camera_from_index[0, 0]),
        "parts": describe_parts(moved.names, meshes, inside),
        "timings": {"total": fit.seconds},
        "fit": fit.report,
    }
    return Estimate(inside, CameraLabels(labels, camera_from_index), meshes, report)


def _finite(points_mm: np.ndarray) -> np.ndarray:
    if not np.isfinite(points_mm).all():
        raise InputError("the fit diverged: it carries points to NaN or infinity.")
    return points_mm


def _cloud_of(
    labels: np.ndarray, camera_from_index: Float64[np.ndarray, "4 4"], stamp_ns: int
) -> OccupancyCloud:
    """Evenly chosen voxels inside; a peer knows no probabilities but 1."""
    inside = np.flatnonzero(labels)
    inside = inside[:: max(1, len(inside) // CLOUD_POINTS)]
    index = np.stack(np.unravel_index(inside, labels.shape), 1).astype(float)
    points_mm = transform_points(camera_from_index, index)
    return OccupancyCloud(points_mm, labels.reshape(-1)[inside], np.ones(len(inside)), stamp_ns)


class Stopwatch:
    """Seconds spent in a ``with`` block."""

    seconds = 0.0


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    watch, start = Stopwatch(), time.perf_counter()
    yield watch
    watch.seconds = time.perf_counter() - start
