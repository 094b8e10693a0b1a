"""Measures all that the pages claim, with today's method: every table and picture.

    make figures           (by estimate 45 minutes on two cores; scenes before that, an hour)
    make figures ARGS='noise following'        these steps alone
    make figures ARGS='--data DATA'            also your copies of KiTS19 (see population.py)

A step is kept if its tables are of today's method and of its present command. Scenes and rows lie
in runs/figures/KEY, where KEY is that of the code that makes scenes; the same command goes on where
it was stopped. At last the pages are filled (`make pages`).

Not measured here: `make paper`, whose models are trained for hours, and what needs other programs.
"""

from __future__ import annotations

import runpy
import shlex
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from tumortrack.assessment.bound import shipped
from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.cli.console import say
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack_benchmarks import physics, scripting
from tumortrack_benchmarks.cli.bench import Bench
from tumortrack_benchmarks.document import MeasuredTable
from tumortrack_benchmarks.physics.scenes import random_case

ROOT = Path(__file__).parents[2]
FIRST = scripting.KidneyOptions.first
_MEASURING = {"cut", "evidence"}  # modules of ``physics`` that make no scenes
_PLANNED = FIRST, FIRST + 1  # kidneys in which plans are made
_PLANS = "{{out}}/{0}/case {{out}}/{0}/scenes --seed {0} --plans {{out}}/{0}/case {{sizes}}"


class Step(NamedTuple):
    """Named as its script, perhaps with more behind a dash. ``sizes``, or of the miniature
    ``tiny``, goes into the ``calls``, of which the last one writes tables beside the page."""

    page: str
    sizes: str
    tiny: str
    calls: tuple[str, ...] = ("{out} {sizes} --document {page}",)


_TINY, _CUT = "--kidneys 2", "--organs 1 --looks 1"
STEPS = {
    # Those that the bounds in the package were learned from: `make bounds` with --write, in the
    # same folder, leaves the rows. 95 % of a family's 400 parts lie within: 93 to 97.
    "bounds": Step(
        "docs/trust.md", "--kidneys 9 --others 1 --advice 2 --states 40 --other-states 24",
        f"--kidneys 2 --others 0 --advice 1 --states 4 --first {FIRST}",
    ),
    # 750 tumors in scenes, some 200 of them in good answers: if none of these is over 5 mm off, the
    # share is under 2 % (95 %).
    "accuracy": Step("docs/results.md", "--kidneys 12 --states 32", f"{_TINY} --states 4"),
    # 60 scenes, the same for every kind of evidence: medians, and shares to 12 points.
    "evidence": Step("docs/evidence.md", "--kidneys 4 --states 16", f"{_TINY} --states 1"),
    # 48 images a condition: shares to 12 points, as the table's intervals say. The page names
    # conditions, so that a miniature needs all.
    "noise": Step("docs/index.md", "--kidneys 4 --count 12", "--kidneys 1 --count 1"),
    # 30 answers a row: what is so in all of them is so in 89 % (95 %).
    "ultrasound": Step("docs/evidence.md", "--kidneys 2 --count 15", "--kidneys 1 --count 1"),
    # 20 jumps: if each is caught up with, 84 % are (95 %). 1,440 frames of each kind.
    "following": Step("docs/results.md", "--kidneys 4 --seconds 12", "--kidneys 1 --seconds 2.5"),
    # 60 scenes, some 20 with a good answer: what is so in all of these is so in 84 % (95 %).
    "stress": Step(
        "docs/results.md", "--count 32", "--count 2",
        (_PLANS.format(_PLANNED[0]), _PLANS.format(_PLANNED[1])
         + f" --beside {{out}}/{_PLANNED[0]}/scenes --document {{page}}"),
    ),
    # 160 scenes, 40 a state: medians, and shares to 15 points.
    "cut": Step(
        "docs/results.md", "--organs 7", f"{_CUT} --states 2",
        ("{out}/cut {sizes} --document {page}",),
    ),
    # 250 frames after each kind of telling: medians.
    "cut-sequence": Step(
        "docs/results.md", "--organs 3", f"{_CUT} --states 3",
        ("{out}/cut-sequence {sizes} --plan sequence --document {page}",),
    ),
    # Medians of 3 to 25 turns, with their spread. Not beside other work.
    "speed": Step(
        "docs/results.md", "", "--only tracking --quick",
        ("{sizes} --out {out}/bench.json --document {page}",),
    ),
    # Some 100 good answers: if none is over 5 mm off, the share is under 4 % (95 %).
    "population": Step(
        "docs/results.md", "--count 12", "--count 1",
        ("DATA {out}/population {sizes} --document {page}",),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Measure what is missing, or of another method, and fill the pages."""

    steps: tyro.conf.Positional[tuple[str, ...]] = ()
    """Which; default: all, the population with --data alone."""
    data: Path | None = None
    """Folder of your copies of KiTS19: also the population, a dozen of it."""
    all: bool = False
    """The whole population."""
    again: bool = False
    """Also what is of today."""
    miniature: Path | None = None
    """A few scenes for every step, in this folder with a copy of the pages: does all still work?"""


def main(options: Options) -> None:
    """Raises TumortrackError: a step failed, or a page or table is not as it must be."""
    steps = scripting.known(options.steps or [*STEPS], STEPS)
    if options.data is None:
        if "population" in options.steps:
            raise InputError("the population is of your copies of KiTS19; give --data DATA.")
        steps = [name for name in steps if name != "population"]
    tiny, scenes = options.miniature, Path(physics.__path__[0]).glob("*.py")
    key = scripting.code_sha256(path for path in scenes if path.stem not in _MEASURING)[:8]
    out = (tiny or Path("runs")) / "figures" / key
    if tiny is not None:
        shutil.copytree(ROOT / "docs", tiny / "docs", dirs_exist_ok=True)
    if (of := shipped().fingerprint) != fingerprint():
        raise InputError(
            f"the package's bounds are of method {of}, and this is {fingerprint()}. Learn them: "
            f"make bounds ARGS='{out} --write src/tumortrack/assessment/bounds.json'"
        )
    wrong = list[str]()
    for name in steps:
        begun_s = time.monotonic()
        try:
            measured = _measure(name, out, options)
        except TumortrackError as error:
            wrong.append(f"{name}: {error}")
        else:
            say(f"{name}: {time.monotonic() - begun_s:.0f} s" if measured else f"{name}: of today")
    pages: Callable[..., list[str]] = runpy.run_path(str(ROOT / "tools/figures.py"))["faults"]
    wrong += pages(ROOT, check=tiny is not None)
    if wrong:
        raise TumortrackError("\n".join(["not all is measured:", *wrong]))


def _measure(name: str, out: Path, options: Options) -> bool:
    """False: the tables are of today. Raises TumortrackError: it failed, or wrote no table, or of
    a miniature one with other columns than that of the pages has."""
    step, script, tiny = STEPS[name], name.split("-")[0], options.miniature
    page = (tiny or Path()) / step.page
    sizes = step.tiny if tiny else "" if options.all and name == "population" else step.sizes
    calls = [shlex.split(call.format(out=out, sizes=sizes, page=page)) for call in step.calls]
    command = scripting.command_of(script, calls[-1])
    command = f"tumortrack bench {sizes}".strip() if name == "speed" else command
    before = _tables(page.parent, command).values()
    if (
        before
        and not options.again
        and {each.about.get("fingerprint") for each in before} == {fingerprint()}
    ):
        return False
    for number in _PLANNED if name == "stress" else ():
        random_case(out / str(number), number)
    for words in calls:
        sys.argv = [script, *(str(options.data) if word == "DATA" else word for word in words)]
        if name == "speed":
            tyro.cli(Bench).run()
        else:
            module: Any = import_module(script)
            module.main(tyro.cli(module.Options))
    if not (made := _tables(page.parent, command)):
        raise TumortrackError(f"{command} wrote no table beside {page}.")
    for path, table in made.items():
        shown = ROOT / "docs/data" / path.name
        if shown.is_file() and MeasuredTable.read(shown).header != table.header:
            raise TumortrackError(f"{path.name} has other columns in the pages: make figures")
    return True


def _tables(docs: Path, command: str) -> dict[Path, MeasuredTable]:
    """Those that this command wrote."""
    read = {path: MeasuredTable.read(path) for path in sorted((docs / "data").glob("*.csv"))}
    return {path: table for path, table in read.items() if table.about.get("command") == command}


if __name__ == "__main__":
    scripting.run(main, Options)
