"""What was seen in a run, and an estimate's parts in words; light to import, unlike the pages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from tumortrack.core import colours
from tumortrack.core.report import FAR_OFF, FitReport, NextEvidence, Point
from tumortrack.core.types import DepthFrame, SensorCloud

if TYPE_CHECKING:
    from tumortrack.core.assessment import Assessment
    from tumortrack.core.estimate import Estimate
    from tumortrack.report.slices import CarriedCt

PAGE, PICTURE = "index.html", "picture.png"


@dataclass(frozen=True, eq=False)
class Seen:
    """What a run's page shows besides the estimate.

    Attributes:
        cloud: the organ's points, in which it was located.
        content: all that the camera saw.
        pixel_class: class of each pixel of a depth image (``segmentation.Region``); 0: the organ.
        ct: for slices of the CT, moved to the organ; without it, slices show labels.
    """

    cloud: SensorCloud | None = None
    content: DepthFrame | SensorCloud | None = None
    pixel_class: UInt8[np.ndarray, "h w"] | None = None
    ct: CarriedCt | None = None


def part_rows(report: FitReport, assessment: Assessment) -> list[dict[str, str]]:
    """For each part its name, centre, how far off it is at most, and volume, with units; empty if
    not known. A poor estimate has no bounds."""
    rows = []
    for name, part in report.parts.items():
        row = {"part": name, "centre": "not found", "bound": "", "volume": ""}
        if part.center_mm is not None:
            x, y, z = part.center_mm
            row |= {"centre": f"({x:.1f}, {y:.1f}, {z:.1f}) mm"}
            row |= {"volume": f"{part.volume_ml:.1f} ml", "bound": assessment.bound_words(name)}
        rows.append(row)
    return rows


def row_words(row: dict[str, str]) -> str:
    words = (f"centre {row['centre']}", row["bound"], row["volume"])
    return f"{row['part']}: {', '.join(filter(None, words)).replace('centre not', 'not')}"


def other_lines(estimate: Estimate) -> list[str]:
    """Other places that the points allow as well, which put a tumor elsewhere; and the best of what
    can be learnt next at once: each kind's first alone, as what follows it presumes it."""
    cost = estimate.report.fit_cost
    first = {each.kind: each for each in reversed(_next_evidence(estimate))}.values()
    best = min(first, key=lambda each: each.then_bound_mm or np.inf, default=None)
    lines = [other.message for other in (() if cost is None else cost.others)]
    return lines + ([] if best is None else [f"next, {best.message}"])


def _next_evidence(estimate: Estimate) -> tuple[NextEvidence, ...]:
    """Nothing of an answer that may be another organ, or in another place."""
    if estimate.finding is not None and estimate.finding.kind not in FAR_OFF:
        return ()
    return estimate.assessment.next_evidence


def spots(estimate: Estimate) -> Iterator[tuple[Point, colours.Colour]]:
    """Where evidence lies, and where to touch next."""
    for each in estimate.report.evidence:
        colour = colours.NONE if each.rejected else colours.WHITE
        yield from ((place_mm, colour) for place_mm in each.places_mm)
    touches = (each for each in _next_evidence(estimate) if each.kind == "touch")
    yield from ((each.place_mm, colours.TO_CUT) for each in touches)
