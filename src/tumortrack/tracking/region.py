"""Where in a depth image, and how large, a model's organ may be."""

from __future__ import annotations

import numpy as np

from tumortrack.models.model import Model
from tumortrack.registration.model import RegistrationModel
from tumortrack.sense.cloud import CloudConfig
from tumortrack.sense.region import RegionConfig


def region_for(
    model: Model | None = None,
    *,
    range_mm: tuple[float, float] | None = None,
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    whole: bool = False,
) -> RegionConfig:
    """Depths that training showed, unless others are given; where it showed any distance, its
    farthest organ still lies in them whole. Pieces of about the organ's size, if that is known.

    Args:
        range_mm: nearest and farthest depth, camera frame.
        box_mm: two opposite corners of a region of interest, camera frame.
        whole: everything in range is the organ.
    """
    if model is None:
        near, far = range_mm or (CloudConfig().near_mm, CloudConfig().far_mm)
        return RegionConfig(crop=CloudConfig(near_mm=near, far_mm=far), box_mm=box_mm)
    scene = model.config.scene
    near, far = scene.cloud.near_mm, scene.cloud.far_mm
    if scene.free_range > 0:
        nearest, farthest = scene.free_nearest_mm
        near, far = min(near, nearest - 5), max(far, farthest + far - near)
    near, far = range_mm or (near, far)
    crop = CloudConfig(near_mm=near, far_mm=far, n_points=scene.cloud.n_points)
    if whole:
        return RegionConfig(crop=crop, box_mm=box_mm, plane=False, flying=False, pieces=False)
    if not isinstance(model, RegistrationModel):
        return RegionConfig(crop=crop, box_mm=box_mm)
    vertices = model.shape.anatomy_ct.organ.vertices_mm
    axes = np.linalg.svd(vertices - vertices.mean(0), full_matrices=False)[2]
    extents_mm = np.ptp(vertices @ axes.T, axis=0)
    size_mm = (0.7 * float(extents_mm.min()), 1.25 * float(extents_mm.max()))
    return RegionConfig(crop=crop, box_mm=box_mm, organ_mm=size_mm)
