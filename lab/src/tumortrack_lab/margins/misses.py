"""Learns ``tumortrack.assessment.bound`` from located scenes, and tests it on what is left out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import nnls
from scipy.stats import spearmanr

from tumortrack.assessment.bound import POOR_MM, MissModel, figures
from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import FAR_MM
from tumortrack.core.geometry import transform_points
from tumortrack.core.report import FAR_OFF
from tumortrack.core.types import DepthFrame
from tumortrack.registration.model import RegistrationModel
from tumortrack.report.rivals import best_rigid_pose, rigid_fit
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.tracker import Tracker

_CONFIDENCE = 0.95
_LEAST_MM, _LOST_MM = 0.1, 30.0  # misses: less is noise; more are other minima, which fits refuse
_ANSWER = ["kidney", "scene", "by"]
_ABOUT = {*_ANSWER, "family", "tumor", "miss_mm", "rigid_fit_mm", "finding", "radius_mm"}


def rows_of(tracker: Tracker, scene: Scene) -> Iterator[dict[str, Any]]:
    """A row a tumor and kind of judging, by the cloud alone or with its depth image: its miss and
    that of a rigid fit to the same points from the best rigid pose, its figures, and the verdict so
    far. A scene without an answer has none."""
    model = tracker.model
    assert scene.targets is not None
    assert isinstance(model, RegistrationModel)
    targets, names = scene.targets, model.parts
    start, _ = best_rigid_pose(model.shape.anatomy_ct, scene)
    rigid = rigid_fit(model.shape.distances[0], scene.cloud, start)
    rigid_away_mm = transform_points(rigid, targets.points_ct) - targets.points_mm
    for seen in (None, scene.depth):
        try:
            estimate = tracker.locate(scene.cloud, 16, 0, seen)
        except NoEstimate:
            continue
        assert estimate.motion is not None
        moved, finding = estimate.motion.carry(targets.points_ct), estimate.finding
        for label, name in enumerate(names[1:], start=2):
            mine = targets.labels == label
            known = figures(estimate.report, name)
            if not mine.any() or known is None:
                continue
            away_mm = (moved[mine] - targets.points_mm[mine]).mean(0)
            yield {
                "family": scene.meta["family"],
                "by": "image" if isinstance(seen, DepthFrame) else "cloud",
                "tumor": name,
                "miss_mm": float(np.linalg.norm(away_mm)),
                "rigid_fit_mm": float(np.linalg.norm(rigid_away_mm[mine].mean(0))),
                "finding": None if finding is None else finding.kind,
                **known,
            }


def learned(rows: pd.DataFrame, about: dict[str, Any]) -> MissModel:
    """Weights of least squares, none negative, then the constant under which 95 % of the misses lie
    within the radius: of answers that nothing else speaks against."""
    names = [name for name in rows.columns if name not in _ABOUT]
    near = rows[rows.miss_mm < _LOST_MM]
    values = np.column_stack([near[names], np.ones(len(near)), -np.ones(len(near))])
    logs = np.log(near.miss_mm.clip(lower=_LEAST_MM))
    *weights, _, _ = nnls(values, logs.to_numpy())[0]
    calm = rows[_acceptable(rows)]
    left = np.log(calm.miss_mm.clip(lower=_LEAST_MM)) - calm[names].to_numpy() @ weights
    rank = min(int(np.ceil((len(left) + 1) * _CONFIDENCE)), len(left))
    constant = float(np.sort(left)[rank - 1])
    kept = {name: round(float(w), 4) for name, w in zip(names, weights, strict=True) if w > 0}
    return MissModel(fingerprint(), round(constant, 4), kept, {**about, "answers": len(rows)})


def left_out(rows: pd.DataFrame, part: str, by: str | None = None) -> pd.DataFrame:
    """What it says of each kidney or family when it was learned from the others; a line for each of
    these, or of ``by``, beside a rigid fit. An answer is good if that holds for all its tumors."""
    rows = rows.assign(radius_mm=np.nan)
    for name in rows[part].unique():
        mine = rows[part] == name
        model = learned(rows[~mine], {})
        each = rows[mine][[*model.weights]].to_dict("records")
        rows.loc[mine, "radius_mm"] = [model.radius_mm(known) for known in each]
    near = _acceptable(rows) & (rows.radius_mm <= POOR_MM)
    good = near.groupby([rows[name] for name in _ANSWER]).transform("all")
    lines = []
    for name, some in [*rows.groupby(by or part), ("all", rows)]:
        calm, mine = some[_acceptable(some)], some[good[some.index]]
        lines.append({
            by or part: name,
            "answers": len(some),
            "good %": round(100 * len(mine) / len(some)),
            "miss of good, mm: median": round(mine.miss_mm.median(), 1),
            "95 %": round(mine.miss_mm.quantile(0.95), 1),
            "worst": round(mine.miss_mm.max(), 1),
            "rigid fit: median": round(mine.rigid_fit_mm.median(), 1),
            "its 95 %": round(mine.rigid_fit_mm.quantile(0.95), 1),
            "over 5 mm": int((mine.miss_mm > FAR_MM).sum()),
            "within the radius %": round(100 * (calm.miss_mm <= calm.radius_mm).mean(), 1),
            "radius, median": round(calm.radius_mm.median(), 1),
            "rank correlation": round(spearmanr(some.miss_mm, some.radius_mm)[0], 2),
        })  # fmt: skip
    return pd.DataFrame(lines)


def _acceptable(rows: pd.DataFrame) -> pd.Series:
    """Whether nothing but what was learned speaks against an answer."""
    return rows.finding.isna() | rows.finding.isin(FAR_OFF)
