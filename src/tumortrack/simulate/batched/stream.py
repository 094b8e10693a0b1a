"""The addressable stream of training batches, made on a device.

Random numbers are drawn on the host, scene by scene (``plan``), so that a recipe is the same scene
however it is made. Work on every vertex, pixel and point runs batched (``render``). The compiled
scenes of ``simulate.scene`` are the reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from tumortrack.core.errors import InputError
from tumortrack.sense.camera import d405
from tumortrack.sense.cloud import FEWEST_POINTS, draw_some
from tumortrack.sense.noise import CALIBRATED, CLEAN
from tumortrack.simulate.batched.plan import BatchPlan, plan_scenes
from tumortrack.simulate.batched.render import carried, depth_images
from tumortrack.simulate.dataset import SceneStream, refill
from tumortrack.simulate.deform import DragConfig, RestConfig, StretchConfig
from tumortrack.simulate.deform.chain import links_of
from tumortrack.simulate.occupancy import OccupancyPool
from tumortrack.simulate.scene import ATTEMPTS, SceneRecipe, shows_nothing

# clouds_mm (b, n, 3), points_mm (b, q, 3), labels (b, q), camera_from_ct (b, 4, 4)
Tensors = tuple[Tensor, Tensor, Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class RenderedBatch:
    """A plan whose images show enough, these images, and their pixels in range: counted up to each
    pixel (on the device) and in total (on the host)."""

    plan: BatchPlan
    depth_mm: Float32[Tensor, "b h w"]
    counted: Int32[Tensor, "b hw"]
    available: Int32[np.ndarray, " b"]


@dataclass(frozen=True, eq=False)
class SampleChoice:
    """The pixels in range that become a scene's cloud, and the points of the pools (first, count;
    the last of those anywhere) that it considers."""

    ranks: Int32[np.ndarray, "b n"]
    windows: Int64[np.ndarray, "b w 2"]


class DeviceStream:
    """The batches of a ``SceneStream`` as tensors on a device.

    Apart from float32 rounding, which may flip a pixel on a silhouette, a batch has the stream's
    values; a scene's labelled points come in another order. A batch is made in four steps, so that
    they can be pipelined: ``plan`` (host), ``render`` (device), ``sample`` (host), ``assemble``
    (device). Only each scene's number of pixels in range returns from the device; the random
    choice among them depends on it.

    Raises:
        InputError: scenes that ``why_not`` refuses.
    """

    def __init__(self, stream: SceneStream, device: torch.device) -> None:
        reason = why_not(stream)
        if reason is not None:
            raise InputError(f"these scenes cannot be made in batches. {reason}.")
        self._stream = stream
        self._device = device
        self._intrinsics = d405(stream.config.width, stream.config.height)

    def __getstate__(self) -> dict[str, Any]:
        held = ("_stream", "_device", "_intrinsics")
        return {name: self.__dict__[name] for name in held}

    @cached_property
    def _organ(self) -> tuple[Float32[Tensor, "3 v"], Tensor]:
        organ = self._stream.anatomy_ct.organ
        vertices = torch.tensor(organ.vertices_mm.T, dtype=torch.float32, device=self._device)
        return vertices, torch.tensor(organ.faces, dtype=torch.int64, device=self._device)

    @cached_property
    def _pool(self) -> _DevicePool:
        assert isinstance(self._stream.pool, OccupancyPool)
        return _DevicePool(self._stream.pool, self._device)

    def batch(self, index: int) -> Tensors:
        """The batch with this number."""
        rendered = self.render(self.plan(index))
        return self.assemble(rendered, self.sample(rendered))

    def plan(self, *indices: int) -> BatchPlan:
        """The random part of the batches with these numbers, up to their images; no device is
        needed. Several are made together, their scenes batch after batch."""
        size, seed, name = self._stream.batch_size, self._stream.seed, self._stream.stream
        numbers = (index * size + row for index in indices for row in range(size))
        recipes = [SceneRecipe(seed, name, number) for number in numbers]
        return plan_scenes(self._stream.simulator, recipes, [0] * len(recipes))

    @torch.no_grad()
    def render(self, plan: BatchPlan) -> RenderedBatch:
        """The plan's depth images; scenes that show too little are drawn again.

        Raises:
            TumortrackError: no pose of a scene shows enough of the organ.
        """
        depth_mm, counted = self._render(plan)
        while True:
            available = counted[:, -1].cpu().numpy()
            few = np.flatnonzero(available < FEWEST_POINTS)
            if len(few) == 0:
                return RenderedBatch(plan, depth_mm, counted, available)
            attempts = plan.attempts[few] + 1
            if attempts.max() >= ATTEMPTS:
                raise shows_nothing(plan.recipes[few[attempts.argmax()]])
            again = plan_scenes(
                self._stream.simulator, plan.recipes[few].tolist(), attempts.tolist()
            )
            plan = plan.replaced(few, again)
            rows = self._sent(few)
            depth_mm[rows], counted[rows] = self._render(again)

    def sample(self, rendered: RenderedBatch) -> SampleChoice:
        """What is drawn after the images. Needs no device, so that a thread can do it alongside
        the device's work."""
        assert isinstance(self._stream.pool, OccupancyPool)
        plan, n = rendered.plan, self._stream.config.cloud.n_points
        rng = np.random.default_rng()
        ranks, windows = [], []
        counts = rendered.available.tolist(), plan.n_points.tolist()
        for state, count, wanted in zip(plan.states, *counts, strict=True):
            rng.bit_generator.state = state
            ranks.append(refill(draw_some(count, wanted, rng), n))
            windows.append(self._stream.pool.windows(rng))
        return SampleChoice(np.stack(ranks).astype(np.int32), np.array(windows))

    @torch.no_grad()
    def assemble(self, rendered: RenderedBatch, chosen: SampleChoice) -> Tensors:
        """The clouds of the chosen pixels, and labelled points at their places, camera frame."""
        camera, plan, windows = self._intrinsics, rendered.plan, chosen.windows
        pixel = torch.searchsorted(rendered.counted, self._sent(chosen.ranks) + 1)
        z = rendered.depth_mm.flatten(1).gather(1, pixel).double()
        row = pixel.div(camera.width, rounding_mode="floor")
        x = (pixel - row * camera.width - camera.cx) * (z / camera.fx)
        y = (row - camera.cy) * (z / camera.fy)
        clouds_mm = torch.stack([x, y, z], -1).float()
        points_ct, labels = self._pool.take(self._sent(windows), windows[:, :, 1].max(0).tolist())
        points_mm = carried(plan, points_ct)
        poses = self._sent(plan.camera_from_ct.astype(np.float32))
        return clouds_mm, points_mm.permute(1, 2, 0).contiguous(), labels, poses

    def _render(self, plan: BatchPlan) -> tuple[Float32[Tensor, "b h w"], Int32[Tensor, "b hw"]]:
        """Depth images (mm, NaN where there is nothing), and the running count, in row-major order,
        of their pixels strictly within the plan's depths."""
        vertices_ct, faces = self._organ
        everywhere = vertices_ct[:, None].expand(-1, len(plan.recipes), -1)
        depth_mm = depth_images(carried(plan, everywhere), faces, self._intrinsics)
        near, far = self._sent(plan.near_mm)[:, None], self._sent(plan.far_mm)[:, None]
        flat = depth_mm.flatten(1)
        return depth_mm, ((flat > near) & (flat < far)).cumsum(1, dtype=torch.int32)

    def _sent(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self._device, non_blocking=True)


def why_not(stream: SceneStream) -> str | None:
    """Why a stream's batches cannot be made on a device; None where they can."""
    if not isinstance(stream.pool, OccupancyPool):
        return "Points that are the same in every scene: made on the CPU alone"
    config = stream.config
    parts = {
        "sensor noise": config.noise != CLEAN,
        "background": config.clutter.scenes > 0,
        "occlusion": config.occlusion.scenes > 0 and config.occlusion.largest_share > 0,
        "cameras out of calibration": config.calibration != CALIBRATED,
        "deformations other than drags, squeezing and bending": not all(
            # Some drags, and then at most one squeeze and bend.
            all(isinstance(link, DragConfig) for link in first)
            and isinstance(last, DragConfig | StretchConfig | RestConfig)
            for *first, last in map(links_of, config.deform)
        ),
    }
    lacks = [what for what, on in parts.items() if on]
    return f"{', '.join(lacks)}: made on the CPU alone" if lacks else None


class _DevicePool:
    """An ``OccupancyPool`` on a device."""

    def __init__(self, pool: OccupancyPool, device: torch.device) -> None:
        def sent(array: np.ndarray) -> Tensor:
            return torch.tensor(array, device=device)

        self._per_side = pool.config.per_side
        points = [(part.points_ct, part.labels) for part in pool.parts]
        points.append((pool.far_points_ct, pool.far_labels))
        self._points = [(sent(points_ct.T), sent(labels)) for points_ct, labels in points]
        self._sides = [(sent(part.distance_mm), sent(part.inside)) for part in pool.parts]

    def take(self, windows: Int64[Tensor, "b w 2"], widest: list[int]) -> tuple[Tensor, Tensor]:
        """The points (3 b q, undeformed CT frame) and labels (b q) that ``OccupancyPool.draw``
        takes from these windows (first, count); on each side of a part the nearest first.
        ``widest`` is each column's greatest count."""
        chosen = []
        for n, ((_, labels), width) in enumerate(zip(self._points, widest, strict=True)):
            step = torch.arange(width, device=windows.device)
            index = (windows[:, n, :1] + step) % len(labels)
            if n < len(self._sides):
                index = self._nearest(index, step >= windows[:, n, 1:], *self._sides[n])
            chosen.append(index)
        pairs = list(zip(self._points, chosen, strict=True))
        points = torch.cat([points[:, index] for (points, _), index in pairs], -1)
        return points, torch.cat([labels[index] for (_, labels), index in pairs], -1)

    def _nearest(
        self, index: Int64[Tensor, "b w"], beyond: Tensor, distance_mm: Tensor, inside: Tensor
    ) -> Int64[Tensor, "b m"]:
        """Of a window's points the k inside that are nearest to the surface, and k outside, the
        nearest first."""
        distance, within = distance_mm[index], inside[index]
        sides = []
        for other in (~within, within):
            left_out = distance.masked_fill(other | beyond, torch.inf)
            nearest = left_out.topk(self._per_side, dim=1, largest=False).indices
            sides.append(index.gather(1, nearest))
        return torch.cat(sides, 1)
