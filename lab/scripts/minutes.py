"""How good a model is after no training, a quarter of a minute, a minute, and a whole training.

    make minutes ARGS='NAME=CASE ...'     (0.3 s a scene and length, and the trainings)

Every length sees the same clouds: ``states`` are scenes of the kind that training shows, hidden
parts and background among them, of a library of elastic states that no training has seen;
``dragged`` ones are dragged, squeezed and bent as no training scene is; ``world`` ones lie in
folders that `make world` or `tumortrack twin` wrote. Cases, models and rows are kept under --out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import pandas as pd
import tyro

from tumortrack import api
from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.imaging.case import Case
from tumortrack.models.folder import KIND, WEIGHTS, is_finished
from tumortrack.simulate.scene_folder import Scene, list_scenes, read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.model import SHIPPED
from tumortrack.training.presets import clinic
from tumortrack_lab.real import kidneys
from tumortrack_lab.real.judging import DRAGGED, by_tumor, judge, quantiles
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import table
from tumortrack_lab.study.methods import named_folders

BLOCK = "minutes"
FAR_MM = (3.0, 5.0)
Made = list[tuple[str, Callable[[], Scene]]]


@dataclass(frozen=True, kw_only=True)
class Options(scripts.KeptOptions):
    """Short trainings beside a whole one, on organs that no training has seen."""

    organs: Annotated[tuple[str, ...], tyro.conf.Positional]
    """NAME=FOLDER of each case that `tumortrack prepare` wrote."""
    lengths: tuple[str, ...] = ("0", "100", "400", "6000", "none:6000")
    """Steps of each training, from the head start and on coarse scenes; with none: in front from
    nothing, with full: on whole images of whole surfaces, with none:full: both."""
    start: Path | None = None
    """Head start (default: the package's)."""
    scenes: int = 60
    """Of states, of each organ; half as many are dragged."""
    worlds: tuple[str, ...] = ()
    """NAME=FOLDER of further scenes of an organ."""
    seed: int = 0
    """Of trainings and scenes."""
    device: api.Device = "auto"
    out: Path = Path("runs/minutes")
    document: Path = Path("docs/training.md")


def main(options: Options) -> None:
    """Train what is not trained, locate what is not located, write the tables."""
    writer = options.begin("minutes", BLOCK)
    cases, worlds = named_folders(options.organs, ()), named_folders(options.worlds, ())
    if foreign := sorted(set(worlds) - set(cases)):
        raise InputError(f"--worlds {foreign[0]}=... has no case of that name.")
    rows = []
    for name, folder in cases.items():
        for length in options.lengths:
            rows += list(_of_length(name, folder, worlds.get(name), length, options))
    writer.write({BLOCK: f"{tables(rows)}\n\n`{writer.command}`"})
    say(f"written to {options.document}")


def _of_length(
    name: str, folder: Path, world: Path | None, length: str, options: Options
) -> Iterator[dict]:
    """The rows of one model, a scene each."""
    how, _, steps = length.rpartition(":")
    if how not in ("", "none", "full", "none:full") or not steps.isdigit():
        raise InputError(f"--lengths {length!r} must be steps, or none:, full:, none:full: before.")
    case_sha256 = store.sha256_of(folder / store.MANIFEST)
    start = Path("none") if how.startswith("none") else options.start or SHIPPED
    of = how.replace(":", "-") or store.sha256_of(start / WEIGHTS)[:8]
    config = clinic(api.load_case(folder).anatomy)
    if how.endswith("full"):
        config = msgspec.structs.replace(config, coarse=None)
    model = options.out / name / f"{case_sha256[:8]}-{of}-{options.seed}-{steps}"
    if not is_finished(model):
        say(f"{name}: training for {length} steps")
        api.train(
            folder, model, config=config, steps=int(steps), seed=options.seed,
            device=options.device, start=start,
        )  # fmt: skip
    about = {
        "case": case_sha256, "scenes": options.scenes,
        "model": store.sha256_of(model / store.MANIFEST), "seed": options.seed,
        "world": None if world is None else store.sha256_of(world),
    }  # fmt: skip
    took = store.read_manifest(model, KIND)["provenance"]["training_s"]
    known = {"organ": name, "length": length, "training_s": took}

    def measure() -> list[dict]:
        case = api.load_case(folder)
        tracker = Tracker(api.load_model(model, options.device))
        tracker.warm()
        organ, *tumors = case.anatomy.parts
        kinds = [kidneys.kind_of(kidneys.outer_share(tumor, organ)) for tumor in tumors]
        found = []
        for source, make in _scenes(case, world, options):
            scene, began = make(), time.perf_counter()
            row = {"source": source, **judge(tracker, case.anatomy, scene, surfaces=False)}
            row["seconds"] = time.perf_counter() - began
            for tumor, kind in zip(row["tumors"], kinds, strict=False):
                tumor["kind"] = kind
            found.append(row)
        return found

    rows = scripts.kept(model.with_suffix(".json"), about, measure)
    say(f"{name}, {length} steps: {quantiles(by_tumor(rows).middle_mm)} mm")
    for row in rows:
        yield {**known, **row}


def _scenes(case: Case, world: Path | None, options: Options) -> Made:
    """What every length sees, and of what source."""
    made: Made = []
    states = clinic(case.anatomy).scene
    for source, config, count in (
        ("states", states, options.scenes),
        ("dragged", DRAGGED, options.scenes // 2),
    ):
        make = api.scene_maker(case, config, options.seed)
        made += [(source, partial(make, number)) for number in range(count)]
    folders = [] if world is None else list_scenes(world)
    return made + [("world", partial(read_scene, folder)) for folder in folders]


def tables(rows: list[dict]) -> str:
    """By source of scenes, by organ, and by how the tumors lie."""
    lines = by_tumor({**row, "scene": number} for number, row in enumerate(rows))
    by = {"scenes": "source", "organ": "organ", "tumors": "kind"}
    return "\n\n".join(_table(f"steps, {what}", lines, column) for what, column in by.items())


def _table(what: str, lines: pd.DataFrame, column: str) -> str:
    """Verdicts of scenes and errors of tumors' middles, mm, by length and group."""
    head = [what, "training, s", "scenes", "good", "poor", "refused"]
    head += [f"good, over {far:g} mm" for far in FAR_MM]
    head += ["middle of tumors, median / 90 / 95 / worst", "called good", "best rigid pose"]
    body = []
    for key, some in lines.groupby(["length", column], sort=False):
        verdicts = some.drop_duplicates("scene").verdict
        good = some[some.verdict == "good"]
        body.append([
            ", ".join(map(str, key)), f"{some.training_s.median():.0f}", str(len(verdicts)),
            *(str((verdicts == one).sum()) for one in ("good", "poor", "refused")),
            *(f"{(good.middle_mm > far).mean():.1%}" if len(good) else "–" for far in FAR_MM),
            *map(quantiles, (some.middle_mm, good.middle_mm, some.rigid_middle_mm)),
        ])  # fmt: skip
    return table(head, body)


if __name__ == "__main__":
    scripts.run(main, Options)
