"""Sequences on disk: depth images of a moving organ by one or three cameras, and the truth.

SEQUENCES/
  sequences.json, tets.safetensors   the inputs of everything here
  press-000/
    view_0/, view_1/, view_2/   depth images named by their stamps, and intrinsics.json: recordings
                                that `tumortrack track --source recording:PATH` plays
    poses.json                  first_from_camera of each view: the true one, and a calibration's
    truth.safetensors           see ``Film``
    meta.json                   kind, material, load, phases, camera
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from safetensors.numpy import load_file, save
from scipy.spatial.transform import Rotation

from tumortrack.core import store
from tumortrack.core.config import Config
from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.rigid_fit import fit_over_volume
from tumortrack.core.types import Anatomy, DepthFrame, Mesh
from tumortrack.sense.camera import d405
from tumortrack.sense.files import depth_png, intrinsics_json
from tumortrack_devices.recording.folders import INTRINSICS, folder_frames
from tumortrack_lab.world.noise import StereoCamera, StereoConfig
from tumortrack_lab.world.paths import KINDS, LoadPath, random_path
from tumortrack_lab.world.scenes import World
from tumortrack_lab.world.states import STATE_KINDS, State, state_path
from tumortrack_lab.world.views import (
    FAR_MM,
    SIZE_PX,
    covering,
    direction,
    facing,
    ground_mesh,
    pose_before,
    render,
)

_VIEWS_DEGREES = (0.0, 45.0, -45.0)  # about the organ's length
_NEAREST_MM = (110.0, 190.0)  # so that an organ that is pushed stays in the picture
_MOST_TILT = 25.0  # of the first camera, degrees
_BEGIN_NS = 1_700_000_000_000_000_000
ALL_KINDS = (*KINDS, *STATE_KINDS)
COVERED_S = 0.3  # until what hides the organ has come, or gone
_BESIDE = 0.8  # how far away it starts, in units of ``views.covering``
_ATTEMPTS = 4  # loads, until one has equilibria all along
# Of a calibration between cameras, one standard deviation each: an assumption.
_POSE_MM, _POSE_DEGREES = 0.5, 0.2


class FilmConfig(Config, frozen=True, kw_only=True):
    """``views``: one camera, or three: above the organ and 45 degrees to either side of that."""

    seed: int = 0
    fps: float = 10.0
    views: Literal[1, 3] = 1


@dataclass(frozen=True, eq=False)
class Film:
    """A sequence of f frames. Truth in the first camera's frame, mm.

    Attributes:
        vertices_mm: of all parts, one part after the other, as in ``rest``.
        camera_from_ct: the best rigid pose over the organ's volume.
        bend_mm: the largest displacement of the organ's surface that this pose leaves.
        hidden_share: of the organ's picture in the first view, by what lies before it.
        targets_mm: points inside the organ, as ``targets_ct``.
    """

    folder: Path
    rest: Anatomy  # CT frame
    meta: dict[str, Any]
    stamps_ns: Int64[np.ndarray, " f"]
    vertices_mm: Float32[np.ndarray, "f v 3"]
    camera_from_ct: Float64[np.ndarray, "f 4 4"]
    bend_mm: Float64[np.ndarray, " f"]
    hidden_share: Float64[np.ndarray, " f"]
    targets_ct: Float64[np.ndarray, "t 3"]
    targets_mm: Float32[np.ndarray, "f t 3"]

    def truth(self, frame: int) -> Anatomy:
        return _parted(self.rest, self.vertices_mm[frame].astype(float))

    @property
    def seconds(self) -> Float64[np.ndarray, " f"]:
        """Since the first frame."""
        return (self.stamps_ns - self.stamps_ns[0]) * 1e-9

    @cached_property
    def _frames(self) -> list[list]:
        views = sorted(self.folder.glob("view_*"))
        return [folder_frames(view, 10.0, "mm") for view in views]

    def looks(self, frame: int) -> tuple[DepthFrame, ...]:
        """What each camera saw, with the stamp."""
        loaded = [view[frame].load().content for view in self._frames]
        return tuple(replace(image, stamp_ns=int(self.stamps_ns[frame])) for image in loaded)

    def first_from_camera(self, as_it_is: bool = False) -> Float64[np.ndarray, "views 4 4"]:
        """Of each view, with a calibration's errors, or exact."""
        poses = store.read_json(self.folder / "poses.json")
        return np.array(poses["first_from_camera" + ("" if as_it_is else "_stated")])


def _parted(rest: Anatomy, vertices: Float[np.ndarray, "v 3"]) -> Anatomy:
    ends = np.cumsum([len(part.vertices_mm) for part in rest.parts])[:-1]
    pairs = zip(rest.parts, np.split(vertices, ends), strict=True)
    return rest.of(part.moved(places) for part, places in pairs)


def write_film(
    world: World, config: FilmConfig, kind: str, number: int, folder: Path,
    states: Callable[[], list[State]] = list,
) -> None:  # fmt: skip
    """Solve, render and write one sequence, all or nothing; ``states``: solved states, for the
    kinds that use them. Raises TumortrackError: none of several loads has equilibria all along its
    path; StorageError."""
    seed = [config.seed, ALL_KINDS.index(kind), number]
    path, failed = _some_path(world, kind, seed, states)
    rng, rest = np.random.default_rng([*seed, 1]), world.organ.anatomy
    moving = path.of(world.points)
    times_s = np.arange(int(path.seconds * config.fps) + 1) / config.fps
    there = [transform_points(path.way(t), moving.at(t)) for t in times_s]
    organ = [Mesh(places[: len(rest.organ.vertices_mm)], rest.organ.faces) for places in there]
    tilt, turn, roll = rng.uniform(0, _MOST_TILT), *rng.uniform(0, 2 * np.pi, 2)
    nearest, first = rng.uniform(*_NEAREST_MM), facing(direction(tilt, turn), roll)
    turns = [Rotation.from_euler("x", angle, degrees=True) for angle in _VIEWS_DEGREES]
    poses = [
        pose_before(organ[0], first @ turn.as_matrix().T, nearest) for turn in turns[: config.views]
    ]
    stamps_ns = _BEGIN_NS + np.rint(times_s * 1e9).astype(np.int64)
    tools = _tools(path, organ, times_s, poses[0], rng) if path.covers else path.tools
    with store.new_folder(folder) as aside:
        views = [
            _filmed(path, organ, pose, stamps_ns, aside / f"view_{n}", [*seed, 2 + n], tools)
            for n, pose in enumerate(poses)
        ]
        exact = np.array([poses[0] @ np.linalg.inv(pose) for pose in poses])
        stated = [exact[0], *(pose @ _small_error(rng) for pose in exact[1:])]
        store.write_json(
            aside / "poses.json",
            {
                "units": "mm",
                "first_from_camera": exact.tolist(),
                "first_from_camera_stated": np.array(stated).tolist(),
            },
        )
        in_camera = [transform_points(poses[0], places) for places in there]
        _write_truth(aside, world, stamps_ns, np.array(in_camera), views[0])
        meta = {
            "kind": kind, "number": number, "seed": config.seed, "failed_loads": failed,
            "phases_s": path.phases_s, **path.about,
            "tilt_degrees": tilt, "nearest_mm": nearest,
            "bench_from_ct": world.bench_from_ct.tolist(),
            "first_from_bench": poses[0].tolist(),
        }  # fmt: skip
        store.write_json(aside / "meta.json", meta)


def _some_path(
    world: World, kind: str, seed: list[int], states: Callable[[], list[State]]
) -> tuple[LoadPath, int]:
    if kind in STATE_KINDS:
        return state_path(world.organ, states(), kind, [*seed, 3]), 0
    for attempt in range(_ATTEMPTS):
        try:
            return random_path(world.organ, kind, [*seed, 3, attempt]), attempt
        except TumortrackError as error:
            last = error
    raise last


def _tools(
    path: LoadPath, organ: list[Mesh], times_s: np.ndarray, pose: np.ndarray,
    rng: np.random.Generator,
) -> Callable[[float], list[Mesh]]:  # fmt: skip
    """Meshes that hide the organ, by time (bench frame), placed for the middle of their stay."""
    camera, placed, back = d405(*SIZE_PX), [], np.linalg.inv(pose)
    for cover in path.covers:
        middle = int(np.searchsorted(times_s, (cover.since_s + cover.until_s) / 2))
        depth = render(organ[min(middle, len(organ) - 1)], pose, camera)
        own = np.isfinite(depth)
        if own.any():
            placed.append((cover, *covering(depth, own, camera, cover.share, rng)))

    def tools(time_s: float) -> list[Mesh]:
        shown = []
        for (since_s, until_s, _), at, share, _ in placed:
            ramp = [since_s - COVERED_S, since_s, until_s, until_s + COVERED_S]
            there = float(np.interp(time_s, ramp, [0.0, 1.0, 1.0, 0.0]))
            if there > 0:
                mesh = at(share - _BESIDE * (1 - there))
                shown.append(mesh.moved(transform_points(back, mesh.vertices_mm)))
        return shown

    return tools


def _filmed(
    path: LoadPath, organ: list[Mesh], pose: np.ndarray, stamps_ns: np.ndarray, folder: Path,
    seed: list[int], tools: Callable[[float], list[Mesh]],
) -> Float64[np.ndarray, " f"]:  # fmt: skip
    """One camera's frames, written; the share of the organ that is hidden in each."""
    folder.mkdir()
    rng, camera = np.random.default_rng(seed), d405(*SIZE_PX)
    sensor = StereoConfig(subpixel_px=rng.uniform(0.03, 0.12), gloss_degrees=rng.uniform(2.0, 7.0))
    sees = StereoCamera(camera, sensor, rng)
    bed = ground_mesh(path.rim_mm, np.random.default_rng(seed[:-1]))
    below, hidden, there = np.empty(0), [], np.zeros((4, 4))
    for mesh, stamp_ns in zip(organ, stamps_ns.tolist(), strict=True):
        time_s = (stamp_ns - _BEGIN_NS) * 1e-9
        if not np.array_equal(path.bed(time_s), there):
            there = path.bed(time_s)
            below = render(bed, pose @ there, camera)
        own = render(mesh, pose, camera)
        others = [below, *(render(tool, pose, camera) for tool in tools(time_s))]
        scene = np.fmin.reduce([own, *others])
        with np.errstate(invalid="ignore"):
            shown = np.isfinite(own) & (own <= scene)
            scene[scene > FAR_MM] = np.nan
        hidden.append(1 - float(shown.sum() / max(int(np.isfinite(own).sum()), 1)))
        frame = sees.see(scene.astype(np.float32), stamp_ns)
        store.write_atomically(folder / f"{stamp_ns}.png", depth_png(frame, compress_level=1))
    store.write_json(folder / INTRINSICS, intrinsics_json(camera))
    return np.array(hidden)


def _write_truth(
    folder: Path, world: World, stamps_ns: np.ndarray, seen_mm: np.ndarray, hidden: np.ndarray
) -> None:
    rest = world.anatomy_ct
    count = sum(len(part.vertices_mm) for part in rest.parts)
    poses, bends = [], []
    for places in seen_mm:
        now = rest.organ.moved(places[: len(rest.organ.vertices_mm)])
        pose = fit_over_volume(rest.organ, now)[0]
        left = transform_points(pose, rest.organ.vertices_mm) - now.vertices_mm
        poses.append(pose)
        bends.append(np.linalg.norm(left, axis=1).max())
    tensors = {
        "stamps_ns": stamps_ns,
        "vertices_ct": np.concatenate([part.vertices_mm for part in rest.parts]),
        "faces": np.concatenate([part.faces for part in rest.parts]).astype(np.int32),
        "sizes": np.array([[len(p.vertices_mm), len(p.faces)] for p in rest.parts]),
        "vertices_mm": seen_mm[:, :count].astype(np.float32),
        "camera_from_ct": np.array(poses),
        "bend_mm": np.array(bends),
        "hidden_share": hidden,
        "targets_ct": world.targets.points_ct,
        "targets_mm": seen_mm[:, count:].astype(np.float32),
    }
    contiguous = {name: np.ascontiguousarray(values) for name, values in tensors.items()}
    store.write_atomically(folder / "truth.safetensors", save(contiguous))


def read_film(folder: Path) -> Film:
    """Read a sequence that ``write_film`` wrote."""
    kept = load_file(folder / "truth.safetensors")
    sizes, vertices, faces = (kept.pop(name) for name in ("sizes", "vertices_ct", "faces"))
    ends = np.cumsum(sizes, axis=0)[:-1].T
    pairs = zip(np.split(vertices, ends[0]), np.split(faces, ends[1]), strict=True)
    rest = Anatomy(tuple(Mesh(*pair) for pair in pairs))
    return Film(folder, rest, store.read_json(folder / "meta.json"), **kept)


def _small_error(rng: np.random.Generator) -> Float64[np.ndarray, "4 4"]:
    turn = Rotation.from_rotvec(rng.normal(0, _POSE_DEGREES, 3), degrees=True)
    return rigid(turn.as_matrix(), rng.normal(0, _POSE_MM, 3))
