"""What each piece of the preset brought: one row for each, the same number of training scenes."""

from __future__ import annotations

from tumortrack_lab.study.figures import Figure, figure, median, names, pick
from tumortrack_lab.study.markdown import table
from tumortrack_lab.study.models import CLINIC
from tumortrack_lab.study.tables import (
    VIEW_LABELS,
    carries,
    change,
    failed_text,
    miou_text,
    target_error,
)

LABELS = {
    "clinic": "clinic",
    "clinic_unrefined": "not laid on the cloud (no refinement)",
    "clinic_clean": "trained without hidden surface, background, calibration errors",
    "clinic_drags": "trained on the paper's drags in 10 of 11 scenes",
    "clinic_pointnet": "PointNet++ instead of the height map",
    "quick_elastic": "occupancy MLP of `quick` instead of the warp, same scenes",
    "M_lim": "`quick` (its own scenes)",
}
RULE = (
    "Distances in mm. Every model saw the same number of scenes; medians over the deformed "
    "variants and all tumors, ± is the standard deviation over the seeds; in brackets the change "
    "against clinic. A part that was not found counts as infinitely far. The prior of the "
    "refinement is that of the elastic body in every row. Seconds are of a machine with the load "
    "said here."
)


def table_of(cells: list[dict]) -> str:
    """One row for each model of one case; a group of columns for each view."""
    views = names(cells, "view")
    head = ["model", "training, s", "frame, s"]
    for view in views:
        name = VIEW_LABELS.get(view, view)
        head += [f"{name}: tumor HD", "centre", "target error", "mIoU", "failed"]
    base = pick(cells, method=CLINIC)
    rows = []
    for method in names(cells, "method"):
        mine = pick(cells, method=method)
        row = [LABELS.get(method, method)]
        row.append(figure(mine, lambda cell: cell["prepare_s"]).text(0))
        row.append(figure(mine, lambda cell: cell["frame_s"]).text(3))
        for view in views:
            row += _columns(pick(mine, view=view), pick(base, view=view))
        rows.append(row)
    return table(head, rows)


def _columns(here: list[dict], base: list[dict]) -> list[str]:
    texts = [
        change(over_tumors(here, key), over_tumors(base, key))
        for key in ("hausdorff_mm", "center_mm")
    ]
    errors = (figure(here, target_error), figure(base, target_error))
    texts.append(change(*errors) if carries(here) else "–")
    return [*texts, miou_text(here), failed_text(here)]


def over_tumors(cells: list[dict], key: str) -> Figure:
    """Median over scenes and tumors for each seed, then the seeds' figure."""
    seeds: dict[int, list[float | None]] = {}
    for cell in cells:
        values = seeds.setdefault(cell["spec"]["method"].get("seed", 0), [])
        for part, metrics in cell["parts"].items():
            if part != "kidney":
                values.append(metrics.get(key) if metrics["found"] else None)
    return Figure(tuple(median(values) for _, values in sorted(seeds.items())))
