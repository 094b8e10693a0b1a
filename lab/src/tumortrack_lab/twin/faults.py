"""Faults of the sensor and the view, made from a clean scene of the twin.

A fault such as ``noise`` is a single source of error at its usual size, or all of them together:
how much of the error is the sensor's. A severity such as ``noise=2`` or ``visible=60`` is one kind
of fault in degrees: how the error grows. All levels of a kind share their random draws, so that
the same shaft reaches farther, and the same noise grows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

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

Fault = Literal[
    "clean", "noise", "distortion", "offset", "occlusion", "outliers", "registration", "all"
]
FAULTS: tuple[Fault, ...] = get_args(Fault)
Kind = Literal["noise", "visible", "outliers", "points", "offset", "distance", "tilt"]
KINDS: tuple[Kind, ...] = get_args(Kind)  # their order is that of their random streams: append only

# The axial noise and depth steps of the D405 model, and nothing else of it.
_AXIAL = ("axial_mm", "correlated_share", "quantum_mm")
AXIAL_NOISE = NoiseConfig(**{name: getattr(D405_NOISE, name) for name in _AXIAL})
DISTORTION_MM = 1.0  # largest slow depth error in the image
OFFSET_MM = 2.0  # towards the camera: the thickness of the paper's soft cardboard
REGISTRATION_MM, REGISTRATION_DEGREES = 1.0, 1.0

# Lowest and highest level allowed, and the level that is the clean scene (None: no level is).
_LIMITS: dict[str, tuple[float, float, float | None]] = {
    "noise": (0.0, 10.0, 0.0),
    "visible": (10.0, 100.0, 100.0),
    "outliers": (0.0, 40.0, 0.0),
    "points": (200.0, 5000.0, 5000.0),
    "offset": (-20.0, 20.0, 0.0),
    "distance": (60.0, 500.0, None),
    "tilt": (0.0, 75.0, 0.0),
}
SCALED = (
    "axial_mm", "flying_share", "hole_share", "grazing_share", "distortion_mm", "scatter_share"
)  # fmt: skip
MOVED = "camera_from_clean"  # in meta: the camera is another one

Transform = Float64[np.ndarray, "4 4"]
Generator = np.random.Generator


@dataclass(frozen=True)
class Severity:
    """A kind of fault and its level.

    - noise: the sensor model's amplitudes, times the level (shares end at 1).
    - visible: percent of the visible surface that is left; a shaft, a lump and a drape hide the
      rest.
    - outliers: percent of all points that are background.
    - points: how many the cloud has.
    - offset: mm that every depth is too small.
    - distance: mm from the camera to the organ's nearest point, along its axis.
    - tilt: degrees by which the camera is turned about the organ's centre, about a random axis of
      the image plane.
    """

    kind: Kind
    level: float

    def __post_init__(self) -> None:
        low, high, _ = _LIMITS[self.kind]
        if not low <= self.level <= high:
            raise InputError(f"{self.kind} is {self.level:g}; allowed: {low:g} to {high:g}.")

    @property
    def name(self) -> str:
        """As a cell names its fault, and ``parse`` reads it."""
        return f"{self.kind}={self.level:g}"

    @property
    def is_clean(self) -> bool:
        """Is this level the clean scene itself?"""
        return self.level == clean_level(self.kind)


def clean_level(kind: str) -> float | None:
    """The level at which a kind is the clean scene, None where there is none."""
    return _LIMITS[kind][2]


def parse(name: str) -> Severity | None:
    """The severity of this name, None where it is none (``noise`` is a fault). Raises InputError:
    an unknown kind, or a level that is no number or not allowed."""
    kind, equals, level = name.partition("=")
    if not equals:
        return None
    if kind not in KINDS:
        raise InputError(f"severity {kind!r} is not known; allowed: {', '.join(KINDS)}.")
    try:
        number = float(level)
    except ValueError:
        raise InputError(f"severity {name!r}: {level!r} is no number.") from None
    return Severity(kind, number)


def disturbed(clean: Scene, fault: str, seed: int) -> Scene:
    """The scene with this fault, by the name of a severity or of one of ``FAULTS``. Raises
    InputError: no such fault, no clean scene of the twin with its depth image."""
    severity = parse(fault)
    return faulty(clean, fault, seed) if severity is None else severe(clean, severity, seed)


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
    its folder has depths in steps of 0.1 mm. Raises InputError: no such fault, or no clean scene of
    the twin with its depth image.
    """
    if fault not in FAULTS:
        raise InputError(f"fault {fault!r} is not known; allowed: {', '.join(FAULTS)}.")
    frame, config = _clean_view(clean)
    if fault == "clean":
        return clean

    def rng(name: Fault) -> Generator:
        return np.random.default_rng([seed, FAULTS.index(name)])

    usual = {"offset": OFFSET_MM, "outliers": config.clutter_share}
    for name, change in _CHANGES.items():
        if fault in (name, "all"):
            frame = change(frame, usual.get(name, 1.0), config, rng(name))
    cloud = clean.cloud
    if frame is not clean.depth:
        cloud = cloud_from_depth(frame, config.crop, np.random.default_rng([seed, len(FAULTS)]))
    meta = {**clean.meta, "fault": fault, "fault_seed": seed}
    if fault in ("registration", "all"):  # both directions are uniform
        shift, axis = rng("registration").standard_normal((2, 3))
        shift *= REGISTRATION_MM / np.linalg.norm(shift)
        axis *= np.deg2rad(REGISTRATION_DEGREES) / np.linalg.norm(axis)
        error = _turned(clean, axis, shift)
        clean = _truth_moved(clean, error)
        meta["registration"] = error.tolist()
    return replace(clean, cloud=cloud, depth=frame, meta=meta)


def severe(clean: Scene, severity: Severity, seed: int) -> Scene:
    """The scene as it would have been with this fault so severe; ``clean`` itself where it is no
    fault at that level.

    Random numbers depend on seed and kind alone. The cloud is drawn again from the depth image by
    the scene's own crop; a camera that moved has the surfaces rendered again and crops nothing.
    Raises InputError: no clean scene of the twin, or another camera for a scene with a rod in view;
    NoEstimate: fewer than 200 points are left.
    """
    frame, config = _clean_view(clean)
    if severity.is_clean:
        return clean
    kind, level = severity.kind, severity.level
    meta = {**clean.meta, "fault": severity.name, "fault_seed": seed}
    stream = 7000 + KINDS.index(kind)
    rng, draw = (np.random.default_rng([seed, stream + more]) for more in (0, len(KINDS)))
    if kind == "points":
        return replace(clean, cloud=thin_cloud(clean.cloud, int(level), draw), meta=meta)
    if kind in ("distance", "tilt"):
        if kind == "distance":
            nearest_mm = float(clean.reference.organ.vertices_mm[:, 2].min())
            camera_from_clean = rigid(np.eye(3), np.array([0.0, 0.0, level - nearest_mm]))
        else:
            angle = rng.uniform(0, 2 * np.pi)
            axis = np.array([np.cos(angle), np.sin(angle), 0.0])
            camera_from_clean = _turned(clean, np.deg2rad(level) * axis)
        return _seen_from(replace(clean, meta=meta), camera_from_clean, config, draw)
    frame = _LEVELS[kind](frame, level, config, rng)
    return replace(clean, cloud=cloud_from_depth(frame, config.crop, draw), depth=frame, meta=meta)


def _clean_view(clean: Scene) -> tuple[DepthFrame, ViewConfig]:
    """The depth image of a clean scene, and how it was taken; else InputError."""
    if clean.depth is None or clean.meta.get("view") != "clean" or "fault" in clean.meta:
        raise InputError(
            "faults are made from clean scenes of the twin with their depth image: the folders "
            "VARIANT-clean that `tumortrack twin` writes."
        )
    config = from_builtins(clean.meta.get("view_config"), ViewConfig, "meta.json, view_config")
    return clean.depth, config


def scaled(noise: NoiseConfig, factor: float) -> NoiseConfig:
    """The noise with every amplitude times a factor; shares end at 1, lengths and the depth unit
    stay."""
    amplitudes = {name: factor * getattr(noise, name) for name in SCALED}
    limited = {k: min(v, 1.0) if k.endswith("_share") else v for k, v in amplitudes.items()}
    return structs.replace(noise, **limited)


def _nearer(frame: DepthFrame, by_mm: float, _: ViewConfig, __: Generator) -> DepthFrame:
    return replace(frame, depth_mm=frame.depth_mm - np.float32(by_mm))


def _outliers(frame: DepthFrame, share: float, config: ViewConfig, rng: Generator) -> DepthFrame:
    return add_background(frame, share, config.far_mm, rng)[0]


def _distortion(frame: DepthFrame, _: float, __: ViewConfig, rng: Generator) -> DepthFrame:
    """The sensor model's slow field at its full height, in every scene."""
    from tumortrack.sense.kernels import slow_shape

    shape = (frame.intrinsics.height, frame.intrinsics.width)
    field, scale = slow_shape(shape, DISTORTION_MM, rng)
    return frame.with_depth(frame.depth_mm + field * scale)


_Change = Callable[[DepthFrame, float, ViewConfig, Generator], DepthFrame]
# First what lies before the sensor, then the sensor itself, stored steps last.
_CHANGES: dict[Fault, _Change] = {
    "offset": _nearer,
    "occlusion": lambda frame, _, config, rng: occlude(
        frame, shaft_over(frame, config.shaft_radius_mm, rng)
    )[0],
    "outliers": _outliers,
    "distortion": _distortion,
    "noise": lambda frame, _, __, rng: add_noise(frame, AXIAL_NOISE, rng),
}
_LEVELS: dict[str, _Change] = {
    "noise": lambda frame, level, config, rng: add_noise(frame, scaled(config.noise, level), rng),
    "visible": lambda frame, level, config, rng: hide_share(
        frame, 1 - level / 100, config.shaft_radius_mm, rng
    )[0],
    "outliers": lambda frame, level, config, rng: _outliers(frame, level / 100, config, rng),
    "offset": _nearer,
}


def _turned(clean: Scene, turn: np.ndarray, shift: np.ndarray | float = 0.0) -> Transform:
    """A rotation vector about the organ's centre, and a shift."""
    centre, rotation = clean.reference.organ.box_mm.mean(0), Rotation.from_rotvec(turn).as_matrix()
    return rigid(rotation, centre + shift - rotation @ centre)


def _seen_from(
    clean: Scene, camera_from_clean: Transform, config: ViewConfig, draw: Generator
) -> Scene:
    """The same state of the organ before another camera of the same make."""
    if "poke" in clean.meta.get("state", {}):
        raise InputError(
            "a scene with a rod in view cannot be seen from elsewhere; choose another state."
        )
    assert clean.depth is not None
    made = _truth_moved(clean, camera_from_clean)
    organ, camera = made.reference.organ, clean.depth.intrinsics
    frame = render_depth(organ.vertices_mm, organ.faces, camera, clean.depth.stamp_ns)
    crop = CloudConfig(near_mm=1.0, far_mm=1e4, n_points=config.n_points)
    meta = {**clean.meta, MOVED: camera_from_clean.tolist()}
    for name in ("camera_from_ct", "camera_from_bench"):
        if name in meta:
            meta[name] = (camera_from_clean @ np.array(meta[name])).tolist()
    return replace(made, cloud=cloud_from_depth(frame, crop, draw), depth=frame, meta=meta)


def _truth_moved(scene: Scene, b_from_a: Transform) -> Scene:
    """The scene with its surfaces and targets moved, and nothing else."""
    targets = scene.targets
    if targets:
        targets = replace(targets, points_mm=transform_points(b_from_a, targets.points_mm))
    return replace(scene, reference=moved(scene.reference, b_from_a), targets=targets)
