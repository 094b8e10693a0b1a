"""Transforms of a PLUS configuration (https://pluslib.readthedocs.io, Coordinate system
definitions)."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, readable
from tumortrack.core.store import read_file
from tumortrack.io.csv_tables import text_of

_LARGEST = 16 * 2**20  # bytes


class PlusTransform(NamedTuple):
    """Carries ``of`` into ``to``, mm; its numbers need not be right. ``error_mm``: NaN: unsaid."""

    of: str
    to: str
    rows: Float64[np.ndarray, "4 4"]
    error_mm: float


def read_plus(path: Path) -> list[PlusTransform]:
    """Raises InputError: missing, damaged, or it has none."""
    text = text_of(read_file(path, _LARGEST), str(path))
    if "<!DOCTYPE" in text:  # which may define entities without end
        raise InputError(f"{path} has a DOCTYPE, which PLUS does not write; remove it.")
    with readable(path, "is no PLUS configuration"):
        found = [
            PlusTransform(
                each.attrib["From"],
                each.attrib["To"],
                np.array(each.attrib["Matrix"].split(), float).reshape(4, 4),
                float(each.get("Error", "nan")),
            )
            for each in ElementTree.fromstring(text).findall(".//CoordinateDefinitions/Transform")
        ]
    if not found:
        raise InputError(f"{path} has no CoordinateDefinitions with a Transform.")
    return found
