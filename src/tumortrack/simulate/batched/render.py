"""Depth images of a batch of surfaces with the same triangles, as tensors.

A z-buffer of scattered maxima: every triangle that faces the camera is spread over the pixels of
its box, and each pixel keeps the greatest 1/z. Precision and tolerance are those of
``sense.render``, so that the same vertices give the same image, in whatever order a device works.
"""

from __future__ import annotations

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from tumortrack.core.types import Intrinsics

PerFace = Int64[Tensor, " t"]
_NEAREST_MM = 1.0
_EDGE = -1e-5  # barycentric weights of a point on an edge may be this far below 0


def depth_images(
    points_mm: Float32[Tensor, "3 b v"], faces: Int64[Tensor, "f 3"], intrinsics: Intrinsics
) -> Float32[Tensor, "b h w"]:
    """Depth along z (mm, NaN where nothing is hit) of b closed surfaces, camera frame."""
    height, width = intrinsics.height, intrinsics.width
    corners, area, box = _front(points_mm, faces, intrinsics)
    scene, left, top, wide, high = box.unbind(1)
    planes = _planes(corners, area, left, top)
    # All pixels of all boxes: their triangle, and their column and row in its box.
    count = wide * high
    triangle = torch.repeat_interleave(count)
    place = torch.arange(len(triangle), device=wide.device) - (count.cumsum(0) - count)[triangle]
    wide = wide[triangle]
    row = place.div(wide, rounding_mode="floor")
    column = place - row * wide
    start, across, down = planes[:, :, triangle]
    share_a, share_b, inverse = start.addcmul(across, column).addcmul(down, row)
    least = torch.minimum(torch.minimum(share_a, share_b), 1.0 - share_a - share_b)
    here = torch.where(least >= _EDGE, inverse, 0.0).float()
    pixel = ((scene * height + top) * width + left)[triangle] + row * width + column
    nearest = here.new_zeros(points_mm.shape[1] * height * width)
    nearest.scatter_reduce_(0, pixel, here, "amax")
    return torch.where(nearest > 0, 1.0 / nearest, torch.nan).view(-1, height, width)


def _front(
    points_mm: Float32[Tensor, "3 b v"], faces: Int64[Tensor, "f 3"], intrinsics: Intrinsics
) -> tuple[Float32[Tensor, "t 9"], Float32[Tensor, " t"], Int64[Tensor, "t 5"]]:
    """Of the triangles that face the camera and touch a pixel: corners (column, row, and 1/z or -1
    behind the camera), area, and box (scene, left, top, width, height)."""
    x, y, z = points_mm
    inverse = torch.where(z > _NEAREST_MM, 1.0 / z, -1.0)
    u = intrinsics.fx * x.double() * inverse.double() + intrinsics.cx
    v = intrinsics.fy * y.double() * inverse.double() + intrinsics.cy
    projected = torch.stack([u.float(), v.float(), inverse], -1)
    corners = projected[:, faces.flatten()].unflatten(1, (-1, 3))  # b f 3 3
    u, v, w = corners.unbind(-1)
    (ua, ub, uc), (va, vb, vc) = u.unbind(-1), v.unbind(-1)
    area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
    left = u.amin(-1).ceil().clamp(0, intrinsics.width)
    top = v.amin(-1).ceil().clamp(0, intrinsics.height)
    wide = u.amax(-1).floor().clamp(-1, intrinsics.width - 1) - left + 1
    high = v.amax(-1).floor().clamp(-1, intrinsics.height - 1) - top + 1
    # Outward faces run clockwise in a y-down image when they face the camera.
    drawn = (area < 0) & (w.amin(-1) > 0) & (wide > 0) & (high > 0)
    scene, face = drawn.nonzero(as_tuple=True)
    box = torch.stack([left, top, wide, high], -1)[scene, face].long()
    return corners[scene, face].flatten(1), area[scene, face], torch.cat([scene[:, None], box], 1)


def _planes(
    corners: Float32[Tensor, "t 9"], area: Float32[Tensor, " t"], left: PerFace, top: PerFace
) -> Float64[Tensor, "3 3 t"]:
    """The barycentric weights of corners a and b, and 1/z: at a box's first pixel, their increment
    by column and by row."""
    parts = corners.double().unflatten(1, (3, 3)).permute(1, 2, 0)
    (ua, va, wa), (ub, vb, wb), (uc, vc, wc) = parts
    share = 1.0 / area.double()
    start_a = ((ub - left) * (vc - top) - (vb - top) * (uc - left)) * share
    start_b = ((uc - left) * (va - top) - (vc - top) * (ua - left)) * share
    across_a, across_b = (vb - vc) * share, (vc - va) * share
    down_a, down_b = (uc - ub) * share, (ua - uc) * share
    from_a, from_b = wa - wc, wb - wc
    start = wc + start_a * from_a + start_b * from_b
    across = across_a * from_a + across_b * from_b
    down = down_a * from_a + down_b * from_b
    rows = (start_a, start_b, start, across_a, across_b, across, down_a, down_b, down)
    return torch.stack(rows).unflatten(0, (3, 3))
