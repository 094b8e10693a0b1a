"""An occupancy network with a cloud and queries: what we do, what the naive form does."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tumortrack_lab.bench.counts import (
    ball_flops,
    farthest_flops,
    module_flops,
    weight_bytes,
)
from tumortrack_lab.bench.row import Precision, Work
from tumortrack_lab.bench.turns import Call, InterleavedTiming

if TYPE_CHECKING:
    import torch

    from tumortrack.occupancy.inference import Inference
    from tumortrack.occupancy.model import OccupancyModel
    from tumortrack.occupancy.network import OccupancyNetwork
    from tumortrack_lab.bench.naive.occupancy import NaiveOccupancy
    from tumortrack_lab.bench.subject import Subject

LABELLING = ("quick", "paper")  # the presets that label points
IN_ONE_PIECE = 40_000  # queries of the naive form: of more the latent's copies fill the memory
_PRECISIONS: dict[str, Precision] = {"float32": "fp32", "bfloat16": "bf16", "int8": "int8"}
_BYTES: dict[Precision, int] = {"fp32": 4, "bf16": 2, "int8": 1}
NAIVE = "single precision, latent beside every query, Python loops, one piece"


@dataclass(eq=False)
class OccupancyWorkload:
    """An occupancy network with a cloud and queries about it: ours and the naive form.

    ``naive_frame_s``: of the naive form's frame, once that was measured."""

    model: OccupancyModel
    points_mm: np.ndarray
    device: str = "cpu"
    naive_frame_s: InterleavedTiming | None = None
    _labelled: dict[int, np.ndarray] = field(default_factory=dict)

    @cached_property
    def network(self) -> OccupancyNetwork:
        return self.model.network.to(self.device)

    @cached_property
    def inference(self) -> Inference:
        from tumortrack.occupancy.inference import Inference

        return Inference(self.network, self.model.arithmetic)

    @cached_property
    def plain(self) -> NaiveOccupancy:
        from tumortrack_lab.bench.naive.occupancy import NaiveOccupancy

        return NaiveOccupancy(self.network)

    @cached_property
    def cloud(self) -> torch.Tensor:
        import torch

        return torch.tensor(self.points_mm)[None].to(self.device)

    def queries(self, count: int) -> np.ndarray:
        """Evenly in the box about the cloud where the organ can be."""
        lower, upper = self.points_mm.min(0), self.points_mm.max(0)
        upper[2] += upper[2] - lower[2]  # its hidden half
        rng = np.random.default_rng(0)
        return rng.uniform(lower, upper, (count, 3)).astype(np.float32)

    def naive_labels(self, queries: np.ndarray) -> np.ndarray:
        """In single precision, piece by piece."""
        import torch

        asked = torch.from_numpy(queries)[None].to(self.device)
        with torch.inference_mode():
            encoded = self.plain.encode(self.cloud)
            pieces = asked.split(IN_ONE_PIECE, dim=1)
            labels = [self.plain.logits(encoded, piece)[0].argmax(-1) for piece in pieces]
        return torch.cat(labels).cpu().numpy()

    def agreement(self, labels: np.ndarray) -> float:
        """Share of the labels of so many ``queries`` that are the naive form's."""
        count = len(labels)
        if count not in self._labelled:
            self._labelled[count] = self.naive_labels(self.queries(count))
        return float((labels == self._labelled[count]).mean())

    @cached_property
    def precision(self) -> Precision:
        """Of the encoder."""
        import torch

        from tumortrack.models.hardware import has_fast_bfloat16

        return "bf16" if has_fast_bfloat16(torch.device(self.device)) else "fp32"

    @property
    def decoder_precision(self) -> Precision:
        """Of the products that answer queries."""
        return _PRECISIONS.get(self.inference.arithmetic.numbers, self.precision)

    def encoder_work(self) -> Work:
        folded = self.network.folded()
        flops = module_flops(lambda: folded.encode(self.cloud))
        n = len(self.points_mm)
        for level in folded.config.encoder.levels:  # type: ignore[union-attr]
            centres = round(level.ratio * n)
            flops += farthest_flops(n, centres) + ball_flops(n, centres)
            n = centres
        moved = weight_bytes(folded.encoder, _BYTES[self.precision]) + self.points_mm.nbytes
        return Work(flops=flops, bytes=moved, precision=self.precision)

    def decoder_work(self, queries: int) -> Work:
        """The latent's share once a frame; queries in, logits out."""
        import torch

        folded = self.network.folded()
        latent = folded.encode(self.cloud)
        some = torch.from_numpy(self.queries(100))[None].to(self.device)
        flops = module_flops(lambda: folded.query(latent, some)) * queries / 100
        classes = len(self.model.parts) + 1
        moved = weight_bytes(folded.decoder, _BYTES[self.decoder_precision]) + queries * (
            12 + 4 * classes
        )
        return Work(flops=flops, bytes=moved, precision=self.decoder_precision)

    def naive_decoder_work(self, queries: int) -> Work:
        import torch

        with torch.inference_mode():
            encoded = self.plain.encode(self.cloud)
            some = torch.from_numpy(self.queries(100))[None].to(self.device)
            flops = module_flops(lambda: self.plain.logits(encoded, some)) * queries / 100
        return Work(flops=flops, bytes=weight_bytes(self.network.decoder, 4))

    def naive_frame(self, queries: np.ndarray) -> Call:
        import torch

        asked = torch.from_numpy(queries)[None].to(self.device)

        @torch.inference_mode()
        def once() -> None:
            encoded = self.plain.encode(self.cloud)
            self.plain.logits(encoded, asked).argmax(-1).cpu()

        return once

    def our_frame(self, queries: np.ndarray) -> tuple[np.ndarray, int]:
        """Labels as `locate` finds them, and how many places were asked for: logits on a lattice
        over the queries' box, linear between its points where that is plain, else asked."""
        from tumortrack.occupancy.locator import steps_over
        from tumortrack.occupancy.sparse import organ_lattice, sparse_logits

        latent, asked = self.inference.encode(self.points_mm), 0

        def logits_at(points_mm: np.ndarray) -> torch.Tensor:
            nonlocal asked
            asked += len(points_mm)
            return self.inference.logits(latent, points_mm)

        box = np.stack([queries.min(0), queries.max(0)]).astype(float)
        lattice = organ_lattice(logits_at, box, steps_over(box))
        return sparse_logits(logits_at, lattice, queries).argmax(-1), asked

    def every_query(self, queries: np.ndarray) -> np.ndarray:
        """Labels by asking at every place."""
        latent = self.inference.encode(self.points_mm)
        labels: np.ndarray = self.inference.logits(latent, queries).argmax(-1).cpu().numpy()
        return labels


def asked_of(subject: Subject, preset: str) -> OccupancyWorkload:
    """Of a preset: one for all groups of rows, whose naive form then labels its queries once."""
    from tumortrack.occupancy.model import OccupancyModel

    if preset not in subject.asked:
        model = subject.model(preset)
        assert isinstance(model, OccupancyModel)
        subject.asked[preset] = OccupancyWorkload(model, subject.cloud(preset).points_mm)
    return subject.asked[preset]
