"""Quality checks of a prepared case: what rules it out, and what a person should look at."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.geometry import transform_points, unit
from tumortrack.core.mesh_query import surface_samples
from tumortrack.core.organ import KIDNEY
from tumortrack.core.patient import UNKNOWN
from tumortrack.core.types import Mesh
from tumortrack.io.case import Case
from tumortrack.io.volume import read_raw
from tumortrack.organ.rest_shape import long_axis_mm
from tumortrack.report.metrics import distance_to_surface

_ORGAN_AT_ALL_ML = {True: (30.0, 1500.0), False: (10.0, 4000.0)}  # a kidney, another
_ORGAN_ML, _TUMOR_ML = (100.0, 400.0), (1.0, 100.0)  # usual
_NEAR_MM = 2.0  # of the organ's outer surface
_POLE = 1 / 3  # of the organ's length, at either end
_SLICE_MM = 5.0
# Notes of `prepare` on most inputs; any other note is for a person to look at.
_USUAL = re.compile(
    r"few distinct whole numbers|the patient's \w+ [\w ]+ was chosen: it bears most tumor"
    r"|\d+ specks beside the organ dropped \(0\.|holes of 0\.|the organ; table, blocks"
    r"|only one [\w ]+ in the map|\S+ is [a-z0-9_]+$|\S+ states SPACE=RAS"
)


def is_cut_off(case: Case, source: Path, series: str | None) -> bool:
    """Whether organ or tumor reach the border of the volume that the case was made from."""
    if case.report["kind"] == "meshes":
        return False
    raw = read_raw(source, series)
    labelled = np.argwhere(case.labels.labels > 0)
    corners = np.array(list(product(*zip(labelled.min(0), labelled.max(0), strict=True))), float)
    index_from_index = np.linalg.inv(raw.lps_from_index) @ case.labels.lps_from_index
    there = transform_points(index_from_index, corners)
    last = np.array(raw.array.shape[:3]) - 1
    return bool((there < 0.5).any() or (there > last - 0.5).any())


def described(case: Case) -> dict[str, Any]:
    """JSON types: organ, side, volumes, spacing (the thickest is the slices'), and of each tumor
    volume, longest extent, depth of its middle below the organ's outer surface, share of its
    surface within 2 mm of that, kind, and position along the organ."""
    organ_ml, *tumors_ml = case.report["volumes_ml"].values()
    spacing = case.report["spacing_mm"]
    turns = case.report.get("half_turn", {}).get("turns", [])
    organ, tumors = case.anatomy.organ, case.anatomy.tumors
    return {
        "organ": case.anatomy.organ_kind.name,
        "side": case.patient.side,
        "kind": case.report["kind"],
        "organ_ml": round(organ_ml, 2),
        "spacing_mm": [round(mm, 3) for mm in spacing],
        "slice_mm": round(max(spacing), 3),
        "half_turn_mm": round(min((turn["mean_mm"] for turn in turns), default=0.0), 2),
        "tumors": [
            {"ml": round(ml, 3), **_placed(tumor, organ)}
            for ml, tumor in zip(tumors_ml, tumors, strict=True)
        ],
    }


def _placed(tumor: Mesh, organ: Mesh) -> dict[str, Any]:
    middle = tumor.vertices_mm.mean(0)
    axis = unit(long_axis_mm(organ))
    axis = axis * (1 if axis[2] >= 0 else -1)  # up, in LPS
    along = organ.vertices_mm @ axis
    share = float((middle @ axis - along.min()) / np.ptp(along))
    position = "lower pole" if share < _POLE else "upper pole" if share > 1 - _POLE else "middle"
    outer = _outer_share(tumor, organ)
    return {
        "longest_mm": round(float(tumor.longest_mm), 2),
        "depth_mm": round(float(distance_to_surface(middle[None], organ)[0]), 2),
        "outer_share": round(outer, 3),
        "kind": "endophytic" if outer < 0.25 else "exophytic" if outer >= 0.5 else "between",
        "position": position,
    }


def _outer_share(tumor: Mesh, organ: Mesh) -> float:
    """The share of a tumor's surface near the organ's outer one."""
    points_mm, area_mm2 = surface_samples(tumor)
    near = distance_to_surface(points_mm, organ) <= _NEAR_MM
    return float(area_mm2[near].sum() / area_mm2.sum())


def failures(numbers: dict[str, Any], cut_off: bool) -> list[str]:
    """Why the case must not be used; empty: it passes."""
    (low, high), ml = _ORGAN_AT_ALL_ML[numbers["organ"] == KIDNEY.name], numbers["organ_ml"]
    reasons = {
        "organ or tumor reach the border of the volume: they are cut off": cut_off,
        f"the organ has {ml:.0f} ml; allowed: {low:g} to {high:g}": not low <= ml <= high,
        "there is no tumor": not numbers["tumors"],
    }
    return [words for words, failed in reasons.items() if failed]


def doubts(case: Case, numbers: dict[str, Any]) -> list[str]:
    """What a person should look at."""
    kind, organ_ml, slice_mm = case.anatomy.organ_kind, numbers["organ_ml"], numbers["slice_mm"]
    largest_ml = max(tumor["ml"] for tumor in numbers["tumors"])
    unusual = kind.name == KIDNEY.name and not _ORGAN_ML[0] <= organ_ml <= _ORGAN_ML[1]
    reasons = {
        "the side is unknown": kind.in_pairs and numbers["side"] == UNKNOWN,
        f"the organ has {organ_ml:.0f} ml": unusual,
        f"the largest tumor has {largest_ml:.1f} ml": not (
            _TUMOR_ML[0] <= largest_ml <= _TUMOR_ML[1]
        ),
        f"slices of {slice_mm:g} mm": slice_mm > _SLICE_MM,
    }
    notes = [note for note in case.report["notes"] if not _USUAL.search(note)]
    return [words for words, doubted in reasons.items() if doubted] + notes
