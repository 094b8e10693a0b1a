"""Numbers as people read them."""

from __future__ import annotations

from tumortrack_lab.bench.row import BenchRow, Peaks, Work

_EMPTY = "–"


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


def percent(share: float | None, digits: int = 1) -> str:
    return _EMPTY if share is None else f"{100 * share:.{digits}f} %"


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


def spread(row: BenchRow) -> str:
    """Half the distance of the quartiles, in per cent of the median."""
    timing = row.ours
    return f"± {50 * (timing.high_s - timing.low_s) / timing.median_s:.0f} %"


def share_of_rate(row: BenchRow, peaks: Peaks | None) -> float | None:
    """Of the machine's matrix products in this precision."""
    if row.work is None or peaks is None or row.device != "cpu":
        return None
    return row.work.flops / row.ours.median_s / peaks.rate(row.work.precision)


def share_of_bandwidth(row: BenchRow, peaks: Peaks | None) -> float | None:
    """Of the machine's memory bandwidth, by the bytes that have to be moved."""
    if row.work is None or peaks is None or row.device != "cpu":
        return None
    return row.work.bytes / row.ours.median_s / peaks.triad


def floor(row: BenchRow, peaks: Peaks | None) -> float | None:
    """The least seconds for the row's work."""
    if row.work is None or peaks is None or row.device != "cpu":
        return None
    return peaks.floor_s(row.work)


def work(of: Work | None) -> tuple[str, str]:
    """Arithmetic and bytes."""
    return (_EMPTY, _EMPTY) if of is None else (f"{count(of.flops)}FLOP", f"{count(of.bytes)}B")
