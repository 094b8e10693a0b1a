"""Workloads of an occupancy network with a cloud: what we do, and what the naive form does."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from itertools import cycle

import numpy as np
import torch

from tumortrack.core.estimate import FollowOptions
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import SensorCloud
from tumortrack.models.report import grid_over
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import rows
from tumortrack_lab.bench.naive import NaiveOccupancy
from tumortrack_lab.bench.rows import Call, InterleavedTiming, Workload
from tumortrack_occupancy.inference import Inference
from tumortrack_occupancy.locator import steps_over
from tumortrack_occupancy.model import OccupancyModel
from tumortrack_occupancy.sparse import organ_lattice, sparse_logits, sparse_margins

QUERIES = 40_000  # of a frame
IN_ONE_PIECE = 40_000  # queries of the naive form: of more the latent's copies fill the memory
GRID = 400  # voxels along the volume's longest side
SLAB = 16_384  # voxels of the volume that the naive form is asked for
_MOVES_MM = 0.5  # of the cloud, from frame to frame
Grid = tuple[np.ndarray, tuple[int, int, int]]  # camera_from_index, shape


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
        self.last = tracker.follow(next(self._frames), None, FollowOptions())

    def __call__(self) -> None:
        self.last = self._tracker.follow(next(self._frames), self.last, FollowOptions())


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
    """Of preset ``paper``. All forms bring their labels back to the host."""

    naive_is = "single precision, latent beside every query, Python loops, one piece"

    def __init__(self, model: OccupancyModel, points_mm: np.ndarray, device: str = "cpu") -> None:
        self.points_mm, self._model, self._device = points_mm, model, device
        self._inference = Inference(model.network)
        self._plain = NaiveOccupancy(model.network)
        self._cloud = torch.tensor(points_mm)[None].to(device)
        self._expected = cache(lambda count: self._naive_labels(self.queries(count)))
        self._naive_frame: Call | InterleavedTiming = partial(
            self._naive_labels, self.queries(QUERIES)
        )  # its seconds, once they are known

    def queries(self, count: int) -> np.ndarray:
        """Evenly in the box about the cloud where the organ can be; of more, these come first."""
        lower, upper = self.points_mm.min(0), self.points_mm.max(0)
        upper[2] += upper[2] - lower[2]  # its hidden half
        rng = np.random.default_rng(0)
        return rng.uniform(lower, upper, (count, 3)).astype(np.float32)

    def frames(self) -> Iterator[Workload]:
        """1,000 points to 40,000 labels, as `locate` does it, and with every query asked."""
        queries = self.queries(QUERIES)

        def facts(every: bool) -> dict:
            labels, places = self._logits().labels(queries), QUERIES
            if not every:
                labels, places = self._our_frame(queries)
            return {
                "agreement": self._agreement(labels),
                "others": {"asked": places},
                "note": "" if every else f"{places:,} places asked for {QUERIES:,} labels",
                "device": self._device,
            }

        def ask_all() -> np.ndarray:
            return self._logits().labels(queries)

        every = Workload(rows.EVERY, "paper", "frame", ask_all, facts=partial(facts, True))
        one = Workload(
            rows.FRAME, "paper", "frame",
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
            rows.TRACKING, "paper", "frame",
            ours=LiveFrames(Tracker(self._model), self.points_mm),
            naive=self._naive_frame,
            naive_is=f"{self.naive_is}; every frame from the start{beside}",
            facts=lambda: {"note": "steady state: labels, surfaces, report"},
        )  # fmt: skip

    def volumes(self) -> Iterator[Workload]:
        """From what is known of the cloud to a label in every voxel."""
        queries = self.queries(QUERIES)
        # About the points inside, as `locate` lays it.
        grid = grid_over(queries[self._logits().labels(queries) > 0], GRID)
        index, points = slab(grid)
        voxels, logits, labels = int(np.prod(grid[1])), self._logits(), np.zeros(0, np.uint8)

        def filled() -> None:
            nonlocal labels
            logits.places = 0
            labels = sparse_margins(logits, *grid)[1]

        def facts() -> dict:
            expected = self._naive_labels(points)
            return {
                "agreement": float((expected == labels[tuple(index.T)]).mean()),
                "others": {"voxels": voxels, "asked": logits.places},
                "note": f"{logits.places:,} of {voxels:,} voxels asked",
                "device": self._device,
            }

        spread = f"{len(points):,} voxels spread over the volume, scaled"
        yield Workload(
            rows.VOLUME, "paper", "volume",
            ours=filled,
            naive=partial(self._naive_labels, points),
            naive_is=f"dense; {self.naive_is}; {spread}",
            naive_share=voxels / len(points),
            facts=facts,
        )  # fmt: skip

    def _logits(self) -> CountedQueries:
        return CountedQueries(self._inference, self.points_mm)

    def _our_frame(self, queries: np.ndarray) -> tuple[np.ndarray, int]:
        """Labels as `locate` finds them, and how many places were asked for: logits on a lattice
        over the queries' box, linear between its points where that is plain, else asked."""
        logits = self._logits()
        box = np.stack([queries.min(0), queries.max(0)]).astype(float)
        lattice = organ_lattice(logits, box, steps_over(box))
        return sparse_logits(logits, lattice, queries).argmax(-1), logits.places

    @torch.inference_mode()
    def _naive_labels(self, queries: np.ndarray) -> np.ndarray:
        """In single precision, piece by piece."""
        encoded = self._plain.encode(self._cloud)
        pieces = torch.from_numpy(queries)[None].to(self._device).split(IN_ONE_PIECE, dim=1)
        labels = [self._plain.logits(encoded, piece)[0].argmax(-1) for piece in pieces]
        return torch.cat(labels).cpu().numpy()

    def _agreement(self, labels: np.ndarray) -> float:
        """Share of the labels of so many ``queries`` that are the naive form's."""
        return float((labels == self._expected(len(labels))).mean())
