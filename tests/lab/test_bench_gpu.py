"""The bench: calls that take seconds, and what only a GPU is asked for."""

import shutil
from functools import partial

import pytest

from clock import Clock
from tumortrack.training.presets import PRESETS, quick
from tumortrack_lab.bench import occupancy, rows, training
from tumortrack_lab.bench import subject as subjects
from tumortrack_lab.bench.report import goals_table
from tumortrack_lab.bench.rows import (
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
    found = {workload.name: workload.row(1, 0.5) for workload in every}
    assert set(found) == {FRAME, VOLUME, TRAINING}
    assert all(row.device == "cpu" and row.what == "quick" for row in found.values())
    assert found[TRAINING].per_s > 0


@pytest.mark.slow
def test_every_workload_becomes_a_row(quick_model, clinic_model, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(subjects, "PRESETS", ("clinic", "quick"))
    small = {"GRID": 24, "SLAB": 99, "QUERIES": 999}
    for name, value in small.items():
        monkeypatch.setattr(occupancy, name, value)
    monkeypatch.setattr(training, "_SAMPLES", {"clinic": 2, "quick": 2})
    presets = {name: partial(PRESETS[name], rotations="limited") for name in ("clinic", "quick")}
    for name, folder in (("clinic", clinic_model), ("quick", quick_model)):
        shutil.copytree(folder, tmp_path / name)
    subject = BenchSubject(presets, tmp_path)
    rows = [
        workload.row(1, 0.01)
        for source in (
            subjects.frames,
            subjects.tracking,
            subjects.volumes,
            training.elastic,
            training.steps,
        )
        for workload in source(subject, 0.01)
    ]
    found = [(row.name, row.what) for row in rows]
    both = [(name, what) for name in (TRACKING, VOLUME) for what in ("clinic", "quick")]
    assert found == [
        (FRAME, "clinic"),
        (FRAME, "quick"),
        *both,
        (GENERATOR, "elastic"),
        (STEP, "clinic"),
        (STEP, "quick"),
    ]
    by_name = dict(zip(found, rows, strict=True))
    for name in (FRAME, VOLUME):
        assert by_name[name, "quick"].agreement > 0.95
        assert by_name[name, "quick"].ratio is not None
    assert all(row.ours.median_s > 0 for row in rows)
