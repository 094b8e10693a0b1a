"""What a peer is, and the rigid ones.

A peer moves the pre-operative anatomy onto one observed cloud: it is made for one patient and
fitted to scenes one by one. Its answer is a map of points, from which organ, tumors and labels
follow; so peers and network are compared by the same ``report.protocol.compare``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float64

from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.models.report import estimate_of as of_surfaces
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.pose_search import (
    Direction,
    Points,
    PoseSearch,
    RigidConfig,
    Transform,
)

# Barycentric points of a tetrahedron that integrate quadratics exactly (Keast 1986, 4 points).
_NEAR, _FAR = 0.1381966011250105, 0.5854101966249685

Carry = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]


@dataclass(frozen=True, eq=False)
class Fit:
    """A peer's answer for one scene.

    ``carry``: points of the undeformed CT frame (LPS, mm) -> the camera frame (mm); ``report``
    (JSON): whatever explains it.
    """

    carry: Carry
    report: dict = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class OneWay:
    """The motion of a method that knows only the way from the CT to the camera."""

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
        """Locate the anatomy in a scene. All but the bound use ``scene.cloud`` alone. Raises
        NoEstimate: the cloud has too little information, such as fewer than 20 points; InputError:
        the cloud or the peer's settings cannot be used."""


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
    return of_surfaces(meshes, grid, stamp_ns, fit=fit.report)


class Rigid:
    """The pose of least error as a peer."""

    def __init__(self, anatomy_ct: Anatomy, up_lps: Direction, config: RigidConfig) -> None:
        self._search = PoseSearch(anatomy_ct, up_lps, config)

    def fit(self, scene: Scene) -> Fit:
        best = self._search.poses(scene.cloud)[0]
        return Fit(rigid_carry(best.camera_from_ct), {"residual_mm": best.error_mm})


class RigidBound:
    """The best rigid pose there is, found with the truth in hand: least squares over the organ's
    whole volume, from the truth's own correspondence. Not a method anyone could use; no rigid
    method can beat it in that norm. Errors as of ``matched_vertices``."""

    def __init__(self, anatomy_ct: Anatomy, up_lps: Direction) -> None:
        self._organ = anatomy_ct.organ

    def fit(self, scene: Scene) -> Fit:
        reference = self._organ.moved(matched_vertices(self._organ, scene.reference.organ))
        camera_from_ct, residual_mm = fit_over_volume(self._organ, reference)
        return Fit(rigid_carry(camera_from_ct), {"residual_mm": residual_mm})


def matched_vertices(rest: Mesh, moved: Mesh) -> Points:
    """Where each vertex of ``rest`` lies in ``moved``, the same triangles in the same order: read
    meshes lose the order of their vertices (equal ones are merged), but never that of their
    triangles. Raises InputError: ``moved`` has other triangles."""
    vertex = np.full(len(rest.vertices_mm), -1)
    same = rest.faces.shape == moved.faces.shape
    if same:
        vertex[rest.faces.reshape(-1)] = moved.faces.reshape(-1)
        same = bool((vertex[rest.faces] == moved.faces).all() and (vertex >= 0).all())
    if not same:
        raise InputError(
            "the rigid bound needs a scene made from this case: its organ must have the "
            "same triangles as the case's. Make scenes with this case, or leave the bound out."
        )
    return moved.vertices_mm[vertex]


def fit_over_volume(source: Mesh, target: Mesh) -> tuple[Transform, float]:
    """``target_from_source`` with the least squared displacement over the source's volume, and the
    root mean square displacement that it leaves, mm. Exact for a displacement that is linear in
    each tetrahedron of a triangle and the vertices' mean."""
    from_mm, weights = _volume_points(source, source)
    to_mm, _ = _volume_points(source, target)
    transform = kabsch(from_mm, to_mm, weights)
    left2 = ((transform_points(transform, from_mm) - to_mm) ** 2).sum(1)
    return transform, float(np.sqrt(max(np.average(left2, weights=weights), 0.0)))


def _volume_points(rest: Mesh, moved: Mesh) -> tuple[Points, Float64[np.ndarray, " n"]]:
    """Quadrature points carried along with ``moved``; their signed weights from ``rest``."""
    corners = rest.vertices_mm[rest.faces] - rest.vertices_mm.mean(0)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    apex = np.broadcast_to(moved.vertices_mm.mean(0), (len(volume), 1, 3))
    tetrahedra = np.concatenate([apex, moved.vertices_mm[moved.faces]], axis=1)
    shares = np.full((4, 4), _NEAR) + (_FAR - _NEAR) * np.eye(4)
    points = np.einsum("qc,tcx->tqx", shares, tetrahedra).reshape(-1, 3)
    return points, np.repeat(volume / 4, 4)


def kabsch(source_mm: Points, target_mm: Points, weights: Float[np.ndarray, " n"]) -> Transform:
    """The rigid transform that carries source points to target points best, in weighted squares
    (Kabsch 1976, doi 10.1107/S0567739476001873)."""
    share = weights / weights.sum()
    source_centre, target_centre = share @ source_mm, share @ target_mm
    spread = (source_mm - source_centre).T @ (share[:, None] * (target_mm - target_centre))
    u, _, vt = np.linalg.svd(spread)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ mirror @ u.T
    return rigid(rotation, target_centre - rotation @ source_centre)
