"""Rigid registration of a scene, as a baseline for the estimate.

``best_rigid_pose``: an oracle, which knows the truth but does not deform the organ: no rigid method
has a smaller mean squared displacement.
``rigid_fit``: the undeformed organ of the CT, fitted to the same points as the estimate by robust
point-to-plane least squares from the best rigid pose: the best case of rigid registration.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.cloud import thin_cloud
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, rigid, transform_points
from tumortrack.core.rigid_fit import fit_over_volume, kabsch, matched_vertices
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.io.scene_folder import Scene
from tumortrack.organ.flow import Flow, LatticeField
from tumortrack.organ.rest_shape import DistanceField, RestShape
from tumortrack.registration.base_model import Model
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import POSE, Pose, residual_rows
from tumortrack.report import metrics
from tumortrack.report.summary import BASELINES, judged_parts

_POINTS = 1000  # of the cloud, as many as the estimate uses
_WIDTH_MM = 5.0  # of the robust kernel, the initial one of the elastic fit
_STEPS, _TOLERANCE = 60, 1e-3  # mm and rad of a step
_FEWEST_TARGETS = 10
_SOURCE_POINTS = 4000  # of the surfaces at rest
_TURNS = tuple(np.diag([a, b, a * b]) for a, b in product((1.0, -1.0), repeat=2))


@dataclass(frozen=True, eq=False)
class Baselines:
    """Rigid registrations of scenes of one organ, whose shape at rest a model knows."""

    rest: RestShape

    def __call__(self, scene: Scene) -> dict[str, Any]:
        """By baseline (JSON): ``parts`` (tumors; without one, the organ) with surface and centre
        distances, ``tre_mm`` if the scene has targets, both as in ``report.protocol``, and
        ``camera_from_ct``; or ``not_available``, the reason in words."""
        try:
            pose, by = best_rigid_pose(self.rest.anatomy_ct, scene)
        except InputError as error:
            return {name: {"not_available": str(error)} for name in BASELINES}
        fitted = rigid_fit(self.rest.distances[0], scene.cloud, pose)
        return {
            "best_rigid_pose": {"by": by, **self._errors(pose, scene)},
            "rigid_fit": self._errors(fitted, scene),
        }

    def _errors(self, camera_from_ct: Affine, scene: Scene) -> dict[str, Any]:
        anatomy, rows = self.rest.anatomy_ct, {}
        pairs = zip(anatomy.parts, scene.reference.parts, strict=True)
        judged = judged_parts(dict(zip(anatomy.names, pairs, strict=True)))
        for name, (part, true) in judged.items():
            placed = part.with_vertices(transform_points(camera_from_ct, part.vertices_mm))
            rows[name] = metrics.part_distances(placed, true)
        errors: dict[str, Any] = {"camera_from_ct": camera_from_ct.tolist(), "parts": rows}
        if scene.targets is not None:
            carried = transform_points(camera_from_ct, scene.targets.points_ct)
            errors["tre_mm"] = metrics.target_errors(carried, scene.targets)
        return errors


def baselines_of(model: Model | None) -> Baselines | None:
    """None without a model, and for one that does not keep the organ at rest."""
    return Baselines(model.shape) if isinstance(model, RegistrationModel) else None


def best_rigid_pose(rest: Anatomy, scene: Scene) -> tuple[Affine, str]:
    """The ``camera_from_ct`` that best moves the undeformed organ onto the true one, and how it was
    found: by the surface's triangles, if they are the case's; else by the targets, whose place in
    the CT the scene states; else by nearest points of organ and tumors. Raises InputError: the
    scene has other parts than the case."""
    true = scene.reference
    if true.names != rest.names:
        raise InputError(
            f"the scene has {', '.join(true.names)}, but the model's case {', '.join(rest.names)}"
        )
    try:
        matched = rest.organ.with_vertices(matched_vertices(rest.organ, true.organ))
    except InputError:  # another program's surface, or a second CT's
        if (at := scene.targets) is not None and len(at.labels) >= _FEWEST_TARGETS:
            return kabsch(at.points_ct, at.points_mm, np.ones(len(at.labels))), "targets"
        return _on_surfaces(rest.parts, true.parts), "surfaces"
    return fit_over_volume(rest.organ, matched)[0], "triangles"


def _on_surfaces(rest: tuple[Mesh, ...], true: tuple[Mesh, ...]) -> Affine:
    """By iterative closest points, part onto part, from the four alignments of the principal axes;
    the result with the smallest mean squared distance."""
    from_mm, onto_mm = ([part.spread_mm() for part in parts] for parts in (rest, true))
    trees = [cKDTree(points) for points in onto_mm]
    step = max(1, sum(map(len, from_mm)) // _SOURCE_POINTS)
    thin = [points[::step] for points in from_mm]

    def descend(pose: Affine, source: list[np.ndarray]) -> tuple[float, Affine]:
        error2, everything = np.inf, np.concatenate(source)
        while True:
            placed = [transform_points(pose, points) for points in source]
            pairs = zip(trees, onto_mm, placed, strict=True)
            nearest = np.concatenate([onto[tree.query(at)[1]] for tree, onto, at in pairs])
            before = error2
            error2 = float(((nearest - np.concatenate(placed)) ** 2).sum(1).mean())
            if error2 > before * (1 - 1e-3):
                return error2, pose
            pose = kabsch(everything, nearest, np.ones(len(everything)))

    (centre, axes), (true_centre, true_axes) = _principal(from_mm[0]), _principal(onto_mm[0])
    turns = [true_axes.T @ turn @ axes for turn in _TURNS]
    few = [points[::8] for points in thin]
    coarse = [descend(rigid(turn, true_centre - turn @ centre), few) for turn in turns]
    return descend(min(coarse, key=lambda result: result[0])[1], thin)[1]


def _principal(points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroid of the points, and their principal axes as rows of a rotation."""
    middle = points_mm.mean(0)
    axes = np.linalg.svd(points_mm - middle, full_matrices=False)[2]
    return middle, axes * [[1.0], [1.0], [np.linalg.det(axes)]]


def rigid_fit(organ: DistanceField, cloud: SensorCloud, camera_from_ct: Affine) -> Affine:
    """Fit the organ at rest (distances to its surface, CT frame) to a cloud, rigidly, from a start:
    Gauss-Newton on the points' distances to the surface, with the Geman-McClure kernel."""
    points_mm = thin_cloud(cloud, _POINTS, np.random.default_rng(0)).points_mm
    still = Flow(np.zeros((2, 2, 2, 3), np.float32), organ.origin_mm, np.float32(1), 1)
    none = LatticeField(np.zeros((2, 2, 2, 3, 0), np.float32), *still[1:3])
    center_ct = organ.origin_mm + organ.spacing_mm * (np.array(organ.values_mm.shape) - 1) / 2
    rotation = np.array(camera_from_ct[:3, :3])
    centre_mm = transform_points(camera_from_ct, center_ct[None])[0]
    for _ in range(_STEPS):
        rows = residual_rows(none, organ, still, Pose(center_ct, rotation, centre_mm), points_mm)
        slopes, distances = rows[:, :POSE].astype(float), rows[:, -1].astype(float)
        weighed = slopes * (1 / (1 + (distances / _WIDTH_MM) ** 2) ** 2)[:, None]
        change = np.linalg.lstsq(weighed.T @ slopes, -(weighed.T @ distances), rcond=None)[0]
        centre_mm = centre_mm + rotation @ change[:3]
        rotation = rotation @ Rotation.from_rotvec(change[3:]).as_matrix()
        if np.abs(change).max() < _TOLERANCE:
            break
    return rigid(rotation, centre_mm - rotation @ center_ct)
