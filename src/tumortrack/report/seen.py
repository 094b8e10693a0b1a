"""Inputs of a run's page, and an estimate's parts in words; light to import, unlike ``run_page``,
which draws the page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from tumortrack.core.report import FitReport
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.tracking.margins import stated_radius

if TYPE_CHECKING:
    from tumortrack.tracking.slices import CarriedCt

PAGE = "index.html"


@dataclass(frozen=True, eq=False)
class Seen:
    """What a run's page shows besides the estimate.

    Attributes:
        cloud: the organ's points, in which it was located.
        content: all that the camera saw.
        taken: class of each pixel of a depth image (``sense.region.Region``); 0: the organ.
        ct: for slices of the CT, moved to the organ; without it, slices show labels.
    """

    cloud: SensorCloud | None = None
    content: DepthFrame | SensorCloud | None = None
    taken: UInt8[np.ndarray, "h w"] | None = None
    ct: CarriedCt | None = None


def part_rows(report: FitReport, good: bool) -> list[dict[str, str]]:
    """For each part its name, centre, standard deviation, volume and margin, with units; empty if
    not known. A poor estimate has no deviations: they would be read as bounds of its error."""
    rows = []
    for name, part in report.parts.items():
        row = {"part": name, "centre": "not found", "std": "", "volume": "", "margin": ""}
        if part.center_mm is not None:
            x, y, z = part.center_mm
            row |= {"centre": f"({x:.1f}, {y:.1f}, {z:.1f}) mm"}
            row |= {"volume": f"{part.volume_ml:.1f} ml"}
            if (deviation := part.deviation_words) is not None and good:
                row |= {"std": deviation}
            if radius := stated_radius(report.margin, name):
                row |= {"margin": radius.words}
        rows.append(row)
    return rows


def row_words(row: dict[str, str]) -> str:
    """A part's row as one line."""
    std = row["std"] and f"standard deviation {row['std']}"
    words = (f"centre {row['centre']}", std, row["volume"], row["margin"])
    return f"{row['part']}: {', '.join(filter(None, words)).replace('centre not', 'not')}"
