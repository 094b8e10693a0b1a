"""Timing of the default method: a first look, frames that follow one another, the volume."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import cycle

import numpy as np

from tumortrack.core.estimate import FollowOptions
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.raster import label_grid
from tumortrack.models.report import grid_over
from tumortrack.registration.looks import Looks
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import rows
from tumortrack_lab.bench.rows import METHOD, Uncounted, Workload
from tumortrack_lab.bench.subject import BenchSubject

GRID = 400  # voxels along the volume's longest side
_NO_VOLUME = 8  # the same, where the volume is not of interest
_MOVES_MM = 0.5  # of the cloud, from frame to frame


class LiveFrames:
    """The live loop's frames, one a call: a cloud that moves to and fro."""

    def __init__(self, tracker: Tracker, points_mm: np.ndarray) -> None:
        swing = np.array([_MOVES_MM / 2, 0.0, 0.0], np.float32)
        self._tracker = tracker
        self._frames = cycle([SensorCloud(points_mm + swing), SensorCloud(points_mm - swing)])
        self.last = tracker.follow(next(self._frames), None, FollowOptions())

    def __call__(self) -> None:
        self.last = self._tracker.follow(next(self._frames), self.last, FollowOptions())


def frames(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """A first look: the search alone, with its refinement, and all that `locate` does."""
    registration, looks = subject.model.registration, Looks.of([subject.cloud.points_mm])
    search = partial(registration.search.starts, looks)
    yield Workload(rows.SEARCH, METHOD, "look", search)
    register = partial(registration.register, looks)
    yield Workload(rows.FIRST_LOOK, METHOD, "look", register)
    tracker = Tracker(subject.model)

    def locate() -> Uncounted:
        estimate = tracker.locate(subject.cloud, _NO_VOLUME, 0)
        return Uncounted(estimate.report.timings["volume"])

    note = "`locate` without its volume: labels, probabilities, surfaces, report"
    yield Workload(rows.FRAME, METHOD, "frame", locate, facts=lambda: {"note": note})


def tracking(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """From frame to frame."""
    follow = LiveFrames(Tracker(subject.model), subject.cloud.points_mm)

    def facts() -> dict:
        motion = follow.last.report.motion
        assert motion is not None
        return {
            "note": f"steady state: {motion.steps} refinement steps, points carried, surfaces, "
            "report"
        }

    yield Workload(rows.TRACKING, METHOD, "frame", follow, facts=facts)


def volumes(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """From an estimate's surfaces to a label in every voxel."""
    estimate = Tracker(subject.model).locate(subject.cloud, _NO_VOLUME, 0)
    anatomy = Anatomy(tuple(estimate.meshes.values()))
    grid = grid_over(anatomy.organ.vertices_mm, GRID)
    note = f"the moved surfaces filled: {int(np.prod(grid[1])):,} voxels"
    fill = partial(label_grid, anatomy, *grid)
    yield Workload(rows.VOLUME, METHOD, "volume", fill, facts=lambda: {"note": note})
