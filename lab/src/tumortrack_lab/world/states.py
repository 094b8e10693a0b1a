"""An organ that moves through solved states: such a sequence costs only its rendering, so there can
be thousands, with jumps and hands before it.

Between rest and a solved state the displacement is scaled, the rigid part by slerp: not an
equilibrium, but close to those of a growing load, with the volume kept to some per cent. One state
leads to another through rest. An organ that is moved to another place keeps its state there, and
does not sink into a bed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points, unit
from tumortrack.core.mesh_files import read_anatomy
from tumortrack.core.rigid_fit import kabsch, matched_vertices
from tumortrack.simulate.scene_folder import InnerPoints, list_scenes, read_targets
from tumortrack_lab.twin.equilibrium import Points
from tumortrack_lab.world.organ import Generator, Organ
from tumortrack_lab.world.paths import Cover, LoadPath, Transform, turned
from tumortrack_lab.world.scenes import World

JUMPS = ("elsewhere", "by a hand", "turned over")
AWAY_S = 1.0  # how long the organ is gone before it is put back turned over
FAR_MM = 1000.0  # how far away it is meanwhile
_LIFT_MM = 25.0  # of an organ that a hand turns over
_LEAST_MM = 10.0  # of a jump: mean over the organ


Way = Callable[[float], Transform]


class State(NamedTuple):
    """A solved state: its rigid motion, and the remaining displacement of ``World.points``."""

    name: str
    pose: Transform
    bend_mm: Points


def world_of(world: World, folder: Path) -> World:
    """The world with the inner points of a folder's scenes, which may differ."""
    inner = read_targets(list_scenes(folder)[0] / "targets.csv")
    return replace(world, targets=InnerPoints(inner.points_ct, inner.labels))


def read_states(world: World, folder: Path) -> list[State]:
    """Of scenes of this case that `make world` made, with its very anatomy and no slit. Raises
    InputError: there is none, or they are another organ's."""
    states, rest = [], world.points
    for path in list_scenes(folder):
        meta = store.read_json(path / "meta.json")
        if meta.get("segmentation", {}).get("kind") != "none" or meta["family"] in ("rest", "cut"):
            continue
        pairs = zip(world.organ.anatomy.parts, read_anatomy(path).parts, strict=True)
        vertices = [matched_vertices(part, moved) for part, moved in pairs]
        inner = read_targets(path / "targets.csv")
        if not np.array_equal(inner.points_ct, world.targets.points_ct):
            raise InputError(f"{path} has other inner points than the first scene of its folder.")
        there = np.concatenate([*vertices, inner.points_mm])
        there = transform_points(np.linalg.inv(np.array(meta["camera_from_bench"])), there)
        pose = kabsch(rest, there, np.ones(len(rest)))
        bend = transform_points(np.linalg.inv(pose), there) - rest
        states.append(State(path.name, pose, bend))
    if not states:
        raise InputError(f"{folder} has no state that could be used; make some: make world.")
    return states


@dataclass(frozen=True, eq=False)
class StatePath(LoadPath):
    """Key frames are (state, share of it); the points must be ``World.points``."""

    shares: tuple[tuple[State, float], ...] = ()

    def parted(self, points_mm: Points) -> tuple[np.ndarray, np.ndarray]:
        middle, poses = self.organ.middle_mm, []
        for state, share in self.shares:
            turn = Rotation.from_matrix(state.pose[:3, :3]).as_rotvec(degrees=True)
            shift = transform_points(state.pose, middle[None])[0] - middle
            poses.append(turned(middle, (share * turn).tolist(), share * shift))
        return np.array(poses), np.array([share * state.bend_mm for state, share in self.shares])


class _Events:
    """An organ's motions and occlusions besides its elastic state, drawn one after the other."""

    def __init__(self, organ: Organ, rng: Generator) -> None:
        self._organ, self._rng = organ, rng
        self._places: list[tuple[float, Way]] = [(-np.inf, lambda time_s: np.eye(4))]
        self.jumps: list[tuple[float, str]] = []
        self.covers: list[Cover] = []
        self.bed: Way = lambda time_s: np.eye(4)

    def breathe(self) -> None:
        """Bed and organ, along one direction."""
        rng = self._rng
        way = unit(rng.normal(size=3) * [1, 1, 0.4]) * rng.uniform(2.0, 10.0)
        period_s = rng.uniform(2.5, 5.0)
        self.bed = lambda time_s: rigid(np.eye(3), way * np.sin(np.pi * time_s / period_s) ** 2)

    def jump(self, kind: str, since_s: float) -> float:
        """Move the organ to another place from one frame to the next, in the open or beneath a
        hand; or take it away and put it back turned over. Returns when that has ended."""
        rng, before = self._rng, self._places[-1][1](np.inf)
        if kind == "turned over":
            away_s, since_s = since_s, since_s + AWAY_S
            away = rigid(np.eye(3), np.array([FAR_MM, 0, 0]))
            self._places.append((away_s, lambda time_s: away))
            self.covers += [Cover(at - 0.25, at + 0.25, 0.5) for at in (away_s, since_s)]
        elif kind == "by a hand":
            self.covers.append(Cover(since_s - 0.3, since_s + 0.4, rng.uniform(0.4, 0.7)))
        over = {"elsewhere": (0, 20), "by a hand": (0, 45), "turned over": (90, 180)}[kind]
        points = self._organ.points_mm
        while True:
            degrees, about = rng.uniform(*over) * rng.choice([-1.0, 1.0]), rng.uniform(-60, 60)
            aside = np.array([*rng.uniform(-20.0, 20.0, 2), 0.0])
            place = turned(self._organ.middle_mm, [0, 0, about], aside) @ self._lying(degrees)
            moved = transform_points(before, points) - transform_points(place, points)
            if np.linalg.norm(moved, axis=1).mean() > _LEAST_MM:
                break
        self._places.append((since_s, lambda time_s: place))
        self.jumps.append((since_s, kind))
        return since_s + 0.5

    def turn(self, since_s: float) -> float:
        """A hand lifts the organ, turns it about its length and puts it down. Returns when the hand
        has gone."""
        rng = self._rng
        turn_s, degrees = rng.uniform(1.2, 3.0), rng.uniform(60.0, 180.0) * rng.choice([-1.0, 1.0])

        def place(time_s: float) -> Transform:
            share = (1 - np.cos(np.pi * np.clip((time_s - since_s) / turn_s, 0, 1))) / 2
            up = np.array([0.0, 0.0, _LIFT_MM * np.sin(np.pi * share)])
            return rigid(np.eye(3), up) @ self._lying(share * degrees)

        self._places.append((since_s, place))
        self.covers.append(Cover(since_s - 0.2, since_s + turn_s + 0.2, rng.uniform(0.2, 0.5)))
        return since_s + turn_s + 0.5

    def way(self, time_s: float) -> Transform:
        place = [place for since_s, place in self._places if since_s <= time_s][-1]
        return self.bed(time_s) @ place(time_s)

    def _lying(self, degrees: float) -> Transform:
        """Turned about its length, its lowest point as deep as before."""
        place, points = (
            turned(self._organ.middle_mm, [degrees, 0, 0], np.zeros(3)),
            self._organ.points_mm,
        )
        place[2, 3] += points[:, 2].min() - transform_points(place, points)[:, 2].min()
        return place


def _turn(events: _Events, rng: Generator) -> tuple[list[float], list[float]]:
    """A hand, which is seen, turns the organ over."""
    return [0.0, events.turn(1.3) + 1.5], [1.0, 1.0]


def _jump(events: _Events, rng: Generator) -> tuple[list[float], list[float]]:
    """Each kind of jump once, two seconds apart."""
    time_s = 1.0
    for kind in rng.permutation(JUMPS):
        time_s = events.jump(str(kind), time_s) + 1.5
    return [0.0, time_s], [1.0, 1.0]


def _hidden(events: _Events, rng: Generator) -> tuple[list[float], list[float]]:
    """One state all along; three times something comes over 30 to 50 % of it, stays and goes."""
    events.breathe()
    for since_s in (1.3, 4.1, 6.9):
        events.covers.append(Cover(since_s, since_s + 1.4, rng.uniform(0.3, 0.5)))
    return [0.0, 9.2], [1.0, 1.0]


def _random(events: _Events, rng: Generator) -> tuple[list[float], list[float]]:
    """Three seconds of random events: two loads, breath, jumps, hands."""
    if rng.uniform() < 0.5:
        events.breathe()
    time_s, jumps = rng.uniform(0.2, 0.8), rng.choice(3, p=[0.35, 0.4, 0.25])
    for _ in range(jumps):
        if time_s < 1.6:
            time_s = events.jump(str(rng.choice(JUMPS)), time_s) + rng.uniform(0.0, 0.6)
    if rng.uniform() < 0.5:
        since_s = rng.uniform(0.2, 1.8)
        share = rng.uniform(0.1, 0.6)
        events.covers.append(Cover(since_s, since_s + rng.uniform(0.3, 1.2), share))
    loads = rng.uniform(0.3, 1.0, 3) * (rng.uniform(size=3) < 0.7)
    return [0.0, rng.uniform(0.5, 1.2), 1.6, rng.uniform(2.0, 2.7), 2.95], [
        loads[0], loads[1], 0.0, loads[2], loads[2]
    ]  # fmt: skip


STATE_KINDS: dict[str, Callable[[_Events, Generator], tuple[list[float], list[float]]]] = {
    "turn": _turn, "jump": _jump, "hidden": _hidden, "random": _random,
}  # fmt: skip


def state_path(organ: Organ, states: list[State], kind: str, seed: list[int]) -> StatePath:
    """All of it drawn from the seed."""
    rng = np.random.default_rng(seed)
    events, first, second = _Events(organ, rng), *rng.choice(len(states), 2)
    times_s, shares = STATE_KINDS[kind](events, rng)
    which = [states[first if n < 3 else second] for n in range(len(shares))]
    keys = tuple(zip(which, np.array(shares).tolist(), strict=True))
    about = {
        "states": [state.name for state, _ in keys], "shares": [share for _, share in keys],
        "jumps": events.jumps, "covers": [list(cover) for cover in events.covers],
    }  # fmt: skip
    rim_mm = rng.uniform(0.1, 0.3) * organ.size_mm[2]
    return StatePath(
        organ, np.array(times_s), (), rim_mm, [0.0, times_s[-1]], about,
        events.way, events.bed, covers=tuple(events.covers), shares=keys,
    )  # fmt: skip
