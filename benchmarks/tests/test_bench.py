"""The bench: figures that follow from their definitions, processes, documents."""

import json
import sys
from collections.abc import Iterator

import pandas as pd
import pytest

from clock import Clock
from refused import refused
from stories import tumortrack
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack_benchmarks import bench
from tumortrack_benchmarks.bench import (
    BenchSubject,
    Group,
    Row,
    Workload,
    carry_out,
    tables_of,
    timed,
)
from tumortrack_benchmarks.cli.bench import Bench

FRAME = Row("frame", "elastic", 2, "frame", 0.012, 0.1)


def test_short_calls_fill_the_budget_and_what_is_not_counted_is_left_out(monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr(bench, "time", clock)

    def call() -> float:
        clock.sleep(0.015)
        return 0.01

    seconds = timed(call, budget_s=0.2)
    assert seconds == [pytest.approx(0.005)] * len(seconds)
    assert 10 <= len(seconds) <= 13


def test_long_calls_have_three_turns_the_first_among_them(monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr(bench, "time", clock)
    seconds = iter([8.0, 2.0, 3.0, 50.0])  # the first is cold
    assert timed(lambda: clock.sleep(next(seconds)), budget_s=0.01) == [8.0, 2.0, 3.0]


def test_a_table_says_times_in_their_unit_and_whether_goals_are_met() -> None:
    slow = Row("tracking frame", "elastic", 2, "frame", 0.006, 0.0)
    alone = Row("frame", "elastic", 1, "frame", 2.5e-5, 0.0)
    parts = tables_of([alone, FRAME, slow], {"cores": "2"})["speed"]
    assert parts.values.tolist() == [
        ["frame", "elastic", "12 ms a frame", "at most 14 ms: met"],
        ["tracking frame", "elastic", "6 ms a frame", "at most 5 ms: not met"],
    ]
    assert alone.time == "25 µs a frame"


def some_work(subject: BenchSubject) -> Iterator[Workload]:
    yield Workload("part", "", "sum", lambda: sum(range(99)), lambda: "a sum")


def test_a_process_measures_a_part(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(bench.GROUPS, "planning", Group(some_work, (1,), 0.01, 0.01))
    monkeypatch.delattr(bench.os, "sched_setaffinity", raising=False)
    (row,) = carry_out(1, tmp_path, True, ["planning"])
    assert row.seconds > 0
    assert (row.note, row.threads) == ("a sum", 1)


@pytest.mark.slow
def test_every_workload_of_the_method_becomes_a_row(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(bench, "_GRID", 24)
    subject = BenchSubject(tmp_path)
    rows = [
        workload.row(1, 0.01)
        for name in ("frame", "tracking", "volume")
        for workload in bench.GROUPS[name].source(subject)
    ]
    names = ["search", "search and refinement", "frame", "tracking frame", "400^3 labels"]
    assert [row.part for row in rows] == names


WORKER = """
import json, os, sys
threads, folder, quick, *groups = sys.argv[1:]
assert os.environ["OMP_NUM_THREADS"] == threads
assert quick or groups == ["tracking"]
print("a library's chatter")
for name in groups:
    row = dict(part=name, of="", threads=int(threads), item="pair", seconds=2.0, spread=0.1)
    print(json.dumps(row))
if "tracking" in groups:
    sys.exit("tracking is broken")
"""


def test_the_command_gathers_what_processes_find(tmp_path, monkeypatch, capfd) -> None:
    monkeypatch.setattr(bench, "WORKER", [sys.executable, "-c", WORKER])
    monkeypatch.setattr(bench, "available_cores", lambda: 2)
    out, page = tmp_path / "new" / "found.json", tmp_path / "page.md"
    page.write_text("before\n<!-- results:speed -->\nold\n<!-- /results:speed -->\nafter")
    Bench(only=("patient", "planning"), quick=True, out=out, document=page).run()
    found = json.loads(out.read_text())
    assert [(row["part"], row["threads"]) for row in found["rows"]] == [
        ("planning", 1),
        ("patient", 2),
    ]
    assert int(found["machine"]["cores"]) >= 1
    assert found["command"] == "tumortrack bench --only patient planning --quick"
    shown = capfd.readouterr().out
    assert shown.index("  planning") < shown.index("  patient") < shown.index("written to")
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after")
    assert "| patient |  | 2 s a pair |" in text
    rows = pd.read_csv(tmp_path / "data" / "speed-rows.csv", comment="#")
    assert rows.seconds.tolist() == [2.0, 2.0]
    with refused(TumortrackError, "tracking is broken"):
        Bench(only=("tracking",), out=tmp_path / "none.json").run()
    assert not (tmp_path / "none.json").exists()


def test_what_cannot_be_measured_is_refused(tmp_path) -> None:
    assert "nonsense" in tumortrack("bench", "--only", "nonsense").stderr
    with pytest.raises(InputError):
        Bench(document=tmp_path / "none.md").run()


def test_the_command_line_names_every_part() -> None:
    from typing import get_args, get_type_hints

    assert set(get_args(get_args(get_type_hints(Bench)["only"])[0])) == set(bench.GROUPS)
