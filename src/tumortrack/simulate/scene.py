"""One scene from a recipe: pose, deformation, depth image, cloud, labelled points.

A recipe is (seed, stream, index); with the case and the configuration it replays bit for bit on
the same machine and the same versions. Elsewhere last digits may differ: compiled code may order
its sums, and the exponential of a drag, as the processor likes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import ConvexHull

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate, TumortrackError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import (
    Anatomy,
    DepthFrame,
    Intrinsics,
    Mesh,
    OccupancySamples,
    SensorCloud,
)
from tumortrack.sense.camera import d405, project
from tumortrack.sense.cloud import FEWEST_POINTS, CloudConfig, cloud_from_depth
from tumortrack.sense.clutter import ClutterConfig, add_clutter
from tumortrack.sense.noise import CalibrationConfig, NoiseConfig, add_noise, miscalibrate
from tumortrack.sense.occlusion import OcclusionConfig, occlude
from tumortrack.sense.render import Visibility, render_depth
from tumortrack.simulate.deform import DeformConfig, DragConfig
from tumortrack.simulate.deform.base import Deformation, View
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import OccupancyConfig, PointSource
from tumortrack.simulate.pose import PoseConfig, sample_pose

STREAMS = ("train", "validation", "test")
ATTEMPTS = 20  # draws of a recipe until one shows enough of the organ


class SceneConfig(Config, frozen=True):
    """How scenes are made.

    A share ``free_range`` of them is seen from any distance and not cropped by depth: a cloud
    that a user has freed of its background himself. The others follow the paper: near 15 cm,
    cropped to 11..15 cm. With ``cloud_points`` each scene's cloud has at most a number of points
    drawn from that range, evenly on a logarithmic scale, instead of ``cloud.n_points``.
    """

    LATER = ("occlusion", "calibration", "cloud_points")

    width: int = 424
    height: int = 240
    pose: PoseConfig = PoseConfig()
    deform: tuple[DeformConfig, ...] = (DragConfig(),)  # each scene takes one, with equal chance
    clutter: ClutterConfig = ClutterConfig()
    noise: NoiseConfig = NoiseConfig()
    cloud: CloudConfig = CloudConfig()
    occupancy: OccupancyConfig = OccupancyConfig()
    free_range: float = 0.0
    free_nearest_mm: tuple[float, float] = (80.0, 250.0)
    occlusion: OcclusionConfig = OcclusionConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    cloud_points: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.cloud_points is None:
            return
        fewest, most = self.cloud_points
        if not FEWEST_POINTS <= fewest <= most:
            raise InputError(
                f"cloud_points is {fewest}..{most}; it must be a rising range from "
                f"{FEWEST_POINTS} points up."
            )


@dataclass(frozen=True)
class SceneRecipe:
    """Names one random scene: streams of the same seed never share a scene."""

    seed: int
    stream: Literal["train", "validation", "test"]
    index: int

    def __post_init__(self) -> None:
        if self.seed < 0 or self.index < 0:
            raise InputError(
                f"seed {self.seed} and index {self.index} of a scene must be 0 or more."
            )

    def generator(self, attempt: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, STREAMS.index(self.stream), self.index, attempt])


@dataclass(frozen=True, eq=False)
class Pair:
    """What training needs of a scene."""

    recipe: SceneRecipe
    cloud: SensorCloud
    samples: OccupancySamples
    camera_from_ct: Float64[np.ndarray, "4 4"]  # the organ's pose, its deformation left out


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is drawn before a picture is taken."""

    free: bool  # seen from any distance and not cropped
    camera_from_ct: Float64[np.ndarray, "4 4"]
    deformation: Deformation


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """A scene before points are asked for: what lies where, and what the camera gets of it."""

    camera_from_ct: Float64[np.ndarray, "4 4"]
    deformation: Deformation
    frame: DepthFrame
    cloud: SensorCloud

    def carry(self, points_ct: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points of the undeformed CT frame at their place before the camera."""
        return transform_points(self.camera_from_ct, self.deformation.apply(points_ct))


class Simulator:
    """Makes the scenes of one anatomy (CT frame, LPS mm); ``body`` where the configuration has
    elastic deformations (``simulate.bodies.body_for`` builds it)."""

    def __init__(
        self,
        anatomy_ct: Anatomy,
        up_lps: tuple[float, float, float],
        config: SceneConfig,
        body: ElasticBody | None = None,
    ) -> None:
        self.anatomy_ct = anatomy_ct
        self._body = body
        self.config = config
        self._up_lps = up_lps
        self._intrinsics = d405(config.width, config.height)
        self._visibility = Visibility(anatomy_ct.organ)
        vertices = anatomy_ct.organ.vertices_mm
        corners = vertices[ConvexHull(vertices).vertices]  # no others are its farthest anywhere
        self._hull_ct = Mesh(corners, np.empty((0, 3)))

    def pair(self, recipe: SceneRecipe, pool: PointSource) -> Pair:
        """The scene's cloud and its labelled points, camera frame."""
        stage, rng = self._stage(recipe)
        points_ct, labels = pool.draw(rng)
        samples = OccupancySamples(stage.carry(points_ct), labels)
        return Pair(recipe, stage.cloud, samples, stage.camera_from_ct)

    def stage(self, recipe: SceneRecipe) -> RenderedScene:
        """Pose, deformation, depth image and cloud of a recipe."""
        return self._stage(recipe)[0]

    def reference(self, stage: RenderedScene) -> Anatomy:
        """The anatomy as it lies in the scene, camera frame."""
        return Anatomy(
            tuple(part.moved(stage.carry(part.vertices_mm)) for part in self.anatomy_ct.parts)
        )

    def _stage(self, recipe: SceneRecipe) -> tuple[RenderedScene, np.random.Generator]:
        for attempt in range(ATTEMPTS):
            rng = recipe.generator(attempt)
            try:
                return self._attempt(rng), rng
            except NoEstimate:  # the crop left too few points: another draw of the same recipe
                continue
        raise shows_nothing(recipe)

    def draw(self, rng: np.random.Generator) -> Drawn:
        """Pose and deformation of the next scene of this generator."""
        config = self.config
        free = bool(rng.uniform() < config.free_range)
        nearest = config.free_nearest_mm if free else config.pose.nearest_mm
        camera_from_ct = sample_pose(config.pose, self._hull_ct, self._up_lps, nearest, rng)
        model = config.deform[rng.integers(len(config.deform))]
        visible = _visible_from(self._visibility, self._intrinsics, camera_from_ct)
        view = View(self.anatomy_ct, visible, self._body)
        return Drawn(free, camera_from_ct, model.sample(view, rng))

    def _attempt(self, rng: np.random.Generator) -> RenderedScene:
        config, organ = self.config, self.anatomy_ct.organ
        drawn = self.draw(rng)
        camera_from_ct, deformation = drawn.camera_from_ct, drawn.deformation
        vertices = transform_points(camera_from_ct, deformation.apply(organ.vertices_mm))
        frame = render_depth(vertices, organ.faces, self._intrinsics)
        frame = add_clutter(frame, config.clutter, rng)
        frame = occlude(frame, config.occlusion, rng)  # hides background too
        frame = miscalibrate(frame, config.calibration, rng)
        frame = add_noise(frame, config.noise, rng)
        crop = crop_of(config, drawn.free, rng)
        return RenderedScene(camera_from_ct, deformation, frame, cloud_from_depth(frame, crop, rng))


def shows_nothing(recipe: SceneRecipe) -> TumortrackError:
    return TumortrackError(
        f"{recipe}: no pose in {ATTEMPTS} shows enough of the organ; check the camera's range and "
        "the distances in the scene configuration."
    )


def crop_of(config: SceneConfig, free: bool, rng: np.random.Generator) -> CloudConfig:
    """What of this scene's image becomes the cloud."""
    near_mm, far_mm = (1.0, 1e4) if free else (config.cloud.near_mm, config.cloud.far_mm)
    n_points = config.cloud.n_points
    if config.cloud_points is not None:
        fewest, most = config.cloud_points
        n_points = round(math.exp(rng.uniform(math.log(fewest), math.log(most))))
    return CloudConfig(near_mm=near_mm, far_mm=far_mm, n_points=n_points)


def _visible_from(
    visibility: Visibility, intrinsics: Intrinsics, camera_from_ct: Float64[np.ndarray, "4 4"]
) -> Callable[[np.ndarray], np.ndarray]:
    eye_ct = np.linalg.inv(camera_from_ct)[:3, 3]

    def visible(points_ct: np.ndarray) -> np.ndarray:
        pixels, depth = project(transform_points(camera_from_ct, points_ct), intrinsics)
        size = np.array([intrinsics.width, intrinsics.height])
        pictured = ((pixels > -0.5) & (pixels < size - 0.5)).all(1) & (depth > 0)
        return pictured & visibility(points_ct, eye_ct)

    return visible
