"""Scenes of a wider world, to calibrate and test bounds on, and a model's estimates in them.

    make world ARGS='CASE OUT --count 320 --model MODEL'     (about 4 s a scene)

Writes scene folders into OUT, which `tumortrack evaluate` reads. The same command goes on where it
was stopped. OUT/world.json states case, seed and configuration, OUT/failures.json the states that
found no equilibrium and the views in which no organ was found, OUT/measured.json a model's
estimates. `--disturb strays fat ...` makes scenes that should not get a good estimate, with
`--states FOLDER` in states that are solved already (0.3 s a scene). Tables of several organs: the
same for each, and the last with `--beside` the others. `--plans MODEL` cuts tumors out (4 s a
scene).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Annotated

import pandas as pd
import tyro

from tumortrack.cli.console import model_folder, progress_bar, say
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.simulate.scene_folder import Scene, list_scenes, read_scene
from tumortrack_lab.study import resection, scripts
from tumortrack_lab.study.measure import measured
from tumortrack_lab.study.methods import study_case
from tumortrack_lab.twin.dataset import claim, known
from tumortrack_lab.world import estimates
from tumortrack_lab.world.families import FAMILIES
from tumortrack_lab.world.scenes import DISTURBANCES, TETS, World, WorldConfig

Made = tuple[str, dict[str, tuple[str, pd.DataFrame]]]  # a text; tables: by name words and rows
_ABOUT, _FAILURES = "world.json", "failures.json"


@dataclass(frozen=True)
class Options:
    """Make a world's scenes and measure a model in them."""

    case: tyro.conf.Positional[Path]
    """Folder that `tumortrack prepare` wrote."""
    out: tyro.conf.Positional[Path]
    """Folder of the scenes."""
    count: int = 320
    """States that are tried; families take turns."""
    seed: int = 0
    """Of everything."""
    families: tuple[str, ...] = tuple(FAMILIES)
    """Which of them."""
    disturb: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KIND")] = ("none",)
    """Which disturbances take turns; none: undisturbed scenes."""
    segmentation: float = 0.6
    """Share of scenes whose true organ differs from the case as segmentations err."""
    states: Path | None = None
    """Undisturbed scenes of this case that this command made: their states are seen again, instead
    of new ones being solved."""
    draws: int = 1
    """How often each of these."""
    model: Path | None = None
    """Measure it (a case has one)."""
    plans: Path | None = None
    """Instead: plan on the estimates of this one, and cut."""
    beside: tuple[Path, ...] = ()
    """Other organs' scenes that are measured already: they join the tables."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""


def main(options: Options) -> None:
    """Make missing scenes, then measure."""
    known(options.families, FAMILIES)
    known(options.disturb, DISTURBANCES)
    block = "world" if set(options.disturb) == {"none"} else "world-disturbed"
    block = "world-plans" if options.plans else block
    writer = scripts.begun("world", options.document)
    config = WorldConfig(
        seed=options.seed,
        families=options.families,
        disturbances=options.disturb,
        segmentation=options.segmentation,
    )
    world = _open(options, config)
    scenes = _scenes(options, world)
    failures_path = options.out / _FAILURES
    failures = store.read_json(failures_path) if failures_path.exists() else {}
    todo = [n for n in scenes if n not in failures and not (options.out / n).exists()]
    with progress_bar("scenes", len(todo)) as advance:
        for name in todo:
            try:
                scenes[name]().write(options.out / name)
            except TumortrackError as error:
                failures[name] = f"{type(error).__name__}: {error}"
                store.write_json(failures_path, failures)
                say(f"{name}: {failures[name]}")
            advance()
    if (given := options.plans or options.model) is not None:
        model = model_folder(given)
        made = [name for name in scenes if (options.out / name).exists()]
        text, data = (_plans if options.plans else _estimates)(options, world, model, made)
        print(text)
        tables = {f"{block}-{name}": rows for name, (_, rows) in data.items()}
        writer.tables(tables, sample=f"{len(made)} scenes")


def _estimates(options: Options, world: World, model: Path, made: list[str]) -> Made:
    estimates.measure(model, world.anatomy_ct, options.out, made)
    folders = [options.out, *options.beside]
    paths = [path for folder in folders if (path := folder / _FAILURES).exists()]
    lost = [why for path in paths for why in store.read_json(path).values()]
    rows = estimates.read_rows(folders)
    lines, count = estimates.verdicts(rows), Counter(why.partition(":")[0] for why in lost)
    reasons = ", ".join(f"{name} {n}" for name, n in count.most_common())
    return f"{estimates.summary(lines)}\n\nNot made: {reasons or 'none'}.", {
        "verdicts": ("Verdicts and errors", lines),
        "wrong": ("Good answers that are wrong", estimates.wrong_ones(rows)),
    }


def _plans(options: Options, world: World, model: Path, made: list[str]) -> Made:
    """Plans are kept in the scenes' folder, a file a scene and method."""
    case, rows = study_case(options.out.name, options.case, options.out), []
    for name, method in product(made, (resection.tracked(model), resection.truth())):
        variant, _, view = name.rpartition("-")
        about = case, method, [variant], view, 160, options.out / "plans" / name
        rows += measured(*about, resection.cut_one, **resection.cutting())
        say(f"planned {name} ({method.name})")
    for other in options.beside:
        if not (files := sorted((other / "plans").rglob("*.json"))):
            raise InputError(f"{other} has no plans; the same command with --plans makes them.")
        rows += [row for path in files for row in store.read_json(path)["rows"]]
    seen = {(row["case"], row["variant"]) for row in rows}
    good = {(row["case"], row["variant"]) for row in rows if row.get("good")}
    for row in rows:
        is_good = (row["case"], row["variant"]) in good
        row["case"] = "a good answer" if is_good else "a poor answer, or none"
    cuts, refused = resection.tables_of(rows)
    counts = f"Scenes: {len(seen)}, with a good answer: {len(good)}."
    return f"{counts}\n\n{resection.summary(cuts)}", {
        "cuts": ("What the cuts did", cuts), "refused": ("Why there was no plan", refused)
    }  # fmt: skip


def _scenes(options: Options, world: World) -> dict[str, Callable[[], Scene]]:
    """What makes each scene, by its name."""
    if options.states is None:
        numbers = {"-".join((f"{n:05d}", *world.recipe(n))): n for n in range(options.count)}
        return {name: partial(world.scene, n) for name, n in numbers.items()}
    shown = lru_cache(1)(lambda folder: world.kept(read_scene(folder)))  # its draws in turn
    scenes: dict[str, Callable[[], Scene]] = {}
    for folder in list_scenes(options.states):
        state, family, kind = folder.name.split("-")
        if kind != "none" or int(state) >= options.count or family not in options.families:
            continue
        for draw in range(options.draws):
            _, other = world.recipe(int(state), options.draws, draw)
            n = int(state) * options.draws + draw
            make = partial(lambda f, n, kind: world.again(shown(f), n, kind), folder, n, other)
            scenes[f"{n:05d}-{family}-{other}"] = make
    return scenes


def _open(options: Options, config: WorldConfig) -> World:
    """The folder's world; a new one's inputs and tetrahedra are written there."""
    out = options.out
    sha256 = store.sha256_of(options.case / store.MANIFEST)
    identity = {"case_sha256": sha256, "config": to_builtins(config)}
    source = options.states or out
    if options.states is not None:
        kept = store.read_json(source / _ABOUT)
        if kept["case_sha256"] != sha256:
            raise InputError(f"{source} shows another case than {options.case}.")
        identity |= {"states": kept, "draws": options.draws}
    claim(out, _ABOUT, identity)
    return World.opened(options.case, config, source / TETS)


if __name__ == "__main__":
    scripts.run(main, Options)
