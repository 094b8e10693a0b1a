"""Small made-up frames, estimates and updates for tests of sources and sinks."""

from __future__ import annotations

import numpy as np
import trimesh

from reports import report_of
from tumortrack.core.estimate import Estimate
from tumortrack.core.patient import Patient
from tumortrack.core.types import (
    Anatomy,
    DepthFrame,
    Intrinsics,
    Mesh,
    OccupancyCloud,
    SensorCloud,
)
from tumortrack.live.values import Observation, PublishedFrame, SinkContext, TrackingResult

PARTS = ("kidney", "tumor_1", "tumor_2")
CAMERA = Intrinsics(width=64, height=48, fx=60.0, fy=61.0, cx=31.5, cy=23.5)
STAMP_NS = 1_790_000_000_123_456_789


def ball(centre_mm: tuple[float, float, float], radius_mm: float) -> Mesh:
    """A closed sphere of 162 vertices."""
    sphere = trimesh.creation.icosphere(2, radius_mm)
    return Mesh(sphere.vertices + np.array(centre_mm), sphere.faces)


def small_anatomy() -> Anatomy:
    """A ball with two tumors at unequal places; the camera's frame, 130 mm away."""
    return Anatomy(
        (
            ball((4.0, -3.0, 130.0), 25.0),
            ball((14.0, -3.0, 120.0), 6.0),
            ball((-6.0, 5.0, 138.0), 4.0),
        )
    )


def small_estimate(stamp_ns: int = STAMP_NS, n: int = 500) -> Estimate:
    """What a tracker would say of ``small_anatomy``; no motion, no volume."""
    anatomy = small_anatomy()
    rng = np.random.default_rng(5)
    points = rng.normal(size=(n, 3))
    points *= 24 * rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    points = (points + [4.0, -3.0, 130.0]).astype(np.float32)
    labels = np.ones(n, np.uint8)
    for label, tumor in enumerate(anatomy.tumors, start=2):
        middle, radius = tumor.box_mm.mean(0), np.ptp(tumor.box_mm[:, 0]) / 2
        labels[np.linalg.norm(points - middle, axis=1) < radius] = label
    probability = np.linspace(0.5, 1.0, n, dtype=np.float32)
    cloud = OccupancyCloud(points, labels, probability, stamp_ns)
    parts = {
        name: {
            "label": label,
            "found": True,
            "volume_ml": mesh.volume_mm3 / 1000,
            "center_mm": mesh.box_mm.mean(0).tolist(),
            "box_mm": mesh.box_mm.tolist(),
            "points": int((labels == label).sum()),
            "probability": 0.75,
        }
        for label, (name, mesh) in enumerate(zip(PARTS, anatomy.parts, strict=True), start=1)
    }
    meshes = dict(zip(PARTS, anatomy.parts, strict=True))
    return Estimate(cloud, None, meshes, report_of(parts=parts))


def small_frame(stamp_ns: int = STAMP_NS) -> DepthFrame:
    """A depth image of a slope with a hole, no two pixels of a row alike."""
    rows, columns = np.mgrid[0:48, 0:64]
    depth_mm = (120 + 0.5 * columns + 0.1 * rows).astype(np.float32)
    depth_mm[10:14, 20:30] = np.nan
    return DepthFrame(depth_mm, CAMERA, stamp_ns)


def small_update(
    sequence: int = 0, stamp_ns: int = STAMP_NS, frames: PublishedFrame | None = None
) -> TrackingResult:
    """An update with an estimate."""
    frame = small_frame(stamp_ns)
    organ = SensorCloud(small_anatomy().organ.vertices_mm[:80], stamp_ns)
    return TrackingResult(
        sequence=sequence,
        stamp_ns=stamp_ns,
        estimate=small_estimate(stamp_ns),
        quality="good",
        observation=Observation(frame, stamp_ns + 2_000_000),
        organ=organ,
        published_frame=frames or PublishedFrame(),
        seconds={"organ": 0.002, "search": 0.003},
        latency_ms=12.5,
    )


def empty_update(sequence: int = 1, reason: str = "only 12 points lie in range") -> TrackingResult:
    """An update without one."""
    return TrackingResult(sequence=sequence, stamp_ns=STAMP_NS + 33_000_000, reason=reason)


def small_setting() -> SinkContext:
    return SinkContext(PARTS, PublishedFrame(), patient=Patient("P1", "left"))
