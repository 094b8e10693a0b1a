"""Clouds in a network's frame: centred, scaled, aligned, without strays."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack_occupancy import point_kernels
from tumortrack_occupancy.sampling import compiled, take


class CloudBox(Config, frozen=True, tag="cloud-box"):
    """Centre and half the longest side of the observed cloud's bounding box (the follow-up's)."""


class Aligned(Config, frozen=True, tag="aligned"):
    """Scale: a constant, so that size is not lost. Centre: the mean of the points that lie
    within ``reach`` scales of it; the others are strays, and nothing sees them. The mean and not
    the box's centre: one stray point moves it by 1 / N of its distance, the box by half. Turned
    about the camera's axis until the cloud's longest direction across it is x, its heavier tail at
    +x: turning the organ or the camera about that axis then changes nothing, and most of what
    varies between ``limited`` poses need not be learnt."""

    scale_mm: float
    reach: float

    def __post_init__(self) -> None:
        for name in ("scale_mm", "reach"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} must be positive, not {getattr(self, name)}.")


def normalised(
    points_mm: Tensor, kind: CloudBox | Aligned
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Clouds (B, N, 3), camera frame, mm, in a network's frame; their centre (B, 1, 3) and scale
    (B, 1, 1), mm, and cosine and sine (2, B, 1) of their turn about z, if they are turned."""
    if not isinstance(kind, CloudBox):
        points_mm = without_strays(points_mm, kind.reach * kind.scale_mm)
    centre_mm, scale_mm = normalisation(points_mm, kind)
    points = (points_mm - centre_mm) / scale_mm
    if not isinstance(kind, Aligned):
        return points, centre_mm, scale_mm, None
    turn = alignment(points)
    return turned(points, turn), centre_mm, scale_mm, turn


def normalisation(points_mm: Tensor, kind: CloudBox | Aligned) -> tuple[Tensor, Tensor]:
    """Centre (B, 1, 3) and scale (B, 1, 1), both mm, of clouds (B, N, 3)."""
    if not isinstance(kind, CloudBox):
        centre_mm = points_mm.mean(dim=1, keepdim=True)
        return centre_mm, points_mm.new_full((len(points_mm), 1, 1), kind.scale_mm)
    low = points_mm.amin(dim=1, keepdim=True)
    high = points_mm.amax(dim=1, keepdim=True)
    return (low + high) / 2, ((high - low) / 2).amax(dim=2, keepdim=True).clamp_min(1e-6)


def without_strays(points_mm: Tensor, reach_mm: float) -> Tensor:
    """Clouds (B, N, 3) with every point that is not within reach of the others' middle replaced by
    one that is: a repeated point changes no maximum, and is never a farthest one. The middle is the
    coordinates' median, then twice the mean of the points within reach, so that background moves it
    little (10 % of a plane behind an organ: 0.5 mm, the mean of all by 5 mm). The order of the
    points that stay is kept."""
    if compiled(points_mm):
        out = torch.empty_like(points_mm, memory_format=torch.contiguous_format)
        point_kernels.near(points_mm.contiguous().numpy(), np.float32(reach_mm), out.numpy())
        return out
    n = points_mm.shape[1]
    if torch.jit.is_tracing():  # ONNX has no median
        middle = points_mm.sort(dim=1).values[:, (n - 1) // 2, None]
    else:
        middle = points_mm.median(dim=1, keepdim=True).values
    near = points_mm
    for _ in range(2):
        stray = (points_mm - middle).square().sum(dim=2) > reach_mm**2
        # No two keys are equal, so that any sorting keeps the order.
        row = torch.arange(n, device=points_mm.device)
        order = (stray * n + row).argsort(dim=1)
        count = (~stray).sum(dim=1, keepdim=True).clamp_min(1)
        near = take(points_mm, order.gather(1, row % count))
        middle = near.mean(dim=1, keepdim=True)
    return near


def alignment(points: Tensor) -> Tensor:
    """Cosine and sine (2, B, 1) of the angle about z of the principal direction of the centred
    points (B, N, 3) across z, pointing to their heavier tail."""
    x, y = points[..., 0], points[..., 1]
    angle = torch.atan2(2 * (x * y).mean(1), (x * x - y * y).mean(1)) / 2
    direction = torch.stack([torch.cos(angle), torch.sin(angle)])[..., None]
    along = x * direction[0] + y * direction[1]
    return direction * torch.where((along**3).mean(1) < 0, -1.0, 1.0)[:, None]


def turned(points: Tensor, turn: Tensor) -> Tensor:
    """Points (B, N, 3) turned by minus the angle. Not as a matrix product: that would be rounded
    to bf16, a tenth of a millimetre."""
    x, y, z = points.unbind(-1)
    cosine, sine = turn
    return torch.stack([x * cosine + y * sine, y * cosine - x * sine, z], dim=-1)
