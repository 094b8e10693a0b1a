"""The addressable stream of training batches, made on a device."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from tumortrack.core.errors import InputError
from tumortrack.sense.camera import d405
from tumortrack.sense.cloud import FEWEST_POINTS, draw_some
from tumortrack.simulate.batched.motion import Motion
from tumortrack.simulate.batched.plan import Plan, plan_scenes, unsupported
from tumortrack.simulate.batched.raster import depth_images
from tumortrack.simulate.batched.sampling import DevicePool, clouds_from_depth, count_in_range
from tumortrack.simulate.dataset import SceneStream, refill
from tumortrack.simulate.occupancy import OccupancyPool
from tumortrack.simulate.scene import ATTEMPTS, SceneRecipe, Simulator, shows_nothing

# clouds_mm (b, n, 3), points_mm (b, q, 3), labels (b, q), camera_from_ct (b, 4, 4)
Tensors = tuple[Tensor, Tensor, Tensor, Tensor]


class DeviceStream:
    """The batches of a ``SceneStream`` as tensors on a device.

    Float32 rounding apart, which may turn a pixel on a silhouette, a batch has the stream's
    values; a scene's labelled points come in another order. Two steps, so that other processes
    can plan ahead: ``plan`` needs no device, ``made`` little of the host: the number of pixels in
    range of each scene comes back, as the random choice among them depends on it.

    Raises:
        InputError: a configuration that ``unsupported`` refuses.
    """

    def __init__(self, stream: SceneStream, device: torch.device) -> None:
        reason = why_not(stream)
        if reason is not None:
            raise InputError(f"these scenes cannot be made in batches. {reason}.")
        self._stream = stream
        self._device = device
        self._intrinsics = d405(stream.config.width, stream.config.height)

    def __getstate__(self) -> dict:
        held = ("_stream", "_device", "_intrinsics")
        return {name: self.__dict__[name] for name in held}

    @cached_property
    def _simulator(self) -> Simulator:
        stream = self._stream
        return Simulator(stream.anatomy_ct, stream.up_lps, stream.config, stream.body)

    @cached_property
    def _organ(self) -> tuple[Float32[Tensor, "3 v"], Tensor]:
        organ = self._stream.anatomy_ct.organ
        vertices = torch.tensor(organ.vertices_mm.T, dtype=torch.float32, device=self._device)
        return vertices, torch.tensor(organ.faces, dtype=torch.int64, device=self._device)

    @cached_property
    def _pool(self) -> DevicePool:
        assert isinstance(self._stream.pool, OccupancyPool)
        return DevicePool(self._stream.pool, self._device)

    def batch(self, index: int) -> Tensors:
        """The batch with this number."""
        return self.made(self.plan(index))

    def plan(self, index: int) -> Plan:
        """What chance decides in the batch with this number, up to its pictures."""
        size, seed, name = self._stream.batch_size, self._stream.seed, self._stream.stream
        recipes = [SceneRecipe(seed, name, i) for i in range(index * size, (index + 1) * size)]
        return plan_scenes(self._simulator, recipes, [0] * size)

    @torch.no_grad()
    def made(self, plan: Plan) -> Tensors:
        """The scenes of a plan.

        Raises:
            TumortrackError: no pose of a scene shows enough of the organ.
        """
        plan, depth_mm, counted = self._pictures(plan)
        ranks, windows = self._drawn(plan, counted[:, -1].cpu().numpy())
        clouds_mm = clouds_from_depth(depth_mm, counted, self._sent(ranks), self._intrinsics)
        points_ct, labels = self._pool.take(self._sent(windows), windows[:, :, 1].max(0).tolist())
        points_mm = Motion.of(plan, self._device).carry(points_ct)
        poses = self._sent(plan.camera_from_ct.astype(np.float32))
        return clouds_mm, points_mm.permute(1, 2, 0).contiguous(), labels, poses

    def depth_images(self, plan: Plan) -> Float32[Tensor, "b h w"]:
        """What the cameras of a plan see of the organ: depth in mm, NaN where there is nothing."""
        vertices_ct, faces = self._organ
        everywhere = vertices_ct[:, None].expand(-1, len(plan.recipes), -1)
        vertices_mm = Motion.of(plan, self._device).carry(everywhere)
        return depth_images(vertices_mm, faces, self._intrinsics)

    def _pictures(self, plan: Plan) -> tuple[Plan, Float32[Tensor, "b h w"], Int32[Tensor, "b hw"]]:
        """Images of the plan, with another attempt at those scenes that show too little."""
        depth_mm, counted = self._picture(plan)
        for _ in range(ATTEMPTS):
            few = np.flatnonzero(counted[:, -1].cpu().numpy() < FEWEST_POINTS)
            if len(few) == 0:
                break
            attempts = plan.attempts[few] + 1
            if attempts.max() >= ATTEMPTS:
                raise shows_nothing(plan.recipes[few[attempts.argmax()]])
            again = plan_scenes(self._simulator, plan.recipes[few].tolist(), attempts.tolist())
            plan = plan.replaced(few, again)
            rows = self._sent(few)
            depth_mm[rows], counted[rows] = self._picture(again)
        return plan, depth_mm, counted

    def _picture(self, plan: Plan) -> tuple[Float32[Tensor, "b h w"], Int32[Tensor, "b hw"]]:
        depth_mm = self.depth_images(plan)
        near, far = self._sent(plan.near_mm), self._sent(plan.far_mm)
        return depth_mm, count_in_range(depth_mm, near, far)

    def _drawn(
        self, plan: Plan, available: Int32[np.ndarray, " b"]
    ) -> tuple[Int32[np.ndarray, "b n"], np.ndarray]:
        """Which pixels in range become the clouds, and each pool's window (b, parts + 1, 2)."""
        assert isinstance(self._stream.pool, OccupancyPool)
        n = self._stream.config.cloud.n_points
        rng = np.random.default_rng()
        ranks, windows = [], []
        for state, count, wanted in zip(plan.states, available, plan.n_points, strict=True):
            rng.bit_generator.state = state
            ranks.append(refill(draw_some(int(count), int(wanted), rng), n))
            windows.append(self._stream.pool.windows(rng))
        return np.stack(ranks).astype(np.int32), np.array(windows)

    def _sent(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self._device, non_blocking=True)


def why_not(stream: SceneStream) -> str | None:
    """Why a stream's batches cannot be made on a device; None where they can."""
    if not isinstance(stream.pool, OccupancyPool):
        return "Points that are the same in every scene: made on the CPU alone"
    return unsupported(stream.config)
