"""A model's estimates in a world's scenes: kept rows, and the tables of docs/trust.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import FAR_MM
from tumortrack.core.types import Anatomy
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.real.judging import by_tumor, judge
from tumortrack_lab.study.document import beside_rigid, spread_mm, table_of

_ERRORS = {"middle_mm": "off", "rigid_middle_mm": "rigid", "rigid_fit_middle_mm": "fit"}
_ERRORS |= {"shape_middle_mm": "shape"}
_HIDDEN = (0.0, 0.4)  # shares of the surface: bounds between the bands
BANDS = ("nothing hidden", "up to 40 %", "over 40 %")
_ROWS, _SAVE_EVERY = "measured.json", 20


def band_of(hidden_share: float) -> str:
    return BANDS[int(np.searchsorted(_HIDDEN, hidden_share))]


def measure(model: Path, anatomy_ct: Anatomy, out: Path, names: Sequence[str]) -> None:
    """A row for each scene, located as by `track` in a first look; kept in the scenes' folder by
    model and method, so that no scene is located again."""
    path = out / _ROWS
    about = {"model_sha256": store.sha256_of(model / store.MANIFEST), "fingerprint": fingerprint()}
    kept = store.read_json(path) if path.exists() else {}
    rows = kept["rows"] if all(kept.get(name) == value for name, value in about.items()) else {}
    tracker = Tracker(load_model(model, "cpu"))
    todo = [name for name in names if name not in rows]
    for done, name in enumerate(todo, start=1):
        rows[name] = _judged(tracker, anatomy_ct, read_scene(out / name))
        if done % _SAVE_EVERY == 0 or done == len(todo):
            store.write_json(path, {**about, "rows": rows})
            say(f"measured {done}/{len(todo)}")


def read_rows(folders: Sequence[Path]) -> pd.DataFrame:
    """A line for each tumor of all scenes; organs have the folders' names. Raises InputError:
    measured with another version of the method, or no scenes."""
    rows = []
    for folder in folders:
        kept = store.read_json(folder / _ROWS)
        if kept.get("fingerprint") != fingerprint():
            raise InputError(f"{folder} was measured with another version of the method.")
        some = kept["rows"].items()
        rows += [{"organ": folder.name, "scene": name, **row} for name, row in some]
    if not rows:
        raise InputError("there are no scenes; give a larger --count, --draws.")
    lines = by_tumor(rows).reindex(columns=[*rows[0], *_ERRORS]).rename(columns=_ERRORS)
    lines["hidden"] = pd.Categorical(lines.hidden_share.map(band_of), BANDS)
    right = lines.off <= FAR_MM  # False where there is no such tumor
    return lines.assign(wrong=(lines.verdict == "good") & ~right)


def _judged(tracker: Tracker, anatomy_ct: Anatomy, scene: Scene) -> dict[str, Any]:
    meta = scene.meta
    about = {"family": meta["family"], "disturbance": meta["disturbance"]["kind"]}
    about |= {name: meta[name] for name in ("hidden_share", "visible_share")}
    return about | judge(tracker, anatomy_ct, scene, scene.depth, surfaces=False)


def verdicts(rows: pd.DataFrame) -> pd.DataFrame:
    """Verdicts and errors of undisturbed scenes by family, hidden surface and organ; of disturbed
    ones by disturbance and organ."""
    calm = rows.disturbance == "none"
    parts = [("family", rows[calm]), ("hidden", rows[calm]), ("organ", rows[calm])]
    parts += [("disturbance", rows[~calm]), ("organ", rows[~calm])]
    parts += [("disturbance, nothing hidden", rows[~calm & (rows.hidden_share == 0)])]
    lines = []
    for by, some in parts:
        key = by.partition(",")[0]
        each = some.groupby(key, sort=key == "hidden", observed=True)
        for name, mine in [*each, ("all", some)] if len(some) else ():
            scenes, good = mine.drop_duplicates(["organ", "scene"]), mine[mine.verdict == "good"]
            line = {"by": by, "value": name, "scenes": len(scenes)}
            line |= {v: (scenes.verdict == v).sum() for v in ("refused", "poor", "good")}
            line["wrong"] = mine[mine.wrong].groupby(["organ", "scene"]).ngroups
            line |= spread_mm("centre", good.off) | spread_mm("best rigid pose", good.rigid)
            line |= spread_mm("rigid fit", good.fit)
            lines.append(line)
    return pd.DataFrame(lines)


def summary(lines: pd.DataFrame) -> str:
    """The first part of these in Markdown."""
    short, by = lines[lines.by == lines.by[0]], lines.by[0]
    shown = short[["value", "scenes", "good", "wrong"]].rename(columns={"value": by})
    return table_of(shown.assign(**beside_rigid(short, "")))


def wrong_ones(rows: pd.DataFrame) -> pd.DataFrame:
    """Every good answer that is wrong, and how: ``wrong pose`` if moving the estimate rigidly onto
    the truth halves the tumor's error; else bent ``too little`` or ``wrongly``, as the best rigid
    pose is farther off or nearer."""
    wrong = rows[rows.wrong].sort_values("off", ascending=False)
    wrong = wrong.drop_duplicates(["organ", "scene"])
    causes = {
        "not this organ": wrong.off.isna(),
        "camera out of scale or depth": wrong.disturbance == "scale",
        "wrong pose": wrong["shape"] < wrong.off / 2,
        "bent too little": wrong.off <= wrong.rigid,
    }
    columns = {
        "disturbance": wrong.disturbance,
        "wrong": np.select([*causes.values()], [*causes], "bent wrongly"),
        "organ": wrong.organ,
        "scene": wrong.scene,
        "off mm": wrong.off.round(1),
        "best rigid pose mm": wrong.rigid.round(1),
        "hidden %": (100 * wrong.hidden_share).round(),
    }
    return pd.DataFrame(columns).sort_values(["disturbance", "wrong"], kind="stable")
