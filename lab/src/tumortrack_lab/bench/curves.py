"""How time and memory grow with the work: queries, points, tumors, voxels, samples in a step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from tumortrack_lab.bench.asked import asked_of
from tumortrack_lab.bench.memory import forget_peak, peak_bytes
from tumortrack_lab.bench.placing import Placing
from tumortrack_lab.bench.row import Point
from tumortrack_lab.bench.subject import SEED, UP
from tumortrack_lab.bench.turns import Call, in_turns

if TYPE_CHECKING:
    from tumortrack.core.types import Anatomy
    from tumortrack_lab.bench.subject import Subject

_QUERIES = (1000, 10_000, 100_000, 1_000_000)
_POINTS = (250, 500, 1000, 2000, 4000, 8000)
_TUMORS = (1, 2, 4, 8)
_GRIDS = (64, 100, 160, 250, 400)
_BATCHES = (1, 4, 16, 64)
_MOST_PAPER = 16  # samples in a step of the paper's network: larger ones take seconds
_TUMOR_GRID = 200
_SMALL = 0.3  # of the phantom's first tumor
_BUDGET_S = 0.3


def points(subject: Subject, curve: str, preset: str) -> Iterator[Point]:
    """The points of one curve of one preset; of ``tumors`` all that there are."""
    return CURVES[curve](subject, preset)


def _measured(curve: str, what: str, size: int, call: Call) -> Point:
    before = forget_peak()
    (timing,) = in_turns(call, budget_s=_BUDGET_S, fewest=1)
    peak = peak_bytes() if before is not None else None
    return Point(
        curve=curve,
        what=what,
        size=size,
        seconds=timing.median_s,
        peak_bytes=peak,
        working_bytes=None if peak is None or before is None else peak - before,
    )


def _queries(subject: Subject, preset: str) -> Iterator[Point]:
    """Labels of queries, the cloud being encoded or the organ placed."""
    if preset == "clinic":
        placing = Placing(subject)
        for size in _QUERIES:
            yield _measured("queries", preset, size, partial(placing.labels, placing.places(size)))
        return
    asked = asked_of(subject, preset)
    logits = partial(asked.inference.logits, asked.inference.encode(asked.points_mm))
    for size in _QUERIES:
        yield _measured("queries", preset, size, partial(_labels, logits, asked.queries(size)))


def _labels(logits, queries: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    logits(queries).argmax(-1)


def _points(subject: Subject, preset: str) -> Iterator[Point]:
    """A cloud of so many points encoded."""
    cloud = subject.stage.cloud.points_mm
    rng = np.random.default_rng(SEED)
    for size in _POINTS:
        seen = cloud[rng.integers(len(cloud), size=size)]
        if preset == "clinic":
            call: Call = partial(subject.clinic.registration().propose, seen)
        else:
            call = partial(asked_of(subject, preset).inference.encode, seen)
        yield _measured("points", preset, size, call)


def _tumors(subject: Subject, _: str) -> Iterator[Point]:
    """An organ with so many tumors: a training pair, a labelled volume, labels of queries by an
    untrained network of so many classes (which takes as long as a trained one)."""
    import torch

    from tumortrack.imaging.raster import label_grid
    from tumortrack.models.report import grid_over
    from tumortrack.occupancy.inference import Inference
    from tumortrack.occupancy.network import OccupancyNetwork
    from tumortrack.simulate.occupancy import OccupancyPool
    from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator

    asked = asked_of(subject, "quick")
    for size in _TUMORS:
        anatomy, config = with_tumors(subject.anatomy, size), SceneConfig()
        pool = OccupancyPool(anatomy, config.occupancy, SEED)
        pair = partial(Simulator(anatomy, UP, config).pair, SceneRecipe(SEED, "train", 0), pool)
        yield _measured("tumors", "training pair", size, pair)
        grid = grid_over(anatomy.organ.vertices_mm, _TUMOR_GRID)
        name = f"clinic, {_TUMOR_GRID}^3 labels"
        yield _measured("tumors", name, size, partial(label_grid, anatomy, *grid))
        torch.manual_seed(SEED)
        network = OccupancyNetwork(subject.presets["quick"](anatomy).network)
        inference = Inference(network.eval())
        logits = partial(inference.logits, inference.encode(asked.points_mm))
        call = partial(_labels, logits, asked.queries(40_000))
        yield _measured("tumors", "quick, 40,000 queries", size, call)


def with_tumors(anatomy: Anatomy, count: int) -> Anatomy:
    """The organ with so many tumors: its first one, made smaller, at places inside."""
    from tumortrack.core.types import Anatomy
    from tumortrack.simulate.occupancy import contains

    organ, tumor = anatomy.organ, anatomy.tumors[0]
    lower, upper = organ.box_mm
    drawn = np.random.default_rng(SEED).uniform(lower, upper, (4000, 3)).astype(np.float32)
    inside = drawn[contains(organ, drawn)]
    small = (tumor.vertices_mm - tumor.box_mm.mean(0)) * _SMALL
    return Anatomy((organ, *(tumor.moved(small + place) for place in inside[:count])))


def _grids(subject: Subject, preset: str) -> Iterator[Point]:
    """The labelled volume."""
    from tumortrack.core.types import Anatomy
    from tumortrack.imaging.raster import label_grid
    from tumortrack.models.report import grid_over
    from tumortrack.occupancy.sparse import sparse_margins
    from tumortrack_lab.bench.volume import organ_grid

    if preset == "clinic":
        anatomy = Anatomy(tuple(Placing(subject).estimate.meshes.values()))
        for size in _GRIDS:
            filled = partial(label_grid, anatomy, *grid_over(anatomy.organ.vertices_mm, size))
            yield _measured("grid", preset, size, filled)
        return
    asked = asked_of(subject, preset)
    latent = asked.inference.encode(asked.points_mm)
    logits = partial(asked.inference.logits, latent)
    for size in _GRIDS:
        call = partial(sparse_margins, logits, *organ_grid(asked, latent, size))
        yield _measured("grid", preset, size, call)


def _batches(subject: Subject, preset: str) -> Iterator[Point]:
    """One training step of so many samples."""
    import torch

    from tumortrack.core.process import keep_freed_memory
    from tumortrack.training.state import TrainingState
    from tumortrack_lab.bench.training import material

    keep_freed_memory()
    for size in _BATCHES:
        if preset == "paper" and size > _MOST_PAPER:
            return
        run, batches, teach = material(subject, preset, size, batches=1)
        state = TrainingState(run, torch.device("cpu"))
        teach(state)
        yield _measured("batch", preset, size, partial(state.step, batches[0]))


CURVES: dict[str, Callable[[Subject, str], Iterator[Point]]] = {
    "queries": _queries,
    "points": _points,
    "tumors": _tumors,
    "grid": _grids,
    "batch": _batches,
}
