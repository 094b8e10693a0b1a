"""The interface of peers (methods to compare with), and the rigid ones, two of which know the
truth: they show the best that rigid registration can do.

A peer moves the pre-operative anatomy onto one observed cloud: it is made for one patient and
fitted to scenes one by one. Its answer is a map of points, from which organ, tumors and labels
follow, so that peers are evaluated exactly as the default method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack.models.report import estimate_of as of_surfaces
from tumortrack.registration.rest_shape import distance_of
from tumortrack.report.rivals import best_rigid_pose, rigid_fit
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.pose_search import (
    Direction,
    Points,
    PoseSearch,
    RigidConfig,
    Transform,
)

Carry = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]


@dataclass(frozen=True, eq=False)
class Fit:
    """A peer's answer for one scene.

    ``carry``: points of the undeformed CT frame (LPS, mm) -> the camera frame (mm); ``report``
    (JSON): details of the fit.
    """

    carry: Carry
    report: dict = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class OneWay:
    """The motion of a method without an inverse and without uncertainty."""

    carry: Carry

    def back(self, points_camera: Points, /) -> None:
        return None

    def std_mm(self, points_ct: Points, /) -> None:
        return None

    largest_std_mm = covariance_mm2 = std_mm


@runtime_checkable
class Peer(Protocol):
    """A method made ready for one patient."""

    def fit(self, scene: Scene) -> Fit:
        """Locate the anatomy in a scene. All but ``RigidBound`` and ``RigidFit`` use
        ``scene.cloud`` alone. Raises NoEstimate: the cloud has too little information, such as
        fewer than 20 points; InputError: the cloud or the peer's settings cannot be used."""


def rigid_carry(camera_from_ct: Transform) -> Carry:
    """The map of points of a rigid pose."""
    return lambda points_ct: transform_points(camera_from_ct, points_ct)


def estimate_of(fit: Fit, anatomy_ct: Anatomy, stamp_ns: int = 0, grid: int = 160) -> Estimate:
    """A fit as the tracker's value: surfaces moved, labels voxelised from them with ``grid`` voxels
    along the longest side. Raises InputError: the fit carries points to NaN or infinity."""
    carried = [np.asarray(fit.carry(part.vertices_mm)) for part in anatomy_ct.parts]
    if not all(np.isfinite(points_mm).all() for points_mm in carried):
        raise InputError("the fit diverged: it carries points to NaN or infinity.")
    pairs = zip(anatomy_ct.names, anatomy_ct.parts, carried, strict=True)
    meshes = {name: part.moved(points_mm) for name, part, points_mm in pairs}
    return of_surfaces(meshes, grid, stamp_ns, peer=fit.report)


class Rigid:
    """The best pose of ``PoseSearch``."""

    def __init__(self, anatomy_ct: Anatomy, up_lps: Direction, config: RigidConfig) -> None:
        self._search = PoseSearch(anatomy_ct, up_lps, config)

    def fit(self, scene: Scene) -> Fit:
        best = self._search.poses(scene.cloud)[0]
        return Fit(rigid_carry(best.camera_from_ct), {"residual_mm": best.error_mm})


class RigidBound:
    """``report.rivals.best_rigid_pose``: an oracle, not a method. Raises InputError: the scene has
    other parts than the case."""

    def __init__(self, anatomy_ct: Anatomy, up_lps: Direction) -> None:
        self._anatomy_ct = anatomy_ct

    def fit(self, scene: Scene) -> Fit:
        camera_from_ct, by = best_rigid_pose(self._anatomy_ct, scene)
        return Fit(rigid_carry(camera_from_ct), {"by": by})


class RigidFit(RigidBound):
    """``report.rivals.rigid_fit`` from there: what rigid registration gives its users at best."""

    def __init__(self, anatomy_ct: Anatomy, up_lps: Direction) -> None:
        super().__init__(anatomy_ct, up_lps)
        self._distance = distance_of(anatomy_ct.organ)

    def fit(self, scene: Scene) -> Fit:
        start, by = best_rigid_pose(self._anatomy_ct, scene)
        return Fit(rigid_carry(rigid_fit(self._distance, scene.cloud, start)), {"by": by})
