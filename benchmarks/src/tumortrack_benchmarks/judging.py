"""Locates a deformed organ and compares it with the truth, and with the best rigid pose and a rigid
fit to the same points that starts there (``report.baselines``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.rigid_fit import matched_vertices
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.io.scene_folder import Scene, Targets, read_scene
from tumortrack.organ.rest_shape import distance_of
from tumortrack.registration.model import RegistrationModel
from tumortrack.report.baselines import best_rigid_pose, rigid_fit
from tumortrack.report.metrics import outward_miss, surface_distances
from tumortrack.tracking.tracker import Tracker

_RIGID = ("rigid_", "rigid_fit_")  # prefixes of errors: of the best rigid pose, of the rigid fit
_kept_distance = lru_cache(maxsize=1)(distance_of)  # of an organ: a second


def judge(tracker: Tracker, anatomy_ct: Anatomy, scene: Scene) -> dict[str, Any]:
    """Locate a scene whose surfaces have the CT's triangles in their order, as `track` first sees
    it, and compare.

    ``verdict`` (refused, poor, good), ``reason``, and ``tumors``: of each the errors of its middle
    and surface (see ``_errors``), of the estimate, of the best rigid pose (``rigid_``) and of the
    rigid fit (``rigid_fit_``); the stated standard deviation, and the radius within which 95 % of
    such tumors lie (``radius_mm``), if it is known; mm. Where the scene has targets, ``target_mm``
    and the same of both rigid poses are their mean errors.
    """
    row: dict[str, Any] = {"tumors": [], "verdict": "refused", "reason": ""}
    motion = None
    try:
        estimate = tracker.follow(scene.cloud, full_view=scene.depth)
        row |= {"verdict": estimate.quality, "reason": estimate.reason}
        motion = estimate.motion
        assert motion is not None
    except NoEstimate as error:
        row["reason"] = str(error)
    best, _ = best_rigid_pose(anatomy_ct, scene)
    fitted = rigid_fit(_kept_distance(anatomy_ct.organ), scene.cloud, best)
    poses = dict(zip(_RIGID, (best, fitted), strict=True))
    targets = scene.targets
    if targets is not None:
        for prefix, pose in poses.items():
            placed = transform_points(pose, targets.points_ct)
            row[f"{prefix}target_mm"] = _mean_off(placed, targets)
        if motion is not None:
            row["target_mm"] = _mean_off(motion.forward(targets.points_ct), targets)
    tumors = zip(anatomy_ct.names[1:], anatomy_ct.tumors, scene.reference.tumors, strict=True)
    for name, rest, true in tumors:
        tumor: dict[str, float | None] = {}
        for prefix, pose in poses.items():
            tumor |= _errors(_posed(rest, pose), true, prefix)
        if motion is not None:
            estimated = rest.with_vertices(motion.forward(rest.vertices_mm))
            tumor |= _errors(estimated, true, "")
            std_mm = motion.std_mm(rest.vertices_mm.mean(0, keepdims=True))
            assert std_mm is not None
            tumor["std_mm"] = float(std_mm[0])
            bound = estimate.assessment.bounds.get(name)
            tumor["radius_mm"] = None if bound is None else bound.error_bound95_mm
        row["tumors"].append(tumor)
    return row


def judge_folder(tracker: Tracker, anatomy_ct: Anatomy, path: Path) -> dict[str, Any]:
    """``judge`` of a folder of a stress scene, whose surfaces have the CT's triangles in any order;
    and which state and view it is."""
    scene = read_scene(path)
    pairs = zip(anatomy_ct.parts, scene.reference.parts, strict=True)
    ordered = (rest.with_vertices(matched_vertices(rest, part)) for rest, part in pairs)
    number, family, *_ = path.name.split("-")
    return {
        "scene": path.name, "state": int(number), "family": family,
        **{name: scene.meta[name] for name in ("hidden_share", "visible_share")},
        "segmentation": scene.meta["segmentation"]["kind"],
        **judge(tracker, anatomy_ct, replace(scene, reference=anatomy_ct.with_parts(ordered))),
    }  # fmt: skip


def _mean_off(found_mm: np.ndarray, targets: Targets) -> float:
    return float(np.linalg.norm(found_mm - targets.points_mm, axis=1).mean())


def _posed(mesh: Mesh, pose: np.ndarray) -> Mesh:
    return mesh.with_vertices(transform_points(pose, mesh.vertices_mm))


def _errors(estimated: Mesh, true: Mesh, prefix: str) -> dict[str, float]:
    """``middle_mm``; Hausdorff and mean surface distance; ``outside_mm``: how far the true tumor
    sticks out of the estimated one."""
    off_mm = estimated.vertices_mm.mean(0) - true.vertices_mm.mean(0)  # the same vertices
    far = surface_distances(estimated, true, spacing_mm=2.0)
    errors = {
        "middle_mm": float(np.linalg.norm(off_mm)),
        "hausdorff_mm": far.hausdorff_mm,
        "surface_mm": far.surface_mm,
        "outside_mm": outward_miss(estimated, true),
    }
    return {f"{prefix}{name}": mm for name, mm in errors.items()}


def centers_off_mm(meshes: Mapping[str, Mesh], truth: Anatomy) -> dict[str, float]:
    """By tumor: the distance between the middles of its boxes, mm."""
    return {
        name: float(np.linalg.norm(meshes[name].box_mm.mean(0) - true.box_mm.mean(0)))
        for name, true in zip(truth.names[1:], truth.tumors, strict=True)
    }


def rigid_centers_mm(model: RegistrationModel, scene: Scene) -> dict[str, float]:
    """Errors of the tumors' centres, by a rigid fit to the same points from the best rigid pose."""
    assert scene.targets is not None
    start, _ = best_rigid_pose(model.shape.anatomy_ct, scene)
    rigid = rigid_fit(model.shape.distances[0], scene.cloud, start)
    off_mm = transform_points(rigid, scene.targets.points_ct) - scene.targets.points_mm
    return {
        name: float(np.linalg.norm(off_mm[scene.targets.labels == label].mean(0)))
        for label, name in enumerate(model.parts, start=1)
        if label > 1 and (scene.targets.labels == label).any()
    }
