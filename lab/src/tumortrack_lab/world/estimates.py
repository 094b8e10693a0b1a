"""What a model makes of a world's scenes: kept rows, and the tables of docs/trust.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack.models.margins import METHOD
from tumortrack.report.metrics import box_center_distance
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.model import load_model
from tumortrack_lab.peers.base import kabsch
from tumortrack_lab.real.judging import quantiles
from tumortrack_lab.study.document import table
from tumortrack_lab.study.trust import BANDS, band_of

_ROWS, _SAVE_EVERY = "measured.json", 20
FAR_MM = 5.0  # off: a good answer that is wrong


def measure(model: Path, anatomy_ct: Anatomy, out: Path, names: Sequence[str]) -> None:
    """A row a tumor and scene, as `track` finds them in a first look; kept in the scenes' folder by
    model and method, so that what is there is not located again."""
    path = out / _ROWS
    about = {"model_sha256": store.sha256_of(model / store.MANIFEST), "method": METHOD}
    kept = store.read_json(path) if path.exists() else {}
    rows = kept["rows"] if all(kept.get(name) == value for name, value in about.items()) else {}
    tracker = Tracker(load_model(model, "cpu", with_margins=False))
    todo = [name for name in names if name not in rows]
    for done, name in enumerate(todo, start=1):
        rows[name] = _judge(tracker, anatomy_ct, read_scene(out / name))
        if done % _SAVE_EVERY == 0 or done == len(todo):
            store.write_json(path, {**about, "rows": rows})
            say(f"measured {done}/{len(todo)}")


def read_rows(folders: Sequence[Path]) -> pd.DataFrame:
    """Of all scenes that were measured with today's method; organs are called as the folders.
    Raises InputError: of a folder there are none."""
    lines = []
    for folder in folders:
        kept = store.read_json(folder / _ROWS)
        if kept.get("method") != METHOD:
            raise InputError(f"{folder} was measured with another version of the method.")
        for name, rows in kept["rows"].items():
            lines += [{"organ": folder.name, "scene": name, **row} for row in rows]
    rows = pd.DataFrame(lines)
    for column in ("tumor", "center_mm", "rigid_mm", "shape_mm"):
        rows[column] = rows.get(column, pd.Series(np.nan, rows.index))
    rows["hidden"] = pd.Categorical(rows.hidden_share.map(band_of), BANDS)
    good = rows.verdict == "good"
    rows["wrong"] = good & (rows.center_mm.isna() | (rows.center_mm > FAR_MM))
    return rows


def _judge(tracker: Tracker, anatomy_ct: Anatomy, scene: Scene) -> list[dict]:
    """Errors of each tumor's centre, mm: of the estimate, of the best rigid pose of the organ as it
    was in the CT, and of the estimate were it moved rigidly onto the truth (``shape_mm``)."""
    meta, targets = scene.meta, scene.targets
    about = {"family": meta["family"], "disturbance": meta["disturbance"]["kind"]}
    about |= {name: meta[name] for name in ("hidden_share", "visible_share")}
    estimate: Estimate | None = None
    try:
        estimate = tracker.follow(scene.cloud, seen=scene.depth)
        about |= {"verdict": estimate.quality, "reason": estimate.reason}
    except NoEstimate as error:
        about |= {"verdict": "none", "reason": str(error)}
    if targets is None:  # not the model's organ: there is no right answer
        return [about]
    volumes = np.array([part.volume_mm3 for part in anatomy_ct.parts])
    counts = np.bincount(targets.labels, minlength=len(volumes) + 1)[1:]
    weights = (volumes / np.maximum(counts, 1))[targets.labels - 1]
    best, onto = kabsch(targets.points_ct, targets.points_mm, weights), np.eye(4)
    if estimate is not None and estimate.motion is not None:
        there = estimate.motion.carry(targets.points_ct)
        onto = kabsch(there, targets.points_mm, weights)
    rows = []
    for n, (rest, truth) in enumerate(
        zip(anatomy_ct.tumors, scene.reference.tumors, strict=True), start=1
    ):
        row = {**about, "tumor": n}
        found = {} if estimate is None else estimate.meshes
        surfaces = {"rigid_mm": (rest, best)}
        if f"tumor_{n}" in found:
            mesh = found[f"tumor_{n}"]
            surfaces |= {"center_mm": (mesh, np.eye(4)), "shape_mm": (mesh, onto)}
        for name, (mesh, pose) in surfaces.items():
            moved = mesh.moved(transform_points(pose, mesh.vertices_mm))
            row[name] = box_center_distance(moved, truth)
        rows.append(row)
    return rows


def summary(rows: pd.DataFrame, failures: dict[str, str]) -> str:
    """The tables in Markdown: undisturbed scenes by family, hidden surface and organ; disturbed
    ones by disturbance and organ; and every good answer that is wrong."""
    calm = rows.disturbance == "none"
    parts = [_verdicts(rows[calm], key) for key in ("family", "hidden", "organ") if calm.any()]
    if not calm.all():
        parts += [_verdicts(rows[~calm], key) for key in ("disturbance", "organ")]
    reasons = pd.Series([why.partition(":")[0] for why in failures.values()], dtype=str)
    lost = ", ".join(f"{name} {count}" for name, count in reasons.value_counts().items())
    parts.append(
        "Errors of tumor centres in mm: median / 90 % / 95 % / worst, of good answers and of the "
        f"best rigid pose of the same states. Wrong: scenes called good with a centre over "
        f"{FAR_MM:g} mm off, or without this organ. Not made: {lost or 'none'}."
    )
    return "\n\n".join([*parts, _wrong(rows)])


def _verdicts(rows: pd.DataFrame, key: str) -> str:
    body = []
    for name, mine in [*rows.groupby(key, sort=key == "hidden", observed=True), ("all", rows)]:
        scenes = mine.drop_duplicates(["organ", "scene"])
        counts = [str((scenes.verdict == verdict).sum()) for verdict in ("none", "poor", "good")]
        good = mine[mine.verdict == "good"]
        wrong = mine[mine.wrong].drop_duplicates(["organ", "scene"])
        body.append(
            [str(name), str(len(scenes)), ", ".join(counts), quantiles(good.center_mm)]
            + [quantiles(good.rigid_mm), str(len(wrong))]
        )
    return table([key, "scenes", "none, poor, good", "good", "best rigid pose", "wrong"], body)


def _wrong(rows: pd.DataFrame) -> str:
    """Every wrong good answer by name, and what is wrong with it."""
    wrong = rows[rows.wrong].sort_values("center_mm", ascending=False)
    wrong = wrong.drop_duplicates(["organ", "scene"])
    causes = {
        "another organ taken for it": wrong.center_mm.isna(),
        "camera out of scale or depth": wrong.disturbance == "scale",
        "laid elsewhere": wrong.shape_mm < wrong.center_mm / 2,
        "bent, and given another bend": wrong.rigid_mm > FAR_MM,
    }
    wrong = wrong.assign(why=np.select([*causes.values()], [*causes], "given a bend it lacks"))
    body = []
    for (kind, why), mine in wrong.groupby(["disturbance", "why"]):
        names = [
            f"{row.organ} {row.scene.rpartition('-')[0]}"
            + ("" if np.isnan(row.center_mm) else f" {row.center_mm:.1f} ({row.rigid_mm:.1f})")
            for row in mine.itertuples()
        ]
        body.append([str(kind), str(why), str(len(mine)), ", ".join(names)])
    head = ["disturbance", "wrong", "scenes", "organ, scene, mm off (best rigid pose)"]
    return table(head, body, 2)
