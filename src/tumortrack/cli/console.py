"""What commands share: lines and bars on the console, devices, and memory that stays."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Literal

from rich.console import Console

from tumortrack.core.process import is_follower

Device = Literal["auto", "cpu", "cuda"]

_EVERY_S = 15.0  # between lines where there is no terminal

# Of one training's processes the first alone speaks.
console = Console(soft_wrap=True, highlight=False, quiet=is_follower())


def say(text: str) -> None:
    """One line, as it is."""
    console.print(text, markup=False)


def say_notes(notes: Iterable[str]) -> None:
    for note in notes:
        say(f"note: {note}")


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar with the time it takes and has left, without a terminal a line now and then; yields a
    function that advances it by one."""
    from rich import progress

    if not console.is_terminal:
        with live_line(what) as show:
            yield _counting(what, total, show)
        return
    columns = (
        progress.TextColumn("{task.description}"),
        *(progress.BarColumn(), progress.MofNCompleteColumn()),
        *(progress.TimeElapsedColumn(), progress.TimeRemainingColumn()),
    )
    with progress.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


def _counting(what: str, total: int, show: Callable[[str], None]) -> Callable[[], None]:
    """Says after each of ``total`` steps how long the others take, but for the first, in which much
    may be compiled."""
    done, first_s = 0, 0.0

    def advance() -> None:
        nonlocal done, first_s
        done, now_s = done + 1, time.monotonic()
        if done == 1:
            first_s = now_s
            show(f"{what}: 1 of {total}")
        else:
            left_s = (now_s - first_s) * (total - done) / (done - 1)
            show(f"{what}: {done} of {total}, about {left_s:.0f} s left")

    return advance


@contextmanager
def live_line(first: str) -> Iterator[Callable[..., None]]:
    """Yields a function of a text, and of whether it is the last: on a terminal it changes one live
    line, elsewhere it prints a line now and then."""
    from rich.status import Status

    spinner, shown_s = Status(first, console=console), -_EVERY_S

    def show(text: str, last: bool = False) -> None:
        nonlocal shown_s
        if console.is_terminal:
            spinner.update(text)
        elif last or time.monotonic() - shown_s >= _EVERY_S:
            say(text)
            shown_s = time.monotonic()

    if console.is_terminal:
        spinner.start()
    try:
        yield show
    finally:
        spinner.stop()


def keep_loaded() -> None:
    """Take what is loaded by now out of garbage collection, once a command has all it needs.

    PyTorch and its kin make objects by the hundred thousand that live to the end of the process.
    The collector would look through them while frames wait, and for half a second at the end.
    Don't call it after modules made by nanobind (manifold3d, ur_analytic_ik) are loaded: they
    report leaks if they are not collected at the end.
    """
    gc.freeze()
