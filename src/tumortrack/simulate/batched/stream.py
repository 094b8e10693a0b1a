"""The addressable stream of training batches, made on a device.

Random numbers are drawn on the host, scene by scene, so that a recipe is the same scene however it
is made. Work on every vertex, pixel and point runs batched. The compiled scenes of
``simulate.scene`` are the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64
from torch import Tensor

from tumortrack.sense.camera import d405
from tumortrack.sense.cloud import FEWEST_POINTS, draw_some
from tumortrack.sense.noise import CALIBRATED, CLEAN
from tumortrack.simulate import scene as scenes
from tumortrack.simulate.batched.render import depth_images
from tumortrack.simulate.deform import Chain, DragConfig, RestConfig, StretchConfig, links_of
from tumortrack.simulate.deform.base import Deformation
from tumortrack.simulate.deform.drag import Drags
from tumortrack.simulate.deform.stretch import Stretch
from tumortrack.simulate.occupancy import OccupancyPool
from tumortrack.simulate.scene import SceneRecipe, SceneStream

# clouds_mm (b, n, 3), points_mm (b, q, 3), labels (b, q), camera_from_ct (b, 4, 4)
Tensors = tuple[Tensor, Tensor, Tensor, Tensor]
SampleChoice = tuple[Int32[np.ndarray, "b n"], Int64[np.ndarray, "b w 2"]]
Points = Float32[Tensor, "3 b n"]
# A stretch as 20 numbers: centre (3), matrix (9), along (3), across (3), sagitta, reach.
_NO_STRETCH = np.array([*[0] * 3, *np.eye(3).ravel(), 1, 0, 0, 0, 1, 0, 0, 1], np.float32)
_SMALLEST = -12.0  # a drag's exponents below, factors of 6e-6, count as zero


@dataclass(frozen=True, eq=False)
class BatchPlan:
    """The random part of b scenes up to their images, k drags each (shift 0: none); mm.
    Picklable."""

    recipes: np.ndarray  # of SceneRecipe
    attempts: Int64[np.ndarray, " b"]  # number of the draw of each recipe
    camera_from_ct: Float64[np.ndarray, "b 4 4"]
    centres_ct: Float32[np.ndarray, "b k 3"]
    shifts_mm: Float32[np.ndarray, "b k 3"]
    sigmas_mm: Float32[np.ndarray, "b k"]
    stretches: Float32[np.ndarray, "b s 20"]  # s is 1 where the configuration has any, else 0
    near_mm: Float32[np.ndarray, " b"]  # the cloud's depth range
    far_mm: Float32[np.ndarray, " b"]
    n_points: Int64[np.ndarray, " b"]
    states: np.ndarray  # of the generators, for what is drawn after rendering

    def replaced(self, rows: Int64[np.ndarray, " r"], others: BatchPlan) -> BatchPlan:
        """The plan with other scenes in these rows."""
        arrays = {name: array.copy() for name, array in vars(self).items()}
        for name, array in arrays.items():
            array[rows] = getattr(others, name)
        return BatchPlan(**arrays)


@dataclass(frozen=True, eq=False)
class RenderedBatch:
    """A plan whose images show enough, these images, and their pixels in range: counted up to each
    pixel (on the device) and in total (on the host)."""

    plan: BatchPlan
    depth_mm: Float32[Tensor, "b h w"]
    counted: Int32[Tensor, "b hw"]
    available: Int32[np.ndarray, " b"]


class DeviceStream:
    """The batches of a ``SceneStream`` as tensors on a device.

    Apart from float32 rounding, which may flip a pixel on a silhouette, a batch has the stream's
    values; a scene's labelled points come in another order. A batch is made in four steps, so that
    they can be pipelined: ``plan`` (host), ``render`` (device), ``sample`` (host), ``assemble``
    (device). Only each scene's number of pixels in range returns from the device; the random
    choice among them depends on it. Pickled without what lies on the device. Only for streams that
    ``why_not`` lets pass.
    """

    def __init__(self, stream: SceneStream, device: torch.device) -> None:
        assert isinstance(stream.pool, OccupancyPool)
        self._stream, self._device, self._pool = stream, device, stream.pool
        self._camera = d405(stream.config.width, stream.config.height)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k != "_tensors"}

    @cached_property
    def _tensors(self) -> list[list[Tensor]]:
        """The organ's vertices (3, v) and faces; of each part points (3, n), labels, distances to
        its surface, whether they are inside; last points and labels of those anywhere."""
        organ, pool = self._stream.anatomy_ct.organ, self._pool
        arrays: list[tuple[np.ndarray, ...]] = [
            (organ.vertices_mm.T.astype(np.float32), organ.faces.astype(np.int64)),
            *((p.points_ct.T, p.labels, p.distance_mm, p.inside) for p in pool.parts),
            (pool.far_points_ct.T, pool.far_labels),
        ]
        return [[torch.tensor(one, device=self._device) for one in row] for row in arrays]

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
        return self._planned(recipes, [0] * len(recipes))

    @torch.no_grad()
    def render(self, plan: BatchPlan) -> RenderedBatch:
        """The plan's depth images; scenes that show too little are drawn again. Raises
        TumortrackError where no pose of a scene shows enough of the organ."""
        depth_mm, counted = self._render(plan)
        while True:
            available = counted[:, -1].cpu().numpy()
            few = np.flatnonzero(available < FEWEST_POINTS)
            if len(few) == 0:
                return RenderedBatch(plan, depth_mm, counted, available)
            attempts = plan.attempts[few] + 1
            if attempts.max() >= scenes.ATTEMPTS:
                raise scenes.shows_nothing(plan.recipes[few[attempts.argmax()]])
            again = self._planned(plan.recipes[few].tolist(), attempts.tolist())
            plan, rows = plan.replaced(few, again), self._sent(few)
            depth_mm[rows], counted[rows] = self._render(again)

    def sample(self, rendered: RenderedBatch) -> SampleChoice:
        """What is drawn after the images: each scene's pixels in range that become its cloud, and
        the points of the pools that it considers, see ``OccupancyPool.windows``. Needs no device,
        so that a thread can do it alongside the device's work."""
        plan, n = rendered.plan, self._stream.config.cloud.n_points
        rng = np.random.default_rng()
        ranks, windows = [], []
        counts = rendered.available.tolist(), plan.n_points.tolist()
        for state, count, wanted in zip(plan.states, *counts, strict=True):
            rng.bit_generator.state = state
            ranks.append(scenes.refill(draw_some(count, wanted, rng), n))
            windows.append(self._pool.windows(rng))
        return np.stack(ranks).astype(np.int32), np.array(windows)

    @torch.no_grad()
    def assemble(self, rendered: RenderedBatch, chosen: SampleChoice) -> Tensors:
        """The clouds of the chosen pixels, and labelled points at their places, camera frame."""
        (ranks, windows), camera, plan = chosen, self._camera, rendered.plan
        pixel = torch.searchsorted(rendered.counted, self._sent(ranks) + 1)
        z = rendered.depth_mm.flatten(1).gather(1, pixel).double()
        row = pixel.div(camera.width, rounding_mode="floor")
        x = (pixel - row * camera.width - camera.cx) * (z / camera.fx)
        y = (row - camera.cy) * (z / camera.fy)
        clouds_mm = torch.stack([x, y, z], -1).float()
        points_ct, labels = self._taken(windows)
        points_mm = carried(plan, points_ct)
        poses = self._sent(plan.camera_from_ct.astype(np.float32))
        return clouds_mm, points_mm.permute(1, 2, 0).contiguous(), labels, poses

    def _planned(self, recipes: Sequence[SceneRecipe], attempts: Sequence[int]) -> BatchPlan:
        """Draw the scenes of these recipes, each at this attempt."""
        simulator = self._stream.simulator
        models = [links_of(model) for model in simulator.config.deform]
        n_drags = max(
            sum(n for link in links if isinstance(link, DragConfig) for _, _, n in link.steps)
            for links in models
        )
        n_stretches = int(any(isinstance(links[-1], StretchConfig) for links in models))
        rows = []
        for recipe, attempt in zip(recipes, attempts, strict=True):
            rng = recipe.generator(attempt)
            camera_from_ct, deformation, free = simulator.draw(rng)
            rng.integers(2**62)  # the seed of a noise that is off
            crop = scenes.crop_of(simulator.config, free, rng)
            motion = _as_arrays(deformation, n_drags, n_stretches)
            depths = np.float32(crop.near_mm), np.float32(crop.far_mm), crop.n_points
            rows.append((camera_from_ct, *motion, *depths, rng.bit_generator.state))
        *columns, states = zip(*rows, strict=True)
        arrays = [np.array(recipes, object), np.array(attempts), *map(np.stack, columns)]
        arrays.append(np.array(states, object))
        return BatchPlan(*arrays)

    def _render(self, plan: BatchPlan) -> tuple[Float32[Tensor, "b h w"], Int32[Tensor, "b hw"]]:
        """Depth images (mm, NaN where there is nothing), and the running count, in row-major order,
        of their pixels strictly within the plan's depths."""
        vertices_ct, faces = self._tensors[0]
        everywhere = vertices_ct[:, None].expand(-1, len(plan.recipes), -1)
        depth_mm = depth_images(carried(plan, everywhere), faces, self._camera)
        near, far = self._sent(plan.near_mm)[:, None], self._sent(plan.far_mm)[:, None]
        flat = depth_mm.flatten(1)
        return depth_mm, ((flat > near) & (flat < far)).cumsum(1, dtype=torch.int32)

    def _taken(self, windows: Int64[np.ndarray, "b w 2"]) -> tuple[Points, Tensor]:
        """The points (undeformed CT frame) and labels (b, n) that ``OccupancyPool.draw`` takes from
        these windows; on each side of a part, first inside, the nearest come first."""
        points, labels, sent = [], [], self._sent(windows)
        widths = windows[..., 1].max(0)
        for n, (part, widest) in enumerate(zip(self._tensors[1:], widths, strict=True)):
            first, count = sent[:, n, :1], sent[:, n, 1:]
            step = torch.arange(int(widest), device=self._device)
            index = (first + step) % len(part[1])
            if len(part) == 4:
                distance, inside = (values[index] for values in part[2:])
                sides = []
                for other in (~inside, inside):
                    left_out = distance.masked_fill(other | (step >= count), torch.inf)
                    nearest = left_out.topk(self._pool.config.per_side, dim=1, largest=False)
                    sides.append(index.gather(1, nearest.indices))
                index = torch.cat(sides, 1)
            points.append(part[0][:, index])
            labels.append(part[1][index])
        return torch.cat(points, -1), torch.cat(labels, -1)

    def _sent(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self._device, non_blocking=True)


def why_not(stream: SceneStream) -> str | None:
    """Why a stream's batches cannot be made on a device; None where they can."""
    if not isinstance(stream.pool, OccupancyPool):
        return "Points that are the same in every scene: made on the CPU alone"
    config = stream.config
    known = all(  # some drags, and then at most one squeeze and bend
        all(isinstance(link, DragConfig) for link in first)
        and isinstance(last, DragConfig | StretchConfig | RestConfig)
        for *first, last in map(links_of, config.deform)
    )
    parts = {
        "sensor noise": config.noise != CLEAN,
        "background": config.clutter.scenes > 0,
        "occlusion": config.occlusion.scenes > 0 and config.occlusion.largest_share > 0,
        "cameras out of calibration": config.calibration != CALIBRATED,
        "deformations other than drags, squeezing and bending": not known,
    }
    lacks = [what for what, on in parts.items() if on]
    return f"{', '.join(lacks)}: made on the CPU alone" if lacks else None


def _as_arrays(deformation: Deformation, n_drags: int, n_stretches: int) -> tuple[np.ndarray, ...]:
    """A deformation as centres, shifts and sigmas of drags, and numbers of stretches."""
    centres, shifts = np.zeros((2, n_drags, 3), np.float32)
    sigmas = np.ones(n_drags, np.float32)
    stretch = np.tile(_NO_STRETCH, (n_stretches, 1))
    done = 0
    for link in deformation.links if isinstance(deformation, Chain) else (deformation,):
        if isinstance(link, Drags):
            here = slice(done, done := done + len(link.sigmas_mm))
            centres[here], shifts[here] = link.centres_ct, link.shifts_mm
            sigmas[here] = link.sigmas_mm
        elif isinstance(link, Stretch):
            bend = link.along, link.across, [link.sagitta_mm, link.reach_mm]
            stretch[0] = np.concatenate([link.centre_ct, link.matrix.ravel(), *bend])
    return centres, shifts, sigmas, stretch


def carried(plan: BatchPlan, points_ct: Points) -> Points:
    """Points of the undeformed CT frame at their places before the plan's cameras, mm: dragged,
    squeezed and bent as by ``simulate.deform``.

    Component by component: matrix products may be rounded to fewer bits by a device's settings
    (TF32, autocast), which at a tumor's distance is a tenth of a millimetre.
    """

    def sent(array: np.ndarray) -> Tensor:
        sent = torch.from_numpy(array.astype(np.float32))
        return sent.to(points_ct.device, non_blocking=True)

    points, sigmas_mm = points_ct.clone(), sent(plan.sigmas_mm)
    centres_ct, shifts_mm = (sent(v).permute(2, 0, 1) for v in (plan.centres_ct, plan.shifts_mm))
    scales = -0.5 / (sigmas_mm * sigmas_mm)
    for k in range(sigmas_mm.shape[1]):
        offset = points - centres_ct[:, :, k, None]
        exponent = offset.square_().sum(0).mul_(scales[:, k, None])
        factor = torch.threshold_(exponent, _SMALLEST, -torch.inf).exp_()
        points.addcmul_(factor, shifts_mm[:, :, k, None])
    for numbers in sent(plan.stretches)[..., None].permute(1, 2, 0, 3):
        centre, matrix = numbers[:3], numbers[3:12].unflatten(0, (3, 3))
        along, across, sagitta, reach = numbers[12:15], numbers[15:18], numbers[18], numbers[19]
        offset = points - centre
        bend = sagitta * ((offset * along).sum(0) / reach).square()
        offset = offset + bend * across
        points = torch.stack([(offset * row).sum(0) for row in matrix]) + centre
    x, y, z = points
    rows = sent(plan.camera_from_ct)[:, :3, :, None].unbind(1)
    return torch.stack([x * r[:, 0] + y * r[:, 1] + z * r[:, 2] + r[:, 3] for r in rows])
