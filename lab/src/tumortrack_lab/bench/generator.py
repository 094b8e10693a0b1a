"""Rows of the scene generator: a training pair of depth image and 2,000 labels."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from typing import TYPE_CHECKING

from tumortrack_lab.bench.counts import blend_flops, drag_flops, draw_flops, flow_flops
from tumortrack_lab.bench.row import BenchRow, Work
from tumortrack_lab.bench.turns import in_turns

if TYPE_CHECKING:
    from tumortrack.simulate.elastic.body import ElasticBody
    from tumortrack.simulate.scene import Simulator
    from tumortrack_lab.bench.subject import Subject

NAME = "generator"
LABELS = 2000
_PAIRS = 20  # in one call of ours
_NAIVE = "NumPy, a ray a pixel, inside tests on deformed surfaces"
_COVERED = 0.25  # of the image, by the organ


def rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """The paper's drags; 424 x 240."""
    from tumortrack.simulate.deform import DragConfig

    yield _row(subject, "drags", DragConfig(), threads, budget_s)


def elastic_rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """States of the organ's elastic body."""
    from tumortrack.simulate.deform import ElasticConfig

    yield _row(subject, "elastic", ElasticConfig(), threads, budget_s)


def _row(subject: Subject, what: str, deform: object, threads: int, budget_s: float) -> BenchRow:
    from tumortrack.simulate.occupancy import OccupancyConfig, OccupancyPool
    from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator
    from tumortrack_lab.bench.naive.scenes import plain_pair
    from tumortrack_lab.bench.subject import SEED, UP

    anatomy = subject.anatomy
    config = SceneConfig(occupancy=OccupancyConfig(per_side=283), deform=(deform,))  # type: ignore[arg-type]
    body = subject.body if what == "elastic" else None
    simulator = Simulator(anatomy, UP, config, body)
    pool, index = OccupancyPool(anatomy, config.occupancy, SEED), count()

    def ours() -> None:
        for _ in range(_PAIRS):
            simulator.pair(SceneRecipe(SEED, "train", next(index)), pool)

    def naive() -> None:
        stage = simulator.render(SceneRecipe(SEED, "train", next(index)))
        plain_pair(anatomy, stage, LABELS)

    ours_s, naive_s = in_turns(ours, naive, budget_s=budget_s)
    return BenchRow(
        name=NAME,
        what=what,
        threads=threads,
        item="pair",
        ours=ours_s.times(1 / _PAIRS),
        naive=naive_s,
        naive_is=_NAIVE,
        work=work_of(simulator, body),
        note="one thread whatever there is: workers are processes",
    )


def work_of(simulator: Simulator, body: ElasticBody | None) -> Work:
    """Of one pair: points and the organ's surface moved, the surface drawn; vertices, faces,
    image, points and cloud moved through memory once."""
    from tumortrack.simulate.deform import DragConfig

    config, organ = simulator.config, simulator.anatomy_ct.organ
    moved, pixels = len(organ.vertices_mm) + LABELS, config.width * config.height
    if body is None:
        drags = sum(times for _, _, times in DragConfig().steps)
        flops = drag_flops(moved, drags)
    else:
        values, modes = body.modes[..., 0].size, body.modes.shape[-1]
        flops = blend_flops(values, modes) + flow_flops(moved, steps=6)
    flops += draw_flops(len(organ.faces) // 2, round(_COVERED * pixels))
    moved_bytes = 2 * 12 * moved + 12 * len(organ.faces) + 4 * pixels + 12 * 1000
    if body is not None:
        moved_bytes += body.modes.nbytes
    return Work(flops=flops, bytes=float(moved_bytes))
