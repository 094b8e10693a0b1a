"""Inference with an occupancy network: batch norms folded, bf16 where the device has instructions
for it, queries in chunks that stay in the cache. ``OccupancyNetwork`` itself, in single precision
and in one piece, is the reference."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from tumortrack_occupancy.hardware import has_fast_bfloat16
from tumortrack_occupancy.network import Latent, OccupancyNetwork

# Queries at a time, per core: their activations (2 MB at 512 channels) stay in its cache
_CHUNK, _CHUNK_GPU = 2048, 2**17
_ROW_MULTIPLE = 512


class Inference:
    """A network in use, on its own device. ``bfloat16``: its arithmetic; None: where it is fast."""

    def __init__(self, network: OccupancyNetwork, bfloat16: bool | None = None) -> None:
        self.network = network.folded()
        self.device = next(network.parameters()).device
        self._bfloat16 = has_fast_bfloat16(self.device) if bfloat16 is None else bfloat16
        on_cpu = self.device.type == "cpu"
        self._rows = _CHUNK * torch.get_num_threads() if on_cpu else _CHUNK_GPU

    @torch.inference_mode()
    def encode(self, points_mm: Float32[np.ndarray, "n 3"]) -> Latent:
        """The latent of a cloud, camera frame, mm. In single precision on a CPU: an error of the
        latent code moves every label, and the encoder takes a small part of a frame's time."""
        points = torch.tensor(points_mm, dtype=torch.float32)[None].to(self.device)
        if self.device.type == "cpu":
            return self.network.encode(points)
        with self._arithmetic():
            return self.network.encode(points)

    @torch.inference_mode()
    def logits(self, latent: Latent, points_mm: Float32[np.ndarray, "n 3"]) -> Tensor:
        """Points, camera frame, mm -> (n, classes), float32, on the network's device."""
        queries = padded(torch.tensor(points_mm, dtype=torch.float32)[None].to(self.device))
        with self._arithmetic():
            parts = latent.normalised(queries).split(self._rows, dim=1)
            decoder = self.network.decoder
            logits = torch.cat([decoder(latent.terms, part).float() for part in parts], 1)
        return logits[0, : len(points_mm)]

    def _arithmetic(self) -> torch.autocast:  # its own for each call: it keeps what was before
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._bfloat16)


def padded(queries: Tensor) -> Tensor:
    """Queries (1, Q, 3) with the last one repeated up to a round number. oneDNN compiles and keeps
    a kernel for every number of rows; frames that each have another number of queries would fill
    memory (0.7 GB until its cache is full)."""
    n, m = queries.shape[1], _ROW_MULTIPLE
    full = -(-n // m) * m if n > m else 1 << max(n - 1, 0).bit_length()
    return torch.cat([queries, queries[:, -1:].expand(-1, full - n, -1)], 1) if n else queries
