"""Measurements as one tidy table (a row for each measurement and part), and figures of its columns.

Over scenes: medians, a part that was not found counting as infinitely far (``protocol.RULE``).
Over seeds: mean and standard deviation (n - 1); where a seed has no finite number, how many have.
In the table, and in every figure, infinite means not found.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

NOT_FOUND, NOTHING, EMPTY = "not found", "–", ""
ORGAN = "kidney"  # its rows stand for their measurements
DISTANCES = ("hausdorff_one_sided_mm", "hausdorff_mm", "hausdorff_95_mm", "center_mm")
POINTS = ("depth_mm", "displacement_mm", "error_mm")  # of points of a tumor's surface: lists
_SCENE = ("case", "scene", "variant", "view", "fault", "fault_seed")
_NUMBERS = [*DISTANCES, "iou", "miou", "target_mm", "frame_s", "prepare_s"]
_ORDERED = ["case", "variant", "view", "fault", "method", "part"]


def tidy(measurements: list[dict]) -> pd.DataFrame:
    """One row for each measurement and part. Columns of names are ordered as they first appear."""
    rows = []
    for one in measurements:
        spec, method, targets = one["spec"], one["spec"]["method"], one["targets_mm"]
        whole = {
            **{key: spec[key] for key in _SCENE},
            "method": method["name"],
            "kind": method.get("kind"),
            "seed": method.get("seed", 0),
            "device": one.get("method", {}).get("device"),
            "failed": one["failed"] is not None,
            "carries": bool(targets),  # whether the method carries points
            "target_mm": targets["mean"] if targets else None,
            **{key: one.get(key) for key in ("miou", "frame_s", "prepare_s")},
        }
        for part, metrics in one["parts"].items():
            found = {key: metrics.get(key) for key in DISTANCES if metrics["found"]}
            points = one.get("points", {}).get(part, {})
            lists = {key: points.get(key) for key in POINTS}
            rows.append({**whole, "part": part, "iou": metrics.get("iou"), **found, **lists})
    frame = pd.DataFrame(rows).reindex(columns=[*whole, "part", "iou", *DISTANCES, *POINTS])
    frame[_NUMBERS] = frame[_NUMBERS].astype(float).fillna(np.inf)
    return ordered(frame, _ORDERED)


def ordered(frame: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Columns that sort, and group, in the order in which their values first appear."""
    return frame.assign(**{key: pd.Categorical(frame[key], frame[key].unique()) for key in columns})


def groups(frame: pd.DataFrame, *keys: str) -> Iterator[tuple[tuple, pd.DataFrame]]:
    """The rows of each combination of values that there is."""
    return iter(frame.groupby(list(keys), observed=True))


def names(frame: pd.DataFrame, key: str) -> list[str]:
    """Distinct values of a column, in the order of the table's."""
    return [name for (name,), _ in groups(frame, key)]


def tumors(frame: pd.DataFrame) -> pd.DataFrame:
    return frame[frame.part != ORGAN]


def scenes(frame: pd.DataFrame) -> pd.DataFrame:
    """One row for each measurement."""
    return frame[frame.part == ORGAN]


def by_seed(frame: pd.DataFrame, column: str) -> pd.Series:
    """Median over the rows of each seed."""
    return frame.groupby("seed")[column].median()


def text(values: pd.Series, digits: int = 1) -> str:
    """Of one value a seed: ``4.2 ± 0.3``; ``4.2`` for one seed; ``5.0 (2 of 3)``: the median by the
    rule, where a seed has none; ``not found``."""
    if values.empty:
        return NOTHING
    finite = int(np.isfinite(values).sum())
    if finite == len(values):
        spread = f" ± {values.std():.{digits}f}" if finite > 1 else ""
        return f"{values.mean():.{digits}f}{spread}"
    middle = values.median()
    if np.isinf(middle):
        return NOT_FOUND
    return f"{middle:.{digits}f} ({finite} of {len(values)})"


def change(here: pd.Series, base: pd.Series) -> str:
    """A figure, and in brackets how much it is above its base."""
    means = here.mean(), base.mean()
    if not np.isfinite(means).all() or np.array_equal(here, base):
        return text(here)
    return f"{text(here)} ({round(means[0] - means[1], 1) + 0.0:+.1f})"  # no minus before a zero
