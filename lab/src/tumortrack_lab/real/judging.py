"""A deformed organ before the camera, located, and held against the truth and the best rigid pose.

The rigid pose is an oracle's: least squares over the organ's volume, with the true deformation in
hand. No method that sees one side can know it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.report.metrics import surface_distances
from tumortrack.sense.camera import d405
from tumortrack.sense.cloud import CloudConfig, cloud_from_depth
from tumortrack.sense.noise import D405_NOISE, add_noise
from tumortrack.sense.render import render_depth
from tumortrack.simulate.deform.base import Deformation
from tumortrack.simulate.scene import PoseConfig, sample_pose
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.peers.base import fit_over_volume

CAMERA = d405(424, 240)  # as training's
_FIRST = ["name", "verdict", "middle_mm", "hausdorff_mm", "std_mm"]


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
    there = Anatomy(tuple(_laid(part, pose) for part in parts))
    frame = render_depth(there.organ.vertices_mm, there.organ.faces, CAMERA)
    frame = add_noise(frame, D405_NOISE, rng)
    return Scene(cloud_from_depth(frame, CloudConfig(), rng), there, frame)


def judge(tracker: Tracker, anatomy_ct: Anatomy, scene: Scene) -> dict[str, Any]:
    """What is said of a scene whose surfaces have the CT's vertices in their order.

    Returns:
        ``verdict`` (refused, poor, good), ``reason``, and ``tumors``: of each the error of its
        middle and the Hausdorff distance, of the estimate and of the best rigid pose, and the
        deviation that the estimate states of its middle; mm.
    """
    pose = fit_over_volume(anatomy_ct.organ, scene.reference.organ)[0]
    pairs = list(zip(anatomy_ct.tumors, scene.reference.tumors, strict=True))
    tumors = [_errors(_laid(rest, pose), true, "rigid_") for rest, true in pairs]
    row: dict[str, Any] = {"tumors": tumors}
    try:
        estimate = tracker.follow(scene.cloud)
    except NoEstimate as error:
        return {**row, "verdict": "refused", "reason": str(error)}
    motion = estimate.motion
    assert motion is not None
    for tumor, (rest, true) in zip(tumors, pairs, strict=True):
        tumor |= _errors(rest.moved(motion.carry(rest.vertices_mm)), true)
        std_mm = motion.std_mm(rest.vertices_mm.mean(0, keepdims=True))
        assert std_mm is not None
        tumor["std_mm"] = float(std_mm[0])
    return {**row, "verdict": estimate.quality, "reason": estimate.reason}


def _laid(mesh: Mesh, pose: np.ndarray) -> Mesh:
    return mesh.moved(transform_points(pose, mesh.vertices_mm))


def _errors(found: Mesh, true: Mesh, prefix: str = "") -> dict[str, float]:
    off_mm = found.vertices_mm.mean(0) - true.vertices_mm.mean(0)  # the same vertices
    return {
        f"{prefix}middle_mm": float(np.linalg.norm(off_mm)),
        f"{prefix}hausdorff_mm": surface_distances(found, true, spacing_mm=2.0).hausdorff_mm,
    }


def by_tumor(rows: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """A line a tumor, with what holds for its scene."""
    lines = [{**row, **tumor} for row in rows for tumor in row["tumors"]]
    found = pd.DataFrame(lines)
    return found.reindex(columns=[*dict.fromkeys([*_FIRST, *found.columns])])


def quantiles(values: Iterable[float]) -> str:
    """Median / 90 % / 95 % / worst."""
    given = pd.Series(list(values), dtype=float).dropna()
    shown = [*given.quantile([0.5, 0.9, 0.95]), given.max()]
    return " / ".join(f"{value:.1f}" for value in shown) if len(given) else "–"
