"""The decoder over oneDNN's own linear layers: weights cast and laid out once, ReLU on the way out.

No compiler is needed, and what oneDNN finds in the processor (AVX-512 with bf16, AMX, VNNI) is
used. On a Zen 5 core it comes to nine tenths of what a lone bf16 matrix product reaches;
AOTInductor, measured beside it, was no faster.
"""

from __future__ import annotations

import platform
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from tumortrack.models.layers import Layer
from tumortrack.occupancy.mlp_decoder import MlpDecoder, octave_features
from tumortrack.occupancy.network import Latent, OccupancyNetwork, normalised

_ENCODER_ROWS = 4096
_ROUND = 512  # rows


def can_pack(device: torch.device) -> bool:
    """Whether these layers exist for the device: oneDNN on an x86 processor."""
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    return device.type == "cpu" and x86 and torch.backends.mkldnn.is_available()


class PackedLinear:
    """y = x W^T, with what is added to it and ReLU in the same pass where they are asked for.

    ``rows`` of x at once is what the layout is chosen for; any other number works too.
    """

    def __init__(self, weight: Tensor, rows: int, dtype: torch.dtype) -> None:
        held = weight.detach().to(dtype).contiguous()
        self.packed = torch.ops.mkldnn._reorder_linear_weight(held, rows)

    def __call__(
        self, x: Tensor, bias: Tensor, after: str = "none", limits: tuple[float, ...] = ()
    ) -> Tensor:
        """Rows (n, in) and (out,) -> (n, out), after it "none", "relu" or "hardtanh" (with its
        two limits)."""
        out: Tensor = torch.ops.mkldnn._linear_pointwise(x, self.packed, bias, after, limits, "")
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


@dataclass(frozen=True, eq=False)
class Step:
    """A hidden layer's parts: ``of_hidden`` (out, hidden) and, where it sees the query,
    ``of_query`` (out, query); ``bias`` None where the latent's term has it."""

    of_hidden: Tensor | None
    of_query: Tensor | None
    bias: Tensor | None


def steps_of(decoder: MlpDecoder) -> list[Step]:
    """The hidden layers of a folded decoder, their latent's share left to ``prepare``."""
    steps, n_hidden = [], 0
    for layer in decoder.layers:
        linear = layer.linear
        assert isinstance(linear, nn.Linear)
        weight = linear.weight.detach()
        if weight.shape[1] == n_hidden:
            steps.append(Step(weight, None, linear.bias.detach()))
        else:
            query = weight[:, n_hidden : n_hidden + decoder.query_size]
            steps.append(Step(weight[:, :n_hidden] if n_hidden else None, query, None))
        n_hidden = decoder.config.width
    return steps


class PackedDecoder:
    """``OccupancyNetwork.query`` of a folded network, in ``dtype``.

    In bf16 a coordinate would be rounded to a tenth of a millimetre; so what the rounding took
    is given as three inputs more, and positions stay exact.

    Args:
        rows: queries at once; their activations should stay in the cache.
    """

    def __init__(self, network: OccupancyNetwork, dtype: torch.dtype, rows: int) -> None:
        self.network, self.dtype, self.rows = network, dtype, rows
        self.steps = steps_of(network.decoder)
        output = network.decoder.output
        self._output = PackedLinear(output.weight, rows, dtype)
        self._output_bias = output.bias.detach().to(dtype)
        self._hidden = [self._packed(step.of_hidden) for step in self.steps]
        self._query = [
            None
            if step.of_query is None
            else self._packed(torch.cat([step.of_query, step.of_query[:, :3]], 1))
            for step in self.steps
        ]
        self._biases = [None if s.bias is None else s.bias.to(dtype) for s in self.steps]

    def _packed(self, weight: Tensor | None) -> PackedLinear | None:
        return None if weight is None else PackedLinear(weight, self.rows, self.dtype)

    def __call__(self, latent: Latent, queries_mm: Tensor) -> Tensor:
        """One cloud's latent and queries (1, Q, 3), mm -> logits (1, Q, classes), float32."""
        terms, n = self.terms(latent), queries_mm.shape[1]
        parts = [
            self.logits(terms, self.features(latent, part))
            for part in filled_up(queries_mm).split(self.rows, dim=1)
        ]
        return torch.cat(parts)[None, :n]

    def terms(self, latent: Latent) -> list[Tensor]:
        """The latent's share of the layers that see it, (width,) each."""
        return [term[0, 0].to(self.dtype) for term in latent.terms]

    def features(self, latent: Latent, queries_mm: Tensor) -> Tensor:
        """Queries (1, Q, 3) -> what layers see of them, (Q, query size), float32."""
        queries = normalised(latent, queries_mm)[0]
        return octave_features(queries, self.network.decoder.config.octaves)

    def rounded(self, features: Tensor) -> Tensor:
        """Features in ``dtype``, (Q, query size + 3): positions with what rounding took of them."""
        rounded = features.to(self.dtype)
        return torch.cat([rounded, (features[:, :3] - rounded[:, :3]).to(self.dtype)], 1)

    def logits(
        self, terms: list[Tensor], features: Tensor, peaks: list[float] | None = None
    ) -> Tensor:
        """Logits (Q, classes), float32; ``peaks`` takes every hidden layer's greatest value."""
        remaining, rounded = list(terms), self.rounded(features)
        hidden: Tensor | None = None
        for number in range(len(self.steps)):
            hidden = self._layer(number, hidden, rounded, remaining)
            if peaks is not None:
                peaks.append(float(hidden.max()))
        assert hidden is not None
        return self._output(hidden, self._output_bias).float()

    def _layer(
        self, number: int, hidden: Tensor | None, rounded: Tensor, remaining: list[Tensor]
    ) -> Tensor:
        of_hidden, of_query = self._hidden[number], self._query[number]
        if of_query is None:
            assert of_hidden is not None
            assert hidden is not None
            bias = self._biases[number]
            assert bias is not None
            return of_hidden(hidden, bias, "relu")
        term = remaining.pop(0)
        if of_hidden is None:
            return of_query(rounded, term, "relu")
        assert hidden is not None
        return functional.relu(of_hidden.onto(hidden, self.seen(number, rounded, term)), True)

    def seen(self, number: int, rounded: Tensor, term: Tensor) -> Tensor:
        """What layer ``number`` makes of query and latent, (Q, width), before its ReLU."""
        of_query = self._query[number]
        assert of_query is not None
        return of_query(rounded, term)
