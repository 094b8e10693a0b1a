"""A run's results: a table, one in a document with CSV beside it, goals, JSON."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd

from tumortrack.core.store import write_atomically
from tumortrack_lab.bench import rows
from tumortrack_lab.bench.rows import BenchResult, BenchRow
from tumortrack_lab.study.document import ReportWriter

_GIB = 2**30
_SECONDS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}
_SUMMARY = ["part", "of", "time"]


def _digits(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _text(seconds: float) -> str:
    """In the largest unit that they reach, with three digits: 12.3 ms."""
    unit = next((name for name, size in _SECONDS.items() if seconds >= size), "µs")
    return f"{_digits(seconds / _SECONDS[unit])} {unit}"


def _cells(row: BenchRow) -> dict[str, str]:
    """What a document and goals say of a row."""
    took = _text(row.timing.median_s)
    return {
        "part": row.name,
        "of": row.what,
        "took": took,
        "time": f"{took} a {row.item}",
        "peak": f"{row.peak_bytes / _GIB:.2f} GiB",
    }


def line(row: BenchRow) -> str:
    """One row, as soon as it is measured."""
    return f"  {row.name} {row.what}, threads {row.threads}: {_cells(row)['time']}"


def figures(bench: BenchResult) -> pd.DataFrame:
    """Every row, as in speed.csv; ms are of one call, quartiles half of their distance."""
    return pd.DataFrame([_figures(row) for row in bench.rows])


def _figures(row: BenchRow) -> dict[str, object]:
    def digits(value: float) -> str:
        return _digits(value).replace(",", "") if value else ""

    timing = row.timing
    return {
        "part": row.name.replace("`", ""),
        "of": row.what,
        "threads": row.threads,
        "ms": digits(1e3 * timing.median_s),
        "quartiles ± %": f"{50 * (timing.high_s - timing.low_s) / timing.median_s:.0f}",
        "items a second": digits(row.per_s),
        "peak GiB": digits(row.peak_bytes / _GIB),
        "note": row.note,
    }


class SpeedGoal(NamedTuple):
    """``row``: name and threads of the row that decides; ``measured``: which of its cells is shown;
    ``met``: whether it is enough (None: not measured on this system)."""

    figure: str
    goal: str
    row: tuple[str, int]
    measured: str
    met: Callable[[BenchRow], bool | None]

    def verdict(self, bench: BenchResult) -> tuple[str, bool | None]:
        """What was measured, in words, and whether it is enough (None: open)."""
        for row in bench.rows:
            if (row.name, row.threads) == self.row:
                met = self.met(row)
                return "not measured" if met is None else _cells(row)[self.measured], met
        return "not measured in this run", None


def goals_of(bench: BenchResult) -> list[dict[str, str]]:
    """Rows of speed_goals.csv: the goal, measured, met."""
    met_text = {True: "yes", False: "no", None: ""}
    lines = []
    for goal in GOALS:
        measured, met = goal.verdict(bench)
        lines.append({
            "figure": goal.figure.replace("`", ""), "goal": goal.goal,
            "measured here": measured, "met": met_text[met],
        })  # fmt: skip
    return lines


def _within(limit_s: float) -> Callable[[BenchRow], bool]:
    return lambda row: row.timing.median_s <= limit_s


GOALS = [
    SpeedGoal(*goal)
    for goal in (
        ("frame, 2 CPU cores (the paper: 14 ms on an RTX 4090)", "at most 14 ms",
         (rows.FRAME, 2), "took", _within(0.014)),
        ("tracking frame, 2 CPU cores", "at most 5 ms", (rows.TRACKING, 2), "took", _within(0.005)),
        ("400^3 labels, exact, 2 CPU cores", "at most 0.3 s",
         (rows.VOLUME, 2), "took", _within(0.3)),
        ("start of `tumortrack locate` to answer, warm disk", "under 3 s",
         (rows.COMMAND, 2), "took", _within(3.0)),
        ("a label map to the first estimate, 2 CPU cores", "at most 15 s",
         (rows.PATIENT, 2), "took", _within(15.0)),
        ("memory of `tumortrack locate --grid 400`", "under 4 GB, everything included",
         (rows.LARGE, 2), "peak", lambda row: row.peak_bytes < 4e9 if row.peak_bytes else None),
    )
]  # fmt: skip


def write_bench(bench: BenchResult, out: Path, document: Path | None) -> list[Path]:
    """Write OUT, and where there is a document its tables in data/ beside it; returns what was
    written. Raises InputError: no such document; StorageError: the disk refused."""
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(out, msgspec.json.format(msgspec.json.encode(bench), indent=1))
    if document is None:
        return [out]
    machine = [{"this machine": key, "value": value} for key, value in bench.machine.items()]
    most = max(row.threads for row in bench.rows)
    cells = pd.DataFrame([_cells(row) for row in bench.rows if row.threads == most])
    tables = {
        "speed": cells[_SUMMARY],
        "speed-rows": figures(bench),
        "speed-goals": pd.DataFrame(goals_of(bench)),
        "speed-machine": pd.DataFrame(machine),
    }
    sample = f"medians of calls on {most} threads"
    ReportWriter(document, bench.command).tables(tables, sample=sample)
    folder = document.parent / "data"
    return [out, document, *(folder / f"{name}.csv" for name in tables)]
