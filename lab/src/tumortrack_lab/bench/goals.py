"""What was aimed at, and what this machine measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tumortrack_lab.bench import command, figures, frames, generator, training, volume
from tumortrack_lab.bench.machine import NO_GPU
from tumortrack_lab.bench.row import BenchResult, BenchRow
from tumortrack_lab.study.markdown import table

_NO_GPU = "no GPU was at hand"
_NOT_MEASURED = "not measured in this run"
_GIB = 2**30


@dataclass(frozen=True)
class Verdict:
    """What was measured, in words, and whether that is enough; None: nobody knows."""

    measured: str
    met: bool | None


Judge = Callable[[BenchResult], Verdict]


@dataclass(frozen=True)
class SpeedGoal:
    figure: str
    paper: str
    goal: str
    judge: Judge


def goals_table(bench: BenchResult) -> str:
    """Figure, the paper's or the naive value, the goal, measured, met."""
    rows = []
    for goal in GOALS:
        verdict = goal.judge(bench)
        met = {True: "yes", False: "no", None: ""}[verdict.met]
        rows.append((goal.figure, goal.paper, goal.goal, verdict.measured, met))
    return table(("figure", "paper / naive", "goal", "measured here", "met"), rows, left=4)


def _row(name: str, what: str, threads: int, judge: Callable[[BenchRow], Verdict]) -> Judge:
    def judged(bench: BenchResult) -> Verdict:
        row = bench.find(name, what, threads)
        return Verdict(_NOT_MEASURED, None) if row is None else judge(row)

    return judged


def _at_most(limit_s: float) -> Callable[[BenchRow], Verdict]:
    def judge(row: BenchRow) -> Verdict:
        return Verdict(figures.seconds(row.ours.median_s), row.ours.median_s <= limit_s)

    return judge


def _at_least_per_s(least: float) -> Callable[[BenchRow], Verdict]:
    return lambda row: Verdict(f"{row.per_s:,.0f}/s", row.per_s >= least)


def _faster_and_equal(times: float, equal: float) -> Callable[[BenchRow], Verdict]:
    def judge(row: BenchRow) -> Verdict:
        assert row.ratio is not None
        assert row.agreement is not None
        assert row.naive is not None
        words = (
            f"{figures.ratio(row.ratio)} ({figures.seconds(row.ours.median_s)}, naive "
            f"{figures.seconds(row.naive.median_s)}), {figures.agreement(row.agreement)} equal"
        )
        return Verdict(words, row.ratio >= times and row.agreement >= equal)

    return judge


def _faster_within(times: float, limit_s: float) -> Callable[[BenchRow], Verdict]:
    def judge(row: BenchRow) -> Verdict:
        assert row.ratio is not None
        words = f"{figures.seconds(row.ours.median_s)}, {figures.ratio(row.ratio)}"
        return Verdict(words, row.ratio >= times and row.ours.median_s <= limit_s)

    return judge


def _started(row: BenchRow) -> Verdict:
    before = row.others[command.BEFORE_TORCH]
    words = f"{figures.seconds(row.ours.median_s)}, {figures.seconds(before)} of it before torch"
    return Verdict(words, row.ours.median_s < 3 and before < 1)


def _held(row: BenchRow) -> Verdict:
    peak = row.others[command.PEAK]
    if not peak:  # this system does not count it
        return Verdict("not measured", None)
    return Verdict(f"{peak / _GIB:.2f} GiB", peak < 4 * 1e9)


def _on_gpu(name: str, what: str, judge: Callable[[BenchRow], Verdict]) -> Judge:
    def judged(bench: BenchResult) -> Verdict:
        gpu = bench.machine.get("GPU", NO_GPU)
        for row in bench.rows:
            if (row.name, row.what) == (name, what) and row.device != "cpu":
                verdict = judge(row)
                return Verdict(f"{verdict.measured} on {gpu}", verdict.met)
        return Verdict(_NO_GPU if gpu == NO_GPU else _NOT_MEASURED, None)

    return judged


GOALS = (
    SpeedGoal(
        "frame (1,000 points, 40,000 queries), `paper`, 2 CPU cores",
        "naive fp32, same run",
        "at least 25 x faster, at least 99.8 % of labels equal",
        _row(frames.FRAME, "paper", 2, _faster_and_equal(25.0, 0.998)),
    ),
    SpeedGoal(
        "frame, `clinic` (the default), 2 CPU cores",
        "14 ms on an RTX 4090",
        "at most 14 ms (with AMX)",
        _row(frames.FRAME, "clinic", 2, _at_most(0.014)),
    ),
    SpeedGoal(
        "tracking frame, `clinic`, 2 CPU cores",
        "",
        "at most 5 ms",
        _row(frames.TRACKING, "clinic", 2, _at_most(0.005)),
    ),
    SpeedGoal(
        "frame, `paper`, H100",
        "(14 ms on an RTX 4090)",
        "at most 1 ms",
        _on_gpu(frames.FRAME, "paper", _at_most(0.001)),
    ),
    SpeedGoal(
        "400^3 labels, exact, `paper`, 2 CPU cores",
        "dense, same run",
        "at least 50 x faster, at most 1.4 s",
        _row(volume.NAME, "paper", 2, _faster_within(50.0, 1.4)),
    ),
    SpeedGoal(
        "400^3 labels, exact, `clinic`, 2 CPU cores",
        "dense, same run",
        "at least 50 x faster, at most 0.3 s",
        _row(volume.NAME, "clinic", 2, _faster_within(50.0, 0.3)),
    ),
    SpeedGoal(
        "400^3 labels, exact, `paper`, H100",
        "dense, same run",
        "at most 10 ms",
        _on_gpu(volume.NAME, "paper", _at_most(0.01)),
    ),
    SpeedGoal(
        "training, `paper`, H100",
        "861 samples/s on an RTX 4090 (2 h)",
        "at least 10,000 samples/s",
        _on_gpu(training.WHOLE, "paper", _at_least_per_s(10_000.0)),
    ),
    SpeedGoal(
        "training, `quick`, 2 CPU cores, generator included",
        "",
        "at least 300 samples/s",
        _row(training.WHOLE, "quick", 2, _at_least_per_s(300.0)),
    ),
    *(
        SpeedGoal(
            f"generator, {what}, one core, 424 x 240 depth and 2,000 labels",
            "Open3D + NumPy: 15/s",
            "at least 250/s",
            _row(generator.NAME, what, 1, _at_least_per_s(250.0)),
        )
        for what in ("drags", "elastic")
    ),
    SpeedGoal(
        "start of `tumortrack locate` to answer, warm disk, `clinic`",
        "",
        "under 3 s, under 1 s of it before torch",
        _row(command.NAME, "clinic", 2, _started),
    ),
    *(
        SpeedGoal(
            f"memory of `tumortrack locate --grid 400`, `{preset}`",
            "",
            "under 4 GB, everything included",
            _row(command.LARGE, preset, 2, _held),
        )
        for preset in ("clinic", "quick")
    ),
)
