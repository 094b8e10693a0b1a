"""Learn how far off tumors are, from random kidneys in all families of the wider world's physics.

    make misses ARGS='OUT --kidneys 16'     (about half an hour on two cores)

Makes kidneys, their models and scenes in OUT, locates each scene, from its cloud alone and with its
depth image, and fits ``assessment.bound`` to how far off the tumors are; writes it to ``--write``.
Prints, or fills in a document's block, what it is worth for kidneys, and families of physics, that
were left out. The same command goes on where it was stopped. No patient's anatomy is in it.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import pandas as pd
import tyro

import tumortrack as tt
from tumortrack.cli.console import model_folder, progress_bar
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.process import available_cores
from tumortrack.simulate.scene_folder import read_scene
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.margins import misses
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import share_words, table_of
from tumortrack_lab.study.tables import NOTHING
from tumortrack_lab.world.made import scenes_of_kidney

_BLOCK = "misses"


@dataclass(frozen=True)
class Options:
    """Learn how far off tumors are."""

    out: tyro.conf.Positional[Path]
    """Folder of kidneys and scenes."""
    kidneys: int = 16
    """So many."""
    states: int = 40
    """Of each; families take turns."""
    seed: int = 1
    """Of everything."""
    write: Path | None = None
    """File for what was learned: src/tumortrack/assessment/misses.json."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""


def main(options: Options) -> None:
    """Make what is missing, then fit."""
    writer = scripts.begun("misses", options.document)
    numbers = range(options.seed * 1000, options.seed * 1000 + options.kidneys)
    options.out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(available_cores(), get_context("spawn")) as pool:
        jobs = [pool.submit(_kidney, options.out, n, options.states) for n in numbers]
        with progress_bar("kidneys", len(jobs)) as advance:
            for job in as_completed(jobs):
                job.result()
                advance()
    rows = pd.concat(
        [pd.read_json(_rows_path(options.out, n, options.states), lines=True) for n in numbers],
        ignore_index=True,
    )
    asked = ({"part": "kidney", "by": "family"}, {"part": "kidney"}, {"part": "family"})
    all_three = [misses.left_out(rows, **each).astype(object).fillna(NOTHING) for each in asked]
    short, tables = all_three[0], all_three[1:]
    print(*map(table_of, all_three), sep="\n\n")
    named = [table.rename(columns={table.columns[0]: "left out"}) for table in tables]
    sample = f"{len(rows)} answers of {len(numbers)} random kidneys"
    written = {_BLOCK: short, f"{_BLOCK}-left-out": pd.concat(named)}
    writer.tables(written, sample=sample, interval=f"over 5 mm {_over(short)} of good")
    about = {"seed": options.seed, "kidneys": len(numbers), "states": options.states}
    learned = misses.learned(rows, about)
    if options.write is not None:
        store.write_json(options.write, to_builtins(learned))


def _over(short: pd.DataFrame) -> str:
    """Of all good answers."""
    of_all = short.iloc[-1]
    good = round(int(of_all["answers"]) * int(of_all["good %"]) / 100)
    return share_words(int(of_all["over 5 mm"]), good)


def _rows_path(out: Path, number: int, states: int) -> Path:
    """Rows are of one version of the method, and of so many states."""
    return out / str(number) / f"misses-{fingerprint()}-{states}.jsonl"


def _kidney(out: Path, number: int, states: int) -> None:
    """A kidney's scenes and rows."""
    folder, rows_path = out / str(number), _rows_path(out, number, states)
    scenes = scenes_of_kidney(folder, number, states)
    if rows_path.exists():
        return
    tracker = Tracker(tt.load_model(model_folder(folder / "case"), "cpu"))
    rows = [
        {"kidney": number, "scene": scene.name, **row}
        for scene in scenes
        for row in misses.rows_of(tracker, read_scene(scene))
    ]
    text = pd.DataFrame(rows).to_json(orient="records", lines=True)
    store.write_atomically(rows_path, text.encode())


if __name__ == "__main__":
    scripts.run(main, Options)
