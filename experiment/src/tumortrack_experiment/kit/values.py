"""A part to print, before it is written to a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from tumortrack.core.types import Mesh


@dataclass(frozen=True, eq=False)
class PrintedPart:
    """A closed solid, mm, where it is in use: molds round the organ in the ``ct`` frame (LPS), what
    stands on the bench in the ``base`` frame. ``print_from_frame``: how it lies on the printer's
    bed, z up from 0. ``state``: the state that it imposes, if any. ``checks``: numbers by name,
    with their unit, as the table of checks has them."""

    name: str
    purpose: str
    mesh: Mesh
    frame: Literal["ct", "base"]
    print_from_frame: Float64[np.ndarray, "4 4"]
    state: str = ""
    checks: tuple[tuple[str, float], ...] = ()
