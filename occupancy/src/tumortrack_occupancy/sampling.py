"""Choosing points and neighbours, deterministically: compiled on a CPU, in plain torch elsewhere.

The plain form is the reference, runs on every device and can be exported; both choose the same
points. Points come in batches (B, N, 3). Lengths are in whatever unit the points have.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from tumortrack.core.mesh_kernels import farthest
from tumortrack.native import F32, I64, kernel

# Points (clouds, 3, n), centres, squared radius -> indices
_ball_query = kernel(
    "ball_query", F32["b", 3, "n"].any_value, F32["b", 3, "m"].any_value, float,
    I64["b", "m", "k"].out,
)  # fmt: skip


def farthest_points(points: Tensor, k: int) -> Tensor:
    """Farthest point sampling, from the point that is farthest from the centroid. This fixed
    start makes the chosen set independent of the points' order (but for exact ties); a random one
    alone changes about 0.8 % of the labels. Sequential in ``k``. Points (B, N, 3) -> indices (B,
    k), int64, in the order of choice. Source: Eldar et al. 1997; Qi et al., PointNet++, NIPS 2017,
    section 3.2."""
    rows, centre = _rows(points), points.detach().mean(dim=1, keepdim=True)
    x, y, z = rows.unbind(1)
    chosen = torch.empty((len(points), k), dtype=torch.int64, device=points.device)
    newest = _distance_2(x, y, z, *centre.unbind(-1)).argmax(dim=1, keepdim=True)
    if compiled(points):
        farthest(rows.numpy(), newest[:, 0].numpy(), chosen.numpy())
        return chosen
    nearest = torch.full_like(x, torch.inf)
    for step in range(k):
        chosen[:, step : step + 1] = newest
        at = (axis.gather(1, newest) for axis in (x, y, z))
        nearest = torch.minimum(nearest, _distance_2(x, y, z, *at))
        newest = nearest.argmax(dim=1, keepdim=True)
    return chosen


def strided_points(points: Tensor, k: int) -> Tensor:
    """Every (N / k)-th point, k at most N, as ascending indices (B, k). For points (B, N, 3) in
    random order this is a random choice at no cost; rows of a depth image, spread evenly, also
    do."""
    n = points.shape[1]
    row = torch.arange(k, device=points.device) * n // k
    return row.expand(len(points), k)


def ball_query(points: Tensor, centres: Tensor, radius: float, k: int) -> Tensor:
    """The first ``k`` points (B, N, 3), by index, within ``radius`` of each centre (B, M, 3):
    indices (B, M, k), int64. If a ball holds fewer, its first is repeated, so that a maximum over
    the neighbours is unchanged. A centre that is one of the points always finds itself; an empty
    ball gives index 0. Source: Qi et al., PointNet++, NIPS 2017, section 3.2."""
    if compiled(points):
        indices = torch.empty((*centres.shape[:2], k), dtype=torch.int64)
        rows = _rows(points).numpy(), _rows(centres).numpy()
        _ball_query(*rows, radius**2, indices.numpy())
        return indices
    across, down = _rows(points)[:, :, None].unbind(1), _rows(centres)[..., None].unbind(1)
    inside = _distance_2(*across, *down) <= radius**2
    slot = inside.long().cumsum(dim=2)  # 1 for the first inside; ONNX does not sum booleans
    count = slot[:, :, -1:].clone()
    slot.sub_(1).masked_fill_(~inside, k).clamp_(max=k)  # slot k takes all that are not wanted
    batch, n_centres, n = inside.shape
    indices = torch.zeros((batch, n_centres, k + 1), dtype=torch.int64, device=points.device)
    indices.scatter_(2, slot, torch.arange(n, device=points.device).expand_as(slot))
    missing = torch.arange(k, device=points.device) >= count
    return torch.where(missing, indices[:, :, :1], indices[:, :, :k])


def take(values: Tensor, indices: Tensor) -> Tensor:
    """Rows of ``values`` (B, N, C) at ``indices`` (B, ...) -> (B, ..., C)."""
    batch, n, channels = values.shape
    first_row = torch.arange(batch, device=values.device) * n
    rows = indices + first_row.view(-1, *([1] * (indices.dim() - 1)))
    return functional.embedding(rows, values.reshape(batch * n, channels))


def compiled(points: Tensor) -> bool:
    """Whether the compiled kernels can take these points: not while torch traces the network, and
    without a gradient."""
    plain = points.device.type != "cpu" or points.dtype != torch.float32 or points.requires_grad
    return not (plain or traced())


def traced() -> bool:
    """Whether torch records operations, to export or compile them."""
    return torch.compiler.is_compiling() or torch.jit.is_tracing()


def _rows(points: Tensor) -> Tensor:
    """(B, N, 3) -> (B, 3, N), contiguous: 3x faster than strides of 3."""
    return points.detach().transpose(1, 2).contiguous()


def _distance_2(x: Tensor, y: Tensor, z: Tensor, cx: Tensor, cy: Tensor, cz: Tensor) -> Tensor:
    """Squared, of broadcastable coordinates; exactly 0 between a point and itself."""
    return (x - cx).square_().add_((y - cy).square_()).add_((z - cz).square_())
