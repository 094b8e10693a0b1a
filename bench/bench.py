"""Speed on this machine: each part beside the naive form of it, interleaved, medians, ratio.

    make bench            (about three minutes; prints a table, writes runs/bench.json)

One thread throughout, so that figures are per core.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import planning
import torch
import trimesh
from rich.console import Console
from rich.table import Table
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from turns import medians

from tumortrack.app.presets import clinic, paper, quick
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.surface import surfaces
from tumortrack.learn.allocator import keep_freed_memory
from tumortrack.learn.config import TrainConfig
from tumortrack.learn.model import has_fast_bfloat16
from tumortrack.learn.network import OccupancyNetwork
from tumortrack.learn.warp.locate import first_motions
from tumortrack.learn.warp.motion import WarpMotion
from tumortrack.learn.warp.network import WarpNetwork
from tumortrack.learn.warp.refine import Refined, refine
from tumortrack.learn.warp.shape import Shape, shape_of
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.simulate.bodies import body_for
from tumortrack.simulate.deform import DragConfig, ElasticConfig
from tumortrack.simulate.deform.drag import Drags
from tumortrack.simulate.deform.elastic import Elastic
from tumortrack.simulate.occupancy import OccupancyConfig, OccupancyPool, labels_of
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator, Stage

UP = (0.0, -1.0, 0.0)
CPU = torch.device("cpu")


def generator(name: str, deform: DragConfig | ElasticConfig) -> tuple[str, float, float]:
    """One training pair: deform 2,000 labelled points and the surface, depth at 424 x 240."""
    anatomy, _ = surfaces(phantom_labels(PhantomParameters()))
    config = SceneConfig(occupancy=OccupancyConfig(per_side=283), deform=(deform,))
    pool = OccupancyPool(anatomy, config.occupancy, 0)
    simulator = Simulator(anatomy, UP, config, body_for(anatomy, UP, config, 0))
    index = iter(range(10**9))

    def ours() -> None:
        for _ in range(20):
            simulator.pair(SceneRecipe(0, "train", next(index)), pool)

    def naive() -> None:
        stage = simulator.stage(SceneRecipe(0, "train", next(index)))
        parts = [part.moved(_plain_carry(stage, part.vertices_mm)) for part in anatomy.parts]
        _plain_depth(trimesh.Trimesh(parts[0].vertices_mm, parts[0].faces, process=False), stage)
        lower, upper = parts[0].box_mm
        points = np.random.default_rng(0).uniform(lower, upper, (2000, 3)).astype(np.float32)
        labels_of(type(anatomy)(tuple(parts)), points)

    mine, plain = medians(ours, naive)
    return f"generator, {name}, 2,000 labels (pairs/s)", 20 / mine, 1 / plain


def _plain_carry(stage: Stage, points_ct: np.ndarray) -> np.ndarray:
    deformation = stage.deformation
    plain = _plain_drags if isinstance(deformation, Drags) else _plain_flow
    return transform_points(stage.camera_from_ct, plain(deformation, points_ct))


def _plain_drags(drags: Drags, points_ct: np.ndarray) -> np.ndarray:
    moved = points_ct.copy()
    for centre, shift, sigma in zip(
        drags.centres_ct, drags.shifts_mm, drags.sigmas_mm, strict=True
    ):
        square = ((moved - centre) ** 2).sum(1)
        moved += np.exp(-0.5 * square / sigma**2)[:, None] * shift
    return moved


def _plain_flow(elastic: Elastic, points_ct: np.ndarray) -> np.ndarray:
    body, steps = elastic.body, 12
    field = np.moveaxis(body.velocity(elastic.coefficients), 3, 0)

    def sample(points: np.ndarray) -> np.ndarray:
        place = (points - body.origin_mm).T / body.spacing_mm
        return np.stack([map_coordinates(f, place, order=1, mode="nearest") for f in field], 1)

    moved = points_ct.copy()
    for _ in range(steps):  # midpoint rule
        moved += sample(moved + sample(moved) / (2 * steps)) / steps
    return moved


def _plain_depth(mesh: trimesh.Trimesh, stage: Stage) -> np.ndarray:
    k = stage.frame.intrinsics
    u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], -1).reshape(-1, 3)
    return mesh.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)[0]


def training_step(name: str, config: TrainConfig, batch: int) -> tuple[str, float, float]:
    """Forward, backward and Adam; naive: fp32."""
    torch.manual_seed(0)
    network = OccupancyNetwork(config.network)
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    clouds, points = 30 * torch.randn(batch, 1000, 3), 40 * torch.randn(batch, 904, 3)
    labels = torch.randint(0, 4, (batch * 904,))

    def step(bf16: bool) -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            logits = network(clouds, points)
        loss = torch.nn.functional.cross_entropy(logits.float().flatten(0, 1), labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    mine, plain = medians(lambda: step(has_fast_bfloat16(CPU)), lambda: step(False))
    return f"training step, {name} (samples/s)", batch / mine, batch / plain


@torch.inference_mode()
def frame(name: str, config: TrainConfig) -> tuple[str, float, float]:
    """1,000 points, 40,000 queries; naive: latent beside every query, fp32, in one piece."""
    torch.manual_seed(0)
    network = OccupancyNetwork(config.network).eval()
    cloud, queries = 30 * torch.randn(1, 1000, 3), 40 * torch.randn(1, 40_000, 3)

    def naive() -> None:
        latent = network.encode(cloud)
        vector = latent.vector.expand(40_000, -1)[None].contiguous()
        terms = network.decoder.prepare(vector[0])
        expanded = tuple(term.transpose(0, 1) for term in terms)
        network.decoder(expanded, (queries - latent.centre_mm) / latent.scale_mm)

    mine, plain = medians(_frame_of(network, cloud, queries), naive)
    return f"frame, 40,000 queries, {name} (frames/s)", 1 / mine, 1 / plain


def _frame_of(
    network: OccupancyNetwork, cloud: torch.Tensor, queries: torch.Tensor
) -> Callable[[], None]:
    """What an occupancy network does for one frame, as ``locate`` does it."""
    folded = network.folded()

    def once() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=has_fast_bfloat16(CPU)):
            latent = folded.encode(cloud)
            for part in queries.split(2048, dim=1):
                folded.query(latent, part)

    return once


class NearestVertex:
    """A surface's signed distance in the plain way: the nearest vertex, seen along its normal."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
        self.tree = cKDTree(mesh.vertices_mm)

    def with_slope(self, points_ct: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nearest = self.tree.query(points_ct)[1]
        normal = self.mesh.vertex_normals[nearest]
        return ((points_ct - self.mesh.vertices[nearest]) * normal).sum(1), normal


class Clinic:
    """A ``clinic`` network, untrained, with the phantom's shape and a deformed scene of it."""

    def __init__(self, anatomy: Anatomy) -> None:
        self.config = clinic(anatomy)
        body = body_for(anatomy, UP, self.config.scene, 0)
        assert body is not None
        self.shape: Shape = shape_of(anatomy, body)
        torch.manual_seed(0)
        self.network = WarpNetwork(self.config.network).eval()
        points = anatomy.organ.vertices_mm[: len(self.network.points)]
        self.network.know(self.shape, UP, points)
        stage = Simulator(anatomy, UP, self.config.scene, body).stage(SceneRecipe(0, "test", 0))
        self.cloud_mm = stage.cloud.points_mm[:1000]
        rotation, place = stage.camera_from_ct[:3, :3], stage.camera_from_ct[:3, 3]
        centre = rotation @ body.center_ct + place + np.array([3.0, -2.0, 2.0])
        # As a trained network leaves it: some millimetres off, no deformation known.
        self.start = WarpMotion(self.shape, rotation, centre, body.mean)

    def refined(self, shape: Shape) -> Refined:
        return refine(shape, self.cloud_mm, replace(self.start, shape=shape), self.config.refine)

    def training_step(self, batch: int) -> tuple[str, float, float]:
        """Forward, backward and Adam; naive: fp32."""
        network = WarpNetwork(self.config.network)
        network.load_state_dict(self.network.state_dict())
        optimizer = torch.optim.Adam(network.parameters(), 1e-3)
        clouds = torch.tensor(self.cloud_mm)[None].expand(batch, -1, -1).contiguous()
        points = self.network.points[None].expand(batch, -1, -1).contiguous()
        labels, pose = torch.zeros(points.shape[:2]).long(), torch.eye(4).expand(batch, 4, 4)

        def step(bf16: bool) -> None:
            with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
                loss = network.loss(clouds, points, labels, pose)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

        mine, plain = medians(lambda: step(has_fast_bfloat16(CPU)), lambda: step(False))
        return "training step, clinic (samples/s)", batch / mine, batch / plain

    def encoded(self, other: TrainConfig) -> tuple[str, float, float]:
        """A cloud to both placements, beside ``quick``'s latent of one."""
        network = OccupancyNetwork(other.network).eval().folded()
        cloud = torch.tensor(self.cloud_mm)[None]
        with torch.inference_mode():
            mine, plain = medians(
                lambda: first_motions(self.network, self.shape, self.cloud_mm),
                lambda: network.encode(cloud),
            )
        return "encode, clinic both ways | quick (clouds/s)", 1 / mine, 1 / plain

    def refinement(self) -> tuple[str, float, float]:
        """1,000 points laid on; naive: the nearest vertex by a tree instead of a field."""
        fields: Any = tuple(NearestVertex(part) for part in self.shape.anatomy_ct.parts)
        plain_shape = replace(self.shape, distances=fields)
        mine, plain = medians(lambda: self.refined(self.shape), lambda: self.refined(plain_shape))
        return "refine, clinic (frames/s)", 1 / mine, 1 / plain

    def live(self, other: TrainConfig) -> tuple[str, float, float]:
        """Placed, refined once, 40,000 points carried back and labelled; beside ``quick``'s."""
        network = OccupancyNetwork(other.network).eval()
        spread = 40 * np.random.default_rng(0).standard_normal((40_000, 3))
        queries = (self.cloud_mm.mean(0) + spread).astype(np.float32)
        cloud, asked = torch.tensor(self.cloud_mm)[None], torch.tensor(queries)[None]

        def ours() -> None:
            first_motions(self.network, self.shape, self.cloud_mm)
            motion = self.refined(self.shape).motion
            self.shape.labels_at(motion.back(queries).astype(np.float32))

        with torch.inference_mode():
            mine, plain = medians(ours, _frame_of(network, cloud, asked))
        return "frame, 40,000 queries, clinic | quick (frames/s)", 1 / mine, 1 / plain


def main() -> None:
    torch.set_num_threads(1)
    keep_freed_memory()
    anatomy, _ = surfaces(phantom_labels(PhantomParameters(), voxel_mm=1.5))
    placed = Clinic(anatomy)
    rows = [
        generator("drags", DragConfig()),
        generator("elastic", ElasticConfig()),
        placed.training_step(32),
        training_step("quick", quick(anatomy), 32),
        training_step("paper", paper(anatomy), 8),
        placed.encoded(quick(anatomy)),
        placed.refinement(),
        placed.live(quick(anatomy)),
        frame("quick", quick(anatomy)),
        frame("paper", paper(anatomy)),
        *planning.rows(),
    ]
    # "A | B": A stands in the first column, B in the second; else the second is the naive form.
    table = Table("part, one core", "tumortrack", "naive", "ratio", title=platform.processor())
    for name, mine, plain in rows:
        table.add_row(name, f"{mine:.1f}", f"{plain:.1f}", f"{mine / plain:.1f} x")
    Console().print(table)
    out = Path("runs/bench.json")
    out.parent.mkdir(exist_ok=True)
    keys = ("name", "tumortrack_per_s", "naive_per_s")
    out.write_text(json.dumps([dict(zip(keys, row, strict=True)) for row in rows], indent=1))


if __name__ == "__main__":
    main()
