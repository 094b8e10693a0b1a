"""How a tumor lies in its organ, as measured; tables never mix the kinds."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from tumortrack.core.mesh_query import surface_samples
from tumortrack.core.types import Anatomy
from tumortrack.report.metrics import distance_to_surface

Kind = Literal["exophytic", "endophytic"]

EXPOSED_MM = 0.5  # a tumor's surface this close to the organ's is the organ's surface
EXOPHYTIC_SHARE = 0.05


class TumorSite(NamedTuple):
    """How a tumor lies in the organ: the share of its surface that is the organ's own, and the
    least parenchyma above it, mm."""

    exposed_share: float
    cover_mm: float

    @property
    def kind(self) -> Kind:
        return "exophytic" if self.exposed_share >= EXOPHYTIC_SHARE else "endophytic"


def tumor_sites_of(anatomy: Anatomy) -> dict[str, TumorSite]:
    """By part name; any frame."""
    sites = {}
    for name, tumor in zip(anatomy.names[1:], anatomy.tumors, strict=True):
        points, area = surface_samples(tumor)
        distance = distance_to_surface(points, anatomy.organ)
        share = float(area[distance < EXPOSED_MM].sum() / area.sum())
        sites[name] = TumorSite(share, float(np.min(distance)))
    return sites
