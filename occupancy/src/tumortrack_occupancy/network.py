"""The occupancy network: encode a cloud once, query many points.

Clouds and queries are in the camera frame, mm. Inside, everything is relative to a centre taken
from the cloud, so that nothing depends on where the camera is.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from tumortrack_occupancy.config import MlpDecoderConfig, NetworkConfig
from tumortrack_occupancy.layers import Layer, Norm
from tumortrack_occupancy.normalisation import normalised, rotated


@dataclass(frozen=True, eq=False)
class Latent:
    """The latent codes of B clouds; valid only for the weights (and the mode) that made them."""

    vector: Tensor  # (B, L)
    centre_mm: Tensor  # (B, 1, 3), camera frame
    scale_mm: Tensor  # (B, 1, 1)
    rotation: Tensor | None  # (2, B, 1): cosine and sine of the angle about z
    terms: tuple[Tensor, ...]  # ``MlpDecoder.prepare``, once per cloud

    def normalised(self, queries_mm: Tensor) -> Tensor:
        """Queries (B, Q, 3), camera frame, mm -> the decoder's input."""
        queries = (queries_mm - self.centre_mm) / self.scale_mm
        return queries if self.rotation is None else rotated(queries, self.rotation)


class MlpDecoder(nn.Module):
    """An MLP on [latent, query] (Mescheder et al., CVPR 2019). A hidden layer's inputs are ordered
    [hidden, query, latent]; W [h, q, z] + b is computed as W_hq [h, q] + (W_z z + b), and the
    bracket once per cloud."""

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

    def hidden_layers(self) -> list[Layer]:
        """All layers but the output, typed."""
        return [layer for layer in self.layers if isinstance(layer, Layer)]

    def prepare(self, latent: Tensor) -> tuple[Tensor, ...]:
        """Latent (B, L) -> the biases (B, 1, width) of the layers that see it."""
        terms = []
        for number, layer in enumerate(self.hidden_layers(), 1):
            if self._sees_query(number):
                weight = layer.linear.weight[:, -latent.shape[-1] :]
                terms.append(functional.linear(latent, weight, layer.linear.bias)[:, None])
        return tuple(terms)

    def forward(self, terms: tuple[Tensor, ...], queries: Tensor) -> Tensor:
        """``prepare``'s terms and queries (B, Q, 3) -> logits (B, Q, classes). Queries stay in
        single precision under autocast: bf16 rounds a coordinate to a tenth of a millimetre."""
        query = octave_features(queries, self.config.octaves)
        remaining = list(terms)
        hidden: Tensor | None = None
        for number, layer in enumerate(self.hidden_layers(), 1):
            if self._sees_query(number):
                n_hidden = 0 if hidden is None else hidden.shape[-1]
                weight = layer.linear.weight[:, : n_hidden + self.query_size]
                with torch.autocast(query.device.type, enabled=False):
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


class OccupancyNetwork(nn.Module):
    """Classifies query points given one cloud (the paper, section "Localization")."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = config.encoder.build()
        self.decoder = MlpDecoder(config.decoder, config.encoder.latent_size)

    def encode(self, points_mm: Tensor) -> Latent:
        """Clouds (B, N, 3), camera frame, mm, float32, points in random order -> Latent."""
        points, centre_mm, scale_mm, rotation = normalised(points_mm, self.config.normalisation)
        vector = self.encoder(points)
        return Latent(vector, centre_mm, scale_mm, rotation, self.decoder.prepare(vector))

    def query(self, latent: Latent, queries_mm: Tensor) -> Tensor:
        """Queries (B, Q, 3), camera frame, mm, float32 -> logits (B, Q, classes)."""
        logits: Tensor = self.decoder(latent.terms, latent.normalised(queries_mm))
        return logits

    def forward(self, points_mm: Tensor, queries_mm: Tensor) -> Tensor:
        """Clouds (B, N, 3) and queries (B, Q, 3) -> logits (B, Q, classes)."""
        return self.query(self.encode(points_mm), queries_mm)

    def loss(self, clouds_mm: Tensor, points_mm: Tensor, labels: Tensor) -> Tensor:
        """Cross-entropy of the points' labels, all weighted equally (the paper)."""
        logits = self(clouds_mm, points_mm)
        return functional.cross_entropy(logits.float().flatten(0, 1), labels.long().flatten())

    def folded(self) -> OccupancyNetwork:
        """A copy for inference: batch norms folded into their linear layers, no gradients."""
        out = copy.deepcopy(self).eval().requires_grad_(False)
        for module in out.modules():
            if isinstance(module, Layer):
                module.fold()
        return out
