"""A warp with a cloud: what we do, what the naive form does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tumortrack_lab.bench.counts import flow_flops, refine_flops
from tumortrack_lab.bench.row import Work
from tumortrack_lab.bench.turns import Uncounted

if TYPE_CHECKING:
    from tumortrack.tracking.tracker import Tracker
    from tumortrack_lab.bench.naive.placed import NaivePlaced
    from tumortrack_lab.bench.subject import Subject

QUERIES = 40_000
NAIVE = "nearest vertices by a tree, SciPy, every start to its end, inside tests"
_NO_VOLUME = 8  # voxels along the longest side: whoever asks for a frame wants no volume
_FLOW_STEPS = 6


@dataclass(eq=False)
class Placing:
    """A warp with a cloud: ours and the naive form."""

    subject: Subject

    def __post_init__(self) -> None:
        from tumortrack.tracking.tracker import Tracker
        from tumortrack_lab.bench.naive.placed import NaivePlaced

        self.model = self.subject.clinic
        self.tracker: Tracker = Tracker(self.model)
        self.plain: NaivePlaced = NaivePlaced(self.model)
        self.cloud = self.subject.cloud("clinic")
        self.estimate = self.tracker.locate(self.cloud, _NO_VOLUME, 0)
        self.queries = self.places(QUERIES)

    def places(self, count: int) -> np.ndarray:
        """Evenly in the organ's box, before the camera."""
        lower, upper = next(iter(self.estimate.meshes.values())).box_mm
        return np.random.default_rng(0).uniform(lower, upper, (count, 3))

    def labels(self, places_mm: np.ndarray) -> np.ndarray:
        """Of places before the camera, at our motion."""
        motion, shape = self.estimate.motion, self.model.shape
        assert motion is not None
        back = motion.back(places_mm)
        assert back is not None
        return shape.labels_at(back.astype(np.float32))[0]

    def ours(self) -> Uncounted:
        estimate = self.tracker.locate(self.cloud, _NO_VOLUME, 0)
        return Uncounted(estimate.report["timings"]["volume"])

    def naive(self) -> None:
        self.plain.labels(self.cloud.points_mm, self.queries)

    def work(self, unknown: int, steps: int, queries: int) -> Work:
        """Refinement of one start, field and flow of the queries, the surfaces moved."""
        shape, points = self.model.shape, len(self.cloud.points_mm)
        vertices = sum(len(part.vertices_mm) for part in shape.anatomy_ct.parts)
        flops = refine_flops(points, unknown, steps, _FLOW_STEPS)
        flops += flow_flops(queries + vertices, _FLOW_STEPS)
        moved = shape.body.modes.nbytes + 16 * queries + 24 * vertices
        return Work(flops=flops, bytes=float(moved))
