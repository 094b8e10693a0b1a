"""Measurements as one tidy table (a row for each measurement and part), and Markdown tables of it.

Accuracy is told by organ, tumor and state: never pooled over organs, and with the worst. Elsewhere,
over scenes: medians, a part that was not found counting as infinitely far (``protocol.RULE``); over
seeds: mean and standard deviation (n - 1); where a seed has no finite number, how many have.
In the table, and in every figure, infinite means not found. Every number comes from a measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
import pandas as pd

from tumortrack_lab.study.document import table
from tumortrack_lab.study.methods import CLINIC
from tumortrack_lab.study.tumor_sites import TumorSite
from tumortrack_lab.twin.faults import KINDS, clean_level, parse

NOT_FOUND, NOTHING, EMPTY = "not found", "–", ""
ORGAN = "kidney"  # its rows stand for their measurements
DISTANCES = ("hausdorff_one_sided_mm", "hausdorff_mm", "hausdorff_95_mm", "center_mm")
POINTS = ("depth_mm", "displacement_mm", "error_mm")  # of points of a tumor's surface: lists
_SCENE = ("case", "scene", "variant", "view", "fault", "fault_seed")
_NUMBERS = [*DISTANCES, "iou", "miou", "target_mm", "frame_s", "prepare_s"]
_ORDERED = ["case", "variant", "view", "fault", "method", "part"]
_BUSY = 1.5  # load above which somebody else than the one measuring process used the machine
METHODS = {
    "M_lim": "slim network, limited turns",  # `quick`: not the paper's network, nor
    "M_full": "slim network, any turn",  # as many scenes as often as the paper's saw
    "rigid_bound": "best rigid pose (oracle)",
    "rigid": "rigid registration, many starts",
    "rigid_any_rotation": "rigid registration, any rotation",
    "cpd": "coherent point drift",
    "bcpd": "Bayesian coherent point drift",
    "elastic": "linear-elastic surface fit",
    "visible_bound": "true visible surface (bound)",
    "basis_bound": "all true surfaces (bound)",
}
CONDITIONS = {
    "fault": {
        "clean": "none (clean depth)",
        "noise": "sensor noise",
        "distortion": "slow distortion",
        "offset": "systematic 2 mm offset",
        "occlusion": "occlusion",
        "outliers": "outliers",
        "registration": "registration, 1 mm and 1 degree",
        "all": "all together",
    },
    "view": {
        "clean": "clean",
        "noise": "sensor noise",
        "shaft": "8 mm shaft in view",
        "clutter": "3 % background points",
    },
}
SEVERITIES = {
    "noise": "sensor noise, times the D405's",
    "visible": "visible surface left, %",
    "outliers": "background points, %",
    "points": "points of the cloud",
    "offset": "depth offset, mm",
    "distance": "distance of the camera, mm",
    "tilt": "tilt of the camera, degrees",
}
FALLING = ("visible", "points")  # severities of which less is more severe
ABLATED = {
    "clinic_unrefined": "not laid on the cloud (no refinement)",
    "clinic_clean": "trained without hidden surface, background, calibration errors",
    "clinic_drags": "trained on the paper's drags in 10 of 11 scenes",
    "clinic_pointnet": "PointNet++ instead of the height map",
    "quick_elastic": "occupancy MLP of `quick` instead of the warp, same scenes",
    "M_lim": "`quick` (its own scenes)",
}
_KEYS = {
    "one-sided HD": "hausdorff_one_sided_mm",
    "HD": "hausdorff_mm",
    "centre": "center_mm",
}
_WHOLE = ("target error", "mIoU", "failed")
Sites = dict[str, TumorSite]


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
            "failed": not all(part["found"] for part in one["parts"].values()),
            "busy": (one.get("provenance", {}).get("load") or 0.0) > _BUSY,
            "carries": bool(targets),  # whether the method carries points
            "target_mm": targets["mean"] if targets else None,
            **{key: one.get(key) for key in ("miou", "frame_s", "prepare_s")},
        }
        for part, metrics in one["parts"].items():
            found = metrics if metrics["found"] else {"iou": metrics.get("iou")}
            rows.append({**whole, "part": part, **found, **one.get("points", {}).get(part, {})})
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


def is_deformed(frame: pd.DataFrame) -> pd.Series:
    """Neither at rest nor turned only."""
    return ~frame.variant.astype(str).str.fullmatch("D0|Rot.*")


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
    return NOT_FOUND if np.isinf(middle) else f"{middle:.{digits}f} ({finite} of {len(values)})"


def change(here: pd.Series, base: pd.Series) -> str:
    """A figure, and in brackets how much it is above its base."""
    means = here.mean(), base.mean()
    if not np.isfinite(means).all() or np.array_equal(here, base):
        return text(here)
    return f"{text(here)} ({round(means[0] - means[1], 1) + 0.0:+.1f})"  # no minus before a zero


def label_of(method: str) -> str:
    return METHODS.get(method, method)


def spread(values: pd.Series, digits: int = 1, high: bool = False) -> str:
    """``median / 90 % / 95 % / worst``: so many are no worse than this (nearest rank); ``high``:
    the lowest is the worst."""
    if values.empty:
        return NOTHING
    each = np.sort(values)[::-1] if high else np.sort(values)
    ranked = [each[-(-len(each) * percent // 100) - 1] for percent in (90, 95, 100)]
    figures = (np.median(each), *ranked)
    return " / ".join(NOT_FOUND if np.isinf(v) else f"{v:.{digits}f}" for v in figures)


def accuracy(frame: pd.DataFrame, sites: Sites) -> str:
    """One case: a row for each state, tumor and figure, a column for each method; each scene of
    each seed counts."""
    rows: list[list[str]] = []
    for state, mine in (("deformed", is_deformed(frame)), ("undeformed", ~is_deformed(frame))):
        each = [frame[mine & (frame.method == method)] for method in names(frame, "method")]
        if not mine.any():
            continue
        for number, (figure, cell) in enumerate(_figures(frame, sites).items()):
            rows.append([*_once(number, state), figure, *map(cell, each)])
    head = ["state", "figure", *map(label_of, names(frame, "method"))]
    return table(head, rows, left=2)


def _figures(frame: pd.DataFrame, sites: Sites) -> dict[str, Callable[[pd.DataFrame], str]]:
    def distance(tumor: str, key: str) -> Callable[[pd.DataFrame], str]:
        return lambda mine: spread(mine[mine.part == tumor][key])

    figures = {"scenes x seeds": lambda mine: f"{mine.scene.nunique()} x {mine.seed.nunique()}"}
    for tumor in names(tumors(frame), "part"):
        for words, key in (("HD", "hausdorff_mm"), ("centre", "center_mm")):
            figures[f"tumor {sites[tumor].text(tumor)}: {words}"] = distance(tumor, key)
    return figures | {
        "target error": lambda mine: spread(scenes(mine[mine.carries]).target_mm),
        "mIoU": lambda mine: spread(scenes(mine).miou, 2, high=True),
        "scenes with a part not found": lambda mine: str(scenes(mine).failed.sum()),
        "s a frame": _frame_s,
    }


def _frame_s(mine: pd.DataFrame) -> str:
    """The median; marked where the machine was not this one's alone."""
    seconds = scenes(mine).frame_s.replace(np.inf, np.nan).median()
    return f"{seconds:.2g}{' (busy)' * bool(mine.busy.any())}" if seconds > 0 else NOTHING


def deformation(frame: pd.DataFrame) -> str:
    """mIoU of the models trained with each row of the paper's deformation table."""
    rows = []
    for (method,), mine in groups(frame, "method"):
        each = [_whole(here)[1] for _, here in groups(mine, "variant")]
        mean = text(scenes(mine).groupby("seed", sort=False).miou.mean(), 2)
        rows.append([method.rpartition("_")[2], *each, mean])
    return table(["configuration", *names(frame, "variant"), "mean"], rows)


def conditions(frame: pd.DataFrame, field: str, base: str) -> str:
    """One row for each method and condition (``field``: fault or view): medians over the scenes, in
    brackets the change against ``base``."""
    keys, first = ("HD", "centre"), "view" if field == "view" else "error source"
    rows = []
    for (method,), mine in groups(frame, "method"):
        reference = mine[mine[field] == base]
        for number, ((condition,), here) in enumerate(groups(mine, field)):
            row = [*_once(number, label_of(method)), CONDITIONS[field].get(condition, condition)]
            for tumor in names(tumors(frame), "part"):
                parts = [some[some.part == tumor] for some in (here, reference)]
                row += [change(*(by_seed(part, _KEYS[key]) for part in parts)) for key in keys]
            rows.append([*row, *_whole(here)])
    return table(["method", first, *_by_tumor(frame, keys), *_WHOLE], rows, left=2)


def severities(frame: pd.DataFrame) -> str:
    """One row for each method, kind and level."""
    keys = ("one-sided HD", "HD", "centre")
    rows = []
    for (method,), mine in groups(frame, "method"):
        for kind in KINDS:
            for number, (level, here) in enumerate(levels_of(mine, kind)):
                row = [*_once(number, label_of(method), SEVERITIES[kind]), f"{level:g}"]
                for tumor in names(tumors(frame), "part"):
                    row += _distances(here[here.part == tumor], keys)
                rows.append(row + _whole(here))
    head = ["method", "severity", "level", *_by_tumor(frame, keys), *_WHOLE]
    return table(head, rows, left=2)


def levels_of(frame: pd.DataFrame, kind: str) -> list[tuple[float, pd.DataFrame]]:
    """The rows of each level of a kind of fault, mild to severe, the clean scene among them."""
    levels = {}
    for (fault,), here in groups(frame, "fault"):
        severity = parse(fault)
        if severity is not None and severity.kind == kind:
            levels[severity.level] = here
    clean, at = frame[frame.fault == "clean"], clean_level(kind)
    if levels and len(clean) and at is not None:
        levels[at] = clean
    return sorted(levels.items(), key=lambda item: item[0], reverse=kind in FALLING)


def ablation(frame: pd.DataFrame) -> str:
    """One row for each model of one case, a group of columns for each view; medians over scenes and
    tumors."""
    views = names(frame, "view")
    head = ["model", "training, s", "frame, s"]
    for view in views:
        label = CONDITIONS["view"].get(view, view)
        head += [f"{label}: tumor HD", "centre", "target error", "mIoU", "failed"]
    base = frame[frame.method == CLINIC]
    rows = []
    for (method,), mine in groups(frame, "method"):
        row = [ABLATED.get(method, method), text(by_seed(scenes(mine), "prepare_s"), 0)]
        row.append(text(by_seed(scenes(mine), "frame_s"), 3))
        for view in views:
            both = mine[mine.view == view], base[base.view == view]
            for of, key in ((tumors, "hausdorff_mm"), (tumors, "center_mm"), (scenes, "target_mm")):
                row.append(change(*(by_seed(of(one), key) for one in both)))
            target, miou, failed = _whole(both[0])
            row[-1:] = [row[-1] if target != NOTHING else NOTHING, miou, failed]
        rows.append(row)
    return table(head, rows)


def sites_text(case: str, sites: Sites) -> str:
    each = [
        f"{spaced(name)} is {site.kind} ({100 * site.exposed_share:.0f} % of its surface "
        f"is the organ's own, least cover {site.cover_mm:.1f} mm)"
        for name, site in sites.items()
    ]
    return f"{case}: " + "; ".join(each) + "."


def spaced(part: str) -> str:
    return part.replace("_", " ")


def _whole(frame: pd.DataFrame) -> list[str]:
    """Mean over the scene's inner targets (mm) where points are carried; mIoU; scenes failed."""
    each = scenes(frame)
    target = text(by_seed(each, "target_mm")) if frame.carries.any() else NOTHING
    return [target, text(by_seed(each, "miou"), 2), f"{each.failed.sum()} of {len(each)}"]


def _distances(part: pd.DataFrame, keys: Iterable[str]) -> list[str]:
    return [text(by_seed(part, _KEYS[key])) for key in keys]


def _by_tumor(frame: pd.DataFrame, keys: Iterable[str]) -> list[str]:
    return [f"{spaced(tumor)} {key}" for tumor in names(tumors(frame), "part") for key in keys]


def _once(number: int, *texts: str) -> list[str]:
    """In the first row alone."""
    return list(texts) if number == 0 else [EMPTY] * len(texts)


def caption(measurements: list[dict], command: str) -> str:
    """What stands below a block; seconds mean little without machine, date and load."""
    about = pd.json_normalize(
        [{k: one[k] for k in ("spec", "method", "provenance")} for one in measurements]
    )
    scene = [f"spec.{key}" for key in ("case", "scene", "fault", "fault_seed")]
    scenes = about.drop_duplicates(scene)
    loads = about["provenance.load"].dropna()
    busy = f"average {loads.min():.1f} to {loads.max():.1f}" if len(loads) else "not known"
    models = about[about["spec.method.kind"] == "network"]
    days = _listed(one["provenance"].get("when", "no date kept")[:10] for one in measurements)
    return (
        f"`{command}`: {len(about)} measurements, {len(scenes)} scenes (views: "
        f"{_listed(about['spec.view'])}), volumes of {_listed(about['spec.grid'], '{}³')} voxels "
        f"at most. {_training(models) if len(models) else ''}Measured on "
        f"{_listed(_device(one['provenance']) for one in measurements)}, {days}, load {busy}."
    )


def _training(about: pd.DataFrame) -> str:
    models = about.drop_duplicates("spec.method.model_sha256", keep="last")
    minutes = models["method.training_s"] / 60
    return (
        f"Models: {len(models)} of {_listed(f'{n:,.0f}' for n in models['method.steps'])} steps, "
        f"seed {_listed(models['method.seed'].astype(int))}, trained on "
        f"{_listed(models['method.device'])} in {minutes.min():.1f} to {minutes.max():.1f} minutes "
        "each by the clock on the wall. "
    )


def _device(about: dict) -> str:
    on_cpu = "{cpu} ({cores} cores, PyTorch on {threads})"
    return (on_cpu if about["device"] == "cpu" else "{device} beside {cpu}").format(**about)


def _listed(items: Iterable[object], form: str = "{}") -> str:
    return ", ".join(map(form.format, sorted(set(items))))  # type: ignore[type-var]
