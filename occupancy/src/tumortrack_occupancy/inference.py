"""Inference with an occupancy network: batch norms folded, the processor's fastest arithmetic,
queries in chunks that stay in the cache.

Packed layers are oneDNN's linear layers: weights are cast and laid out once, and ReLU is fused.
They need no compiler and use what the processor has (AVX-512 with bf16, AMX). On a Zen 5 core they
reach nine tenths of the speed of a bf16 matrix product alone; AOTInductor was no faster.
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

# Queries at a time, per core: their activations (2 MB at 512 channels) stay in its cache. With
# 1,024 or 4,096 no difference exceeded that between runs (AMX, quick and paper).
_CHUNK, _CHUNK_GPU = 2048, 2**17
_ENCODER_ROWS = 4096
_ROW_MULTIPLE = 512

Arithmetic = Literal["network", "float32", "bfloat16"]


def can_pack(device: torch.device) -> bool:
    """Whether packed layers exist for the device: oneDNN on an x86 processor."""
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    if device.type != "cpu" or not x86 or not torch.backends.mkldnn.is_available():
        return False
    operators = torch.ops.mkldnn  # private: another PyTorch may lack them
    return all(hasattr(operators, name) for name in ("_reorder_linear_weight", "_linear_pointwise"))


def fastest(device: torch.device) -> Arithmetic:
    """The arithmetic that the device has fast instructions for."""
    if not can_pack(device):
        return "network"
    return "bfloat16" if has_fast_bfloat16(device) else "float32"


class Inference:
    """A network in use, on its own device. ``arithmetic``: ``network`` runs it as it is
    (``torch.autocast``), the others run its packed form; None: the fastest."""

    def __init__(self, network: OccupancyNetwork, arithmetic: Arithmetic | None = None) -> None:
        self.network = network.folded()
        self.device = next(network.parameters()).device
        self.arithmetic: Arithmetic = arithmetic or fastest(self.device)
        on_cpu = self.device.type == "cpu"
        self._rows = _CHUNK * torch.get_num_threads() if on_cpu else _CHUNK_GPU
        packed = self.arithmetic != "network"
        self._bf16 = not packed and has_fast_bfloat16(self.device)
        if packed:
            dtype = torch.bfloat16 if self.arithmetic == "bfloat16" else torch.float32
            self.network.decoder = PackedDecoder(self.network.decoder, dtype, self._rows)
            pack_layers(self.network.encoder)

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
            queries, terms = padded(queries), decoder.cast(terms)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._bf16):
            parts = latent.normalised(queries).split(self._rows, dim=1)
            logits = torch.cat([decoder(terms, part).float() for part in parts], 1)
        return logits[0, : len(points_mm)]


def padded(queries: Tensor) -> Tensor:
    """Queries (1, Q, 3) with the last one repeated up to a round number. oneDNN compiles and keeps
    a kernel for every number of rows; frames that each have another number of queries would fill
    memory (0.7 GB until its cache is full)."""
    n, m = queries.shape[1], _ROW_MULTIPLE
    full = -(-n // m) * m if n > m else 1 << max(n - 1, 0).bit_length()
    return torch.cat([queries, queries[:, -1:].expand(-1, full - n, -1)], 1) if n else queries


def _pack(weight: Tensor, rows: int, dtype: torch.dtype) -> Tensor:
    """Weights (out, in) laid out for ``rows`` of x at a time; any other number works too."""
    contiguous = weight.detach().to(dtype).contiguous()
    out: Tensor = torch.ops.mkldnn._reorder_linear_weight(contiguous, rows)
    return out


def _linear(x: Tensor, packed: Tensor, bias: Tensor, after: str = "none") -> Tensor:
    """Rows (n, in) -> (n, out); with ReLU fused if ``after`` is "relu"."""
    out: Tensor = torch.ops.mkldnn._linear_pointwise(x, packed, bias, after, (), "")
    return out


class PackedLayer(nn.Module):
    """A folded ``Layer`` for inference: (..., in) -> (..., out)."""

    def __init__(self, layer: Layer) -> None:
        super().__init__()
        weight, self._bias = layer.linear.weight, layer.linear.bias
        self._weight = _pack(weight, _ENCODER_ROWS, weight.dtype)

    def forward(self, x: Tensor) -> Tensor:
        return _linear(x.flatten(0, -2), self._weight, self._bias, "relu").view(*x.shape[:-1], -1)


def pack_layers(encoder: nn.Module) -> None:
    """Pack the layers of a folded encoder's MLPs, in place. In single precision: an error of the
    latent code moves every label, and the encoder takes a small part of a frame's time."""
    for module in encoder.modules():
        if isinstance(module, nn.Sequential):
            for n, layer in enumerate(module):
                if isinstance(layer, Layer):
                    module[n] = PackedLayer(layer)


class PackedDecoder(MlpDecoder):
    """A folded decoder of one cloud's queries, ``rows`` at a time, in ``dtype``. bf16 would round a
    coordinate to a tenth of a millimetre; the rounding errors are three more inputs, so that
    positions stay exact."""

    def __init__(self, decoder: MlpDecoder, dtype: torch.dtype, rows: int) -> None:
        nn.Module.__init__(self)
        self.config, self.query_size = decoder.config, decoder.query_size
        self.layers, self.output, self._dtype = decoder.layers, decoder.output, dtype
        # Per layer: weights of the hidden input, weights of the query, bias. Layers that see the
        # query take their bias from ``prepare``'s terms instead.
        self._packed: list[tuple[Tensor | None, Tensor | None, Tensor]] = []
        n_hidden = 0
        for layer in self.hidden_layers():
            weight, size = layer.linear.weight, self.query_size
            of_hidden = _pack(weight[:, :n_hidden], rows, dtype) if n_hidden else None
            of_query = None
            if weight.shape[1] > n_hidden:
                columns = weight[:, n_hidden : n_hidden + size]
                of_query = _pack(torch.cat([columns, columns[:, :3]], 1), rows, dtype)
            self._packed.append((of_hidden, of_query, layer.linear.bias.to(dtype)))
            n_hidden = len(weight)
        self._output = _pack(self.output.weight, rows, dtype), self.output.bias.to(dtype)

    def cast(self, terms: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """``prepare``'s terms as ``forward`` takes them."""
        return tuple(term[0, 0].to(self._dtype) for term in terms)

    def forward(self, terms: tuple[Tensor, ...], queries: Tensor) -> Tensor:
        """Terms and queries (1, Q, 3) -> logits (1, Q, classes), float32."""
        features = octave_features(queries[0], self.config.octaves)
        rounded = features.to(self._dtype)
        rounding_error = (features[:, :3] - rounded[:, :3]).to(self._dtype)
        query = hidden = torch.cat([rounded, rounding_error], 1)
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
