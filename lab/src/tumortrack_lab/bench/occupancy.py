"""An occupancy network with a cloud and queries: what we do, what the naive form does."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch

from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.occupancy.inference import Inference
from tumortrack.occupancy.locator import steps_over
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.sparse import organ_lattice, sparse_logits
from tumortrack_lab.bench.counts import ball_flops, farthest_flops, module_flops, weight_bytes
from tumortrack_lab.bench.naive.occupancy import NaiveOccupancy
from tumortrack_lab.bench.rows import Precision, Work
from tumortrack_lab.bench.timing import Call, InterleavedTiming

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

    def __post_init__(self) -> None:
        self.network = self.model.network.to(self.device)
        self.inference = Inference(self.network, self.model.arithmetic)
        self.plain = NaiveOccupancy(self.network)
        self.cloud = torch.tensor(self.points_mm)[None].to(self.device)

    def queries(self, count: int) -> np.ndarray:
        """Evenly in the box about the cloud where the organ can be."""
        lower, upper = self.points_mm.min(0), self.points_mm.max(0)
        upper[2] += upper[2] - lower[2]  # its hidden half
        rng = np.random.default_rng(0)
        return rng.uniform(lower, upper, (count, 3)).astype(np.float32)

    def on_device(self, queries: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(queries)[None].to(self.device)

    @torch.inference_mode()
    def naive_labels(self, queries: np.ndarray) -> np.ndarray:
        """In single precision, piece by piece."""
        encoded = self.plain.encode(self.cloud)
        pieces = self.on_device(queries).split(IN_ONE_PIECE, dim=1)
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

    def decoder_work(self, queries: int, voxels: int = 0) -> Work:
        """The latent's share once a frame; queries in, logits out; a label to every voxel."""
        folded = self.network.folded()
        latent, some = folded.encode(self.cloud), self.on_device(self.queries(100))
        flops = module_flops(lambda: folded.query(latent, some)) * queries / 100
        moved = weight_bytes(folded.decoder, _BYTES[self.decoder_precision]) + voxels
        moved += queries * (12 + 4 * (len(self.model.parts) + 1))
        return Work(flops=flops, bytes=moved, precision=self.decoder_precision)

    def frame_work(self, queries: int) -> Work:
        encode, decode = self.encoder_work(), self.decoder_work(queries)
        return Work(
            flops=encode.flops + decode.flops,
            bytes=encode.bytes + decode.bytes,
            precision=decode.precision,
        )

    @torch.inference_mode()
    def naive_decoder_work(self, queries: int) -> Work:
        encoded, some = self.plain.encode(self.cloud), self.on_device(self.queries(100))
        flops = module_flops(lambda: self.plain.logits(encoded, some)) * queries / 100
        return Work(flops=flops, bytes=weight_bytes(self.network.decoder, 4))

    def naive_encoding(self) -> Call:
        return torch.inference_mode()(lambda: self.plain.encode(self.cloud))

    def naive_decoding(self, queries: np.ndarray) -> Call:
        """The cloud being encoded."""
        tensor = self.on_device(queries)
        with torch.inference_mode():
            encoded = self.plain.encode(self.cloud)
        return torch.inference_mode()(lambda: self.plain.logits(encoded, tensor).argmax(-1))

    def naive_frame(self, queries: np.ndarray) -> Call:
        tensor = self.on_device(queries)

        @torch.inference_mode()
        def once() -> None:
            self.plain.logits(self.plain.encode(self.cloud), tensor).argmax(-1).cpu()

        return once

    def our_frame(self, queries: np.ndarray) -> tuple[np.ndarray, int]:
        """Labels as `locate` finds them, and how many places were asked for: logits on a lattice
        over the queries' box, linear between its points where that is plain, else asked."""
        logits = self.counted()
        box = np.stack([queries.min(0), queries.max(0)]).astype(float)
        lattice = organ_lattice(logits, box, steps_over(box))
        return sparse_logits(logits, lattice, queries).argmax(-1), logits.places

    def counted(self) -> CountedQueries:
        return CountedQueries(self.inference, self.inference.encode(self.points_mm))

    def every_query(self, queries: np.ndarray) -> np.ndarray:
        """Labels by asking at every place."""
        labels: np.ndarray = self.counted()(queries).argmax(-1).cpu().numpy()
        return labels


class CountedQueries:
    """Logits at places (n, 3), mm; ``places``: how many were asked for."""

    def __init__(self, inference: Inference, latent: object) -> None:
        self._inference, self._latent, self.places = inference, latent, 0

    def __call__(self, points_mm: np.ndarray) -> torch.Tensor:
        self.places += len(points_mm)
        return self._inference.logits(self._latent, points_mm)  # type: ignore[arg-type]
