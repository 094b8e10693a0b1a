"""The viewer's colours: red, green and blue in 0..255."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from tumortrack.core.organ import is_tumor

Colour = tuple[int, int, int]

ORGAN_PART: Colour = (185, 102, 83)
TUMORS = ((144, 238, 144), (255, 205, 60), (110, 190, 255), (240, 130, 230), (170, 150, 255))
STRUCTURES = ((214, 40, 40), (70, 110, 220), (245, 225, 170), (150, 110, 60), (60, 170, 160))
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
BACKGROUND: Colour = (22, 24, 29)

_SWEEPS = ((0, 120, 240), (90, 60, 220), (205, 0, 130))


def part_colour(label: int) -> Colour:
    """Of label 1, 2, 3, ...: the organ, then the tumors, over again after the fifth."""
    return ORGAN_PART if label == 1 else TUMORS[(label - 2) % len(TUMORS)]


def named_colour(part: str) -> Colour:
    """Of kidney (or the organ's other name), tumor_1, tumor_2, ..."""
    return part_colour(int(part.removeprefix("tumor_")) + 1) if is_tumor(part) else ORGAN_PART


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
