"""The occupancy network: encode a cloud once, query many points.

Both in the camera frame and in mm; inside, everything is relative to a centre taken from the
cloud, so that nothing depends on where the camera is.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from tumortrack.core.errors import InputError
from tumortrack.models.config import MlpDecoderConfig, NetworkConfig
from tumortrack.models.layers import Layer
from tumortrack.models.model import Network
from tumortrack.models.normalisation import (
    Aligned,
    CloudBox,
    alignment,
    normalisation,
    turned,
    without_strays,
)
from tumortrack.occupancy.mlp_decoder import MlpDecoder


@dataclass(frozen=True, eq=False)
class Latent:
    """What is known of B clouds; valid only for the weights (and the mode) that made it."""

    vector: Tensor  # (B, L)
    centre_mm: Tensor  # (B, 1, 3), camera frame
    scale_mm: Tensor  # (B, 1, 1)
    turn: Tensor | None  # (2, B, 1): cosine and sine of the turn about z; None: no turn
    terms: tuple[Tensor, ...]  # the decoder's share, computed once per cloud


class OccupancyNetwork(Network):
    """Labels of query points from one cloud (the paper, section "Localization")."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        if not isinstance(config.decoder, MlpDecoderConfig):
            raise InputError("an occupancy network needs a decoder of queries, such as `mlp`.")
        self.encoder = config.encoder.build()
        self.decoder = MlpDecoder(config.decoder, config.encoder.latent_size)

    def encode(self, points_mm: Tensor) -> Latent:
        """Clouds (B, N, 3), camera frame, mm, float32, points in random order -> Latent."""
        kind = self.config.normalisation
        if not isinstance(kind, CloudBox):
            points_mm = without_strays(points_mm, kind.reach * kind.scale_mm)
        centre_mm, scale_mm = normalisation(points_mm, kind)
        points = (points_mm - centre_mm) / scale_mm
        turn = None
        if isinstance(kind, Aligned):
            turn = alignment(points)
            points = turned(points, turn)
        vector = self.encoder(points)
        return Latent(vector, centre_mm, scale_mm, turn, self.decoder.prepare(vector))

    def query(self, latent: Latent, queries_mm: Tensor) -> Tensor:
        """Queries (B, Q, 3), camera frame, mm, float32 -> logits (B, Q, classes)."""
        logits: Tensor = self.decoder(latent.terms, normalised(latent, queries_mm))
        return logits

    def forward(self, points_mm: Tensor, queries_mm: Tensor) -> Tensor:
        """Both at once: (B, N, 3) and (B, Q, 3) -> logits (B, Q, classes)."""
        return self.query(self.encode(points_mm), queries_mm)

    def loss(
        self,
        clouds_mm: Tensor,
        points_mm: Tensor,
        labels: Tensor,
        camera_from_ct: Tensor,
        *,
        first: int = 0,
    ) -> Tensor:
        """Cross-entropy of the points' labels, all points equal (the paper). Neither the poses nor
        the first cloud's number in the batch are used."""
        logits = self.query(self.encode(clouds_mm), points_mm)
        flat = logits.float().flatten(0, 1)
        return nn.functional.cross_entropy(flat, labels.long().flatten())

    def onnx_parts(self, cloud_mm: Tensor) -> tuple[nn.Module, tuple[Tensor, ...], dict[str, Any]]:
        """See ``Network``: clouds and queries in, logits out."""
        free = {"queries_mm": {1: "queries"}, "logits": {1: "queries"}}
        names = {"input_names": ["cloud_mm", "queries_mm"], "output_names": ["logits"]}
        return self.folded().cpu(), (cloud_mm, cloud_mm[:, :7]), {**names, "dynamic_axes": free}

    def folded(self) -> OccupancyNetwork:
        """A copy for inference: batch norms folded into their linear layers, no gradients."""
        out = copy.deepcopy(self).eval().requires_grad_(False)
        for module in out.modules():
            if isinstance(module, Layer):
                module.fold()
        return out


def normalised(latent: Latent, queries_mm: Tensor) -> Tensor:
    """Queries (B, Q, 3), camera frame, mm -> as the decoder is asked for them."""
    queries = (queries_mm - latent.centre_mm) / latent.scale_mm
    return queries if latent.turn is None else turned(queries, latent.turn)
