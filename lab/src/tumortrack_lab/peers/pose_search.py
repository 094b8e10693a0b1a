"""The rigid poses that fit a cloud best: ICP of the cloud to the surface from many starts.

Point-to-plane ICP by small_gicp (Koide 2024, doi 10.21105/joss.06948). ICP converges to the
nearest minimum only, so the starts cover the rotations that the surgeon's knowledge leaves open.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.config import Config
from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import rigid, rotation_onto, transform_points, triangles_of
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.sense.render import Visibility

_TOWARDS_CAMERA = np.array([0.0, 0.0, -1.0])
CROP_PERCENT = 98.0  # of the cloud's depths: beyond, nothing was kept (or it is noise)
_POLISH = 20  # iterations
_ALIKE_DEG, _ALIKE_MM = 8.0, 5.0
_FEWEST_POINTS = 20

Transform = Float64[np.ndarray, "4 4"]
Points = Float64[np.ndarray, "_ 3"]
Point = Float64[np.ndarray, " 3"]
Rotation3 = Float64[np.ndarray, "3 3"]
Direction = tuple[float, float, float]


class RigidConfig(Config, frozen=True):
    """How a rigid pose is searched: the side that faces the camera is known, the turn about the
    camera's axis is not (the paper's M_lim)."""

    turns: int = 24  # about the camera's axis
    tilt_deg: float = 12.0  # four more starts of each turn, tilted by this
    spacing_mm: float = 2.0  # of the model's surface points
    distance_mm: float = 120.0  # from the camera to the organ's nearest point, in the starts
    coarse_points: int = 250  # of the cloud, for the first pass over all starts
    refined: int = 8  # of the starts
    reach_mm: tuple[float, float, float] = (25.0, 10.0, 5.0)  # pairs: first pass, second, third
    cloud_share: float = 0.9  # of the cloud's points believed to show the organ
    seen_share: float = 0.8  # of the visible surface believed to be in the cloud


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points spread evenly over a surface and its outward unit normals there."""

    points_mm: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]

    def faces(self, eye_mm: Point) -> Bool[np.ndarray, " n"]:
        return np.einsum("ij,ij->i", self.normals, eye_mm - self.points_mm) > 0


def surface_points(mesh: Mesh, spacing_mm: float) -> SurfacePoints:
    """Vertices thinned to about one per cube of ``spacing_mm`` (the first by index)."""
    cube = np.floor(mesh.vertices_mm / spacing_mm).astype(np.int64)
    _, first = np.unique(cube, axis=0, return_index=True)
    kept = np.sort(first)
    return SurfacePoints(mesh.vertices_mm[kept], vertex_normals(mesh)[kept])


def vertex_normals(mesh: Mesh) -> Points:
    """Outward unit normals: the mean of each vertex's triangles, by area."""
    normals, doubled = (
        np.zeros_like(mesh.vertices_mm),
        triangles_of(mesh.vertices_mm, mesh.faces)[1],
    )
    for corner in mesh.faces.T:
        np.add.at(normals, corner, doubled)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def seen_from(
    visibility: Visibility, surface: SurfacePoints, camera_from_ct: Transform
) -> Bool[np.ndarray, " n"]:
    """Which surface points the camera sees: turned towards it and not hidden by the organ."""
    eye_ct = np.linalg.inv(camera_from_ct)[:3, 3]
    towards = surface.faces(eye_ct)
    visible = np.zeros(len(towards), bool)
    visible[towards] = visibility(surface.points_mm[towards], eye_ct)
    return visible


def trimmed_mean(values: Float[np.ndarray, " n"], kept_share: float) -> float:
    """The mean of the smallest ``kept_share`` of the values."""
    count = max(1, round(kept_share * len(values)))
    return float(np.partition(values, count - 1)[:count].mean())


class Pose(NamedTuple):
    """A rigid candidate; ``error_mm``: of ``PoseSearch.error_mm``."""

    camera_from_ct: Transform
    error_mm: float
    start: int


class PoseSearch:
    """Starts, ICP and selection; what needs no cloud is prepared on construction."""

    def __init__(self, anatomy_ct: Anatomy, up_lps: Direction, config: RigidConfig) -> None:
        import small_gicp

        self.config = config
        self.surface = surface_points(anatomy_ct.organ, config.spacing_mm)
        self.visibility = Visibility(anatomy_ct.organ)
        # ICP works about the organ's middle: turns about a far origin make it stall.
        self._middle = self.surface.points_mm.mean(0)
        self._ct_from_middle = rigid(np.eye(3), self._middle)
        middle_from_ct = np.linalg.inv(self._ct_from_middle)
        points = transform_points(middle_from_ct, self.surface.points_mm)
        self._target = small_gicp.PointCloud(points)
        self._target_tree = small_gicp.KdTree(self._target)
        small_gicp.estimate_normals(self._target, self._target_tree, 10)
        self._tree = cKDTree(self.surface.points_mm)
        self._starts = [self._start(turn) for turn in _rotations(config, np.array(up_lps))]

    def poses(self, cloud: SensorCloud) -> list[Pose]:
        """The refined poses, best first, no two alike. Raises NoEstimate: fewer than 20 points."""
        points = cloud.points_mm.astype(float)
        if len(points) < _FEWEST_POINTS:
            raise NoEstimate(
                f"the cloud has {len(points)} points; registration needs {_FEWEST_POINTS}."
            )
        few = points[:: max(1, len(points) // self.config.coarse_points)]
        first, *then = self.config.reach_mm
        coarse = []
        for number, (rotation, anchor_ct) in enumerate(self._starts):
            start = rigid(rotation, _anchor(points) - rotation @ anchor_ct)
            placed = self._icp(few, start, first)
            coarse.append(Pose(placed, self.error_mm(few, placed), number))
        fine = []
        for pose in self._distinct(coarse)[: self.config.refined]:
            placed = pose.camera_from_ct
            for reach_mm in then:
                placed = self._icp(points, placed, reach_mm)
            placed = self._polished(points, placed, then[-1])
            fine.append(Pose(placed, self.error_mm(points, placed), pose.start))
        return self._distinct(fine)

    def error_mm(self, points: Points, camera_from_ct: Transform) -> float:
        """Trimmed mean distance of the cloud to the surface, and of what the camera should see
        of the surface to the cloud: a cloud alone fits anywhere on a larger flat side."""
        ct_from_camera = np.linalg.inv(camera_from_ct)
        points_ct = transform_points(ct_from_camera, points)
        out = self._tree.query(points_ct)[0]
        seen_ct = transform_points(ct_from_camera, self.seen(points, camera_from_ct))
        if len(seen_ct) == 0:
            return float("inf")
        back = cKDTree(points_ct).query(seen_ct)[0]
        config = self.config
        return trimmed_mean(out, config.cloud_share) + trimmed_mean(back, config.seen_share)

    def seen(self, points: Points, camera_from_ct: Transform) -> Points:
        """Points of the undeformed surface that the camera should see and that lie nearer than the
        depth where the cloud was cropped; camera frame."""
        visible = seen_from(self.visibility, self.surface, camera_from_ct)
        placed = transform_points(camera_from_ct, self.surface.points_mm[visible])
        return placed[placed[:, 2] < np.percentile(points[:, 2], CROP_PERCENT)]

    def _start(self, rotation: Rotation3) -> tuple[Rotation3, Point]:
        """A rotation, and the model's point that the cloud's anchor meets: that of the surface
        seen from straight above."""
        turned = self.surface.points_mm @ rotation.T
        middle = (turned.min(0) + turned.max(0)) / 2
        shift = np.array([*-middle[:2], self.config.distance_mm - turned[:, 2].min()])
        visible = seen_from(self.visibility, self.surface, rigid(rotation, shift))
        return rotation, _anchor(turned[visible]) @ rotation

    def _icp(self, points: Points, camera_from_ct: Transform, reach_mm: float) -> Transform:
        import small_gicp

        middle_from_camera = np.linalg.inv(camera_from_ct @ self._ct_from_middle)
        placed = transform_points(middle_from_camera, points)
        result = small_gicp.align(
            self._target,
            small_gicp.PointCloud(placed),
            self._target_tree,
            np.eye(4),
            registration_type="PLANE_ICP",
            max_correspondence_distance=reach_mm,
            max_iterations=30,
            translation_epsilon=1e-4,
            rotation_epsilon=1e-5,
        )
        ct_from_camera = self._ct_from_middle @ result.T_target_source @ middle_from_camera
        return np.linalg.inv(ct_from_camera)

    def _polished(self, points: Points, camera_from_ct: Transform, reach_mm: float) -> Transform:
        """Point-to-plane ICP with the mesh's own normals and Tukey weights: small_gicp estimates
        normals from neighbours, which leaves an error of half a millimetre."""
        middle = self._middle
        for _ in range(_POLISH):
            placed = transform_points(np.linalg.inv(camera_from_ct), points)
            distance, index = self._tree.query(placed)
            normal, at = self.surface.normals[index], self.surface.points_mm[index]
            rows = np.concatenate([np.cross(at - middle, normal), normal], axis=1)
            residual = np.einsum("ij,ij->i", normal, placed - at)
            scaled = rows.T * tukey(distance, reach_mm)
            step = np.linalg.solve(scaled @ rows + 1e-6 * np.eye(6), scaled @ residual)
            camera_from_ct = camera_from_ct @ turned_about(middle, step)
        return camera_from_ct

    def _distinct(self, poses: list[Pose]) -> list[Pose]:
        """By error, without those that lie within 8 degrees and 5 mm of a better one."""
        kept: list[Pose] = []
        for pose in sorted(poses, key=lambda pose: pose.error_mm):
            for other in kept:
                ct_from_ct = np.linalg.inv(other.camera_from_ct) @ pose.camera_from_ct
                turn = Rotation.from_matrix(ct_from_ct[:3, :3]).magnitude()
                shift = transform_points(ct_from_ct, self._middle[None])[0] - self._middle
                if np.degrees(turn) < _ALIKE_DEG and np.linalg.norm(shift) < _ALIKE_MM:
                    break
            else:
                kept.append(pose)
        return kept


def tukey(distance: Float[np.ndarray, " n"], reach: float) -> Float[np.ndarray, " n"]:
    """Tukey's biweight: 1 at no distance, 0 beyond the reach."""
    return (1 - np.minimum(distance / reach, 1) ** 2) ** 2


def turned_about(middle: Point, step: Float64[np.ndarray, " 6"]) -> Transform:
    """A rotation vector about a point, then a shift."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return rigid(turn, middle + step[3:] - turn @ middle)


def _anchor(points: Points) -> Point:
    """Middle of the view, at the depth of its nearest part: both survive a crop in depth."""
    return np.array([*np.median(points[:, :2], axis=0), np.percentile(points[:, 2], 5)])


def _rotations(config: RigidConfig, up_lps: Point) -> list[Rotation3]:
    """Rotations ``camera_from_ct`` to start from."""
    spins = np.arange(config.turns) * 2 * np.pi / config.turns
    turns = Rotation.from_rotvec(spins[:, None] * [0.0, 0.0, 1.0])
    facing = rotation_onto(up_lps, _TOWARDS_CAMERA)
    tilts = config.tilt_deg * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    sides = [Rotation.from_euler("xy", t, degrees=True).as_matrix() @ facing for t in tilts]
    return [turn @ side for side in sides for turn in turns.as_matrix()]
