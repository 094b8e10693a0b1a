"""What encoders and decoders are made of: linear layers, and the maximum over neighbours."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

Norm = Literal["none", "batch"]


class Layer(nn.Module):
    """Linear, optional batch norm, ReLU; over the last axis of any array. He initialisation and
    zero biases: without a norm, activations then keep their scale through many layers."""

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
        """Batch norm and ReLU of the linear part's output, which is overwritten."""
        # In rows: overwriting a view makes autograd copy it.
        rows = linear_out if self.norm is None else self.norm(linear_out.flatten(0, -2))
        return functional.relu(rows, inplace=True).view(linear_out.shape)

    def forward(self, x: Tensor) -> Tensor:
        # The output of a linear layer on more axes is a view, too.
        rows = self.activate(self.linear(x.flatten(0, -2)))
        return rows.view(*x.shape[:-1], -1)

    @torch.no_grad()
    def fold(self) -> None:
        """Fold the batch norm's running statistics into the linear part (inference only)."""
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
    """An MLP: layers from ``widths[0]`` inputs through every further width."""
    return nn.Sequential(*(Layer(n_in, n_out, norm) for n_in, n_out in pairwise(widths)))


def max_over_neighbours(values: Tensor) -> Tensor:
    """The maximum over the K neighbours, (B, M, K, C) -> (B, M, C), by pooling, which is several
    times faster than a maximum along an axis."""
    if values.requires_grad and values.device.type == "cpu":
        return cast(Tensor, _Maximum.apply(values))
    channels_first = values.permute(0, 3, 1, 2)
    return functional.max_pool2d(channels_first, (1, values.shape[2])).squeeze(-1).transpose(1, 2)


class _Maximum(torch.autograd.Function):
    """The same with a backward pass for a CPU, where that of pooling is slow."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        k = values.shape[2]
        pooled = functional.max_pool2d(values.permute(0, 3, 1, 2), (1, k), return_indices=True)
        out, index = (each.squeeze(-1).transpose(1, 2) for each in pooled)
        ctx.save_for_backward(index % k)
        ctx.neighbours = k
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (index,), (gradient,) = ctx.saved_tensors, gradients
        batch, centres, channels = gradient.shape
        zeros = gradient.new_zeros((batch, centres, ctx.neighbours, channels))
        return zeros.scatter_(2, index[:, :, None], gradient[:, :, None])
