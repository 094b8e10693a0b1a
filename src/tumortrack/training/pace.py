"""What every training loop needs besides its steps: time, cores, Ctrl-C, a word on progress."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch

from tumortrack.core.errors import TumortrackError
from tumortrack.core.process import available_cores, keep_freed_memory
from tumortrack.training.checkpoint import TrainingProgress

REPORT_EVERY_S = 5.0
_Item = TypeVar("_Item")
MOST_THREADS = 16  # more only wait for each other in layers this small


@dataclass(frozen=True)
class TrainingStatus:
    """What the loop tells while it runs; ``end`` is None while minutes decide."""

    step: int
    end: int | None
    seconds_left: float
    samples_per_s: float
    loss: float
    miou: float | None  # of the last validation
    note: str = ""  # on how scenes are made, where a user should know
    waiting: float = 0.0  # share of the time that was spent waiting for scenes


class Interrupted(TumortrackError):
    """Ctrl-C: the state is saved, the same command goes on."""

    exit_code = 130

    @classmethod
    def at(cls, step: int, folder: Path) -> Interrupted:
        """After this step of the training in ``folder``."""
        return cls(
            f"stopped at step {step}; the state is saved in {folder}. The same "
            "command goes on from there."
        )


def use_cores(device: torch.device, workers: int, sharing: int = 1) -> None:
    """Give the network the cores that the workers leave, as far as OMP_NUM_THREADS grants them;
    ``sharing`` processes of one training have the machine together."""
    if device.type == "cpu":
        keep_freed_memory()
        granted = os.environ.get("OMP_NUM_THREADS", "")
        most = int(granted) if granted.isdigit() else MOST_THREADS
        torch.set_num_threads(
            max(1, min(most, MOST_THREADS, available_cores() // sharing - workers))
        )


class TrainingClock:
    """Time spent in all sessions of a run, and when things are due again."""

    def __init__(self, progress: TrainingProgress) -> None:
        self._start, self._first_step = time.monotonic(), progress.step
        self._before = progress.elapsed_s
        self._last: dict[str, float] = {}
        self._waited = 0.0

    def waits(self, source: Iterator[_Item]) -> Iterator[_Item]:
        """The same items; how long each is waited for counts."""
        while True:
            began = time.monotonic()
            item = next(source, None)
            self._waited += time.monotonic() - began
            if item is None:
                return
            yield item

    @property
    def waiting(self) -> float:
        """Share of this session's time that was spent waiting."""
        return self._waited / max(time.monotonic() - self._start, 1e-9)

    def elapsed(self) -> float:
        return self._before + time.monotonic() - self._start

    def rate(self, progress: TrainingProgress) -> float:
        """Steps per second in this session."""
        return (progress.step - self._first_step) / max(time.monotonic() - self._start, 1e-9)

    def due(self, what: str, every_s: float) -> bool:
        now = time.monotonic()
        if now - self._last.setdefault(what, self._start) < every_s:
            return False
        self._last[what] = now
        return True


@contextmanager
def ctrl_c() -> Iterator[Callable[[], bool]]:
    """Turns Ctrl-C and SIGTERM into a question that the loop asks after each step."""
    asked: list[int] = []
    before = {
        number: signal.signal(number, lambda received, _: asked.append(received))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(asked)
    except BaseException:
        if "TORCHELASTIC_RUN_ID" in os.environ:
            # torchrun ends the processes that are left; what this one has to say comes first.
            before[signal.SIGTERM] = signal.SIG_IGN
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
