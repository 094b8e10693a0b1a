"""Error at each point of a tumor's true surface, beside its depth and its displacement.

A network gives no correspondence, so the error of a point is its distance to the estimated
surface, for every method alike: 0 means that the surface passes through the point.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.report.metrics import distance_to_surface
from tumortrack.sense.camera import deproject
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.rigid import kabsch

POINTS = 120  # vertices drawn of each tumor
_NEAR_MM, _FAR_MM = 50.0, 400.0  # of a depth image: what can be the organ at all


def visible_points(scene: Scene) -> Float[np.ndarray, "n 3"]:
    """The organ's seen surface: all pixels of the depth image, or else the cloud."""
    if scene.depth is None:
        return scene.cloud.points_mm.astype(float)
    points = deproject(scene.depth).astype(float)
    return points[(points[:, 2] > _NEAR_MM) & (points[:, 2] < _FAR_MM)]


def point_errors(
    truth: Anatomy,
    rest_ct: Anatomy,
    visible_mm: Float[np.ndarray, "n 3"],
    meshes: dict[str, Mesh],
) -> dict[str, dict[str, list[float]]]:
    """By tumor that was found: depth, displacement and error of points of its true surface, mm.

    Args:
        truth: the anatomy in the scene, camera frame; face n of a part is face n of ``rest_ct``.
        rest_ct: the undeformed anatomy, CT frame.
        visible_mm: the visible surface without noise, camera frame.
        meshes: the estimate, by part name.

    Depth is the distance to the nearest visible point; displacement is what is left of a point's
    way after the best rigid motion of the whole organ, and absent where the scene's surfaces are
    not the case's.
    """
    from scipy.spatial import cKDTree

    seen = cKDTree(visible_mm)
    moves = displacements(truth, rest_ct)
    out: dict[str, dict[str, list[float]]] = {}
    for name, part in zip(truth.names[1:], truth.tumors, strict=True):
        if name not in meshes or len(meshes[name].faces) == 0:
            continue
        corners = part.faces.reshape(-1)
        chosen = np.random.default_rng(0).integers(len(corners), size=POINTS)
        points = part.vertices_mm[corners[chosen]]
        columns = {
            "depth_mm": seen.query(points)[0],
            "error_mm": distance_to_surface(points, meshes[name]),
        }
        if name in moves:
            columns["displacement_mm"] = moves[name][chosen]
        out[name] = {key: np.round(values, 2).tolist() for key, values in columns.items()}
    return out


def displacements(truth: Anatomy, rest_ct: Anatomy) -> dict[str, Float[np.ndarray, " n"]]:
    """How far the corner of each face lies from its place under the best rigid motion, mm.

    Corners, because a file's vertices may come back in another order; its faces do not. Empty
    where the surfaces are not the case's own.
    """
    same = len(truth.parts) == len(rest_ct.parts) and all(
        len(a.faces) == len(b.faces) for a, b in zip(truth.parts, rest_ct.parts, strict=True)
    )
    if not same:
        return {}
    now = [part.vertices_mm[part.faces.reshape(-1)] for part in truth.parts]
    before = [part.vertices_mm[part.faces.reshape(-1)] for part in rest_ct.parts]
    best = kabsch(before[0], now[0], np.ones(len(now[0])))
    return {
        name: np.linalg.norm(a - transform_points(best, b), axis=1)
        for name, a, b in zip(truth.names, now, before, strict=True)
    }
