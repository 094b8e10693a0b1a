"""Molds for casting the organ: two halves along the organ's own parting surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tumortrack.core.config import Config
from tumortrack.core.types import Anatomy
from tumortrack_experiment.kit.values import PrintedPart


class MoldConfig(Config):
    """Sizes of the molds, mm. ``clearance_mm``: between a key and its hole, on the radius.
    ``largest_undercut_mm``: how far the cast may have to yield when a part is pulled off.
    ``bed_mm``: the printer's; larger parts are split."""

    wall_mm: float = 5.0
    clearance_mm: float = 0.25
    parts: int = 2
    largest_undercut_mm: float = 4.0
    sprue_mm: float = 10.0
    vent_mm: float = 1.5
    pin_mm: float = 1.5
    bed_mm: tuple[float, float, float] = (220.0, 220.0, 250.0)


@dataclass(frozen=True, eq=False)
class Pin:
    """A straight rod that holds a tumor (its number, from 1) in the organ mold; ``ct`` frame.
    ``tip_ct`` lies in the tumor, ``entry_ct`` on its surface, ``mouth_ct`` on the mold's outside.
    """

    tumor: int
    tip_ct: Float64[np.ndarray, " 3"]
    entry_ct: Float64[np.ndarray, " 3"]
    mouth_ct: Float64[np.ndarray, " 3"]
    diameter_mm: float
    length_mm: float  # to cut it to: from the tip to 10 mm outside


@dataclass(frozen=True, eq=False)
class OrganMold:
    """The printed parts, how they come off, and what was measured on them.

    The mold stands on its lower part when it is filled: ``pull_ct``, the way in which the upper
    part comes off, is up. ``parting_ct``: the loop where the parting surface meets the organ.
    ``checks``: numbers by name with their unit.
    """

    parts: tuple[PrintedPart, ...]
    pull_ct: Float64[np.ndarray, " 3"]
    parting_ct: Float64[np.ndarray, "n 3"]
    undercut_mm2: float
    undercut_share: float
    undercut_depth_mm: float
    cast_ml: float
    sprue_ct: Float64[np.ndarray, " 3"]  # where it meets the organ
    vents_ct: Float64[np.ndarray, "v 3"]
    pins: tuple[Pin, ...]
    checks: tuple[tuple[str, float], ...]


def organ_mold(anatomy: Anatomy, config: MoldConfig) -> OrganMold:
    """The organ's mold with a sprue, vents, keys, bolt holes and the holes for the tumors' pins."""
    raise NotImplementedError


def tumor_molds(
    anatomy: Anatomy, config: MoldConfig, pins: tuple[Pin, ...]
) -> tuple[PrintedPart, ...]:
    """A mold of two halves for each tumor, with holes for the same pins, which leave in the cast
    tumor the holes by which they hold it in the organ mold."""
    raise NotImplementedError


def split_to_bed(part: PrintedPart, bed_mm: tuple[float, float, float]) -> tuple[PrintedPart, ...]:
    """The part itself where it fits the bed as it lies or turned by a quarter; else pieces that
    do, with pegs and holes on their cuts."""
    raise NotImplementedError
