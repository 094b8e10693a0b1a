"""What commands share: lines and progress bars on the console, options, garbage collection."""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from tumortrack.core.errors import InputError
from tumortrack.tracking import options
from tumortrack.tracking.options import Device as Device

if TYPE_CHECKING:
    from tumortrack.report.summary import Table

_EVERY_S = 15.0  # between lines where there is no terminal


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """The reader has gone (`| head`): go on silently, to the command's own exit status."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


console = _Console(soft_wrap=True, highlight=False)


def say(text: str) -> None:
    """Print one line, without markup."""
    console.print(text, markup=False)


def say_json(content: Mapping[str, Any]) -> None:
    """Print JSON with indentation, for programs."""
    print(json.dumps(content, indent=1, allow_nan=False))


def warn(warnings: Iterable[str]) -> None:
    """Print a line each that begins with WARNING, in red where the terminal has colours."""
    for text in warnings:
        console.print(f"WARNING: {text}", style="bold red", markup=False)


def say_notes(notes: Iterable[str]) -> None:
    for note in notes:
        say(f"note: {note}")


def say_table(content: Table) -> None:
    """Print a table in the terminal's width; nothing if it has no rows."""
    from rich.table import Table as Grid

    if not content.rows:
        return
    grid = Grid(title=content.title or None, caption=content.caption or None)
    for n, name in enumerate(content.head):
        grid.add_column(name, no_wrap=n == 0, overflow="fold", justify="left" if n < 3 else "right")
    for row in content.rows:
        grid.add_row(*row)
    console.print(grid)


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[], None]]:
    """Shows progress, speed and the time left; yields a function to call after each of ``total``
    steps. Begin it before slow imports."""
    steps = count(1)
    with progress_of(what, f"{what}: 0 of {total} ...") as show:
        yield lambda: show(next(steps), total)


@contextmanager
def progress_of(what: str, first: str = "") -> Iterator[Callable[..., None]]:
    """The same, but the yielded function takes the number of steps done, and of how many."""
    first_s = 0.0

    with live_line(first or f"{what} ...") as line:

        def show(done: int, total: int) -> None:
            nonlocal first_s
            if done == 1:  # may have included imports and compilation: says nothing of the rate
                first_s = time.monotonic()
                line(f"{what}: 1 of {total}")
                return
            each_s = (time.monotonic() - first_s) / (done - 1)
            minutes, seconds = divmod(round(each_s * (total - done)), 60)
            rate = f"{1 / each_s:.1f} a second" if each_s < 1 else f"{each_s:.1f} s each"
            line(f"{what}: {done} of {total} | {rate} | {minutes}:{seconds:02d} left")

        yield show


def model_folder(given: Path) -> Path:
    """``tracking.options.model_folder``, with a progress bar where a case's model is made."""
    return options.model_folder(given, partial(progress_of, "making the case's model, once"))


def inputs_and_out(
    paths: Sequence[Path], out: Path | None, usage: str
) -> tuple[Sequence[Path], Path]:
    """A command's inputs, and the folder to write. Without --out the last path is that folder, as
    it was once: a note says how to write it now. Raises InputError: nothing is left as an input."""
    if out is not None:
        return paths, out
    *inputs, last = paths
    if not inputs:
        raise InputError(f"say where to write. The order is: tumortrack {usage}")
    print(f"note: {last} is taken for the folder to write: {usage}.", file=sys.stderr)
    return inputs, last


def options_of(command: object, kind: type[Any]) -> dict[str, Any]:
    """Those of a command's options that are fields of ``kind``."""
    return {field.name: getattr(command, field.name) for field in fields(kind)}


@contextmanager
def live_line(first: str) -> Iterator[Callable[..., None]]:
    """Prints ``first`` at once. Yields a function of a text, and of whether it is the last: on a
    terminal it updates one live line, elsewhere it prints a line now and then."""
    from rich.status import Status

    spinner, shown_s = Status(first, console=console), time.monotonic()

    def show(text: str, last: bool = False) -> None:
        nonlocal shown_s
        if console.is_terminal:
            spinner.update(text)
        elif last or time.monotonic() - shown_s >= _EVERY_S:
            say(text)
            shown_s = time.monotonic()

    if console.is_terminal:
        spinner.start()
    else:
        say(first)
    try:
        yield show
    finally:
        spinner.stop()


def keep_loaded() -> None:
    """Exclude what is loaded by now from garbage collection, once a command has all it needs.

    PyTorch and the like create hundreds of thousands of objects that live to the end. Searching
    them would delay frames, and the exit by half a second. Don't call it after modules made by
    nanobind (manifold3d) are loaded: they report leaks if they are not collected at the end.
    """
    gc.freeze()
