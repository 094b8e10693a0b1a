"""What a research repository would have: the same answers, in the plain way.

The occupancy network as PointNet++ and occupancy networks are usually written: single precision;
farthest points by a Python loop, neighbours by sorting a whole matrix, batch norms apart, the
latent joined to every query, everything in one piece. Of a network it takes single layers and the
configuration and nothing else, so that it is also an independent reference. Source: the forms of
github.com/yanx27/Pointnet_Pointnet2_pytorch and of Mescheder et al., CVPR 2019.

An elastic body's flow by SciPy.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional

from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack_occupancy.config import MlpDecoderConfig
from tumortrack_occupancy.encoders.pointnet2 import PointNet2Config
from tumortrack_occupancy.network import Latent, OccupancyNetwork, octave_features
from tumortrack_occupancy.normalisation import (
    Aligned,
    CloudBox,
    alignment,
    normalisation,
    turned,
    without_strays,
)

FLOW_STEPS = 12


class NaiveOccupancy:
    """``encode`` clouds, ``logits`` of queries, in the mode that the network is in."""

    def __init__(self, network: OccupancyNetwork) -> None:
        encoder, decoder = network.config.encoder, network.config.decoder
        assert isinstance(encoder, PointNet2Config)
        assert isinstance(decoder, MlpDecoderConfig)
        self._encoder, self._decoder, self._network = encoder, decoder, network

    def encode(self, points_mm: Tensor) -> Latent:
        """Clouds (B, N, 3), mm."""
        kind = self._network.config.normalisation
        if not isinstance(kind, CloudBox):
            points_mm = without_strays(points_mm, kind.reach * kind.scale_mm)
        centre, scale = normalisation(points_mm, kind)
        points, turn = (points_mm - centre) / scale, None
        if isinstance(kind, Aligned):
            turn = alignment(points)
            points = turned(points, turn)
        return Latent(self._latent(points), centre, scale, turn, ())

    def logits(self, encoded: Latent, queries_mm: Tensor) -> Tensor:
        """Queries (B, Q, 3), mm -> (B, Q, classes), the latent beside each."""
        config, latent = self._decoder, encoded.vector
        given = octave_features(encoded.normalised(queries_mm), config.octaves)
        given = torch.cat([given, latent[:, None].expand(-1, given.shape[1], -1)], -1)
        hidden = given
        for number in range(1, config.hidden_layers + 1):
            if number == config.skip_layer and number > 1:
                hidden = torch.cat([hidden, given], -1)
            hidden = self._layer(f"decoder.layers.{number - 1}", hidden)
        return self._network.decoder.output(hidden)

    def _latent(self, points: Tensor) -> Tensor:
        config = self._encoder
        n = points.shape[1]
        if config.n_points is not None and n > config.n_points:
            points = points[:, torch.arange(config.n_points) * n // config.n_points]
        features = points[..., :0]
        for number, level in enumerate(config.levels):
            k = math.ceil(level.ratio * points.shape[1])
            centres = rows_of(points, farthest_points(points, k))
            near = neighbours(points, centres, level.radius, level.neighbours)
            offsets = (rows_of(points, near) - centres[:, :, None]) / level.radius
            grouped = torch.cat([offsets, rows_of(features, near)], -1)
            grouped = self._layer(f"encoder.levels.{number}.first", grouped)
            for layer in range(len(level.widths) - 1):
                grouped = self._layer(f"encoder.levels.{number}.rest.{layer}", grouped)
            points, features = centres, grouped.max(2).values
        out = torch.cat([points, features], -1)
        for layer in range(len(config.widths)):
            out = self._layer(f"encoder.summary.{layer}", out)
        return out.max(1).values

    def _layer(self, name: str, x: Tensor) -> Tensor:
        """Linear, batch norm where there is one, ReLU."""
        layer: Any = self._network.get_submodule(name)
        return functional.relu(layer.normalise(layer.linear(x)))


def farthest_points(points: Tensor, k: int) -> Tensor:
    """Farthest point sampling of clouds (B, N, 3) -> (B, k), a Python loop; begun at the point
    farthest from the middle."""
    nearest = torch.full(points.shape[:2], torch.inf, device=points.device)
    newest = _square(points - points.mean(1, keepdim=True)).argmax(1)
    chosen = []
    every = torch.arange(len(points), device=points.device)
    for _ in range(k):
        chosen.append(newest)
        nearest = torch.minimum(nearest, _square(points - points[every, newest][:, None]))
        newest = nearest.argmax(1)
    return torch.stack(chosen, 1)


def neighbours(points: Tensor, centres: Tensor, radius: float, k: int) -> Tensor:
    """The first ``k`` points (B, N, 3) within ``radius`` of each centre (B, M, 3) -> (B, M, k), by
    sorting all; the first of them again where there are fewer."""
    n = points.shape[1]
    index = torch.arange(n, device=points.device).repeat(*centres.shape[:2], 1)
    index[_square(centres[:, :, None] - points[:, None]) > radius**2] = n
    index = index.sort(-1).values[..., :k]
    return torch.where(index == n, index[..., :1].expand_as(index), index).clamp_max(n - 1)


def rows_of(values: Tensor, index: Tensor) -> Tensor:
    """Rows of (B, N, C) at (B, ...) -> (B, ..., C)."""
    every = torch.arange(len(values), device=values.device)
    return values[every.view(-1, *([1] * (index.dim() - 1))), index]


def _square(offsets: Tensor) -> Tensor:
    x, y, z = offsets.unbind(-1)
    return x * x + y * y + z * z


def flowed(body: ElasticBody, coefficients: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the CT frame after one unit of time in a body's velocity: midpoint rule,
    SciPy's interpolation."""
    field = np.moveaxis(body.velocity(coefficients), 3, 0)
    moved = np.array(points, float)
    for _ in range(FLOW_STEPS):
        middle = moved + sampled(body, field, moved) / (2 * FLOW_STEPS)
        moved += sampled(body, field, middle) / FLOW_STEPS
    return moved


def sampled(body: ElasticBody, fields: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Fields (f, i, j, k) on a body's lattice at points (n, 3) -> (n, f)."""
    place = (points - body.origin_mm).T / body.spacing_mm
    return np.stack([map_coordinates(f, place, order=1, mode="nearest") for f in fields], 1)
