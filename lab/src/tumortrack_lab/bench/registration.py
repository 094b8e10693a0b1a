"""Workloads of a registration model with a cloud."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.raster import label_grid
from tumortrack.models.report import grid_over
from tumortrack.registration.model import RegistrationModel
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import occupancy, rows
from tumortrack_lab.bench.rows import Workload

_NO_VOLUME = 8  # voxels along the longest side: whoever asks for a frame wants no volume


class RegistrationForms:
    """Of preset ``clinic``; the workloads are those of ``OccupancyForms``, without naive forms."""

    def __init__(self, model: RegistrationModel, cloud: SensorCloud) -> None:
        self._cloud, self._tracker = cloud, Tracker(model)

    def frames(self) -> Iterator[Workload]:
        ours = partial(self._tracker.locate, self._cloud, _NO_VOLUME, 0)
        note = {"note": "`locate` with hardly a volume: labels, probabilities, surfaces, report"}
        yield Workload(rows.FRAME, "clinic", "frame", ours, facts=lambda: note)

    def tracking(self) -> Iterator[Workload]:
        ours = occupancy.LiveFrames(self._tracker, self._cloud.points_mm)

        def facts() -> dict:
            steps = ours.last.report["motion"]["steps"]
            return {
                "note": f"steady state: {steps} refinement steps, points carried, surfaces, report"
            }

        yield Workload(rows.TRACKING, "clinic", "frame", ours, facts=facts)

    def volumes(self) -> Iterator[Workload]:
        """The moved surfaces filled."""
        estimate = self._tracker.locate(self._cloud, _NO_VOLUME, 0)
        anatomy = Anatomy(tuple(estimate.meshes.values()))
        grid = grid_over(anatomy.organ.vertices_mm, occupancy.GRID)
        note = {"note": "the moved surfaces filled"}
        ours = partial(label_grid, anatomy, *grid)
        yield Workload(rows.VOLUME, "clinic", "volume", ours, facts=lambda: note)
