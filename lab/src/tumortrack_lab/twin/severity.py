"""One fault of the sensor or the view in degrees, made from a clean scene of the twin.

Where ``faults`` asks which fault costs how much, this asks how the cost grows. A severity has a
name such as ``noise=2`` or ``visible=60``; all levels of a kind share their random draws, so that
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

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy, DepthFrame
from tumortrack.sense.cloud import CloudConfig, cloud_from_depth, thin_cloud
from tumortrack.sense.noise import NoiseConfig, add_noise
from tumortrack.sense.render import render_depth
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.twin.cover import cover
from tumortrack_lab.twin.faults import clean_view, faulty
from tumortrack_lab.twin.props import add_background
from tumortrack_lab.twin.variants import ViewConfig

Kind = Literal["noise", "visible", "outliers", "points", "offset", "distance", "tilt"]
KINDS: tuple[Kind, ...] = get_args(Kind)  # their order is that of their random streams: append only

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
    """The severity of this name, None where it is none (``noise`` is a fault of ``faults``).

    Raises:
        InputError: an unknown kind, or a level that is no number or not allowed.
    """
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
    """The scene with this fault, by the name of a severity or of a fault of ``faults``.

    Raises:
        InputError: no such fault; no clean scene of the twin with its depth image.
    """
    severity = parse(fault)
    return faulty(clean, fault, seed) if severity is None else severe(clean, severity, seed)


def severe(clean: Scene, severity: Severity, seed: int) -> Scene:
    """The scene as it would have been with this fault so severe; ``clean`` itself where it is no
    fault at that level.

    Random numbers depend on seed and kind alone. The cloud is drawn anew from the depth image by
    the scene's own crop; a camera that moved has the surfaces rendered again and crops nothing.

    Raises:
        InputError: no clean scene of the twin; or another camera for a scene with a rod in view.
        NoEstimate: fewer than 200 points are left.
    """
    frame, config = clean_view(clean)
    if severity.is_clean:
        return clean
    meta = {**clean.meta, "fault": severity.name, "fault_seed": seed}
    rng = np.random.default_rng([seed, 7000 + KINDS.index(severity.kind)])
    draw = np.random.default_rng([seed, 7000 + len(_LIMITS) + KINDS.index(severity.kind)])
    if severity.kind == "points":
        return replace(clean, cloud=thin_cloud(clean.cloud, int(severity.level), draw), meta=meta)
    if severity.kind in _MOVES:
        moved = _MOVES[severity.kind](clean, severity.level, rng)
        return _seen_from(replace(clean, meta=meta), moved, config, draw)
    changed = _CHANGES[severity.kind](frame, severity.level, config, rng)
    return replace(
        clean, cloud=cloud_from_depth(changed, config.crop, draw), depth=changed, meta=meta
    )


def scaled(noise: NoiseConfig, factor: float) -> NoiseConfig:
    """The noise with every amplitude times a factor; shares end at 1, lengths and the depth unit
    stay."""
    amplitudes = {name: factor * getattr(noise, name) for name in SCALED}
    limited = {k: min(v, 1.0) if k.endswith("_share") else v for k, v in amplitudes.items()}
    return structs.replace(noise, **limited)


def _noise(
    frame: DepthFrame, level: float, config: ViewConfig, rng: np.random.Generator
) -> DepthFrame:
    return add_noise(frame, scaled(config.noise, level), rng)


def _visible(
    frame: DepthFrame, level: float, config: ViewConfig, rng: np.random.Generator
) -> DepthFrame:
    return cover(frame, 1 - level / 100, config.shaft_radius_mm, rng)[0]


def _outliers(
    frame: DepthFrame, level: float, config: ViewConfig, rng: np.random.Generator
) -> DepthFrame:
    return add_background(frame, level / 100, config.far_mm, rng)[0]


def _offset(
    frame: DepthFrame, level: float, config: ViewConfig, rng: np.random.Generator
) -> DepthFrame:
    return DepthFrame(frame.depth_mm - np.float32(level), frame.intrinsics, frame.stamp_ns)


_Change = Callable[[DepthFrame, float, ViewConfig, np.random.Generator], DepthFrame]
_CHANGES: dict[str, _Change] = {
    "noise": _noise,
    "visible": _visible,
    "outliers": _outliers,
    "offset": _offset,
}


def _distance(clean: Scene, level: float, rng: np.random.Generator) -> Float64[np.ndarray, "4 4"]:
    nearest_mm = float(clean.reference.organ.vertices_mm[:, 2].min())
    return rigid(np.eye(3), np.array([0.0, 0.0, level - nearest_mm]))


def _tilt(clean: Scene, level: float, rng: np.random.Generator) -> Float64[np.ndarray, "4 4"]:
    angle = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    turn = Rotation.from_rotvec(np.deg2rad(level) * axis).as_matrix()
    centre = clean.reference.organ.box_mm.mean(0)
    return rigid(turn, centre - turn @ centre)


_Move = Callable[[Scene, float, np.random.Generator], Float64[np.ndarray, "4 4"]]
_MOVES: dict[str, _Move] = {"distance": _distance, "tilt": _tilt}


def _seen_from(
    clean: Scene,
    camera_from_clean: Float64[np.ndarray, "4 4"],
    config: ViewConfig,
    draw: np.random.Generator,
) -> Scene:
    """The same state of the organ before another camera of the same make."""
    if "poke" in clean.meta.get("state", {}):
        raise InputError(
            "a scene with a rod in view cannot be seen from elsewhere; choose another state."
        )
    if clean.depth is None:
        raise InputError("the scene has no depth image.")
    reference = Anatomy(
        tuple(
            p.moved(transform_points(camera_from_clean, p.vertices_mm))
            for p in clean.reference.parts
        )
    )
    organ, camera = reference.organ, clean.depth.intrinsics
    frame = render_depth(organ.vertices_mm, organ.faces, camera, clean.depth.stamp_ns)
    crop = CloudConfig(near_mm=1.0, far_mm=1e4, n_points=config.n_points)
    targets = clean.targets
    if targets:
        carried = transform_points(camera_from_clean, targets.points_mm)
        targets = replace(targets, points_mm=carried)
    meta = {**clean.meta, MOVED: camera_from_clean.tolist()}
    for name in ("camera_from_ct", "camera_from_bench"):
        if name in meta:
            meta[name] = (camera_from_clean @ np.array(meta[name])).tolist()
    return Scene(cloud_from_depth(frame, crop, draw), reference, frame, meta, targets)
