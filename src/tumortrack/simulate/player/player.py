"""The theatre: what lies where at a time, what the camera sees of it, where the truth is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, rotation_onto, transform_points
from tumortrack.core.types import Anatomy, DepthFrame, Mesh
from tumortrack.sense.camera import d405
from tumortrack.sense.noise import D405_NOISE, NoiseConfig, add_noise
from tumortrack.sense.render import render_depth
from tumortrack.simulate.elastic.body import BodyConfig, body_of, reduced_organ
from tumortrack.simulate.elastic.flow import follow
from tumortrack.simulate.elastic.settle import LEVER_MM
from tumortrack.simulate.player.props import Table, drape, rod
from tumortrack.simulate.player.pushes import Bed, Push, pushes_on, swollen
from tumortrack.simulate.pose import PoseConfig, sample_pose

SHAFT_MM = 4.0  # an instrument's radius
_SHAFT_LENGTH_MM = 200.0
_AWAY_MM = 160.0  # along its shaft: an instrument out of the picture
_STEPS = 3  # along the body's field: within 0.02 mm of the exact way, for states as here
_NOTHING = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
_INFERIOR = np.array([0.0, 0.0, -1.0])
_SWAY_S = (17.0, 23.0, 29.0, 19.0, 13.0, 31.0)  # periods of the camera's turns and shifts

# A push in shares of its time: the instrument's way from the organ, then its depth.
_AWAY = PchipInterpolator([0.0, 0.2, 0.85, 1.0], [1.0, 0.0, 0.0, 1.0])
_DEPTH = PchipInterpolator([0.0, 0.2, 0.45, 0.6, 0.85, 1.0], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0])


class ScenePlayerConfig(Config, frozen=True, kw_only=True):
    """What moves and what is seen; a length of zero switches its part off.

    Attributes:
        distance_mm: depth of the organ's nearest point, at rest and before the camera sways.
        breath_mm: the organ's way down the body and back, every ``breath_s``; ``swell`` is the
            strain of its volume that goes with it.
        push_mm: how deep an instrument presses, one push every ``push_s`` at one of ``places``.
        sway_mm, sway_degrees: the camera's slow motion along and about each axis.
    """

    width: int = 424
    height: int = 240
    distance_mm: float = 118.0
    breath_mm: float = 6.0
    breath_s: float = 4.0
    swell: float = 0.01
    push_mm: float = 8.0
    push_s: float = 6.0
    places: int = 3
    sway_mm: float = 3.0
    sway_degrees: float = 3.0
    table: bool = True
    drape: bool = False
    noise: NoiseConfig = D405_NOISE
    body: BodyConfig = BodyConfig()

    def __post_init__(self) -> None:
        _within("distance_mm", self.distance_mm, 60, 400)
        _within("breath_mm", self.breath_mm, 0, 30)
        _within("breath_s", self.breath_s, 1, 20)
        _within("swell", self.swell, 0, 0.025)
        _within("push_mm", self.push_mm, 0, 14)
        _within("push_s", self.push_s, 2, 60)
        _within("places", self.places, 1, 20)
        _within("sway_mm", self.sway_mm, 0, 30)
        _within("sway_degrees", self.sway_degrees, 0, 20)
        d405(self.width, self.height)


@dataclass(frozen=True, eq=False)
class Instant:
    """The theatre at a time. The room's frame is the CT's, with the organ where it lay there."""

    t_s: float
    camera_from_room: Float64[np.ndarray, "4 4"]
    room_from_organ: Float64[np.ndarray, "4 4"]  # the organ's rigid motion, after its deformation
    coefficients: Float64[np.ndarray, " m"]  # of the body's modes
    velocity: Float32[np.ndarray, "i j k 3"]  # the field of these, which points of the CT follow
    depth_mm: float  # of the push
    room_from_rod: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        if not self.t_s >= 0:
            raise InputError(f"time {self.t_s} s is before the theatre's beginning, 0 s.")


class ScenePlayer:
    """One case in motion. Building it solves the elastic states: some seconds.

    Raises:
        InputError: a case that makes no elastic body, or a configuration that doesn't fit it.
    """

    def __init__(
        self,
        anatomy_ct: Anatomy,
        up_lps: tuple[float, float, float],
        config: ScenePlayerConfig,
        seed: int,
    ) -> None:
        rng = np.random.default_rng([seed, 0x57A6E])
        up = np.asarray(up_lps, float) / np.linalg.norm(up_lps)
        self.anatomy_ct, self.config = anatomy_ct, config
        self.intrinsics = d405(config.width, config.height)
        self._seed = seed
        pose = PoseConfig(tilt_deg=8.0, sideways_mm=5.0)
        near_mm = (config.distance_mm, config.distance_mm)
        self._camera_from_ct = sample_pose(pose, anatomy_ct.organ, up_lps, near_mm, rng)
        bed = Bed(reduced_organ(anatomy_ct, up, config.body, rng), up, seed)
        self._swollen = swollen(bed, config.swell)
        self._pushes = _pushes(bed, config, rng)
        modes = bed.organ.n_modes
        states = [self._swollen, *(push.unknowns(config.push_mm) for push in self._pushes)]
        self._body = body_of(bed.organ, np.array(states, np.float32)[:, :modes])
        self._down_the_body = _down_the_body(up)
        self._vertices = np.concatenate([part.vertices_mm for part in anatomy_ct.parts])
        self._table = Table.under(anatomy_ct.organ, up)
        self._drape = drape(self._table, rng) if config.drape else _NOTHING
        self._rod = rod(SHAFT_MM, _SHAFT_LENGTH_MM) if self._pushes else _NOTHING
        self._faces = _faces(anatomy_ct.organ, self._drape, self._rod)

    def state_at(self, t_s: float) -> Instant:
        """Everything at a time from 0 s on. A function: no clock, no memory."""
        config = self.config
        breath = np.sin(np.pi * t_s / config.breath_s) ** 4  # Lujan 1999, doi 10.1118/1.598577
        unknowns = breath * self._swollen
        depth_mm, away_mm, push = self._push_at(t_s)
        if push is not None:
            unknowns = unknowns + push.unknowns(depth_mm)
        modes = self._body.modes.shape[-1]
        coefficients, shift, turn = np.split(unknowns, [modes, modes + 3])
        rotation = Rotation.from_rotvec(turn / LEVER_MM).as_matrix()
        center = self._body.center_ct
        moved = shift + config.breath_mm * breath * self._down_the_body
        room_from_organ = rigid(rotation, center - rotation @ center + moved)
        velocity = self._body.velocity(coefficients)
        camera_from_room = self._camera_at(t_s)
        instant = Instant(t_s, camera_from_room, room_from_organ, coefficients, velocity, depth_mm)
        if push is None:
            return instant
        place = self._deformed(instant, push.place_ct[None])
        tip = transform_points(room_from_organ, place)[0] + away_mm * push.axis
        upright = rigid(rotation_onto(np.array([0.0, 0.0, 1.0]), push.axis), tip)
        return replace(instant, room_from_rod=upright)

    def carry(
        self, instant: Instant, points_ct: Float[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Where points of the CT are before the camera."""
        camera_from_organ = instant.camera_from_room @ instant.room_from_organ
        return transform_points(camera_from_organ, self._deformed(instant, points_ct))

    def truth(self, instant: Instant) -> Anatomy:
        """The true surfaces, camera frame."""
        parts = self.anatomy_ct.parts
        ends = np.cumsum([len(part.vertices_mm) for part in parts])
        vertices = np.split(self.carry(instant, self._vertices), ends[:-1])
        return Anatomy(tuple(part.moved(v) for part, v in zip(parts, vertices, strict=True)))

    def frame(self, instant: Instant, truth: Anatomy, stamp_ns: int) -> DepthFrame:
        """What the sensor sees at an instant with these true surfaces. Its noise follows from seed
        and time."""
        about = transform_points(instant.room_from_rod, self._rod.vertices_mm)
        about = np.concatenate([self._drape.vertices_mm, about])
        about = transform_points(instant.camera_from_room, about)
        vertices = np.concatenate([truth.organ.vertices_mm, about])
        clean = render_depth(vertices, self._faces, self.intrinsics, stamp_ns)
        if self.config.table:
            table_mm = self._table.depth_mm(instant.camera_from_room, self.intrinsics)
            clean = DepthFrame(np.fmin(clean.depth_mm, table_mm), self.intrinsics, stamp_ns)
        rng = np.random.default_rng([self._seed, round(instant.t_s * 1e6)])
        return add_noise(clean, self.config.noise, rng)

    def _deformed(self, instant: Instant, points_ct: np.ndarray) -> Float64[np.ndarray, "n 3"]:
        start, spacing_mm = np.ascontiguousarray(points_ct, np.float32), self._body.spacing_mm
        origin_mm = self._body.origin_mm
        moved = follow(instant.velocity, origin_mm, np.float32(spacing_mm), start, _STEPS)
        return moved.astype(np.float64)

    def _push_at(self, t_s: float) -> tuple[float, float, Push | None]:
        """Depth, way from the organ (mm), and which push it is."""
        if not self._pushes:
            return 0.0, 0.0, None
        number, share = divmod(t_s / self.config.push_s, 1)
        push = self._pushes[int(number) % len(self._pushes)]
        return self.config.push_mm * float(_DEPTH(share)), _AWAY_MM * float(_AWAY(share)), push

    def _camera_at(self, t_s: float) -> Float64[np.ndarray, "4 4"]:
        """A slow sway about the organ's centre."""
        sway = np.sin(2 * np.pi * t_s / np.array(_SWAY_S))
        turn = Rotation.from_rotvec(self.config.sway_degrees * sway[:3], degrees=True).as_matrix()
        center = transform_points(self._camera_from_ct, self._body.center_ct[None])[0]
        swayed = rigid(turn, center - turn @ center + self.config.sway_mm * sway[3:])
        return swayed @ self._camera_from_ct


def _pushes(bed: Bed, config: ScenePlayerConfig, rng: np.random.Generator) -> tuple[Push, ...]:
    if config.push_mm == 0:
        return ()
    return pushes_on(bed, config.places, SHAFT_MM, config.push_mm, rng)


def _faces(*meshes: Mesh) -> np.ndarray:
    """Of several surfaces, with their vertices one after the other."""
    first = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in meshes)])
    return np.concatenate([mesh.faces + n for mesh, n in zip(meshes, first, strict=False)])


def _down_the_body(up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    """Inferior along the table; for a body that stands, any way along it."""
    along = _INFERIOR - (_INFERIOR @ up) * up
    if np.linalg.norm(along) < 0.1:
        along = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return along / np.linalg.norm(along)


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InputError(f"{name} is {value:g}; it must lie in {low:g}..{high:g}.")
