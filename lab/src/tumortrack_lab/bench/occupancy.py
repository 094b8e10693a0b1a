"""Workloads of an occupancy network with a cloud: what we do, what the naive form does, and what it
has to cost.

Arithmetic is counted by torch for modules, by formulas elsewhere. A multiplication and an addition
are 2. Comparisons, square roots and exponentials are 1 each: formulas are meant to be right within
some tens of per cent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import cycle

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from tumortrack.core.estimate import Following
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import SensorCloud
from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.models.report import grid_over
from tumortrack.occupancy.inference import Inference
from tumortrack.occupancy.locator import steps_over
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import Latent
from tumortrack.occupancy.sparse import organ_lattice, sparse_logits, sparse_margins
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import rows
from tumortrack_lab.bench.naive import NaiveOccupancy
from tumortrack_lab.bench.rows import Call, InterleavedTiming, Precision, Work, Workload

QUERIES = 40_000  # of a frame
DECODED = (1000, 10_000, 40_000, 400_000)  # queries
IN_ONE_PIECE = 40_000  # queries of the naive form: of more the latent's copies fill the memory
GRID = 400  # voxels along the volume's longest side
SLAB = 16_384  # voxels of the volume that the naive form is asked for
_MOVES_MM = 0.5  # of the cloud, from frame to frame
_SQUARE = 8  # of a squared distance in space
Grid = tuple[np.ndarray, tuple[int, int, int]]  # camera_from_index, shape


def module_flops(call: Callable[[], object]) -> float:
    """Of the matrix products and convolutions in a call, by ``torch.utils.flop_counter``."""
    with FlopCounterMode(display=False) as counter:
        call()
    return float(counter.get_total_flops())


def weight_bytes(module: torch.nn.Module, precision: Precision = "fp32") -> float:
    """Of all weights, moved once."""
    numbers = sum(weight.numel() for weight in module.parameters())
    return float({"fp32": 4, "bf16": 2, "int8": 1}[precision] * numbers)


def slab(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Indices and places (n, 3) of random voxels."""
    camera_from_index, shape = grid
    index = np.random.default_rng(0).integers(0, shape, (SLAB, 3))
    return index, transform_points(camera_from_index, index.astype(float)).astype(np.float32)


class LiveFrames:
    """The live loop's frames, one a call: a cloud that moves to and fro."""

    def __init__(self, tracker: Tracker, points_mm: np.ndarray) -> None:
        swing = np.array([_MOVES_MM / 2, 0.0, 0.0], np.float32)
        self._tracker = tracker
        self._frames = cycle([SensorCloud(points_mm + swing), SensorCloud(points_mm - swing)])
        self.last = tracker.follow(next(self._frames), None, Following())

    def __call__(self) -> None:
        self.last = self._tracker.follow(next(self._frames), self.last, Following())


class CountedQueries:
    """Logits at places (n, 3), mm; ``places``: how many were asked for."""

    def __init__(self, inference: Inference, points_mm: np.ndarray) -> None:
        self._inference, self._latent, self.places = inference, inference.encode(points_mm), 0

    def __call__(self, points_mm: np.ndarray) -> torch.Tensor:
        self.places += len(points_mm)
        return self._inference.logits(self._latent, points_mm)

    def labels(self, points_mm: np.ndarray) -> np.ndarray:
        """By asking at every place."""
        labels: np.ndarray = self(points_mm).argmax(-1).cpu().numpy()
        return labels


class OccupancyForms:
    """``preset``: what the rows are of. All forms bring their labels back to the host."""

    naive_is = "single precision, latent beside every query, Python loops, one piece"

    def __init__(
        self, preset: str, model: OccupancyModel, points_mm: np.ndarray, device: str = "cpu"
    ) -> None:
        self.preset, self.points_mm, self._model, self._device = preset, points_mm, model, device
        self._inference = Inference(model.network)
        self.encode = self._inference.encode
        self._plain = NaiveOccupancy(model.network)
        self._cloud = torch.tensor(points_mm)[None].to(device)
        self._expected = cache(lambda count: self._naive_labels(self.queries(count)))
        self._naive_frame: Call | InterleavedTiming = partial(
            self._naive_labels, self.queries(QUERIES)
        )  # its seconds, once they are known
        fast = has_fast_bfloat16(torch.device(device))
        self._precision: Precision = "bf16" if fast else "fp32"

    def queries(self, count: int) -> np.ndarray:
        """Evenly in the box about the cloud where the organ can be; of more, these come first."""
        lower, upper = self.points_mm.min(0), self.points_mm.max(0)
        upper[2] += upper[2] - lower[2]  # its hidden half
        rng = np.random.default_rng(0)
        return rng.uniform(lower, upper, (count, 3)).astype(np.float32)

    def labelling(self, count: int) -> Call:
        """Labels of queries, the cloud being encoded."""
        return partial(self._logits().labels, self.queries(count))

    def filling(self, size: int) -> Call:
        """A label in every voxel."""
        return partial(sparse_margins, self._logits(), *self._grid(size))

    def encoders(self) -> Iterator[Workload]:
        """The cloud to what is known of it."""
        yield Workload(
            rows.ENCODER, self.preset, "cloud",
            ours=partial(self.encode, self.points_mm),
            naive=self._naive_encoding,
            naive_is="single precision, Python loop of farthest points, neighbours by sorting",
            facts=lambda: {"work": self._encoder_work()},
        )  # fmt: skip

    def decoders(self) -> Iterator[Workload]:
        """Labels of 1,000 to 400,000 queries, the cloud being encoded."""
        encoded = self._naive_encoding()
        whole: object = None  # seconds of the naive form, in the largest piece
        for count in DECODED:
            first = self.queries(min(count, IN_ONE_PIECE))
            scaled = count / len(first)
            known = whole if scaled != 1 and isinstance(whole, InterleavedTiming) else None
            one = Workload(
                rows.DECODER, f"{self.preset}, {count:,} queries", "decoding",
                ours=self.labelling(count),
                naive=known or partial(self._naive_labels, first, encoded),
                naive_is=self.naive_is,
                naive_share=scaled,
                facts=partial(self._decoder_facts, count, first),
            )  # fmt: skip
            yield one
            whole = one.naive

    def _decoder_facts(self, count: int, first: np.ndarray) -> dict:
        return {
            "work": self._decoder_work(count),
            "agreement": self._agreement(self._logits().labels(first)),
            "note": "" if count == len(first) else f"naive: that of {IN_ONE_PIECE:,}, scaled",
        }

    def frames(self) -> Iterator[Workload]:
        """1,000 points to 40,000 labels, as `locate` does it, and with every query asked."""
        queries = self.queries(QUERIES)

        def facts(every: bool) -> dict:
            labels, places = self._logits().labels(queries), QUERIES
            if not every:
                labels, places = self._our_frame(queries)
            one, two = self._encoder_work(), self._decoder_work(places)
            flops, moved = one.flops + two.flops, one.bytes + two.bytes
            return {
                "work": Work(flops=flops, bytes=moved, precision=two.precision),
                "agreement": self._agreement(labels),
                "others": {"asked": places},
                "note": "" if every else f"{places:,} places asked for {QUERIES:,} labels",
                "device": self._device,
            }

        def ask_all() -> np.ndarray:
            return self._logits().labels(queries)

        every = Workload(rows.EVERY, self.preset, "frame", ask_all, facts=partial(facts, True))
        one = Workload(
            rows.FRAME, self.preset, "frame",
            ours=partial(self._our_frame, queries),
            naive=partial(self._naive_labels, queries),
            naive_is=self.naive_is,
            facts=partial(facts, False),
            beside=(every,),
        )  # fmt: skip
        yield one
        assert one.naive is not None
        self._naive_frame = one.naive

    def tracking(self) -> Iterator[Workload]:
        """From frame to frame."""
        known = isinstance(self._naive_frame, InterleavedTiming)
        beside = ", timed beside the row `frame`" if known else ""
        yield Workload(
            rows.TRACKING, self.preset, "frame",
            ours=LiveFrames(Tracker(self._model), self.points_mm),
            naive=self._naive_frame,
            naive_is=f"{self.naive_is}; every frame from the start{beside}",
            facts=lambda: {"note": "steady state: labels, surfaces, report"},
        )  # fmt: skip

    def volumes(self) -> Iterator[Workload]:
        """From what is known of the cloud to a label in every voxel."""
        grid = self._grid(GRID)
        index, points = slab(grid)
        voxels, logits, labels = int(np.prod(grid[1])), self._logits(), np.zeros(0, np.uint8)

        def filled() -> None:
            nonlocal labels
            logits.places = 0
            labels = sparse_margins(logits, *grid)[1]

        def facts() -> dict:
            expected = self._naive_labels(points)
            return {
                "work": self._decoder_work(logits.places, voxels),
                "agreement": float((expected == labels[tuple(index.T)]).mean()),
                "others": {"voxels": voxels, "asked": logits.places},
                "note": f"{logits.places:,} of {voxels:,} voxels asked",
                "device": self._device,
            }

        spread = f"{len(points):,} voxels spread over the volume, scaled"
        yield Workload(
            rows.VOLUME, self.preset, "volume",
            ours=filled,
            naive=partial(self._naive_labels, points),
            naive_is=f"dense; {self.naive_is}; {spread}",
            naive_share=voxels / len(points),
            facts=facts,
        )  # fmt: skip

    def _logits(self) -> CountedQueries:
        return CountedQueries(self._inference, self.points_mm)

    def _grid(self, size: int) -> Grid:
        """Voxels over the organ, as `locate` lays them: about the points that are inside."""
        queries = self.queries(QUERIES)
        return grid_over(queries[self._logits().labels(queries) > 0], size)

    def _our_frame(self, queries: np.ndarray) -> tuple[np.ndarray, int]:
        """Labels as `locate` finds them, and how many places were asked for: logits on a lattice
        over the queries' box, linear between its points where that is plain, else asked."""
        logits = self._logits()
        box = np.stack([queries.min(0), queries.max(0)]).astype(float)
        lattice = organ_lattice(logits, box, steps_over(box))
        return sparse_logits(logits, lattice, queries).argmax(-1), logits.places

    @torch.inference_mode()
    def _naive_encoding(self) -> Latent:
        return self._plain.encode(self._cloud)

    @torch.inference_mode()
    def _naive_labels(self, queries: np.ndarray, encoded: Latent | None = None) -> np.ndarray:
        """In single precision, piece by piece."""
        encoded = encoded or self._naive_encoding()
        pieces = torch.from_numpy(queries)[None].to(self._device).split(IN_ONE_PIECE, dim=1)
        labels = [self._plain.logits(encoded, piece)[0].argmax(-1) for piece in pieces]
        return torch.cat(labels).cpu().numpy()

    def _agreement(self, labels: np.ndarray) -> float:
        """Share of the labels of so many ``queries`` that are the naive form's."""
        return float((labels == self._expected(len(labels))).mean())

    def _encoder_work(self) -> Work:
        folded, n = self._model.network.folded(), len(self.points_mm)
        flops = module_flops(lambda: folded.encode(self._cloud))
        for level in folded.config.encoder.levels:  # type: ignore[union-attr]
            centres = round(level.ratio * n)
            # Each choice of the farthest compares all points with the newest; then the neighbours
            # of the centres, every point tried.
            flops += n * centres * ((_SQUARE + 2) + (_SQUARE + 1))
            n = centres
        moved = weight_bytes(folded.encoder, self._precision) + self.points_mm.nbytes
        return Work(flops=flops, bytes=moved, precision=self._precision)

    def _decoder_work(self, queries: int, voxels: int = 0) -> Work:
        """The latent's share once a frame; queries in, logits out; a label to every voxel."""
        kinds: dict[str, Precision] = {"float32": "fp32", "bfloat16": "bf16"}
        precision = kinds.get(self._inference.numbers, self._precision)
        folded = self._model.network.folded()
        some = torch.from_numpy(self.queries(100))[None].to(self._device)
        latent = folded.encode(self._cloud)
        flops = module_flops(lambda: folded.query(latent, some)) * queries / 100
        moved = weight_bytes(folded.decoder, precision) + voxels
        moved += queries * (12 + 4 * (len(self._model.parts) + 1))
        return Work(flops=flops, bytes=moved, precision=precision)
