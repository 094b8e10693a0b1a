"""How far margins can be trusted: rows of `tumortrack margins`, tested on physics and organs that
were left out of the calibration. The results are in docs/trust.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest, spearmanr

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.rigid_fit import kabsch
from tumortrack.registration.rest_shape import RestShape
from tumortrack.report.drawing import new_figure, save
from tumortrack.report.metrics import outward_miss
from tumortrack.report.pictures import FROM_CAMERA, FROM_SIDE, draw_solid_view, scene_legend
from tumortrack.report.rivals import best_rigid_pose, rigid_fit
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack.tracking.margins import ModelMargins
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.margins.calibration import WIDEST_MM, answered, margins_of
from tumortrack_lab.margins.table import Row
from tumortrack_lab.study.document import spread_mm

STATED = (0.9, 0.95)
_CURVE = tuple(np.round(np.arange(0.5, 0.96, 0.05), 2).tolist())  # of the reliability plot
_HIDDEN = (0.0, 0.4)  # shares of the surface: bounds between the bands
BANDS = ("nothing hidden", "up to 40 %", "over 40 %")
_BEYOND_MM = {3.0: "#0072B2", 5.0: "#E69F00", 8.0: "#D55E00"}  # Okabe and Ito


def states_of(rows: Sequence[Row]) -> pd.DataFrame:
    """A line a state: family, organ, band of hidden surface, how the CT's segmentation errs,
    whether its estimate is good, and of the tumors the largest miss (mm), the largest standard
    deviation (mm) and whether all lie within ``two`` of their own."""
    lines = []
    for row in rows:
        meta = store.read_json(Path(row.scene) / "meta.json")
        line: dict[str, Any] = {"family": row.label[0], "organ": row.label[2]}
        line["hidden"] = band_of(meta.get("hidden_share", 0.0))
        line["segmentation"] = meta.get("segmentation", {}).get("kind", "none")
        line |= {"good": not row.doubt, "row": row}
        if not row.doubt:
            line["miss"] = row.score("tumor", None)
            line["s"] = max(s or 0.0 for _, s in row.misses["tumor"])
            line["two"] = all(miss <= 2 * (s or 0.0) for miss, s in row.misses["tumor"])
        lines.append(line)
    return pd.DataFrame(lines)


def band_of(hidden_share: float) -> str:
    return BANDS[int(np.searchsorted(_HIDDEN, hidden_share))]


def left_out(states: pd.DataFrame, parts: pd.Series, seed: int, **how: Any) -> pd.DataFrame:
    """The states judged part by part with a calibration on the other parts: ``accepted``; of every
    good estimate by confidence ``mm`` (the largest radius of its tumors) and ``within`` (all of
    them); ``refused``: why there is no calibration without this part."""
    judged = states.assign(part=parts, accepted=False, refused="")
    for part in sorted(parts.unique()):
        mine = judged.index[parts == part]
        try:
            rest = [*states.row[parts != part]]
            margins = margins_of(rest, "", tuple(_CURVE), seed=seed, **how)
        except InputError as error:
            judged.loc[mine, "refused"] = str(error)
            continue
        for n in mine:
            for name, value in _judged(judged.row[n], margins).items():
                judged.loc[n, name] = value
    if judged.refused.all():
        raise InputError(judged.refused.iloc[0])
    return judged


def _judged(row: Row, margins: ModelMargins) -> dict[str, Any]:
    if row.doubt:
        return {}
    result: dict[str, Any] = {"accepted": answered(row, margins)}
    for shells in margins.shells:
        radius = shells.radii["tumor"]
        radii = [radius.at(s, row.measured) for _, s in row.misses["tumor"]]
        result[f"mm {shells.confidence}"] = max(np.inf if at is None else at for at in radii)
        result[f"within {shells.confidence}"] = row.within("tumor", radius)
    return result


def rigid_miss(shape: RestShape, scene: Scene) -> float:
    """Largest outward miss of a tumor by a rigid fit to the cloud, from the best rigid pose, mm."""
    start, _ = best_rigid_pose(shape.anatomy_ct, scene)
    pose = rigid_fit(shape.distances[0], scene.cloud, start)
    pairs = zip(shape.anatomy_ct.tumors, scene.reference.tumors, strict=True)
    placed = ((ct.moved(transform_points(pose, ct.vertices_mm)), truth) for ct, truth in pairs)
    return max(outward_miss(tumor, truth) for tumor, truth in placed)


def share_words(hits: int, cases: int) -> str:
    """A share with Clopper and Pearson's interval of 95 %."""
    if not cases:
        return "-"
    low, high = binomtest(hits, cases).proportion_ci(0.95, "exact")
    return f"{100 * hits / cases:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def coverage(kinds: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """A row for each part of each way of leaving out: share of answers, and by stated confidence
    the coverage and the margins' sizes. Parts without a calibration have no answers and are not
    counted."""
    rows = []
    for what, judged in kinds.items():
        every = ("all of these", judged[judged.refused == ""])
        for name, mine in [*judged.groupby("part", sort=True), every]:
            row = {"left out": what, "part": name, "states": len(mine), "good": mine.good.sum()}
            taken = mine[mine.accepted.astype(bool)]
            row["answers %"] = f"{100 * len(taken) / len(mine):.0f}" if len(taken) else ""
            row["answers"] = len(taken)
            for stated in STATED if len(taken) else ():
                of, margin = f"{100 * stated:g} %", taken[f"mm {stated}"].astype(float)
                row[f"within {of}"] = share_words(int(taken[f"within {stated}"].sum()), len(taken))
                for words, share in (("median", 0.5), ("90 %", 0.9)):
                    row[f"{of} margin {words} mm"] = f"{margin.quantile(share):.1f}"
            for words, key in (("miss", "miss"), ("rigid fit's", "rigid")):
                row[f"{words} 95 % mm"] = f"{taken[key].quantile(0.95):.1f}" if len(taken) else ""
            rows.append(row)
    return pd.DataFrame(rows).fillna("")


def by_family(coverage: pd.DataFrame) -> pd.DataFrame:
    """A row for each family, a column for each kind of evidence: share within the 95 % margin and
    its median, of so many answers."""
    mine = coverage[coverage["left out"] == "organ, by family"]
    within = mine["within 95 %"].str.split(" ").str[0]
    mine = mine.assign(
        cell=within + " / " + mine["95 % margin median mm"] + " (" + mine.answers.astype(str) + ")"
    )
    table = mine.pivot(index="part", columns="evidence", values="cell")
    table = table.loc[mine.part.unique(), mine.evidence.unique()]
    rigid = mine.drop_duplicates("part").set_index("part")["rigid fit's 95 % mm"]
    return table.assign(**{rigid.name: rigid}).reset_index(names="family")


def ranks(judged: pd.DataFrame) -> pd.DataFrame:
    """Of good estimates, limits or not: misses, and their rank correlation with the standard
    deviation, and with the 95 % radius by a calibration without the state's part."""
    rows, good, radius = [], judged[judged.good], f"mm {STATED[-1]}"
    for name, mine in [*good.groupby("family"), *good.groupby("organ"), ("all", good)]:
        known = mine[mine[radius].notna()]
        row = {"family or organ": name, "good": len(mine), **spread_mm("miss", mine.miss)}
        row[f"over {WIDEST_MM:g} mm"] = (mine.miss > WIDEST_MM).sum()
        row["within two deviations %"] = f"{100 * mine.two.mean():.0f}"
        for words, key in (("deviation", "s"), ("95 % radius", radius)):
            rank = spearmanr(known[key], known.miss)[0]
            row[f"{words} and miss"] = "" if np.isnan(rank) else f"{rank:.2f}"
        rows.append(row)
    return pd.DataFrame(rows)


def risk_picture(judged: pd.DataFrame, path: Path) -> None:
    """Share of answers that are farther off than some mm, as answers are given down to a limit on
    the stated 95 % radius; a dot: with the limits that the calibrations found."""
    drawing = new_figure(8.6, 4.4, left=0.09, right=0.98, top=0.9, bottom=0.13)
    judged = judged[judged.refused == ""]
    axes, good = drawing.add_subplot(), judged[judged.good]
    order = good.sort_values(f"mm {STATED[-1]}")
    share = 100 * np.arange(1, len(order) + 1) / len(judged)
    taken = judged[judged.accepted.astype(bool)]
    for far_mm, color in _BEYOND_MM.items():
        beyond = 100 * np.cumsum(order.miss > far_mm) / np.arange(1, len(order) + 1)
        axes.plot(share, beyond, color=color, lw=2, label=f"over {far_mm:g} mm off")
        axes.plot(100 * len(taken) / len(judged), 100 * (taken.miss > far_mm).mean(), "o", c=color)
    axes.set(xlabel="answered: share of all states, %", ylabel="of these farther off, %")
    axes.set(xlim=(0, 100), ylim=(0, None))
    _finish(axes, "Risk against coverage: the surest answers first; dots: with the limits")
    save(drawing, path)


def reliability_picture(kinds: dict[str, pd.DataFrame], path: Path) -> None:
    """Stated confidence against the share found within the margin, a line a way of leaving out."""
    drawing = new_figure(6.4, 5.4, left=0.12, right=0.97, top=0.91, bottom=0.11)
    axes = drawing.add_subplot()
    axes.plot([50, 95], [50, 95], color="0.5", lw=1, ls="--", label="as stated")
    for (name, judged), color in zip(kinds.items(), _BEYOND_MM.values(), strict=False):
        taken = judged[judged.accepted.astype(bool)]
        hits = [int(taken[f"within {stated}"].sum()) for stated in _CURVE]
        bands = [binomtest(n, len(taken)).proportion_ci(0.95, "exact") for n in hits]
        x, y = 100 * np.array(_CURVE), 100 * np.array(hits) / len(taken)
        low, high = 100 * np.array([(band.low, band.high) for band in bands]).T
        axes.fill_between(x, low, high, color=color, alpha=0.13, lw=0)
        axes.plot(x, y, "o-", color=color, ms=4, label=name)
        for _, mine in taken.groupby("part"):
            shares = [100 * mine[f"within {stated}"].mean() for stated in _CURVE]
            axes.plot(x, shares, color=color, lw=0.6, alpha=0.5)
    axes.set(xlabel="stated, %", ylabel="found within the margin, %")
    _finish(axes, "Stated and found (thin: each part left out; band: 95 %)")
    save(drawing, path)


def worst_picture(
    judged: pd.DataFrame, models: Mapping[str, Path], count: int, path: Path
) -> pd.DataFrame:
    """Draw the accepted answers with the largest errors over the truth, a row each; returns their
    table. ``models``: folders, by organ."""
    taken = judged[judged.accepted.astype(bool)].nlargest(count, "miss")
    trackers: dict[str, Tracker] = {}
    height = 2.75 * len(taken) + 0.5
    drawing = new_figure(8.4, height)
    panels, rows = drawing.subplots(len(taken), 2, squeeze=False), []
    drawing.subplots_adjust(
        left=0.045, top=1 - 0.7 / height, bottom=0.1 / height, hspace=0.16, wspace=0.03
    )
    for number, (row, (_, state)) in enumerate(zip(panels, taken.iterrows(), strict=True), start=1):
        if state.organ not in trackers:
            model = load_model(models[state.organ], "cpu", with_margins=False)
            trackers[state.organ] = Tracker(model)
        scene = read_scene(Path(state["row"].scene))
        estimate = trackers[state.organ].locate(scene.cloud, 8, 0, scene.depth)
        for axes, view in zip(row, (FROM_CAMERA, FROM_SIDE), strict=True):
            draw_solid_view(axes, scene, estimate.meshes, view)
        row[0].set_ylabel(f"{number}", fontsize=14, fontweight="bold", rotation=0, labelpad=10)
        rows.append({
            "row": number, "organ": state.organ, "scene": Path(state["row"].scene).name,
            "off mm": f"{state.miss:.1f}", "95 % radius mm": f"{state[f'mm {STATED[-1]}']:.1f}",
            "hidden": state.hidden, **_moved_rigidly(estimate.motion, scene),
        })  # fmt: skip
    drawing.legend(
        handles=scene_legend(*scene.reference.names), ncols=4, loc="upper right", frameon=False
    )
    save(drawing, path)
    return pd.DataFrame(rows)


def _moved_rigidly(motion: Any, scene: Scene) -> dict[str, str]:
    """The rigid motion between the estimated and the true organ, and the mean error that remains
    after it."""
    assert scene.targets is not None
    there = motion.carry(scene.targets.points_ct)
    best = kabsch(there, scene.targets.points_mm, np.ones(len(there)))
    degrees = np.rad2deg(np.arccos(np.clip((np.trace(best[:3, :3]) - 1) / 2, -1, 1)))
    middle = there.mean(0)
    shift = float(np.linalg.norm(transform_points(best, middle[None])[0] - middle))
    left = np.linalg.norm(transform_points(best, there) - scene.targets.points_mm, axis=1).mean()
    return {
        "beside mm": f"{shift:.1f}",
        "turned degrees": f"{degrees:.0f}",
        "left mm": f"{left:.1f}",
    }


def _finish(axes: Any, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=11)
    axes.grid(color="0.9", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
