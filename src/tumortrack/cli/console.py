"""What commands share: lines and bars on the console, devices, and memory that stays."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Literal

from rich.console import Console

from tumortrack.core.process import is_follower

Device = Literal["auto", "cpu", "cuda"]

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
    """A bar with rate and time left; yields a function that advances it by one."""
    from rich import progress

    columns = (
        progress.TextColumn("{task.description}"),
        *(progress.BarColumn(), progress.MofNCompleteColumn()),
        *(progress.TimeElapsedColumn(), progress.TimeRemainingColumn()),
    )
    with progress.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


def keep_loaded() -> None:
    """Take what is loaded by now out of garbage collection, once a command has all it needs.

    PyTorch and its kin make objects by the hundred thousand that live to the end of the process.
    The collector would look through them while frames wait, and for half a second at the end.
    Don't call it after modules made by nanobind (manifold3d, ur_analytic_ik) are loaded: they
    report leaks if they are not collected at the end.
    """
    gc.freeze()
