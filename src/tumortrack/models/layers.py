"""The one layer that encoders and decoders are made of."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

Norm = Literal["none", "batch"]


class Layer(nn.Module):
    """Linear, batch norm where asked for, ReLU; over the last axis of any array.

    Weights start as He's, biases at zero: without a norm the signal then keeps its size through
    many layers, which torch's default start does not give.
    """

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

    def before_relu(self, x: Tensor) -> Tensor:
        """All but the ReLU, (..., n_in) -> (..., n_out)."""
        return self.normalise(self.linear(x))

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
