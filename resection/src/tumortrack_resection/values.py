"""The values of planning, in the ``table`` frame, mm: z up against gravity, its origin on the
table's top. The paper's 'transverse plane' is the table's plane, its 'superior' is up."""

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
from tumortrack.core.report import Finding
from tumortrack.core.types import FIRST_TUMOR, Mesh

Method = Literal["published", "margin"]
MARGIN_MM = (1.0, 20.0)  # allowed
ELECTRODE = "electrode"
# Beginnings of the notes that pictures and screens must always show, first.
POOR_ESTIMATE = "PLANNED ON A POOR ESTIMATE"
OVER_BUDGET = "PLANNED OVER ITS ERROR BUDGET"
UNCHECKED = "UNCHECKED"
WEAK_CASE = "PLANNED ON A WEAK CASE"
CUTS_TUMOR = "THE INSTRUMENT CUTS INTO"
NO_ROOM = "NO ROOM TO KEEP"
UNGUARDED = "Nothing keeps the cuts away from"
WARNINGS = (POOR_ESTIMATE, WEAK_CASE, CUTS_TUMOR, OVER_BUDGET, NO_ROOM, UNCHECKED, UNGUARDED)


class ResectionConfig(Config, frozen=True, kw_only=True):
    """How to cut a tumor out.

    Attributes:
        method: published: the paper's two sweeps; margin: plane facets in which the electrode lies.
        tumor: its part's name (tumor_1, ...); empty: the one that lies farthest out.
        margin_mm: least distance between tumor and electrode (the paper's 5).
        spacing_mm: between points of a stroke.
        lead_mm: strokes begin and end so far outside the organ.
        most_facets: of the piece; more follow the tumor more closely, and take longer.
        least_exophytic: a tumor with a smaller share outside the organ's hull lies wholly inside.
        most_healthy: the largest share of the organ's healthy tissue that a plan may take.
        keep_away: structures and tumors, with distances in mm; other tumors keep ``margin_mm``.
    """

    method: Method = "margin"
    tumor: str = ""
    margin_mm: float = 5.0
    spacing_mm: float = 1.0
    lead_mm: float = 5.0
    most_facets: int = 6
    least_exophytic: float = 0.05
    most_healthy: float = 0.5
    keep_away: dict[str, float] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        self.check_between("plan:", margin_mm=MARGIN_MM, spacing_mm=(0.2, 2), lead_mm=(0, 30))
        shares = {"least_exophytic": (0, 1), "most_healthy": (0, 1)}
        self.check_between("plan:", most_facets=(1, 12), **shares)
        if not all(0 < mm <= 50 for mm in self.keep_away.values()):
            raise InputError(f"plan: keep_away is {self.keep_away}; allowed: above 0 to 50 mm.")


def name_of(label: int) -> str:
    """2 is tumor_1, 3 is tumor_2."""
    return f"tumor_{label - 1}"


def label_of(tumor: str) -> int:
    """tumor_1 has label 2."""
    return int(tumor.removeprefix("tumor_")) + 1


def organ_surface(meshes: Mapping[str, Mesh]) -> Mesh:
    """The organ's surface; NoPlan: there is none."""
    if (name := organ_name(meshes)) is None:
        raise NoPlan("no organ was located, so nothing can be planned. Locate it first.")
    return meshes[name]


@dataclass(frozen=True, eq=False)
class Located:
    """Organ and tumors as located, mm; table frame, or before they are ``moved`` the camera's.

    ``labels``: 1 organ without tumors, 2, 3, ... tumors. ``meshes``: closed; the organ's includes
    the tumors. ``bounds_mm``: how far off a tumor is at most (95 %), where known. ``structures``:
    closed or open. ``doubt``: why the estimate is poor. ``weak``: what weakens the case.
    """

    points_mm: Float[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    meshes: dict[str, Mesh] = field(default_factory=dict)
    bounds_mm: Mapping[str, float] = field(default_factory=dict)
    stamp_ns: int = 0
    patient: Patient = NOBODY
    structures: Mapping[str, Mesh] = field(default_factory=dict)
    doubt: str = ""
    weak: tuple[Finding, ...] = ()

    def transformed(self, b_from_a: Float[np.ndarray, "4 4"]) -> Located:
        points_mm = transform_points(b_from_a, self.points_mm)
        meshes, structures = (
            {
                name: mesh.with_vertices(transform_points(b_from_a, mesh.vertices_mm))
                for name, mesh in of
            }
            for of in (self.meshes.items(), self.structures.items())
        )
        return replace(self, points_mm=points_mm, meshes=meshes, structures=structures)

    def points_of(self, label: int) -> Float[np.ndarray, "m 3"]:
        return self.points_mm[self.labels == label]

    @property
    def organ(self) -> Mesh:
        """The organ's surface; NoPlan: it was not located."""
        return organ_surface(self.meshes)

    @property
    def surfaces(self) -> dict[str, Mesh]:
        """Of all parts and structures."""
        return {**self.meshes, **self.structures}

    @property
    def parenchyma_ml(self) -> float:
        tumors = (self.meshes[name_of(n)].volume_ml for n in self.tumors)
        return self.organ.volume_ml - sum(tumors)

    @property
    def tumors(self) -> tuple[int, ...]:
        """Labels of those with points or a surface."""
        counts = np.bincount(self.labels, minlength=np.iinfo(np.uint8).max + 1)
        named = range(FIRST_TUMOR, len(counts))
        return tuple(n for n in named if counts[n] or name_of(n) in self.meshes)


@dataclass(frozen=True, eq=False)
class Cut:
    """One pass of the instrument. ``path_mm``: of the electrode's tip, in the order of motion.
    ``axis``: unit vector from the pencil to the tip; None: level, in directions that the arms
    choose."""

    sweep: int
    path_mm: Float64[np.ndarray, "_ 3"]
    axis: Float64[np.ndarray, " 3"] | None = None

    @property
    def closed(self) -> bool:
        return bool(np.allclose(self.path_mm[0], self.path_mm[-1]))

    @property
    def length_mm(self) -> float:
        return float(np.linalg.norm(np.diff(self.path_mm, axis=0), axis=1).sum())


@dataclass(frozen=True)
class Clearance:
    """The least distance, over all motions, of one solid of a tool to one surface: ``least_mm``
    (negative: the solid's axis goes so deep into the part), reached ``at_s`` after ``stage``
    began, at the nearest place of the part's surface. ``energised_mm``: the same while the
    electrode cuts; None: never, or another solid."""

    solid: str
    part: str
    least_mm: float
    energised_mm: float | None
    stage: str
    at_s: float
    place_mm: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class ResectionPlan:
    """Where to grasp and to cut, and what comes away if the estimate is right.

    Attributes:
        grasp_mm: where the grasper's cup touches.
        cuts: passes in their order.
        piece: what comes away, closed; without what the electrode's width takes.
        taken: names of the tumors that come away, the planned one among them.
        keep_mm: what the electrode keeps away from beside them, with distances.
        facets: of the method ``margin``, one a sweep: outward unit normals n and offsets h, mm. The
            electrode's axis stays in n x = h; the piece lies on the inner sides.
        lift: unit vector along which the piece is lifted out, and from where the cup comes.
        volumes_ml: organ, parenchyma (of that, no tumor), tumor, piece, healthy (of the piece,
            parenchyma); with facets kerf (parenchyma within the electrode's width).
        exophytic: share of the tumor outside the organ's hull.
        clearances: what the check of the motions found; empty: there are none: unchecked.
    """

    method: Method
    tumor: str
    label: int
    grasp_mm: Float64[np.ndarray, " 3"]
    cuts: tuple[Cut, ...]
    piece: Mesh
    taken: tuple[str, ...]
    keep_mm: dict[str, float]
    facets: Float64[np.ndarray, "k 4"]
    lift: Float64[np.ndarray, " 3"]
    margin_mm: float
    volumes_ml: dict[str, float]
    exophytic: float
    stamp_ns: int = 0
    notes: tuple[str, ...] = ()
    clearances: tuple[Clearance, ...] = ()

    def transformed(self, b_from_a: Float[np.ndarray, "4 4"]) -> ResectionPlan:
        """Facets, cuts and grasp where a tumor that moved rigidly has taken them."""
        turn, shift = b_from_a[:3, :3], b_from_a[:3, 3]
        normals = self.facets[:, :3] @ turn.T
        cuts = tuple(
            replace(
                cut, path_mm=transform_points(b_from_a, cut.path_mm),
                axis=None if cut.axis is None else turn @ cut.axis,
            )
            for cut in self.cuts
        )  # fmt: skip
        return replace(
            self, facets=np.column_stack([normals, self.facets[:, 3] + normals @ shift]), cuts=cuts,
            grasp_mm=turn @ self.grasp_mm + shift, lift=turn @ self.lift,
        )  # fmt: skip

    @property
    def warnings(self) -> tuple[str, ...]:
        """Notes that say not to rely on the plan."""
        return tuple(note for note in self.notes if note.startswith(WARNINGS))

    @property
    def sweeps(self) -> int:
        return max(cut.sweep for cut in self.cuts)

    @property
    def least_mm(self) -> dict[str, float]:
        """The electrode's least distance to each tumor and structure; empty: unchecked."""
        return {each.part: each.least_mm for each in self.clearances if each.solid == ELECTRODE}
