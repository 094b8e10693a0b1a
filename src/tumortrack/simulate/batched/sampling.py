"""Points chosen by numbers that were drawn on the host: of depth images, of a labelled pool."""

from __future__ import annotations

import torch
from jaxtyping import Float32, Int32, Int64, UInt8
from torch import Tensor

from tumortrack.core.types import Intrinsics
from tumortrack.simulate.occupancy import OccupancyPool, PartPool


def count_in_range(
    depth_mm: Float32[Tensor, "b h w"],
    near_mm: Float32[Tensor, " b"],
    far_mm: Float32[Tensor, " b"],
) -> Int32[Tensor, "b hw"]:
    """Of each image's pixels up to each, in row-major order, those strictly between its depths."""
    flat = depth_mm.flatten(1)
    inside = (flat > near_mm[:, None]) & (flat < far_mm[:, None])
    return inside.cumsum(1, dtype=torch.int32)


def clouds_from_depth(
    depth_mm: Float32[Tensor, "b h w"],
    counted: Int32[Tensor, "b hw"],
    ranks: Int32[Tensor, "b n"],
    intrinsics: Intrinsics,
) -> Float32[Tensor, "b n 3"]:
    """The points of the pixels in range with these ranks, camera frame, mm; ``counted`` is what
    ``count_in_range`` returned."""
    pixel = torch.searchsorted(counted, ranks + 1)
    z = depth_mm.flatten(1).gather(1, pixel).double()
    row = pixel.div(intrinsics.width, rounding_mode="floor")
    x = (pixel - row * intrinsics.width - intrinsics.cx) * (z / intrinsics.fx)
    y = (row - intrinsics.cy) * (z / intrinsics.fy)
    return torch.stack([x, y, z], -1).float()


class DevicePool:
    """An ``OccupancyPool`` on a device."""

    def __init__(self, pool: OccupancyPool, device: torch.device) -> None:
        self._per_side = pool.config.per_side
        self._parts = [_DevicePart(part, device) for part in pool.parts]
        self._far_points_ct = torch.tensor(pool.far_points_ct.T, device=device)
        self._far_labels = torch.tensor(pool.far_labels, device=device)

    def take(
        self, windows: Int64[Tensor, "b w 2"], widest: list[int]
    ) -> tuple[Float32[Tensor, "3 b q"], UInt8[Tensor, "b q"]]:
        """The points (undeformed CT frame) and labels that ``OccupancyPool.draw`` takes from these
        windows (first, count); on each side of a part the nearest first. ``widest`` is each
        column's greatest count."""
        points, labels = [], []
        for part, window, width in zip(self._parts, windows.unbind(1), widest, strict=False):
            chosen = part.nearest(window, width, self._per_side)
            points.append(part.points_ct[:, chosen])
            labels.append(part.labels[chosen])
        far = _neighbours(windows[:, -1, 0], widest[-1], len(self._far_labels))
        points.append(self._far_points_ct[:, far])
        labels.append(self._far_labels[far])
        return torch.cat(points, -1), torch.cat(labels, -1)


class _DevicePart:
    def __init__(self, part: PartPool, device: torch.device) -> None:
        self.points_ct = torch.tensor(part.points_ct.T, device=device)
        self.labels = torch.tensor(part.labels, device=device)
        self._distance_mm = torch.tensor(part.distance_mm, device=device)
        self._inside = torch.tensor(part.inside, device=device)

    def nearest(self, window: Int64[Tensor, "b 2"], width: int, k: int) -> Int64[Tensor, "b 2*{k}"]:
        """Of the window's points the k inside that are nearest to the surface, and k outside, the
        nearest first."""
        index = _neighbours(window[:, 0], width, len(self.labels))
        beyond = torch.arange(width, device=index.device) >= window[:, 1:]
        distance, inside = self._distance_mm[index], self._inside[index]
        sides = []
        for other in (~inside, inside):
            left_out = distance.masked_fill(other | beyond, torch.inf)
            nearest = left_out.topk(k, dim=1, largest=False).indices
            sides.append(index.gather(1, nearest))
        return torch.cat(sides, 1)


def _neighbours(first: Int64[Tensor, " b"], count: int, total: int) -> Int64[Tensor, "b count"]:
    return (first[:, None] + torch.arange(count, device=first.device)) % total
