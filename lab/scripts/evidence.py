"""Measure what evidence beside the cloud brings: touches, outlines, landmarks, a held tumor.

    make evidence ARGS='OUT --kidneys 4 --seed 1'     (about 10 minutes on two cores)

Makes random kidneys, their models and scenes in OUT, as `make bounds` does, draws evidence of each
scene from its truth with the errors of tools, calibrations and hands, and locates it with and
without. --twin: a folder with cases/NAME and scenes/NAME (`tumortrack twin`), measured beside them.
Prints tables, or fills in a document's block. The same command goes on where it was stopped; after
a change of the method everything is measured again. No patient's anatomy is in it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import tyro

import tumortrack as tt
import tumortrack_lab
from tumortrack.cli.console import model_folder, say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.process import available_cores
from tumortrack.simulate.scene_folder import read_scene
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.study import evidence, evidence_tables, scripts
from tumortrack_lab.study.document import table_of
from tumortrack_lab.study.methods import code_sha256
from tumortrack_lab.world.made import scenes_of

_BLOCK = "evidence"
# Of errors, in the document.
_SHOWN = ["kind", "good %", "median, mm", "95 %", "worst", "rigid fit: median", "its 95 %, mm"]
_KINDS = (
    "none", "3 touches, chosen", "6 touches, chosen", "12 touches, chosen", "12 touches, random",
    "1 outline", "12 touches, chosen, and 1 outline", "held tumor", "40 % hidden: none",
    "40 % hidden: 6 touches, chosen",
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Measure what evidence brings."""

    out: tyro.conf.Positional[Path]
    """Folder of kidneys, scenes and rows."""
    kidneys: int = 4
    """So many."""
    first: int | None = None
    """Number of the first kidney; default: 1000 times the seed."""
    states: int = 24
    """Of each; families take turns."""
    seed: int = 1
    """Of everything."""
    twin: Path | None = None
    """A folder with cases/NAME and scenes/NAME."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""


class Organ(NamedTuple):
    """One to measure, and another whose model it is mistaken for."""

    number: int
    case: Path
    other: Path
    scenes: tuple[Path, ...]
    rows: Path


def main(options: Options) -> None:
    """Make what is missing, then measure."""
    writer = scripts.begun("evidence", options.document)
    first = 1000 * options.seed if options.first is None else options.first
    numbers = range(first, first + options.kidneys)
    options.out.mkdir(parents=True, exist_ok=True)
    twins = () if options.twin is None else _twins(options.twin, options.out)
    with ProcessPoolExecutor(available_cores(), get_context("spawn")) as pool:
        made = {n: pool.submit(scenes_of, options.out / str(n), n, options.states) for n in numbers}
        _wait(made, "made")
        cases = [options.out / str(n) / "case" for n in numbers]
        organs = [
            Organ(n, case, other, tuple(made[n].result()), _rows(case.parent, options.states))
            for n, case, other in zip(numbers, cases, _next(cases), strict=True)
        ]
        _wait({each.case.parent.name: pool.submit(_measure, each) for each in organs}, "measured")
        _wait({each.case.name: pool.submit(_measure, each) for each in twins}, "measured")
    sets = {"random kidneys": organs, "twin": twins}
    frames = {name: _read(some) for name, some in sets.items() if some}
    blocks = [block for name, rows in frames.items() for block in _tables(name, rows)]
    for _, words, table in blocks:
        print(words, table_of(table), sep="\n\n", end="\n\n")
    if options.document is not None:
        _, _, errors = blocks[0]
        some = errors.loc[errors.kind.isin(_KINDS), _SHOWN]
        evidence_tables.draw(next(iter(frames.values())), writer.image(_BLOCK))
        each = pd.concat([_by_family(name, rows) for name, rows in frames.items()])
        tables = {f"{_BLOCK}-{file}": table for file, _, table in blocks}
        scenes = sum(len(organ.scenes) for organ in (*organs, *twins))
        sample = f"{len(organs) + len(twins)} organs, {scenes} scenes"
        writer.tables({_BLOCK: some, f"{_BLOCK}-families": each, **tables}, sample=sample)


def _tables(name: str, rows: pd.DataFrame) -> Iterable[tuple[str, str, pd.DataFrame]]:
    """Each with a name for a file and its title."""
    file = name.split()[-1]
    scenes = len(rows[["kidney", "scene"]].drop_duplicates())
    of = f"{rows.kidney.nunique()} organs, {scenes} scenes"
    yield f"{file}-errors", f"{name}, {of}: errors of centres", evidence_tables.errors(rows)
    if name == "twin":
        own = rows[rows.organ == "own"]
        for site, some in own.groupby("site"):
            yield f"{file}-{site}", f"{name}, {site} tumors", evidence_tables.errors(some)
    yield f"{file}-advice", f"{name}: what advice foresees", evidence_tables.foresight(rows)
    yield f"{file}-verdicts", f"{name}: called good", evidence_tables.verdicts(rows)


def _by_family(name: str, rows: pd.DataFrame) -> pd.DataFrame:
    families = rows[rows.organ == "own"].groupby("family")
    tables = [evidence_tables.errors(some).assign(family=family) for family, some in families]
    each = pd.concat(tables).assign(organs=name)
    return each[["organs", "family", *(c for c in each if c not in ("organs", "family"))]]


def _twins(folder: Path, out: Path) -> Sequence[Organ]:
    cases = sorted(path for path in (folder / "cases").glob("*") if path.is_dir())
    if not cases:
        raise InputError(f"{folder} has no cases/NAME; give a folder of twins with their scenes.")
    organs = []
    for number, (case, other) in enumerate(zip(cases, _next(cases), strict=True)):
        scenes = tuple(sorted((folder / "scenes" / case.name).glob("*-noise")))
        rows = out / f"twin-{case.name}"
        rows.mkdir(exist_ok=True)
        organs.append(Organ(number, case, other, scenes, _rows(rows, len(scenes))))
    return organs


def _next(cases: list[Path]) -> list[Path]:
    return [*cases[1:], *cases[:1]]


def _rows(folder: Path, states: int) -> Path:
    """Rows are of one version of the method and of how evidence is drawn, and of so many states."""
    drawn = code_sha256(Path(tumortrack_lab.__path__[0]).glob("*/evidence.py"))
    return folder / f"evidence-{fingerprint()}-{drawn[:8]}-{states}.jsonl"


def _measure(organ: Organ) -> int:
    """Write an organ's rows; how many scenes it has."""
    if not organ.rows.exists():
        trackers = _tracker(organ.case), _tracker(organ.other)
        scenes = ((path.name, read_scene(path)) for path in organ.scenes)
        rows = pd.DataFrame(evidence.all_rows(trackers, scenes, organ.number))
        text = rows.to_json(orient="records", lines=True)
        store.write_atomically(organ.rows, text.encode())
    return len(organ.scenes)


def _tracker(case: Path) -> Tracker:
    return Tracker(tt.load_model(model_folder(case), "cpu"))


def _read(organs: Sequence[Organ]) -> pd.DataFrame:
    frames = [pd.read_json(organ.rows, lines=True) for organ in organs]
    return pd.concat(frames, ignore_index=True)


def _wait(jobs: dict[Any, Future], what: str) -> None:
    start, names = time.monotonic(), {job: name for name, job in jobs.items()}
    for done, job in enumerate(as_completed(names), start=1):
        left_min = (time.monotonic() - start) / done * (len(jobs) - done) / 60
        job.result()
        say(f"{done}/{len(jobs)} {names[job]} {what}: {left_min:.0f} min left")


if __name__ == "__main__":
    scripts.run(main, Options)
