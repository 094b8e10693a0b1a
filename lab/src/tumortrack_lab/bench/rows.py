"""Workloads, and the rows that become of them: what was done, how long it took, what it has to
take at least."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import msgspec

from tumortrack.core.config import Config
from tumortrack_lab.bench.timing import Call, InterleavedTiming, interleaved

PRESETS = ("clinic", "quick", "paper")
# What rows are called.
GENERATOR, ENCODER, DECODER = "generator", "encoder", "decoder"
FRAME, EVERY, TRACKING = "frame", "frame, every query asked", "tracking frame"
VOLUME, COMMAND, LARGE = "400^3 labels", "`locate` command", "`locate --grid 400` command"
PLAN, MOTIONS, STEP, TRAINING = "plan", "motions", "training step", "training, generator included"
BEFORE_TORCH, PEAK = "seconds before torch is imported", "peak bytes"  # among ``others``

Precision = Literal["fp32", "bf16", "int8"]


class Work(Config, frozen=True):
    """What cannot be left out of one call: arithmetic, and bytes that have to be moved once."""

    flops: float
    bytes: float
    precision: Precision = "fp32"


class BenchRow(Config, frozen=True):
    """One measured part.

    ``item`` is what a call makes: a pair, a frame; ``per_call``: how many of them. ``naive`` is the
    plain form's time for the same, ``naive_is`` says what it is, ``naive_work`` its arithmetic.
    ``agreement``: share of labels equal to the naive form's in single precision. ``others``: other
    figures, by name (seconds, bytes, shares).
    """

    name: str
    what: str
    threads: int
    item: str
    ours: InterleavedTiming
    naive: InterleavedTiming | None = None
    naive_is: str = ""
    work: Work | None = None
    naive_work: Work | None = None
    per_call: int = 1
    agreement: float | None = None
    others: dict[str, float] = msgspec.field(default_factory=dict)
    note: str = ""
    device: str = "cpu"

    @property
    def ratio(self) -> float | None:
        """How many times faster than the naive form."""
        return None if self.naive is None else self.naive.median_s / self.ours.median_s

    @property
    def per_s(self) -> float:
        """Items a second."""
        return self.per_call / self.ours.median_s


@dataclass(eq=False)
class Workload:
    """What becomes a row: our form and the naive one, each a call or what it took.

    ``calls``: how many items one call of ours makes; ``naive_share``: how many times the naive
    form's part the whole work is; ``facts``: the row's other fields, asked for once it is timed;
    ``beside``: other forms of ours, timed in the same turns and beside the same naive form.
    ``naive`` holds the seconds once they are known.
    """

    name: str
    what: str
    item: str
    ours: Call | InterleavedTiming
    naive: Call | InterleavedTiming | None = None
    naive_is: str = ""
    calls: int = 1
    naive_share: float = 1.0
    facts: Callable[[], dict[str, Any]] = dict
    beside: tuple[Workload, ...] = ()

    def rows(self, threads: int, budget_s: float) -> Iterator[BenchRow]:
        """Time all forms in turns."""
        forms = (self, *self.beside)
        calls = [call for call in (*(f.ours for f in forms), self.naive) if callable(call)]
        timed: dict[object, Any] = dict(
            zip(calls, interleaved(*calls, budget_s=budget_s), strict=True)
        )
        self.naive = timed.get(self.naive, self.naive)
        for form in forms:
            ours = timed.get(form.ours, form.ours)
            yield BenchRow(
                name=form.name,
                what=form.what,
                threads=threads,
                item=form.item,
                ours=ours.times(1 / form.calls),
                naive=self.naive and self.naive.times(self.naive_share),
                naive_is=self.naive_is,
                **form.facts(),
            )


class Peaks(Config, frozen=True):
    """What the machine reaches with so many threads: matrix products by precision (FLOP/s; absent:
    not offered) and memory (bytes/s)."""

    threads: int
    gemm: dict[str, float]
    triad: float

    def floor_s(self, work: Work) -> float:
        """The least time: arithmetic at the measured rate or bytes at the measured bandwidth,
        whichever takes longer."""
        return max(work.flops / self.rate(work.precision), work.bytes / self.triad)

    def rate(self, precision: Precision) -> float:
        """FLOP/s of matrix products; single precision's where the other is not offered."""
        return self.gemm.get(precision, self.gemm["fp32"])


class Point(Config, frozen=True):
    """A point of a curve: time of one call and the process's peak memory meanwhile."""

    curve: str  # against what: queries, points, ...
    what: str
    size: int
    seconds: float
    peak_bytes: int | None
    working_bytes: int | None = None  # of the peak, what was not held before the call


class BenchResult(Config, frozen=True):
    """All that was measured in one run, and on what."""

    machine: dict[str, str]
    command: str
    peaks: tuple[Peaks, ...] = ()
    rows: tuple[BenchRow, ...] = ()
    points: tuple[Point, ...] = ()

    def find(self, name: str, what: str, threads: int) -> BenchRow | None:
        """The row of this name, if it was measured on the CPU."""
        for row in self.rows:
            if (row.name, row.what, row.threads, row.device) == (name, what, threads, "cpu"):
                return row
        return None

    def peaks_for(self, row: BenchRow) -> Peaks | None:
        """Of as many threads as the row was measured with; none for other devices."""
        fitting = (peaks for peaks in self.peaks if peaks.threads == row.threads)
        return next(fitting, None) if row.device == "cpu" else None
