"""The values of planning: what was located, where to cut, and what comes away.

All in the ``table`` frame, mm: z up against gravity, its origin on the table's top. The paper's
'transverse plane' is the table's plane, its 'superior' is up and its 'posterior' is down.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.types import FIRST_TUMOR, Mesh, part_names

Method = Literal["published", "margin"]
StrokeKind = Literal["wall", "floor"]
Rings = tuple[Float64[np.ndarray, "_ 2"], ...]


def name_of(label: int) -> str:
    """The part's name: 1 is kidney, 2 is tumor_1."""
    return part_names(label)[label - 1]


@dataclass(frozen=True, eq=False)
class Located:
    """Kidney and tumors as located, table frame, mm.

    Attributes:
        points_mm, labels: the labelled cloud: label 1 organ without tumors, 2, 3, ... tumors.
        meshes: closed surfaces, as far as known: kidney (tumors included), tumor_1, ...
        std_mm: per tumor, the standard deviation of each of its mesh's vertices along any axis;
            left out where the estimate has none.
    """

    points_mm: Float[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    meshes: dict[str, Mesh] = field(default_factory=dict)
    std_mm: dict[str, Float64[np.ndarray, " v"]] = field(default_factory=dict)
    stamp_ns: int = 0

    def of(self, label: int) -> Float[np.ndarray, "m 3"]:
        """The points with this label."""
        return self._by_label.get(label, self.points_mm[:0])

    @property
    def tumors(self) -> tuple[int, ...]:
        """Labels of the tumors that were found."""
        return tuple(label for label in self._by_label if label >= FIRST_TUMOR)

    @cached_property
    def _by_label(self) -> dict[int, Float[np.ndarray, "m 3"]]:
        labels = np.flatnonzero(np.bincount(self.labels))
        return {int(label): self.points_mm[self.labels == label] for label in labels}


@dataclass(frozen=True, eq=False)
class CutLayer:
    """A slab of the piece to be removed: this outline between two heights.

    ``rings_mm``: closed polygons (n, 2), x and y, the first point not repeated; several where the
    slab is in pieces. ``top_mm`` is infinite in the uppermost.
    """

    bottom_mm: float
    top_mm: float
    rings_mm: Rings

    def __post_init__(self) -> None:
        if not self.bottom_mm < self.top_mm:
            raise InputError(f"a layer from {self.bottom_mm:g} up to {self.top_mm:g} mm is none.")


@dataclass(frozen=True, eq=False)
class Cut:
    """One stroke of the instrument's tip, which is held horizontally.

    Attributes:
        sweep: which sweep it belongs to, from 1.
        path_mm: of the tip (n, 3), evenly spaced, all at one height, in the order of motion; of a
            closed stroke the first point is repeated at the end.
        kind: wall: along the outline of a layer; floor: the sheet below the piece.
    """

    sweep: int
    path_mm: Float64[np.ndarray, "n 3"]
    kind: StrokeKind = "wall"

    @classmethod
    def level(
        cls, sweep: int, flat: Float64[np.ndarray, "n 2"], height: float, kind: StrokeKind = "wall"
    ) -> Cut:
        """From its x and y, and its height, mm."""
        return cls(sweep, np.column_stack([flat, np.full(len(flat), height)]), kind)

    @property
    def height_mm(self) -> float:
        return float(self.path_mm[0, 2])

    @property
    def closed(self) -> bool:
        return bool(np.allclose(self.path_mm[0], self.path_mm[-1]))

    @property
    def length_mm(self) -> float:
        return float(np.linalg.norm(np.diff(self.path_mm, axis=0), axis=1).sum())


@dataclass(frozen=True, eq=False)
class ResectionPlan:
    """Where to grasp, where to cut, and what comes away if the estimate is right.

    Attributes:
        tumor: its part's name (tumor_1, ...) and ``label``.
        grasp_mm: where the grasper's cup touches; it comes from straight above.
        cuts: strokes in the order in which they are made.
        layers: what the cuts enclose, top first: the wall is each layer's outline, and where a
            layer is wider than the one below it, or has none below, the tissue is cut level.
        margin_mm: the least distance that was asked for between tumor and cut.
        volumes_ml: organ, parenchyma (of that, no tumor), tumor, piece (all that comes away),
            healthy (of that, parenchyma).
        exophytic: share of the tumor outside the organ's hull.
        notes: what the user should know.
    """

    method: Method
    tumor: str
    label: int
    grasp_mm: Float64[np.ndarray, " 3"]
    cuts: tuple[Cut, ...]
    layers: tuple[CutLayer, ...]
    margin_mm: float
    volumes_ml: dict[str, float]
    exophytic: float
    stamp_ns: int = 0
    notes: tuple[str, ...] = ()

    @property
    def sweeps(self) -> int:
        """How many sweeps there are."""
        return max(cut.sweep for cut in self.cuts)


# What a method of planning returns: layers, cuts, and where to grasp (table frame, mm)
MethodResult = tuple[tuple[CutLayer, ...], tuple[Cut, ...], Float64[np.ndarray, " 3"]]
