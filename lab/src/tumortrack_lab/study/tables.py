"""Cells -> markdown tables. Every number comes from a cell, or from the paper by ``paper``."""

from __future__ import annotations

from tumortrack_lab.study import paper
from tumortrack_lab.study.figures import Figure, figure, names, part_value, pick
from tumortrack_lab.study.markdown import table

LABELS = {
    "rigid_bound": "true rigid pose (bound)",
    "rigid": "rigid registration, many starts",
    "rigid_any_rotation": "rigid registration, any rotation",
    "cpd": "coherent point drift",
    "bcpd": "Bayesian coherent point drift",
    "elastic": "linear-elastic surface fit",
    "visible_bound": "true visible surface (bound)",
    "basis_bound": "all true surfaces (bound)",
}
FAULT_LABELS = {
    "clean": "none (clean depth)",
    "noise": "sensor noise",
    "distortion": "slow distortion",
    "offset": "systematic 2 mm offset",
    "occlusion": "occlusion",
    "outliers": "outliers",
    "registration": "registration, 1 mm and 1 degree",
    "all": "all together",
}
VIEW_LABELS = {
    "clean": "clean",
    "noise": "sensor noise",
    "shaft": "8 mm shaft in view",
    "clutter": "3 % background points",
}
EMPTY = ""


def label_of(method: str) -> str:
    """How a table names a method."""
    return LABELS.get(method, method)


def tumors_of(cells: list[dict]) -> list[str]:
    """Names of the tumors in these cells, in order."""
    return [part for part in cells[0]["parts"] if part != "kidney"]


def accuracy(cells: list[dict], lies: dict[str, paper.Lie], is_paper: bool) -> str:
    """The paper's table of results for one case: a row for each variant, model and tumor."""
    head = ["variant", "model", "tumor", "one-sided HD", "HD", "HD95", "centre", "IoU", "mIoU"]
    head += ["target error"]
    if is_paper:
        head[4:4] = ["paper"]
        head[8:8] = ["paper"]
    rows = []
    for variant in names(cells, "variant"):
        for model in names(cells, "method"):
            mine = pick(cells, variant=variant, method=model)
            for number, tumor in enumerate(tumors_of(cells)):
                kind = lies[tumor].kind
                first = [variant, model] if number == 0 else [EMPTY, EMPTY]
                row = [*first, tumor_text(tumor, kind), *_distances(mine, tumor)]
                row += [miou_text(mine), target_text(mine)] if number == 0 else [EMPTY] * 2
                if is_paper:
                    row[4:4] = [_said(paper.hausdorff(variant, model, kind))]
                    row[8:8] = [_said(paper.center(variant, model))]
                rows.append(row)
    return table(head, rows, left=3)


def deformation(cells: list[dict]) -> str:
    """mIoU of the models trained with each row of the paper's deformation table."""
    variants = names(cells, "variant")
    head = ["configuration", *variants, "mean", "paper"]
    rows = []
    for method in names(cells, "method"):
        number = int(method.rpartition("_")[2])
        mine = pick(cells, method=method)
        columns = [miou_text(pick(mine, variant=variant)) for variant in variants]
        said = f"{paper.CONFIGURATION_MIOU[number]:.2f}"
        rows.append([str(number), *columns, _mean_miou(mine).text(2), said])
    return table(head, rows)


def methods(cells: list[dict], lies: dict[str, paper.Lie]) -> str:
    """Methods beside one another on the same scenes: medians over the scenes, by tumor."""
    head = ["method", "tumor", "one-sided HD", "HD", "HD95", "centre", "IoU", "mIoU"]
    head += ["target error", "failed", "s a frame", "preparation, s"]
    rows = []
    for method in names(cells, "method"):
        mine = pick(cells, method=method)
        for number, tumor in enumerate(tumors_of(cells)):
            name = tumor_text(tumor, lies[tumor].kind)
            row = [label_of(method) if number == 0 else EMPTY, name, *_distances(mine, tumor)]
            rows.append(row + (_whole_scene(mine) if number == 0 else [EMPTY] * 5))
    return table(head, rows, left=2)


def conditions(cells: list[dict], field: str, base: str) -> str:
    """One row for each method and condition (``field``: fault or view): medians over the
    scenes, and in brackets the change against ``base``."""
    tumors = tumors_of(cells)
    parts = [f"{tumor.replace('_', ' ')} {what}" for tumor in tumors for what in ("HD", "centre")]
    head = ["method", "view" if field == "view" else "error source", *parts]
    head += ["target error", "mIoU", "failed"]
    labels = VIEW_LABELS if field == "view" else FAULT_LABELS
    rows = []
    for method in names(cells, "method"):
        mine = pick(cells, method=method)
        reference = pick(mine, **{field: base})
        for number, condition in enumerate(names(mine, field)):
            here = pick(mine, **{field: condition})
            row = [label_of(method) if number == 0 else EMPTY, labels.get(condition, condition)]
            for tumor in tumors:
                for key in ("hausdorff_mm", "center_mm"):
                    value = part_value(tumor, key)
                    row.append(change(figure(here, value), figure(reference, value)))
            rows.append([*row, target_text(here), miou_text(here), failed_text(here)])
    return table(head, rows, left=2)


def lies_text(case: str, lies: dict[str, paper.Lie]) -> str:
    """Which tumor of a case is exophytic, and by what measure."""
    each = [
        f"{name.replace('_', ' ')} is {lie.kind} ({100 * lie.exposed_share:.0f} % of its surface "
        f"is the organ's own, least cover {lie.cover_mm:.1f} mm)"
        for name, lie in lies.items()
    ]
    return f"{case}: " + "; ".join(each) + "."


def tumor_text(tumor: str, kind: str) -> str:
    return f"{tumor.rpartition('_')[2]}, {kind}"


def _distances(cells: list[dict], tumor: str) -> list[str]:
    keys = ("hausdorff_one_sided_mm", "hausdorff_mm", "hausdorff_95_mm", "center_mm")
    texts = [figure(cells, part_value(tumor, key)).text() for key in keys]
    return [*texts, figure(cells, part_value(tumor, "iou")).text(2)]


def _whole_scene(cells: list[dict]) -> list[str]:
    frame = figure(cells, lambda cell: cell["frame_s"])
    prepare = figure(cells, lambda cell: cell["prepare_s"])
    return [
        miou_text(cells),
        target_text(cells),
        failed_text(cells),
        frame.text(3) if (frame.mean or 0) < 1 else frame.text(),
        prepare.text(),
    ]


def target_error(cell: dict) -> float | None:
    """Mean over the scene's inner targets, mm."""
    return (cell["targets_mm"] or {}).get("mean")


def carries(cells: list[dict]) -> bool:
    """Whether the method of these cells carries points."""
    return any(cell["targets_mm"] for cell in cells)


def target_text(cells: list[dict]) -> str:
    return figure(cells, target_error).text() if carries(cells) else "–"


def failed_text(cells: list[dict]) -> str:
    return f"{sum(cell['failed'] is not None for cell in cells)} of {len(cells)}"


def miou_text(cells: list[dict]) -> str:
    return figure(cells, lambda cell: cell["miou"]).text(2)


def _mean_miou(cells: list[dict]) -> Figure:
    """Mean over scenes for each seed."""
    seeds: dict[int, list[float]] = {}
    for cell in cells:
        seeds.setdefault(cell["spec"]["method"].get("seed", 0), []).append(cell["miou"])
    return Figure(tuple(sum(values) / len(values) for values in seeds.values()))


def _said(said: paper.PaperFigure | None) -> str:
    return EMPTY if said is None else said.text


def change(here: Figure, base: Figure) -> str:
    """A figure, and in brackets how much it is above its base."""
    if here.mean is None or base.mean is None or here is base or here == base:
        return here.text()
    more = round(here.mean - base.mean, 1) + 0.0  # no minus before a zero
    return f"{here.text()} ({more:+.1f})"
