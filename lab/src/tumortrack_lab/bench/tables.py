"""The bench as tables: on a terminal, and in a document; numbers as people read them."""

from __future__ import annotations

from rich.table import Table

from tumortrack_lab.bench.rows import PEAK, BenchResult, BenchRow
from tumortrack_lab.study.document import table

_EMPTY = "–"
_GIB = 2**30


def seconds(value: float | None) -> str:
    """With a unit and three digits: 12.3 ms."""
    if value is None:
        return _EMPTY
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if value >= size or unit == "µs":
            return f"{_digits(value / size)} {unit}"
    raise AssertionError


def _digits(value: float) -> str:
    if value >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def percent(share: float | None) -> str:
    return _EMPTY if share is None else f"{100 * share:.1f} %"


def agreement(share: float | None) -> str:
    """Of labels; never rounded up to all of them."""
    if share is None:
        return _EMPTY
    return "100 %" if share == 1 else f"{int(share * 1e5) / 1e3:.3f} %"


def ratio(value: float | None) -> str:
    return _EMPTY if value is None else f"{_digits(value)} x"


def count(value: float) -> str:
    """With a prefix: 0.15 T."""
    for prefix, size in (("T", 1e12), ("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{_digits(value / size)} {prefix}"
    return f"{_digits(value)} "


def line(row: BenchRow, left: str) -> str:
    """One row, as soon as it is measured; ``left``: how long all others will take."""
    naive = (
        "" if row.naive is None else f"; naive {seconds(row.naive.median_s)}, {ratio(row.ratio)}"
    )
    took = f"{seconds(row.ours.median_s)} a {row.item}"
    return f"  {row.name} {row.what}, threads {_threads(row)}: {took}{naive}; {left}"


def rich_table(bench: BenchResult) -> Table:
    """For a terminal."""
    title = f"{bench.machine.get('processor', '')}, {bench.machine.get('date', '')}"
    head = ("part", "", "threads", "tumortrack", "per s", "naive", "ratio", "labels equal", "floor")
    out = Table(*head, title=title)
    for row in bench.rows:
        took = seconds(row.ours.median_s)
        out.add_row(*_whose(row), took, *_beside_naive(row), seconds(_floor(bench, row)))
    return out


def speed_table(bench: BenchResult) -> str:
    """Every row beside its naive form."""
    head = (
        "part", "of", "threads", "tumortrack", "quartiles", "items a second", "naive", "ratio",
        "labels equal",
    )  # fmt: skip
    rows = []
    for row in bench.rows:
        ours = row.ours
        spread = f"± {50 * (ours.high_s - ours.low_s) / ours.median_s:.0f} %"
        took = f"{seconds(ours.median_s)} a {row.item}"
        rows.append((*_whose(row), took, spread, *_beside_naive(row)))
    return table(head, rows, left=2)


def floor_table(bench: BenchResult) -> str:
    """What each row has to do at least, and what that would take; shares of the machine's matrix
    products in this precision, and of its memory's bandwidth."""
    head = (
        "part", "of", "threads", "arithmetic", "memory", "in", "share of the rate",
        "share of the bandwidth", "floor", "times the floor",
    )  # fmt: skip
    rows = []
    for row in bench.rows:
        if (work := row.work) is None:
            continue
        peaks, took, floor_s = bench.peaks_for(row), row.ours.median_s, _floor(bench, row)
        rate = None if peaks is None else work.flops / took / peaks.rate(work.precision)
        bandwidth = None if peaks is None else work.bytes / took / peaks.triad
        least = (f"{count(work.flops)}FLOP", f"{count(work.bytes)}B", work.precision)
        times = None if floor_s is None else took / floor_s
        shares = (percent(rate), percent(bandwidth))
        rows.append((*_whose(row), *least, *shares, seconds(floor_s), ratio(times)))
    return table(head, rows, left=2)


def _whose(row: BenchRow) -> tuple[str, str, str]:
    return row.name, row.what, _threads(row)


def _beside_naive(row: BenchRow) -> tuple[str, ...]:
    naive_s = None if row.naive is None else row.naive.median_s
    per_s = count(row.per_s).strip()
    return per_s, seconds(naive_s), ratio(row.ratio), agreement(row.agreement)


def _floor(bench: BenchResult, row: BenchRow) -> float | None:
    """The least seconds for the row's work."""
    peaks = bench.peaks_for(row)
    return None if row.work is None or peaks is None else peaks.floor_s(row.work)


def _threads(row: BenchRow) -> str:
    return f"{row.threads}" if row.device == "cpu" else row.device


def notes(bench: BenchResult) -> str:
    """What the naive forms are and what else is to be known of a row."""
    lines: dict[str, list[str]] = {}
    for row in bench.rows:
        naive = [f"naive: {row.naive_is}"] if row.naive_is else []
        text = "; ".join([*naive, *([row.note] if row.note else [])])
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
    rows = [
        (f"{row.name}, {row.what}", "", f"{row.others[PEAK] / _GIB:.2f} GiB")
        for row in bench.rows
        if row.others.get(PEAK)
    ]
    last = {(point.curve, point.what): point for point in bench.points}
    for (curve, what), point in last.items():
        if point.peak_bytes is not None:
            held = f"{point.peak_bytes / _GIB:.2f} GiB"
            rows.append((f"{what}: {point.size:,} ({curve})", seconds(point.seconds), held))
    return table(("what", "time", "peak memory of the process"), rows)
