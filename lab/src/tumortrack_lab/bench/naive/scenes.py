"""A training pair as one would write it first: NumPy, a ray for each pixel, inside tests."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack.simulate.deform.drag import Drags
from tumortrack.simulate.deform.elastic import ElasticDeformation
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import labels_of
from tumortrack.simulate.scene import RenderedScene

FLOW_STEPS = 12


def plain_pair(anatomy_ct: Anatomy, stage: RenderedScene, labels: int) -> np.ndarray:
    """All surfaces deformed, a ray a pixel through a tree that is built anew, and random points
    labelled by inside tests on the deformed surfaces."""
    parts = [part.moved(_carried(stage, part.vertices_mm)) for part in anatomy_ct.parts]
    k = stage.frame.intrinsics
    u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], -1).reshape(-1, 3)
    mesh = trimesh.Trimesh(parts[0].vertices_mm, parts[0].faces, process=False)
    mesh.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    lower, upper = parts[0].box_mm
    points = np.random.default_rng(0).uniform(lower, upper, (labels, 3)).astype(np.float32)
    return labels_of(Anatomy(tuple(parts)), points)


def _carried(stage: RenderedScene, points_ct: np.ndarray) -> np.ndarray:
    deformation = stage.deformation
    if isinstance(deformation, Drags):
        moved = _dragged(deformation, points_ct)
    else:
        assert isinstance(deformation, ElasticDeformation)
        moved = flowed(deformation.body, deformation.coefficients, points_ct)
    return transform_points(stage.camera_from_ct, moved)


def _dragged(drags: Drags, points_ct: np.ndarray) -> np.ndarray:
    moved = points_ct.copy()
    for centre, shift, sigma in zip(
        drags.centres_ct, drags.shifts_mm, drags.sigmas_mm, strict=True
    ):
        square = ((moved - centre) ** 2).sum(1)
        moved += np.exp(-0.5 * square / sigma**2)[:, None] * shift
    return moved


def flowed(body: ElasticBody, coefficients: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the CT frame after one unit of time in a body's velocity: midpoint rule,
    SciPy's interpolation."""
    field = np.moveaxis(body.velocity(coefficients), 3, 0)
    moved = np.array(points, float)
    for _ in range(FLOW_STEPS):
        middle = moved + sampled(body, field, moved) / (2 * FLOW_STEPS)
        moved += sampled(body, field, middle) / FLOW_STEPS
    return moved


def sampled(body: ElasticBody, fields: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Fields (f, i, j, k) on a body's lattice at points (n, 3) -> (n, f)."""
    place = (points - body.origin_mm).T / body.spacing_mm
    return np.stack([map_coordinates(f, place, order=1, mode="nearest") for f in fields], 1)
