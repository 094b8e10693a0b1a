"""The bench as tables, on a terminal and in a document: rows, floors, and what was aimed at."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from rich.table import Table

from tumortrack_lab.bench import rows
from tumortrack_lab.bench.machine import NO_GPU
from tumortrack_lab.bench.rows import BenchResult, BenchRow
from tumortrack_lab.study.document import table

_EMPTY = "–"
_NOT_MEASURED = "not measured in this run"
_GIB = 2**30


def seconds(value: float | None) -> str:
    """With a unit and three digits: 12.3 ms."""
    if value is None:
        return _EMPTY
    unit, size = next((u for u in (("s", 1.0), ("ms", 1e-3)) if value >= u[1]), ("µs", 1e-6))
    return f"{_digits(value / size)} {unit}"


def count(value: float) -> str:
    """With a prefix: 0.15 T."""
    sizes = (("T", 1e12), ("G", 1e9), ("M", 1e6), ("k", 1e3))
    prefix, size = next((one for one in sizes if value >= one[1]), ("", 1.0))
    return f"{_digits(value / size)} {prefix}"


def _digits(value: float) -> str:
    if value >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _percent(share: float | None) -> str:
    return _EMPTY if share is None else f"{100 * share:.1f} %"


def _agreement(share: float | None) -> str:
    """Of labels; never rounded up to all of them."""
    if share is None:
        return _EMPTY
    return "100 %" if share == 1 else f"{int(share * 1e5) / 1e3:.3f} %"


def _ratio(value: float | None) -> str:
    return _EMPTY if value is None else f"{_digits(value)} x"


def line(row: BenchRow, left: str) -> str:
    """One row, as soon as it is measured; ``left``: how long all others will take."""
    naive = f"; naive {seconds(row.naive.median_s)}, {_ratio(row.ratio)}" if row.naive else ""
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
    body = []
    for row in bench.rows:
        ours = row.ours
        spread = f"± {50 * (ours.high_s - ours.low_s) / ours.median_s:.0f} %"
        took = f"{seconds(ours.median_s)} a {row.item}"
        body.append((*_whose(row), took, spread, *_beside_naive(row)))
    return table(head, body, left=2)


def floor_table(bench: BenchResult) -> str:
    """What each row has to do at least, and what that would take; shares of the machine's matrix
    products in this precision, and of its memory's bandwidth."""
    head = (
        "part", "of", "threads", "arithmetic", "memory", "in", "share of the rate",
        "share of the bandwidth", "floor", "times the floor",
    )  # fmt: skip
    body = []
    for row in bench.rows:
        if (work := row.work) is None:
            continue
        peaks, took, floor_s = bench.peaks_for(row), row.ours.median_s, _floor(bench, row)
        rate = None if peaks is None else work.flops / took / peaks.rate(work.precision)
        bandwidth = None if peaks is None else work.bytes / took / peaks.triad
        least = (f"{count(work.flops)}FLOP", f"{count(work.bytes)}B", work.precision)
        times = None if floor_s is None else took / floor_s
        shares = (_percent(rate), _percent(bandwidth))
        body.append((*_whose(row), *least, *shares, seconds(floor_s), _ratio(times)))
    return table(head, body, left=2)


def _whose(row: BenchRow) -> tuple[str, str, str]:
    return row.name, row.what, _threads(row)


def _beside_naive(row: BenchRow) -> tuple[str, ...]:
    naive_s = row.naive.median_s if row.naive else None
    return count(row.per_s).strip(), seconds(naive_s), _ratio(row.ratio), _agreement(row.agreement)


def _floor(bench: BenchResult, row: BenchRow) -> float | None:
    """The least seconds for the row's work."""
    peaks = bench.peaks_for(row)
    return peaks.floor_s(row.work) if row.work and peaks else None


def _threads(row: BenchRow) -> str:
    return f"{row.threads}" if row.device == "cpu" else row.device


def notes(bench: BenchResult) -> str:
    """What the naive forms are and what else is to be known of a row."""
    lines: dict[str, list[str]] = {}
    for row in bench.rows:
        naive = f"naive: {row.naive_is}" if row.naive_is else ""
        if text := "; ".join(filter(None, (naive, row.note))):
            lines.setdefault(text, []).append(f"{row.name} ({row.what}, {_threads(row)})")
    return "\n".join(f"- {_few(where)}: {text}." for text, where in lines.items())


def _few(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def machine_table(bench: BenchResult) -> str:
    """The machine in words, and what it reaches."""
    body = [*bench.machine.items()]
    for peaks in bench.peaks:
        rates = ", ".join(f"{name} {rate / 1e9:,.0f} GFLOP/s" for name, rate in peaks.gemm.items())
        text = f"{rates}; memory {peaks.triad / 1e9:.1f} GB/s"
        body.append((f"measured, {peaks.threads} thread{'s' * (peaks.threads > 1)}", text))
    return table(("this machine", ""), body, left=2)


def memory_table(bench: BenchResult) -> str:
    """Largest of each curve, and the command line."""
    body = [
        (f"{row.name}, {row.what}", "", f"{row.others[rows.PEAK] / _GIB:.2f} GiB")
        for row in bench.rows
        if row.others.get(rows.PEAK)
    ]
    last = {(point.curve, point.what): point for point in bench.points}
    for (curve, what), point in last.items():
        if point.peak_bytes is not None:
            held = f"{point.peak_bytes / _GIB:.2f} GiB"
            body.append((f"{what}: {point.size:,} ({curve})", seconds(point.seconds), held))
    return table(("what", "time", "peak memory of the process"), body)


Verdict = tuple[str, bool | None]  # what was measured, in words; whether it is enough (None: open)
Judge = Callable[[BenchRow], Verdict]


class SpeedGoal(NamedTuple):
    """``paper``: the paper's or the naive figure; ``row``: name, preset and threads of the row that
    decides (threads None: on a GPU)."""

    figure: str
    paper: str
    goal: str
    row: tuple[str, str, int | None]
    judge: Judge

    def verdict(self, bench: BenchResult) -> Verdict:
        name, what, threads = self.row
        gpu = bench.machine.get("GPU", NO_GPU)
        for row in bench.rows:
            here = row.device != "cpu" if threads is None else _threads(row) == str(threads)
            if (row.name, row.what) == (name, what) and here:
                measured, met = self.judge(row)
                return measured if threads else f"{measured} on {gpu}", met
        none_at_hand = threads is None and gpu == NO_GPU
        return "no GPU was at hand" if none_at_hand else _NOT_MEASURED, None


def goals_table(bench: BenchResult) -> str:
    """Figure, the paper's or the naive value, the goal, measured, met."""
    body = []
    for goal in GOALS:
        measured, met = goal.verdict(bench)
        met_text = {True: "yes", False: "no", None: ""}[met]
        body.append((goal.figure, goal.paper, goal.goal, measured, met_text))
    return table(("figure", "paper / naive", "goal", "measured here", "met"), body, left=4)


def _at_most(limit_s: float) -> Judge:
    return lambda row: (seconds(row.ours.median_s), row.ours.median_s <= limit_s)


def _at_least_per_s(least: float) -> Judge:
    return lambda row: (f"{row.per_s:,.0f}/s", row.per_s >= least)


def _faster_and_equal(row: BenchRow) -> Verdict:
    assert row.ratio is not None
    assert row.agreement is not None
    assert row.naive is not None
    both = f"{seconds(row.ours.median_s)}, naive {seconds(row.naive.median_s)}"
    words = f"{_ratio(row.ratio)} ({both}), {_agreement(row.agreement)} equal"
    return words, row.ratio >= 25.0 and row.agreement >= 0.998


def _faster_within(limit_s: float) -> Judge:
    def judge(row: BenchRow) -> Verdict:
        assert row.ratio is not None
        words = f"{seconds(row.ours.median_s)}, {_ratio(row.ratio)}"
        return words, row.ratio >= 50.0 and row.ours.median_s <= limit_s

    return judge


def _started(row: BenchRow) -> Verdict:
    before = row.others[rows.BEFORE_TORCH]
    words = f"{seconds(row.ours.median_s)}, {seconds(before)} of it before torch"
    return words, row.ours.median_s < 3 and before < 1


def _held(row: BenchRow) -> Verdict:
    """The peak is 0 on a system that does not count it."""
    peak = row.others[rows.PEAK]
    return (f"{peak / _GIB:.2f} GiB", peak < 4 * 1e9) if peak else ("not measured", None)


GOALS = [
    SpeedGoal(*goal)
    for goal in (
        ("frame (1,000 points, 40,000 queries), `paper`, 2 CPU cores", "naive fp32, same run",
         "at least 25 x faster, at least 99.8 % of labels equal",
         (rows.FRAME, "paper", 2), _faster_and_equal),
        ("frame, `clinic` (the default), 2 CPU cores", "14 ms on an RTX 4090",
         "at most 14 ms (with AMX)", (rows.FRAME, "clinic", 2), _at_most(0.014)),
        ("tracking frame, `clinic`, 2 CPU cores", "", "at most 5 ms",
         (rows.TRACKING, "clinic", 2), _at_most(0.005)),
        ("frame, `paper`, H100", "(14 ms on an RTX 4090)", "at most 1 ms",
         (rows.FRAME, "paper", None), _at_most(0.001)),
        ("400^3 labels, exact, `paper`, 2 CPU cores", "dense, same run",
         "at least 50 x faster, at most 1.4 s", (rows.VOLUME, "paper", 2), _faster_within(1.4)),
        ("400^3 labels, exact, `clinic`, 2 CPU cores", "dense, same run",
         "at least 50 x faster, at most 0.3 s", (rows.VOLUME, "clinic", 2), _faster_within(0.3)),
        ("400^3 labels, exact, `paper`, H100", "dense, same run", "at most 10 ms",
         (rows.VOLUME, "paper", None), _at_most(0.01)),
        ("training, `paper`, H100", "861 samples/s on an RTX 4090 (2 h)",
         "at least 10,000 samples/s", (rows.TRAINING, "paper", None), _at_least_per_s(10_000.0)),
        ("training, `quick`, 2 CPU cores, generator included", "", "at least 300 samples/s",
         (rows.TRAINING, "quick", 2), _at_least_per_s(300.0)),
        *((f"generator, {what}, one core, 424 x 240 depth and 2,000 labels",
           "Open3D + NumPy: 15/s", "at least 250/s", (rows.GENERATOR, what, 1),
           _at_least_per_s(250.0)) for what in ("drags", "elastic")),
        ("start of `tumortrack locate` to answer, warm disk, `clinic`", "",
         "under 3 s, under 1 s of it before torch", (rows.COMMAND, "clinic", 2), _started),
        *((f"memory of `tumortrack locate --grid 400`, `{preset}`", "",
           "under 4 GB, everything included", (rows.LARGE, preset, 2), _held)
          for preset in ("clinic", "quick")),
    )
]  # fmt: skip
