"""What is measured on a kit, and within which limits: the table on the screen and on the sheet."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tumortrack.core.config import Config
from tumortrack_experiment.kit.base import Base, BaseConfig, eyes_mm, seen_beads
from tumortrack_experiment.kit.mold import MoldConfig, OrganMold
from tumortrack_experiment.kit.mold_checks import LINES_MM, open_edges, thin_share
from tumortrack_experiment.kit.split import fits, laid_mesh
from tumortrack_experiment.kit.stands import COMPRESSION_MM, PLATE_MM, midsection_top_mm
from tumortrack_experiment.kit.values import PrintedPart
from tumortrack_experiment.kit_file import LEAST_BEADS

_LEAST_SHOWN = 0.01
# By name: what it is, unit, least, most, and whether the kit is of no use beyond.
_COUNT, _YES = "", "yes or no"  # units
_LIMITS: dict[str, tuple[str, str, float | None, float | None, bool]] = {
    "open_edges": ("edges that are open after STL", _COUNT, 0, 0, True),
    "fits_bed": ("fits the printer's bed", _YES, 1, 1, True),
    "least_wall_mm": ("least wall", "mm", LINES_MM, None, False),
    "thin_percent": ("surface with less than 1.2 mm of material", "%", None, 5, False),
    "cast_error_percent": ("error of the cast's volume", "%", -1, 1, True),
    "cast_differs_mm": ("mean error of the cast's surface", "mm", None, 0.2, False),
    "halves_overlap_mm3": ("halves overlap", "mm3", None, 1, False),
    "undercut_percent": ("surface that undercuts the mold", "%", None, None, False),
    "undercut_depth_mm": ("the cast yields by", "mm", 0, MoldConfig().largest_undercut_mm, False),
    "steep_parting_deg": ("parting's slope, 95 %", "deg", None, 70, False),
    "keys": ("keys that centre the halves", _COUNT, 2, None, False),
    "bolts": ("bolts", _COUNT, 2, None, False),
    "firmness": ("firmness of its pins", "of 1", 0.2, None, False),
    "pressed_mm": ("midsection pressed by", "mm", None, None, True),
    "deepest_mm": ("the plate presses somewhere by", "mm", None, 25, False),
    "bead_gap_mm": ("least difference between two beads' distances", "mm", 1, None, True),
    "mirror_mm": ("misfit of mirrored beads", "mm", 3, None, True),
    "tre_mm": ("expected error of place (TRE)", "mm", None, 0.3, False),
    "steady_mm": ("centre of weight inside its support by", "mm", 5, None, False),
    "seen": ("fewest beads that a camera sees whole", _COUNT, LEAST_BEADS, None, True),
}  # fmt: skip


class Check(Config, frozen=True, kw_only=True):
    """A number. ``where``: of which part; ``verdict``: good, look, or FAILS, where the kit is of no
    use."""

    where: str
    what: str
    value: float
    unit: str
    limits: str
    verdict: str

    @property
    def number(self) -> str:
        """The value with its unit, as a person writes it."""
        if self.unit == _YES:
            return "yes" if self.value else "no"
        if self.unit in ("mm", "mm3", "%") and 0 <= self.value < _LEAST_SHOWN:
            return f"under {_LEAST_SHOWN:g} {self.unit}"
        return f"{self.value:.3g} {self.unit}".strip()


def checked(where: str, name: str, value: float, exactly: float | None = None) -> Check:
    """A number held against its limits, or against what it must be to within 0.05."""
    what, unit, least, most, needed = _LIMITS[name]
    if exactly is not None:
        least, most = exactly - 0.05, exactly + 0.05
    above = least is None or value >= least - 1e-6
    good = above and (most is None or value <= most + 1e-6)
    ends = ("at least", least), ("at most", most)
    limits = ", ".join(f"{word} {end:g}" for word, end in ends if end is not None)
    if least == most is not None:
        limits = "yes" if unit == _YES else f"exactly {least:g}"
    verdict = "good" if good else "FAILS" if needed else "look"
    value = round(float(value), 3) + 0.0
    return Check(where=where, what=what, value=value, unit=unit, limits=limits, verdict=verdict)


def check_print(part: PrintedPart, bed_mm: tuple[float, float, float]) -> Iterator[Check]:
    """A part that is no mold's."""
    yield checked(part.name, "open_edges", open_edges(laid_mesh(part)))
    yield checked(part.name, "fits_bed", fits(part, bed_mm))
    yield checked(part.name, "thin_percent", 100 * thin_share(part.mesh))


def check_base(base: Base, config: BaseConfig) -> Iterator[Check]:
    """Beads, cradle, and how far the plates press."""
    organ, eyes = base.anatomy.organ, eyes_mm(base.anatomy.organ, config)
    yield checked("beads", "bead_gap_mm", base.gap_mm)
    yield checked("beads", "mirror_mm", base.mirror_mm)
    for number, tre in enumerate(base.tre_mm, 1):
        yield checked(f"beads, tumor {number}", "tre_mm", tre)
    for state in ("rest", *config.states):
        there = [p.mesh for p in base.parts if p.name == "base" or p.state == state]
        seen = seen_beads([organ, *there], base.beads_mm, eyes, config.bead_mm)
        yield checked(f"beads, {state}", "seen", seen.sum(1).min())
    yield checked("cradle", "steady_mm", base.steady_mm)
    for part in base.parts:
        if by := COMPRESSION_MM.get(part.state):
            z = plate_height_mm(part)
            yield checked(part.name, "pressed_mm", midsection_top_mm(organ) - z, by)
            under = organ.vertices_mm[np.abs(organ.vertices_mm[:, 0]) < PLATE_MM / 2, 2]
            yield checked(part.name, "deepest_mm", under.max() - z)


def check_mold(name: str, mold: OrganMold) -> Iterator[Check]:
    """A mold's halves and its cast."""
    for key, value in mold.checks:
        if key.endswith("firmness") and name == "organ":  # a tumor's own mold has the same pins
            yield checked(key.removesuffix("_firmness").replace("_", " "), "firmness", value)
        elif key in _LIMITS:
            yield checked(name, key, value)
    for part in mold.parts:
        yield from (checked(part.name, key, value) for key, value in part.checks if key in _LIMITS)


def plate_height_mm(part: PrintedPart) -> float:
    """Height of a pressing plate's underside at its middle, base frame, measured on its mesh."""
    import trimesh

    solid = trimesh.Trimesh(part.mesh.vertices_mm, part.mesh.faces, process=False)
    x, y, _ = part.mesh.box_mm.mean(0) + 0.1  # beside the edges between triangles
    hits, _, _ = solid.ray.intersects_location([[x, y, -1.0]], [[0.0, 0.0, 1.0]])
    return float(hits[:, 2].min())
