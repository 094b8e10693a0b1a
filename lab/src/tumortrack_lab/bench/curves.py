"""How time and memory grow with the work: queries, points, tumors, voxels, samples in a step."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch

from tumortrack.core.process import keep_freed_memory
from tumortrack.core.types import Anatomy
from tumortrack.imaging.raster import label_grid
from tumortrack.models.report import grid_over
from tumortrack.occupancy.inference import Inference
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.simulate.occupancy import OccupancyPool, contains
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator
from tumortrack_lab.bench.machine import forget_peak, peak_bytes
from tumortrack_lab.bench.occupancy import CountedQueries, OccupancyForms
from tumortrack_lab.bench.rows import Call, Point, interleaved
from tumortrack_lab.bench.subject import SEED, UP, BenchSubject
from tumortrack_lab.bench.training import training_state

_QUERIES = (1000, 10_000, 100_000, 1_000_000)
_POINTS = (250, 500, 1000, 2000, 4000, 8000)
_TUMORS = (1, 2, 4, 8)
_GRIDS = (64, 100, 160, 250, 400)
_BATCHES = (1, 4, 16, 64)
_MOST_PAPER = 16  # samples in a step of the paper's network: larger ones take seconds
_TUMOR_GRID = 200
_SMALL = 0.3  # of the phantom's first tumor
_BUDGET_S = 0.3
Calls = Iterator[tuple[str, int, Call]]  # what, its size, the work


def points_of(subject: BenchSubject, curve: str, preset: str) -> Iterator[Point]:
    """The points of one curve of one preset; of ``tumors`` all that there are."""
    for what, size, call in _CURVES[curve](subject, preset):
        before = forget_peak()
        (timing,) = interleaved(call, budget_s=_BUDGET_S, fewest=1)
        peak = peak_bytes() if before is not None else None
        working = None if peak is None or before is None else peak - before
        yield Point(
            curve=curve, what=what, size=size, seconds=timing.median_s, peak_bytes=peak,
            working_bytes=working,
        )  # fmt: skip


def _points(subject: BenchSubject, preset: str) -> Calls:
    """A cloud of so many points encoded."""
    cloud, rng = subject.scene.cloud.points_mm, np.random.default_rng(SEED)
    for size in _POINTS:
        seen = cloud[rng.integers(len(cloud), size=size)]
        yield preset, size, partial(subject.forms(preset).encode, seen)


def _tumors(subject: BenchSubject, _: str) -> Calls:
    """An organ with so many tumors: a training pair, a labelled volume, labels of queries by an
    untrained network of so many classes (which takes as long as a trained one)."""
    forms, config, recipe = subject.forms("quick"), SceneConfig(), SceneRecipe(SEED, "train", 0)
    assert isinstance(forms, OccupancyForms)
    for size in _TUMORS:
        anatomy = _with_tumors(subject.anatomy, size)
        pool = OccupancyPool(anatomy, config.occupancy, SEED)
        yield "training pair", size, partial(Simulator(anatomy, UP, config).pair, recipe, pool)
        grid = grid_over(anatomy.organ.vertices_mm, _TUMOR_GRID)
        yield f"clinic, {_TUMOR_GRID}^3 labels", size, partial(label_grid, anatomy, *grid)
        torch.manual_seed(SEED)
        network = OccupancyNetwork(subject.presets["quick"](anatomy).network)
        logits = CountedQueries(Inference(network.eval()), forms.points_mm)
        yield "quick, 40,000 queries", size, partial(logits.labels, forms.queries(40_000))


def _with_tumors(anatomy: Anatomy, count: int) -> Anatomy:
    """The organ with so many tumors: its first one, made smaller, at places inside."""
    organ, tumor = anatomy.organ, anatomy.tumors[0]
    lower, upper = organ.box_mm
    drawn = np.random.default_rng(SEED).uniform(lower, upper, (4000, 3)).astype(np.float32)
    inside = drawn[contains(organ, drawn)]
    small = (tumor.vertices_mm - tumor.box_mm.mean(0)) * _SMALL
    return Anatomy((organ, *(tumor.moved(small + place) for place in inside[:count])))


def _batches(subject: BenchSubject, preset: str) -> Calls:
    """One training step of so many samples."""
    keep_freed_memory()
    for size in _BATCHES:
        if preset != "paper" or size <= _MOST_PAPER:
            state, (batch,) = training_state(subject, preset, size, batches=1)
            yield preset, size, partial(state.step, batch)


_CURVES = {
    "queries": lambda s, preset: ((preset, n, s.forms(preset).labelling(n)) for n in _QUERIES),
    "points": _points,
    "tumors": _tumors,
    "grid": lambda s, preset: ((preset, n, s.forms(preset).filling(n)) for n in _GRIDS),
    "batch": _batches,
}
