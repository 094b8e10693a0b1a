"""A moving scene: a camera looks at an organ that breathes and is pushed on its table.

A state is an equilibrium of ``elastic``: coefficients of the body's modes and a small rigid motion
on the bed. It is solved for a few depths of a push; between them the unknowns follow a monotone
cubic (PCHIP: Fritsch and Carlson 1980, doi 10.1137/0717021), without overshoot or jumps.

``ScenePlayer`` is a function of time: the same seed and time give the same state, depth image and
true surfaces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float32, Float64
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from tumortrack.core.camera import d405
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import perpendicular, rigid, rotation_onto, transform_points, unit
from tumortrack.core.render import render_depth
from tumortrack.core.types import Anatomy, DepthFrame, Intrinsics, Mesh
from tumortrack.organ.body import BodyConfig, Points, body_of, length_over_kidney, reduced_organ
from tumortrack.organ.loads import ReducedProblem, in_bed
from tumortrack.organ.modes import LEVER_MM
from tumortrack.simulation.noise import D405_NOISE, NoiseConfig, add_noise
from tumortrack.simulation.scene import PoseConfig, sample_pose
from tumortrack_devices.pulled import PulledStates

SHAFT_MM = 4.0  # an instrument's radius
_SHAFT_LENGTH_MM = 200.0
_BREATH_S, _PUSH_S = 4.0, 6.0  # periods
_KIDNEY_MM = 118.0  # from the camera to a kidney
_CLEAR_MM = 15.0  # from the nearest depth that a camera sees to the organ, motions included
_AWAY_MM = 160.0  # an instrument withdrawn this far along its shaft is out of view
_STEPS = 3  # of integration: for these states within 0.02 mm of the exact position
_SWAY_S = (17.0, 23.0, 29.0, 19.0, 13.0, 31.0)  # periods of the camera's rotations and shifts
# Over the period of a push (0..1): the instrument's relative distance from the organ, its depth.
_AWAY = PchipInterpolator([0.0, 0.2, 0.85, 1.0], [1.0, 0.0, 0.0, 1.0])
_DEPTH = PchipInterpolator([0.0, 0.2, 0.45, 0.6, 0.85, 1.0], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0])

_REACH_MM = 400.0  # of the drape to every side
_CELLS = 40  # of the drape along each edge
_WAVES = 5  # of the drape
_RING_MM = 4.0  # between the rings of an instrument's triangles
_SECTIONS = 24  # of each ring
_FARTHEST_MM = 500.0  # of the table, as seen by the sensor
_DEPTHS = 7  # of a push for which the state is solved
_FOOT_MM = 2.0  # the tissue is held down this far beyond the instrument's radius
_FACING = 0.85  # least cosine between an indented place's normal and up
_RISE_DEGREES = 50.0  # of an instrument's shaft over the surface
_SIDES = 24  # directions from which it may come
_NOTHING = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))


class ScenePlayerConfig(Config, frozen=True, kw_only=True):
    """What moves and what is visible; a length of zero switches its part off."""

    width: int = 424
    height: int = 240
    # Depth of the organ's nearest point before all motion; None: as for a kidney, scaled with the
    # length of a larger organ.
    distance_mm: float | None = None
    breath_mm: float = 6.0  # motion down the body and back
    swell: float = 0.01  # strain of the organ's volume with a breath
    push_mm: float = 8.0  # depth to which an instrument presses, at each place in turn
    places: int = 3
    sway_mm: float = 3.0  # of the camera along each axis
    sway_degrees: float = 3.0  # about each axis
    table: bool = True
    drape: bool = False
    noise: NoiseConfig = D405_NOISE
    body: BodyConfig = BodyConfig()

    def __post_init__(self) -> None:
        if self.distance_mm is not None:
            self.check_between("the virtual room:", distance_mm=(60, 400))
        d405(self.width, self.height)


@dataclass(frozen=True, eq=False)
class Instant:
    """The scene at a time. The room's frame is the CT's, with the organ at rest in its place."""

    t_s: float
    camera_from_room: Float64[np.ndarray, "4 4"]
    room_from_organ: Float64[np.ndarray, "4 4"]  # the organ's rigid motion, after its deformation
    room_from_rod: Float64[np.ndarray, "4 4"]  # the instrument's pose
    velocity: Float32[np.ndarray, "i j k 3"]  # the field that points of the CT follow
    depth_mm: float  # of the push


@dataclass(frozen=True, eq=False)
class Indentation:
    """One place of the surface under an instrument; CT frame."""

    place_ct: Float64[np.ndarray, " 3"]  # at rest
    axis: Float64[np.ndarray, " 3"]  # unit vector from the instrument's tip along its shaft
    unknowns: Callable[[float], Float64[np.ndarray, " m"]]  # for a depth in mm


class ScenePlayer:
    """One case in motion. The constructor solves the elastic states, which takes some seconds.
    Raises InputError: a case without an elastic body, or a configuration that doesn't fit it, or
    ``pulled`` of another case's vertices."""

    def __init__(
        self,
        anatomy_ct: Anatomy,
        up_lps: tuple[float, float, float],
        config: ScenePlayerConfig,
        seed: int,
        pulled: PulledStates | None = None,
    ) -> None:
        rng = np.random.default_rng([seed, 0x57A6E])
        up = unit(np.asarray(up_lps, float))
        self.anatomy_ct, self.config = anatomy_ct, config
        self.intrinsics = d405(config.width, config.height)
        self._seed, self._up = seed, up
        pose = PoseConfig(tilt_deg=8.0, sideways_mm=5.0)
        distance_mm = config.distance_mm
        if distance_mm is None:
            distance_mm = min(_KIDNEY_MM * max(1.0, length_over_kidney(anatomy_ct)), 400.0)
            distance_mm = max(distance_mm, config.noise.nearest_mm + _CLEAR_MM)
        nearest_mm = (distance_mm, distance_mm)
        self._camera_from_ct = sample_pose(pose, anatomy_ct.organ, up_lps, nearest_mm, rng)
        organ = self._organ = reduced_organ(anatomy_ct, up, config.body, rng)
        self._swollen = self._at_rest("swell", ReducedProblem.expand, config.swell)
        self._pushes = self._indentations(rng) if config.push_mm > 0 else []
        states = [self._swollen, *(push.unknowns(config.push_mm) for push in self._pushes)]
        self._body = body_of(organ, np.array(states, np.float32)[:, : organ.n_modes])
        inferior = np.array([0.0, 0.0, -1.0])
        along = inferior - (inferior @ up) * up
        upright = np.linalg.norm(along) < 0.1  # then any horizontal direction
        self._down_the_body = perpendicular(up) if upright else unit(along)
        self._vertices = np.concatenate([part.vertices_mm for part in anatomy_ct.parts])
        self._pulled = pulled
        if pulled is not None and pulled.moved_mm.shape[1] != len(self._vertices):
            raise InputError("the states of the pull are of another case; make them for this one.")
        self._table = Table(anatomy_ct.organ, up)
        self._drape = drape(self._table, rng) if config.drape else _NOTHING
        self._rod = rod(SHAFT_MM, _SHAFT_LENGTH_MM) if self._pushes else _NOTHING
        shown = (anatomy_ct.organ, self._drape, self._rod)
        first = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in shown)])
        faces = [mesh.faces + n for mesh, n in zip(shown, first, strict=False)]
        self._faces = np.concatenate(faces)

    def state_at(self, t_s: float) -> Instant:
        """The scene at a time from 0 s on; a pure function."""
        if not t_s >= 0:
            raise InputError(f"time {t_s} s is before the scene's beginning, 0 s.")
        config = self.config
        breath = np.sin(np.pi * t_s / _BREATH_S) ** 4  # Lujan 1999, doi 10.1118/1.598577
        unknowns, depth_mm, push = breath * self._swollen, 0.0, None
        count, phase = divmod(t_s / _PUSH_S, 1)
        if self._pushes:
            push = self._pushes[int(count) % len(self._pushes)]
            depth_mm = config.push_mm * float(_DEPTH(phase))
            unknowns = unknowns + push.unknowns(depth_mm)
        modes = self._body.modes.shape[-1]
        coefficients, shift, turn = np.split(unknowns, [modes, modes + 3])
        rotation = Rotation.from_rotvec(turn / LEVER_MM).as_matrix()
        center = self._body.center_ct
        moved = shift + config.breath_mm * breath * self._down_the_body
        room_from_organ = rigid(rotation, center - rotation @ center + moved)
        velocity, room_from_rod = self._body.velocity(coefficients), np.eye(4)
        if push is not None:
            place = self._deformed(velocity, push.place_ct[None])
            away_mm = _AWAY_MM * float(_AWAY(phase))
            tip = transform_points(room_from_organ, place)[0] + away_mm * push.axis
            room_from_rod = rigid(rotation_onto(np.array([0.0, 0.0, 1.0]), push.axis), tip)
        poses = self._camera_at(t_s), room_from_organ, room_from_rod
        return Instant(t_s, *poses, velocity, depth_mm)

    def forward(self, instant: Instant, points_ct: Points) -> Float64[np.ndarray, "n 3"]:
        """Points of the CT in the camera frame."""
        camera_from_organ = instant.camera_from_room @ instant.room_from_organ
        return transform_points(camera_from_organ, self._deformed(instant.velocity, points_ct))

    def truth(self, instant: Instant, pull_mm: float = 0.0) -> Anatomy:
        """The true surfaces, camera frame. ``pull_mm``: of the tool that pulls, if one does."""
        parts = self.anatomy_ct.parts
        ends = np.cumsum([len(part.vertices_mm) for part in parts])
        pulled_mm = 0.0 if self._pulled is None else self._pulled.at(pull_mm)
        vertices = np.split(self.forward(instant, self._vertices + pulled_mm), ends[:-1])
        return self.anatomy_ct.with_parts(
            part.with_vertices(v) for part, v in zip(parts, vertices, strict=True)
        )

    def frame(self, instant: Instant, truth: Anatomy, stamp_ns: int) -> DepthFrame:
        """The sensor's depth image at an instant with these true surfaces. Its noise follows from
        seed and time."""
        rod_mm = transform_points(instant.room_from_rod, self._rod.vertices_mm)
        room_mm = np.concatenate([self._drape.vertices_mm, rod_mm])
        camera_mm = transform_points(instant.camera_from_room, room_mm)
        vertices = np.concatenate([truth.organ.vertices_mm, camera_mm])
        clean = render_depth(vertices, self._faces, self.intrinsics, stamp_ns)
        if self.config.table:
            table_mm = self._table.depth_mm(instant.camera_from_room, self.intrinsics)
            clean = DepthFrame(np.fmin(clean.depth_mm, table_mm), self.intrinsics, stamp_ns)
        rng = np.random.default_rng([self._seed, round(instant.t_s * 1e6)])
        return add_noise(clean, self.config.noise, rng)

    def _at_rest(self, name: str, load: Callable[..., None], *arguments: object) -> np.ndarray:
        """The organ's unknowns at rest under a load, its tissue and bed drawn by the seed; ``name``
        is the load's in the error."""
        problem = in_bed(self._organ, self._up, np.random.default_rng([self._seed, 0xBED]))
        load(problem, *arguments)
        unknowns = problem.equilibrium()
        if unknowns is None:
            raise InputError(
                f"the organ does not come to rest under {name}; choose another seed. If that does "
                "not help, look at the case's pictures."
            )
        return unknowns

    def _indentations(self, rng: np.random.Generator) -> list[Indentation]:
        """Indentations at places that face up, far from each other."""
        count, patches = self.config.places, self._organ.patches
        places, normals = patches.points_mm, patches.normals
        facing = np.flatnonzero(normals @ self._up > _FACING)
        if len(facing) < count:
            raise InputError(
                f"only {len(facing)} places of the organ face the camera, {count} are to be "
                "pushed; ask for fewer."
            )
        points = places[facing]
        chosen = [int(rng.integers(len(facing)))]  # farthest point sampling
        distance = np.full(len(facing), np.inf)
        while len(chosen) < count:
            distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
            chosen.append(int(np.argmax(distance)))
        indentations, depths = [], np.linspace(0, self.config.push_mm, _DEPTHS)
        for patch in facing[chosen].tolist():
            instrument = patch, normals[patch], SHAFT_MM + _FOOT_MM
            poke = partial(self._at_rest, "poke", ReducedProblem.indent, *instrument)
            states = [poke(depth) for depth in depths.tolist()]
            unknowns = PchipInterpolator(depths, np.stack(states) - states[0])
            axis = _clearest_axis(places - places[patch], normals[patch])
            indentations.append(Indentation(places[patch], axis, unknowns))
        return indentations

    def _deformed(self, velocity: np.ndarray, points_ct: Points) -> Float64[np.ndarray, "n 3"]:
        return self._body.follow(velocity, points_ct, _STEPS).astype(np.float64)

    def _camera_at(self, t_s: float) -> Float64[np.ndarray, "4 4"]:
        """A slow sway about the organ's centre."""
        sway = np.sin(2 * np.pi * t_s / np.array(_SWAY_S))
        turn = Rotation.from_rotvec(self.config.sway_degrees * sway[:3], degrees=True).as_matrix()
        center = transform_points(self._camera_from_ct, self._body.center_ct[None])[0]
        swayed = rigid(turn, center - turn @ center + self.config.sway_mm * sway[3:])
        return swayed @ self._camera_from_ct


def _clearest_axis(offset_mm: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """The direction of a shaft that stays farthest from the organ, of those of equal rise.
    ``offset_mm``: the organ's patches relative to the shaft's tip."""
    x_axis, rise = perpendicular(outward), np.deg2rad(_RISE_DEGREES)
    y_axis = np.cross(outward, x_axis)

    def gap(axis: np.ndarray) -> float:
        along = offset_mm @ axis
        apart = np.linalg.norm(offset_mm - np.outer(along, axis), axis=1)
        return float((apart[along > 10] / along[along > 10]).min(initial=np.inf))

    turns = np.arange(_SIDES) * 2 * np.pi / _SIDES
    sides = [np.cos(angle) * x_axis + np.sin(angle) * y_axis for angle in turns]
    return max((np.sin(rise) * outward + np.cos(rise) * side for side in sides), key=gap)


class Table:
    """The plane on which an organ lies, with the organ's height and radius over it; CT frame.
    ``up`` is a unit vector, ``origin`` lies below the organ's middle."""

    def __init__(self, organ: Mesh, up: Float64[np.ndarray, " 3"]) -> None:
        heights, middle = organ.vertices_mm @ up, organ.box_mm.mean(0)
        offset = organ.vertices_mm - middle
        across = np.linalg.norm(offset - np.outer(offset @ up, up), axis=1)
        self.up, self.origin = up, middle - up * (middle @ up - heights.min())
        self.organ_height_mm, self.organ_radius_mm = np.ptp(heights), across.mean()

    def depth_mm(
        self, camera_from_room: Float64[np.ndarray, "4 4"], intrinsics: Intrinsics
    ) -> Float32[np.ndarray, "h w"]:
        """Depth of the bare plane, NaN where the camera looks past it: 1/z is linear in the
        image."""
        normal = camera_from_room[:3, :3] @ self.up
        origin = camera_from_room[:3, :3] @ self.origin + camera_from_room[:3, 3]
        across = normal[0] * (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
        downward = normal[1] * (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy
        rows = ((downward + normal[2]) / (normal @ origin)).astype(np.float32)
        columns = (across / (normal @ origin)).astype(np.float32)
        nearness = rows[:, None] + columns
        nearness[nearness < 1 / _FARTHEST_MM] = np.nan
        return np.float32(1) / nearness


# Surfaces have small triangles, as the renderer leaves out those that reach behind the camera.
def drape(table: Table, rng: np.random.Generator) -> Mesh:
    """A cloth with folds, its upper side only: nearly half as high as the organ beside it, farther
    away it falls to the table."""
    steps = np.linspace(-_REACH_MM, _REACH_MM, _CELLS + 1)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    beyond = np.clip(np.hypot(x, y) - table.organ_radius_mm, 0, None)
    height = 0.45 * table.organ_height_mm * np.exp(-0.5 * (beyond / 60) ** 2) + 4.0
    for _ in range(_WAVES):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        length_mm = rng.uniform(25, 70)
        along = np.cos(angle) * x + np.sin(angle) * y
        height += rng.uniform(0.3, 1.2) * np.sin(2 * np.pi * along / length_mm + phase)
    x_axis = perpendicular(table.up)
    places = np.stack([x, y, np.maximum(height, 0.5)], -1)
    places = places @ np.stack([x_axis, np.cross(table.up, x_axis), table.up])
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    return Mesh(table.origin + places.reshape(-1, 3), faces)


def rod(radius_mm: float, length_mm: float) -> Mesh:
    """A shaft along +z whose round tip touches the origin."""
    angle = np.linspace(0, np.pi / 2, 7)[1:]
    along = np.linspace(radius_mm, length_mm, int(np.ceil(length_mm / _RING_MM)) + 1)[1:]
    radius = np.concatenate([radius_mm * np.sin(angle), np.full(len(along), radius_mm)])
    height = np.concatenate([radius_mm * (1 - np.cos(angle)), along])
    turn = np.arange(_SECTIONS) * 2 * np.pi / _SECTIONS
    x, y = radius[:, None] * np.cos(turn), radius[:, None] * np.sin(turn)
    circles = np.stack([x, y, np.repeat(height[:, None], _SECTIONS, 1)], -1).reshape(-1, 3)
    vertices = np.concatenate([circles, [[0.0, 0.0, 0.0], [0.0, 0.0, length_mm]]])
    ring = np.arange(len(circles)).reshape(x.shape)
    following = np.roll(ring, -1, axis=1)
    tip, end = np.full((2, _SECTIONS), [[len(circles)], [len(circles) + 1]])
    corners = [
        (ring[:-1], following[:-1], ring[1:]),
        (following[:-1], following[1:], ring[1:]),
        (tip, following[0], ring[0]),
        (end, ring[-1], following[-1]),
    ]
    return Mesh(vertices, np.concatenate([np.stack(abc, -1).reshape(-1, 3) for abc in corners]))
