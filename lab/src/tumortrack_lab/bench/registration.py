"""A registration model with a cloud: what we do, what the naive form does."""

from __future__ import annotations

import numpy as np

from tumortrack.core.types import SensorCloud
from tumortrack.registration.model import RegistrationModel
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench.counts import flow_flops, refine_flops
from tumortrack_lab.bench.naive.registration import NaiveRegistration
from tumortrack_lab.bench.rows import Work
from tumortrack_lab.bench.timing import Uncounted

NAIVE = "nearest vertices by a tree, SciPy, every start to its end, inside tests"
_NO_VOLUME = 8  # voxels along the longest side: whoever asks for a frame wants no volume
_FLOW_STEPS = 6


class RegistrationWorkload:
    """A registration model with a cloud: ours and the naive form."""

    def __init__(self, model: RegistrationModel, cloud: SensorCloud, queries: int) -> None:
        self.model, self.shape, self.cloud = model, model.shape, cloud
        self.tracker, self.plain = Tracker(model), NaiveRegistration(model)
        self.estimate = self.tracker.locate(cloud, _NO_VOLUME, 0)
        self.queries = self.places(queries)

    def places(self, count: int) -> np.ndarray:
        """Evenly in the organ's box, camera frame."""
        lower, upper = next(iter(self.estimate.meshes.values())).box_mm
        return np.random.default_rng(0).uniform(lower, upper, (count, 3))

    def back(self, places_mm: np.ndarray) -> np.ndarray:
        """Places in the camera frame -> the CT, by our motion."""
        motion = self.estimate.motion
        assert motion is not None
        back = motion.back(places_mm)
        assert back is not None
        return back

    def labels(self, places_mm: np.ndarray) -> np.ndarray:
        """Of places in the camera frame, at our motion."""
        return self.shape.labels_at(self.back(places_mm).astype(np.float32))[0]

    def ours(self) -> Uncounted:
        estimate = self.tracker.locate(self.cloud, _NO_VOLUME, 0)
        return Uncounted(estimate.report["timings"]["volume"])

    def naive(self) -> None:
        self.plain.labels(self.cloud.points_mm, self.queries)

    def work(self, report: dict, queries: int) -> Work:
        """Refinement of one start, field and flow of the queries, the surfaces moved. ``report``:
        of the estimate whose steps are counted."""
        motion, points = report["motion"], len(self.cloud.points_mm)
        vertices = sum(len(part.vertices_mm) for part in self.shape.anatomy_ct.parts)
        unknown = 6 + len(motion["coefficients"])
        flops = refine_flops(points, unknown, motion["steps"], _FLOW_STEPS)
        flops += flow_flops(queries + vertices, _FLOW_STEPS)
        moved = self.shape.body.modes.nbytes + 16 * queries + 24 * vertices
        return Work(flops=flops, bytes=float(moved))
