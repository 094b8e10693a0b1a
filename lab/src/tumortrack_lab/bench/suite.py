"""Which rows there are, and what a process that measures them says."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tumortrack_lab.bench import command, frames, generator, gpu, halves, planning, training, volume
from tumortrack_lab.bench.row import BenchRow

if TYPE_CHECKING:
    from tumortrack_lab.bench.subject import Subject

Rows = Callable[["Subject", int, float], Iterator[BenchRow]]


@dataclass(frozen=True)
class Group:
    """Rows measured together: at which numbers of threads, for how long each time (seconds, about;
    ``quick_s`` in a hurry), and the presets whose trained models they need."""

    rows: Rows
    threads: tuple[int, ...]
    seconds: float
    quick_s: float
    needs: tuple[str, ...] = ()

    def budget_s(self, quick: bool) -> float:
        return self.quick_s if quick else self.seconds


ALL = ("clinic", "quick", "paper")
# Training comes last: it tells the C library to keep freed memory, which stays so.
GROUPS: dict[str, Group] = {
    "generator": Group(generator.rows, (1,), 3.0, 0.7),
    "elastic-generator": Group(generator.elastic_rows, (1,), 3.0, 0.7, ("clinic",)),
    "encoder": Group(halves.encoder_rows, (1,), 4.0, 1.5, ALL),
    "decoder": Group(halves.decoder_rows, (1,), 12.0, 4.0, ALL),
    "frame": Group(frames.frame_rows, (1, 2), 12.0, 4.0, ALL),
    "tracking": Group(frames.tracking_rows, (1, 2), 9.0, 2.0, ALL),
    "volume": Group(volume.rows, (1, 2), 18.0, 6.0, ALL),
    "command": Group(command.rows, (2,), 25.0, 6.0, ALL),
    "planning": Group(planning.rows, (1,), 9.0, 2.0),
    "training": Group(training.rows, (1,), 15.0, 3.0, ("clinic",)),
    "whole-training": Group(training.whole_rows, (2,), 20.0, 12.0),
    "gpu": Group(gpu.rows, (2,), 60.0, 20.0, ALL),
}
