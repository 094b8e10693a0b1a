"""What a model makes of a world's scenes: kept rows, and the tables of docs/trust.md."""

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
from tumortrack.models.margins import METHOD
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.real.judging import by_tumor, judge, quantiles
from tumortrack_lab.study.document import table
from tumortrack_lab.study.trust import BANDS, band_of

_ERRORS = {"middle_mm": "off", "rigid_middle_mm": "rigid", "shape_middle_mm": "shape"}
_ROWS, _SAVE_EVERY = "measured.json", 20


def measure(model: Path, anatomy_ct: Anatomy, out: Path, names: Sequence[str]) -> None:
    """A row a scene, as `track` finds them in a first look; kept in the scenes' folder by
    model and method, so that what is there is not located again."""
    path = out / _ROWS
    about = {"model_sha256": store.sha256_of(model / store.MANIFEST), "method": METHOD}
    kept = store.read_json(path) if path.exists() else {}
    rows = kept["rows"] if all(kept.get(name) == value for name, value in about.items()) else {}
    tracker = Tracker(load_model(model, "cpu", with_margins=False))
    todo = [name for name in names if name not in rows]
    for done, name in enumerate(todo, start=1):
        rows[name] = _judged(tracker, anatomy_ct, read_scene(out / name))
        if done % _SAVE_EVERY == 0 or done == len(todo):
            store.write_json(path, {**about, "rows": rows})
            say(f"measured {done}/{len(todo)}")


def read_rows(folders: Sequence[Path]) -> pd.DataFrame:
    """A line a tumor of all scenes; organs are called as the folders. Raises InputError: measured
    with another version of the method, or none at all."""
    rows = []
    for folder in folders:
        kept = store.read_json(folder / _ROWS)
        if kept.get("method") != METHOD:
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


def summary(rows: pd.DataFrame, failures: Sequence[str]) -> str:
    """The tables in Markdown: undisturbed scenes by family, hidden surface and organ; disturbed
    ones by disturbance and organ; and every good answer that is wrong."""
    calm = rows.disturbance == "none"
    parts = [_verdicts(rows[calm], key) for key in ("family", "hidden", "organ") if calm.any()]
    if not calm.all():
        parts += [_verdicts(rows[~calm], key) for key in ("disturbance", "organ")]
        bare = rows[~calm & (rows.hidden_share == 0)]
        parts.append(_verdicts(bare, "disturbance", ", nothing hidden"))
    reasons = pd.Series([why.partition(":")[0] for why in failures], dtype=str)
    lost = ", ".join(f"{name} {count}" for name, count in reasons.value_counts().items())
    parts.append(
        "Errors of the tumors' middles, mm: median / 90 % / 95 % / worst, of good answers and of "
        f"the best rigid pose of the same states. Wrong: called good with a tumor over {FAR_MM:g} "
        f"mm off, or without this organ. Not made: {lost or 'none'}."
    )
    return "\n\n".join([*parts, _wrong(rows)])


def _verdicts(rows: pd.DataFrame, key: str, of: str = "") -> str:
    body = []
    for name, mine in [*rows.groupby(key, sort=key == "hidden", observed=True), ("all", rows)]:
        scenes, good = mine.drop_duplicates(["organ", "scene"]), mine[mine.verdict == "good"]
        counts = [str((scenes.verdict == verdict).sum()) for verdict in ("refused", "poor", "good")]
        errors = quantiles(good.off), quantiles(good.rigid)
        wrong = mine[mine.wrong].groupby(["organ", "scene"]).ngroups
        body.append([str(name), str(len(scenes)), ", ".join(counts), *errors, str(wrong)])
    head = [key + of, "scenes", "refused, poor, good", "good", "best rigid pose", "wrong"]
    return table(head, body)


def _wrong(rows: pd.DataFrame) -> str:
    """Every wrong good answer by name, and what is wrong with it: ``laid elsewhere`` if its tumor
    would be within half of its error, were the estimate moved rigidly onto the truth; else bent
    ``too little`` or ``wrongly``, as the best rigid pose is farther off or nearer."""
    if not rows.wrong.any():
        return "Wrong: none."
    wrong = rows[rows.wrong].sort_values("off", ascending=False)
    wrong = wrong.drop_duplicates(["organ", "scene"])
    causes = {
        "another organ taken for it": wrong.off.isna(),
        "camera out of scale or depth": wrong.disturbance == "scale",
        "laid elsewhere": wrong["shape"] < wrong.off / 2,
        "bent too little": wrong.off <= wrong.rigid,
    }
    wrong["why"] = np.select([*causes.values()], [*causes], "bent wrongly")
    wrong["name"] = wrong.scene.str.rpartition("-")[0] + [
        "" if np.isnan(row.off) else f" {row.off:.1f}" for row in wrong.itertuples()
    ]
    told = wrong.off.notna() & (wrong.disturbance != "scale")
    wrong.loc[told, "name"] += [
        f" ({row.rigid:.1f}, {row.hidden_share:.0%})" for row in wrong[told].itertuples()
    ]
    body = []
    for (kind, why), mine in wrong.groupby(["disturbance", "why"]):
        named = [f"{organ} {', '.join(some['name'])}" for organ, some in mine.groupby("organ")]
        body.append([str(kind), str(why), str(len(mine)), "; ".join(named)])
    head = ["disturbance", "wrong", "scenes", "organ, scene, mm off (best rigid pose, hidden)"]
    return table(head, body, 4)
