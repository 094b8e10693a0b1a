"""What was judged in sequences, as tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tumortrack.core import store
from tumortrack_lab.study.document import table
from tumortrack_lab.world.paths import KINDS
from tumortrack_lab.world.states import JUMPS

# The twin's D1, D2, D3 leave 4, 7 and 10 mm at most beside their best rigid pose (median of five
# organs; largest displacement of the surface). Bounds lie half way.
STATES = {"at rest": 1.5, "D1": 5.8, "D2": 8.8, "D3": np.inf}
WRONG_MM, FAILED_MM = 3.0, 5.0  # a centre farther off must not be called good
KEPT_S = 1.0  # a wrong state that lasts so long was kept
_AS_GOOD_MM = 0.5  # more than a first look at the same frame has
_OPEN, _HIDDEN = 0.05, (0.3, 0.5)  # shares of the organ that something hides
_FRAME = ["organ", "sequence", "time_s"]


def rows_in(out: Path) -> list[dict[str, Any]]:
    """Of all sequences and methods that were judged in a folder."""
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
                since_s, jump = [one for one in jumps if one[0] <= row["time_s"] + 1e-6][-1]
                rows.append({**about, **row, "phase": phase, "jump": jump, "since_s": since_s})
    return rows


def summary(rows: pd.DataFrame) -> str:
    """Markdown: errors by state and site, how far verdicts can be relied on, what jumps and hands
    do, and which wrong states were kept."""
    one = rows["method"].isin(["track", "first-look"])
    also = rows.merge(rows.loc[~one, ["organ", "sequence"]].drop_duplicates())
    frames = _frames(rows)
    parts = [_errors(rows[one]), _errors(also), _verdicts(frames)]
    parts += [_jumps(frames[frames["kind"] == "jump"]), _hiding(frames[frames["kind"] == "hidden"])]
    return "\n\n".join(filter(None, parts)) + "\n"


def _errors(rows: pd.DataFrame) -> str:
    """Of loads that were solved along their paths."""
    rows = rows[rows["kind"].isin(KINDS)]
    if not len(rows):
        return ""
    bound = np.array(list(STATES.values()))
    state = np.array(list(STATES))[np.searchsorted(bound, rows["bend_mm"])]
    rows = rows.assign(state=pd.Categorical(state, list(STATES)))
    methods = sorted(set(rows["method"]))
    head = ["state", "tumor", "organs", "frames", "best rigid pose", *methods]
    body = []
    for (severity, site), mine in rows.groupby(["state", "site"], observed=True):
        each = [mine[mine["method"] == method] for method in methods]
        count = str(mine["organ"].nunique()), str(len(each[0]))
        cells = [severity, site, *count, _of_organs(each[0], "rigid_center_mm")]
        for its in each:
            both = (_of_organs(its, key) for key in ("center_mm", "hausdorff_mm"))
            cells.append(" / ".join(both))
        body.append(cells)
    return (
        f"{table(head, body, 2)}\n\nmm: centre / Hausdorff distance; median over organs of the "
        "median over all frames with an estimate (good or poor) [worst organ]. State: by the "
        "largest displacement beside the best rigid pose, up to "
        f"{', '.join(f'{mm:g}' for mm in bound[:-1])} mm, and more."
    )


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


def _verdicts(frames: pd.DataFrame) -> str:
    """By method and kind; and by name where a wrong state was called good for over a second."""
    body, named = [], []
    for (method, kind), mine in frames.groupby(["method", "kind"]):
        spans = []
        for (organ, name), one in mine.groupby(["organ", "sequence"]):
            times, its = one["time_s"].tolist(), one[one["wrong"]]
            spans.append([longest_s(times, one[key].tolist()) for key in ("wrong", "failed")])
            if spans[-1][0] > KEPT_S:
                off, rigid = (its[key].median() for key in ("center_mm", "rigid_center_mm"))
                named.append(
                    f"{method} in {organ} {name}, {spans[-1][0]:.1f} s ({spans[-1][1]:.1f} s over "
                    f"5 mm), {off:.1f} mm off (best rigid pose {rigid:.1f}), "
                    f"{100 * its['hidden_share'].median():.0f} % hidden"
                )
        shares = [f"{100 * (mine['quality'] == q).mean():.0f}" for q in ("good", "poor")]
        kept = [str(int((np.array(spans)[:, n] > KEPT_S).sum())) for n in (0, 1)]
        cells = [method, kind, str(len(spans)), str(len(mine)), *shares]
        wrong = f"{100 * mine['wrong'].mean():.1f}", f"{np.max(spans, axis=0)[0]:.1f}"
        body.append([*cells, *wrong, *kept])
    head = ["method", "kind", "sequences", "frames", "good, %", "poor, %", "good and over 3 mm, %"]
    head += ["longest, s", "kept over 1 s", "over 5 mm kept over 1 s"]
    return (
        f"{table(head, body, 2)}\n\nOver 3 mm: the centre of any tumor. Longest, kept: good and "
        "over 3 mm (5 mm) off without a break; sequences. Kept over a second: "
        f"{'; '.join(named) or 'none'}."
    )


def _jumps(frames: pd.DataFrame) -> str:
    """How long after a jump the follower is worse than a first look at the same frames."""
    both = {method: mine.set_index(_FRAME) for method, mine in frames.groupby("method")}
    if not {"track", "first-look"} <= set(both):
        return ""
    track, body = both["track"], []
    first = both["first-look"].reindex(track.index)
    near = track["center_mm"] <= first["center_mm"] + _AS_GOOD_MM
    track = track.assign(as_good=near | (first["quality"] == "none"), first=first["wrong"])
    gone = track["hidden_share"] == 1
    for kind in JUMPS:
        counts, meanwhile = [], 0
        mine = track[(track["jump"] == kind) & ~gone]
        for _, after in mine.groupby(["organ", "sequence", "since_s"]):
            good = [*after["as_good"], True]
            counts.append(good.index(True) + 1)
            meanwhile += int(after["wrong"].iloc[: counts[-1] - 1].sum())
        if counts:
            within = f"{100 * np.mean(np.array(counts) <= 3):.0f}"
            cells = [kind, str(len(counts)), f"{np.median(counts):.0f} [{max(counts)}]", within]
            later = meanwhile, mine["wrong"].sum(), mine["first"].sum(), len(mine)
            body.append([*cells, *(str(int(count)) for count in later)])
    head = ["jump", "jumps", "frames until as good as a first look [worst]", "within three, %"]
    head += ["good and over 3 mm until then", "in all: track", "first look", "of frames"]
    return (
        f"{table(head, body)}\n\nAs good: within {_AS_GOOD_MM:g} mm of a first look at the same "
        f"frame, or that finds nothing. While the organ was gone, {track[gone]['wrong'].sum()} of "
        f"{gone.sum()} frames were called good."
    )


def _hiding(frames: pd.DataFrame) -> str:
    """Errors while 30 to 50 % of the organ are hidden, against the same sequence's open frames."""
    body = []
    for method, mine in frames.groupby("method"):
        ratios = []
        for (organ, _), one in mine.groupby(["organ", "sequence"]):
            behind = one[one["hidden_share"].between(*_HIDDEN)]
            bare = one[one["hidden_share"] < _OPEN]["targets_mm"].median()
            off = behind["targets_mm"].median()
            ratios.append((organ, bare, off, off / bare))
        found = pd.DataFrame(ratios, columns=["organ", "open", "behind", "ratio"])
        cells = [_of_organs(found, key) for key in ("open", "behind", "ratio")]
        behind = mine[mine["hidden_share"].between(*_HIDDEN)]
        shares = [f"{100 * (behind['quality'] == q).mean():.0f}" for q in ("good", "none")]
        counts = str(len(found)), *cells, f"{found['ratio'].max():.1f}"
        body.append([method, *counts, *shares, f"{behind['wrong'].sum()} of {len(behind)}"])
    head = ["method", "sequences", "target error, open, mm", "30-50 % hidden", "times as large"]
    head += ["worst sequence", "good, %", "none, %", "good and over 3 mm"]
    said = "Median over organs of the median over sequences [worst organ]; verdicts while hidden."
    return f"{table(head, body)}\n\n{said}" if body else ""


def longest_s(times_s: list[float], wrong: list[bool]) -> float:
    """How long the longest unbroken run of wrong frames lasted, until the frame that ended it."""
    begun, longest = None, 0.0
    for now, is_wrong in zip([*times_s, times_s[-1]], [*wrong, False], strict=True):
        if is_wrong and begun is None:
            begun = now
        elif not is_wrong and begun is not None:
            longest, begun = max(longest, now - begun), None
    return longest


def _of_organs(rows: pd.DataFrame, key: str) -> str:
    medians = rows.groupby("organ")[key].median().dropna()
    return f"{medians.median():.1f} [{medians.max():.1f}]" if len(medians) else "–"
