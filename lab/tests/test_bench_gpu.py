"""The bench: calls that take seconds, and what only a GPU is asked for."""

import shutil

import pytest

from clock import Clock
from tumortrack_lab.bench import occupancy, rows, training
from tumortrack_lab.bench import subject as subjects
from tumortrack_lab.bench.report import goals_of
from tumortrack_lab.bench.rows import (
    EVERY,
    FIRST_LOOK,
    FRAME,
    SEARCH,
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
    goals = [goal for goal in goals_of(bench) if "H100" in goal["figure"]]
    (training,) = [goal for goal in goals if "training" in goal["figure"]]
    assert (training["measured here"], training["met"]) == ("12,800/s on a GPU", "yes")
    others = [goal["measured here"] for goal in goals if goal is not training]
    assert others == ["not measured in this run"] * 2


@pytest.fixture
def subject(quick_model, tmp_path, monkeypatch) -> BenchSubject:
    """In small, with a small network in place of the paper's."""
    for name, small in (("GRID", 24), ("SLAB", 99), ("QUERIES", 999), ("IN_ONE_PIECE", 500)):
        monkeypatch.setattr(occupancy, name, small)
    shutil.copytree(quick_model, tmp_path / "paper")
    return BenchSubject(tmp_path)


def test_rows_of_a_gpu_are_measured_on_any_device(subject) -> None:
    every = training.on_device(subject, "cpu", 0.5, "quick")
    found = {row.name: row for workload in every for row in workload.rows(1, 0.5)}
    assert set(found) == {FRAME, EVERY, VOLUME, TRAINING}
    assert all(row.device == "cpu" for row in found.values())
    assert found[TRAINING].per_s > 0


@pytest.mark.slow
def test_every_workload_becomes_a_row(subject, clinic_model, tmp_path) -> None:
    shutil.copytree(clinic_model, tmp_path / "clinic")
    rows = [
        row
        for source in (subjects.frames, subjects.tracking, subjects.volumes)
        for workload in source(subject, 0.01)
        for row in workload.rows(1, 0.01)
    ]
    found = [(row.name, row.what) for row in rows]
    both = [(name, what) for name in (TRACKING, VOLUME) for what in ("clinic", "paper")]
    looks = [(name, "clinic") for name in (SEARCH, FIRST_LOOK, FRAME)]
    assert found == [*looks, (FRAME, "paper"), (EVERY, "paper"), *both]
    by_name = dict(zip(found, rows, strict=True))
    times = [by_name[name, "clinic"].ours.best_s for name in (SEARCH, FIRST_LOOK, FRAME)]
    assert times[0] < times[1]
    assert by_name[TRACKING, "paper"].naive == by_name[FRAME, "paper"].naive
    assert by_name[VOLUME, "clinic"].agreement > 0.95
    assert by_name[FRAME, "clinic"].agreement > 0.95
