"""How an organ is located by its elastic body, as frozen values, and the preset for it."""

from __future__ import annotations

from typing import Literal

from tumortrack.core.config import Config
from tumortrack.core.types import Anatomy
from tumortrack.registration.base_model import ModelConfig
from tumortrack.simulation.clutter import ClutterConfig
from tumortrack.simulation.deform import ElasticConfig
from tumortrack.simulation.noise import D405_NOISE, CalibrationConfig
from tumortrack.simulation.occlusion import OcclusionConfig
from tumortrack.simulation.scene import PoseConfig, SceneConfig

Rotations = Literal["full", "limited"]


class GaussNewtonConfig(Config, frozen=True):
    """``n_effective``: independent points in a cloud: errors of neighbours are correlated.
    ``sigma_mm``: of a point that belongs to the organ, model errors included. ``first_mm`` and
    ``last_mm``: the robust kernel's width falls from the one to the other; a point pulls most at
    0.58 of it, and points far beyond do not count. ``shift_mm``, ``turn_rad``: how far a hypothesis
    may be off."""

    steps: int = 20
    n_effective: float = 300.0
    sigma_mm: float = 1.0
    first_mm: float = 5.0
    last_mm: float = 1.0
    narrowing: float = 0.7
    shift_mm: float = 20.0
    turn_rad: float = 0.5
    enough_mm: float = 0.02  # a step that moves less is the last

    def __post_init__(self) -> None:
        self.check_between(
            "refine",
            steps=(0, 1000),
            n_effective=(1, 1e6),
            sigma_mm=(0.01, 100),
            first_mm=(0.01, 1000),
            last_mm=(0.01, 1000),
            narrowing=(0.01, 1),
            shift_mm=(0.01, 1000),
            turn_rad=(0.001, 10),
            enough_mm=(0, 10),
        )


class RegistrationConfig(ModelConfig, frozen=True):
    """Everything that decides a model that registers an elastic body, apart from case and seed.

    Attributes:
        scene: what is seen of the organ: how it may lie, its states, the camera and its errors.
        refine: how the body is fitted to a cloud.
        scenes: simulated ones on whose right fits the usual cost is calibrated; of them the organ
            is ``searched`` for in so many, on which standard deviations are.
    """

    scene: SceneConfig
    refine: GaussNewtonConfig = GaussNewtonConfig()
    scenes: int = 96
    searched: int = 32

    def __post_init__(self) -> None:
        self.check_between("calibration", scenes=(1, 10_000), searched=(1, self.scenes))


def elastic(
    anatomy: Anatomy, rotations: Rotations = "limited", tilt_degrees: float = 30.0
) -> RegistrationConfig:
    """The default: an elastic body is registered, and calibrated on scenes with sensor errors,
    occlusion and background. ``tilt_degrees``: about either axis across the line of sight."""
    scene = SceneConfig(
        pose=PoseConfig(rotations=rotations, tilt_deg=tilt_degrees),
        deform=(ElasticConfig(),),
        clutter=ClutterConfig(scenes=0.5, largest_share=0.15),
        noise=D405_NOISE,
        occlusion=OcclusionConfig(scenes=0.6, largest_share=0.6, left_in=0.15),
        calibration=CalibrationConfig(offset_mm=2.0, scale=0.01),
        cloud_points=(500, 5000),
        free_range=0.6,
        free_nearest_mm=(80.0, 300.0),
    )
    return RegistrationConfig(scene=scene.seen_whole(anatomy))
