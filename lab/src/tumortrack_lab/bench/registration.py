"""Workloads of a registration model with a cloud."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from tumortrack.core.mesh_query import labels_of
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.raster import label_grid
from tumortrack.models.report import grid_over
from tumortrack.registration.looks import Looks
from tumortrack.registration.model import RegistrationModel
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import occupancy, rows
from tumortrack_lab.bench.naive import flowed
from tumortrack_lab.bench.rows import Uncounted, Workload

_NO_VOLUME = 8  # voxels along the longest side: whoever asks for a frame wants no volume


class RegistrationForms:
    """Of preset ``clinic``; the workloads are those of ``OccupancyForms``."""

    def __init__(self, model: RegistrationModel, cloud: SensorCloud) -> None:
        self._cloud, self._shape = cloud, model.shape
        self._registration, self._tracker = model.registration, Tracker(model)
        self._estimate = self._tracker.locate(cloud, _NO_VOLUME, 0)
        self._anatomy = Anatomy(tuple(self._estimate.meshes.values()))  # where it was found

    def frames(self) -> Iterator[Workload]:
        """A first look: the search alone, with its refinement, and all that `locate` does."""
        cloud, looks = self._estimate.cloud, Looks.of([self._cloud.points_mm])
        search = partial(self._registration.search.starts, looks)
        yield Workload(rows.SEARCH, "clinic", "look", search)
        register = partial(self._registration.register, looks)
        yield Workload(rows.FIRST_LOOK, "clinic", "look", register)

        def ours() -> Uncounted:
            estimate = self._tracker.locate(self._cloud, _NO_VOLUME, 0)
            return Uncounted(estimate.report.timings["volume"])

        def facts() -> dict:
            # Of the points inside, at our motion, where inside tests say the same.
            assert self._estimate.motion is not None
            back = self._estimate.motion.back(cloud.points_mm.astype(float))
            assert back is not None
            return {
                "agreement": float((self._labels(back) == cloud.labels).mean()),
                "note": "`locate` without its volume: labels, probabilities, surfaces, report; "
                "agreement: points inside, at our motion, against inside tests",
            }

        yield Workload(rows.FRAME, "clinic", "frame", ours, facts=facts)

    def tracking(self) -> Iterator[Workload]:
        ours = occupancy.LiveFrames(self._tracker, self._cloud.points_mm)

        def facts() -> dict:
            motion = ours.last.report.motion
            assert motion is not None
            steps = motion.steps
            note = f"steady state: {steps} refinement steps, points carried, surfaces, report"
            return {"note": note}

        yield Workload(rows.TRACKING, "clinic", "frame", ours, facts=facts)

    def volumes(self) -> Iterator[Workload]:
        grid = grid_over(self._anatomy.organ.vertices_mm, occupancy.GRID)
        index, points = occupancy.slab(grid)
        voxels = int(np.prod(grid[1]))
        motion = self._estimate.report.motion
        assert motion is not None
        camera_from_ct, state = np.array(motion.camera_from_ct), np.array(motion.coefficients)

        def naive() -> np.ndarray:
            rest = (points - camera_from_ct[:3, 3]) @ camera_from_ct[:3, :3]
            return self._labels(flowed(self._shape.body, -state, rest))

        def facts() -> dict:
            labels = label_grid(self._anatomy, *grid)[tuple(index.T)]
            return {
                "agreement": float((naive() == labels).mean()),
                "others": {"voxels": voxels},
                "note": "the moved surfaces filled",
            }

        yield Workload(
            rows.VOLUME, "clinic", "volume",
            ours=partial(label_grid, self._anatomy, *grid),
            naive=naive,
            naive_is=f"every voxel carried back, inside tests; {len(points):,} voxels, scaled",
            naive_share=voxels / len(points),
            facts=facts,
        )  # fmt: skip

    def _labels(self, places_ct: np.ndarray) -> np.ndarray:
        """Inside tests on the surfaces of the CT."""
        return labels_of(self._shape.anatomy_ct, places_ct.astype(np.float32))
