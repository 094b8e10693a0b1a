"""Locates a deformed organ and compares it with the truth, and with the best rigid pose and a rigid
fit to the same points that starts there (``report.rivals``)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.rigid_fit import fit_over_volume
from tumortrack.core.types import Anatomy, DepthFrame, Mesh
from tumortrack.registration.rest_shape import distance_of
from tumortrack.report.metrics import outward_miss, surface_distances
from tumortrack.report.rivals import best_rigid_pose, rigid_fit
from tumortrack.sense.camera import d405
from tumortrack.sense.cloud import CloudConfig, cloud_from_depth
from tumortrack.sense.noise import D405_NOISE, add_noise
from tumortrack.sense.render import render_depth
from tumortrack.simulate.deform import ChainConfig, DragConfig, StretchConfig
from tumortrack.simulate.deform.base import Deformation
from tumortrack.simulate.scene import PoseConfig, SceneConfig, sample_pose
from tumortrack.simulate.scene_folder import Scene, Targets
from tumortrack.tracking.tracker import Tracker

CAMERA = d405(424, 240)
# Unlike any scene that a model is calibrated on.
DRAGGED = SceneConfig(
    deform=(ChainConfig(links=(DragConfig(), StretchConfig())),), noise=D405_NOISE
)
# Columns that tables need; what was measured before rigid fits were has none of theirs.
_FIRST = ["name", "verdict", "middle_mm", "hausdorff_mm", "std_mm", "rigid_fit_middle_mm"]
_RIGID = ("rigid_", "rigid_fit_")  # prefixes of errors: of the best rigid pose, of the rigid fit
_kept_distance = lru_cache(maxsize=1)(distance_of)  # of an organ: a second


def scene_of(
    anatomy_ct: Anatomy,
    up_lps: tuple[float, float, float],
    deformation: Deformation,
    rng: np.random.Generator,
) -> Scene:
    """One depth image, with a D405's noise, of the deformed organ in a pose of the paper's kind
    (any turn about the camera's axis, tilts up to 15 degrees), cropped as the paper's. Raises
    NoEstimate: too little of it is in range."""
    parts = [part.moved(deformation.apply(part.vertices_mm)) for part in anatomy_ct.parts]
    config = PoseConfig()
    pose = sample_pose(config, parts[0], up_lps, config.nearest_mm, rng)
    there = anatomy_ct.of(_posed(part, pose) for part in parts)
    frame = render_depth(there.organ.vertices_mm, there.organ.faces, CAMERA)
    frame = add_noise(frame, D405_NOISE, rng)
    return Scene(cloud_from_depth(frame, CloudConfig(), rng), there, frame)


def judge(
    tracker: Tracker,
    anatomy_ct: Anatomy,
    scene: Scene,
    seen: DepthFrame | None = None,
    surfaces: bool = True,
) -> dict[str, Any]:
    """Locate a scene whose surfaces have the CT's triangles in their order, and compare; ``seen``:
    the image that the estimate's quality is checked with.

    Returns:
        ``verdict`` (refused, poor, good), ``reason``, and ``tumors``: of each the error of its
        middle and, with ``surfaces``, the Hausdorff and the mean surface distance and how far the
        true tumor sticks out of the estimated one, of the estimate, of the best rigid pose
        (``rigid_``) and of the rigid fit (``rigid_fit_``); the middle's error after moving the
        estimate rigidly onto the truth (``shape_``); the stated standard deviation, and the radius
        within which 95 % of such tumors lie (``radius_mm``), if it is known; mm. No tumors where
        the scene shows another organ. Where it has targets, ``target_mm`` and the same of both
        rigid poses are their mean errors.
    """
    row: dict[str, Any] = {"tumors": [], "verdict": "refused", "reason": ""}
    motion = None
    try:
        estimate = tracker.follow(scene.cloud, seen=seen)
        row |= {"verdict": estimate.quality, "reason": estimate.reason}
        motion = estimate.motion
        assert motion is not None
    except NoEstimate as error:
        row["reason"] = str(error)
    if scene.meta.get("model_organ") is False:
        return row
    best, _ = best_rigid_pose(anatomy_ct, scene)
    fitted = rigid_fit(_kept_distance(anatomy_ct.organ), scene.cloud, best)
    poses = dict(zip(_RIGID, (best, fitted), strict=True))
    onto, targets = np.eye(4), scene.targets
    if targets is not None:
        for prefix, pose in poses.items():
            placed = transform_points(pose, targets.points_ct)
            row[f"{prefix}target_mm"] = _mean_off(placed, targets)
        if motion is not None:
            row["target_mm"] = _mean_off(motion.carry(targets.points_ct), targets)
    if motion is not None:
        estimated = anatomy_ct.organ.moved(motion.carry(anatomy_ct.organ.vertices_mm))
        onto = fit_over_volume(estimated, scene.reference.organ)[0]
    tumors = zip(anatomy_ct.names[1:], anatomy_ct.tumors, scene.reference.tumors, strict=True)
    for name, rest, true in tumors:
        tumor: dict[str, float | None] = {}
        for prefix, pose in poses.items():
            tumor |= _errors(_posed(rest, pose), true, prefix, surfaces)
        if motion is not None:
            estimated = rest.moved(motion.carry(rest.vertices_mm))
            tumor |= _errors(estimated, true, "", surfaces)
            tumor |= _errors(_posed(estimated, onto), true, "shape_", False)
            std_mm = motion.std_mm(rest.vertices_mm.mean(0, keepdims=True))
            assert std_mm is not None
            tumor["std_mm"] = float(std_mm[0])
            bound = estimate.assessment.bounds.get(name)
            tumor["radius_mm"] = None if bound is None else bound.error_bound95_mm
        row["tumors"].append(tumor)
    return row


def _mean_off(found_mm: np.ndarray, targets: Targets) -> float:
    return float(np.linalg.norm(found_mm - targets.points_mm, axis=1).mean())


def _posed(mesh: Mesh, pose: np.ndarray) -> Mesh:
    return mesh.moved(transform_points(pose, mesh.vertices_mm))


def _errors(estimated: Mesh, true: Mesh, prefix: str, surfaces: bool) -> dict[str, float]:
    off_mm = estimated.vertices_mm.mean(0) - true.vertices_mm.mean(0)  # the same vertices
    errors = {f"{prefix}middle_mm": float(np.linalg.norm(off_mm))}
    if surfaces:
        far = surface_distances(estimated, true, spacing_mm=2.0)
        errors[f"{prefix}hausdorff_mm"] = far.hausdorff_mm
        errors[f"{prefix}surface_mm"] = far.surface_mm
        errors[f"{prefix}outside_mm"] = outward_miss(estimated, true)
    return errors


def by_tumor(rows: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """A line for each tumor, with its scene's values; one line for a scene without tumors."""
    lines = [{**row, **tumor} for row in rows for tumor in row["tumors"] or [{}]]
    frame = pd.DataFrame(lines)
    return frame.reindex(columns=[*dict.fromkeys([*_FIRST, *frame.columns])])
