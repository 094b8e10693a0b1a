"""What a run found: a table on a terminal, one in a document with CSV beside it, goals, JSON."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec
import pandas as pd
from rich.table import Table

from tumortrack.core.store import write_atomically
from tumortrack_lab.bench import rows
from tumortrack_lab.bench.machine import NO_GPU
from tumortrack_lab.bench.rows import BenchResult, BenchRow
from tumortrack_lab.study.document import ReportWriter, table

BLOCKS = ("speed",)
_EMPTY = "–"
_GIB = 2**30
_SECONDS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}
_COUNTS = {"T": 1e12, "G": 1e9, "M": 1e6, "k": 1e3, "": 1.0}
# Columns, by what ``_cells`` calls them; a terminal's table has other names for some.
_SHOWN = ("part", "of", "threads", "took", "items a second", "naive", "ratio", "labels equal")
_SHOWN_AS = {"of": "", "took": "tumortrack", "items a second": "per s"}
_SUMMARY = ("part", "of", "tumortrack", "naive", "ratio", "labels equal")


def _digits(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _text(value: float, units: dict[str, float] = _SECONDS) -> str:
    """In the largest unit that it reaches, with three digits: 12.3 ms."""
    unit = next((name for name, size in units.items() if value >= size), [*units][-1])
    return f"{_digits(value / units[unit])} {unit}"


def _agreement(share: float) -> str:
    """Of labels; never rounded up to all of them."""
    return "100 %" if share == 1 else f"{int(share * 1e5) / 1e3:.3f} %"


def _cells(row: BenchRow) -> dict[str, str]:
    """All that tables say of a row."""
    took, share = row.ours.median_s, row.agreement
    return {
        "part": row.name,
        "of": row.what,
        "threads": f"{row.threads}" if row.device == "cpu" else row.device,
        "took": _text(took),
        "tumortrack": f"{_text(took)} a {row.item}",
        "items a second": _text(row.per_s, _COUNTS).strip(),
        "naive": _text(row.naive.median_s) if row.naive else _EMPTY,
        "ratio": _EMPTY if row.ratio is None else f"{_digits(row.ratio)} x",
        "labels equal": _EMPTY if share is None else _agreement(share),
        "peak": f"{row.others.get(rows.PEAK, 0.0) / _GIB:.2f} GiB",
    }


def line(row: BenchRow, left: str) -> str:
    """One row, as soon as it is measured; ``left``: how long all others will take."""
    cells = _cells(row)
    naive = "; naive {naive}, {ratio}".format_map(cells) if row.naive else ""
    return "  {part} {of}, threads {threads}: {tumortrack}".format_map(cells) + f"{naive}; {left}"


def rich_table(bench: BenchResult) -> Table:
    """For a terminal."""
    title = f"{bench.machine.get('processor', '')}, {bench.machine.get('date', '')}"
    out = Table(*(_SHOWN_AS.get(key, key) for key in _SHOWN), title=title)
    for row in bench.rows:
        cells = _cells(row)
        out.add_row(*(cells[key] for key in _SHOWN))
    return out


def _figures(row: BenchRow) -> dict[str, object]:
    """A row of speed.csv; ms are of one call, quartiles half of their distance."""

    def digits(value: float | None) -> str:
        return "" if value is None else _digits(value).replace(",", "")

    ours, naive, share = row.ours, row.naive, row.agreement
    return {
        "part": row.name.replace("`", ""),
        "of": row.what,
        "threads": row.threads if row.device == "cpu" else row.device,
        "ms": digits(1e3 * ours.median_s),
        "quartiles ± %": f"{50 * (ours.high_s - ours.low_s) / ours.median_s:.0f}",
        "items a second": digits(row.per_s),
        "naive ms": digits(1e3 * naive.median_s if naive else None),
        "times faster": digits(row.ratio),
        "labels equal %": "" if share is None else _agreement(share).removesuffix(" %"),
        "peak GiB": digits(row.others.get(rows.PEAK, 0.0) / _GIB or None),
        "naive is": row.naive_is,
        "note": row.note,
    }


class SpeedGoal(NamedTuple):
    """``paper``: the paper's or the naive figure; ``row``: name, preset and threads of the row that
    decides (threads None: on a GPU); ``words``: of its cells; ``met``: whether it is enough (None:
    a system that does not count)."""

    figure: str
    paper: str
    goal: str
    row: tuple[str, str, int | None]
    words: str
    met: Callable[[BenchRow], bool | None]

    def verdict(self, bench: BenchResult) -> tuple[str, bool | None]:
        """What was measured, in words, and whether it is enough (None: open)."""
        gpu = bench.machine.get("GPU", NO_GPU)
        for row in bench.rows:
            threads = row.threads if row.device == "cpu" else None
            if (row.name, row.what, threads) == self.row:
                met = self.met(row)
                cells = {**_cells(row), "each": f"{row.per_s:,.0f}/s"}
                text = "not measured" if met is None else self.words.format_map(cells)
                return text if threads else f"{text} on {gpu}", met
        none_at_hand = self.row[2] is None and gpu == NO_GPU
        return "no GPU was at hand" if none_at_hand else "not measured in this run", None


def goals_of(bench: BenchResult) -> list[dict[str, str]]:
    """Rows of speed_goals.csv: the paper's or the naive value, the goal, measured, met."""
    met_text = {True: "yes", False: "no", None: ""}
    found = []
    for goal in GOALS:
        measured, met = goal.verdict(bench)
        found.append({
            "figure": goal.figure.replace("`", ""), "paper or naive": goal.paper,
            "goal": goal.goal, "measured here": measured, "met": met_text[met],
        })  # fmt: skip
    return found


def _within(limit_s: float, faster: float = 0.0) -> Callable[[BenchRow], bool]:
    return lambda row: row.ours.median_s <= limit_s and (row.ratio or 0.0) >= faster


def _held(row: BenchRow) -> bool | None:
    peak = row.others[rows.PEAK]
    return peak < 4e9 if peak else None


GOALS = [
    SpeedGoal(*goal)
    for goal in (
        ("frame (1,000 points, 40,000 queries), `paper`, 2 CPU cores", "naive fp32, same run",
         "at least 25 x faster, at least 99.8 % of labels equal", (rows.FRAME, "paper", 2),
         "{ratio} ({took}, naive {naive}), {labels equal} equal",
         lambda row: row.ratio >= 25.0 and row.agreement >= 0.998),
        ("frame, `clinic` (the default), 2 CPU cores", "14 ms on an RTX 4090",
         "at most 14 ms (with AMX)", (rows.FRAME, "clinic", 2), "{took}", _within(0.014)),
        ("tracking frame, `clinic`, 2 CPU cores", "", "at most 5 ms",
         (rows.TRACKING, "clinic", 2), "{took}", _within(0.005)),
        ("frame, `paper`, H100", "(14 ms on an RTX 4090)", "at most 1 ms",
         (rows.FRAME, "paper", None), "{took}", _within(0.001)),
        ("400^3 labels, exact, `paper`, 2 CPU cores", "dense, same run",
         "at least 50 x faster, at most 1.4 s", (rows.VOLUME, "paper", 2), "{took}, {ratio}",
         _within(1.4, faster=50.0)),
        ("400^3 labels, exact, `clinic`, 2 CPU cores", "dense, same run",
         "at least 50 x faster, at most 0.3 s", (rows.VOLUME, "clinic", 2), "{took}, {ratio}",
         _within(0.3, faster=50.0)),
        ("400^3 labels, exact, `paper`, H100", "dense, same run", "at most 10 ms",
         (rows.VOLUME, "paper", None), "{took}", _within(0.01)),
        ("training, `paper`, H100", "861 samples/s on an RTX 4090 (2 h)",
         "at least 10,000 samples/s", (rows.TRAINING, "paper", None), "{each}",
         lambda row: row.per_s >= 10_000.0),
        ("training, `quick`, 2 CPU cores, generator included", "", "at least 300 samples/s",
         (rows.TRAINING, "quick", 2), "{each}", lambda row: row.per_s >= 300.0),
        ("start of `tumortrack locate` to answer, warm disk, `clinic`", "",
         "under 3 s", (rows.COMMAND, "clinic", 2), "{took}", _within(3.0)),
        ("a label map to the first estimate, `clinic`, 2 CPU cores", "", "at most 15 s",
         (rows.PATIENT, "clinic", 2), "{took}", _within(15.0)),
        *((f"memory of `tumortrack locate --grid 400`, `{preset}`", "",
           "under 4 GB, everything included", (rows.LARGE, preset, 2), "{peak}", _held)
          for preset in rows.PRESETS),
    )
]  # fmt: skip


def write_bench(bench: BenchResult, out: Path, document: Path | None) -> list[Path]:
    """Write OUT, and where there is a document its block and the tables in data/ beside it; returns
    what was written. Raises InputError: no such document, or a marker of its block is missing;
    StorageError: the disk refused."""
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(out, msgspec.json.format(msgspec.json.encode(bench), indent=1))
    if document is None:
        return [out]
    machine = [{"this machine": key, "value": value} for key, value in bench.machine.items()]
    tables = (
        ("speed", [_figures(row) for row in bench.rows], "Every row"),
        ("speed_goals", goals_of(bench), "Goals"),
        ("speed_machine", machine, "The machine"),
    )
    most = max(row.threads for row in bench.rows)
    cells = [_cells(row) for row in bench.rows if row.threads == most]
    summary = table(_SUMMARY, [[each[key] for key in _SUMMARY] for each in cells], left=2)
    caption = f"Medians on {most} threads; `{bench.command}`, {bench.machine.get('date', '')}."
    writer = ReportWriter(document, bench.command)
    links = (writer.data(name, pd.DataFrame(found), words) for name, found, words in tables)
    writer.write({"speed": "\n\n".join((summary, caption, *links))})
    folder = document.parent / "data"
    return [out, document, *(folder / f"{name}.csv" for name, *_ in tables)]
