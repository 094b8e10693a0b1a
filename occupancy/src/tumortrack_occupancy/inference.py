"""An occupancy network in use: batch norms folded, the arithmetic that the processor is fastest
with, chunks of queries that stay in the cache.

Packed layers are oneDNN's own linear layers: weights cast and laid out once, ReLU in the same pass.
They need no compiler and use what oneDNN finds in the processor (AVX-512 with bf16, AMX). On a Zen
5 core they reach nine tenths of the speed of a lone bf16 matrix product; AOTInductor was no faster.
``OccupancyNetwork`` itself, in single precision and in one piece, is the reference.
"""

from __future__ import annotations

import platform
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from tumortrack_occupancy.hardware import has_fast_bfloat16
from tumortrack_occupancy.layers import Layer
from tumortrack_occupancy.network import Latent, MlpDecoder, OccupancyNetwork, octave_features

# Queries at once and core: their activations (2 MB at 512 channels) stay near it. With 1,024 or
# 4,096 nothing was faster by more than one run differs from the next (AMX, quick and paper).
_CHUNK, _CHUNK_GPU = 2048, 2**17
_ENCODER_ROWS = 4096
_ROUND = 512  # rows

Numbers = Literal["network", "float32", "bfloat16"]


def can_pack(device: torch.device) -> bool:
    """Whether packed layers exist for the device: oneDNN on an x86 processor."""
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    if device.type != "cpu" or not x86 or not torch.backends.mkldnn.is_available():
        return False
    operators = torch.ops.mkldnn  # private: another PyTorch may lack them
    return all(hasattr(operators, name) for name in ("_reorder_linear_weight", "_linear_pointwise"))


def fastest(device: torch.device) -> Numbers:
    """What the device has fast instructions for."""
    if not can_pack(device):
        return "network"
    return "bfloat16" if has_fast_bfloat16(device) else "float32"


class Inference:
    """A network in use, where it lies. ``numbers``: ``network`` is the network as it is
    (``torch.autocast``), the others are its packed form; None: what is fastest."""

    def __init__(self, network: OccupancyNetwork, numbers: Numbers | None = None) -> None:
        self.network = network.folded()
        self.device = next(network.parameters()).device
        self.numbers: Numbers = numbers or fastest(self.device)
        on_cpu = self.device.type == "cpu"
        self._rows = _CHUNK * torch.get_num_threads() if on_cpu else _CHUNK_GPU
        packed = self.numbers != "network"
        self._bf16 = not packed and has_fast_bfloat16(self.device)
        if packed:
            dtype = torch.bfloat16 if self.numbers == "bfloat16" else torch.float32
            self.network.decoder = PackedDecoder(self.network.decoder, dtype, self._rows)
            pack_stacks(self.network.encoder)

    @torch.inference_mode()
    def encode(self, points_mm: Float32[np.ndarray, "n 3"]) -> Latent:
        """The latent of a cloud, camera frame, mm."""
        points = torch.tensor(points_mm, dtype=torch.float32)[None]
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._bf16):
            return self.network.encode(points.to(self.device))

    @torch.inference_mode()
    def logits(self, latent: Latent, points_mm: Float32[np.ndarray, "n 3"]) -> Tensor:
        """Points, camera frame, mm -> (n, classes), float32, on the network's device."""
        queries = torch.tensor(points_mm, dtype=torch.float32)[None].to(self.device)
        terms, decoder = latent.terms, self.network.decoder
        if isinstance(decoder, PackedDecoder):
            queries, terms = filled_up(queries), decoder.cast(terms)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._bf16):
            parts = latent.normalised(queries).split(self._rows, dim=1)
            logits = torch.cat([decoder(terms, part).float() for part in parts], 1)
        return logits[0, : len(points_mm)]


def filled_up(queries: Tensor) -> Tensor:
    """Queries (1, Q, 3) with the last one repeated until their number is a round one: oneDNN
    compiles and keeps a kernel for every number of rows that it meets, and frames that each have
    another number of queries would fill memory (0.7 GB until its cache is full)."""
    n = queries.shape[1]
    full = -(-n // _ROUND) * _ROUND if n > _ROUND else 1 << max(n - 1, 0).bit_length()
    return torch.cat([queries, queries[:, -1:].expand(-1, full - n, -1)], 1) if n else queries


def _memory_layout(weight: Tensor, rows: int, dtype: torch.dtype) -> Tensor:
    """Weights (out, in) laid out for ``rows`` of x at once; any other number works too."""
    held = weight.detach().to(dtype).contiguous()
    out: Tensor = torch.ops.mkldnn._reorder_linear_weight(held, rows)
    return out


def _linear(x: Tensor, packed: Tensor, bias: Tensor, after: str = "none") -> Tensor:
    """Rows (n, in) -> (n, out), with ReLU in the same pass where ``after`` is "relu"."""
    out: Tensor = torch.ops.mkldnn._linear_pointwise(x, packed, bias, after, (), "")
    return out


class PackedLayer(nn.Module):
    """A folded ``Layer`` in one pass, for inference: (..., in) -> (..., out)."""

    def __init__(self, layer: Layer) -> None:
        super().__init__()
        weight = layer.linear.weight
        self._weight, self._bias = (
            _memory_layout(weight, _ENCODER_ROWS, weight.dtype),
            layer.linear.bias,
        )

    def forward(self, x: Tensor) -> Tensor:
        return _linear(x.flatten(0, -2), self._weight, self._bias, "relu").view(*x.shape[:-1], -1)


def pack_stacks(encoder: nn.Module) -> None:
    """Replace the layers in a folded encoder's stacks, in place. In single precision: an error of
    the latent moves every label, and an encoder is a small part of a frame."""
    for module in encoder.modules():
        if isinstance(module, nn.Sequential):
            for n, layer in enumerate(module):
                if isinstance(layer, Layer):
                    module[n] = PackedLayer(layer)


class PackedDecoder(MlpDecoder):
    """A folded decoder of one cloud's queries, ``rows`` at once, in ``dtype``. In bf16 a coordinate
    would be rounded to a tenth of a millimetre; so what the rounding took is given as three more
    inputs, and positions stay exact."""

    def __init__(self, decoder: MlpDecoder, dtype: torch.dtype, rows: int) -> None:
        nn.Module.__init__(self)
        self.config, self.query_size = decoder.config, decoder.query_size
        self.layers, self.output, self._dtype = decoder.layers, decoder.output, dtype
        # Per layer: weights of the layer before, weights of the query, bias. The bias of
        # layers that see the query comes with the latent.
        self._packed: list[tuple[Tensor | None, Tensor | None, Tensor]] = []
        n_hidden = 0
        for layer in self.hidden_layers():
            weight, size = layer.linear.weight, self.query_size
            of_hidden = _memory_layout(weight[:, :n_hidden], rows, dtype) if n_hidden else None
            of_query = None
            if weight.shape[1] > n_hidden:
                columns = weight[:, n_hidden : n_hidden + size]
                of_query = _memory_layout(torch.cat([columns, columns[:, :3]], 1), rows, dtype)
            self._packed.append((of_hidden, of_query, layer.linear.bias.to(dtype)))
            n_hidden = len(weight)
        self._output = _memory_layout(self.output.weight, rows, dtype), self.output.bias.to(dtype)

    def cast(self, terms: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """``prepare``'s terms as ``forward`` takes them."""
        return tuple(term[0, 0].to(self._dtype) for term in terms)

    def forward(self, terms: tuple[Tensor, ...], queries: Tensor) -> Tensor:
        """Terms and queries (1, Q, 3) -> logits (1, Q, classes), float32."""
        features = octave_features(queries[0], self.config.octaves)
        rounded = features.to(self._dtype)
        lost = (features[:, :3] - rounded[:, :3]).to(self._dtype)
        query = hidden = torch.cat([rounded, lost], 1)
        remaining = iter(terms)
        for of_hidden, of_query, bias in self._packed:
            if of_query is None:
                assert of_hidden is not None
                hidden = _linear(hidden, of_hidden, bias, "relu")
            elif of_hidden is None:
                hidden = _linear(query, of_query, next(remaining), "relu")
            else:
                added = _linear(query, of_query, next(remaining))
                both = (hidden, added, of_hidden, None, "add")
                hidden = torch.ops.mkldnn._linear_pointwise.binary(*both).relu_()
        return _linear(hidden, *self._output).float()[None]
