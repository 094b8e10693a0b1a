"""A kit's folder: its parts as files, what later commands know it by, and the sheet."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.io.mesh_files import write_mesh
from tumortrack_experiment.kit.design import Design
from tumortrack_experiment.kit.sheet import write_sheet
from tumortrack_experiment.kit.split import laid_mesh
from tumortrack_experiment.kit.values import PrintedPart
from tumortrack_experiment.kit_file import KIT_FILE, Bead, Kit, KitPart, Rows

KIND = "kit"
_APART_MM = 10.0  # between parts in the 3MF file


def write_kit(design: Design, folder: Path, case_sha256: str, whose: str = "") -> None:
    """Its files, sealed, into an empty folder: meshes lie as they are printed. ``whose``: names the
    case on the sheet."""
    for part in design.parts:
        write_mesh(folder / f"{part.name}.stl", laid_mesh(part))
    (folder / "kit.3mf").write_bytes(_three_mf(design.parts))
    kit = kit_of(design, case_sha256)
    store.write_json(folder / KIT_FILE, to_builtins(kit))
    store.write_json(folder / "checks.json", {"checks": list(map(to_builtins, design.checks))})
    write_sheet(design, kit, folder / "sheet.html", whose)
    content = {
        "case_sha256": case_sha256, "states": list(kit.states), "parts": len(kit.parts),
        "beads": f"{len(kit.beads)} of {kit.bead_diameter_mm:g} mm",
        "config": {"base": to_builtins(design.base_config), "mix": to_builtins(design.mix)},
    }  # fmt: skip
    store.seal(folder, KIND, content, frame="base")


def kit_of(design: Design, case_sha256: str) -> Kit:
    """What every later command knows a kit by."""
    beads = enumerate(design.base.beads_mm.round(4).tolist(), 1)
    parts = [
        KitPart(
            name=part.name, file=f"{part.name}.stl", purpose=part.purpose, state=part.state,
            volume_ml=round(part.mesh.volume_mm3 / 1000, 3),
            base_from_part=_rows(np.linalg.inv(part.print_from_frame))
            if part.frame == "base" else None,
        )
        for part in design.parts
    ]  # fmt: skip
    return Kit(
        case_sha256=case_sha256,
        bead_diameter_mm=design.base_config.bead_mm,
        beads=tuple(Bead(name=str(n), center_mm=(x, y, z)) for n, (x, y, z) in beads),
        base_from_ct=_rows(design.base.base_from_ct),
        organ_ml=design.molds[0].cast_ml,
        tumors_ml=tuple(mold.cast_ml for mold in design.molds[1:]),
        states=("rest", *design.base_config.states),
        parts=tuple(parts),
    )


def _rows(b_from_a: np.ndarray) -> Rows:
    a, b, c, d = (tuple(row) for row in b_from_a.tolist())
    return a, b, c, d


def _three_mf(parts: tuple[PrintedPart, ...]) -> bytes:
    """All parts beside each other, as they are printed; mm."""
    import trimesh

    scene, x = trimesh.Scene(), 0.0
    for part in parts:
        mesh = laid_mesh(part)
        solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
        solid.apply_translation([x - mesh.box_mm[0, 0], -mesh.box_mm[0, 1], 0])
        x += float(np.ptp(mesh.box_mm, axis=0)[0]) + _APART_MM
        scene.add_geometry(solid, node_name=part.name, geom_name=part.name)
    scene.units = "mm"
    buffer = io.BytesIO()
    scene.export(buffer, file_type="3mf")
    return buffer.getvalue()
