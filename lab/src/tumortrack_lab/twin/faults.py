"""Faults of the sensor and the view, made from a clean scene of the twin.

A fault such as ``noise`` is a single source of error at its usual size, or all of them together:
how much of the error is the sensor's. A severity such as ``noise=2`` or ``visible=60`` is one kind
of fault in degrees: how the error grows. All levels of a kind share their random draws, so that
the same shaft reaches farther, and the same noise grows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from msgspec import structs
from scipy.spatial.transform import Rotation

from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import DepthFrame
from tumortrack.sense.cloud import CloudConfig, cloud_from_depth, thin_cloud
from tumortrack.sense.noise import D405_NOISE, NoiseConfig, add_noise
from tumortrack.sense.render import render_depth
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.twin.apparatus import moved
from tumortrack_lab.twin.occluders import add_background, hide_share, occlude, shaft_over
from tumortrack_lab.twin.views import ViewConfig

# Streams of random numbers go by the order of these two: append only.
FAULTS = (
    "clean", "noise", "distortion", "offset", "occlusion", "outliers", "registration", "all"
)  # fmt: skip
# Lowest and highest level allowed, and the level that is the clean scene (None: no level is).
_LIMITS: dict[str, tuple[float, float, float | None]] = {
    "noise": (0.0, 10.0, 0.0),  # the sensor model's amplitudes, times this (shares end at 1)
    "visible": (10.0, 100.0, 100.0),  # percent of the visible surface that occluders leave
    "outliers": (0.0, 40.0, 0.0),  # percent of all points that are background
    "points": (200.0, 5000.0, 5000.0),  # of the cloud
    "offset": (-20.0, 20.0, 0.0),  # mm that every depth is too small
    "distance": (60.0, 500.0, None),  # mm, camera to the organ's nearest point, along its axis
    "tilt": (0.0, 75.0, 0.0),  # degrees, the camera about the organ's centre; axis in the image
}
KINDS = tuple(_LIMITS)

# The axial noise and depth steps of the D405 model, and nothing else of it.
_AXIAL = ("axial_mm", "correlated_share", "quantum_mm")
AXIAL_NOISE = NoiseConfig(**{name: getattr(D405_NOISE, name) for name in _AXIAL})
DISTORTION_MM = 1.0  # largest slow depth error in the image
OFFSET_MM = 2.0  # towards the camera: the thickness of the paper's soft cardboard
REGISTRATION_MM, REGISTRATION_DEGREES = 1.0, 1.0
SCALED = (
    "axial_mm", "flying_share", "hole_share", "grazing_share", "distortion_mm", "scatter_share"
)  # fmt: skip
MOVED = "camera_from_clean"  # in meta: the camera is another one

Transform = Float64[np.ndarray, "4 4"]
Generator = np.random.Generator


class Severity(NamedTuple):
    """A kind of fault and its level (``_LIMITS``)."""

    kind: str
    level: float

    @property
    def name(self) -> str:
        """As a measurement names its fault, and ``parse`` reads it."""
        return f"{self.kind}={self.level:g}"


def clean_level(kind: str) -> float | None:
    """The level at which a kind is the clean scene, None where there is none."""
    return _LIMITS[kind][2]


def parse(name: str) -> Severity | None:
    """The severity of this name, None where it is none (``noise`` is a fault). Raises InputError:
    an unknown kind, or a level that is no number or not allowed."""
    kind, equals, text = name.partition("=")
    if not equals:
        return None
    if kind not in KINDS:
        raise InputError(f"severity {kind!r} is not known; allowed: {', '.join(KINDS)}.")
    try:
        level = float(text)
    except ValueError:
        raise InputError(f"severity {name!r}: {text!r} is no number.") from None
    low, high, _ = _LIMITS[kind]
    if not low <= level <= high:
        raise InputError(f"{kind} is {level:g}; allowed: {low:g} to {high:g}.")
    return Severity(kind, level)


def disturbed(clean: Scene, fault: str, seed: int) -> Scene:
    """The scene as it would have been with a fault or severity of this name; ``clean`` itself
    without any.

    Random numbers depend on the seed and the fault, or kind of severity, alone; a fault's are the
    same in ``all``. The cloud is drawn from the depth image again, by the scene's own crop; a scene
    that was read from its folder has depths in steps of 0.1 mm. A camera that moved has the
    surfaces rendered again and crops nothing.

    Raises InputError: no such fault, no clean scene of the twin with its depth image, or another
    camera for a scene with a rod in view; NoEstimate: fewer than 200 points are left.
    """
    severity = parse(fault)
    if severity is None and fault not in FAULTS:
        raise InputError(f"fault {fault!r} is not known; allowed: {', '.join(FAULTS)}.")
    if clean.depth is None or clean.meta.get("view") != "clean" or "fault" in clean.meta:
        raise InputError(
            "faults are made from clean scenes of the twin with their depth image: the folders "
            "VARIANT-clean that `tumortrack twin` writes."
        )
    config = from_builtins(clean.meta.get("view_config"), ViewConfig, "meta.json, view_config")
    if fault == "clean" or (severity and severity.level == clean_level(severity.kind)):
        return clean
    name = severity.name if severity else fault
    scene = replace(clean, meta={**clean.meta, "fault": name, "fault_seed": seed})
    if severity:
        return _severe(scene, clean.depth, config, severity, seed)
    return _faulty(scene, clean.depth, config, fault, seed)


def _faulty(scene: Scene, clean: DepthFrame, config: ViewConfig, fault: str, seed: int) -> Scene:
    """With faults at their usual size."""
    frame, wanted = clean, (fault,) if fault != "all" else FAULTS
    rngs = {name: np.random.default_rng([seed, n]) for n, name in enumerate(FAULTS)}
    for name, change in _FAULTY.items():
        if name in wanted:
            frame = change(frame, config, rngs[name])
    if frame is not clean:
        draw = np.random.default_rng([seed, len(FAULTS)])
        scene = replace(scene, cloud=cloud_from_depth(frame, config.crop, draw), depth=frame)
    if "registration" not in wanted:
        return scene
    # The truth lies off, by a transform about the organ's centre; both directions are uniform.
    shift, axis = rngs["registration"].standard_normal((2, 3))
    shift *= REGISTRATION_MM / np.linalg.norm(shift)
    axis *= np.deg2rad(REGISTRATION_DEGREES) / np.linalg.norm(axis)
    error = _turned(scene, axis, shift)
    return _truth_moved(scene, error, registration=error.tolist())


def _severe(
    scene: Scene, frame: DepthFrame, config: ViewConfig, severity: Severity, seed: int
) -> Scene:
    """With one kind of fault at its level."""
    kind, level = severity
    stream = 7000 + KINDS.index(kind)
    rng, draw = (np.random.default_rng([seed, stream + more]) for more in (0, len(KINDS)))
    if kind == "points":
        return replace(scene, cloud=thin_cloud(scene.cloud, int(level), draw))
    crop = config.crop
    if kind in ("distance", "tilt"):
        scene = _camera_moved(scene, kind, level, rng)
        organ = scene.reference.organ
        frame = render_depth(organ.vertices_mm, organ.faces, frame.intrinsics, frame.stamp_ns)
        crop = CloudConfig(near_mm=1.0, far_mm=1e4, n_points=config.n_points)
    else:
        frame = _SEVERE[kind](frame, level, config, rng)
    return replace(scene, cloud=cloud_from_depth(frame, crop, draw), depth=frame)


def _camera_moved(scene: Scene, kind: str, level: float, rng: Generator) -> Scene:
    """The truth before another camera of the same make."""
    if "poke" in scene.meta.get("state", {}):
        raise InputError(
            "a scene with a rod in view cannot be seen from elsewhere; choose another state."
        )
    if kind == "distance":
        nearest_mm = float(scene.reference.organ.vertices_mm[:, 2].min())
        camera_from_clean = rigid(np.eye(3), np.array([0.0, 0.0, level - nearest_mm]))
    else:
        angle = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        camera_from_clean = _turned(scene, np.deg2rad(level) * axis)
    known = [n for n in ("camera_from_ct", "camera_from_bench") if n in scene.meta]
    placed = {name: (camera_from_clean @ np.array(scene.meta[name])).tolist() for name in known}
    return _truth_moved(scene, camera_from_clean, **{MOVED: camera_from_clean.tolist()}, **placed)


def scaled(noise: NoiseConfig, factor: float) -> NoiseConfig:
    """The noise with every amplitude times a factor; shares end at 1, lengths and the depth unit
    stay."""
    amplitudes = {name: factor * getattr(noise, name) for name in SCALED}
    limited = {k: min(v, 1.0) if k.endswith("_share") else v for k, v in amplitudes.items()}
    return structs.replace(noise, **limited)


def _nearer(frame: DepthFrame, by_mm: float) -> DepthFrame:
    return replace(frame, depth_mm=frame.depth_mm - np.float32(by_mm))


def _distortion(frame: DepthFrame, _: ViewConfig, rng: Generator) -> DepthFrame:
    """The sensor model's slow field at its full height, in every scene."""
    from tumortrack.sense.kernels import slow_shape

    shape = (frame.intrinsics.height, frame.intrinsics.width)
    field, scale = slow_shape(shape, DISTORTION_MM, rng)
    return frame.with_depth(frame.depth_mm + field * scale)


# First what lies before the sensor, then the sensor itself, stored steps last.
_FAULTY: dict[str, Callable[[DepthFrame, ViewConfig, Generator], DepthFrame]] = {
    "offset": lambda frame, _, __: _nearer(frame, OFFSET_MM),
    "occlusion": lambda frame, config, rng: occlude(
        frame, shaft_over(frame, config.shaft_radius_mm, rng)
    )[0],
    "outliers": lambda frame, config, rng: add_background(
        frame, config.clutter_share, config.far_mm, rng
    )[0],
    "distortion": _distortion,
    "noise": lambda frame, _, rng: add_noise(frame, AXIAL_NOISE, rng),
}
_SEVERE: dict[str, Callable[[DepthFrame, float, ViewConfig, Generator], DepthFrame]] = {
    "noise": lambda frame, level, config, rng: add_noise(frame, scaled(config.noise, level), rng),
    "visible": lambda frame, level, config, rng: hide_share(
        frame, 1 - level / 100, config.shaft_radius_mm, rng
    ),
    "outliers": lambda frame, level, config, rng: add_background(
        frame, level / 100, config.far_mm, rng
    )[0],
    "offset": lambda frame, level, _, __: _nearer(frame, level),
}


def _turned(scene: Scene, turn: np.ndarray, shift: np.ndarray | float = 0.0) -> Transform:
    """A rotation vector about the organ's centre, and a shift."""
    centre, rotation = scene.reference.organ.box_mm.mean(0), Rotation.from_rotvec(turn).as_matrix()
    return rigid(rotation, centre + shift - rotation @ centre)


def _truth_moved(scene: Scene, b_from_a: Transform, **about: object) -> Scene:
    """With its surfaces and targets moved, and no more; ``about`` goes into its meta."""
    targets = scene.targets
    if targets:
        targets = replace(targets, points_mm=transform_points(b_from_a, targets.points_mm))
    reference, meta = moved(scene.reference, b_from_a), {**scene.meta, **about}
    return replace(scene, reference=reference, targets=targets, meta=meta)
