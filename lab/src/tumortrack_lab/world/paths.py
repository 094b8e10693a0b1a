"""A moving organ: equilibria along a load path as key frames, and interpolation between them.

Quasi-static: every key frame is solved from the one before, with friction, so the organ's place
depends on its path. Only bed and weight hold it while it is pressed, pushed, rolled or breathes: it
is free to roll. Ranges are assumptions, wide on purpose.

Key frames are split into their best rigid motion over the volume and the remaining displacement.
Rotations are interpolated by slerp, displacements and positions by monotone cubics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from tumortrack.core.geometry import rigid, transform_points, unit
from tumortrack.core.rigid_fit import kabsch
from tumortrack.core.types import Mesh
from tumortrack_lab.tets import find
from tumortrack_lab.twin.equilibrium import Nodes, Points, Rod
from tumortrack_lab.twin.occluders import rod_mesh
from tumortrack_lab.world.families import (
    bedded,
    equilibria,
    frame_along,
    log_uniform,
    plate_over,
    random_tissue,
    roll,
    volume_change,
)
from tumortrack_lab.world.forces import Capsule, Force
from tumortrack_lab.world.organ import Generator, Organ, Stage
from tumortrack_lab.world.views import direction

KEY_MM = 2.5  # of a load, between key frames
BEFORE_S, AFTER_S = 1.0, 1.5  # at rest, before the load comes and when it has gone
_AWAY_MM = 60.0  # where a tool waits

Transform = Float64[np.ndarray, "4 4"]
Times = Float64[np.ndarray, " k"]


def _still(time_s: float) -> Transform:
    return np.eye(4)


def _no_tools(time_s: float) -> list[Mesh]:
    return []


class Cover(NamedTuple):
    """A time in which a hand or instruments hide this share of the organ (first camera)."""

    since_s: float
    until_s: float
    share: float


@dataclass(frozen=True, eq=False)
class LoadPath:
    """Key frames (bench frame, mm) and what goes on besides.

    ``phases_s``: when it begins, the load comes, is all there, goes, has gone, and when it ends;
    ``way``, ``bed``: how the organ and the ground move as one (breathing); ``tools``: what else is
    in the picture; all by time. ``covers``: what comes before the organ.
    """

    organ: Organ
    times_s: Times
    keys_mm: Sequence[Nodes]
    rim_mm: float
    phases_s: list[float]
    about: dict[str, Any]
    way: Callable[[float], Transform] = _still
    bed: Callable[[float], Transform] = _still
    tools: Callable[[float], list[Mesh]] = _no_tools
    covers: tuple[Cover, ...] = ()

    @property
    def seconds(self) -> float:
        return float(self.times_s[-1])

    def parted(self, points_mm: Points) -> tuple[np.ndarray, np.ndarray]:
        """Each key frame's rigid motion, and the remaining displacement of these points."""
        mesh, rest = self.organ.mesh, self.organ.mesh.nodes_mm
        share = mesh.lump(mesh.volumes_mm3)
        owner, weights = find(rest[mesh.tets], points_mm)
        poses = np.array([kabsch(rest, nodes, share) for nodes in self.keys_mm])
        left = []
        for nodes, pose in zip(self.keys_mm, poses, strict=True):
            moved = np.einsum("mi,mij->mj", weights, (nodes - rest)[mesh.tets[owner]])
            left.append(transform_points(np.linalg.inv(pose), points_mm + moved) - points_mm)
        return poses, np.array(left)

    def of(self, points_mm: Points) -> Moving:
        """Points in or on the organ at rest on their way."""
        mesh, (poses, left) = self.organ.mesh, self.parted(points_mm)
        middle = np.average(mesh.nodes_mm, axis=0, weights=mesh.lump(mesh.volumes_mm3))
        places = poses[:, :3, :3] @ middle + poses[:, :3, 3]
        turn = Slerp(self.times_s, Rotation.from_matrix(poses[:, :3, :3]))
        place = PchipInterpolator(self.times_s, places)

        def pose_at(time_s: float) -> Transform:
            rotation = turn(time_s).as_matrix()
            return rigid(rotation, place(time_s) - rotation @ middle)

        return Moving(points_mm, pose_at, PchipInterpolator(self.times_s, left))


@dataclass(frozen=True, eq=False)
class Moving:
    """Points between key frames: what ``bend(t)`` adds to their places at rest, moved by the rigid
    ``pose(t)``."""

    points_mm: Points
    pose: Callable[[float], Transform]
    bend: Callable[[float], Points]

    def at(self, time_s: float) -> Points:
        return transform_points(self.pose(time_s), self.points_mm + self.bend(time_s))


class _Bench(NamedTuple):
    """An organ of random tissue in a random bed, free to roll."""

    stage: Stage
    forces: tuple[Force, ...]
    rim_mm: float
    about: dict[str, float]


def _bench(organ: Organ, rng: Generator, rim: tuple[float, float], friction: float) -> _Bench:
    tissue, solid = random_tissue(organ, organ.mesh, rng)
    stage, rim_mm = Stage(organ, solid), rng.uniform(*rim) * organ.size_mm[2]
    bed_kpa, weight = log_uniform(rng, 3.0, 40.0), log_uniform(rng, 0.1, 1.0)
    forces: list[Force] = [
        *bedded(stage, rim_mm, bed_kpa, friction, weight * np.array([0.0, 0.0, -1.0]))
    ]
    if tissue["capsule_mn_mm"] > 0:
        forces.append(Capsule.of(organ.mesh, tissue["capsule_mn_mm"]))
    about = {**tissue, "bed_kpa": bed_kpa, "friction": friction, "weights_added": weight}
    return _Bench(stage, tuple(forces), rim_mm, about)


def _some_friction(rng: Generator) -> float:
    return float(rng.choice([0.0, rng.uniform(0.1, 0.8)]))


class _Course(NamedTuple):
    """When which share of a load acts: of key frames (``shares``), solved in this order, and of
    the times at which they stand (``which``)."""

    shares: list[float]
    times_s: Times
    which: list[int]
    phases_s: list[float]

    def share(self, time_s: float) -> float:
        return float(np.interp(time_s, self.times_s, np.array(self.shares)[self.which]))


def _there_and_back(reach_mm: float, rng: Generator) -> _Course:
    """At rest, loaded, held, released, at rest; eased at both ends."""
    steps = max(3, int(np.ceil(reach_mm / KEY_MM)))
    up = np.arange(steps + 1) / steps
    eased = np.arccos(1 - 2 * up) / np.pi
    rise_s, hold_s, fall_s = rng.uniform(1.5, 3.0), rng.uniform(0.5, 1.0), rng.uniform(0.7, 2.0)
    held_s = BEFORE_S + rise_s + hold_s
    rising, falling = BEFORE_S + rise_s * eased, held_s + fall_s * eased
    times = [0.0, *rising, *falling, falling[-1] + AFTER_S]
    last = 2 * steps
    which = [0, *range(steps + 1), *range(steps, last + 1), last]
    phases = [0.0, BEFORE_S, rising[-1], held_s, times[-2], times[-1]]
    return _Course([*up, *up[-2::-1]], np.array(times), which, np.array(phases).tolist())


def _loaded(
    bench: _Bench, course: _Course, at: Callable[[float], list[Force]], about: dict[str, Any],
    **besides: Any,
) -> LoadPath:  # fmt: skip
    """The path of one load that is applied and removed."""
    loads = (bench.forces + tuple(at(share) if share > 0 else ()) for share in course.shares)
    return _path(bench, course, loads, about, **besides)


def _path(
    bench: _Bench, course: _Course, loads: Iterable[tuple[Force, ...]], about: dict[str, Any],
    **besides: Any,
) -> LoadPath:  # fmt: skip
    keys, iterations = equilibria(bench.stage.solid, loads)
    change = max((volume_change(bench.stage.solid, nodes) for nodes in keys), key=abs)
    recipe = {"material": bench.about, "rim_mm": bench.rim_mm, "load": about}
    recipe |= {"volume_change": change, "iterations": iterations}
    shown = [keys[n] for n in course.which]
    return LoadPath(
        bench.stage.organ, course.times_s, shown, bench.rim_mm, course.phases_s, recipe, **besides
    )


def _press(organ: Organ, rng: Generator) -> LoadPath:
    """A plate from above on the midsection, up to 25 degrees oblique, on which the organ does not
    slip freely; it is not in the picture (as the twin's is not)."""
    bench = _bench(organ, rng, (0.3, 0.5), _some_friction(rng))
    rough = rng.uniform(0.2, 0.8)
    tilt, turn = rng.uniform(0, 25.0), rng.uniform(0, 2 * np.pi)
    width = rng.uniform(20.0, 60.0)
    deep = rng.uniform(0.1, 0.4) * organ.size_mm[2]
    middle = np.abs(organ.points_mm[:, 0] - organ.middle_mm[0]) < 0.15 * organ.size_mm[0]
    top = np.argmax(np.where(middle, organ.points_mm[:, 2], -np.inf))
    target, axes = organ.points_mm[top], frame_along(direction(tilt, turn), rng)

    def at(share: float) -> list[Force]:
        plate = plate_over(bench.stage, axes, target, width, share * deep)
        return [bench.stage.touch(plate, friction=rough)]

    about = {"plate_tilt_degrees": tilt, "width_mm": width, "mm": deep}
    return _loaded(bench, _there_and_back(deep, rng), at, about)


def _push(organ: Organ, rng: Generator) -> LoadPath:
    """A rod, which is seen, pushes a flank aside."""
    bench = _bench(organ, rng, (0.05, 0.25), _some_friction(rng))
    out = unit(np.array([rng.normal(0, 0.3), rng.choice([-1.0, 1.0]), rng.uniform(0.0, 0.7)]))
    point = organ.points_mm[(organ.points_mm @ out).argmax()]
    axis, radius = unit(out + [0.0, 0.0, rng.uniform(0.2, 0.8)]), rng.uniform(4.0, 10.0)
    far = rng.uniform(5.0, 18.0)
    course = _there_and_back(far, rng)

    def rod(mm: float) -> Rod:
        return Rod(point - mm * out, axis, radius)

    def at(share: float) -> list[Force]:
        return [bench.stage.touch(rod(share * far))]

    def tools(time_s: float) -> list[Mesh]:
        away = [0.0, BEFORE_S, course.times_s[-2], course.times_s[-1]]
        mm = np.interp(time_s, away, [-_AWAY_MM, 0.0, 0.0, -_AWAY_MM])
        return [rod_mesh(rod(mm + course.share(time_s) * far))]

    return _loaded(bench, course, at, {"mm": far, "rod_radius_mm": radius}, tools=tools)


def _roll(organ: Organ, rng: Generator) -> LoadPath:
    """A flank is drawn round over a slippery bed by something that is not seen."""
    bench = _bench(organ, rng, (0.25, 0.5), 0.0)
    load = roll(bench.stage, rng)
    return _loaded(bench, _there_and_back(load.reach_mm, rng), load.at, load.about)


def _breathe(organ: Organ, rng: Generator) -> LoadPath:
    """A diaphragm presses on one pole and moves organ and bed along; two to three breaths."""
    bench = _bench(organ, rng, (0.2, 0.45), _some_friction(rng))
    out = unit(np.array([rng.choice([-1.0, 1.0]), *rng.normal(0, 0.2, 2)]))
    axes, deep = frame_along(out, rng), rng.uniform(1.5, 5.0)
    target = organ.points_mm[(organ.points_mm @ out).argmax()]
    far, lift, tilt = rng.uniform(4.0, 15.0), rng.uniform(0.0, 5.0), rng.uniform(-4.0, 4.0)
    period_s, middle = rng.uniform(2.5, 5.0), organ.middle_mm
    shares = [0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25]
    eased = np.arccos(1 - 2 * np.array(shares)) / np.pi / 2
    eased[5:] = 1 - eased[5:]
    breaths = int(np.ceil(7.0 / period_s))
    times = [BEFORE_S + period_s * (n + phase) for n in range(breaths) for phase in eased]
    end_s = BEFORE_S + breaths * period_s
    which = [0, *(np.arange(8 * breaths) % 8), 0, 0]
    phases = [0.0, BEFORE_S, BEFORE_S + period_s / 2, end_s - period_s / 2, end_s, end_s + AFTER_S]
    course = _Course(shares, np.array([0.0, *times, end_s, end_s + AFTER_S]), which, phases)

    def at(share: float) -> list[Force]:
        return [bench.stage.touch(plate_over(bench.stage, axes, target, 100.0, share * deep))]

    def way(time_s: float) -> Transform:
        phase = np.clip((time_s - BEFORE_S) / period_s, 0, breaths)
        share = np.sin(np.pi * phase) ** 2
        return turned(middle, [0.0, share * tilt, 0.0], share * (far * -out + [0, 0, lift]))

    about = {"mm": deep, "moved_mm": far, "period_s": period_s}
    return _loaded(bench, course, at, about, way=way, bed=way)


def turned(middle_mm: np.ndarray, degrees: Sequence[float], shift_mm: np.ndarray) -> Transform:
    """A motion that turns about a point (a rotation vector), and moves it."""
    rotation = Rotation.from_rotvec(degrees, degrees=True).as_matrix()
    return rigid(rotation, middle_mm - rotation @ middle_mm + shift_mm)


KINDS: dict[str, Callable[[Organ, Generator], LoadPath]] = {
    "press": _press, "breathe": _breathe, "push": _push, "roll": _roll,
}  # fmt: skip


def random_path(organ: Organ, kind: str, seed: Sequence[int]) -> LoadPath:
    """All of it drawn from the seed. Raises TumortrackError: a key frame has no equilibrium, or the
    organ's volume changed by more than tissue's does."""
    return KINDS[kind](organ, np.random.default_rng(seed))
