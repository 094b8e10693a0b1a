"""The values of planning: configuration, located organ, cuts, the piece that comes away.

All in the ``table`` frame, mm: z up against gravity, its origin on the table's top. The paper's
'transverse plane' is the table's plane, its 'superior' is up and its 'posterior' is down.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float, Float64, UInt8

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.geometry import transform_points
from tumortrack.core.organ import organ_name
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.report import MarginReport
from tumortrack.core.types import FIRST_TUMOR, Mesh

Method = Literal["published", "margin"]
Direction = Literal["shortest", "clockwise", "anticlockwise"]
StrokeKind = Literal["wall", "floor"]
Rings = tuple[Float64[np.ndarray, "_ 2"], ...]
MARGIN_MM = (1.0, 20.0)  # allowed
# Beginnings of the notes that pictures and screens must always show, first.
POOR_ESTIMATE = "PLANNED ON A POOR ESTIMATE"
OVER_BUDGET = "PLANNED OVER ITS ERROR BUDGET"
UNGUARDED = "Nothing keeps the cuts away from"


class ResectionConfig(Config, frozen=True, kw_only=True):
    """How to cut a tumor out.

    Attributes:
        method: published: the paper's two sweeps round the tumor's projection; margin: layers that
            keep the margin in all directions.
        tumor: its part's name (tumor_1, ...); empty: the one that lies farthest out.
        margin_mm: least distance between tumor and cut (the paper's 5), to which ``sigmas``
            standard deviations of the estimate's own uncertainty are added; with them it is
            nowhere wider than ``most_margin_mm``.
        spacing_mm: between points of a stroke.
        layer_mm: height of a layer, where the method is ``margin``.
        stroke_mm: width that one stroke of the horizontal instrument cuts.
        order: of layers, from the top down or from the floor up.
        direction: of strokes, seen from above; shortest: each from the end that is nearer to where
            the one before ended.
        lead_mm: strokes begin and end so far outside the organ.
        least_exophytic: a tumor with a smaller share outside the organ's hull lies wholly inside.
        most_healthy: the largest share of the organ's healthy tissue that a plan may take.
        keep_away: structures that no cut may come near to, with the least distance in mm.
    """

    method: Method = "margin"
    tumor: str = ""
    margin_mm: float = 5.0
    sigmas: float = 0.0
    spacing_mm: float = 1.0
    layer_mm: float = 4.0
    stroke_mm: float = 6.0
    order: Literal["down", "up"] = "down"
    direction: Direction = "shortest"
    lead_mm: float = 5.0
    least_exophytic: float = 0.05
    most_healthy: float = 0.5
    most_margin_mm: float = 20.0
    keep_away: dict[str, float] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        self.check_between("plan:", margin_mm=MARGIN_MM, most_margin_mm=(20, 60), sigmas=(0, 10))
        self.check_between("plan:", spacing_mm=(0.2, 10), layer_mm=(1, 20), stroke_mm=(1, 30))
        if not all(0 < mm <= 50 for mm in self.keep_away.values()):
            raise InputError(f"plan: keep_away is {self.keep_away}; allowed: above 0 to 50 mm.")
        self.check_between("plan:", lead_mm=(0, 30), least_exophytic=(0, 1), most_healthy=(0, 1))


def name_of(label: int) -> str:
    """2 is tumor_1, 3 is tumor_2."""
    return f"tumor_{label - 1}"


def organ_surface(meshes: Mapping[str, Mesh]) -> Mesh:
    """The organ's surface; NoPlan: there is none."""
    if (name := organ_name(meshes)) is None:
        raise NoPlan("no organ was located, so nothing can be planned. Locate it first.")
    return meshes[name]


@dataclass(frozen=True, eq=False)
class Located:
    """Organ and tumors as located, mm; table frame, or before they are ``moved`` the camera's.

    Attributes:
        points_mm, labels: the labelled cloud: label 1 organ without tumors, 2, 3, ... tumors.
        meshes: closed surfaces: the organ's name (tumors included), tumor_1, ...
        std_mm: per tumor, the standard deviation of each of its mesh's vertices along the axis that
            is least sure; left out where the estimate has none.
        margin: the estimate's margins (``tracking.margins``).
        structures: further surfaces that move with the organ, closed or open.
        doubt: why the estimate is poor; empty: it is good.
    """

    points_mm: Float[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    meshes: dict[str, Mesh] = field(default_factory=dict)
    std_mm: dict[str, Float64[np.ndarray, " v"]] = field(default_factory=dict)
    stamp_ns: int = 0
    patient: Patient = NOBODY
    margin: MarginReport | None = None
    structures: Mapping[str, Mesh] = field(default_factory=dict)
    doubt: str = ""

    def moved(self, b_from_a: Float[np.ndarray, "4 4"]) -> Located:
        """The same in another frame."""
        points_mm = transform_points(b_from_a, self.points_mm)
        meshes, structures = (
            {name: mesh.moved(transform_points(b_from_a, mesh.vertices_mm)) for name, mesh in of}
            for of in (self.meshes.items(), self.structures.items())
        )
        return replace(self, points_mm=points_mm, meshes=meshes, structures=structures)

    def of(self, label: int) -> Float[np.ndarray, "m 3"]:
        return self.points_mm[self.labels == label]

    @property
    def organ(self) -> Mesh:
        """The organ's surface; NoPlan: it was not located."""
        return organ_surface(self.meshes)

    @property
    def tumors(self) -> tuple[int, ...]:
        """Labels of the located tumors."""
        labels = np.flatnonzero(np.bincount(self.labels)).tolist()
        return tuple(label for label in labels if label >= FIRST_TUMOR)


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

    ``sweep``: the one it belongs to, from 1. ``path_mm``: of the tip, evenly spaced, all at one
    height, in the order of motion; of a closed stroke the first point is repeated at the end.
    ``kind``: wall: along the outline of a layer; floor: the sheet below the piece.
    """

    sweep: int
    path_mm: Float64[np.ndarray, "_ 3"]
    kind: StrokeKind = "wall"

    @classmethod
    def level(cls, sweep: int, flat: np.ndarray, height: float, kind: StrokeKind = "wall") -> Cut:
        """From its x and y (n, 2), and its height, mm."""
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
    """Where to grasp and to cut, and what comes away if the estimate is right.

    Attributes:
        tumor: its part's name (tumor_1, ...) and ``label``.
        grasp_mm: where the grasper's cup touches, coming from straight above.
        cuts: strokes in their order.
        layers: what the cuts enclose, top first: the wall is each layer's outline, and where a
            layer is wider than the one below it, or has none below, the tissue is cut level.
        margin_mm: the requested least distance between tumor and cut.
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
    def warnings(self) -> tuple[str, ...]:
        """Notes that say not to rely on the plan."""
        beginnings = (POOR_ESTIMATE, OVER_BUDGET, UNGUARDED)
        return tuple(note for note in self.notes if note.startswith(beginnings))

    @property
    def sweeps(self) -> int:
        return max(cut.sweep for cut in self.cuts)


# Of a planning method: layers, cuts, and the grasp point (table frame, mm)
MethodResult = tuple[tuple[CutLayer, ...], tuple[Cut, ...], Float64[np.ndarray, " 3"]]
