"""Where straight pins hold a tumor in the organ's mold, and how firmly."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points, unit
from tumortrack.core.types import Mesh
from tumortrack.imaging.grid import grid_round
from tumortrack.imaging.raster import voxelise
from tumortrack_experiment.kit.casting import FLANGE_MM, THICK_MM, Layout
from tumortrack_experiment.kit.parting import directions

HANDLE_MM = 10.0  # of a pin outside the mold
_WAYS = 600  # directions tried: 8 degrees apart
_COMPARED = 60  # of them, in all threes
_DEEP_MM = 8.0  # in the tumor, at most; and at most this share of the way to its middle:
_DEEP = 0.6
_OFF_MM = 3.0  # from other tumors and pins, and of its hole from the parting surface
_STEP_MM = 0.5
_UPPER, _UNDER, _LONG_MM = 0.4, 0.2, 300.0  # costs in units of ``firmness``; of a mm: 1/300
_NOWHERE = np.full((1, 3), 1e6)


@dataclass(frozen=True, eq=False)
class Pin:
    """A straight rod that holds a tumor (its number, from 1) in the organ's mold; in one frame.

    ``tip_mm`` lies in the tumor, ``entry_mm`` on its surface, ``mouth_mm`` on the mold's outside.
    """

    tumor: int
    diameter_mm: float
    tip_mm: Float64[np.ndarray, " 3"]
    entry_mm: Float64[np.ndarray, " 3"]
    mouth_mm: Float64[np.ndarray, " 3"]

    @property
    def length_mm(self) -> float:
        """From its tip to 10 mm outside."""
        return float(np.linalg.norm(self.mouth_mm - self.tip_mm)) + HANDLE_MM

    @property
    def way(self) -> Float64[np.ndarray, " 3"]:
        """From the tumor outwards, a unit vector."""
        return unit(self.mouth_mm - self.tip_mm)

    def moved(self, b_from_a: Float64[np.ndarray, "4 4"]) -> Pin:
        """The same in another frame."""
        ends = transform_points(b_from_a, np.stack([self.tip_mm, self.entry_mm, self.mouth_mm]))
        return Pin(self.tumor, self.diameter_mm, *ends)


def firmness(ways: Float64[np.ndarray, "p 3"]) -> float:
    """How firmly pins hold against a shift in the direction in which they hold least: 0, they all
    are parallel and let it slide; 1, as three that are square to each other. A pin in its hole
    holds what it pierces across its axis and not along it."""
    return float(len(ways) - np.linalg.eigvalsh(ways.T @ ways)[-1]) / 2


def place_pins(layout: Layout, tumors: list[Mesh], pin_mm: float) -> list[Pin]:
    """Three pins for each tumor, in the order of the tumors; all in the mold's frame.

    They keep off other tumors and pins, sprue and vents, and their holes off the parting surface.

    Raises:
        InputError: a tumor that cannot be reached by three.
    """
    pins: list[Pin] = []
    surfaces = [tumor.spread_mm(1.5) for tumor in tumors]
    organ = _Inside(layout.mesh, 1.0)
    for number, tumor in enumerate(tumors, 1):
        taken = [points for n, points in enumerate(surfaces, 1) if n != number]
        taken += [np.linspace(pin.tip_mm, pin.mouth_mm, 100) for pin in pins]
        found = _reaching(layout, organ, tumor, cKDTree(np.concatenate([*taken, _NOWHERE])))
        if len(found) < 3:
            raise InputError(
                f"tumor {number} can be reached by {len(found)} straight pins that keep "
                f"{_OFF_MM:g} mm from other tumors and from the parting surface; 3 are needed."
            )
        pins += [Pin(number, pin_mm, *ends) for ends in _best_three(layout, found)]
    return pins


class _Inside:
    """Which points lie in a closed mesh, by its voxels."""

    def __init__(self, mesh: Mesh, step_mm: float) -> None:
        self.frame, shape = grid_round(mesh.box_mm, step_mm, 2 * step_mm)
        self.cells = voxelise(mesh, self.frame, shape)

    def __call__(self, points_mm: Float64[np.ndarray, "*n 3"]) -> Bool[np.ndarray, " *n"]:
        index = np.rint((points_mm - self.frame[:3, 3]) / self.frame[0, 0]).astype(int)
        return self.cells[
            tuple(np.moveaxis(np.clip(index, 0, np.array(self.cells.shape) - 1), -1, 0))
        ]

    def deepest_mm(self) -> Float64[np.ndarray, " 3"]:
        """The point that is farthest from the surface."""
        depth = ndimage.distance_transform_edt(self.cells)
        at = np.unravel_index(depth.argmax(), depth.shape)
        return self.frame[:3, 3] + self.frame[0, 0] * np.array(at)


def _reaching(
    layout: Layout, organ: _Inside, tumor: Mesh, taken: cKDTree
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Tip, entry and mouth of every straight way to a tumor's middle that is free."""
    inside = _Inside(tumor, 0.5)
    middle, ways = inside.deepest_mm(), directions(_WAYS)
    run = np.arange(0, np.linalg.norm(np.ptp(layout.mesh.box_mm, axis=0)) + 80.0, _STEP_MM)
    points = middle + run[:, None] * ways[:, None]
    above = points[..., 2] - layout.field.at(points[..., :2].reshape(-1, 2)).reshape(len(ways), -1)
    beyond = layout.beyond_wall(points[..., :2])
    z = points[..., 2]
    block = (beyond < 0) & (z > layout.bottom_mm) & (z < layout.top_mm)
    block |= (beyond < FLANGE_MM) & (np.abs(above) < THICK_MM + FLANGE_MM - np.maximum(beyond, 0))
    entry = len(run) - 1 - inside(points)[:, ::-1].argmax(1)
    mouth = len(run) - 1 - block[:, ::-1].argmax(1)
    outside = np.arange(len(run)) > entry[:, None]
    wall = block & outside & ~organ(points)
    air = np.linalg.norm(points[..., :2] - layout.sprue_mm[:2], axis=-1)
    bad = wall & (z > layout.sprue_mm[2]) & (air < 3 * layout.sprue_radius_mm + _OFF_MM)
    for vent in layout.vents_mm:
        bad |= wall & (np.linalg.norm(points[..., :2] - vent[:2], axis=-1) < _OFF_MM)
    bad |= wall & (np.abs(above) < _OFF_MM)
    free = ~bad.any(1) & ~((wall & (above > 0)).any(1) & (wall & (above < 0)).any(1))
    found = []
    for n in np.flatnonzero(free):
        deep = min(_DEEP_MM, _DEEP * run[entry[n]])
        way = points[n, entry[n] : mouth[n] + 1]
        if taken.query(way[::3])[0].min() > _OFF_MM:
            found.append((way[0] - deep * ways[n], way[0], way[-1]))
    return found


def _best_three(
    layout: Layout, found: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Firm, short, rather through the lower half, which is open while a tumor is set on them, and
    through its side, since the mold stands on its bottom."""
    ends = np.array(found)
    length = np.linalg.norm(ends[:, 2] - ends[:, 0], axis=1)
    z = ends[:, 2, 2]
    cost = length / _LONG_MM + _UPPER * (z > layout.field.at(ends[:, 2, :2]))
    cost += _UNDER * (z < layout.bottom_mm + 1.0)
    some = np.argsort(cost, kind="stable")[:: max(len(found) // _COMPARED, 1)]
    threes = some[np.array(list(combinations(range(len(some)), 3)))]
    ways = (ends[:, 2] - ends[:, 0]) / length[:, None]
    held = ways[threes]
    slack = np.linalg.eigvalsh(np.swapaxes(held, 1, 2) @ held)[:, -1]  # as in ``firmness``
    worth = (3 - slack) / 2 - cost[threes].mean(1)
    return [found[n] for n in threes[int(np.argmax(worth))]]
