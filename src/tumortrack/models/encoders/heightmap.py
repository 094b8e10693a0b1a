"""A cloud seen from one side is a height map: rasterised, then a small convolutional network.

One view has one point per line of sight, so that the picture loses nothing; neither centres nor
neighbours have to be searched, which is most of the cost of PointNet++.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.models import kernels
from tumortrack.models.sampling import compiled

_HALF = 1.25  # normalised units from the picture's middle to its border
_SEEN = 0.05  # of a point's weight: a pixel with less has no height of its own
_SEEN_BESIDE = 0.02  # mean over a pixel and its neighbours


class HeightMapConfig(Config, frozen=True, tag="heightmap"):
    """``pixels`` along a side; ``channels`` of three stages, each of which halves the picture;
    ``n_points``: larger clouds lose the rest (None: take all)."""

    pixels: int = 32
    channels: tuple[int, int, int] = (24, 48, 96)
    n_points: int | None = None

    def __post_init__(self) -> None:
        if self.pixels < 8 or self.pixels % 8:
            raise InputError(f"heightmap: pixels is {self.pixels}; it must be a multiple of 8.")

    @property
    def latent_size(self) -> int:
        return self.channels[-1] * (self.pixels // 8) ** 2

    def build(self) -> HeightMap:
        """The network, with weights from torch's global generator."""
        return HeightMap(self)


class HeightMap(nn.Module):
    """Normalised points (B, N, 3), z away from the camera -> latent (B, L)."""

    def __init__(self, config: HeightMapConfig) -> None:
        super().__init__()
        self.config = config
        layers: list[nn.Module] = []
        for n_in, n_out in pairwise((4, *config.channels)):
            layers += [*_convolution(n_in, n_out, 1), *_convolution(n_out, n_out, 2)]
        layers += _convolution(config.channels[-1], config.channels[-1], 1)
        self.layers = nn.Sequential(*layers)

    def forward(self, points: Tensor) -> Tensor:
        seen = picture(points[:, : self.config.n_points], self.config.pixels)
        # The memory order of convolutions: else each of them would convert to it and back.
        latent: Tensor = self.layers(seen.to(memory_format=torch.channels_last)).flatten(1)
        return latent


def picture(points: Tensor, pixels: int) -> Tensor:
    """Points (B, N, 3) -> (B, 4, pixels, pixels): seen or not and mean height, by pixel, and the
    same over a pixel and its eight neighbours, which closes the gaps between points. A point is
    spread over the four pixels about it, so that heights change smoothly with it."""
    place = (points[..., :2] + _HALF) / (2 * _HALF) * pixels - 0.5
    weight, height = _spread(place, points[..., 2].contiguous(), pixels)
    channels = []
    for least in (_SEEN, _SEEN_BESIDE):
        seen = (weight > least).to(points)
        channels += [seen, height / weight.clamp_min(least) * seen]
        weight, height = (functional.avg_pool2d(v, 3, 1, 1) for v in (weight, height))
    return torch.cat(channels, 1)


def _spread(place: Tensor, heights: Tensor, pixels: int) -> tuple[Tensor, Tensor]:
    """Weights of points (B, N, 2) and weights times heights (B, N), by pixel, (B, 1, P, P)."""
    weight = place.new_zeros(len(place), 1, pixels, pixels)
    height = torch.zeros_like(weight)
    if compiled(place):
        kernels.spread(place.numpy(), heights.numpy(), weight[:, 0].numpy(), height[:, 0].numpy())
        return weight, height
    lowest = place.floor()
    part = place - lowest
    weight, height = weight.flatten(1), height.flatten(1)
    for right in (0, 1):
        for down in (0, 1):
            fraction = (part[..., 0] if right else 1 - part[..., 0]) * (
                part[..., 1] if down else 1 - part[..., 1]
            )
            x, y = lowest[..., 0].long() + right, lowest[..., 1].long() + down
            fraction = fraction * ((x >= 0) & (x < pixels) & (y >= 0) & (y < pixels))
            index = y.clamp(0, pixels - 1) * pixels + x.clamp(0, pixels - 1)
            weight.scatter_add_(1, index, fraction)
            height.scatter_add_(1, index, fraction * heights)
    return weight.view(-1, 1, pixels, pixels), height.view(-1, 1, pixels, pixels)


def _convolution(n_in: int, n_out: int, stride: int) -> list[nn.Module]:
    layer = nn.Conv2d(n_in, n_out, 3, stride, 1)
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return [layer, nn.ReLU(inplace=True)]
