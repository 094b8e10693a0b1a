"""The greatest of neighbours' features: compiled for a CPU that learns, in plain torch elsewhere.

Both give the same numbers and the same gradients, bit for bit.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional

from tumortrack.models.sampling import traced

_WHOLE = {torch.bfloat16: torch.int16, torch.float32: torch.int32}  # of the same size


def greatest_above_zero(values: Tensor) -> Tensor:
    """The maximum over the K neighbours of the ReLU of ``values`` (B, M, K, C) -> (B, M, C)."""
    compiled = values.dtype in _WHOLE and values.device.type == "cpu" and not traced()
    if compiled and values.requires_grad:
        out: Tensor = _Greatest.apply(values)
        return out
    return greatest(functional.relu(values))


def greatest(values: Tensor) -> Tensor:
    """The maximum over the K neighbours, (B, M, K, C) -> (B, M, C). As pooling, whose backward on
    a CPU is several times faster than that of a maximum along an axis."""
    k = values.shape[2]
    channels_first = values.permute(0, 3, 1, 2)
    return functional.max_pool2d(channels_first, (1, k)).squeeze(-1).transpose(1, 2)


class _Greatest(Function):
    """``greatest_above_zero`` as one pass there and one back. ReLU and maximum by torch are eight,
    with copies between them, and a third of a step of ``quick``."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        from tumortrack.models.kernels import greatest

        batch, m, k, channels = ctx.shape = values.shape
        whole = values.detach().contiguous().view(_WHOLE[values.dtype])
        out = torch.empty(batch, m, channels, dtype=values.dtype)
        chosen = torch.empty(batch * m, channels, dtype=whole.dtype)
        infinity = torch.tensor(torch.inf, dtype=values.dtype).view(whole.dtype)
        greatest(
            whole.view(-1, k, channels).numpy(),
            infinity.numpy()[()],
            out.view(whole.dtype).view(-1, channels).numpy(),
            chosen.numpy(),
        )
        ctx.save_for_backward(chosen)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        from tumortrack.models.kernels import handed_back

        (chosen,) = ctx.saved_tensors
        (gradient,) = gradients
        whole = gradient.contiguous().view(chosen.dtype).view(chosen.shape)
        out = torch.empty(ctx.shape, dtype=gradient.dtype)
        _, _, k, channels = ctx.shape
        spread = out.view(chosen.dtype).view(-1, k, channels)
        handed_back(whole.numpy(), chosen.numpy(), spread.numpy())
        return out
