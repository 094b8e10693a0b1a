"""All colours that are shown: red, green and blue in 0..255.

A part has the same colour in every picture, page, viewer, film and export: ``part_colour(label)``
or ``name_colour("tumor_2")``. ``css`` converts it for pages, ``report.renderer.rgb`` for drawings.

Tumors have the palette of Okabe and Ito (Color Universal Design, 2008,
https://jfly.uni-koeln.de/color) without colours like the organ's, which is 3D Slicer's for kidneys.
``tests/core/test_colours.py`` checks that they differ for every kind of colour vision.
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
PIECE: Colour = (110, 80, 200)  # that a plan removes
SEEN: Colour = (112, 118, 126)
ORGAN: Colour = (225, 230, 235)
REGION: Colour = (64, 70, 82)
PICKED: Colour = (255, 80, 200)

GOOD: Colour = (88, 100, 114)  # not green, which would mean that it is safe to cut
POOR: Colour = (210, 140, 0)
NONE: Colour = (205, 20, 30)
VERDICTS = {"good": GOOD, "poor": POOR, "none": NONE}
STALE: Colour = (110, 60, 160)
CONTROL: Colour = (45, 95, 165)
TO_CUT: Colour = (0, 120, 240)
NOW: Colour = (205, 0, 130)  # being cut
CUT: Colour = (120, 40, 40)
ENERGISED: Colour = (70, 0, 255)  # an electrode that cuts
WHITE: Colour = (255, 255, 255)
BACKGROUND: Colour = (22, 24, 29)

_SWEEPS = ((0, 120, 240), (90, 60, 220), (205, 0, 130))


def part_colour(label: int) -> Colour:
    """Of label 1 (organ), 2, 3, ... (tumors); repeats after the fifth tumor."""
    return ORGAN_PART if label == 1 else TUMORS[(label - 2) % len(TUMORS)]


def name_colour(name: str) -> Colour:
    """Of a part's name: ``tumor_1``, ``tumor_2``, ...; any other is the organ's."""
    return part_colour(int(name.split("_")[1]) + 1) if is_tumor(name) else ORGAN_PART


def structure_colour(number: int) -> Colour:
    return STRUCTURES[number % len(STRUCTURES)]


def label_colours(labels: UInt8[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    return np.array([SEEN, *(part_colour(n) for n in range(1, 256))], np.uint8)[labels]


def css(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def sweep_colour(sweep: int, sweeps: int) -> Colour:
    """Of the cuts in sweep 1, 2, ...: from blue to magenta, colours that no part has."""
    share = (sweep - 1) / max(sweeps - 1, 1)
    mixed = [np.interp(share, (0.0, 0.5, 1.0), shades) for shades in zip(*_SWEEPS, strict=True)]
    red, green, blue = (round(float(value)) for value in mixed)
    return red, green, blue
