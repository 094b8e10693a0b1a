"""Molds for casting an organ and its tumors: two halves along each one's own parting surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from tumortrack.core.config import Config
from tumortrack.core.geometry import transform_points, triangles_of
from tumortrack.core.render import Visibility
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy, Mesh
from tumortrack_experiment.kit.casting import Layout, cut_halves, lay_out
from tumortrack_experiment.kit.mold_checks import cast_error, demould, open_edges, walls
from tumortrack_experiment.kit.parting import undercut
from tumortrack_experiment.kit.pins import HANDLE_MM, Pin, firmness, in_own_mold, place_pins
from tumortrack_experiment.kit.split import fits, laid_mesh, split_to_bed, to_bed
from tumortrack_experiment.kit.values import PrintedPart

Checks = tuple[tuple[str, float], ...]


class MoldConfig(Config, frozen=True):
    """Sizes of the molds, mm. ``clearance_mm``: between a key and its hole, on the radius.
    ``largest_undercut_mm``: how far a cast may have to yield when a half is pulled off; our choice:
    hydrogel and silicone stretch by more. ``bed_mm``: the printer's; larger parts are split."""

    wall_mm: float = 5.0
    clearance_mm: float = 0.25
    largest_undercut_mm: float = 5.0
    sprue_mm: float = 10.0
    vent_mm: float = 1.5
    pin_mm: float = 1.5
    bed_mm: tuple[float, float, float] = (220.0, 220.0, 250.0)

    def __post_init__(self) -> None:
        self.check_between(
            "mold", wall_mm=(2.0, 30.0), clearance_mm=(0.0, 1.0), largest_undercut_mm=(0.0, 20.0),
            sprue_mm=(4.0, 30.0), vent_mm=(0.8, 4.0), pin_mm=(0.5, 4.0),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class OrganMold:
    """A mold's printed parts (of an organ or a tumor), how they come off, and their checks.

    It stands on its lower half when it is filled: ``pull_ct``, in which the upper half comes off,
    is up. ``parting_ct``: the loop where the parting surface meets the organ. ``undercut_mm2`` and
    its share of the surface: what no pull lays open. ``undercut_depth_mm``: how far the cast must
    yield. ``sprue_ct``: where it meets the organ. ``checks``: numbers by name with their unit.
    """

    parts: tuple[PrintedPart, ...]
    pull_ct: Float64[np.ndarray, " 3"]
    parting_ct: Float64[np.ndarray, "n 3"]
    undercut_mm2: float
    undercut_share: float
    undercut_depth_mm: float
    cast_ml: float
    sprue_ct: Float64[np.ndarray, " 3"]
    vents_ct: Float64[np.ndarray, "v 3"]
    pins: tuple[Pin, ...]
    checks: Checks


def organ_mold(anatomy: Anatomy, config: MoldConfig) -> OrganMold:
    """The organ's mold with a sprue, vents, keys, bolt holes and the holes for the tumors' pins.

    Raises:
        InputError: an open surface, no place for a sprue, or a tumor that no three pins reach.
    """
    layout = lay_out(anatomy.organ, anatomy.tumors, config.wall_mm, config.sprue_mm)
    way = layout.mold_from_ct
    tumors = [t.with_vertices(transform_points(way, t.vertices_mm)) for t in anatomy.tumors]
    pins = place_pins(layout, tumors, config.pin_mm)
    return _mold(
        layout, config, "organ", tuple(pin.transformed(np.linalg.inv(way)) for pin in pins)
    )


def tumor_molds(
    anatomy: Anatomy, config: MoldConfig, pins: tuple[Pin, ...]
) -> tuple[OrganMold, ...]:
    """A mold of two halves for each tumor, with holes for the same pins (``OrganMold.pins``), which
    leave in the cast tumor the holes by which they hold it in the organ's mold. The pins of these
    molds are those again, each with its mouth on the outside of the tumor's mold."""
    molds = []
    for number, tumor in enumerate(anatomy.tumors, 1):
        own = tuple(pin for pin in pins if pin.tumor == number)
        ways = np.array([pin.way for pin in own])
        layout = lay_out(tumor, (), config.wall_mm, config.sprue_mm, ways)
        there, back = layout.mold_from_ct, np.linalg.inv(layout.mold_from_ct)
        own = tuple(in_own_mold(pin.transformed(there), layout).transformed(back) for pin in own)
        molds.append(_mold(layout, config, f"tumor_{number}", own))
    return tuple(molds)


def _mold(layout: Layout, config: MoldConfig, name: str, pins: tuple[Pin, ...]) -> OrganMold:
    """Cut the halves, measure them, and turn them back to the ``ct`` frame."""
    moved = [pin.transformed(layout.mold_from_ct) for pin in pins]
    ways = [(pin.tip_mm, pin.mouth_mm + HANDLE_MM * pin.way) for pin in moved]
    halves = cut_halves(layout, config.vent_mm, config.pin_mm, config.clearance_mm, ways)
    organ, up = solid_of(layout.mesh, name), np.array([0.0, 0.0, 1.0])
    sides = ("upper", halves.upper, up), ("lower", halves.lower, -up)
    depths = {side: demould(part, organ, layout.mesh, pull) for side, part, pull in sides}
    parts = [
        piece
        for side, solid, pull in sides
        for piece in _printed(
            layout, mesh_of(solid), f"{name}_{side}", pull[2], config, depths[side]
        )
    ]
    cast_mm3, differs_mm3 = cast_error(halves, organ)
    area = np.linalg.norm(triangles_of(layout.mesh.vertices_mm, layout.mesh.faces)[1], axis=1) / 2
    hidden = float(area[undercut(layout.mesh, up, Visibility(layout.mesh))].sum())
    deepest = max(depths.values())
    slope = np.hypot(*np.gradient(layout.field.heights_mm, layout.field.step_mm))
    beside = (layout.beyond(layout.field.nodes()) < 0) & ~layout.cells.inside.any(2)
    checks = {
        "cast_error_percent": 100 * (cast_mm3 / layout.mesh.volume_mm3 - 1),
        "cast_differs_mm": differs_mm3 / area.sum(),
        "halves_overlap_mm3": (halves.upper ^ halves.lower).volume(),
        "undercut_percent": 100 * hidden / area.sum(),
        "undercut_depth_mm": deepest,
        "undercut_within_limit": deepest <= config.largest_undercut_mm,
        "steep_parting_deg": np.degrees(np.arctan(np.percentile(slope[beside], 95))),
        "sprue_below_top_mm": layout.mesh.box_mm[1, 2] - layout.sprue_mm[2],
        "keys": halves.keys, "bolts": halves.bolts, "vents": len(layout.vents_mm),
        "pins_through_bottom": sum(pin.mouth_mm[2] < layout.bottom_mm + 1 for pin in moved),
    }  # fmt: skip
    for number in sorted({pin.tumor for pin in pins}):
        held = np.array([pin.way for pin in pins if pin.tumor == number])
        checks[f"tumor_{number}_firmness"] = firmness(held)
    ct_from_mold = np.linalg.inv(layout.mold_from_ct)
    sprue, *vents = transform_points(ct_from_mold, np.vstack([layout.sprue_mm, layout.vents_mm]))
    return OrganMold(
        tuple(parts), ct_from_mold[:3, 2], transform_points(ct_from_mold, layout.parting_mm),
        hidden, float(hidden / area.sum()), deepest, cast_mm3 / 1000, sprue,
        np.array(vents).reshape(-1, 3), pins, tuple((k, float(v)) for k, v in checks.items()),
    )  # fmt: skip


def _printed(
    layout: Layout, mesh: Mesh, name: str, up: float, config: MoldConfig, depth_mm: float
) -> list[PrintedPart]:
    """As it is printed: on its flat outside, the parting surface up, in pieces if need be."""
    wall_mm, thin = walls(mesh, layout)
    whole: Checks = (
        ("least_wall_mm", wall_mm), ("thin_percent", 100 * thin), ("yields_mm", depth_mm),
    )  # fmt: skip
    on_bed = to_bed(mesh.vertices_mm, np.diag([1.0, -up, -up])) @ layout.mold_from_ct
    own = mesh.with_vertices(transform_points(np.linalg.inv(layout.mold_from_ct), mesh.vertices_mm))
    purpose = f"{name.replace('_', ' ')} half of the mold"
    pieces = split_to_bed(
        PrintedPart(name, purpose, own, "ct", on_bed), config.bed_mm, config.clearance_mm
    )
    return [
        replace(piece, checks=(
            ("open_edges", float(open_edges(laid_mesh(piece)))), *whole,
            ("plastic_ml", piece.mesh.volume_mm3 / 1000),
            ("fits_bed", float(fits(piece, config.bed_mm))),
        ))
        for piece in pieces
    ]  # fmt: skip
