"""The sheet that lies beside the work: one HTML file, for A4, that needs no network."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from tumortrack.core.geometry import rigid, rotation_onto, transform_points, unit
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Mesh
from tumortrack.imaging.meshes import mesh_of
from tumortrack.report.renderer import Body, Viewpoint, render
from tumortrack_experiment.kit import recipe
from tumortrack_experiment.kit.solids import ball, rod
from tumortrack_experiment.kit_file import Kit

if TYPE_CHECKING:
    from tumortrack_experiment.kit.design import Design
    from tumortrack_experiment.kit.mold import OrganMold

_PLASTIC, _STAND, _GEL, _TUMOR, _BEAD, _PIN = (
    (0.80, 0.82, 0.84), (0.45, 0.63, 0.80), (0.85, 0.55, 0.48), (0.95, 0.80, 0.25),
    (0.15, 0.25, 0.75), (0.35, 0.35, 0.35),
)  # fmt: skip
_SIZE = (900, 640)
_STYLE = """
@page{size:A4;margin:14mm}body{font:14px/1.45 sans-serif;max-width:186mm;margin:1em auto;color:#111}
h1{font-size:22px}h2{font-size:17px;margin:1.4em 0 .4em;break-after:avoid}img{width:100%}
table{border-collapse:collapse;width:100%;font-size:12px}th,td{border-bottom:1px solid #ccc;
padding:2px 6px;text-align:left;vertical-align:top}tr,figure{break-inside:avoid}
figure{margin:.4em 0}figcaption{font-size:12px;color:#444}.pair{display:grid;
grid-template-columns:1fr 1fr;gap:8px}.look{background:#fff3cd}.FAILS{background:#f8d7da;
font-weight:bold}.num{text-align:right;white-space:nowrap}
"""


def bench_picture(design: Design, state: str = "", lifted_mm: float = 0.0) -> np.ndarray:
    """Base, beads and organ, and what imposes a state, lifted off by some mm; (h, w, 3)."""
    base = design.base
    bodies = [Body(base.parts[0].mesh, _PLASTIC)]
    organ, *tumors = base.anatomy.parts
    bodies += [Body(organ, _GEL, 0.75), *(Body(tumor, _TUMOR) for tumor in tumors)]
    radius = design.base_config.bead_mm / 2
    bodies += [Body(mesh_of(ball(tuple(b), radius)), _BEAD) for b in base.beads_mm.tolist()]
    for part in base.parts[1:]:
        if state and part.state == state:
            high = lifted_mm * (2 if part.name.startswith("rod") else 1)
            bodies.append(
                Body(part.mesh, _STAND, world_from_mesh=rigid(np.eye(3), np.array([0, 0, high])))
            )
    return _picture(bodies, np.array([0.55, -1.0, 0.85]))


def mold_picture(mold: OrganMold, cast: Sequence[Mesh], apart: float = 0.75) -> np.ndarray:
    """A mold opened along its pull, the cast (organ and tumors, CT frame) and pins between."""
    up = mold.pull_ct
    turn = rigid(rotation_onto(up, np.array([0.0, 0.0, 1.0])), np.zeros(3))
    high = float(np.ptp(cast[0].vertices_mm @ up)) * apart + 15
    bodies = []
    for part in mold.parts:
        side = 1 if "_upper" in part.name else -1
        moved = turn @ rigid(np.eye(3), side * high * up)
        bodies.append(Body(part.mesh, _PLASTIC, world_from_mesh=moved))
    organ, *tumors = cast
    bodies.append(Body(organ, _GEL if tumors else _TUMOR, 0.6 if tumors else 1, turn))
    bodies += [Body(tumor, _TUMOR, world_from_mesh=turn) for tumor in tumors]
    for pin in mold.pins:
        stick = mesh_of(rod(pin.tip_mm, pin.tip_mm + pin.length_mm * pin.way, pin.diameter_mm / 2))
        bodies.append(Body(stick, _PIN, world_from_mesh=turn))
    return _picture(bodies, np.array([0.7, -1.0, 0.35]))


def write_sheet(design: Design, kit: Kit, path: Path) -> None:
    """Pictures, steps and tables, atomically. Raises StorageError: the disk refused."""
    write_atomically(path, "".join(_page(design, kit)).encode())


def _page(design: Design, kit: Kit) -> Iterable[str]:
    made = recipe.batches(design.mix, kit.organ_ml, kit.tumors_ml)
    plastic = sum(part.volume_ml for part in kit.parts)
    pins = len(design.molds[0].pins)
    organ, *tumors = design.anatomy_ct.parts
    yield f"<!doctype html><html lang=en><meta charset=utf-8><title>Kit</title><style>{_STYLE}</style>"
    yield f"<h1>Phantom kit of case {kit.case_sha256[:12]}</h1>"
    yield (
        f"<p>Organ with tumors {kit.organ_ml:.1f} ml; tumors "
        + ", ".join(f"{ml:.1f} ml" for ml in kit.tumors_ml)
        + f". States: {', '.join(kit.states)}. Research software, not a medical device.</p>"
    )
    yield _figure(bench_picture(design), "The bench at rest: base, cradle, organ, beads.")
    yield "<h2>1. Print</h2><p>Each file lies as it is printed, without supports; 0.2 mm layers. Ream the beads' cones with a countersink of 90&deg; if they are rough.</p>"
    rows = [(p.file, p.purpose, p.state, f"{p.volume_ml:.1f}") for p in kit.parts]
    yield _table(("file", "what for", "state", "ml"), rows)
    yield "<h2>2. Mix</h2>"
    cells = [
        (b.name, f"{b.ml:.0f}", f"{b.water_g:.0f}", f"{b.pva_g:.1f}", f"{b.baso4_g:.2f}",
         f"{b.silicone_g:.0f}") for b in made
    ]  # fmt: skip
    yield _table(("batch", "ml", "water g", "PVA g", "BaSO4 g", "or silicone g"), cells)
    yield (
        f"<p>{design.mix.pva_percent:g} % PVA and {design.mix.baso4_percent:g} % BaSO4 by weight "
        f"(the paper's), {100 * design.mix.spare:.0f} % spare (our choice), {recipe.COUPONS} coupons "
        "of each batch included. Stir PVA into cold water, heat to 90&deg;C until it is clear, "
        "let it cool to 40&deg;C under a film, degas. Stir BaSO4 in as a paste with a little water; "
        "it settles: stir again right before pouring.</p>"
    )
    yield _table(("material", "Young's modulus", "source"), recipe.STIFFNESS, raw=True)
    yield "<h2>3. Cast</h2><div class=pair>"
    yield _figure(
        mold_picture(design.molds[0], (organ, *tumors)), "Organ mold, opened: tumors on their pins."
    )
    for number, (mold, tumor) in enumerate(zip(design.molds[1:], tumors, strict=True), 1):
        yield _figure(mold_picture(mold, (tumor,)), f"Mold of tumor {number}, opened.")
    yield "</div>" + _list(
        "Grease the molds thinly. Push the pins through the tumor molds' holes, bolt, pour, freeze "
        "at -20&deg;C for 16 h, thaw for 8 h; fill the K and T coupons from the same batches.",
        "Draw the pins a little, open the tumor molds, and set each tumor on its pins in the "
        "organ's lower half, as deep as they were.",
        "Close, bolt, seal the seam with grease, pour slowly through the sprue until every vent "
        "runs over.",
        f"{design.mix.cycles} cycles of 16 h at -20&deg;C and 8 h at room temperature (our choice "
        "of hours). Draw the pins; open along the pull. Keep the phantom under water.",
    )
    if pins:
        lengths = [
            (f"tumor {p.tumor}", f"{p.diameter_mm:g}", f"{p.length_mm:.0f}")
            for p in design.molds[0].pins
        ]
        yield _table(("pin for", "diameter mm", "cut to mm"), lengths)
    yield "<h2>4. Set up</h2>" + _list(
        "Glue a bead into each cone with a drop of cyanoacrylate; it must touch the cone all "
        "round. Numbers beside the posts are the names in kit.json.",
        "Lay the organ into its cradle; letters at the edges are the patient's directions (S "
        "superior, L left, ...), + is the base's x.",
        "Scan coupons beside the base: their HU go with the scan's.",
        "For a state put its stand into the sockets until its legs touch the base, and hold it by "
        "two rubber bands in the notches. Nothing else may be moved between picture and scan.",
    )
    yield "<div class=pair>"
    for state in kit.states[1:]:
        if any(part.state == state for part in design.base.parts):
            yield _figure(
                bench_picture(design, state, 25.0), f"{state}, before it is pressed down."
            )
    yield "</div><h2>5. Coupons</h2>"
    across, high = recipe.COUPON_MM
    squat = across / (4 * high)
    yield (
        f"<p>Cylinders of {across:g} x {high:g} mm (ISO 7743, A). Between greased plates E = F h / "
        f"(A d), with the force F at which the height h has become less by d = 10 % of it, and A = "
        f"{np.pi / 4 * across**2:.0f} mm&sup2;; between rough plates, to which it sticks, divide by 1 + 2 "
        f"S&sup2; = {1 + 2 * squat**2:.2f}, S = diameter / 4 h (Gent and Lindley 1959, doi "
        "10.1243/PIME_PROC_1959_173_022_02).</p>"
    )
    yield "<h2>Beads, base frame</h2>"
    places = [(b.name, *(f"{x:.2f}" for x in b.center_mm)) for b in kit.beads]
    yield _table(("bead", "x mm", "y mm", "z mm"), places)
    yield "<h2>Checks</h2>"
    yield "<table><tr><th>of<th>what<th>value<th>limits<th>verdict</tr>" + "".join(
        f"<tr class={c.verdict}><td>{html.escape(c.where)}<td>{html.escape(c.what)}<td class=num>"
        f"{c.value:.2f} {c.unit}<td>{c.limits}<td>{c.verdict}</tr>" for c in design.checks
    ) + "</table>"  # fmt: skip
    yield "<h2>Shopping</h2><p>Prices are rough estimates of ours, in EUR.</p>"
    bought = recipe.shopping(made, len(kit.beads), kit.bead_diameter_mm, plastic, pins)
    yield _table(("item", "amount", "EUR"), bought)
    yield "<h2>Times</h2>" + _table(("step", "time"), recipe.times(design.mix, plastic))


def _picture(bodies: list[Body], towards: np.ndarray) -> np.ndarray:
    """From that side, in parallel, as large as everything needs."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for body in bodies:
        way = np.eye(4) if body.world_from_mesh is None else body.world_from_mesh
        points = transform_points(way, body.mesh.vertices_mm)
        low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
    middle = (low + high) / 2
    corners = np.stack(np.meshgrid(*zip(low, high)), -1).reshape(-1, 3)
    view = Viewpoint.towards(middle, middle + 1000 * unit(towards), 1.0, parallel=True)
    across, down, _ = np.ptp((corners - middle) @ view.axes.T, axis=0)
    width = 1.05 * max(across, down * _SIZE[0] / _SIZE[1])
    place = middle + 1000 * unit(towards)
    return render(bodies, Viewpoint.towards(middle, place, width, parallel=True), _SIZE)


def _figure(picture: np.ndarray, text: str) -> str:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "WEBP", quality=85)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f"<figure><img alt='' src='data:image/webp;base64,{data}'><figcaption>{text}</figcaption></figure>"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], raw: bool = False) -> str:
    tidy = (lambda text: text) if raw else html.escape
    top = "".join(f"<th>{name}" for name in head)
    body = "".join("<tr>" + "".join(f"<td>{tidy(c)}" for c in row) + "</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{body}</table>"


def _list(*steps: str) -> str:
    return "<ol>" + "".join(f"<li>{step}" for step in steps) + "</ol>"
