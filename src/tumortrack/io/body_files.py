"""Bodies for simulators: VTK's legacy files and USD's text, written and never read. As text, since
SOFA's MeshVTKLoader swaps the bytes of a binary file's nodes, but not those of its data; in USD
with the schemas proposed for deformable bodies, which newton reads, and in metres, which it needs.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped

from tumortrack.core import store
from tumortrack.core.colours import Colour
from tumortrack.core.types import Mesh

_TETRAHEDRON = 10  # VTK's number of that kind of cell
_LONGEST = 255  # characters of a title in VTK


@dataclass(frozen=True, eq=False)
class Cells:
    """Triangles, or tetrahedra of positive volume; values by name of each, and vectors of nodes."""

    nodes_mm: Float[np.ndarray, "n 3"]
    nodes: Int[np.ndarray, "c k"]
    of_cells: Mapping[str, Shaped[np.ndarray, " c"]] = field(default_factory=dict)
    of_nodes: Mapping[str, Float[np.ndarray, "n 3"]] = field(default_factory=dict)


def write_vtk(path: Path, title: str, cells: Cells) -> None:
    """Write an unstructured grid, of triangles polygons. Raises StorageError: the disk refused."""
    count, corners = cells.nodes.shape
    listed = np.column_stack([np.full(count, corners), cells.nodes])
    flat = corners == 3
    dataset, kind = ("POLYDATA", "POLYGONS") if flat else ("UNSTRUCTURED_GRID", "CELLS")
    text = [
        f"# vtk DataFile Version 3.0\n{' '.join(title.split())[:_LONGEST]}\nASCII\n",
        f"DATASET {dataset}\nPOINTS {len(cells.nodes_mm)} float\n",
        *(_rows(cells.nodes_mm), f"{kind} {count} {listed.size}\n", _rows(listed)),
        *([] if flat else [f"CELL_TYPES {count}\n", f"{_TETRAHEDRON}\n" * count]),
    ]
    text += [f"CELL_DATA {count}\n"] * bool(cells.of_cells)
    for name, values in cells.of_cells.items():
        kind = "int" if values.dtype.kind in "iu" else "float"
        text += [f"SCALARS {name} {kind} 1\nLOOKUP_TABLE default\n", _rows(values[:, None])]
    text += [f"POINT_DATA {len(cells.nodes_mm)}\n"] * bool(cells.of_nodes)
    for name, values in cells.of_nodes.items():
        text += [f"VECTORS {name} float\n", _rows(values)]
    store.write_atomically(path, "".join(text).encode("ascii", "replace"))


def write_usd(
    path: Path,
    title: str,
    cells: Cells,
    rest_mm: Float[np.ndarray, "n 3"],
    tissue: Mapping[str, float],
    surfaces: Mapping[str, tuple[Mesh, Colour]],
) -> None:
    """Write a stage (.usda): tetrahedra /World/Body, with their nodes at rest and the tissue of all
    of them (by the schema's names, SI), and /World/NAME of each surface. Raises StorageError."""
    material = "".join(f"        float physics:{name} = {x:.7g}\n" for name, x in tissue.items())
    values = "".join(
        _usd("int" if of.dtype.kind in "iu" else "float", f"primvars:{name}", of, "uniform")
        for name, of in cells.of_cells.items()
    )
    for name, of in cells.of_nodes.items():
        values += _usd("vector3f", f"primvars:{name}", of, "vertex")
    shown = "".join(
        f'    def Mesh "{name}"\n    {{\n        uniform token subdivisionScheme = "none"\n'
        + _points(mesh.vertices_mm)
        + _usd("int", "faceVertexCounts", np.full(len(mesh.faces), 3))
        + _usd("int", "faceVertexIndices", mesh.faces.ravel())
        + _usd("color3f", "primvars:displayColor", np.array([colour]) / 255)
        + "    }\n"
        for name, (mesh, colour) in surfaces.items()
    )
    text = f"""#usda 1.0
(
    defaultPrim = "World"
    doc = {json.dumps(title, ensure_ascii=False)}
    kilogramsPerUnit = 1
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{{
    double3 xformOp:scale = (0.001, 0.001, 0.001)
    uniform token[] xformOpOrder = ["xformOp:scale"]
    def Material "Tissue" (prepend apiSchemas = ["PhysicsVolumeDeformableMaterialAPI"])
    {{
{material}    }}
    def TetMesh "Body" (prepend apiSchemas = ["PhysicsDeformableBodyAPI", \
"PhysicsVolumeDeformableSimAPI", "PhysicsCollisionAPI", "MaterialBindingAPI"])
    {{
        rel material:binding:physics = </World/Tissue>
        uniform token purpose = "guide"
{_points(cells.nodes_mm)}{_usd("int4", "tetVertexIndices", cells.nodes)}\
{_usd("point3f", "physics:restShapePoints", rest_mm)}{values}    }}
{shown}}}
"""
    store.write_atomically(path, text.encode())


def _points(points_mm: np.ndarray) -> str:
    box_mm = np.stack([points_mm.min(0), points_mm.max(0)])
    return _usd("float3", "extent", box_mm) + _usd("point3f", "points", points_mm)


def _usd(kind: str, name: str, values: np.ndarray, interpolation: str = "") -> str:
    """An attribute: numbers, or a tuple of each row."""
    if values.ndim == 1:
        listed = _rows(values[:, None], end=", ")[:-2]
    else:
        listed = f"({_rows(values, ', ', '), (')[:-3]}"
    how = f' (interpolation = "{interpolation}")' if interpolation else ""
    return f"        {kind}[] {name} = [{listed}]{how}\n"


def _rows(rows: Shaped[np.ndarray, "n k"], between: str = " ", end: str = "\n") -> str:
    stream, number = io.StringIO(), "%d" if rows.dtype.kind in "iu" else "%.7g"  # as float32
    np.savetxt(stream, rows, fmt=number, delimiter=between, newline=end)
    return stream.getvalue()
