"""What was aimed at, and what this machine measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tumortrack_lab.bench.machine import NO_GPU
from tumortrack_lab.bench.rows import (
    BEFORE_TORCH,
    COMMAND,
    FRAME,
    GENERATOR,
    LARGE,
    PEAK,
    TRACKING,
    TRAINING,
    VOLUME,
    BenchResult,
    BenchRow,
)
from tumortrack_lab.bench.tables import agreement, ratio, seconds
from tumortrack_lab.study.document import table

_NOT_MEASURED = "not measured in this run"
_GIB = 2**30

Verdict = tuple[str, bool | None]  # what was measured, in words; whether it is enough (None: open)
Judge = Callable[[BenchRow], Verdict]


@dataclass(frozen=True)
class SpeedGoal:
    """``paper``: the paper's or the naive figure; ``row``: name, preset and threads of the row that
    decides (threads None: on a GPU)."""

    figure: str
    paper: str
    goal: str
    row: tuple[str, str, int | None]
    judge: Judge

    def verdict(self, bench: BenchResult) -> Verdict:
        name, what, threads = self.row
        if threads is not None:
            row = bench.find(name, what, threads)
            return (_NOT_MEASURED, None) if row is None else self.judge(row)
        gpu = bench.machine.get("GPU", NO_GPU)
        for row in bench.rows:
            if (row.name, row.what) == (name, what) and row.device != "cpu":
                measured, met = self.judge(row)
                return f"{measured} on {gpu}", met
        return "no GPU was at hand" if gpu == NO_GPU else _NOT_MEASURED, None


def goals_table(bench: BenchResult) -> str:
    """Figure, the paper's or the naive value, the goal, measured, met."""
    rows = []
    for goal in GOALS:
        measured, met = goal.verdict(bench)
        met_text = {True: "yes", False: "no", None: ""}[met]
        rows.append((goal.figure, goal.paper, goal.goal, measured, met_text))
    return table(("figure", "paper / naive", "goal", "measured here", "met"), rows, left=4)


def _at_most(limit_s: float) -> Judge:
    return lambda row: (seconds(row.ours.median_s), row.ours.median_s <= limit_s)


def _at_least_per_s(least: float) -> Judge:
    return lambda row: (f"{row.per_s:,.0f}/s", row.per_s >= least)


def _faster_and_equal(row: BenchRow) -> Verdict:
    assert row.ratio is not None
    assert row.agreement is not None
    assert row.naive is not None
    words = (
        f"{ratio(row.ratio)} ({seconds(row.ours.median_s)}, naive "
        f"{seconds(row.naive.median_s)}), {agreement(row.agreement)} equal"
    )
    return words, row.ratio >= 25.0 and row.agreement >= 0.998


def _faster_within(limit_s: float) -> Judge:
    def judge(row: BenchRow) -> Verdict:
        assert row.ratio is not None
        words = f"{seconds(row.ours.median_s)}, {ratio(row.ratio)}"
        return words, row.ratio >= 50.0 and row.ours.median_s <= limit_s

    return judge


def _started(row: BenchRow) -> Verdict:
    before = row.others[BEFORE_TORCH]
    words = f"{seconds(row.ours.median_s)}, {seconds(before)} of it before torch"
    return words, row.ours.median_s < 3 and before < 1


def _held(row: BenchRow) -> Verdict:
    peak = row.others[PEAK]
    if not peak:  # this system does not count it
        return "not measured", None
    return f"{peak / _GIB:.2f} GiB", peak < 4 * 1e9


GOALS = tuple(
    SpeedGoal(*goal)
    for goal in (
        ("frame (1,000 points, 40,000 queries), `paper`, 2 CPU cores", "naive fp32, same run",
         "at least 25 x faster, at least 99.8 % of labels equal",
         (FRAME, "paper", 2), _faster_and_equal),
        ("frame, `clinic` (the default), 2 CPU cores", "14 ms on an RTX 4090",
         "at most 14 ms (with AMX)", (FRAME, "clinic", 2), _at_most(0.014)),
        ("tracking frame, `clinic`, 2 CPU cores", "", "at most 5 ms",
         (TRACKING, "clinic", 2), _at_most(0.005)),
        ("frame, `paper`, H100", "(14 ms on an RTX 4090)", "at most 1 ms",
         (FRAME, "paper", None), _at_most(0.001)),
        ("400^3 labels, exact, `paper`, 2 CPU cores", "dense, same run",
         "at least 50 x faster, at most 1.4 s", (VOLUME, "paper", 2), _faster_within(1.4)),
        ("400^3 labels, exact, `clinic`, 2 CPU cores", "dense, same run",
         "at least 50 x faster, at most 0.3 s", (VOLUME, "clinic", 2), _faster_within(0.3)),
        ("400^3 labels, exact, `paper`, H100", "dense, same run", "at most 10 ms",
         (VOLUME, "paper", None), _at_most(0.01)),
        ("training, `paper`, H100", "861 samples/s on an RTX 4090 (2 h)",
         "at least 10,000 samples/s", (TRAINING, "paper", None), _at_least_per_s(10_000.0)),
        ("training, `quick`, 2 CPU cores, generator included", "", "at least 300 samples/s",
         (TRAINING, "quick", 2), _at_least_per_s(300.0)),
        *(
            (f"generator, {what}, one core, 424 x 240 depth and 2,000 labels",
             "Open3D + NumPy: 15/s", "at least 250/s", (GENERATOR, what, 1), _at_least_per_s(250.0))
            for what in ("drags", "elastic")
        ),
        ("start of `tumortrack locate` to answer, warm disk, `clinic`", "",
         "under 3 s, under 1 s of it before torch", (COMMAND, "clinic", 2), _started),
        *(
            (f"memory of `tumortrack locate --grid 400`, `{preset}`", "",
             "under 4 GB, everything included", (LARGE, preset, 2), _held)
            for preset in ("clinic", "quick")
        ),
    )
)  # fmt: skip
