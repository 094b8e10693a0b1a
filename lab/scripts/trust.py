"""How far margins can be trusted: random kidneys, calibrated without each one and each family.

    make trust ARGS='OUT'     (about an hour on two cores)

Makes kidneys and scenes in OUT, as `make misses` does, and locates them as `tumortrack margins`
does, by their clouds alone and with each of the ``--evidence``. Prints tables, or fills in a
document's block and its pictures. The same command goes on where it was stopped. No patient's
anatomy is in it.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import pandas as pd
import tyro

import tumortrack as tt
from tumortrack.cli.console import model_folder, say
from tumortrack.core.process import available_cores
from tumortrack.simulate.scene_folder import read_scene
from tumortrack_lab.cli.margins import located
from tumortrack_lab.margins.calibration import WIDEST_MM, evidence_of, list_states
from tumortrack_lab.study import scripts, trust
from tumortrack_lab.study.document import table_of
from tumortrack_lab.world.made import scenes_of_kidney

BLOCK = "trust"
_ALONE = "clouds alone"


@dataclass(frozen=True)
class Options:
    """Tables and plots of what margins are worth."""

    out: tyro.conf.Positional[Path]
    """Folder of kidneys, scenes and rows."""
    kidneys: tuple[int, ...] = tuple(range(1000, 1012))
    """Their numbers."""
    states: int = 40
    """Of each; families take turns."""
    evidence: tuple[str, ...] = ("touch12", "outline1")
    """As of `tumortrack margins`."""
    document: Path | None = None
    """A page that shows the tables, which go beside it with the pictures."""
    worst: int = 6
    """So many of the worst accepted answers are drawn."""
    widest: float = WIDEST_MM
    """As of `tumortrack margins`."""
    seed: int = 0
    """Of what each state is used for."""


def main(options: Options) -> None:
    """Calibrate on the others, test on what is left out, and write it down."""
    writer = scripts.begun("trust", options.document)
    asked = {_ALONE: {}, **{name: evidence_of(name) for name in options.evidence}}
    options.out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(available_cores(), get_context("spawn")) as pool:
        jobs = [pool.submit(_kidney, options, number, asked) for number in options.kidneys]
        kidneys = []
        for job in jobs:
            kidneys.append(job.result())
            say(f"{len(kidneys)} of {len(jobs)} kidneys located")
    coverages, by_kind = [], {}
    for kind in asked:
        states = pd.concat([kidney[kind] for kidney in kidneys], ignore_index=True)
        by_kind[kind] = {
            part: trust.left_out(states, states[part], options.seed, widest_mm=options.widest)
            for part in ("organ", "family")
        }
        organ = by_kind[kind]["organ"]
        each = {
            **by_kind[kind],
            **{
                f"organ, by {by}": organ.assign(part=organ[by]) for by in ("family", "segmentation")
            },
        }
        coverages.append(trust.coverage(each).assign(evidence=kind))
        say(f"calibrated without each kidney and each family: {kind}")
    coverage = pd.concat(coverages)
    short, ranks = trust.by_family(coverage), trust.ranks(by_kind[_ALONE]["organ"])
    if options.document is None:
        print(*map(table_of, (short, coverage, ranks)), sep="\n\n")
        return
    alone = by_kind[_ALONE]
    pictured = {f"each {part} left out": judged for part, judged in alone.items()}
    trust.reliability_picture(pictured, writer.image("trust_reliability"))
    trust.risk_picture(alone["organ"], writer.image("trust_risk"))
    models = {str(number): _model(options.out, number) for number in options.kidneys}
    image = writer.image("trust_worst")
    worst = trust.worst_picture(alone["organ"], models, options.worst, image)
    sample = f"{len(options.kidneys)} random kidneys"
    tables = {"": short, "-coverage": coverage, "-ranks": ranks, "-worst": worst}
    writer.tables({f"{BLOCK}{name}": table for name, table in tables.items()}, sample=sample)
    say(f"written to {options.document}")


def _model(out: Path, number: int) -> Path:
    return model_folder(out / str(number) / "case")


def _kidney(
    options: Options, number: int, asked: dict[str, dict[str, int]]
) -> dict[str, pd.DataFrame]:
    """A kidney's states by kind of evidence, with the miss of a rigid fit."""
    folder = options.out / str(number)
    folder.mkdir(exist_ok=True)
    made = {*scenes_of_kidney(folder, number, options.states)}
    listed = [
        each for each in list_states([folder / "scenes"], options.seed) if each.folder in made
    ]
    model, table = _model(options.out, number), folder / "margins.jsonl"
    shape = tt.load_model(model, "cpu").shape
    paths = [str(state.folder.resolve()) for state in listed]

    def rigid() -> list[dict]:
        scenes = zip(paths, (read_scene(Path(path)) for path in paths), strict=True)
        return [{"scene": path, "mm": trust.rigid_miss(shape, scene)} for path, scene in scenes]

    known = scripts.kept(folder / "rigid.json", {"scenes": paths}, rigid)
    rigid_mm = {row["scene"]: row["mm"] for row in known}
    frames = {}
    for kind, evidence in asked.items():
        _, rows = located(model, listed, evidence, table, options.seed, "cpu")
        states = trust.states_of(rows).assign(organ=str(number))
        frames[kind] = states.assign(rigid=[rigid_mm[row.scene] for row in rows])
    return frames


if __name__ == "__main__":
    scripts.run(main, Options)
