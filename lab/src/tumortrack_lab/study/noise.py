"""How noise of a depth image, or of a cloud, changes the answers: each scene's true organ is seen
again without its noise, from a stated distance, and then disturbed in one way."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy, DepthError, DepthFrame, SensorCloud
from tumortrack.registration.model import RegistrationModel
from tumortrack.report.rivals import best_rigid_pose, rigid_fit
from tumortrack.sense.camera import d405, deproject, with_depth_error
from tumortrack.sense.region import Hints, organ_points
from tumortrack.sense.render import render_depth
from tumortrack.sense.sensors import FIGURES, SensorConfig, depth_error_of, simulated
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.tracker import Tracker, region_for
from tumortrack_lab.twin.apparatus import moved

CLOUDS = "cloud", "strays", "fat"
_POINTS = 3000  # of a cloud, from all pixels of the organ
_WIDER = 1.5  # the box of strays than the organ's
_LUMP_MM = 14.0  # radius of a lump of fat at the organ's outline
BIASES = {"scale": "%", "depth": "mm"}
_PARTS = "white", "correlated", *BIASES, *CLOUDS
_UNCALIBRATED = "uncalibrated-"


@dataclass(frozen=True)
class Condition:
    """``kind``: white, correlated, cloud (mm of white noise), strays or fat (% of the points), or a
    camera of ``sense.sensors``; ``amount``: mm, %, or so many times a camera's noise (0: its edges,
    holes and steps alone); ``length_px``: where the correlation is 1/e; ``distance_mm``: the median
    of the organ's depths. Calibrated, and stated, but ``scale`` (%) and ``depth`` (mm), by which
    depths err to either side, and ``uncalibrated`` cameras, of which the kind is said."""

    kind: str
    amount: float = 0.0
    distance_mm: float = 150.0
    length_px: float = 0.0
    uncalibrated: bool = False

    @classmethod
    def read(cls, text: str) -> Condition:
        """``white:1``, ``correlated:1:8`` (mm, px), ``strays:20``, ``scale:3``, ``zed@400`` (mm),
        ``zed:0@400``, ``uncalibrated-zed@400``. Raises InputError: it is none of these."""
        camera = text.removeprefix(_UNCALIBRATED)
        what, _, distance = camera.partition("@")
        kind, *numbers = what.split(":")
        try:
            amount, length_px = [*map(float, numbers), 0.0, 0.0][:2] if numbers else (1.0, 0.0)
            at_mm, raw = float(distance or 150.0), camera != text
            condition = cls(kind, amount, at_mm, length_px, raw)
        except ValueError as error:
            raise InputError(f"{text} is no condition: {error}.") from error
        allowed, given = (*_PARTS, *FIGURES), (amount, length_px, condition.distance_mm)
        if kind not in (FIGURES if camera != text else allowed) or not all(
            0 <= value < np.inf for value in given
        ):
            raise InputError(
                f"{text} is no condition. Allowed: {', '.join(allowed)}, with positive "
                "numbers: white:1, correlated:1:8, zed@400."
            )
        return condition

    @property
    def name(self) -> str:
        """It, for people."""
        if self.kind == "white" and not self.amount:
            return "none"
        if self.kind not in _PARTS:
            kind = f"{self.kind}, uncalibrated" if self.uncalibrated else self.kind
            return kind if self.amount == 1 else f"{kind}, noise times {self.amount:g}"
        if self.kind in BIASES:
            return f"depths off by {self.amount:g} {BIASES[self.kind]}"
        across = f", {self.length_px:g} px" if self.length_px else ""
        return f"{self.kind} {self.amount:g} {'%' if self.kind in CLOUDS[1:] else 'mm'}{across}"

    def sensor(self, unit: int) -> SensorConfig:
        """What disturbs an image of it; ``unit``: which camera of its kind."""
        if self.kind not in _PARTS:
            camera = simulated(self.kind, unit=unit, uncalibrated=self.uncalibrated)
            assert isinstance(camera, SensorConfig)
            px, mm = ("temporal_px", "frozen_px"), ("temporal_mm", "frozen_mm")
            scaled: dict[str, Any] = {key: self.amount * getattr(camera, key) for key in px}
            for key in mm:
                scaled[key] = tuple(self.amount * value for value in getattr(camera, key))
            return msgspec.structs.replace(camera, **scaled)
        white = self.kind == "white"
        return SensorConfig(
            native_px=d405().width,
            temporal_mm=(self.amount if self.kind in ("white", "correlated") else 0.0,),
            white_share=float(white),
            temporal_length_px=self.length_px or 1.0,
        )

    @property
    def noise_mm(self) -> float:
        """Standard deviation of one depth at this distance, its random and frozen parts."""
        if self.kind in (*CLOUDS, *BIASES):
            return self.amount if self.kind == "cloud" else 0.0
        return float(np.hypot(*self.sensor(0).noise_mm(self.distance_mm)))


def placed(reference: Anatomy, distance_mm: float) -> tuple[Anatomy, DepthFrame]:
    """The organ in the middle of a D405's image, this far off in the median, and the image."""
    shift, camera = -reference.organ.box_mm.mean(0) + [0.0, 0.0, distance_mm], d405()
    for _ in range(2):
        there = moved(reference, rigid(np.eye(3), shift))
        frame = render_depth(there.organ.vertices_mm, there.organ.faces, camera)
        off_mm = distance_mm - float(np.nanmedian(frame.depth_mm))
        shift = shift + [0.0, 0.0, off_mm]
    return there, frame


def disturbed(frame: DepthFrame, condition: Condition, seed: int) -> DepthFrame | SensorCloud:
    """What is seen instead of a clean image."""
    if condition.kind in BIASES:
        off = condition.amount if seed % 2 else -condition.amount
        by = (1 + off / 100, 0.0) if condition.kind == "scale" else (1.0, off)
        return frame.with_depth(frame.depth_mm * np.float32(by[0]) + np.float32(by[1]))
    if condition.kind not in CLOUDS:
        camera = condition.sensor(seed)
        error = depth_error_of(condition.kind) if condition.uncalibrated else camera.depth_error
        return with_depth_error(camera.measured(frame, seed), error)
    rng, points = np.random.default_rng((seed, 1)), deproject(frame).astype(float)
    points = rng.choice(points, min(_POINTS, len(points)), replace=False)
    count = round(len(points) * condition.amount / 100)
    if condition.kind == "cloud":
        points += condition.amount * rng.standard_normal(points.shape)
    elif condition.kind == "strays":
        low, high = points.min(0), points.max(0)
        points[:count] = (low + high) / 2 + _WIDER * (rng.random((count, 3)) - 0.5) * (high - low)
    else:
        points = np.concatenate([points, _lump(points, count, rng)])
    return SensorCloud(points.astype(np.float32), depth_error=DepthError())


def _lump(
    points: Float[np.ndarray, "n 3"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    """The visible half of a ball about a point of the outline."""
    outwards = (points - points.mean(0))[:, :2] @ rng.standard_normal(2)
    ball = rng.standard_normal((count, 3))
    ball *= _LUMP_MM / np.linalg.norm(ball, axis=1)[:, None]
    ball[:, 2] = -np.abs(ball[:, 2])
    return points[outwards.argmax()] + ball


def measured(tracker: Tracker, scenes: list[Scene], condition: Condition) -> list[dict[str, Any]]:
    """A row a scene (JSON): ``quality`` of the answer (none: there is none) and ``check`` that it
    failed; ``off_mm``, the largest error of a tumor's centre, and ``rigid_mm``, the rigid fit's to
    the same points (``report.rivals``); ``beyond``: whether a tumor lies farther off than
    its bound; ``seconds`` from the image to the answer."""
    return [_row(tracker, scene, condition, seed) for seed, scene in enumerate(scenes)]


def _row(tracker: Tracker, scene: Scene, condition: Condition, seed: int) -> dict[str, Any]:
    model = tracker.model
    assert isinstance(model, RegistrationModel)
    true, frame = placed(scene.reference, condition.distance_mm)
    seen, start = disturbed(frame, condition, seed), time.perf_counter()
    try:
        cloud = seen
        if isinstance(seen, DepthFrame):
            rng = np.random.default_rng(0)
            cloud = organ_points(seen, region_for(model), Hints(), rng).cloud
        assert isinstance(cloud, SensorCloud)
        estimate = tracker.locate(cloud, 16, 0, seen)
    except NoEstimate as error:
        check = error.finding.check if error.finding else "none"
        return {"quality": "none", "check": check, "seconds": time.perf_counter() - start}
    seconds, shape = time.perf_counter() - start, model.shape
    pose, _ = best_rigid_pose(shape.anatomy_ct, Scene(cloud, true))
    pose = rigid_fit(shape.distances[0], cloud, pose)
    centres = {name: mesh.box_mm.mean(0) for name, mesh in zip(true.names, true.parts, strict=True)}
    off, rigid_off, beyond = [], [], False
    for name, rest in zip(true.names[1:], shape.anatomy_ct.tumors, strict=True):
        carried = rest.moved(transform_points(pose, rest.vertices_mm))
        rigid_off.append(np.linalg.norm(carried.box_mm.mean(0) - centres[name]))
        off.append(np.linalg.norm(estimate.meshes[name].box_mm.mean(0) - centres[name]))
        bound = estimate.assessment.bounds.get(name)
        beyond |= bound is not None and bool(off[-1] > bound.error_bound95_mm)
    return {
        "quality": estimate.quality, "check": estimate.finding.check if estimate.finding else "",
        "off_mm": float(max(off)), "rigid_mm": float(max(rigid_off)), "beyond": beyond,
        "seconds": seconds,
    }  # fmt: skip
