"""Training as the user sees it: a live line on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time

from rich.status import Status as Spinner

from tumortrack.cli.console import console, say
from tumortrack.core.process import is_follower
from tumortrack.training.distributed import ProcessLost
from tumortrack.training.state import Diverged
from tumortrack.training.train import Interrupted, TrainingStatus

_EVERY_S = 15.0  # between lines where there is no terminal


class TrainingScreen:
    """Shows each status it is given."""

    def __init__(self) -> None:
        self._spinner = Spinner("making labelled points, starting workers ...", console=console)
        self._said = -_EVERY_S
        self._noted = ""

    def __enter__(self) -> TrainingScreen:
        if console.is_terminal:
            self._spinner.start()
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        self._spinner.stop()
        if is_follower() and isinstance(error, Interrupted | Diverged | ProcessLost):
            raise SystemExit(error.exit_code)  # the first process says the same

    def show(self, status: TrainingStatus) -> None:
        if status.note != self._noted:
            say(status.note)
            self._noted = status.note
        text = _line(status)
        if console.is_terminal:
            self._spinner.update(text)
        elif time.monotonic() - self._said >= _EVERY_S or status.step == status.end:
            say(text)
            self._said = time.monotonic()


def _line(status: TrainingStatus) -> str:
    end = f"/{status.end}" if status.end is not None else ""
    miou = "-" if status.miou is None else f"{status.miou:.3f}"
    left = f"{int(status.seconds_left) // 60}:{int(status.seconds_left) % 60:02d}"
    return (
        f"step {status.step}{end} | {status.samples_per_s:.0f} samples/s | loss {status.loss:.4f} "
        f"| validation mIoU {miou} | {left} left | {status.waiting:.0%} waiting for scenes"
    )
