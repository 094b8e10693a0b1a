"""The occupancy network's decoder: an MLP on [latent, query] (Mescheder et al., CVPR 2019)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from tumortrack.models.config import MlpDecoderConfig
from tumortrack.models.layers import Layer, Norm


class MlpDecoder(nn.Module):
    """Latent and normalised queries -> logits, the latent's share computed once per cloud.

    Inputs of a hidden layer are ordered [hidden, query, latent]; W [h, q, z] + b is computed as
    W_hq [h, q] + (W_z z + b): the bracket is one vector per cloud.
    """

    def __init__(self, config: MlpDecoderConfig, latent_size: int) -> None:
        super().__init__()
        self.config = config
        self.query_size = 3 * (1 + 2 * len(config.octaves))
        self.layers = nn.ModuleList()
        n_hidden = 0
        for number in range(1, config.hidden_layers + 1):
            n_in = n_hidden + (self.query_size + latent_size if self._sees_query(number) else 0)
            norm: Norm = "batch" if number in config.norm_layers else "none"
            self.layers.append(Layer(n_in, config.width, norm))
            n_hidden = config.width
        self.output = nn.Linear(config.width, config.n_classes)

    def _sees_query(self, number: int) -> bool:
        return number in (1, self.config.skip_layer)

    def _numbered_layers(self) -> list[tuple[int, Layer]]:
        return [(n, m) for n, m in enumerate(self.layers, 1) if isinstance(m, Layer)]

    def prepare(self, latent: Tensor) -> tuple[Tensor, ...]:
        """Latent (B, L) -> the biases (B, 1, width) of the layers that see it."""
        terms = []
        for number, layer in self._numbered_layers():
            if self._sees_query(number):
                linear = layer.linear
                weight = linear.weight[:, -latent.shape[-1] :]
                terms.append(functional.linear(latent, weight, linear.bias)[:, None])
        return tuple(terms)

    def forward(self, terms: tuple[Tensor, ...], queries: Tensor) -> Tensor:
        """``prepare``'s terms and queries (B, Q, 3) -> logits (B, Q, classes)."""
        query = octave_features(queries, self.config.octaves)
        remaining = list(terms)
        hidden: Tensor | None = None
        for number, layer in self._numbered_layers():
            if self._sees_query(number):
                n_hidden = 0 if hidden is None else hidden.shape[-1]
                weight = layer.linear.weight[:, : n_hidden + self.query_size]
                out = functional.linear(query, weight[:, n_hidden:]) + remaining.pop(0)
                if hidden is not None:
                    out += functional.linear(hidden, weight[:, :n_hidden])
                hidden = layer.activate(out)
            else:
                hidden = layer(hidden)
        logits: Tensor = self.output(hidden)
        return logits


def octave_features(queries: Tensor, octaves: tuple[int, ...]) -> Tensor:
    """(..., 3) -> (..., 3 + 6 len(octaves)): the coordinates, then sin and cos of 2^k pi q."""
    if not octaves:
        return queries
    factors = torch.tensor([math.pi * 2.0**k for k in octaves], device=queries.device)
    angles = (queries[..., None, :] * factors[:, None].to(queries)).flatten(-2)
    return torch.cat([queries, torch.sin(angles), torch.cos(angles)], dim=-1)
