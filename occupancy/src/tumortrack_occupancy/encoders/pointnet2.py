"""PointNet++ (Qi et al., NIPS 2017): set abstraction levels, then one global level."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from tumortrack.core.config import Config
from tumortrack_occupancy.layers import Layer, Norm, max_over_neighbours, stack
from tumortrack_occupancy.sampling import ball_query, farthest_points, strided_points, take, traced

_AT_ONCE = 128  # centres


class SetAbstraction(Config, frozen=True):
    """One level: choose centres among the points, and encode the neighbourhood of each. ``ratio``:
    centres per point (rounded up). ``radius``: of the ball, in normalised units. ``neighbours``:
    most points in a ball. ``widths``: of the MLP, whose maximum over them is the feature."""

    ratio: float
    radius: float
    neighbours: int
    widths: tuple[int, ...]


class PointNet2Config(Config, frozen=True, tag="pointnet2"):
    """``levels``, then a global one: an MLP of ``widths`` on [position, feature], whose maximum is
    the latent code. ``n_points``: larger clouds, in random order, are first thinned to this number
    by stride; None: never."""

    levels: tuple[SetAbstraction, ...]
    widths: tuple[int, ...]
    norm: Norm = "batch"
    n_points: int | None = None

    @property
    def latent_size(self) -> int:
        return self.widths[-1]

    def build(self) -> PointNet2:
        """The network, with weights from torch's global generator."""
        return PointNet2(self)


class PointNet2(nn.Module):
    """Normalised points (B, N, 3) -> latent (B, L); N may differ from call to call."""

    def __init__(self, config: PointNet2Config) -> None:
        super().__init__()
        self.config = config
        features = [0, *(level.widths[-1] for level in config.levels)]
        self.levels = nn.ModuleList(
            _Level(level, n_features, config.norm)
            for level, n_features in zip(config.levels, features, strict=False)
        )
        self.summary = stack((3 + features[-1], *config.widths), config.norm)

    def forward(self, points: Tensor) -> Tensor:
        limit = self.config.n_points
        if limit is not None and points.shape[1] > limit:
            points = take(points, strided_points(points, limit))
        features: Tensor | None = None
        for level in self.levels:
            points, features = level(points, features)
        summary = points if features is None else torch.cat([points.to(features), features], -1)
        out: Tensor = self.summary(summary).amax(dim=1)
        return out


class _Level(nn.Module):
    """Points (B, N, 3) and features (B, N, F) or none -> centres (B, M, 3), features (B, M, G).
    The first linear layer on [p_j - c_i, f_j] is W_p (p_j - c_i) + W_f f_j; the second product is
    computed once per point, before neighbours are gathered. Offsets are computed in full precision
    and divided by the radius."""

    def __init__(self, level: SetAbstraction, n_features: int, norm: Norm) -> None:
        super().__init__()
        self.level = level
        self.first = Layer(3 + n_features, level.widths[0], norm)
        self.rest = stack(level.widths, norm)

    def forward(self, points: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        level, count = self.level, math.ceil(self.level.ratio * points.shape[1])
        centres = take(points, farthest_points(points, count))
        neighbours = ball_query(points, centres, level.radius, level.neighbours)
        weight, projected = self.first.linear.weight, None
        if features is not None:
            projected = functional.linear(features, weight[:, 3:])
        if torch.is_grad_enabled() or traced() or points.device.type != "cpu":
            return centres, self._encode(points, centres, neighbours, projected)
        # In inference, in chunks of centres that fit in the cache.
        chunks = zip(centres.split(_AT_ONCE, 1), neighbours.split(_AT_ONCE, 1), strict=True)
        return centres, torch.cat([self._encode(points, *chunk, projected) for chunk in chunks], 1)

    def _encode(
        self, points: Tensor, centres: Tensor, neighbours: Tensor, projected: Tensor | None
    ) -> Tensor:
        """Features (B, M, G) of centres (B, M, 3) from their neighbours (B, M, K)."""
        offsets = (take(points, neighbours) - centres[:, :, None]) / self.level.radius
        linear = self.first.linear
        grouped = functional.linear(offsets, linear.weight[:, :3], linear.bias)
        if projected is not None:
            grouped = grouped + take(projected, neighbours)
        hidden = self.first.activate(grouped)
        *layers, last = self.rest
        for layer in layers:
            hidden = layer(hidden)
        assert isinstance(last, Layer)
        # ReLU after the maximum gives the same numbers and gradients, for a K-th of the work.
        out = last.normalise(last.linear(hidden))
        return functional.relu(max_over_neighbours(out))
