"""From what was located to what is cut: which tumor, where to hold it, along which lines.

The paper's planner (its section "Integration with Robotic Resection") and ours, by ``method``.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.errors import NoPlan
from tumortrack.core.types import FIRST_TUMOR
from tumortrack.plan.config import ResectionConfig
from tumortrack.plan.exophytic import chosen_tumor, name_of
from tumortrack.plan.margin import margin_plan
from tumortrack.plan.outline import polygon_of
from tumortrack.plan.published import published_plan
from tumortrack.plan.values import CutLayer, Located, ResectionPlan

_A_COLUMN = 30  # points in a column, about
_WHOLE, _TOUCHED = 0.99, 0.02  # of another tumor's points


def plan_resection(located: Located, config: ResectionConfig) -> ResectionPlan:
    """The plan, table frame, mm.

    Raises:
        InputError: no such tumor.
        NoPlan: nothing to cut, or not as asked; why.
    """
    label, share = chosen_tumor(located, config)
    method = published_plan if config.method == "published" else margin_plan
    layers, cuts, grasp_mm = method(located, label, config)
    taken = inside(layers, located.points_mm)
    volumes_ml = _volumes_ml(located, label, taken)
    notes = _others(located, label, taken)
    healthy_share = volumes_ml["healthy"] / volumes_ml["parenchyma"]
    if healthy_share > config.most_healthy:
        raise NoPlan(
            f"{healthy_share:.0%} of the organ's healthy tissue would come away; allowed are "
            f"{config.most_healthy:.0%}. Ask for a smaller margin, or allow more."
        )
    return ResectionPlan(
        method=config.method,
        tumor=name_of(label),
        label=label,
        grasp_mm=grasp_mm,
        cuts=cuts,
        layers=layers,
        margin_mm=config.margin_mm,
        volumes_ml=volumes_ml,
        exophytic=share,
        stamp_ns=located.stamp_ns,
        notes=notes,
    )


def inside(
    layers: tuple[CutLayer, ...], points_mm: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Which points lie in the piece that the layers make up."""
    import shapely

    found = np.zeros(len(points_mm), bool)
    for layer in layers:
        area = polygon_of(layer.rings_mm)
        left, low, right, high = area.bounds
        x, y, z = points_mm.T
        near = np.flatnonzero(
            (z >= layer.bottom_mm) & (z < layer.top_mm)
            & (x > left) & (x < right) & (y > low) & (y < high)
        )  # fmt: skip
        shapely.prepare(area)
        found[near] = shapely.contains_xy(area, x[near], y[near])
    return found


def _volumes_ml(located: Located, label: int, taken: Bool[np.ndarray, " n"]) -> dict[str, float]:
    """By counting points, which lie evenly in the organ."""
    kidney = located.meshes.get("kidney")
    organ_mm3 = cloud_volume_mm3(located.points_mm) if kidney is None else kidney.volume_mm3
    organ_ml = organ_mm3 / 1000
    each_ml = organ_ml / len(located.points_mm)
    tumor, healthy = located.labels == label, located.labels < FIRST_TUMOR
    return {
        "organ": organ_ml,
        "parenchyma": each_ml * float(healthy.sum()),
        "tumor": each_ml * float(tumor.sum()),
        "piece": each_ml * float((taken | tumor).sum()),
        "healthy": each_ml * float((taken & healthy).sum()),
    }


def cloud_volume_mm3(points_mm: Float[np.ndarray, "n 3"]) -> float:
    """Of a body that points lie evenly in, without overhangs: the sum over columns of their area
    times the height that k points' span stands for, (k + 1) / (k - 1) of it."""
    flat = points_mm[:, :2] - points_mm[:, :2].min(0)
    side_mm = float(np.sqrt(_A_COLUMN * np.ptp(flat, axis=0).prod() / len(flat)))
    cell = (flat / side_mm).astype(int)
    shape = cell.max(0) + 1
    index = cell[:, 0] * shape[1] + cell[:, 1]
    low, high = np.full(shape.prod(), np.inf), np.full(shape.prod(), -np.inf)
    np.minimum.at(low, index, points_mm[:, 2])
    np.maximum.at(high, index, points_mm[:, 2])
    count = np.bincount(index, minlength=len(low))
    some = count >= 2
    span = (high - low)[some] * (count[some] + 1) / (count[some] - 1)
    # A column at the edge is not full: it counts by how dense its points are.
    dense = np.median(count[some] / span)
    area = np.minimum(1.0, count[some] / span / dense)
    return float((span * area).sum() * side_mm**2)


def _others(located: Located, label: int, taken: Bool[np.ndarray, " n"]) -> tuple[str, ...]:
    """What becomes of other tumors; a cut through one is no plan."""
    notes = []
    for other in located.tumors:
        share = float(taken[located.labels == other].mean())
        if other == label or share < _TOUCHED:
            continue
        if share < _WHOLE:
            raise NoPlan(
                f"the cut would go through {name_of(other)} ({share:.0%} of it would come away). "
                "Ask for another margin, or plan that tumor."
            )
        notes.append(f"{name_of(other)} comes away with {name_of(label)}.")
    return tuple(notes)
