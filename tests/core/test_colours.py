"""Parts differ in colour for every colour vision, and have the same one everywhere."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab

from tumortrack.core import colours
from tumortrack.core.colours import name_colour, part_colour
from tumortrack.io.segmentation_files import segments

# Linear RGB as it is seen without one kind of cone: Machado, Oliveira, Fernandes 2009, doi
# 10.1109/TVCG.2009.113, severity 1.0.
VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
         [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
         [-0.011820, 0.042940, 0.968881]]
    ),
}  # fmt: skip


def apart(first: colours.Colour, second: colours.Colour, vision: str) -> float:
    """CIEDE2000; 2.3 is just noticeable side by side."""
    srgb = np.array([first, second]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    light = np.clip(linear @ VISIONS[vision].T, 0, 1)
    shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    one, other = rgb2lab(shown[None])[0]
    return float(deltaE_ciede2000(one, other))


@pytest.mark.parametrize("vision", VISIONS)
def test_parts_differ_for_every_colour_vision(vision: str) -> None:
    parts = [part_colour(label) for label in range(1, 7)]
    for first, second in itertools.combinations(parts, 2):
        assert apart(first, second, vision) >= 10
    two = [*itertools.combinations(parts[:3], 2)]  # a kidney with two tumors
    assert min(apart(*pair, vision) for pair in two) >= 20


def test_names_and_labels_and_exports_agree() -> None:
    names = ["kidney", *(f"tumor_{n}" for n in range(1, 8))]
    expected = [part_colour(label) for label in range(1, 9)]
    assert [name_colour(name) for name in names] == expected
    assert [segment.rgb for segment in segments(names)] == expected
    assert name_colour("horseshoe_kidney") == (185, 102, 83)  # Slicer's kidney
    assert name_colour("tumor_1") == (230, 159, 0)
    assert name_colour("tumor_6") == name_colour("tumor_1")
