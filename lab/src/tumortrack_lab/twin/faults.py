"""Single sources of error, made from a clean scene of the twin: each alone, and all together.

They answer what the paper could not: how much of the error is the sensor's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy, DepthFrame
from tumortrack.sense.cloud import cloud_from_depth
from tumortrack.sense.noise import D405_NOISE, NoiseConfig, add_noise
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.twin.props import add_background, occlude, shaft_over
from tumortrack_lab.twin.variants import ViewConfig

Fault = Literal[
    "clean",
    "noise",
    "distortion",
    "offset",
    "occlusion",
    "outliers",
    "registration",
    "all",
]
FAULTS: tuple[Fault, ...] = get_args(Fault)

# The axial noise and depth steps of the D405 model, and nothing else of it.
AXIAL_NOISE = NoiseConfig(
    axial_mm=D405_NOISE.axial_mm,
    correlated_share=D405_NOISE.correlated_share,
    quantum_mm=D405_NOISE.quantum_mm,
)
DISTORTION_MM = 1.0  # largest slow depth error in the image
OFFSET_MM = 2.0  # towards the camera: the thickness of the paper's soft cardboard
REGISTRATION_MM, REGISTRATION_DEGREES = 1.0, 1.0

_Change = Callable[[DepthFrame, ViewConfig, np.random.Generator], DepthFrame]


def faulty(clean: Scene, fault: str, seed: int) -> Scene:
    """The scene as it would have been with this fault; ``clean`` itself without any.

    - noise: axial noise and depth steps. distortion: a slow depth error of at most 1 mm.
    - offset: every depth 2 mm less. occlusion: an 8 mm instrument shaft.
    - outliers: 3 % background points.
    - registration: the truth lies 1 mm and 1 degree off, in random directions about the organ's
      centre; ``meta["registration"]`` is the transform that moved it.
    - all: these together.

    The fault's random numbers depend on seed and fault alone, and are the same in ``all``. The
    cloud is drawn from the depth image again, by the scene's own crop; a scene that was read from
    its folder has depths in steps of 0.1 mm.

    Raises:
        InputError: no such fault, or no clean scene of the twin with its depth image.
    """
    if fault not in FAULTS:
        raise InputError(f"fault {fault!r} is not known; allowed: {', '.join(FAULTS)}.")
    frame, config = clean_view(clean)
    if fault == "clean":
        return clean
    for name, change in _IN_ORDER.items():
        if fault in (name, "all"):
            frame = change(frame, config, _rng(seed, name))
    cloud = clean.cloud
    if frame is not clean.depth:
        cloud = cloud_from_depth(frame, config.crop, np.random.default_rng([seed, len(FAULTS)]))
    reference, targets = clean.reference, clean.targets
    meta = {**clean.meta, "fault": fault, "fault_seed": seed}
    if fault in ("registration", "all"):
        moved = registration_error(clean.reference, _rng(seed, "registration"))
        reference = Anatomy(
            tuple(p.moved(transform_points(moved, p.vertices_mm)) for p in reference.parts)
        )
        if targets:
            targets = replace(targets, points_mm=transform_points(moved, targets.points_mm))
        meta["registration"] = moved.tolist()
    return Scene(cloud, reference, frame, meta, targets)


def clean_view(clean: Scene) -> tuple[DepthFrame, ViewConfig]:
    """The depth image of a clean scene, and how it was taken.

    Raises:
        InputError: no clean scene of the twin with its depth image.
    """
    if clean.depth is None or clean.meta.get("view") != "clean" or "fault" in clean.meta:
        raise InputError(
            "faults are made from clean scenes of the twin with their depth image: the folders "
            "VARIANT-clean that `tumortrack twin` writes."
        )
    config = from_builtins(clean.meta.get("view_config"), ViewConfig, "meta.json, view_config")
    return clean.depth, config


def registration_error(reference: Anatomy, rng: np.random.Generator) -> Float64[np.ndarray, "4 4"]:
    """A rigid motion by 1 mm and 1 degree about the organ's centre, both directions uniform."""
    centre = reference.organ.box_mm.mean(0)
    shift, axis = rng.standard_normal((2, 3))
    shift *= REGISTRATION_MM / np.linalg.norm(shift)
    axis *= np.deg2rad(REGISTRATION_DEGREES) / np.linalg.norm(axis)
    rotation = Rotation.from_rotvec(axis).as_matrix()
    return rigid(rotation, centre + shift - rotation @ centre)


def _offset(frame: DepthFrame, config: ViewConfig, rng: np.random.Generator) -> DepthFrame:
    return DepthFrame(frame.depth_mm - OFFSET_MM, frame.intrinsics, frame.stamp_ns)


def _occlusion(frame: DepthFrame, config: ViewConfig, rng: np.random.Generator) -> DepthFrame:
    return occlude(frame, shaft_over(frame, config.shaft_radius_mm, rng))[0]


def _outliers(frame: DepthFrame, config: ViewConfig, rng: np.random.Generator) -> DepthFrame:
    return add_background(frame, config.clutter_share, config.far_mm, rng)[0]


def _distortion(frame: DepthFrame, config: ViewConfig, rng: np.random.Generator) -> DepthFrame:
    """The sensor model's slow field at its full height, in every scene."""
    from tumortrack.sense.kernels import slow_shape

    shape = (frame.intrinsics.height, frame.intrinsics.width)
    field, scale = slow_shape(shape, DISTORTION_MM, rng)
    return frame.with_depth(frame.depth_mm + field * scale)


def _noise(frame: DepthFrame, config: ViewConfig, rng: np.random.Generator) -> DepthFrame:
    return add_noise(frame, AXIAL_NOISE, rng)


# First what lies before the sensor, then the sensor itself, stored steps last.
_IN_ORDER: dict[str, _Change] = {
    "offset": _offset,
    "occlusion": _occlusion,
    "outliers": _outliers,
    "distortion": _distortion,
    "noise": _noise,
}


def _rng(seed: int, fault: Fault | str) -> np.random.Generator:
    return np.random.default_rng([seed, list(FAULTS).index(fault)])  # type: ignore[arg-type]
