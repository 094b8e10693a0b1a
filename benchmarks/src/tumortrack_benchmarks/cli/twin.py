"""`tumortrack twin`: a case -> the scenes of its digital twin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from tumortrack.cli.console import live_line, say


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
        with live_line("starting ...") as report:
            from tumortrack_benchmarks.physics.twin import USUAL, VIEWS, make_scenes

            made = make_scenes(
                self.case, self.scenes, self.states or USUAL, self.views or VIEWS,
                self.seed, report,
            )  # fmt: skip
        say(f"{len(made)} scenes in {self.scenes}; look at the scene.png in each.")
