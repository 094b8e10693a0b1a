"""The groups of rows that `tumortrack bench` measures."""

from __future__ import annotations

from collections.abc import Iterator
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # with PyTorch, whose threads are settled when it is imported
    from tumortrack_lab.bench.rows import Workload
    from tumortrack_lab.bench.subject import BenchSubject

PRESETS = ("clinic", "quick", "paper")


class Group(NamedTuple):
    """Workloads measured together: module of this package and function that yields them; for how
    long each is measured (about; in a hurry); presets whose trained models they need."""

    source: str
    seconds: float
    quick_s: float
    needs: tuple[str, ...] = ()

    def workloads(self, subject: BenchSubject, seconds: float) -> Iterator[Workload]:
        return resolve_name(f"tumortrack_lab.bench.{self.source}")(subject, seconds)


# Training comes last: it tells the C library to keep freed memory, which stays so.
GROUPS: dict[str, Group] = {
    "generator": Group("training:drags", 3.0, 0.7),
    "elastic-generator": Group("training:elastic", 3.0, 0.7, ("clinic",)),
    "frame": Group("subject:frames", 4.0, 1.4, PRESETS),
    "tracking": Group("subject:tracking", 3.0, 0.7, PRESETS),
    "volume": Group("subject:volumes", 6.0, 2.0, PRESETS),
    "command": Group("command:workloads", 4.2, 1.0, PRESETS),
    "planning": Group("planning:workloads", 3.0, 0.7),
    "training": Group("training:steps", 5.0, 1.0, ("clinic",)),
    "whole-training": Group("training:whole", 20.0, 12.0),
    "gpu": Group("training:on_gpu", 10.0, 3.4, PRESETS),
}
