"""The named configuration of the default method: a Python value of a case."""

from __future__ import annotations

from typing import Literal

from tumortrack.core.types import Anatomy
from tumortrack.registration.config import RegistrationConfig
from tumortrack.sense.clutter import ClutterConfig
from tumortrack.sense.noise import D405_NOISE, CalibrationConfig
from tumortrack.sense.occlusion import OcclusionConfig
from tumortrack.simulate.deform import ElasticConfig
from tumortrack.simulate.scene import PoseConfig, SceneConfig

Rotations = Literal["full", "limited"]
TILT_DEGREES = 30.0  # about either axis across the line of sight


def clinic(
    anatomy: Anatomy, rotations: Rotations = "limited", tilt_degrees: float = TILT_DEGREES
) -> RegistrationConfig:
    """The default: an elastic body is registered, and calibrated on scenes with sensor errors,
    occlusion and background."""
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
