"""Depth images of a batch of surfaces with the same triangles: a z-buffer of scattered maxima.

Every triangle that faces the camera is spread over the pixels of its box, and each pixel keeps the
greatest 1/z: the arithmetic, precision and tolerance of ``sense.render``, so that the same
vertices give the same image to the last bit, in whatever order a device works.
"""

from __future__ import annotations

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from tumortrack.core.types import Intrinsics

_NEAREST_MM = 1.0
_EDGE = -1e-5  # weights of a point on an edge may be so much below 0


def depth_images(
    points_mm: Float32[Tensor, "3 b v"], faces: Int64[Tensor, "f 3"], intrinsics: Intrinsics
) -> Float32[Tensor, "b h w"]:
    """Depth along z (mm, NaN where nothing is hit) of b closed surfaces, camera frame."""
    height, width = intrinsics.height, intrinsics.width
    batch = points_mm.shape[1]
    corners, area, box = _front(_projected(points_mm, intrinsics), faces, intrinsics)
    triangle, x, y = _pixels(box)
    corners, area = corners[triangle].double(), area[triangle].double()
    (ua, va, wa), (ub, vb, wb), (uc, vc, wc) = corners.unflatten(1, (3, 3)).permute(1, 2, 0)
    inverse = 1.0 / area
    share_a = ((ub - x) * (vc - y) - (vb - y) * (uc - x)) * inverse
    share_b = ((uc - x) * (va - y) - (vc - y) * (ua - x)) * inverse
    share_c = 1.0 - share_a - share_b
    inside = (share_a >= _EDGE) & (share_b >= _EDGE) & (share_c >= _EDGE)
    here = (share_a * wa + share_b * wb + share_c * wc).float()
    pixel = (box[triangle, 0] * height + y) * width + x
    nearest = here.new_zeros(batch * height * width)
    nearest.scatter_reduce_(0, pixel, torch.where(inside, here, 0), "amax")
    depth_mm = torch.where(nearest > 0, 1.0 / nearest, torch.nan)
    return depth_mm.view(batch, height, width)


def _projected(
    points_mm: Float32[Tensor, "3 b v"], intrinsics: Intrinsics
) -> Float32[Tensor, "b v 3"]:
    """Column, row and 1/z (linear in the image, unlike z; -1 behind the camera)."""
    x, y, z = points_mm
    before = z > _NEAREST_MM
    inverse = torch.where(before, 1.0 / z, -1.0)
    w = inverse.double()
    u = intrinsics.fx * x.double() * w + intrinsics.cx
    v = intrinsics.fy * y.double() * w + intrinsics.cy
    return torch.stack([u.float(), v.float(), inverse], -1)


def _front(
    projected: Float32[Tensor, "b v 3"], faces: Int64[Tensor, "f 3"], intrinsics: Intrinsics
) -> tuple[Float32[Tensor, "t 9"], Float32[Tensor, " t"], Int64[Tensor, "t 5"]]:
    """Of the triangles that face the camera and touch a pixel: corners, area, and box (scene,
    left, top, width, height)."""
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


def _pixels(
    box: Int64[Tensor, "t 5"],
) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " p"], Int64[Tensor, " p"]]:
    """All pixels of all boxes: whose, column, row."""
    _, left, top, wide, high = box.unbind(1)
    count = wide * high
    triangle = torch.repeat_interleave(count)
    place = torch.arange(len(triangle), device=box.device) - (count.cumsum(0) - count)[triangle]
    wide = wide[triangle]
    row = place.div(wide, rounding_mode="floor")
    return triangle, left[triangle] + place - row * wide, top[triangle] + row
