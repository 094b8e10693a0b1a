"""A world's scenes, by number: state, true anatomy, view, cloud, disturbance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float64
from safetensors.numpy import load_file, save

from tumortrack.core import store
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.imaging.case import Case, load_case
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.simulate.scene_folder import InnerPoints, Scene, Targets, draw_targets
from tumortrack_lab.tets import TetMesh, tetrahedralise
from tumortrack_lab.twin.apparatus import bench_from_ct, moved
from tumortrack_lab.twin.occluders import ellipsoid
from tumortrack_lab.world import segmentation
from tumortrack_lab.world.families import FAMILIES, Deformed, solve
from tumortrack_lab.world.kidneys import random_anatomy
from tumortrack_lab.world.organ import Organ
from tumortrack_lab.world.views import View, look, organ_cloud

Disturbance = Literal[
    "none", "hidden", "strays", "fat", "white", "scale", "side", "mirrored", "foreign", "nothing"
]
DISTURBANCES: tuple[Disturbance, ...] = get_args(Disturbance)
OTHERS = ("mirrored", "foreign", "nothing")  # not the model's organ: no estimate is right
TETS = "tets.safetensors"  # of a folder's world: filling an organ is not reproducible
_FINE_MM, _EDGE_MM = 0.1, 7.0  # surfaces are simplified by this, edges halved beyond
_HIDDEN = (0.3, 0.7)  # share of what is seen of the organ, where hiding is the disturbance
_SAME_MM = 0.05  # allowed between a kept state and the same, solved again

Generator = np.random.Generator


class WorldConfig(Config, frozen=True, kw_only=True):
    """``edge_mm``, ``envelope``: of the tetrahedra. ``hidden``: share of scenes with a hand or
    instruments, which hide up to ``most_hidden``. ``segmentation``: share of scenes whose truth
    differs from the case as CT segmentations err; 0 switches that off."""

    seed: int = 0
    edge_mm: float = 8.0
    envelope: float = 0.01
    hidden: float = 0.5
    most_hidden: float = 0.7
    segmentation: float = 0.6
    families: tuple[str, ...] = tuple(FAMILIES)
    disturbances: tuple[Disturbance, ...] = ("none",)


class Shown(NamedTuple):
    """A state, the true anatomy in it and inner points (bench frame, mm); ``name``: of
    the state; ``about``: its recipe, as scenes state it."""

    state: Deformed
    truth: Anatomy
    targets: Targets
    name: str
    about: dict[str, Any]


@dataclass(frozen=True, eq=False)
class World:
    """A case on the bench. ``anatomy_ct``: the case's, simplified by 0.1 mm."""

    config: WorldConfig
    case_sha256: str
    anatomy_ct: Anatomy
    bench_from_ct: Float64[np.ndarray, "4 4"]
    organ: Organ
    targets: InnerPoints
    slices_axis: Float64[np.ndarray, " 3"]  # of the CT, bench frame

    @classmethod
    def of(
        cls, case: Case, case_sha256: str, config: WorldConfig, mesh: TetMesh | None = None
    ) -> World:
        """``mesh``: the tetrahedra (bench frame) of a world that goes on: filling an organ is not
        reproducible."""
        to_bench = bench_from_ct(case.anatomy.organ, case.up_lps)
        few = simplified(case.anatomy)
        there, axes = moved(few, to_bench), case.labels.lps_from_index[:3, :3]
        spacing = np.linalg.norm(axes, axis=0)
        if mesh is None:
            mesh = tetrahedralise(there.organ, config.edge_mm, config.envelope)
        thick = axes[:, spacing.argmax()] / spacing.max()
        return cls(
            config, case_sha256, few, to_bench, Organ.of(there, mesh),
            draw_targets(few, config.seed), to_bench[:3, :3] @ thick,
        )  # fmt: skip

    @classmethod
    def opened(cls, case: Path, config: WorldConfig, tets: Path) -> World:
        """The world of a case's folder, with the tetrahedra in a file, which is written if there is
        none."""
        of = partial(cls.of, load_case(case), store.sha256_of(case / store.MANIFEST), config)
        if tets.exists():
            kept = load_file(tets)
            return of(TetMesh(kept["nodes_mm"], kept["tets"]))
        world = of()
        mesh = world.organ.mesh
        store.write_atomically(tets, save({"nodes_mm": mesh.nodes_mm, "tets": mesh.tets}))
        return world

    @property
    def points(self) -> Float64[np.ndarray, "n 3"]:
        """The vertices of all parts at rest, one part after the other, and the inner points (bench
        frame, mm)."""
        inner = transform_points(self.bench_from_ct, self.targets.points_ct)
        return np.concatenate([*(p.vertices_mm for p in self.organ.anatomy.parts), inner])

    def recipe(self, number: int, draws: int = 1, draw: int = 0) -> tuple[str, Disturbance]:
        """Family and disturbance of a state's scene, of so many: all pairs in turn."""
        family = self.config.families[number % len(self.config.families)]
        turn = number // len(self.config.families) * draws + draw
        return family, self.config.disturbances[turn % len(self.config.disturbances)]

    def scene(self, number: int) -> Scene:
        """The same number, the same scene. Raises TumortrackError: its state has no equilibrium, or
        the organ is not found in its image (NoEstimate)."""
        (family, disturbance), config = self.recipe(number), self.config
        rng = np.random.default_rng([config.seed, number, 1])
        state = solve(self.organ, family, config.seed * 1_000_003 + number)
        kind: segmentation.Kind = "none"
        if rng.uniform() < config.segmentation:
            kind = segmentation.KINDS[1 + rng.integers(len(segmentation.KINDS) - 1)]
        true, segmented = segmentation.perturbed(self.organ.anatomy, kind, self.slices_axis, rng)
        truth = true.of(part.moved(state.carry(part.vertices_mm)) for part in true.parts)
        points = state.carry(transform_points(self.bench_from_ct, self.targets.points_ct))
        about = {"family": family, "segmentation": segmented, **state.about}
        shown = Shown(state, truth, self.targets.at(points), f"{config.seed}-{number}", about)
        return self._seen(shown, number, disturbance, rng)

    def kept(self, scene: Scene) -> Shown:
        """The state of an undisturbed scene of this case and these tetrahedra; only slits, whose
        walls are not kept, are solved again. Raises InputError: it shows another organ."""
        meta, parts = scene.meta, ("material", "load", "volume_change", "least_stretch")
        if meta.get("case_sha256", self.case_sha256) != self.case_sha256 or scene.targets is None:
            raise InputError("the scene to be seen again shows another organ than the case.")
        to_bench = np.linalg.inv(np.array(meta["camera_from_bench"]))
        truth = moved(scene.reference, to_bench)
        points = transform_points(to_bench, scene.targets.points_mm)
        targets = replace(scene.targets, points_mm=points)
        family, number, seed = meta["family"], meta["world"]["number"], meta["world"]["seed"]
        about = {name: meta[name] for name in ("family", "segmentation", *parts) if name in meta}
        if family in ("rest", "cut"):
            state = solve(self.organ, family, seed * 1_000_003 + number)
            there = state.carry(transform_points(self.bench_from_ct, scene.targets.points_ct))
            if (off_mm := float(np.abs(there - points).max())) > _SAME_MM:
                raise InputError(f"the state, solved again, is another by {off_mm:.2f} mm.")
        else:  # nodes at rest: they are not used
            mesh, rim_mm = self.organ.mesh, meta["material"]["rim_mm"]
            state = Deformed(self.organ, mesh.nodes_mm, mesh.tets, rim_mm, None, {})
        return Shown(state, truth, targets, f"{seed}-{number}", about)

    def again(self, shown: Shown, number: int, disturbance: Disturbance) -> Scene:
        """Another view of a state, with another noise and this disturbance. Raises NoEstimate: the
        organ is not found in its image."""
        rng = np.random.default_rng([self.config.seed, number, 2])
        return self._seen(shown, number, disturbance, rng)

    def _seen(self, shown: Shown, number: int, disturbance: Disturbance, rng: Generator) -> Scene:
        config = self.config
        state, truth, beside = _replaced(disturbance, shown.state, shown.truth, rng)
        hidden = rng.uniform(0.05, config.most_hidden) * (rng.uniform() < config.hidden)
        if disturbance == "hidden":
            hidden = rng.uniform(*_HIDDEN)
        view = look(state, truth.organ, hidden, rng, beside)
        view, how = _disturbed_frame(disturbance, view, truth.organ, rng)
        cloud, on_organ = organ_cloud(view, truth.organ, rng)
        if disturbance == "strays":
            cloud, how = _with_strays(cloud, rng)
        elif disturbance == "white":
            view, cloud, how = _with_white_noise(view, cloud, rng)
        reference = moved(truth, view.camera_from_bench)
        points = cloud.points_mm[:, None]
        tumor_mm = [
            float(np.linalg.norm(points - part.vertices_mm.mean(0), axis=2).min())
            for part in reference.tumors
        ]
        meta = {
            "case_sha256": self.case_sha256,
            "world": {"number": number, "seed": config.seed},
            "state": shown.name,
            **shown.about,
            "disturbance": {"kind": disturbance, **how},
            "model_organ": disturbance not in OTHERS,
            **view.about,
            "cloud_on_organ": on_organ,
            "tumor_centre_to_cloud_mm": tumor_mm,
            "camera_from_bench": view.camera_from_bench.tolist(),
            "bench_from_ct": self.bench_from_ct.tolist(),
        }
        known = None
        if disturbance not in OTHERS:
            seen_mm = transform_points(view.camera_from_bench, shown.targets.points_mm)
            known = replace(shown.targets, points_mm=seen_mm)
        return Scene(cloud, reference, view.frame, meta, known)


def simplified(anatomy_ct: Anatomy) -> Anatomy:
    """The anatomy whose triangles a world's scenes have."""
    pairs = zip(anatomy_ct.names, anatomy_ct.parts, strict=True)
    solids = (solid_of(part, name) for name, part in pairs)
    return anatomy_ct.of(
        mesh_of(solid.simplify(_FINE_MM).refine_to_length(_EDGE_MM)) for solid in solids
    )


def _replaced(
    kind: Disturbance, state: Deformed, truth: Anatomy, rng: Generator
) -> tuple[Deformed, Anatomy, tuple[Mesh, ...]]:
    """The state with something else in the organ's place, or beside it."""
    low, high = truth.organ.box_mm
    if kind == "mirrored":
        flip = [1.0, -1.0, 1.0]
        parts = (Mesh(part.vertices_mm * flip, part.faces[:, ::-1]) for part in truth.parts)
        return replace(state, wound=None), truth.of(parts), ()
    if kind == "foreign":
        other, up = random_anatomy(int(rng.integers(1 << 31)))
        return replace(state, wound=None), moved(other, bench_from_ct(other.organ, up)), ()
    if kind == "nothing":
        half = (high - low) / 2 * rng.uniform(0.6, 1.1, 3)
        ball = ellipsoid(np.zeros(3), np.ones(3))
        waves = rng.normal(0, 1.5, (3, 8))
        bumps = np.cos(ball.vertices_mm @ waves + rng.uniform(0, 6.3, 8)).mean(1, keepdims=True)
        thing = Mesh((ball.vertices_mm * (1 + 0.5 * bumps)) * half + [0, 0, half[2]], ball.faces)
        return replace(state, wound=None), truth.of((thing,)), ()
    if kind == "fat":
        angle, half = rng.uniform(0, 2 * np.pi), rng.uniform([12, 12, 15], [35, 35, 30])
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        edge = truth.organ.vertices_mm[(truth.organ.vertices_mm @ way).argmax()]
        place = edge + 0.3 * half.mean() * way
        place[2] = low[2] + rng.uniform(0.5, 0.9) * (high[2] - low[2]) - 0.7 * half[2]
        return state, truth, (ellipsoid(place, half),)
    return state, truth, ()


def _disturbed_frame(
    kind: Disturbance, view: View, organ: Mesh, rng: Generator
) -> tuple[View, dict[str, Any]]:
    """The view through a sensor out of order, and by how much."""
    depth = view.frame.depth_mm
    if kind == "scale":
        scale, by_mm = 1 + rng.choice([-1, 1]) * rng.uniform(0.02, 0.1), rng.uniform(-8.0, 8.0)
        how, depth = {"scale": scale, "offset_mm": by_mm}, depth * scale + by_mm
    elif kind == "side":
        there = transform_points(view.camera_from_bench, organ.vertices_mm)
        camera = view.frame.intrinsics
        pixels = there[:, :2] / there[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        angle, share = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 0.65)
        way = np.array([np.cos(angle), np.sin(angle)])
        v, u = np.indices(depth.shape)
        lost = u * way[0] + v * way[1] > np.quantile(pixels @ way, 1 - share)
        how, depth = {"lost_share": share}, np.where(lost, np.nan, depth)
    else:
        return view, {}
    return replace(view, frame=view.frame.with_depth(depth.astype(np.float32))), how


def _with_white_noise(
    view: View, cloud: SensorCloud, rng: Generator
) -> tuple[View, SensorCloud, dict[str, Any]]:
    """1 to 2 mm along each ray, in image and points alike, after the organ was segmented."""
    std_mm, depth = rng.uniform(1.0, 2.0), view.frame.depth_mm
    noisy = depth + rng.normal(0, std_mm, depth.shape).astype(np.float32)
    z = cloud.points_mm[:, 2:].astype(float)
    points = cloud.points_mm * (1 + rng.normal(0, std_mm, z.shape) / z)
    view = replace(view, frame=view.frame.with_depth(noisy))
    return view, SensorCloud(points.astype(np.float32), cloud.stamp_ns), {"std_mm": std_mm}


def _with_strays(cloud: SensorCloud, rng: Generator) -> tuple[SensorCloud, dict[str, Any]]:
    """10 to 40 % of the points lie anywhere in the organ's box, a quarter wider."""
    points = cloud.points_mm.copy()
    share = rng.uniform(0.1, 0.4)
    stray = rng.random(len(points)) < share
    low, high = points.min(0), points.max(0)
    points[stray] = low + (high - low) * rng.uniform(-0.125, 1.125, (int(stray.sum()), 3))
    points[:, 2] = np.maximum(points[:, 2], 1.0)
    return SensorCloud(points.astype(np.float32), cloud.stamp_ns), {"share": share}
