"""What is measured on a kit, and within which limits: the table on the screen and on the sheet."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tumortrack.core.config import Config
from tumortrack.core.types import Mesh
from tumortrack_experiment.kit.base import Base, BaseConfig, eyes_mm, seen_beads
from tumortrack_experiment.kit.mold import MoldConfig, OrganMold
from tumortrack_experiment.kit.mold_checks import open_edges
from tumortrack_experiment.kit.split import fits, laid_mesh
from tumortrack_experiment.kit.stands import COMPRESSION_MM, midsection_top_mm
from tumortrack_experiment.kit.values import PrintedPart
from tumortrack_experiment.kit_file import LEAST_BEADS

_RAYS, _LINES_MM = 2000, 1.2  # three lines of a nozzle of 0.4 mm: thinner walls break
_INF = float("inf")
# By name: what it is, unit, least, most, and whether the kit is of no use without.
_LIMITS: dict[str, tuple[str, str, float, float, bool]] = {
    "open_edges": ("edges open after STL", "", 0, 0, True),
    "fits_bed": ("fits the bed", "1: yes", 1, 1, True),
    "least_wall_mm": ("least wall", "mm", _LINES_MM, _INF, False),
    "thin_percent": ("surface over less than 1.2 mm", "%", 0, 5, False),
    "cast_error_percent": ("cast volume off by", "%", -1, 1, True),
    "cast_differs_mm": ("cast surface off by, mean", "mm", 0, 0.2, False),
    "halves_overlap_mm3": ("halves overlap", "mm3", 0, 1, False),
    "undercut_percent": ("surface under cuts", "%", 0, 100, False),
    "undercut_depth_mm": ("cast must yield by", "mm", 0, MoldConfig().largest_undercut_mm, False),
    "steep_parting_deg": ("steepness of the parting, 95 %", "deg", 0, 70, False),
    "keys": ("keys", "", 2, _INF, False),
    "bolts": ("bolts", "", 2, _INF, False),
    "vents": ("vents", "", 0, _INF, False),
    "firmness": ("firmness of the pins", "0..1", 0.2, _INF, False),
    "pressed_mm": ("presses by", "mm", 0, _INF, False),
    "bead_gap_mm": ("least difference of bead distances", "mm", 1, _INF, True),
    "mirror_mm": ("misfit of the mirrored beads", "mm", 3, _INF, True),
    "tre_mm": ("expected target error", "mm", 0, 0.3, False),
    "steady_mm": ("weight inside the cradle by", "mm", 5, _INF, False),
    "seen": ("beads seen whole, fewest", "", LEAST_BEADS, _INF, True),
}  # fmt: skip


class Check(Config, frozen=True, kw_only=True):
    """One number. ``where``: of which part or tumor; ``needed``: without it the kit is of no use;
    ``least`` and ``most``: None where any number is right."""

    where: str
    what: str
    value: float
    unit: str
    least: float | None
    most: float | None
    needed: bool

    @property
    def good(self) -> bool:
        low = self.least is None or self.value >= self.least - 1e-6
        return low and (self.most is None or self.value <= self.most + 1e-6)

    @property
    def verdict(self) -> str:
        return "good" if self.good else "FAILS" if self.needed else "look"

    @property
    def limits(self) -> str:
        if self.least is not None and self.most is not None:
            return f"{self.least:g} to {self.most:g}"
        if self.least is not None:
            return f"at least {self.least:g}"
        return "" if self.most is None else f"at most {self.most:g}"


def checked(where: str, name: str, value: float) -> Check:
    what, unit, least, most, needed = _LIMITS[name]
    return Check(
        where=where, what=what, value=round(float(value), 3), unit=unit, needed=needed,
        least=least if np.isfinite(least) else None, most=most if np.isfinite(most) else None,
    )  # fmt: skip


def check_base(
    base: Base, config: BaseConfig, bed_mm: tuple[float, float, float]
) -> Iterator[Check]:
    """The base's beads, cradle and prints, and how far its plates press."""
    yield checked("beads", "bead_gap_mm", base.gap_mm)
    yield checked("beads", "mirror_mm", base.mirror_mm)
    for number, tre in enumerate(base.tre_mm, 1):
        yield checked(f"beads, tumor {number}", "tre_mm", tre)
    yield checked("cradle", "steady_mm", base.steady_mm)
    eyes = eyes_mm(base.anatomy.organ, config)
    for state in ("rest", *config.states):
        there = [p.mesh for p in base.parts if p.name == "base" or p.state == state]
        seen = seen_beads([base.anatomy.organ, *there], base.beads_mm, eyes, config.bead_mm)
        yield checked(f"beads, {state}", "seen", seen.sum(1).min())
    for part in base.parts:
        laid = laid_mesh(part)
        yield checked(part.name, "open_edges", open_edges(laid))
        yield checked(part.name, "fits_bed", fits(part, bed_mm))
        yield checked(part.name, "thin_percent", 100 * thin_share(part.mesh))
        if by := COMPRESSION_MM.get(part.state):
            pressed = midsection_top_mm(base.anatomy.organ) - plate_height_mm(part)
            yield checked(part.name, "pressed_mm", pressed)
            if abs(pressed - by) > 0.05:
                raise AssertionError(f"{part.name} presses by {pressed:.2f} mm")


def check_mold(name: str, mold: OrganMold) -> Iterator[Check]:
    """A mold's halves and its cast."""
    for key, value in mold.checks:
        if (limited := "firmness" if key.endswith("firmness") else key) in _LIMITS:
            yield checked(key.removesuffix("_firmness") if limited != key else name, limited, value)
    for part in mold.parts:
        for key, value in part.checks:
            if key in _LIMITS:
                yield checked(part.name, key, value)


def plate_height_mm(part: PrintedPart) -> float:
    """Height of a pressing plate's underside at its middle, base frame, measured on its mesh."""
    import trimesh

    solid = trimesh.Trimesh(part.mesh.vertices_mm, part.mesh.faces, process=False)
    middle = part.mesh.box_mm.mean(0)[1]
    hits, _, _ = solid.ray.intersects_location([[0.1, middle + 0.1, -1.0]], [[0.0, 0.0, 1.0]])
    return float(hits[:, 2].min())


def thin_share(mesh: Mesh) -> float:
    """Share of a solid's surface with less than 1.2 mm of it behind."""
    import trimesh

    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(solid, _RAYS, seed=0)
    inward = -solid.face_normals[face]
    ends, ray, _ = solid.ray.intersects_location(points + 1e-3 * inward, inward, False)
    return float((np.linalg.norm(ends - points[ray], axis=1) < _LINES_MM).mean())
