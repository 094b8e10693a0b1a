"""Where straight pins hold a tumor in the organ's mold, and how firmly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points, unit
from tumortrack.core.types import Mesh
from tumortrack_experiment.kit.casting import Layout
from tumortrack_experiment.kit.parting import Cells, directions

HANDLE_MM = 10.0  # of a pin outside the mold
_WAYS, _COMPARED = 600, 60  # directions tried, 8 degrees apart; of them, compared in all threes
_DEEP_MM, _DEEP = 8.0, 0.6  # in the tumor, at most; at most this share of the way to its middle
_OFF_MM = 3.0  # from other tumors and pins, and of a hole in the wall from the parting surface
_STEP_MM = 0.5
_UPPER, _UNDER, _LONG_MM = 0.8, 0.3, 300.0  # costs in units of ``firmness``; of a mm: 1/300


@dataclass(frozen=True, eq=False)
class Pin:
    """A straight rod that holds a tumor (its number, from 1) in the organ's mold, or leaves its
    hole in the tumor while that is cast; in one frame.

    ``tip_mm`` lies in the tumor, ``entry_mm`` on its surface, ``mouth_mm`` on that mold's outside.
    """

    tumor: int
    diameter_mm: float
    tip_mm: Float64[np.ndarray, " 3"]
    entry_mm: Float64[np.ndarray, " 3"]
    mouth_mm: Float64[np.ndarray, " 3"]

    @property
    def depth_mm(self) -> float:
        """From its tip to the mold's outside: where it has a mark."""
        return float(np.linalg.norm(self.mouth_mm - self.tip_mm))

    @property
    def length_mm(self) -> float:
        """From its tip to 10 mm outside."""
        return self.depth_mm + HANDLE_MM

    @property
    def way(self) -> Float64[np.ndarray, " 3"]:
        """From the tumor outwards, a unit vector."""
        return unit(self.mouth_mm - self.tip_mm)

    def transformed(self, b_from_a: Float64[np.ndarray, "4 4"]) -> Pin:
        """The same in another frame."""
        ends = transform_points(b_from_a, np.stack([self.tip_mm, self.entry_mm, self.mouth_mm]))
        return Pin(self.tumor, self.diameter_mm, *ends)


def firmness(ways: Float64[np.ndarray, "*n p 3"]) -> Float64[np.ndarray, " *n"]:
    """How firmly pins hold against a shift in the direction in which they hold least: 0, all are
    parallel and let it slide; 1, as three that are square to each other. Each holds what it pierces
    across its axis and not along it: the least eigenvalue of the sum of 1 - way way^T, halved."""
    along = np.linalg.eigvalsh(np.swapaxes(ways, -1, -2) @ ways)[..., -1]
    return np.asarray((ways.shape[-2] - along) / 2)


def place_pins(layout: Layout, tumors: list[Mesh], pin_mm: float) -> list[Pin]:
    """Three pins for each tumor, tumor by tumor; all in the mold's frame.

    They keep off other tumors and pins, sprue and vents, and their holes off the parting surface;
    they rather go through the lower half, in which a tumor is set on them, and through its side,
    since the mold stands on its bottom.

    Raises:
        InputError: a tumor that cannot be reached by three.
    """
    pins: list[Pin] = []
    surfaces = [tumor.spread_mm(1.5) for tumor in tumors]
    for number, tumor in enumerate(tumors, 1):
        taken = [points for n, points in enumerate(surfaces, 1) if n != number]
        taken += [np.linspace(pin.tip_mm, pin.mouth_mm, 100) for pin in pins]
        ends = _reaching(layout, tumor, cKDTree(np.concatenate([*taken, np.full((1, 3), 1e6)])))
        if len(ends) < 3:
            raise InputError(
                f"tumor {number} can be reached by {len(ends)} straight pins that keep "
                f"{_OFF_MM:g} mm from other tumors and from the parting surface; 3 are needed."
            )
        mouth, way = ends[:, 2], ends[:, 2] - ends[:, 0]
        length = np.linalg.norm(way, axis=1)
        cost = length / _LONG_MM + _UPPER * (mouth[:, 2] > layout.field.at(mouth))
        cost += _UNDER * (mouth[:, 2] < layout.bottom_mm + 1.0)
        some = np.argsort(cost, kind="stable")[:: -(-len(ends) // _COMPARED)]
        threes = some[np.array(list(combinations(range(len(some)), 3)))]
        worth = firmness((way / length[:, None])[threes]) - cost[threes].mean(1)
        pins += [Pin(number, pin_mm, *ends[n]) for n in threes[worth.argmax()]]
    return pins


def in_own_mold(pin: Pin, layout: Layout) -> Pin:
    """A pin of the organ's mold as it goes through its tumor's own; both in that mold's frame."""
    run = np.arange(0, 2 * layout.mesh.longest_mm + 100.0, 0.1)[:, None]
    points = pin.tip_mm + run * pin.way
    return replace(pin, mouth_mm=points[np.flatnonzero(layout.in_block(points))[-1]])


def _reaching(layout: Layout, tumor: Mesh, taken: cKDTree) -> Float64[np.ndarray, "n 3 3"]:
    """Tip, entry and mouth of every straight way to a tumor's middle that is free."""
    cells, ways = Cells(tumor, (_STEP_MM,) * 3, 0.0), directions(_WAYS)
    depth = ndimage.distance_transform_edt(cells.inside)
    middle = cells.place_mm(np.array(np.unravel_index(depth.argmax(), depth.shape)))
    run = np.arange(0, np.linalg.norm(np.ptp(layout.mesh.box_mm, axis=0)) + 80.0, _STEP_MM)
    points = middle + run[:, None] * ways[:, None]
    z, above = points[..., 2], points[..., 2] - layout.field.at(points)
    block = layout.in_block(points)
    entry, mouth = (len(run) - 1 - held[:, ::-1].argmax(1) for held in (cells.at(points), block))
    wall = block & (np.arange(len(run)) > entry[:, None]) & ~layout.cells.at(points)
    bad = np.abs(above) < _OFF_MM
    for hole in (layout.sprue_mm, *layout.vents_mm):
        wide = 3 * layout.sprue_radius_mm if hole is layout.sprue_mm else 0.0
        off = np.linalg.norm(points[..., :2] - hole[:2], axis=-1) < wide + _OFF_MM
        bad |= off & (z > hole[2])
    split = (wall & (above > 0)).any(1) & (wall & (above < 0)).any(1)
    ends = []
    for n in np.flatnonzero(~(bad & wall).any(1) & ~split):
        way = points[n, entry[n] : mouth[n] + 1]
        tip = way[0] - min(_DEEP_MM, _DEEP * run[entry[n]]) * ways[n]
        if taken.query(way[::3])[0].min() > _OFF_MM and cells.at(tip):
            ends.append([tip, way[0], way[-1]])
    return np.array(ends).reshape(-1, 3, 3)
