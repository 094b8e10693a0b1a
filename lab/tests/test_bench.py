"""The bench: figures that follow from their definitions, processes, documents."""

import json
import shutil
import sys
from collections.abc import Iterator

import pytest

from clock import Clock
from stories import tumortrack
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack_lab.bench import registration, rows
from tumortrack_lab.bench import run as running
from tumortrack_lab.bench.report import GOALS, goals_of, write_bench
from tumortrack_lab.bench.rows import (
    FIRST_LOOK,
    FRAME,
    SEARCH,
    TRACKING,
    VOLUME,
    BenchResult,
    BenchRow,
    Timing,
    Uncounted,
    Workload,
    timed,
    timing_of,
)
from tumortrack_lab.bench.run import GROUPS, Task, carry_out, tasks_of
from tumortrack_lab.bench.subject import BenchSubject
from tumortrack_lab.cli.bench import Bench
from tumortrack_lab.study.document import MeasuredTable


def timing(median_s: float) -> Timing:
    return timing_of([0.9 * median_s, median_s, 1.2 * median_s])


def test_short_calls_fill_the_budget_and_what_is_not_counted_is_left_out(monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr(rows, "time", clock)

    def call() -> Uncounted:
        clock.sleep(0.015)
        return Uncounted(0.01)

    taken = timed(call, budget_s=0.2)
    assert taken.median_s == pytest.approx(0.005)  # a hundredth is not counted
    assert 10 <= taken.turns <= 13
    assert taken.best_s <= taken.low_s <= taken.median_s <= taken.high_s


def test_long_calls_have_three_turns_the_first_among_them(monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr(rows, "time", clock)
    seconds = iter([8.0, 2.0, 3.0, 50.0])  # the first is cold
    taken = timed(lambda: clock.sleep(next(seconds)), budget_s=0.01)
    assert taken.turns == 3
    assert taken.median_s == pytest.approx(3.0)
    assert taken.best_s == pytest.approx(2.0)


def some_bench() -> BenchResult:
    row = BenchRow(name="frame", what="clinic", threads=2, item="frame", timing=timing(0.012))
    follow = BenchRow(
        name="tracking frame", what="clinic", threads=2, item="frame", timing=timing(0.006)
    )
    machine = {"processor": "a processor", "date": "2026-01-02"}
    return BenchResult(machine=machine, command="the command", rows=(row, follow))


def test_goals_are_judged_by_what_was_measured() -> None:
    goals = {goal["figure"]: goal for goal in goals_of(some_bench())}
    assert len(goals) == len(GOALS)
    frame = goals["frame, 2 CPU cores (the paper: 14 ms on an RTX 4090)"]
    assert (frame["measured here"], frame["met"]) == ("12.0 ms", "yes")
    tracking = goals["tracking frame, 2 CPU cores"]
    assert (tracking["measured here"], tracking["met"]) == ("6.00 ms", "no")
    open_ones = [goal["measured here"] for goal in goals.values() if not goal["met"]]
    assert open_ones == ["not measured in this run"] * (len(GOALS) - 2)


def test_a_document_is_filled_and_the_rest_of_it_stays(tmp_path) -> None:
    document = tmp_path / "docs" / "performance.md"
    document.parent.mkdir()
    blocks = "<!-- results:speed -->\nold\n<!-- /results:speed -->"
    document.write_text(f"before\n{blocks}\nafter")
    data = document.parent / "data"
    written = write_bench(some_bench(), tmp_path / "bench.json", document)
    text = document.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after")
    assert "old" not in text
    assert "| frame | clinic | 12.0 ms a frame |" in text
    rows = MeasuredTable.read(data / "speed-rows.csv")
    values = dict(zip(rows.header, rows.rows[0], strict=True))
    assert (values["ms"], values["items a second"]) == ("12.0", "83.3")
    tables = [data / f"speed{name}.csv" for name in ("", "-rows", "-goals", "-machine")]
    assert written == [tmp_path / "bench.json", document, *tables]


@pytest.mark.slow
def test_every_workload_becomes_a_row(clinic_model, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(registration, "GRID", 24)
    shutil.copytree(clinic_model, tmp_path / "clinic")
    subject = BenchSubject(tmp_path)
    assert subject.has_model
    measured = [
        workload.row(1, 0.01)
        for source in (registration.frames, registration.tracking, registration.volumes)
        for workload in source(subject, 0.01)
    ]
    assert [row.name for row in measured] == [SEARCH, FIRST_LOOK, FRAME, TRACKING, VOLUME]
    search, first_look, *_ = measured
    assert search.timing.best_s < first_look.timing.best_s


def test_a_process_measures_a_part(tmp_path, monkeypatch) -> None:
    def workloads(subject: BenchSubject, budget_s: float) -> Iterator[Workload]:
        yield Workload("part", "", "sum", lambda: sum(range(99)), lambda: {"note": "a sum"})

    monkeypatch.setattr(running, "resolve_name", lambda name: workloads)
    monkeypatch.delattr(running.os, "sched_setaffinity", raising=False)
    (row,) = carry_out(Task(1, tmp_path, True, ("planning",)))
    taken = row.timing
    assert taken.best_s <= taken.low_s <= taken.median_s <= taken.high_s
    assert row.per_s == 1 / taken.median_s
    assert (row.note, row.threads) == ("a sum", 1)


WORKER = """
import json, os, sys
threads, folder, quick, *groups = sys.argv[1:]
assert os.environ["OMP_NUM_THREADS"] == threads
assert quick or groups == ["tracking"]
print("a library's chatter")
for name in groups:
    timing = dict(best_s=1.0, median_s=2.0, low_s=1.5, high_s=3.0, turns=3)
    print(json.dumps(dict(name=name, what="", threads=1, item="pair", timing=timing)))
if "tracking" in groups:
    sys.exit("tracking is broken")
"""


def test_the_command_gathers_what_processes_find(tmp_path, monkeypatch, capfd) -> None:
    monkeypatch.setattr(running, "WORKER", [sys.executable, "-c", WORKER])
    monkeypatch.setattr(BenchSubject, "has_model", True)
    out = tmp_path / "new" / "found.json"
    Bench(only=("patient", "planning"), quick=True, out=out).run()
    found = json.loads(out.read_text())
    assert [row["name"] for row in found["rows"]] == ["planning", "patient"]
    assert int(found["machine"]["cores"]) >= 1
    assert found["command"] == "tumortrack bench --only patient planning --quick"
    shown = capfd.readouterr().out
    assert shown.index("  planning") < shown.index("  patient") < shown.index("written to")
    lines = [line for line in shown.splitlines() if "2.00 s a pair" in line]
    assert len(lines) == 2  # each as soon as it was measured
    with pytest.raises(TumortrackError, match="tracking is broken"):
        Bench(only=("tracking",), out=tmp_path / "none.json").run()
    assert not (tmp_path / "none.json").exists()


def test_each_process_has_its_own_threads(tmp_path) -> None:
    groups = ("planning", "frame", "tracking")
    one, two = tasks_of(groups, tmp_path, True, cores=4)
    assert (one.threads, one.groups) == (1, groups)
    assert (two.threads, two.groups) == (2, groups[1:])
    (alone,) = tasks_of(("planning", "patient"), tmp_path, True, cores=1)
    assert alone.groups == ("planning",)


def test_what_cannot_be_measured_is_refused(tmp_path) -> None:
    assert "nonsense" in tumortrack("bench", "--only", "nonsense").stderr
    with pytest.raises(InputError, match="does not exist"):
        Bench(document=tmp_path / "none.md").run()


def test_the_command_line_names_every_part() -> None:
    from typing import get_args, get_type_hints

    assert set(get_args(get_args(get_type_hints(Bench)["only"])[0])) == set(GROUPS)
