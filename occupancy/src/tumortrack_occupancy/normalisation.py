"""Clouds in a network's frame: centred, scaled, aligned, without outliers."""

from __future__ import annotations

import torch
from torch import Tensor

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack_occupancy.sampling import take


class CloudBox(Config, frozen=True, tag="cloud-box"):
    """Centre and half the longest side of the observed cloud's bounding box (the follow-up's)."""


class Aligned(Config, frozen=True, tag="aligned"):
    """A constant scale, so that size is not lost. The centre is the mean of the points within
    ``reach`` scales of it; all others are outliers and are replaced (``without_outliers``). The
    mean rather than the box's centre: one outlier moves it by 1 / N of its distance, the box by
    half. The cloud is rotated about the camera's axis until its principal direction across that
    axis is x, with the heavier tail at +x: rotating the organ or the camera about the axis then
    changes nothing, and most of the variation between ``limited`` poses need not be learnt."""

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
    (B, 1, 1), both mm; cosine and sine (2, B, 1) of their rotation about z, None without one."""
    if isinstance(kind, CloudBox):
        low, high = points_mm.amin(dim=1, keepdim=True), points_mm.amax(dim=1, keepdim=True)
        centre_mm = (low + high) / 2
        scale_mm = ((high - low) / 2).amax(dim=2, keepdim=True).clamp_min(1e-6)
        return (points_mm - centre_mm) / scale_mm, centre_mm, scale_mm, None
    points_mm = without_outliers(points_mm, kind.reach * kind.scale_mm)
    centre_mm = points_mm.mean(dim=1, keepdim=True)
    scale_mm = points_mm.new_full((len(points_mm), 1, 1), kind.scale_mm)
    points = (points_mm - centre_mm) / scale_mm
    rotation = alignment(points)
    return rotated(points, rotation), centre_mm, scale_mm, rotation


def without_outliers(points_mm: Tensor, reach_mm: float) -> Tensor:
    """Clouds (B, N, 3) in which each point farther than ``reach_mm`` from the cloud's middle is
    replaced by one within reach: a repeated point changes no maximum, and is never a farthest
    one. The middle is the coordinates' median, then twice the mean of the points within reach,
    so that background moves it little (10 % of a plane behind an organ: 0.5 mm, the mean of all
    points by 5 mm). The points that stay keep their order."""
    n = points_mm.shape[1]
    if torch.jit.is_tracing():  # ONNX has no median
        middle = points_mm.sort(dim=1).values[:, (n - 1) // 2, None]
    else:
        middle = points_mm.median(dim=1, keepdim=True).values
    within = points_mm
    for _ in range(2):
        outlier = (points_mm - middle).square().sum(dim=2) > reach_mm**2
        # No two keys are equal, so that any sorting keeps the order.
        row = torch.arange(n, device=points_mm.device)
        order = (outlier * n + row).argsort(dim=1)
        count = (~outlier).sum(dim=1, keepdim=True).clamp_min(1)
        within = take(points_mm, order.gather(1, row % count))
        middle = within.mean(dim=1, keepdim=True)
    return within


def alignment(points: Tensor) -> Tensor:
    """Cosine and sine (2, B, 1) of the angle about z of the principal direction across z of the
    centred points (B, N, 3), pointing to their heavier tail."""
    x, y = points[..., 0], points[..., 1]
    angle = torch.atan2(2 * (x * y).mean(1), (x * x - y * y).mean(1)) / 2
    direction = torch.stack([torch.cos(angle), torch.sin(angle)])[..., None]
    along = x * direction[0] + y * direction[1]
    return direction * torch.where((along**3).mean(1) < 0, -1.0, 1.0)[:, None]


def rotated(points: Tensor, rotation: Tensor) -> Tensor:
    """Points (B, N, 3) rotated about z by minus the angle. Not as a matrix product, which would
    be rounded to bf16, a tenth of a millimetre."""
    x, y, z = points.unbind(-1)
    cosine, sine = rotation
    return torch.stack([x * cosine + y * sine, y * cosine - x * sine, z], dim=-1)
