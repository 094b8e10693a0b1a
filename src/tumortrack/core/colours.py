"""The colours of everything that is shown: red, green and blue in 0..255.

A part has one colour in every picture, page, viewer, film and export: ``part_colour(label)``, or
``name_colour("tumor_2")`` where only a name is at hand; ``css`` makes it a page's,
``report.renderer.rgb`` a drawing's. No module names a colour for a part of its own.

Tumors have Okabe and Ito's palette (Color Universal Design, 2008, https://jfly.uni-koeln.de/color),
without what resembles the organ; the organ has 3D Slicer's colour of a kidney.
``tests/core/test_colours.py`` holds that they differ for every colour vision.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from tumortrack.core.organ import is_tumor

Colour = tuple[int, int, int]

ORGAN_PART: Colour = (185, 102, 83)
TUMORS = ((230, 159, 0), (86, 180, 233), (240, 228, 66), (204, 121, 167), (0, 158, 115))
STRUCTURES = ((214, 40, 40), (70, 110, 220), (245, 225, 170), (150, 110, 60), (60, 170, 160))
TRUTH: Colour = (0, 90, 160)  # outlines: darker than any tumor
OBSERVED: Colour = (64, 64, 64)
PIECE: Colour = (110, 80, 200)  # what a plan takes away
SEEN: Colour = (112, 118, 126)
ORGAN: Colour = (225, 230, 235)
REGION: Colour = (64, 70, 82)
PICKED: Colour = (255, 80, 200)

GOOD: Colour = (88, 100, 114)  # no green: it would say that it is safe to cut
POOR: Colour = (210, 140, 0)
NONE: Colour = (205, 20, 30)
VERDICTS = {"good": GOOD, "poor": POOR, "none": NONE}
STALE: Colour = (110, 60, 160)
ARMS: Colour = (45, 95, 165)
TO_CUT: Colour = (0, 120, 240)
NOW: Colour = (205, 0, 130)  # being cut
CUT: Colour = (120, 40, 40)
WHITE: Colour = (255, 255, 255)
BACKGROUND: Colour = (22, 24, 29)

_SWEEPS = ((0, 120, 240), (90, 60, 220), (205, 0, 130))


def part_colour(label: int) -> Colour:
    """Of label 1, 2, 3, ...: the organ, then the tumors, over again after the fifth."""
    return ORGAN_PART if label == 1 else TUMORS[(label - 2) % len(TUMORS)]


def name_colour(name: str) -> Colour:
    """Of a part by its name: ``tumor_1``, ``tumor_2``, ...; any other is the organ."""
    return part_colour(int(name.split("_")[1]) + 1) if is_tumor(name) else ORGAN_PART


def structure_colour(number: int) -> Colour:
    """Of structure 0, 1, 2, ..., over again after the fifth."""
    return STRUCTURES[number % len(STRUCTURES)]


def label_colours(labels: UInt8[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    return np.array([SEEN, *(part_colour(n) for n in range(1, 256))], np.uint8)[labels]


def css(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def sweep_colour(sweep: int, sweeps: int) -> Colour:
    """Of the cuts of sweep 1, 2, ...: from blue for the first to magenta for the last; none of it
    is a part's colour."""
    along = (sweep - 1) / max(sweeps - 1, 1)
    mixed = [np.interp(along, (0.0, 0.5, 1.0), shades) for shades in zip(*_SWEEPS, strict=True)]
    red, green, blue = (round(float(value)) for value in mixed)
    return red, green, blue
