"""Labels by whole numbers of 8 bits, and again in single precision where these might be wrong.

Twice the speed of bf16, at an error of some tenths of a logit: alone that changes 0.1 % of labels,
all at queries whose two best classes are close. So how far it can be off is found out for each
call, on a share of its own queries, and every query closer than that is asked again. The labels
then agree with the reference better than those of bf16, which is not checked.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tumortrack.occupancy.network import Latent
from tumortrack.occupancy.packed import PackedDecoder, PackedLinear, filled_up

_PROBE = 512  # queries answered both ways, spread evenly over those asked
_FEWEST = 8 * _PROBE  # with fewer the probe costs more than is gained
_HEADROOM = 1.15  # activations may exceed the probe's greatest by so much
_MOST_AGAIN = 0.2  # of the probe to be asked again: with more, nothing would be gained
_LARGEST = 255  # activations are uint8: ReLU leaves nothing below zero


def can_quantize() -> bool:
    """Whether products of 8-bit numbers run in hardware, exactly: older processors add pairs of
    them in 16 bits, which saturate."""
    has = torch.cpu.get_capabilities()
    return bool(has.get("avx512_vnni") or has.get("avx_vnni") or has.get("amx_int8"))


class QuantizedLinear:
    """Whole-number products of activations (n, in), uint8, with weights rounded row by row."""

    def __init__(self, weight: Tensor, bias: Tensor | None, rows: int) -> None:
        self.scales = (weight.abs().amax(1) / 127).clamp_min(torch.finfo(torch.float32).tiny)
        whole = (weight / self.scales[:, None]).round().to(torch.int8)
        self.packed = torch.ops.onednn.qlinear_prepack(whole, [rows, weight.shape[1]])
        self.zeros = torch.zeros(len(weight), dtype=torch.int32)
        self.bias = bias

    def hidden(self, x: Tensor, scale: float, scale_out: float) -> Tensor:
        """The next activations in steps of ``scale_out``; ``x`` has steps of ``scale``."""
        out: Tensor = torch.ops.onednn.qlinear_pointwise(
            x, scale, 0, self.packed, self.scales, self.zeros, self.bias,
            scale_out, 0, torch.uint8, "relu", [], "",
        )  # fmt: skip
        return out

    def hidden_onto(self, x: Tensor, added: Tensor, scale: float, scale_out: float) -> Tensor:
        """As ``hidden``, with (n, out) added before the ReLU."""
        out: Tensor = torch.ops.onednn.qlinear_pointwise.binary(
            x, scale, 0, self.packed, self.scales, self.zeros, added, self.bias,
            scale_out, 0, torch.uint8, 1.0, 0, "add", 1.0, "relu", [], "",
        )  # fmt: skip
        return out

    def logits(self, x: Tensor, scale: float) -> Tensor:
        """(n, out), float32."""
        out: Tensor = torch.ops.onednn.qlinear_pointwise(
            x, scale, 0, self.packed, self.scales, self.zeros, self.bias,
            1.0, 0, torch.float32, "none", [], "",
        )  # fmt: skip
        return out


class QuantizedDecoder:
    """``OccupancyNetwork.query`` of a folded network.

    Positions, and what layers make of them, are not rounded to 8 bits.

    Args:
        packed: answers where 8 bits do not pay: few queries, or most of them close.
        exact: the same network in single precision, for queries asked again.
    """

    def __init__(self, packed: PackedDecoder, exact: PackedDecoder) -> None:
        self.packed, self.exact, rows = packed, exact, packed.rows
        self._hidden = [
            None if s.of_hidden is None else QuantizedLinear(s.of_hidden, s.bias, rows)
            for s in packed.steps
        ]
        first = packed.steps[0].of_query
        assert first is not None
        self._first = PackedLinear(first, rows, torch.float32)
        output = packed.network.decoder.output
        self._output = QuantizedLinear(output.weight.detach(), output.bias.detach(), rows)

    def __call__(self, latent: Latent, queries_mm: Tensor) -> Tensor:
        """One cloud's latent and queries (1, Q, 3), mm -> logits (1, Q, classes), float32."""
        asked = queries_mm.shape[1]
        if asked < _FEWEST:
            return self.packed(latent, queries_mm)
        queries_mm = filled_up(queries_mm)
        n = queries_mm.shape[1]
        probe, peaks = torch.arange(_PROBE) * n // _PROBE, list[float]()
        features = self.packed.features(latent, queries_mm[:, probe])
        right = self.exact.logits(self.exact.terms(latent), features, peaks)
        scales = [max(peak, 1e-6) * _HEADROOM / _LARGEST for peak in peaks]
        rough = self.logits(latent, features, scales)
        doubt = float(shift(right, rough).max())
        if float((gap(rough) <= doubt).float().mean()) > _MOST_AGAIN:
            return self.packed(latent, queries_mm)[:, :asked]
        logits = torch.cat([
            self.logits(latent, self.packed.features(latent, part), scales)
            for part in queries_mm.split(self.packed.rows, dim=1)
        ])  # fmt: skip
        again = (gap(logits) <= doubt).nonzero()[:, 0]
        if len(again):
            logits[again] = self.exact(latent, queries_mm[:, again])[0]
        logits[probe] = right
        return logits[None, :asked]

    def logits(self, latent: Latent, features: Tensor, scales: list[float]) -> Tensor:
        """Logits (Q, classes), float32, activations in steps of ``scales``, one a hidden layer."""
        terms = self.packed.terms(latent)[1:]
        rounded = self.packed.rounded(features)
        hidden = self._begun(latent.terms[0][0, 0].float(), features, scales[0])
        for number, (layer, step) in enumerate(zip(self._hidden, self.packed.steps, strict=True)):
            if layer is None:
                continue
            before, scale = scales[number - 1], scales[number]
            if step.of_query is None:
                hidden = layer.hidden(hidden, before, scale)
            else:
                added = self.packed.seen(number, rounded, terms.pop(0))
                hidden = layer.hidden_onto(hidden, added, before, scale)
        return self._output.logits(hidden, scales[-1])

    def _begun(self, term: Tensor, features: Tensor, scale: float) -> Tensor:
        """The first activations. They are rounded as int8, 128 below their value, and raised
        again bit by bit: torch is several times slower at rounding to uint8."""
        steps = self._first(features / scale, term / scale - 128, "hardtanh", (-128.0, 127.0))
        return steps.round_().to(torch.int8).view(torch.uint8).bitwise_xor_(128)


def gap(logits: Tensor) -> Tensor:
    """How far the best class is ahead of the next, (n, classes) -> (n,)."""
    best = logits.topk(2, dim=1).values
    return best[:, 0] - best[:, 1]


def shift(right: Tensor, rough: Tensor) -> Tensor:
    """By how much the lead of the truly best class over the next is wrong, (n, classes) -> (n,)."""
    first_two = right.topk(2, dim=1)
    lead = rough.gather(1, first_two.indices)
    return (lead[:, 0] - lead[:, 1] - first_two.values[:, 0] + first_two.values[:, 1]).abs()
