"""The bench: calls that take seconds, and what only a GPU is asked for."""

import shutil

import pytest

from clock import Clock
from tumortrack.training.presets import quick
from tumortrack_lab.bench import frames, gpu, turns, volume
from tumortrack_lab.bench.goals import goals_table
from tumortrack_lab.bench.row import BenchResult, BenchRow
from tumortrack_lab.bench.subject import Subject
from tumortrack_lab.bench.training import WHOLE
from tumortrack_lab.bench.turns import in_turns, timing_of


def test_long_calls_have_three_turns_the_first_among_them(monkeypatch) -> None:
    monkeypatch.setattr(turns, "_LONG_S", 0.01)
    monkeypatch.setattr(turns, "_LONGER_S", 0.01)
    clock = Clock()
    monkeypatch.setattr(turns, "time", clock)
    seconds = iter([0.08, 0.02, 0.03, 0.5])  # the first is cold
    order = []

    def naive() -> None:
        order.append("naive")
        clock.sleep(next(seconds))

    def ours() -> None:
        order.append("ours")
        clock.sleep(0.002)

    ours_s, naive_s = in_turns(ours, naive, budget_s=0.01)
    assert order.count("naive") == naive_s.turns == ours_s.turns == 3
    assert order[:4] == ["ours", "ours", "naive", "ours"]
    assert naive_s.median_s == pytest.approx(0.03)  # of 0.08, 0.02 and 0.03
    assert naive_s.best_s == pytest.approx(0.02)
    assert ours_s.median_s == pytest.approx(0.002)


def test_goals_of_a_gpu_are_judged_where_there_is_one() -> None:
    step = BenchRow(
        name=WHOLE,
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
    monkeypatch.setattr(gpu, "LABELLING", ("quick",))
    for module, name, small in (
        (volume, "GRID", 24),
        (volume, "_SLAB", 99),
        (frames, "QUERIES", 999),
    ):
        monkeypatch.setattr(module, name, small)
    subject = Subject({"quick": lambda anatomy: quick(anatomy, "limited")}, tmp_path)
    shutil.copytree(quick_model, tmp_path / "quick")
    found = {row.name: row for row in gpu.rows_on(subject, "cpu", 1, 0.5)}
    assert set(found) == {frames.FRAME, frames.EVERY, volume.NAME, WHOLE}
    assert all(row.device == "cpu" and row.what == "quick" for row in found.values())
    assert found[WHOLE].per_s > 0
