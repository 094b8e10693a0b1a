"""An occupancy network as it runs: norms folded, bf16 where it pays, chunks that stay in cache.

``OccupancyNetwork`` itself, in single precision and in one piece, is the reference.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from tumortrack.learn.model import has_fast_bfloat16
from tumortrack.learn.network import Latent, OccupancyNetwork

CHUNK = 1024  # queries at once and core: their activations (1 MB at 512 channels) stay in its cache
_CHUNK_GPU = 2**17

# Latent and queries (1, Q, 3), mm -> logits (1, Q, classes)
Decode = Callable[[Latent, Tensor], Tensor]


class Inference:
    """A network for use, on the device where it lies.

    Args:
        decode: what answers queries; None: the network itself.
    """

    def __init__(self, network: OccupancyNetwork, decode: Decode | None = None) -> None:
        self.network = network.folded()
        self.device = next(network.parameters()).device
        self._bf16 = has_fast_bfloat16(self.device)
        self._decode = decode or self.network.query

    @torch.inference_mode()
    def encode(self, points_mm: Float32[np.ndarray, "n 3"]) -> Latent:
        """A cloud, camera frame, mm -> what is known of it."""
        points = torch.from_numpy(np.ascontiguousarray(points_mm, np.float32))[None]
        with self._precision():
            return self.network.encode(points.to(self.device))

    @torch.inference_mode()
    def logits(self, latent: Latent, points_mm: Float32[np.ndarray, "n 3"]) -> Tensor:
        """Points, camera frame, mm -> (n, classes), float32, on the network's device."""
        queries = torch.from_numpy(np.ascontiguousarray(points_mm, np.float32))[None]
        on_cpu = self.device.type == "cpu"
        size = CHUNK * torch.get_num_threads() if on_cpu else _CHUNK_GPU
        with self._precision():
            parts = queries.to(self.device).split(size, dim=1)
            return torch.cat([self._decode(latent, part)[0].float() for part in parts])

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._bf16)
