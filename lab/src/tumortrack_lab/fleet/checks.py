"""Quality checks of a prepared case: what rules it out, and what a person should look at."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.geometry import transform_points, unit
from tumortrack.core.organ import KIDNEY
from tumortrack.core.patient import UNKNOWN
from tumortrack.core.types import Mesh
from tumortrack.imaging.case import Case
from tumortrack.imaging.volume import read_raw
from tumortrack.registration.rest_shape import long_axis_mm
from tumortrack.report.metrics import distance_to_surface
from tumortrack_lab.real.kidneys import ORGAN_ML, TUMOR_ML, kind_of, outer_share

_ORGAN_AT_ALL_ML = {True: (30.0, 1500.0), False: (10.0, 4000.0)}  # a kidney, another
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
        "organ": case.anatomy.kind.name,
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
    outer = outer_share(tumor, organ)
    return {
        "longest_mm": round(float(tumor.longest_mm), 2),
        "depth_mm": round(float(distance_to_surface(middle[None], organ)[0]), 2),
        "outer_share": round(outer, 3),
        "kind": kind_of(outer),
        "position": position,
    }


def failures(numbers: dict[str, Any], cut_off: bool) -> list[str]:
    """Why the case must not be used; empty: it passes."""
    low, high = _ORGAN_AT_ALL_ML[numbers["organ"] == KIDNEY.name]
    reasons = {
        "organ or tumor reach the border of the volume: they are cut off": cut_off,
        f"the organ has {numbers['organ_ml']:.0f} ml; allowed: {low:g} to {high:g}": not (
            low <= numbers["organ_ml"] <= high
        ),
        "there is no tumor": not numbers["tumors"],
    }
    return [words for words, failed in reasons.items() if failed]


def doubts(case: Case, numbers: dict[str, Any]) -> list[str]:
    """What a person should look at."""
    largest = max(tumor["ml"] for tumor in numbers["tumors"])
    reasons = {
        "the side is unknown": case.anatomy.kind.in_pairs and numbers["side"] == UNKNOWN,
        f"the organ has {numbers['organ_ml']:.0f} ml": case.anatomy.kind.name == KIDNEY.name
        and not (ORGAN_ML[0] <= numbers["organ_ml"] <= ORGAN_ML[1]),
        f"the largest tumor has {largest:.1f} ml": not TUMOR_ML[0] <= largest <= TUMOR_ML[1],
        f"slices of {numbers['slice_mm']:g} mm": numbers["slice_mm"] > _SLICE_MM,
    }
    notes = [note for note in case.report["notes"] if not _USUAL.search(note)]
    return [words for words, doubted in reasons.items() if doubted] + notes
