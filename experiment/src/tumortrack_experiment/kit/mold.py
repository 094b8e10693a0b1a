"""Molds for casting the organ and its tumors: two halves along each one's own parting surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.config import Config
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.sense.render import Visibility
from tumortrack_experiment.kit.casting import Halves, Layout, cut_halves, lay_out
from tumortrack_experiment.kit.mold_checks import (
    area_mm2,
    behind_mm,
    cast_solid,
    demould,
    distance_mm,
    open_edges,
    thin_share,
)
from tumortrack_experiment.kit.parting import undercut
from tumortrack_experiment.kit.pins import Pin, firmness, place_pins
from tumortrack_experiment.kit.split import fits, split_to_bed, to_bed
from tumortrack_experiment.kit.values import PrintedPart

_EDGE_MM = 3.0  # from the parting line and from holes a wall is as thin as its edge


class MoldConfig(Config):
    """Sizes of the molds, mm. ``clearance_mm``: between a key and its hole, on the radius.
    ``largest_undercut_mm``: how far the cast may have to yield when a part is pulled off; soft
    casts yield, and 4 mm is our choice. ``bed_mm``: the printer's; larger parts are split."""

    wall_mm: float = 5.0
    clearance_mm: float = 0.25
    largest_undercut_mm: float = 4.0
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
    """The printed parts, how they come off, and what was measured on them.

    The mold stands on its lower half when it is filled: ``pull_ct``, the way in which the upper
    half comes off, is up. ``parting_ct``: the loop where the parting surface meets the organ.
    ``undercut_mm2``, its share of the organ's surface: what neither pull lays open.
    ``undercut_depth_mm``: how far the cast must yield. ``checks``: numbers by name with their unit.
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
    pins: tuple[Pin, ...]  # in the ct frame
    checks: tuple[tuple[str, float], ...]


def organ_mold(anatomy: Anatomy, config: MoldConfig) -> OrganMold:
    """The organ's mold with a sprue, vents, keys, bolt holes and the holes for the tumors' pins.

    Raises:
        InputError: a surface that is not closed, or a tumor that no three pins reach.
    """
    layout = lay_out(anatomy.organ, config.wall_mm, config.sprue_mm)
    tumors = [
        tumor.moved(transform_points(layout.mold_from_ct, tumor.vertices_mm))
        for tumor in anatomy.tumors
    ]
    pins = place_pins(layout, tumors, config.pin_mm)
    ct_from_mold = np.linalg.inv(layout.mold_from_ct)
    return _mold(layout, config, "organ", tuple(pin.moved(ct_from_mold) for pin in pins))


def tumor_molds(
    anatomy: Anatomy, config: MoldConfig, pins: tuple[Pin, ...]
) -> tuple[OrganMold, ...]:
    """A mold of two halves for each tumor, with holes for the same pins (``OrganMold.pins``), which
    leave in the cast tumor the holes by which they hold it in the organ's mold."""
    molds = []
    for number, tumor in enumerate(anatomy.tumors, 1):
        its = tuple(pin for pin in pins if pin.tumor == number)
        ways = np.array([pin.way for pin in its]).reshape(-1, 3)
        layout = lay_out(tumor, config.wall_mm, config.sprue_mm, ways if len(ways) else None)
        molds.append(_mold(layout, config, f"tumor_{number}", its))
    return tuple(molds)


def _mold(layout: Layout, config: MoldConfig, name: str, pins: tuple[Pin, ...]) -> OrganMold:
    """Cut the halves, measure them, and turn them back to the ``ct`` frame."""
    inside = [pin.moved(layout.mold_from_ct) for pin in pins]
    reach = 20.0 + 2 * layout.mesh.longest_mm
    ways = [(pin.tip_mm, pin.mouth_mm + reach * pin.way) for pin in inside]
    halves = cut_halves(layout, config.vent_mm, config.pin_mm, config.clearance_mm, ways)
    solid = solid_of(layout.mesh, name)
    parts, checks, depth = [], [], 0.0
    for side, part, way in (("upper", halves.upper, 1.0), ("lower", halves.lower, -1.0)):
        pull = np.array([0.0, 0.0, way])
        off = demould(part, solid, layout.mesh, pull)
        depth = max(depth, off.depth_mm)
        mesh = mesh_of(part)
        own = (*_measured(mesh, layout), ("yields_mm", off.depth_mm))
        own += (("yields_mm3", off.volume_mm3),)
        parts += _printed(layout, mesh, f"{name}_{side}", config, own, way)
    cast, other = cast_solid(halves.block, [halves.upper, halves.lower], halves.channels, solid)
    area = area_mm2(layout.mesh)
    hidden = area[undercut(layout.mesh, np.array([0, 0, 1.0]), Visibility(layout.mesh))].sum()
    checks = _summary(layout, halves, solid, cast, other)
    back = np.linalg.inv(layout.mold_from_ct)
    return OrganMold(
        tuple(parts), back[:3, 2].copy(), transform_points(back, layout.parting_mm),
        float(hidden), float(hidden / area.sum()), depth, cast / 1000,
        transform_points(back, layout.sprue_mm[None])[0],
        transform_points(back, layout.vents_mm), pins, (*checks, *_held(pins)),
    )  # fmt: skip


def _measured(mesh: Mesh, layout: Layout) -> tuple[tuple[str, float], ...]:
    """Closed, walls, plastic."""
    points, deep = behind_mm(mesh)
    at_cavity = distance_mm(points, layout.mesh) < 0.05
    holes = [layout.sprue_mm, *layout.vents_mm]
    edge = layout.field.at(points[:, :2])
    clear = np.abs(points[:, 2] - edge) > _EDGE_MM
    for hole in holes:
        clear &= np.linalg.norm(points[:, :2] - hole[:2], axis=1) > 3 * layout.sprue_radius_mm
    return (
        ("open_edges", float(open_edges(mesh))),
        ("least_wall_mm", float(deep[at_cavity & clear].min(initial=np.inf))),
        ("thin_share", thin_share(deep)),
        ("plastic_ml", mesh.volume_mm3 / 1000),
    )


def _printed(
    layout: Layout, mesh: Mesh, name: str, config: MoldConfig, checks: Any, way: float
) -> list[PrintedPart]:
    """As it is printed: on its flat outside, the parting surface up, in pieces if need be."""
    back = np.linalg.inv(layout.mold_from_ct)
    turn = np.diag([1.0, -way, -way])
    on_bed = to_bed(mesh.vertices_mm, turn)
    purpose = f"{name.replace('_', ' ')} half of the mold"
    part = PrintedPart(
        name, purpose, mesh.moved(transform_points(back, mesh.vertices_mm)), "ct",
        on_bed @ layout.mold_from_ct, "", tuple(checks),
    )  # fmt: skip
    pieces = split_to_bed(part, config.bed_mm, config.clearance_mm)
    return [replace(p, checks=(*p.checks, ("fits_bed", float(_fits(p, config))))) for p in pieces]


def _fits(part: PrintedPart, config: MoldConfig) -> bool:
    laid = part.mesh.moved(transform_points(part.print_from_frame, part.mesh.vertices_mm))
    return fits(laid, config.bed_mm)


def _summary(
    layout: Layout, halves: Halves, organ: Any, cast: float, other: float
) -> tuple[tuple[str, float], ...]:
    field = layout.field
    near = layout.beyond_wall(field.nodes()) < 0
    steps = np.hypot(*np.gradient(field.heights_mm, field.step_mm))
    volume = float(organ.volume())
    return (
        ("cast_error_percent", 100 * (cast / volume - 1)),
        ("cast_differs_mm", other / area_mm2(layout.mesh).sum()),
        ("halves_overlap_mm3", float((halves.upper ^ halves.lower).volume())),
        ("steepest_parting_deg", float(np.degrees(np.arctan(np.percentile(steps[near], 99))))),
        ("keys", float(halves.keys)),
        ("bolts", float(halves.bolts)),
        ("vents", float(len(layout.vents_mm))),
    )


def _held(pins: tuple[Pin, ...]) -> tuple[tuple[str, float], ...]:
    """How firmly each tumor's pins hold it."""
    return tuple(
        (f"firmness_{number}", firmness(np.array([p.way for p in pins if p.tumor == number])))
        for number in sorted({pin.tumor for pin in pins})
    )
