"""What encoders and decoders are made of: linear layers, and the maximum over neighbours."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

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
        return functional.relu(self.normalise(linear_out), inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        # In rows: the output of a linear layer on more axes is a view, and overwriting a view
        # makes autograd copy it.
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
    times faster than a maximum along an axis. Its backward pass is slow on a CPU; there the
    gradient goes through an indexing of the same values."""
    batch, _, k, channels = values.shape
    channels_first = values.permute(0, 3, 1, 2)
    if not values.requires_grad or values.device.type != "cpu":
        return functional.max_pool2d(channels_first, (1, k)).squeeze(-1).transpose(1, 2)
    with torch.no_grad():
        _, index = functional.max_pool2d(channels_first, (1, k), return_indices=True)
    row = torch.arange(batch)[:, None, None]
    return values.flatten(1, 2)[row, index.squeeze(-1).transpose(1, 2), torch.arange(channels)]
