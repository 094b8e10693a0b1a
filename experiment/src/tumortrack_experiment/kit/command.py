"""`phantom-kit`: everything to print and to mix for one case."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import say, say_notes
from tumortrack.core import store
from tumortrack.core.errors import InputError, TumortrackError

if TYPE_CHECKING:
    from tumortrack_experiment.kit.design import Design

_WORSE = ("good", "look", "FAILS")


def _say_step(what: str) -> None:
    say(f"  {what} ...")


@dataclass(frozen=True, kw_only=True)
class PhantomKit:
    """Make the parts that cast a case as a phantom and squeeze it on a bench.

    Attributes:
        case: folder that `prepare` wrote.
        out: folder to write: kit.json, an STL a part, kit.3mf, checks.json and sheet.html.
        states: to be imposed: D1, D2, D3 (midsection pressed by 4, 8, 12 mm), P1 (a rod pressed in
            by 10 mm), T2 to T25 (base tilted by so many degrees).
        bed: the printer's, X Y Z in mm; larger parts of molds are split.
        bead_mm: diameter of the beads of glass, ceramic or steel.
        beads: how many.
        wall: of the molds, mm.
        pva: percent by weight of polyvinyl alcohol in the hydrogel.
        cycles: of freezing and thawing.
        overwrite: replace OUT if it exists.
    """

    case: Positional[Path]
    out: Positional[Path]
    states: tuple[str, ...] = ("D1", "D2", "D3", "P1")
    bed: tuple[float, float, float] = (220.0, 220.0, 250.0)
    bead_mm: float = 6.0
    beads: int = 7
    wall: float = 5.0
    pva: float = 10.0
    cycles: int = 1
    overwrite: bool = False

    def run(self) -> None:
        from tumortrack import api
        from tumortrack_experiment.kit.base import BaseConfig
        from tumortrack_experiment.kit.design import design_kit
        from tumortrack_experiment.kit.folder import write_kit
        from tumortrack_experiment.kit.mold import MoldConfig
        from tumortrack_experiment.kit.recipe import Mix

        store.check_place(self.out, "kit", self.overwrite)
        if not all(30 <= side <= 2000 for side in self.bed):
            raise InputError(f"--bed {self.bed}: each side must be 30 to 2000 mm.")
        base = BaseConfig(
            states=self.states, bead_mm=self.bead_mm, beads=self.beads, bed_mm=self.bed[:2]
        )
        mold = MoldConfig(wall_mm=self.wall, bed_mm=self.bed)
        mix = Mix(pva_percent=self.pva, cycles=self.cycles)
        say(f"designing the kit of {self.case}; usually half a minute ...")
        case = api.load_case(self.case)
        if not case.anatomy.tumors:
            raise InputError(
                f"{self.case} has no tumor, so its phantom would have nothing to locate. Prepare "
                "it from a scan or labels with one."
            )
        digest = store.sha256_of(self.case / store.MANIFEST)
        made = design_kit(case.anatomy, case.up_lps, base, mold, mix, _say_step)
        with store.new_folder(self.out, self.overwrite) as aside:
            _say_step("files and the sheet")
            write_kit(made, aside, digest, f"{self.case.resolve().name} ({case.patient})")
        self._report(made)

    def _report(self, made: Design) -> None:
        for where in dict.fromkeys(check.where for check in made.checks):
            rows = [check for check in made.checks if check.where == where]
            numbers = ", ".join(f"{row.what}: {row.number}" for row in rows)
            say(f"{max((row.verdict for row in rows), key=_WORSE.index):5} {where}: {numbers}")
        say(f"{len(made.parts)} parts, written to {self.out}; print {self.out / 'sheet.html'}.")
        texts: dict[str, list[str]] = {verdict: [] for verdict in _WORSE}
        for row in made.checks:
            wanted = f"wanted: {row.limits}" if row.limits else "no limit"
            texts[row.verdict].append(f"{row.where}: {row.what}: {row.number} ({wanted})")
        say_notes(texts["look"])
        if texts["FAILS"]:
            raise TumortrackError(f"this kit cannot be used as it is. {'; '.join(texts['FAILS'])}.")
