"""The bench: calls that take seconds, and what only a GPU is asked for."""

import shutil
import time

from tumortrack.training.presets import quick
from tumortrack_lab.bench import networks, timing, training
from tumortrack_lab.bench.goals import goals_table
from tumortrack_lab.bench.rows import EVERY, FRAME, TRAINING, VOLUME, BenchResult, BenchRow
from tumortrack_lab.bench.subject import BenchSubject
from tumortrack_lab.bench.timing import interleaved, timing_of


def test_long_calls_have_three_turns_the_first_among_them(monkeypatch) -> None:
    monkeypatch.setattr(timing, "_LONG_S", 0.01)
    monkeypatch.setattr(timing, "_LONGER_S", 0.01)
    seconds = iter([0.08, 0.02, 0.03, 0.5])  # the first is cold
    order = []

    def naive() -> None:
        order.append("naive")
        time.sleep(next(seconds))

    def ours() -> None:
        order.append("ours")
        time.sleep(0.002)

    ours_s, naive_s = interleaved(ours, naive, budget_s=0.01)
    assert order.count("naive") == naive_s.turns == ours_s.turns == 3
    assert order[:4] == ["ours", "ours", "naive", "ours"]
    assert 0.03 <= naive_s.median_s < 0.08 <= naive_s.best_s + 0.07
    assert 0.002 <= ours_s.median_s < 0.02


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
    for name, small in (("GRID", 24), ("_SLAB", 99), ("QUERIES", 999)):
        monkeypatch.setattr(networks, name, small)
    presets = {"quick": lambda anatomy: quick(anatomy, "limited")}
    subject = BenchSubject(presets, tmp_path)
    shutil.copytree(quick_model, tmp_path / "quick")
    every = training.on_device(subject, "cpu", 0.5)
    found = {row.name: row for workload in every for row in workload.rows(1, 0.5)}
    assert set(found) == {FRAME, EVERY, VOLUME, TRAINING}
    assert all(row.device == "cpu" and row.what == "quick" for row in found.values())
    assert found[TRAINING].per_s > 0
