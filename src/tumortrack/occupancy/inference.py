"""An occupancy network as it runs: norms folded, the numbers the processor is fastest with, chunks
that stay in cache.

``OccupancyNetwork`` itself, in single precision and in one piece, is the reference.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.occupancy.arithmetic import Arithmetic, usual
from tumortrack.occupancy.network import Latent, OccupancyNetwork
from tumortrack.occupancy.packed import PackedDecoder, pack_stacks

# Latent and queries (1, Q, 3), mm -> logits (1, Q, classes), float32
Decode = Callable[[Latent, Tensor], Tensor]


class Inference:
    """A network for use, on the device where it lies.

    Args:
        arithmetic: how queries are answered; None: what is usually fastest.
    """

    def __init__(self, network: OccupancyNetwork, arithmetic: Arithmetic | None = None) -> None:
        self.network = network.folded()
        self.device = next(network.parameters()).device
        self.arithmetic = arithmetic or usual(self.device)
        self._decode = decoder(self.network, self.arithmetic)
        packed = self.arithmetic.numbers != "network"
        if packed:
            pack_stacks(self.network.encoder)
        self._bf16 = not packed and has_fast_bfloat16(self.device)

    @torch.inference_mode()
    def encode(self, points_mm: Float32[np.ndarray, "n 3"]) -> Latent:
        """A cloud, camera frame, mm -> what is known of it."""
        points = torch.tensor(points_mm, dtype=torch.float32)[None]
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._bf16):
            return self.network.encode(points.to(self.device))

    @torch.inference_mode()
    def logits(self, latent: Latent, points_mm: Float32[np.ndarray, "n 3"]) -> Tensor:
        """Points, camera frame, mm -> (n, classes), float32, on the network's device."""
        queries = torch.tensor(points_mm, dtype=torch.float32)[None]
        return self._decode(latent, queries.to(self.device))[0]


def decoder(network: OccupancyNetwork, arithmetic: Arithmetic) -> Decode:
    """What answers queries by a folded network; any number of them at once."""
    rows = arithmetic.chunk
    if next(network.parameters()).device.type == "cpu":
        rows *= torch.get_num_threads()
    if arithmetic.numbers == "network":
        return _as_it_is(network, rows)
    numbers = torch.bfloat16 if arithmetic.numbers == "bfloat16" else torch.float32
    return PackedDecoder(network, numbers, rows)


def _as_it_is(network: OccupancyNetwork, rows: int) -> Decode:
    device = next(network.parameters()).device
    bf16 = has_fast_bfloat16(device)

    def decode(latent: Latent, queries_mm: Tensor) -> Tensor:
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            parts = queries_mm.split(rows, dim=1)
            return torch.cat([network.query(latent, part).float() for part in parts], 1)

    return decode
