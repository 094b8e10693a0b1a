"""Rigid registration from many starts: ICP of the cloud to the surface, the best fit wins.

Point-to-plane ICP by small_gicp (Koide 2024, doi 10.21105/joss.06948). ICP converges to the
nearest minimum only, so the starts cover the rotations that the surgeon's knowledge leaves open.
The best poses are also the starts of every deformable peer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.config import Config
from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import rigid, rotation_onto, transform_points
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.sense.render import Visibility
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import Fit, rigid_carry, stopwatch
from tumortrack_lab.peers.surface import seen_from, surface_points, trimmed_mean

_TOWARDS_CAMERA = np.array([0.0, 0.0, -1.0])
CROP_PERCENT = 98.0  # of the cloud's depths: beyond, nothing was kept (or it is noise)
_POLISH = 20  # iterations
_ALIKE_DEG, _ALIKE_MM = 8.0, 5.0
_FEWEST_POINTS = 20
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


class RigidConfig(Config, frozen=True):
    """How a rigid pose is searched.

    ``facing``: the side that faces the camera is known, the turn about the camera's axis is not
    (the paper's M_lim). ``unknown``: any rotation (its M_full).
    """

    orientation: Literal["facing", "unknown"] = "facing"
    turns: int = 24  # about the camera's axis
    tilt_deg: float = 12.0  # four more starts of each turn, tilted by this (facing)
    sides: int = 40  # directions that may face the camera (unknown)
    spacing_mm: float = 2.0  # of the model's surface points
    distance_mm: float = 120.0  # from the camera to the organ's nearest point, in the starts
    coarse_points: int = 250  # of the cloud, for the first pass over all starts
    refined: int = 8  # of the starts
    reach_mm: tuple[float, float, float] = (25.0, 10.0, 5.0)  # pairs: first pass, second, third
    cloud_share: float = 0.9  # of the cloud's points believed to show the organ
    seen_share: float = 0.8  # of the visible surface believed to be in the cloud


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid candidate: ``error_mm`` is what ``PoseSearch.error_mm`` says of it."""

    camera_from_ct: Float64[np.ndarray, "4 4"]
    error_mm: float
    start: int


class Rigid:
    """The best rigid pose as a peer."""

    def __init__(
        self,
        anatomy_ct: Anatomy,
        up_lps: tuple[float, float, float],
        config: RigidConfig | None = None,
    ) -> None:
        config = config or RigidConfig()
        self.name = "rigid" if config.orientation == "facing" else "rigid_any_rotation"
        with stopwatch() as watch:
            self._search = PoseSearch(anatomy_ct, up_lps, config)
        self.prepare_s = watch.seconds

    def fit(self, scene: Scene) -> Fit:
        """The pose of least error.

        Raises:
            NoEstimate: fewer than 20 points.
        """
        with stopwatch() as watch:
            best = self._search.poses(scene.cloud)[0]
        report = {"start": best.start, "residual_mm": best.error_mm}
        return Fit(rigid_carry(best.camera_from_ct), watch.seconds, report)


class PoseSearch:
    """Starts, ICP and choice, with everything prepared that does not need a cloud."""

    def __init__(
        self, anatomy_ct: Anatomy, up_lps: tuple[float, float, float], config: RigidConfig
    ) -> None:
        import small_gicp

        self.config = config
        self.surface = surface_points(anatomy_ct.organ, config.spacing_mm)
        self.visibility = Visibility(anatomy_ct.organ)
        # ICP works about the organ's middle: turns about a far origin make it stall.
        self._ct_from_middle = rigid(np.eye(3), self.surface.points_mm.mean(0))
        middle_from_ct = np.linalg.inv(self._ct_from_middle)
        points = transform_points(middle_from_ct, self.surface.points_mm)
        self._target = small_gicp.PointCloud(points)
        self._target_tree = small_gicp.KdTree(self._target)
        small_gicp.estimate_normals(self._target, self._target_tree, 10)
        self._tree = cKDTree(self.surface.points_mm)
        self._starts = [self._start(turn) for turn in _rotations(config, np.array(up_lps))]

    def poses(self, cloud: SensorCloud) -> list[Pose]:
        """The refined poses, best first, no two alike.

        Raises:
            NoEstimate: fewer than 20 points.
        """
        points = cloud.points_mm.astype(float)
        if len(points) < _FEWEST_POINTS:
            raise NoEstimate(
                f"the cloud has {len(points)} points; registration needs {_FEWEST_POINTS}."
            )
        few = points[:: max(1, len(points) // self.config.coarse_points)]
        first, *then = self.config.reach_mm
        coarse = []
        for number, (camera_from_ct, anchor_ct) in enumerate(self._starts):
            camera_from_ct = camera_from_ct.copy()
            camera_from_ct[:3, 3] = _anchor(points) - camera_from_ct[:3, :3] @ anchor_ct
            camera_from_ct = self._icp(few, camera_from_ct, first)
            coarse.append(Pose(camera_from_ct, self.error_mm(few, camera_from_ct), number))
        coarse.sort(key=lambda pose: pose.error_mm)
        fine = []
        for pose in _distinct(coarse, self._ct_from_middle[:3, 3])[: self.config.refined]:
            camera_from_ct = pose.camera_from_ct
            for reach_mm in then:
                camera_from_ct = self._icp(points, camera_from_ct, reach_mm)
            camera_from_ct = self._polished(points, camera_from_ct, then[-1])
            fine.append(Pose(camera_from_ct, self.error_mm(points, camera_from_ct), pose.start))
        fine.sort(key=lambda pose: pose.error_mm)
        return _distinct(fine, self._ct_from_middle[:3, 3])

    def error_mm(
        self, points: Float64[np.ndarray, "n 3"], camera_from_ct: Float64[np.ndarray, "4 4"]
    ) -> float:
        """Trimmed mean distance of the cloud to the surface, and of what the camera should see
        of the surface to the cloud: a cloud alone may hide anywhere in a larger flat side."""
        points_ct = transform_points(np.linalg.inv(camera_from_ct), points)
        out = self._tree.query(points_ct)[0]
        seen_ct = transform_points(np.linalg.inv(camera_from_ct), self.seen(points, camera_from_ct))
        if len(seen_ct) == 0:
            return float("inf")
        back = cKDTree(points_ct).query(seen_ct)[0]
        return trimmed_mean(out, self.config.cloud_share) + trimmed_mean(
            back, self.config.seen_share
        )

    def seen(
        self, points: Float64[np.ndarray, "n 3"], camera_from_ct: Float64[np.ndarray, "4 4"]
    ) -> Float64[np.ndarray, "m 3"]:
        """The surface that the camera should see above the depth where the cloud was cropped,
        camera frame, for the organ as it was in the CT."""
        seen = seen_from(self.visibility, self.surface, camera_from_ct)
        placed = transform_points(camera_from_ct, self.surface.points_mm[seen])
        return placed[placed[:, 2] < np.percentile(points[:, 2], CROP_PERCENT)]

    def _start(
        self, rotation: Float64[np.ndarray, "3 3"]
    ) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, " 3"]]:
        """A pose straight below the camera, and the model's point that the cloud's anchor meets."""
        turned = self.surface.points_mm @ rotation.T
        middle = (turned.min(0) + turned.max(0)) / 2
        shift = np.array([*-middle[:2], self.config.distance_mm - turned[:, 2].min()])
        camera_from_ct = rigid(rotation, shift)
        seen = seen_from(self.visibility, self.surface, camera_from_ct)
        anchor = _anchor(turned[seen]) @ rotation
        return camera_from_ct, anchor

    def _icp(
        self,
        points: Float64[np.ndarray, "n 3"],
        camera_from_ct: Float64[np.ndarray, "4 4"],
        reach_mm: float,
    ) -> Float64[np.ndarray, "4 4"]:
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

    def _polished(
        self,
        points: Float64[np.ndarray, "n 3"],
        camera_from_ct: Float64[np.ndarray, "4 4"],
        reach_mm: float,
    ) -> Float64[np.ndarray, "4 4"]:
        """Point-to-plane once more, with the mesh's own normals and Tukey weights: small_gicp
        estimates normals from neighbours, and those leave half a millimetre."""
        middle = self._ct_from_middle[:3, 3]
        for _ in range(_POLISH):
            placed = transform_points(np.linalg.inv(camera_from_ct), points)
            distance, index = self._tree.query(placed)
            normal, at = self.surface.normals[index], self.surface.points_mm[index]
            weight = (1 - np.minimum(distance / reach_mm, 1) ** 2) ** 2
            rows = np.concatenate([np.cross(at - middle, normal), normal], axis=1)
            residual = np.einsum("ij,ij->i", normal, placed - at)
            scaled = rows.T * weight
            step = np.linalg.solve(scaled @ rows + 1e-6 * np.eye(6), scaled @ residual)
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            camera_from_ct = camera_from_ct @ rigid(turn, middle + step[3:] - turn @ middle)
        return camera_from_ct


def _distinct(ordered: list[Pose], middle_ct: Float64[np.ndarray, " 3"]) -> list[Pose]:
    """Without those that lie within 8 degrees and 5 mm of an earlier one."""
    kept: list[Pose] = []
    for pose in ordered:
        for other in kept:
            ct_from_ct = np.linalg.inv(other.camera_from_ct) @ pose.camera_from_ct
            turn = Rotation.from_matrix(ct_from_ct[:3, :3]).magnitude()
            shift = transform_points(ct_from_ct, middle_ct[None])[0] - middle_ct
            if np.degrees(turn) < _ALIKE_DEG and np.linalg.norm(shift) < _ALIKE_MM:
                break
        else:
            kept.append(pose)
    return kept


def _anchor(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " 3"]:
    """Middle of the view, at the depth of its nearest part: both survive a crop in depth."""
    return np.array([*np.median(points[:, :2], axis=0), np.percentile(points[:, 2], 5)])


def _rotations(
    config: RigidConfig, up_lps: Float64[np.ndarray, " 3"]
) -> list[Float64[np.ndarray, "3 3"]]:
    """Rotations ``camera_from_ct`` to start from."""
    spins = np.arange(config.turns) * 2 * np.pi / config.turns
    turns = Rotation.from_rotvec(spins[:, None] * [0.0, 0.0, 1.0])
    if config.orientation == "unknown":
        sides = [rotation_onto(side, _TOWARDS_CAMERA) for side in _directions(config.sides)]
    else:
        facing = rotation_onto(up_lps, _TOWARDS_CAMERA)
        tilts = config.tilt_deg * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
        sides = [Rotation.from_euler("xy", t, degrees=True).as_matrix() @ facing for t in tilts]
    return [turn @ side for side in sides for turn in turns.as_matrix()]


def _directions(count: int) -> Float64[np.ndarray, "n 3"]:
    """Unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = _GOLDEN_ANGLE * np.arange(count)
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)
