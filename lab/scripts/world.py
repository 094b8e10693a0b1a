"""Scenes of a wider world, to calibrate and test margins on; and how a model does in them.

    make world ARGS='CASE OUT --count 320 --model MODEL'     (about 4 s a scene)

Writes scene folders into OUT, which `tumortrack evaluate` reads. The same command goes on where it
was stopped. OUT/world.json states case, seed and configuration, OUT/failures.json the states that
found no equilibrium and the views in which no organ was found, OUT/measured.json and table.md what
a model makes of them. `--disturb strays fat ...` makes scenes that should be met with silence.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro

from tumortrack import api
from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate, TumortrackError
from tumortrack.core.geometry import transform_points
from tumortrack.report.metrics import box_center_distance
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.peers.base import kabsch
from tumortrack_lab.real.judging import quantiles
from tumortrack_lab.study import trainings
from tumortrack_lab.study.document import table
from tumortrack_lab.world.families import FAMILIES
from tumortrack_lab.world.scenes import DISTURBANCES, World, WorldConfig

_SAVE_EVERY = 20


@dataclass(frozen=True)
class Options:
    """Make a world's scenes and measure a model in them."""

    case: tyro.conf.Positional[Path]
    """Folder that `tumortrack prepare` wrote."""
    out: tyro.conf.Positional[Path]
    """Folder of the scenes."""
    count: int = 320
    """Scenes that are tried; families take turns."""
    seed: int = 0
    """Of everything."""
    families: tuple[str, ...] = tuple(FAMILIES)
    """Which of them."""
    disturb: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KIND")] = ("none",)
    """Which disturbances take turns; none: undisturbed scenes."""
    segmentation: float = 0.6
    """Share of scenes whose true organ differs from the case as segmentations err."""
    model: Path | None = None
    """Measure it (folder that `tumortrack train` wrote)."""


def main(options: Options) -> None:
    """Make what is missing, then measure what is."""
    for names, known in ((options.families, FAMILIES), (options.disturb, DISTURBANCES)):
        if unknown := sorted(set(names) - set(known)):
            raise InputError(f"{unknown[0]!r} is not known; allowed: {', '.join(known)}.")
    config = WorldConfig(
        seed=options.seed,
        families=options.families,
        disturbances=options.disturb,
        segmentation=options.segmentation,
    )
    world = World.kept(options.case, options.out, "world.json", config)
    failures_path = options.out / "failures.json"
    failures = store.read_json(failures_path) if failures_path.exists() else {}
    names = {n: "-".join((f"{n:05d}", *world.recipe(n))) for n in range(options.count)}
    todo = [n for n, name in names.items() if name not in failures]
    todo = [n for n in todo if not (options.out / names[n]).exists()]
    start, used = time.monotonic(), time.process_time()
    for done, number in enumerate(todo, start=1):
        try:
            world.scene(number).write(options.out / names[number])
        except TumortrackError as error:
            failures[names[number]] = f"{type(error).__name__}: {error}"
            store.write_json(failures_path, failures)
        left_min = (time.monotonic() - start) / done * (len(todo) - done) / 60
        each_s = (time.process_time() - used) / done
        say(
            f"{done}/{len(todo)} {names[number]}: {left_min:.0f} min left, {each_s:.1f} s of one "
            f"core a scene, {len(failures)} failed"
        )
    if options.model is not None:
        made = [name for name in names.values() if (options.out / name).exists()]
        rows = _measured(options.model, world, options.out, made)
        text = _summary(rows, {k: v for k, v in failures.items() if k in names.values()})
        store.write_atomically(options.out / "table.md", text.encode())
        print(text)


def _measured(model: Path, world: World, out: Path, names: list[str]) -> pd.DataFrame:
    """A row a tumor and scene, kept by model."""
    path, about = out / "measured.json", store.sha256_of(model / store.MANIFEST)
    kept = store.read_json(path) if path.exists() else {}
    rows = kept.get("rows", {}) if kept.get("model_sha256") == about else {}
    tracker = Tracker(api.load_model(model, "cpu"))
    todo = [name for name in names if name not in rows]
    for done, name in enumerate(todo, start=1):
        rows[name] = _judge(tracker, world, read_scene(out / name))
        if done % _SAVE_EVERY == 0 or done == len(todo):
            store.write_json(path, {"model_sha256": about, "rows": rows})
            say(f"measured {done}/{len(todo)}")
    return pd.DataFrame([{"scene": name, **row} for name in names for row in rows[name]])


def _judge(tracker: Tracker, world: World, scene: Scene) -> list[dict]:
    """Errors of each tumor's centre, of the estimate and of the best rigid pose there is."""
    meta = scene.meta
    about = {
        "family": meta["family"],
        "disturbance": meta["disturbance"]["kind"],
        "segmentation": meta["segmentation"]["kind"],
        "hidden_share": meta["hidden_share"],
        "visible_share": meta["visible_share"],
    }
    try:
        estimate = tracker.follow(scene.cloud, seen=scene.depth)
        about |= {"verdict": estimate.quality, "reason": estimate.reason}
        found = estimate.meshes
    except NoEstimate as error:
        about |= {"verdict": "none", "reason": str(error)}
        found = {}
    if scene.targets is None:  # not the model's organ: there is no right answer
        return [about]
    weights = np.array([part.volume_mm3 for part in world.anatomy_ct.parts])
    weights /= np.maximum(np.bincount(scene.targets.labels, minlength=len(weights) + 1)[1:], 1)
    best = kabsch(
        scene.targets.points_ct, scene.targets.points_mm, weights[scene.targets.labels - 1]
    )
    rows = []
    for number, truth in enumerate(scene.reference.tumors, start=1):
        rest = world.anatomy_ct.tumors[number - 1]
        rigid = rest.moved(transform_points(best, rest.vertices_mm))
        row = {**about, "tumor": number, "rigid_mm": box_center_distance(rigid, truth)}
        if f"tumor_{number}" in found:
            row["center_mm"] = box_center_distance(found[f"tumor_{number}"], truth)
        rows.append(row)
    return rows


def _summary(rows: pd.DataFrame, failures: dict[str, str]) -> str:
    """A Markdown table: a line a family, or a disturbance where there are any."""
    key = "family" if set(rows["disturbance"]) == {"none"} else "disturbance"
    place = 1 if key == "family" else 2
    head = [key, "scenes", "failed", "none, poor, good", "good: mm", "poor: mm", "rigid: mm"]
    body = []
    for name in [*rows[key].unique(), "all"]:
        mine = rows if name == "all" else rows[rows[key] == name]
        lost = sum(name in ("all", scene.split("-")[place]) for scene in failures)
        first = mine.drop_duplicates("scene")
        counts = [str((first["verdict"] == verdict).sum()) for verdict in ("none", "poor", "good")]
        errors = (
            quantiles(mine[mine["verdict"] == v].get("center_mm", ())) for v in ("good", "poor")
        )
        cells = [name, str(len(first)), str(lost), ", ".join(counts), *errors]
        body.append([*cells, quantiles(mine.get("rigid_mm", ()))])
    reasons = pd.Series([reason.partition(":")[0] for reason in failures.values()], dtype=str)
    why = ", ".join(f"{name} {count}" for name, count in reasons.value_counts().items())
    return (
        f"{table(head, body, 1)}\n\nErrors of tumor centres: median / 90th / 95th percentile / "
        f"worst. rigid: the best rigid pose. Failed: {why or 'none'}.\n"
    )


if __name__ == "__main__":
    trainings.run(main, Options)
