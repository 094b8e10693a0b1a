"""`tumortrack twin`: a case -> the scenes of its digital twin, with a bar and the time left."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from tumortrack.cli.console import console, say

if TYPE_CHECKING:
    from tumortrack_lab.twin.views import View

_EVERY_S = 15.0  # between lines where there is no terminal


def write_twin(
    case: Path, scenes: Path, seed: int, variants: Sequence[str], views: Sequence[View]
) -> None:
    """Make what is missing of these variants and views; empty means all.

    Raises:
        InputError: no case, unknown names, or scenes made from something else.
    """
    from tumortrack_lab.twin.dataset import TwinRun, TwinStatus, make_scenes
    from tumortrack_lab.twin.views import VARIANTS, VIEWS

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("twin", total=1.0)
        said = -_EVERY_S

        def show(status: TwinStatus) -> None:
            nonlocal said
            progress.update(task, completed=status.share, description=status.text)
            if not console.is_terminal and time.monotonic() - said >= _EVERY_S:
                say(f"{status.share:.0%} {status.text}")
                said = time.monotonic()

        run = TwinRun(case, seed=seed)
        made = make_scenes(run, scenes, variants or tuple(VARIANTS), views or VIEWS, show)
    say(f"{len(made)} scenes in {scenes}; look at the scene.png in each.")
