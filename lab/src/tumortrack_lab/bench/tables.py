"""The bench as tables: on a terminal, and in a document."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tumortrack_lab.bench import figures
from tumortrack_lab.bench.row import BenchResult, BenchRow, Peaks
from tumortrack_lab.study.markdown import table

if TYPE_CHECKING:
    from rich.table import Table

_GIB = 2**30


def rich_table(bench: BenchResult) -> Table:
    """For a terminal."""
    from rich.table import Table

    title = f"{bench.machine.get('processor', '')}, {bench.machine.get('date', '')}"
    head = ("part", "", "threads", "tumortrack", "per s", "naive", "ratio", "labels equal", "floor")
    out = Table(*head, title=title)
    for row in bench.rows:
        naive_s = None if row.naive is None else row.naive.median_s
        out.add_row(
            row.name,
            row.what,
            _threads(row),
            figures.seconds(row.ours.median_s),
            figures.count(row.per_s).strip(),
            figures.seconds(naive_s),
            figures.ratio(row.ratio),
            figures.agreement(row.agreement),
            figures.seconds(figures.floor(row, _peaks(bench, row))),
        )
    return out


def line(row: BenchRow) -> str:
    """One row, as soon as it is measured."""
    naive = "" if row.naive is None else f"; naive {figures.seconds(row.naive.median_s)}"
    return (
        f"  {row.name} {row.what}, threads {_threads(row)}: {figures.seconds(row.ours.median_s)} "
        f"a {row.item}{naive}"
    )


def speed_table(bench: BenchResult) -> str:
    """Every row beside its naive form."""
    head = (
        "part", "of", "threads", "tumortrack", "quartiles", "items a second", "naive", "ratio",
        "labels equal",
    )  # fmt: skip
    rows = [
        (
            row.name,
            row.what,
            _threads(row),
            f"{figures.seconds(row.ours.median_s)} a {row.item}",
            figures.spread(row),
            figures.count(row.per_s).strip(),
            figures.seconds(None if row.naive is None else row.naive.median_s),
            figures.ratio(row.ratio),
            figures.agreement(row.agreement),
        )
        for row in bench.rows
    ]
    return table(head, rows, left=2)


def floor_table(bench: BenchResult) -> str:
    """What each row has to do at least, and what that would take."""
    head = (
        "part", "of", "threads", "arithmetic", "memory", "in", "share of the rate",
        "share of the bandwidth", "floor", "times the floor",
    )  # fmt: skip
    rows = []
    for row in bench.rows:
        if row.work is None:
            continue
        peaks = _peaks(bench, row)
        floor_s = figures.floor(row, peaks)
        rows.append(
            (
                row.name,
                row.what,
                _threads(row),
                *figures.work(row.work),
                row.work.precision,
                figures.percent(figures.share_of_rate(row, peaks)),
                figures.percent(figures.share_of_bandwidth(row, peaks)),
                figures.seconds(floor_s),
                figures.ratio(None if floor_s is None else row.ours.median_s / floor_s),
            )
        )
    return table(head, rows, left=2)


def notes(bench: BenchResult) -> str:
    """What the naive forms are and what else is to be known of a row."""
    lines: dict[str, list[str]] = {}
    for row in bench.rows:
        said = [f"naive: {row.naive_is}"] if row.naive_is else []
        text = "; ".join([*said, *([row.note] if row.note else [])])
        if text:
            lines.setdefault(text, []).append(f"{row.name} ({row.what}, {_threads(row)})")
    return "\n".join(f"- {_few(where)}: {text}." for text, where in lines.items())


def _few(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def machine_table(bench: BenchResult) -> str:
    """The machine in words, and what it reaches."""
    rows = [(key, text) for key, text in bench.machine.items()]
    for peaks in bench.peaks:
        rates = ", ".join(f"{name} {rate / 1e9:,.0f} GFLOP/s" for name, rate in peaks.gemm.items())
        text = f"{rates}; memory {peaks.triad / 1e9:.1f} GB/s"
        rows.append((f"measured, {peaks.threads} thread{'s' * (peaks.threads > 1)}", text))
    return table(("this machine", ""), rows, left=2)


def memory_table(bench: BenchResult) -> str:
    """Largest of each curve, and the command line."""
    from tumortrack_lab.bench.command import PEAK

    rows = [
        (f"{row.name}, {row.what}", "", f"{row.others[PEAK] / _GIB:.2f} GiB")
        for row in bench.rows
        if row.others.get(PEAK)
    ]
    last = {(point.curve, point.what): point for point in bench.points}
    for (curve, what), point in last.items():
        if point.peak_bytes is not None:
            held = f"{point.peak_bytes / _GIB:.2f} GiB"
            rows.append((f"{what}: {point.size:,} ({curve})", figures.seconds(point.seconds), held))
    return table(("what", "time", "peak memory of the process"), rows)


def _threads(row: BenchRow) -> str:
    return f"{row.threads}" if row.device == "cpu" else row.device


def _peaks(bench: BenchResult, row: BenchRow) -> Peaks | None:
    for peaks in bench.peaks:
        if peaks.threads == row.threads:
            return peaks
    return None
