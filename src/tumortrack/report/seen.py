"""What a run's page shows besides the estimate, and its parts in words. The page itself is
``run_page``, which loads what only pictures need."""

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
        taken: of a depth image, as of ``sense.region.Region``: 0 where it was taken for the organ.
        ct: for slices of the CT where it lies now; None: slices show labels.
    """

    cloud: SensorCloud | None = None
    content: DepthFrame | SensorCloud | None = None
    taken: UInt8[np.ndarray, "h w"] | None = None
    ct: CarriedCt | None = None


def part_rows(report: FitReport, good: bool) -> list[dict[str, str]]:
    """Of each part: its name, centre, standard deviation, volume and margin, in words with units;
    empty where that is not known, and the deviation where the answer is poor."""
    rows = []
    for name, part in report.parts.items():
        row = {"part": name, "centre": "not found", "std": "", "volume": "", "margin": ""}
        if part.center_mm is not None:
            x, y, z = part.center_mm
            row |= {"centre": f"({x:.1f}, {y:.1f}, {z:.1f}) mm"}
            row |= {"volume": f"{part.volume_ml:.1f} ml"}
            # Of a poor one it would be read as how wrong it may be, which nobody knows.
            if part.center_std_mm is not None and good:
                row |= {"std": f"{part.center_std_mm:.1f} mm"}
            if radius := stated_radius(report.margin, name):
                row |= {"margin": radius.words}
        rows.append(row)
    return rows


def row_words(row: dict[str, str]) -> str:
    """A part's row as one line."""
    std = row["std"] and f"standard deviation {row['std']}"
    said = (f"centre {row['centre']}", std, row["volume"], row["margin"])
    return f"{row['part']}: {', '.join(filter(None, said)).replace('centre not', 'not')}"
