"""The decoder over oneDNN's own linear layers: weights cast and laid out once, ReLU on the way out.

No compiler is needed, and what oneDNN finds in the processor (AVX-512 with bf16, AMX, VNNI) is
used. On a Zen 5 core it comes to nine tenths of what a lone bf16 matrix product reaches;
AOTInductor, measured beside it, was no faster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from tumortrack.models.layers import Layer
from tumortrack.occupancy.mlp_decoder import octave_features
from tumortrack.occupancy.network import Latent, OccupancyNetwork, normalised

_ENCODER_ROWS = 4096
_ROUND = 512  # rows


class PackedLinear:
    """y = x W^T, with what is added to it and ReLU in the same pass where they are asked for.

    ``rows`` of x at once is what the layout is chosen for; any other number works too.
    """

    def __init__(self, weight: Tensor, rows: int, dtype: torch.dtype) -> None:
        held = weight.detach().to(dtype).contiguous()
        self.packed = torch.ops.mkldnn._reorder_linear_weight(held, rows)

    def __call__(self, x: Tensor, bias: Tensor, after: str = "none") -> Tensor:
        """Rows (n, in) and (out,) -> (n, out), after it "none" or "relu"."""
        out: Tensor = torch.ops.mkldnn._linear_pointwise(x, self.packed, bias, after, (), "")
        return out

    def onto(self, x: Tensor, added: Tensor) -> Tensor:
        """Rows (n, in) and (n, out) -> their product with W, and the sum."""
        out: Tensor = torch.ops.mkldnn._linear_pointwise.binary(x, added, self.packed, None, "add")
        return out


def filled_up(queries: Tensor) -> Tensor:
    """Queries (1, Q, 3) with the last one repeated until their number is a round one.

    oneDNN compiles and keeps a kernel for every number of rows that it meets: frames that each
    ask another number of questions would fill memory (0.7 GB until its cache is full).
    """
    n = queries.shape[1]
    full = -(-n // _ROUND) * _ROUND if n > _ROUND else 1 << max(n - 1, 0).bit_length()
    return torch.cat([queries, queries[:, -1:].expand(-1, full - n, -1)], 1) if n else queries


class PackedLayer(nn.Module):
    """A folded ``Layer`` in one pass, for inference."""

    def __init__(self, layer: Layer) -> None:
        super().__init__()
        weight = layer.linear.weight
        self.linear = PackedLinear(weight, _ENCODER_ROWS, weight.dtype)
        self.bias = layer.linear.bias.detach()

    def forward(self, x: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        rows = self.linear(x.flatten(0, -2), self.bias, "relu")
        return rows.view(*x.shape[:-1], -1)


def pack_stacks(encoder: nn.Module) -> None:
    """Replace the layers in a folded encoder's stacks, in place. In single precision: a latent
    that is off moves every label, and an encoder is a small part of a frame."""
    for module in encoder.modules():
        if isinstance(module, nn.Sequential):
            for n, layer in enumerate(module):
                if isinstance(layer, Layer):
                    module[n] = PackedLayer(layer)


# What the layer before gave (Q, width), queries with what rounding took, terms of the latent
_HiddenLayer = Callable[[Tensor, Tensor, Iterator[Tensor]], Tensor]


def _hidden_layer(
    linear: nn.Linear, n_hidden: int, query_size: int, rows: int, dtype: torch.dtype
) -> _HiddenLayer:
    """One hidden layer of a folded decoder; its latent's share comes as a term instead."""
    weight = linear.weight.detach()
    if weight.shape[1] == n_hidden:
        plain, bias = PackedLinear(weight, rows, dtype), linear.bias.detach().to(dtype)
        return lambda hidden, query, terms: plain(hidden, bias, "relu")
    columns = weight[:, n_hidden : n_hidden + query_size]
    of_query = PackedLinear(torch.cat([columns, columns[:, :3]], 1), rows, dtype)
    if not n_hidden:
        return lambda hidden, query, terms: of_query(query, next(terms), "relu")
    of_hidden = PackedLinear(weight[:, :n_hidden], rows, dtype)

    def skip(hidden: Tensor, query: Tensor, terms: Iterator[Tensor]) -> Tensor:
        return functional.relu(of_hidden.onto(hidden, of_query(query, next(terms))), True)

    return skip


class PackedDecoder:
    """``OccupancyNetwork.query`` of a folded network, in ``dtype``.

    In bf16 a coordinate would be rounded to a tenth of a millimetre; so what the rounding took
    is given as three inputs more, and positions stay exact.

    Args:
        rows: queries at once; their activations should stay in the cache.
    """

    def __init__(self, network: OccupancyNetwork, dtype: torch.dtype, rows: int) -> None:
        decoder, output = network.decoder, network.decoder.output
        self._octaves, self._dtype, self._rows = decoder.config.octaves, dtype, rows
        hidden = [0] + [decoder.config.width] * (len(decoder.layers) - 1)
        self._layers = [
            _hidden_layer(layer.linear, n, decoder.query_size, rows, dtype)
            for n, layer in zip(hidden, decoder.layers, strict=True)
            if isinstance(layer, Layer)
        ]
        self._output = PackedLinear(output.weight, rows, dtype)
        self._output_bias = output.bias.detach().to(dtype)

    def __call__(self, latent: Latent, queries_mm: Tensor) -> Tensor:
        """One cloud's latent and queries (1, Q, 3), mm -> logits (1, Q, classes), float32."""
        terms = [term[0, 0].to(self._dtype) for term in latent.terms]
        queries, n = normalised(latent, filled_up(queries_mm))[0], queries_mm.shape[1]
        parts = [self._logits(iter(terms), part) for part in queries.split(self._rows)]
        return torch.cat(parts)[None, :n]

    def _logits(self, terms: Iterator[Tensor], queries: Tensor) -> Tensor:
        """Normalised queries (Q, 3) -> logits (Q, classes), float32."""
        features = octave_features(queries, self._octaves)
        rounded = features.to(self._dtype)
        lost = (features[:, :3] - rounded[:, :3]).to(self._dtype)
        query = hidden = torch.cat([rounded, lost], 1)
        for layer in self._layers:
            hidden = layer(hidden, query, terms)
        return self._output(hidden, self._output_bias).float()
