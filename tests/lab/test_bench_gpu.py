"""The bench: calls that take seconds, and what only a GPU is asked for."""

import shutil
from functools import partial

import pytest

from clock import Clock
from tumortrack.training.presets import PRESETS, quick
from tumortrack_lab.bench import curves, occupancy, rows, training
from tumortrack_lab.bench import subject as subjects
from tumortrack_lab.bench.report import goals_table
from tumortrack_lab.bench.rows import (
    DECODER,
    ENCODER,
    EVERY,
    FRAME,
    GENERATOR,
    STEP,
    TRACKING,
    TRAINING,
    VOLUME,
    BenchResult,
    BenchRow,
    interleaved,
    timing_of,
)
from tumortrack_lab.bench.subject import BenchSubject


def test_long_calls_have_three_turns_the_first_among_them(monkeypatch) -> None:
    monkeypatch.setattr(rows, "_LONG_S", 0.01)
    monkeypatch.setattr(rows, "_LONGER_S", 0.01)
    clock = Clock()
    monkeypatch.setattr(rows, "time", clock)
    seconds = iter([0.08, 0.02, 0.03, 0.5])  # the first is cold
    order = []

    def naive() -> None:
        order.append("naive")
        clock.sleep(next(seconds))

    def ours() -> None:
        order.append("ours")
        clock.sleep(0.002)

    ours_s, naive_s = interleaved(ours, naive, budget_s=0.01)
    assert order.count("naive") == naive_s.turns == ours_s.turns == 3
    assert order[:4] == ["ours", "ours", "naive", "ours"]
    assert naive_s.median_s == pytest.approx(0.03)  # of 0.08, 0.02 and 0.03
    assert naive_s.best_s == pytest.approx(0.02)
    assert ours_s.median_s == pytest.approx(0.002)


def test_goals_of_a_gpu_are_judged_where_there_is_one() -> None:
    step = BenchRow(
        name=TRAINING,
        what="paper",
        threads=2,
        item="step",
        per_call=64,
        ours=timing_of([0.004, 0.005, 0.006]),
        device="cuda",
    )
    bench = BenchResult(machine={"GPU": "a GPU"}, command="the command", rows=(step,))
    lines = [line for line in goals_table(bench).splitlines() if "H100" in line]
    (training,) = [line for line in lines if "training" in line]
    assert training.endswith("| 12,800/s on a GPU | yes |")
    assert sum("not measured in this run |  |" in line for line in lines) == len(lines) - 1 == 2


def test_rows_of_a_gpu_are_measured_on_any_device(quick_model, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(training, "LABELLING", ("quick",))
    for name, small in (("GRID", 24), ("SLAB", 99), ("QUERIES", 999)):
        monkeypatch.setattr(occupancy, name, small)
    presets = {"quick": lambda anatomy: quick(anatomy, "limited")}
    subject = BenchSubject(presets, tmp_path)
    shutil.copytree(quick_model, tmp_path / "quick")
    every = training.on_device(subject, "cpu", 0.5)
    found = {row.name: row for workload in every for row in workload.rows(1, 0.5)}
    assert set(found) == {FRAME, EVERY, VOLUME, TRAINING}
    assert all(row.device == "cpu" and row.what == "quick" for row in found.values())
    assert found[TRAINING].per_s > 0


@pytest.mark.slow
def test_every_workload_becomes_a_row(quick_model, clinic_model, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(subjects, "LABELLING", ("quick",))
    monkeypatch.setattr(subjects, "PRESETS", ("clinic", "quick"))
    small = {"GRID": 24, "SLAB": 99, "QUERIES": 999, "DECODED": (100, 200), "IN_ONE_PIECE": 100}
    for name, value in small.items():
        monkeypatch.setattr(occupancy, name, value)
    monkeypatch.setattr(training, "_SAMPLES", {"clinic": 2, "quick": 2})
    presets = {name: partial(PRESETS[name], rotations="limited") for name in ("clinic", "quick")}
    for name, folder in (("clinic", clinic_model), ("quick", quick_model)):
        shutil.copytree(folder, tmp_path / name)
    subject = BenchSubject(presets, tmp_path)
    rows = [
        row
        for source in (
            subjects.encoders,
            subjects.decoders,
            subjects.frames,
            subjects.tracking,
            subjects.volumes,
            training.elastic,
            training.steps,
        )
        for workload in source(subject, 0.01)
        for row in workload.rows(1, 0.01)
    ]
    found = [(row.name, row.what) for row in rows]
    both = [(name, what) for name in (TRACKING, VOLUME) for what in ("clinic", "quick")]
    assert found == [
        (ENCODER, "quick"),
        (ENCODER, "clinic"),
        (DECODER, "quick, 100 queries"),
        (DECODER, "quick, 200 queries"),
        (FRAME, "clinic"),
        (FRAME, "quick"),
        (EVERY, "quick"),
        *both,
        (GENERATOR, "elastic"),
        (GENERATOR, "clinic"),
        (STEP, "clinic"),
        (STEP, "quick"),
    ]
    by_name = dict(zip(found, rows, strict=True))
    one, two = (by_name[DECODER, f"quick, {count} queries"] for count in (100, 200))
    assert one.naive is not None
    assert two.naive == one.naive.times(2.0)  # timed once, scaled
    assert by_name[TRACKING, "quick"].naive == by_name[FRAME, "quick"].naive
    assert by_name[VOLUME, "clinic"].agreement > 0.95
    assert by_name[FRAME, "clinic"].agreement > 0.95
    uncounted = by_name[GENERATOR, "clinic"]  # sensor errors and occlusion have no such figure
    assert all(row.work for row in rows if row.name != TRACKING and row != uncounted)
    assert all(row.naive is not None for row in rows if row != by_name[ENCODER, "clinic"])
    for name in ("_QUERIES", "_POINTS", "_GRIDS", "_BATCHES"):
        monkeypatch.setattr(curves, name, (20, 40))
    for curve in ("queries", "points", "grid", "batch"):
        for preset in presets:
            points = list(curves.points_of(subject, curve, preset))
            assert [point.size for point in points] == [20, 40]
            assert all(point.seconds > 0 for point in points)
