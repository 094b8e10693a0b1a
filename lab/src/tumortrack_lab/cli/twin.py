"""`tumortrack twin`: a case -> the scenes of its digital twin, with a bar and the time left."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from tumortrack.cli.console import console, say

if TYPE_CHECKING:
    from tumortrack_lab.twin.dataset import TwinStatus

_EVERY_S = 15.0  # between lines where there is no terminal


@dataclass(frozen=True, kw_only=True)
class Twin:
    """Squeeze, turn, sink and poke a case by finite elements, and write the scenes with truth.

    Attributes:
        case: folder that `prepare` wrote.
        scenes: folder to write: what `evaluate` reads. The same command resumes.
        seed: of noise, instruments, background and target points.
        states: which of them; default: all.
        views: which of them; default: all.
    """

    case: Positional[Path]
    scenes: Positional[Path]
    seed: int = 0
    states: tuple[
        Literal["D0", "D1", "D2", "D3", "Rot90", "Rot180", "Rot270", "G1", "P1"], ...
    ] = ()
    views: tuple[Literal["clean", "noise", "shaft", "clutter"], ...] = ()

    def run(self) -> None:
        """Make what is missing of these states and views; empty means all. Raises InputError: no
        case, unknown names, or scenes made from something else."""
        from rich import progress as bars

        from tumortrack_lab.twin.dataset import TwinRun, make_scenes
        from tumortrack_lab.twin.views import VARIANTS, VIEWS

        columns = [*bars.Progress.get_default_columns(), bars.TimeElapsedColumn()]
        columns = [columns[n] for n in (0, 1, 2, 4, 3)]  # the time left stands last
        with bars.Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task("twin", total=1.0)
            shown_s = -_EVERY_S

            def show(status: TwinStatus) -> None:
                nonlocal shown_s
                progress.update(task, completed=status.share, description=status.text)
                if not console.is_terminal and time.monotonic() - shown_s >= _EVERY_S:
                    say(f"{status.share:.0%} {status.text}")
                    shown_s = time.monotonic()

            states: Sequence[str] = self.states or tuple(VARIANTS)
            views = self.views or VIEWS
            made = make_scenes(TwinRun(self.case, seed=self.seed), self.scenes, states, views, show)
        say(f"{len(made)} scenes in {self.scenes}; look at the scene.png in each.")
