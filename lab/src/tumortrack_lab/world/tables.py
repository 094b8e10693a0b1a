"""Tables of the errors in sequences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tumortrack.core import store
from tumortrack_lab.world.paths import KINDS
from tumortrack_lab.world.states import JUMPS

# The twin's D1, D2, D3 leave 4, 7 and 10 mm at most beside their best rigid pose (median of five
# organs; largest displacement of the surface). Bounds lie half way.
STATES = {"at rest": 1.5, "D1": 5.8, "D2": 8.8, "D3": np.inf}
WRONG_MM, FAILED_MM = 3.0, 5.0  # a centre farther off must not be called good
KEPT_S = 1.0  # a wrong state that lasts longer counts as kept
_AS_GOOD_MM = 0.5  # more than a first look at the same frame has
_OPEN, _HIDDEN = 0.05, (0.3, 0.5)  # shares of the organ that something hides
_FRAME = ["organ", "sequence", "time_s"]
_OFF = {"centre, mm": "center_mm", "Hausdorff, mm": "hausdorff_mm"}
_RIGID = {"best rigid pose": "rigid_center_mm", "rigid fit": "rigid_fit_center_mm"}
# What each table has, for its link.
WORDS = {
    "errors": "Errors by state, tumor and method",
    "verdicts": "Verdicts by method and kind of sequence",
    "kept": "Wrong states that were called good for over a second",
    "jumps": "What the follower does after a jump",
    "hidden": "Errors while 30 to 50 % of the organ is hidden",
}


def rows_in(out: Path) -> list[dict[str, Any]]:
    """Rows of all sequences and methods in a folder."""
    rows = []
    for path in sorted(out.glob("*-[0-9]*/*.json")):
        kept = store.read_json(path)
        if "rows" in kept:
            kind, about = path.parent.name.partition("-")[0], {"method": path.stem}
            about |= {"organ": out.name, "sequence": path.parent.name, "kind": kind}
            meta = store.read_json(path.parent / "meta.json")
            phases, jumps = meta["phases_s"], [(-np.inf, "none"), *meta.get("jumps", [])]
            for row in kept["rows"]:
                phase = np.interp(row["time_s"], phases, range(len(phases)))
                since_s, jump = [event for event in jumps if event[0] <= row["time_s"] + 1e-6][-1]
                rows.append({**about, **row, "phase": phase, "jump": jump, "since_s": since_s})
    return rows


def tables(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """The tables of ``WORDS`` that are not empty: medians over organs of the median over frames or
    sequences, with the worst organ's."""
    single = rows["method"].isin(["track", "first-look"])
    also = rows.merge(rows.loc[~single, ["organ", "sequence"]].drop_duplicates())
    frames = _frames(rows)
    errors = [*_errors(rows[single], "all"), *_errors(also, "with three cameras")]
    jumps, hidden = (frames[frames["kind"] == kind] for kind in ("jump", "hidden"))
    lists = [errors, *_verdicts(frames), _jumps(jumps), _hiding(hidden)]
    made = zip(WORDS, lists, strict=True)
    return {name: pd.DataFrame(its).round(1).convert_dtypes() for name, its in made if its}


def _errors(rows: pd.DataFrame, sequences: str) -> list[dict[str, Any]]:
    """Of loads that were solved along their paths."""
    rows = rows[rows["kind"].isin(KINDS)]
    state = np.array(list(STATES))[np.searchsorted(list(STATES.values()), rows["bend_mm"])]
    rows = rows.assign(state=pd.Categorical(state, list(STATES)))
    lines, methods = [], sorted(set(rows["method"]))
    for (severity, site), mine in rows.groupby(["state", "site"], observed=True):
        each = {method: mine[mine["method"] == method] for method in methods}
        first = each[methods[0]]
        rigid = {
            words: first.assign(center_mm=first[column], hausdorff_mm=np.nan)
            for words, column in _RIGID.items()
            if column in first  # older rows have no fits
        }
        about = {"sequences": sequences, "state": severity, "tumor": site}
        about |= {"organs": mine["organ"].nunique(), "frames": len(first)}
        for method, its in {**rigid, **each}.items():
            lines.append({**about, "method": method, **_of_organs(its, _OFF)})
    return lines


def _frames(rows: pd.DataFrame) -> pd.DataFrame:
    """A line a frame: of its tumors the one that is farthest off."""
    keys, same = ["method", "kind", *_FRAME], ["quality", "hidden_share", "jump", "since_s"]
    how = dict.fromkeys([*same, "targets_mm"], "first")
    how |= dict.fromkeys(["center_mm", "rigid_center_mm"], "max")
    rows = rows.reindex(columns=[*keys, *how])
    frames = rows.groupby(keys, observed=True).agg(how).reset_index()
    good = frames["quality"] == "good"
    wrong, failed = (good & (frames["center_mm"] > mm) for mm in (WRONG_MM, FAILED_MM))
    return frames.assign(wrong=wrong, failed=failed)


def _verdicts(frames: pd.DataFrame) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """By method and kind; and where a wrong state was called good for over a second."""
    lines, kept = [], []
    for (method, kind), mine in frames.groupby(["method", "kind"]):
        spans = []
        for (organ, name), sequence in mine.groupby(["organ", "sequence"]):
            times, its = sequence["time_s"].tolist(), sequence[sequence["wrong"]]
            spans.append([longest_s(times, sequence[key].tolist()) for key in ("wrong", "failed")])
            if spans[-1][0] > KEPT_S:
                row = {"method": method, "organ": organ, "sequence": name}
                row |= zip(["over 3 mm, s", "over 5 mm, s"], spans[-1], strict=True)
                row["centre, mm"] = its["center_mm"].median()
                row["best rigid pose, mm"] = its["rigid_center_mm"].median()
                kept.append(row | {"hidden, %": 100 * its["hidden_share"].median()})
        row = {"method": method, "kind": kind, "sequences": len(spans), "frames": len(mine)}
        row |= _shares(mine, "good", "poor")
        row["good and over 3 mm, %"] = 100 * mine["wrong"].mean()
        row["longest of these, s"] = max(span[0] for span in spans)
        for n, mm in enumerate((WRONG_MM, FAILED_MM)):
            row[f"over {mm:g} mm for over 1 s"] = sum(span[n] > KEPT_S for span in spans)
        lines.append(row)
    return lines, kept


def _jumps(frames: pd.DataFrame) -> list[dict[str, Any]]:
    """How long the follower is worse than a first look at the same frames after a jump."""
    both = {method: mine.set_index(_FRAME) for method, mine in frames.groupby("method")}
    if not {"track", "first-look"} <= set(both):
        return []
    track, lines = both["track"], []
    first = both["first-look"].reindex(track.index)
    near = track["center_mm"] <= first["center_mm"] + _AS_GOOD_MM
    track = track.assign(as_good=near | (first["quality"] == "none"), first=first["wrong"])
    gone, wrong = track["hidden_share"] == 1, "good and over 3 mm"
    for kind in JUMPS:
        counts, meanwhile = [], 0
        mine = track[(track["jump"] == kind) & ~gone]
        for _, after in mine.groupby(["organ", "sequence", "since_s"]):
            counts.append([*after["as_good"], True].index(True) + 1)
            meanwhile += after["wrong"].iloc[: counts[-1] - 1].sum()
        if counts:
            row = {"jump": kind, "jumps": len(counts), "frames": len(mine)}
            row |= {"frames until as good as a first look": np.median(counts), "worst": max(counts)}
            row["within three frames, %"] = 100 * np.mean(np.array(counts) <= 3)
            row |= {f"{wrong} until then": meanwhile, f"{wrong}: track": mine["wrong"].sum()}
            lines.append(row | {f"{wrong}: first-look": mine["first"].sum()})
    row = {
        "jump": "organ gone",
        "frames": gone.sum(),
        f"{wrong}: track": track[gone]["wrong"].sum(),
    }
    return [*lines, row] if gone.any() else lines


def _hiding(frames: pd.DataFrame) -> list[dict[str, Any]]:
    """Errors while 30 to 50 % of the organ are hidden, against the same sequence's open frames."""
    rows, times = [], "hidden / open"
    for method, mine in frames.groupby("method"):
        ratios = []
        for (organ, _), sequence in mine.groupby(["organ", "sequence"]):
            behind = sequence[sequence["hidden_share"].between(*_HIDDEN)]["targets_mm"].median()
            bare = sequence[sequence["hidden_share"] < _OPEN]["targets_mm"].median()
            ratios.append((organ, bare, behind, behind / bare))
        of = ["targets when open, mm", "targets when hidden, mm", times]
        each = pd.DataFrame(ratios, columns=["organ", *of])
        behind = mine[mine["hidden_share"].between(*_HIDDEN)]
        row = {"method": method, "sequences": len(each)}
        row |= _of_organs(each, dict(zip(of, of, strict=True)))
        row[f"{times}, worst sequence"] = each[times].max()
        row |= _shares(behind, "good", "none")
        rows.append(row | {"good and over 3 mm": behind["wrong"].sum(), "frames": len(behind)})
    return rows


def longest_s(times_s: list[float], wrong: list[bool]) -> float:
    """How long the longest unbroken run of wrong frames lasted, until the frame that ended it."""
    begun, longest = None, 0.0
    for now, is_wrong in zip([*times_s, times_s[-1]], [*wrong, False], strict=True):
        if is_wrong and begun is None:
            begun = now
        elif not is_wrong and begun is not None:
            longest, begun = max(longest, now - begun), None
    return longest


def _shares(frames: pd.DataFrame, *qualities: str) -> dict[str, float]:
    return {f"{each}, %": 100 * (frames["quality"] == each).mean() for each in qualities}


def _of_organs(rows: pd.DataFrame, columns: dict[str, str]) -> dict[str, float]:
    """Of each column, under its name: median and largest of the organs' medians."""
    spread: dict[str, float] = {}
    for name, key in columns.items():
        medians = rows.groupby("organ")[key].median()
        spread |= {name: medians.median(), f"{name}, worst organ": medians.max()}
    return spread
