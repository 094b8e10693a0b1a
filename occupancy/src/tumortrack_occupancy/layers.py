"""What encoders and decoders are made of: linear layers, and the maximum over neighbours.

The maximum is compiled for training on a CPU, in plain torch elsewhere; both give the same numbers
and gradients, bit for bit.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional

from tumortrack_occupancy import point_kernels
from tumortrack_occupancy.sampling import traced

Norm = Literal["none", "batch"]
_INTEGER = {torch.bfloat16: torch.int16, torch.float32: torch.int32}  # of the same size


class Layer(nn.Module):
    """Linear, optional batch norm, ReLU; over the last axis of any array. Weights start as He's,
    biases at zero: without a norm the signal then keeps its size through many layers."""

    def __init__(self, n_in: int, n_out: int, norm: Norm) -> None:
        super().__init__()
        self.linear = nn.Linear(n_in, n_out)
        nn.init.kaiming_uniform_(self.linear.weight, nonlinearity="relu")
        nn.init.zeros_(self.linear.bias)
        self.norm = nn.BatchNorm1d(n_out) if norm == "batch" else None

    def normalise(self, linear_out: Tensor) -> Tensor:
        """The batch norm alone, (..., n_out) -> (..., n_out)."""
        if self.norm is None:
            return linear_out
        out: Tensor = self.norm(linear_out.flatten(0, -2)).view(linear_out.shape)
        return out

    def activate(self, linear_out: Tensor) -> Tensor:
        """Batch norm and ReLU of what the linear part gave; it is overwritten."""
        return functional.relu(self.normalise(linear_out), inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        # In rows: the output of a linear layer on more axes is a view, and overwriting a view
        # makes autograd copy it.
        rows = self.activate(self.linear(x.flatten(0, -2)))
        return rows.view(*x.shape[:-1], -1)

    @torch.no_grad()
    def fold(self) -> None:
        """Put the batch norm's running statistics into the linear part (inference only)."""
        if self.norm is None:
            return
        mean, variance = self.norm.running_mean, self.norm.running_var
        assert mean is not None
        assert variance is not None
        gain = self.norm.weight / torch.sqrt(variance + self.norm.eps)
        self.linear.weight.mul_(gain[:, None])
        self.linear.bias.sub_(mean).mul_(gain).add_(self.norm.bias)
        self.norm = None


def stack(widths: tuple[int, ...], norm: Norm) -> nn.Sequential:
    """Layers from ``widths[0]`` inputs through every further width."""
    return nn.Sequential(*(Layer(n_in, n_out, norm) for n_in, n_out in pairwise(widths)))


def greatest_above_zero(values: Tensor) -> Tensor:
    """The maximum over the K neighbours of the ReLU of ``values`` (B, M, K, C) -> (B, M, C)."""
    compiled = values.dtype in _INTEGER and values.device.type == "cpu" and not traced()
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
    """``greatest_above_zero`` in one pass forward and one back. ReLU and maximum by torch are
    eight, with copies between them, and a third of a step of ``quick``."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        batch, m, k, channels = ctx.shape = values.shape
        bits = values.detach().contiguous().view(_INTEGER[values.dtype])
        out = torch.empty(batch, m, channels, dtype=values.dtype)
        chosen = torch.empty(batch * m, channels, dtype=bits.dtype)
        infinity = torch.tensor(torch.inf, dtype=values.dtype).view(bits.dtype)
        point_kernels.greatest(
            bits.view(-1, k, channels).numpy(),
            infinity.numpy()[()],
            out.view(bits.dtype).view(-1, channels).numpy(),
            chosen.numpy(),
        )
        ctx.save_for_backward(chosen)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (chosen,) = ctx.saved_tensors
        (gradient,) = gradients
        bits = gradient.contiguous().view(chosen.dtype).view(chosen.shape)
        out = torch.empty(ctx.shape, dtype=gradient.dtype)
        _, _, k, channels = ctx.shape
        spread = out.view(chosen.dtype).view(-1, k, channels)
        point_kernels.handed_back(bits.numpy(), chosen.numpy(), spread.numpy())
        return out
