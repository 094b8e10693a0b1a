"""Learn how far off parts may be, from random organs in all families of the wider world's physics.

    make bounds ARGS='OUT --kidneys 9'     (an hour on two cores)

Makes organs, their models and scenes in OUT, locates each scene with and without evidence, by its
cloud and its depth image, hidden and noisy, and fits ``assessment.bound`` to how far off the parts
are; writes it to ``--write``, with what came of its advice on further kidneys. Prints, or fills in
a document's blocks, what it is worth for organs, families of physics and kinds of evidence that
were left out. The same command goes on where it was stopped. No patient's anatomy is in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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
from tumortrack_lab.study import bounds, scripts
from tumortrack_lab.study.document import share_words, table_of
from tumortrack_lab.study.tables import NOTHING
from tumortrack_lab.world.made import scenes_of

_BLOCK = "bounds"
_FIRST = {"kidney": 1000, "prostate": 2000, "liver": 3000}  # numbers of organs


@dataclass(frozen=True)
class Options:
    """Learn how far off parts may be."""

    out: tyro.conf.Positional[Path]
    """Folder of organs and scenes."""
    kidneys: int = 9
    """So many."""
    others: int = 1
    """Livers, and as many prostates."""
    advice: int = 2
    """Further kidneys, on which advice is tested."""
    states: int = 40
    """Of each kidney; families take turns."""
    other_states: int = 24
    """Of each of the others."""
    write: Path | None = None
    """File for what was learned: src/tumortrack/assessment/bounds.json."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""


def main(options: Options) -> None:
    """Make what is missing, then fit."""
    writer = scripts.begun("bounds", options.document)
    options.out.mkdir(parents=True, exist_ok=True)
    organs = list(_organs(options))
    with ProcessPoolExecutor(available_cores(), get_context("spawn")) as pool:
        jobs = [pool.submit(_organ, options.out, *each) for each in organs]
        with progress_bar("organs", len(jobs)) as advance:
            for job in as_completed(jobs):
                job.result()
                advance()
    rows = _read([_rows_path(options.out, number, states) for _, number, states in organs])
    rows = rows[rows.segmentation_mm <= bounds.READERS_MM]
    organs_out, *others_out = (
        bounds.bounded(rows, part) for part in ("organ", "family", "evidence", "shape")
    )
    ways = (organs_out, "family"), (organs_out, "shape"), *zip(
        others_out, ("family", "evidence", "shape"), strict=True
    )  # fmt: skip
    tables = [bounds.left_out(*way).astype(object).fillna(NOTHING) for way in ways]
    if options.document is not None:
        bounds.draw(organs_out, writer.image("bounds"))
    print(*map(table_of, tables), sep="\n\n")
    named = [table.rename(columns={table.columns[0]: "of"}) for table in tables]
    written = {_BLOCK: pd.concat(named[:2]), f"{_BLOCK}-left-out": pd.concat(named[2:])}
    about = {"organs": len(organs)}
    if options.write is not None:
        store.write_json(options.write, to_builtins(bounds.learned(rows, about)))
        found = _advice_found(options)
        print(table_of(found))
        ratios = dict(zip(found.kind, found["found / foreseen"], strict=True))
        store.write_json(options.write, to_builtins(bounds.learned(rows, about, ratios)))
        written[f"{_BLOCK}-advice"] = found
    sample = f"{len(rows)} parts in answers of {len(organs)} random organs"
    writer.tables(written, sample=sample, interval=f"over 5 mm {_over(tables[0])} of good")


def _advice_found(options: Options) -> pd.DataFrame:
    """What came of advice by the bounds that were just learned, on kidneys that they do not
    know."""
    first = _FIRST["kidney"] + options.kidneys
    with ProcessPoolExecutor(available_cores(), get_context("spawn")) as pool:
        jobs = [
            pool.submit(_advice, options.out, first + n, options.states)
            for n in range(options.advice)
        ]
        return bounds.advice_found(_read([job.result() for job in jobs]))


def _organs(options: Options) -> Iterator[tuple[str, int, int]]:
    """Shape, number and states."""
    for shape, first in _FIRST.items():
        kidney = shape == "kidney"
        count = options.kidneys if kidney else options.others
        states = options.states if kidney else options.other_states
        yield from ((shape, first + n, states) for n in range(count))


def _read(paths: Iterable[Path]) -> pd.DataFrame:
    return pd.concat([pd.read_json(path, lines=True) for path in paths], ignore_index=True)


def _over(short: pd.DataFrame) -> str:
    """Of all good answers."""
    of_all = short.iloc[-1]
    good = round(int(of_all["answers"]) * int(of_all["good %"]) / 100)
    return share_words(int(of_all["center over 5 mm"]), good)


def _rows_path(out: Path, number: int, states: int) -> Path:
    """Rows are of one version of the method, and of so many states."""
    return out / str(number) / f"bounds-{fingerprint()}-{states}.jsonl"


def _organ(out: Path, shape: str, number: int, states: int) -> None:
    """An organ's scenes and rows."""
    folder, rows_path = out / str(number), _rows_path(out, number, states)
    if rows_path.exists():
        return
    scenes = scenes_of(folder, number, states, shape)
    tracker = Tracker(tt.load_model(model_folder(folder / "case"), "cpu"))
    rows = [
        {"shape": shape, "organ": number, "scene": scene.name, **row}
        for seed, scene in enumerate(scenes)
        for row in bounds.rows_of(tracker, read_scene(scene), seed)
    ]
    text = pd.DataFrame(rows).to_json(orient="records", lines=True)
    store.write_atomically(rows_path, text.encode())


def _advice(out: Path, number: int, states: int) -> Path:
    """A kidney's rows of what came of advice; of the bounds that are in the package now."""
    folder = out / str(number)
    rows_path = folder / f"advice-{fingerprint()}-{states}.jsonl"
    if not rows_path.exists():
        scenes = scenes_of(folder, number, states)
        tracker = Tracker(tt.load_model(model_folder(folder / "case"), "cpu"))
        rows = [
            row
            for seed, scene in enumerate(scenes)
            for row in bounds.advice_rows(tracker, read_scene(scene), seed)
        ]
        text = pd.DataFrame(rows).to_json(orient="records", lines=True)
        store.write_atomically(rows_path, text.encode())
    return rows_path


if __name__ == "__main__":
    scripts.run(main, Options)
