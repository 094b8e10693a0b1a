"""The sheet that lies beside the work: one HTML file, for A4, that needs no network."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from tumortrack.core.geometry import rigid, rotation_onto, transform_points, unit
from tumortrack.core.solids import mesh_of
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Mesh
from tumortrack.report.renderer import Body, Viewpoint, render
from tumortrack_experiment.kit import recipe
from tumortrack_experiment.kit.casting import THICK_MM, rod
from tumortrack_experiment.kit.solids import ball
from tumortrack_experiment.kit_file import Kit

if TYPE_CHECKING:
    from tumortrack_experiment.kit.design import Design
    from tumortrack_experiment.kit.mold import OrganMold

_PLASTIC, _STAND, _GEL = (0.80, 0.82, 0.84), (0.45, 0.63, 0.80), (0.85, 0.55, 0.48)
_TUMOR, _BEAD, _PIN = (0.95, 0.80, 0.25), (0.15, 0.25, 0.75), (0.35, 0.35, 0.35)


def bench_picture(design: Design, state: str = "", lifted_mm: float = 0.0) -> np.ndarray:
    """Base, beads and organ, and what imposes a state, lifted by some mm; (h, w, 3)."""
    base, radius = design.base, design.base_config.bead_mm / 2
    organ, *tumors = base.anatomy.parts
    bodies = [Body(base.parts[0].mesh, _PLASTIC), Body(organ, _GEL, 0.75)]
    bodies += [Body(tumor, _TUMOR) for tumor in tumors]
    bodies += [Body(mesh_of(ball(bead, radius)), _BEAD) for bead in base.beads_mm]
    for part in base.parts[1:]:
        if part.state == state:
            up = lifted_mm * (2 * part.name.startswith("rod") + (part.mesh.box_mm[1, 2] > 9))
            way = rigid(np.eye(3), np.array([0, 0, up]))
            bodies.append(Body(part.mesh, _STAND, world_from_mesh=way))
    return _picture(bodies, np.array([0.55, -1.0, 0.85]))


def mold_picture(mold: OrganMold, cast: Sequence[Mesh]) -> np.ndarray:
    """A mold opened along its pull, the cast (organ and tumors, CT frame) and pins between."""
    turn = rigid(rotation_onto(mold.pull_ct, np.array([0.0, 0.0, 1.0])), np.zeros(3))
    apart = 0.75 * float(np.ptp(cast[0].vertices_mm @ mold.pull_ct)) + 15
    bodies = []
    for part in mold.parts:
        side = apart if "_upper" in part.name else -apart
        moved = turn @ rigid(np.eye(3), side * mold.pull_ct)
        bodies.append(Body(part.mesh, _PLASTIC, world_from_mesh=moved))
    organ, *tumors = cast
    bodies.append(Body(organ, _GEL if tumors else _TUMOR, 0.6 if tumors else 1.0, turn))
    bodies += [Body(tumor, _TUMOR, world_from_mesh=turn) for tumor in tumors]
    for pin in mold.pins:
        stick = rod(pin.tip_mm, pin.tip_mm + pin.length_mm * pin.way, pin.diameter_mm / 2)
        bodies.append(Body(mesh_of(stick), _PIN, world_from_mesh=turn))
    return _picture(bodies, np.array([0.7, -1.0, 0.35]))


def write_sheet(design: Design, kit: Kit, path: Path, whose: str = "") -> None:
    """Pictures, steps and tables, atomically; ``whose``: the case's name. Raises StorageError: the
    disk refused."""
    made = recipe.batches(design.mix, kit.organ_ml, kit.tumors_ml)
    plastic, pins = sum(part.volume_ml for part in kit.parts), design.molds[0].pins
    organ, *tumors = design.anatomy_ct.parts
    casts = [(organ, *tumors), *((tumor,) for tumor in tumors)]
    names = ["the organ: tumors sit on pins", *(f"tumor {n + 1}" for n in range(len(tumors)))]
    (across, high), mix = recipe.COUPON_MM, design.mix
    shown = [s for s in kit.states if any(part.state == s for part in design.base.parts)]
    rows = [
        f"<tr class={c.verdict}><td>" + "<td>".join(
            (c.where, c.what, c.number, c.limits, c.verdict)) + "</tr>"
        for c in design.checks
    ]  # fmt: skip
    texts = {
        "CASE": html.escape(whose or kit.case_sha256[:12]), "DIGEST": kit.case_sha256[:12],
        "BOLTS": f"{sum(dict(mold.checks)['bolts'] for mold in design.molds):.0f}",
        "BOLT": f"{2 * THICK_MM:g}",
        "ORGAN": f"{kit.organ_ml:.1f}",
        "TUMORS": ", ".join(f"{ml:.1f}" for ml in kit.tumors_ml),
        "STATES": ", ".join(kit.states),
        "BENCH": _figure(bench_picture(design), "At rest: base, cradle, organ, beads"),
        "PARTS": _table("file, what for, state, ml", (
            (p.file, p.purpose, p.state, f"{p.volume_ml:.1f}") for p in kit.parts)),
        "BATCHES": _table("batch, ml, water g, PVA g, BaSO4 g, or silicone g", (
            (b.name, f"{b.ml:.0f}", f"{b.water_g:.0f}", f"{b.pva_g:.1f}", f"{b.baso4_g:.2f}",
             f"{b.silicone_g:.0f}") for b in made)),
        "PVA": f"{mix.pva_percent:g}", "BASO4": f"{mix.baso4_percent:g}",
        "SPARE": f"{100 * mix.spare:.0f}", "COUPONS": str(recipe.COUPONS),
        "MOLDS": "".join(
            _figure(mold_picture(mold, cast), f"Mold of {name}")
            for mold, cast, name in zip(design.molds, casts, names, strict=True)),
        "CYCLES": str(mix.cycles), "DAYS": str(mix.cycles),
        "PINS": _table(
            "pin for, diameter mm, cut to mm, mark for the tumor's mold mm, for the organ's mm", (
                (f"tumor {p.tumor}", f"{p.diameter_mm:g}", f"{max(p.length_mm, own.length_mm):.0f}",
                 f"{own.depth_mm:.1f}", f"{p.depth_mm:.1f}")
                for p, own in zip(pins, (o for m in design.molds[1:] for o in m.pins), strict=True)
            )),
        "SHOWN": "".join(
            _figure(bench_picture(design, s, 25.0), f"State {s}; what stands in sockets is lifted")
            for s in shown),
        "ACROSS": f"{across:g}", "HIGH": f"{high:g}", "AREA": f"{np.pi / 4 * across**2:.0f}",
        "SQUAT": f"{1 + 2 * (across / high / 4) ** 2:.2f}",
        "BEADS": _table("bead, x, y, z", (
            (b.name, *(f"{x:.2f}" for x in b.center_mm)) for b in kit.beads)),
        "CHECKS": "<table><tr><th>of<th>what<th>value<th>limits<th>verdict</tr>"
        + "".join(rows) + "</table>",
        "PVA_G": f"{sum(b.pva_g for b in made):.0f}", "BEAD": f"{kit.bead_diameter_mm:g}",
        "BASO4_G": f"{made[1].baso4_g:.1f}", "N": str(len(kit.beads)), "RODS": str(len(pins)),
        "WATER": f"{sum(b.water_g for b in made) / 1000:.2f}", "SCANS": str(len(kit.states)),
        "PLASTIC": f"{1.27 * plastic / 1000:.2f}", "HOURS": f"{plastic / 24:.0f}",
    }  # fmt: skip
    page = resources.files("tumortrack_experiment.kit").joinpath("sheet.html").read_text("utf-8")
    for name, text in texts.items():
        page = page.replace(f"@{name}@", text)
    write_atomically(path, page.encode())


def _picture(bodies: list[Body], towards: np.ndarray) -> np.ndarray:
    """From that side, in parallel, cropped to what is there."""
    points = np.concatenate([
        body.mesh.vertices_mm if body.world_from_mesh is None
        else transform_points(body.world_from_mesh, body.mesh.vertices_mm) for body in bodies
    ])  # fmt: skip
    middle = points.mean(0)
    place = middle + 1000 * unit(towards)
    axes = Viewpoint.towards(middle, place, 1.0).axes
    width = 2.04 * float(np.abs((points - middle) @ axes[:2].T).max())
    image = render(bodies, Viewpoint.towards(middle, place, width, parallel=True), (720, 720))
    drawn = [np.flatnonzero((image < 255).any((2, axis))) for axis in (1, 0)]
    return image[drawn[0][0] : drawn[0][-1] + 1, drawn[1][0] : drawn[1][-1] + 1]


def _figure(picture: np.ndarray, text: str) -> str:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "WEBP", quality=85)
    data = f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"
    return f"<figure><img alt='' src='{data}'><figcaption>{text}</figcaption></figure>"


def _table(head: str, rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{name}" for name in head.split(", "))
    cells = ("".join(f"<td>{html.escape(cell)}" for cell in row) for row in rows)
    return f"<table><tr>{top}</tr>" + "".join(f"<tr>{row}</tr>" for row in cells) + "</table>"
