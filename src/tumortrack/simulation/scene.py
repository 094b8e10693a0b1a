"""One scene from a recipe: pose, deformation, depth image, cloud.

A recipe is (seed, stream, index); with the case and the configuration it replays bit for bit on
the same machine and versions. On others the last digits may differ: compiled code may reorder sums
and evaluate the exponential of a drag differently.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float64

from tumortrack.core.camera import d405, project, with_depth_error
from tumortrack.core.cloud import FEWEST_POINTS, CloudConfig, cloud_from_depth
from tumortrack.core.config import Config, check_seed
from tumortrack.core.errors import InputError, NoEstimate, TumortrackError
from tumortrack.core.geometry import rigid, rotation_onto, transform_points
from tumortrack.core.render import Visibility, render_depth
from tumortrack.core.types import Anatomy, DepthFrame, Mesh, SensorCloud
from tumortrack.organ.body import BodyConfig, ElasticBody, build_body, length_over_kidney
from tumortrack.simulation.clutter import ClutterConfig, add_clutter
from tumortrack.simulation.deform import ChainConfig, DragConfig, installed, links_of
from tumortrack.simulation.deform.base import Deformation, Points, View
from tumortrack.simulation.noise import (
    CALIBRATED,
    CalibrationConfig,
    NoiseConfig,
    add_noise,
    miscalibrate,
)
from tumortrack.simulation.occlusion import OcclusionConfig, occlude

STREAMS = ("train", "validation", "test")
_FARTHEST_MM = 500.0  # range of depth cameras for close work
_ATTEMPTS = 20  # draws of a recipe until one shows enough of the organ


class PoseConfig(Config, frozen=True):
    """Random poses of the organ.

    ``full``: every rotation, uniformly (the paper's M_full). ``limited``: any rotation about the
    camera's axis, tilts about X and Y uniform within ``tilt_deg`` of the direction that faces
    the camera (the paper's M_lim, section Experiments).
    """

    rotations: Literal["full", "limited"] = "limited"
    tilt_deg: float = 15.0
    nearest_mm: tuple[float, float] = (110.0, 125.0)  # depth of the organ's nearest point
    sideways_mm: float = 15.0  # the organ's centre may lie this far off the camera's axis

    def __post_init__(self) -> None:
        self.check_between("pose", tilt_deg=(0, 180))


class OccupancyConfig(Config, frozen=True):
    """Labelled points of scenes, for methods that learn from them (``tumortrack_occupancy``)."""

    per_side: int = 256  # k: points kept inside and outside of each part
    box_factor: float = 1.5
    wall_mm: float = 0.2
    far_share: float = 0.15
    far_reach: float = 1.2  # half of the far points: a cube of +- this times the organ's diagonal
    pool: int = 100_000  # points per part that are labelled once


class SceneConfig(Config, frozen=True):
    """How scenes are made.

    A fraction ``free_range`` of them is seen from any distance and not cropped by depth, like a
    cloud whose background the user has removed. The others follow the paper: near 15 cm, cropped
    to 11..15 cm. With ``cloud_points`` the largest number of points in each scene's cloud is drawn
    from that range, log-uniformly, instead of ``cloud.n_points``.
    """

    width: int = 424
    height: int = 240
    pose: PoseConfig = PoseConfig()
    # Each scene has one of these, drawn uniformly.
    deform: tuple[installed.LinkConfig | ChainConfig, ...] = (DragConfig(),)
    clutter: ClutterConfig = ClutterConfig()
    noise: NoiseConfig = NoiseConfig()
    cloud: CloudConfig = CloudConfig()
    occupancy: OccupancyConfig = OccupancyConfig()
    free_range: float = 0.0
    free_nearest_mm: tuple[float, float] = (80.0, 250.0)
    occlusion: OcclusionConfig = OcclusionConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    cloud_points: tuple[int, int] | None = None

    def seen_whole(self, anatomy_ct: Anatomy) -> SceneConfig:
        """The same with distances, which are meant for kidneys, scaled up for a larger organ, so
        that it fills the image as a kidney does."""
        scale = max(1.0, length_over_kidney(anatomy_ct))
        if scale == 1.0:
            return self
        (low, high), (near_mm, far_mm) = self.pose.nearest_mm, self.free_nearest_mm
        replace, cloud = msgspec.structs.replace, self.cloud
        return replace(
            self,
            pose=replace(self.pose, nearest_mm=(scale * low, scale * high)),
            cloud=replace(cloud, near_mm=scale * cloud.near_mm, far_mm=scale * cloud.far_mm),
            free_nearest_mm=(scale * near_mm, max(far_mm, min(scale * far_mm, _FARTHEST_MM))),
        )

    def __post_init__(self) -> None:
        fewest, most = self.cloud_points or (FEWEST_POINTS, FEWEST_POINTS)
        if not FEWEST_POINTS <= fewest <= most:
            raise InputError(
                f"cloud_points is {fewest}..{most}; allowed: rising, from {FEWEST_POINTS} up."
            )


@dataclass(frozen=True)
class SceneRecipe:
    """Names one random scene: streams of the same seed never share a scene."""

    seed: int
    stream: Literal["train", "validation", "test"]
    index: int

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if self.index < 0:
            raise InputError(f"the index of a scene is {self.index}; it must be 0 or more.")

    def generator(self, attempt: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, STREAMS.index(self.stream), self.index, attempt])


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """A scene without labelled points: the organ's pose and deformation, and the camera's view."""

    camera_from_ct: Float64[np.ndarray, "4 4"]  # the organ's pose, without its deformation
    deformation: Deformation
    frame: DepthFrame
    cloud: SensorCloud

    def forward(self, points_ct: Points) -> Points:
        """Points of the undeformed CT in the camera frame."""
        return transform_points(self.camera_from_ct, self.deformation.apply(points_ct))


@dataclass(eq=False)
class Simulator:
    """Makes the scenes of one anatomy (CT frame, LPS mm). A configuration with elastic deformations
    needs a ``body`` (``body_for`` builds it)."""

    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    config: SceneConfig
    body: ElasticBody | None = None

    def __post_init__(self) -> None:
        from scipy.spatial import ConvexHull  # slow to import

        self._intrinsics = d405(self.config.width, self.config.height)
        self._visibility = Visibility(self.anatomy_ct.organ)
        vertices = self.anatomy_ct.organ.vertices_mm
        corners = vertices[ConvexHull(vertices).vertices]  # include the extremes in any direction
        self._hull_ct = Mesh(corners, np.empty((0, 3)))

    def render(self, recipe: SceneRecipe) -> RenderedScene:
        return self.draw(recipe)[0]

    def reference(self, scene: RenderedScene) -> Anatomy:
        """The anatomy as it lies in the scene, camera frame."""
        parts = (
            part.with_vertices(scene.forward(part.vertices_mm)) for part in self.anatomy_ct.parts
        )
        return self.anatomy_ct.with_parts(parts)

    def draw(self, recipe: SceneRecipe) -> tuple[RenderedScene, np.random.Generator]:
        """``render``, and the recipe's generator, for what else is drawn of the scene."""
        config, organ = self.config, self.anatomy_ct.organ
        for attempt in range(_ATTEMPTS):
            rng = recipe.generator(attempt)
            free = bool(rng.uniform() < config.free_range)
            nearest_mm = config.free_nearest_mm if free else config.pose.nearest_mm
            camera_from_ct = sample_pose(config.pose, self._hull_ct, self.up_lps, nearest_mm, rng)
            model = config.deform[rng.integers(len(config.deform))]
            deformation = model.sample(self._view(camera_from_ct), rng)
            vertices = transform_points(camera_from_ct, deformation.apply(organ.vertices_mm))
            frame = render_depth(vertices, organ.faces, self._intrinsics)
            frame = add_clutter(frame, config.clutter, rng)
            frame = occlude(frame, config.occlusion, rng)  # hides background too
            frame = miscalibrate(frame, config.calibration, rng)
            frame = add_noise(frame, config.noise, rng)
            if config.calibration == CALIBRATED:
                frame = with_depth_error(frame, config.noise.depth_error)
            try:
                cloud = cloud_from_depth(frame, self._crop(free, rng), rng)
            except NoEstimate:  # the crop left too few points: another draw of the same recipe
                continue
            return RenderedScene(camera_from_ct, deformation, frame, cloud), rng
        raise TumortrackError(
            f"{recipe}: no pose in {_ATTEMPTS} shows enough of the organ; check the camera's range "
            "and the distances in the scene configuration."
        )

    def _crop(self, free: bool, rng: np.random.Generator) -> CloudConfig:
        """The depth range and number of points of this scene's cloud."""
        cloud, n_points = self.config.cloud, self.config.cloud.n_points
        if self.config.cloud_points is not None:
            fewest, most = self.config.cloud_points
            n_points = round(math.exp(rng.uniform(math.log(fewest), math.log(most))))
        near_mm, far_mm = (1.0, 1e4) if free else (cloud.near_mm, cloud.far_mm)
        return CloudConfig(near_mm=near_mm, far_mm=far_mm, n_points=n_points)

    def _view(self, camera_from_ct: Float64[np.ndarray, "4 4"]) -> View:
        eye_ct, camera = np.linalg.inv(camera_from_ct)[:3, 3], self._intrinsics

        def visible(points_ct: np.ndarray) -> np.ndarray:
            pixels, depth = project(transform_points(camera_from_ct, points_ct), camera)
            size = np.array([camera.width, camera.height])
            in_view = ((pixels > -0.5) & (pixels < size - 0.5)).all(1) & (depth > 0)
            return in_view & self._visibility(points_ct, eye_ct)

        return View(self.anatomy_ct, visible, self.body)


def sample_pose(
    config: PoseConfig,
    organ_ct: Mesh,
    up_lps: tuple[float, float, float],
    nearest_mm: tuple[float, float],
    rng: np.random.Generator,
) -> Float64[np.ndarray, "4 4"]:
    """Draw ``camera_from_ct``; the organ's nearest point gets a depth within ``nearest_mm``."""
    if config.rotations == "full":
        from scipy.spatial.transform import Rotation

        rotation = Rotation.random(rng=rng).as_matrix()
    else:
        spin = rng.uniform(0, 360)
        tilt_x, tilt_y = rng.uniform(-config.tilt_deg, config.tilt_deg, 2)
        rotation = _turn(*np.radians([tilt_x, tilt_y, spin])) @ _facing(up_lps)
    rotated = rotation @ organ_ct.vertices_mm.T  # (3, v): minima along rows are fast
    lower, upper = rotated.min(1), rotated.max(1)
    offset = rng.uniform(-config.sideways_mm, config.sideways_mm, 2)
    nearest = rng.uniform(*nearest_mm)
    centre = (lower + upper) / 2
    return rigid(rotation, np.array([*(offset - centre[:2]), nearest - lower[2]]))


def _turn(about_x: float, about_y: float, about_z: float) -> Float64[np.ndarray, "3 3"]:
    """A rotation about z, then y, then x, all fixed axes; radians. (A single SciPy Rotation takes a
    twentieth of a scene's time.)"""
    sx, sy, sz = np.sin([about_x, about_y, about_z]).tolist()
    cx, cy, cz = np.cos([about_x, about_y, about_z]).tolist()
    first = [cy * cz, -cy * sz, sy]
    second = [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy]
    third = [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy]
    return np.array([first, second, third])


@lru_cache(maxsize=64)
def _facing(up_lps: tuple[float, float, float]) -> Float64[np.ndarray, "3 3"]:
    """The rotation that turns the organ's upper side towards the camera."""
    turn = rotation_onto(np.array(up_lps), np.array([0.0, 0.0, -1.0]))
    turn.flags.writeable = False
    return turn


def body_for(
    anatomy_ct: Anatomy, up_lps: tuple[float, float, float], config: SceneConfig, seed: int
) -> ElasticBody | None:
    """The organ's elastic body if a deformation of the configuration needs one, else None.

    With ``full`` rotations the organ's bed lies on any side of it. Raises InputError: deformations
    with different bodies.
    """
    links = (link for model in config.deform for link in links_of(model))
    bodies = (getattr(link, "body", None) for link in links)
    configs = {body for body in bodies if isinstance(body, BodyConfig)}
    if len(configs) > 1:
        raise InputError(
            "the scene configuration has elastic deformations with different bodies; give them "
            "all the same `body`."
        )
    if not configs:
        return None
    body = configs.pop()
    if config.pose.rotations == "full":
        body = msgspec.structs.replace(body, bed_anywhere=1.0)
    return build_body(anatomy_ct, up_lps, body, seed)
