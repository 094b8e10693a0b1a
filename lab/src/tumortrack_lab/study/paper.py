"""The paper's own figures, to print beside ours, and which tumor of a case they belong to.

Source: the paper, section "Localization Accuracy" and table "compare_deformations". Its full
table of results is not in the text, so only what the text says is here; a sign before a number
is the text's "approximately", "less than or equal to" and "less than".
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from tumortrack.core.types import Anatomy
from tumortrack.report.metrics import distance_to_surface, surface_samples

Kind = Literal["exophytic", "endophytic"]

# mIoU of training configuration 1..6, on the paper's second phantom.
CONFIGURATION_MIOU = {1: 0.70, 2: 0.65, 3: 0.71, 4: 0.71, 5: 0.68, 6: 0.66}


class PaperFigure(NamedTuple):
    """A figure of the paper with its sign: ``""``, ``"~"``, ``"<="`` or ``"<"``."""

    sign: str
    value_mm: float

    @property
    def text(self) -> str:
        signs = {"": "", "~": "≈ ", "<=": "≤ ", "<": "< "}
        return f"{signs[self.sign]}{self.value_mm:g}"


# Tumor distances (estimate to reference), mm, by variant (and model): exophytic, endophytic.
_HAUSDORFF = {
    "D1": ("~", 4.0, 7.0),
    "D2": ("~", 6.0, 9.0),
    "D3 M_lim": ("", 11.3, 12.9),
    "D3 M_full": ("", 15.4, 18.5),
}


def hausdorff(variant: str, model: str, kind: Kind) -> PaperFigure | None:
    """The paper's tumor distance (estimate to reference), mm, where the text gives one."""
    if variant.startswith("Rot") and model == "M_full":
        return PaperFigure("<=", 13.4)
    stated = _HAUSDORFF.get(variant) or _HAUSDORFF.get(f"{variant} {model}")
    if stated is None:
        return None
    sign, exophytic, endophytic = stated
    return PaperFigure(sign, exophytic if kind == "exophytic" else endophytic)


def center(variant: str, model: str) -> PaperFigure | None:
    """The paper's bound on the distance of the tumors' centres, mm."""
    stated = variant in ("D1", "D2", "D3") or variant.startswith("Rot")
    return PaperFigure("<", 10.0) if stated and (variant, model) != ("D3", "M_full") else None


EXPOSED_MM = 0.5  # a tumor's surface this close to the organ's is the organ's surface
EXOPHYTIC_SHARE = 0.05


class Lie(NamedTuple):
    """How a tumor lies in the organ: the share of its surface that is the organ's own, and the
    least parenchyma above it, mm."""

    exposed_share: float
    cover_mm: float

    @property
    def kind(self) -> Kind:
        return "exophytic" if self.exposed_share >= EXOPHYTIC_SHARE else "endophytic"

    def text(self, tumor: str) -> str:
        return f"{tumor.rpartition('_')[2]}, {self.kind}"


def tumor_lies(anatomy: Anatomy) -> dict[str, Lie]:
    """By part name; any frame."""
    lies = {}
    for name, tumor in zip(anatomy.names[1:], anatomy.tumors, strict=True):
        points, area, _ = surface_samples(tumor)
        distance = distance_to_surface(points, anatomy.organ)
        share = float(area[distance < EXPOSED_MM].sum() / area.sum())
        lies[name] = Lie(share, float(np.min(distance)))
    return lies
