"""Workloads of an occupancy network with a cloud: what we do, and what the naive form does."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from itertools import cycle

import numpy as np
import torch

from tumortrack.core.estimate import Following
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import SensorCloud
from tumortrack.models.report import grid_over
from tumortrack.occupancy.inference import Inference
from tumortrack.occupancy.locator import steps_over
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.sparse import organ_lattice, sparse_logits, sparse_margins
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import rows
from tumortrack_lab.bench.naive import NaiveOccupancy
from tumortrack_lab.bench.rows import Workload

QUERIES = 40_000  # of a frame
GRID = 400  # voxels along the volume's longest side
SLAB = 16_384  # voxels of the volume that the naive form is asked for
_MOVES_MM = 0.5  # of the cloud, from frame to frame


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


class OccupancyForms:
    """``preset``: what the rows are of. All forms bring their labels back to the host."""

    naive_is = "single precision, latent beside every query, Python loops, one piece"

    def __init__(
        self, preset: str, model: OccupancyModel, points_mm: np.ndarray, device: str = "cpu"
    ) -> None:
        self.preset, self.points_mm, self._model, self._device = preset, points_mm, model, device
        self._inference = Inference(model.network, model.arithmetic)
        self._plain = NaiveOccupancy(model.network)
        self._cloud = torch.tensor(points_mm)[None].to(device)
        # Evenly in the box about the cloud where the organ can be, its hidden half included.
        lower, upper = points_mm.min(0), points_mm.max(0)
        upper[2] += upper[2] - lower[2]
        queries = np.random.default_rng(0).uniform(lower, upper, (QUERIES, 3))
        self._queries = queries.astype(np.float32)
        self._expected = cache(self._naive_frame)

    def frames(self) -> Iterator[Workload]:
        """1,000 points to 40,000 labels, as `locate` does it."""

        def facts() -> dict:
            labels, places = self._our_frame()
            return {
                "agreement": float((labels == self._expected()).mean()),
                "others": {"asked": places},
                "note": f"{places:,} places asked for {QUERIES:,} labels",
                "device": self._device,
            }

        yield Workload(
            rows.FRAME, self.preset, "frame", self._our_frame, self._naive_frame, self.naive_is,
            facts=facts,
        )  # fmt: skip

    def tracking(self) -> Iterator[Workload]:
        """From frame to frame."""
        note = {"note": "steady state: labels, surfaces, report"}
        ours = LiveFrames(Tracker(self._model), self.points_mm)
        yield Workload(rows.TRACKING, self.preset, "frame", ours, facts=lambda: note)

    def volumes(self) -> Iterator[Workload]:
        """From what is known of the cloud to a label in every voxel."""
        logits = CountedQueries(self._inference, self.points_mm)
        inside = self._queries[logits(self._queries).argmax(-1).cpu().numpy() > 0]
        camera_from_index, shape = grid_over(inside, GRID)  # as `locate` lays it
        index = np.random.default_rng(0).integers(0, shape, (SLAB, 3))
        points = transform_points(camera_from_index, index.astype(float)).astype(np.float32)
        voxels, labels = int(np.prod(shape)), np.zeros(0, np.uint8)

        def filled() -> None:
            nonlocal labels
            logits.places = 0
            labels = sparse_margins(logits, camera_from_index, shape)[1]

        def facts() -> dict:
            equal = self._naive_labels(points) == labels[tuple(index.T)]
            return {
                "agreement": float(equal.mean()),
                "others": {"voxels": voxels, "asked": logits.places},
                "note": f"{logits.places:,} of {voxels:,} voxels asked",
                "device": self._device,
            }

        spread = f"{len(points):,} voxels spread over the volume, scaled"
        yield Workload(
            rows.VOLUME, self.preset, "volume", filled, partial(self._naive_labels, points),
            f"dense; {self.naive_is}; {spread}", naive_share=voxels / len(points), facts=facts,
        )  # fmt: skip

    def _our_frame(self) -> tuple[np.ndarray, int]:
        """Labels as `locate` finds them, and how many places were asked for: logits on a lattice
        over the queries' box, linear between its points where that is plain, else asked."""
        logits, queries = CountedQueries(self._inference, self.points_mm), self._queries
        box = np.stack([queries.min(0), queries.max(0)]).astype(float)
        lattice = organ_lattice(logits, box, steps_over(box))
        return sparse_logits(logits, lattice, queries).argmax(-1), logits.places

    def _naive_frame(self) -> np.ndarray:
        return self._naive_labels(self._queries)

    @torch.inference_mode()
    def _naive_labels(self, queries: np.ndarray) -> np.ndarray:
        places = torch.from_numpy(queries)[None].to(self._device)
        labels = self._plain.logits(self._plain.encode(self._cloud), places)[0].argmax(-1)
        return labels.cpu().numpy()
