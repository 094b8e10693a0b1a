"""The study's Markdown tables. Every number comes from a measurement, or from the paper."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from tumortrack_lab.study import paper
from tumortrack_lab.study.document import table
from tumortrack_lab.study.frame import (
    EMPTY,
    NOTHING,
    by_seed,
    change,
    groups,
    names,
    scenes,
    text,
    tumors,
)
from tumortrack_lab.study.models import CLINIC
from tumortrack_lab.twin.faults import KINDS, clean_level, parse

METHODS = {
    "rigid_bound": "true rigid pose (bound)",
    "rigid": "rigid registration, many starts",
    "rigid_any_rotation": "rigid registration, any rotation",
    "cpd": "coherent point drift",
    "bcpd": "Bayesian coherent point drift",
    "elastic": "linear-elastic surface fit",
    "visible_bound": "true visible surface (bound)",
    "basis_bound": "all true surfaces (bound)",
}
FAULTS = {
    "clean": "none (clean depth)",
    "noise": "sensor noise",
    "distortion": "slow distortion",
    "offset": "systematic 2 mm offset",
    "occlusion": "occlusion",
    "outliers": "outliers",
    "registration": "registration, 1 mm and 1 degree",
    "all": "all together",
}
VIEWS = {
    "clean": "clean",
    "noise": "sensor noise",
    "shaft": "8 mm shaft in view",
    "clutter": "3 % background points",
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
    "HD95": "hausdorff_95_mm",
    "centre": "center_mm",
    "IoU": "iou",
}


def label_of(method: str) -> str:
    """How a table names a method."""
    return METHODS.get(method, method)


def accuracy(frame: pd.DataFrame, lies: dict[str, paper.Lie], is_paper: bool) -> str:
    """The paper's table of results for one case: a row for each variant, model and tumor."""
    head = ["variant", "model", "tumor", *_KEYS, "mIoU", "target error"]
    if is_paper:
        head[4:4] = ["paper"]
        head[8:8] = ["paper"]
    rows = []
    for (variant, model), mine in groups(frame, "variant", "method"):
        for number, ((tumor,), part) in enumerate(groups(tumors(mine), "part")):
            kind = lies[tumor].kind
            row = [*_once(number, variant, model), tumor_text(tumor, kind), *_distances(part)]
            row += _once(number, miou_text(mine), target_text(mine))
            if is_paper:
                row[4:4] = [_paper_text(paper.hausdorff(variant, model, kind))]
                row[8:8] = [_paper_text(paper.center(variant, model))]
            rows.append(row)
    return table(head, rows, left=3)


def methods(frame: pd.DataFrame, lies: dict[str, paper.Lie]) -> str:
    """Methods beside one another on the same scenes: medians over the scenes, by tumor."""
    head = ["method", "tumor", *_KEYS, "mIoU", "target error", "failed", "s a frame"]
    rows = []
    for (method,), mine in groups(frame, "method"):
        frame_s = by_seed(scenes(mine), "frame_s")
        slow = 1 <= frame_s.mean() < float("inf")
        whole = [miou_text(mine), target_text(mine), failed_text(mine)]
        whole += [text(frame_s, 1 if slow else 3), text(by_seed(scenes(mine), "prepare_s"))]
        for number, ((tumor,), part) in enumerate(groups(tumors(mine), "part")):
            name = tumor_text(tumor, lies[tumor].kind)
            row = [*_once(number, label_of(method)), name, *_distances(part)]
            rows.append(row + _once(number, *whole))
    return table([*head, "preparation, s"], rows, left=2)


def deformation(frame: pd.DataFrame) -> str:
    """mIoU of the models trained with each row of the paper's deformation table."""
    rows = []
    for (method,), mine in groups(frame, "method"):
        number = int(method.rpartition("_")[2])
        each = [miou_text(here) for _, here in groups(mine, "variant")]
        mean = text(scenes(mine).groupby("seed", sort=False).miou.mean(), 2)
        rows.append([str(number), *each, mean, f"{paper.CONFIGURATION_MIOU[number]:.2f}"])
    return table(["configuration", *names(frame, "variant"), "mean", "paper"], rows)


def conditions(frame: pd.DataFrame, field: str, base: str) -> str:
    """One row for each method and condition (``field``: fault or view): medians over the
    scenes, and in brackets the change against ``base``."""
    keys = ("HD", "centre")
    first, labels = ("view", VIEWS) if field == "view" else ("error source", FAULTS)
    rows = []
    for (method,), mine in groups(frame, "method"):
        reference = mine[mine[field] == base]
        for number, ((condition,), here) in enumerate(groups(mine, field)):
            row = [*_once(number, label_of(method)), labels.get(condition, condition)]
            for tumor in _parts(frame):
                parts = [rows[rows.part == tumor] for rows in (here, reference)]
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
                for tumor in _parts(frame):
                    row += _distances(here[here.part == tumor], keys)
                rows.append(row + _whole(here))
    head = ["method", "severity", "level", *_by_tumor(frame, keys), *_WHOLE]
    return table(head, rows, left=2)


def levels_of(frame: pd.DataFrame, kind: str) -> list[tuple[float, pd.DataFrame]]:
    """The rows of each level of a kind of fault, from mild to severe, the clean scene among
    them."""
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
    """What each piece of the preset brought: one row for each model of one case; a group of
    columns for each view. Medians over scenes and tumors."""
    views = names(frame, "view")
    head = ["model", "training, s", "frame, s"]
    for view in views:
        head += [f"{VIEWS.get(view, view)}: tumor HD", "centre", "target error", "mIoU", "failed"]
    base = frame[frame.method == CLINIC]
    rows = []
    for (method,), mine in groups(frame, "method"):
        row = [ABLATED.get(method, method), text(by_seed(scenes(mine), "prepare_s"), 0)]
        row.append(text(by_seed(scenes(mine), "frame_s"), 3))
        for view in views:
            here, there = mine[mine.view == view], base[base.view == view]
            row += [
                change(by_seed(tumors(here), key), by_seed(tumors(there), key))
                for key in ("hausdorff_mm", "center_mm")
            ]
            errors = change(*(by_seed(scenes(one), "target_mm") for one in (here, there)))
            row += [errors if here.carries.any() else NOTHING, miou_text(here), failed_text(here)]
        rows.append(row)
    return table(head, rows)


def lies_text(case: str, lies: dict[str, paper.Lie]) -> str:
    """Which tumor of a case is exophytic, and by what measure."""
    each = [
        f"{spaced(name)} is {lie.kind} ({100 * lie.exposed_share:.0f} % of its surface "
        f"is the organ's own, least cover {lie.cover_mm:.1f} mm)"
        for name, lie in lies.items()
    ]
    return f"{case}: " + "; ".join(each) + "."


def tumor_text(tumor: str, kind: str) -> str:
    return f"{tumor.rpartition('_')[2]}, {kind}"


def spaced(part: str) -> str:
    return part.replace("_", " ")


def target_text(frame: pd.DataFrame) -> str:
    """Mean over the scene's inner targets, mm."""
    return text(by_seed(scenes(frame), "target_mm")) if frame.carries.any() else NOTHING


def miou_text(frame: pd.DataFrame) -> str:
    return text(by_seed(scenes(frame), "miou"), 2)


def failed_text(frame: pd.DataFrame) -> str:
    return f"{scenes(frame).failed.sum()} of {len(scenes(frame))}"


_WHOLE = ("target error", "mIoU", "failed")


def _whole(frame: pd.DataFrame) -> list[str]:
    return [target_text(frame), miou_text(frame), failed_text(frame)]


def _distances(part: pd.DataFrame, keys: Iterable[str] = _KEYS) -> list[str]:
    return [text(by_seed(part, _KEYS[key]), 2 if key == "IoU" else 1) for key in keys]


def _parts(frame: pd.DataFrame) -> list[str]:
    return names(tumors(frame), "part")


def _by_tumor(frame: pd.DataFrame, keys: Iterable[str]) -> list[str]:
    return [f"{spaced(tumor)} {key}" for tumor in _parts(frame) for key in keys]


def _once(number: int, *texts: str) -> list[str]:
    """In the first row alone."""
    return list(texts) if number == 0 else [EMPTY] * len(texts)


def _paper_text(figure: paper.PaperFigure | None) -> str:
    return EMPTY if figure is None else figure.text


def caption(measurements: list[dict], command: str) -> str:
    """What stands below a block: command, scenes, models with their steps and training time,
    device, load (seconds mean little without it), grid; from the measurements."""
    about = pd.json_normalize([{k: one[k] for k in _CAPTION} for one in measurements])
    scenes = about.drop_duplicates([f"spec.{key}" for key in _SCENE])
    loads = about["provenance.load"].dropna()
    busy = (
        f"load average {loads.min():.1f} to {loads.max():.1f}" if len(loads) else "load not known"
    )
    return (
        f"`{command}`: {len(about)} measurements, {len(scenes)} scenes (views: "
        f"{_listed(about['spec.view'])}), volumes of {_listed(about['spec.grid'], '{}³')} voxels "
        f"at most. {_training(about[about['spec.method.kind'] == 'network'])}Measured on "
        f"{_listed(_device(one['provenance']) for one in measurements)}, {busy}."
    )


_CAPTION, _SCENE = ("spec", "method", "provenance"), ("case", "scene", "fault", "fault_seed")


def _training(about: pd.DataFrame) -> str:
    """One sentence about the models, if there are any."""
    if about.empty:
        return ""
    models = about.drop_duplicates("spec.method.model_sha256", keep="last")
    minutes = models["method.training_s"] / 60
    return (
        f"Models: {len(models)} of {_listed(f'{n:,.0f}' for n in models['method.steps'])} steps, "
        f"seed {_listed(models['method.seed'].astype(int))}, trained on "
        f"{_listed(models['method.device'])} in {minutes.min():.1f} to {minutes.max():.1f} minutes "
        "each. "
    )


def _device(about: dict) -> str:
    if about["device"] != "cpu":
        return f"{about['device']} beside {about['cpu']}"
    return f"{about['cpu']} ({about['cores']} cores, PyTorch on {about['threads']})"


def _listed(items: Iterable[object], form: str = "{}") -> str:
    return ", ".join(map(form.format, sorted(set(items))))  # type: ignore[type-var]
