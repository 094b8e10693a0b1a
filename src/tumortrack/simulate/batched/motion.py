"""Where the points of a batch of scenes go: drags, squeeze and bend, the camera's pose.

Everything is written component by component: a product of matrices may be rounded to fewer bits
by a device's settings (TF32, autocast), which at a tumor's distance is a tenth of a millimetre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from tumortrack.simulate.batched.plan import BatchPlan

_FARTHEST = -12.0  # where a drag's factor is below exp(-12) = 6e-6, it is left out


@dataclass(frozen=True, eq=False)
class BatchedMotion:
    """The maps of b scenes from the CT frame to their cameras', as tensors on a device."""

    centres_ct: Float32[Tensor, "3 b k"]
    shifts_mm: Float32[Tensor, "3 b k"]
    sigmas_mm: Float32[Tensor, "b k"]
    stretches: Float32[Tensor, "s 20 b"]
    camera_from_ct: Float32[Tensor, "b 4 4"]

    @classmethod
    def of(cls, plan: BatchPlan, device: torch.device) -> BatchedMotion:
        def sent(array: np.ndarray) -> Tensor:
            return torch.from_numpy(array.astype(np.float32)).to(device, non_blocking=True)

        return cls(
            sent(plan.centres_ct).permute(2, 0, 1),
            sent(plan.shifts_mm).permute(2, 0, 1),
            sent(plan.sigmas_mm),
            sent(plan.stretches).permute(1, 2, 0),
            sent(plan.camera_from_ct),
        )

    def carry(self, points_ct: Float32[Tensor, "3 b n"]) -> Float32[Tensor, "3 b n"]:
        """Points of the undeformed CT frame at their places before the cameras, mm."""
        points = drag(points_ct, self.centres_ct, self.shifts_mm, self.sigmas_mm)
        for numbers in self.stretches:
            points = _stretch(points, numbers[:, :, None])
        return _affine(points, self.camera_from_ct)


def drag(
    points_ct: Float32[Tensor, "3 b n"],
    centres_ct: Float32[Tensor, "3 b k"],
    shifts_mm: Float32[Tensor, "3 b k"],
    sigmas_mm: Float32[Tensor, "b k"],
) -> Float32[Tensor, "3 b n"]:
    """k drags one after the other, as ``simulate.deform.drag``."""
    points = points_ct.clone()
    scales = -0.5 / (sigmas_mm * sigmas_mm)
    for k in range(sigmas_mm.shape[1]):
        offset = points - centres_ct[:, :, k, None]
        exponent = offset.square_().sum(0).mul_(scales[:, k, None])
        factor = torch.threshold_(exponent, _FARTHEST, -torch.inf).exp_()
        points.addcmul_(factor, shifts_mm[:, :, k, None])
    return points


def _stretch(
    points: Float32[Tensor, "3 b n"], numbers: Float32[Tensor, "20 b 1"]
) -> Float32[Tensor, "3 b n"]:
    """A squeeze and bend, as ``simulate.deform.stretch``."""
    centre, rows = numbers[:3], numbers[3:12].unflatten(0, (3, 3))
    along, across, sagitta, reach = numbers[12:15], numbers[15:18], numbers[18], numbers[19]
    offset = points - centre
    bend = sagitta * ((offset * along).sum(0) / reach).square()
    offset = offset + bend * across
    return torch.stack([(offset * row).sum(0) for row in rows]) + centre


def _affine(
    points: Float32[Tensor, "3 b n"], b_from_a: Float32[Tensor, "b 4 4"]
) -> Float32[Tensor, "3 b n"]:
    x, y, z = points
    rows = b_from_a[:, :3, :, None].unbind(1)
    return torch.stack([x * r[:, 0] + y * r[:, 1] + z * r[:, 2] + r[:, 3] for r in rows])
