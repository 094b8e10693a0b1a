"""Simulators' own readers in a process of their own (`clients.py`); what they find, as JSON.

simulator_peer.py vtk FILE...    of legacy files VTK (that of 3D Slicer's core): a line for each
simulator_peer.py usd FILE       of a stage usd-core
simulator_peer.py newton FILE    newton loads a stage's body, holds a third of it, and lets it hang
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

STEPS, STEP_S, GRAVITY = 100, 1 / 600, 9.81
ITERATIONS = 20  # of a step; with 5 a body sags five times as far


def vtk(path: str) -> dict[str, Any]:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersVerdict import vtkMeshQuality
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader

    reader = vtkGenericDataObjectReader()
    reader.SetFileName(path)
    reader.ReadAllScalarsOn()
    reader.ReadAllVectorsOn()
    reader.Update()
    grid, quality = reader.GetOutput(), vtkMeshQuality()
    quality.SetInputData(grid)
    quality.SetTetQualityMeasureToMinAngle()
    quality.Update()
    angles = quality.GetOutput().GetFieldData().GetArray("Mesh Tetrahedron Quality")

    cells = grid.GetPolys() if grid.IsA("vtkPolyData") else grid.GetCells()

    def arrays(data: Any) -> dict[str, Any]:
        found = (data.GetArray(n) for n in range(data.GetNumberOfArrays()))
        return {array.GetName(): vtk_to_numpy(array).tolist() for array in found}

    return {
        "title": reader.GetHeader(),
        "types": sorted({grid.GetCellType(n) for n in range(grid.GetNumberOfCells())}),
        "nodes": vtk_to_numpy(grid.GetPoints().GetData()).tolist(),
        "cells": vtk_to_numpy(cells.GetConnectivityArray()).tolist(),
        "of_cells": arrays(grid.GetCellData()),
        "of_nodes": arrays(grid.GetPointData()),
        "least_degrees": angles.GetTuple(0)[0],
    }


def usd(path: str) -> dict[str, Any]:
    """``said``: what it printed, and what its validators found."""
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    with printed() as said:
        stage = Usd.Stage.Open(path)
        body = UsdGeom.TetMesh(stage.GetPrimAtPath("/World/Body"))
        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        errors = UsdValidation.ValidationContext(validators).Validate(stage)
        world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(body.GetPrim()))
    surface = UsdGeom.TetMesh.ComputeSurfaceFaces(body)
    tissue, _ = UsdShade.MaterialBindingAPI(body.GetPrim()).ComputeBoundMaterial("physics")
    given = [p for p in UsdGeom.PrimvarsAPI(body).GetPrimvars() if p.HasValue()]
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    return {
        "said": [*said, *(error.GetMessage() for error in errors)],
        "validators": len(validators),
        "about": stage.GetRootLayer().documentation,
        "metres": UsdGeom.GetStageMetersPerUnit(stage),
        "world": world.tolist(),
        "nodes": np.array(body.GetPointsAttr().Get()).tolist(),
        "cells": np.array(body.GetTetVertexIndicesAttr().Get()).tolist(),
        "inverted": len(UsdGeom.TetMesh.FindInvertedElements(body)),
        "rest": np.array(body.GetPrim().GetAttribute("physics:restShapePoints").Get()).tolist(),
        "surface": np.array(surface).tolist(),
        "tissue": {
            name: tissue.GetPrim().GetAttribute(f"physics:{name}").Get()
            for name in ("youngsModulus", "poissonsRatio", "density")
        },
        "primvars": {
            p.GetPrimvarName(): [p.GetInterpolation(), np.array(p.Get()).tolist()] for p in given
        },
        "surfaces": {
            mesh.GetPrim().GetName(): [
                np.array(mesh.GetPointsAttr().Get()).tolist(),
                np.array(mesh.GetFaceVertexIndicesAttr().Get()).tolist(),
            ]
            for mesh in meshes
        },
    }


def newton(path: str) -> dict[str, Any]:
    """``said``: newton's warnings. Gravity acts along the organ's thinnest axis, and the third
    on top is held; lengths in m."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        import warp
        from newton import ModelBuilder
        from newton.solvers import SolverVBD
        from pxr import Usd, UsdGeom

        warp.config.quiet = True
        stage = Usd.Stage.Open(path)
        primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/Body"))
        points = np.array(UsdGeom.TetMesh(stage.GetPrimAtPath("/World/Body")).GetPointsAttr().Get())
        axis = int(np.argmin(np.ptp(points, axis=0)))
        builder = ModelBuilder(gravity=tuple((-GRAVITY * np.eye(3)[axis]).tolist()))
        builder.add_usd(stage)
        usual, mass = builder.tet_materials[0], sum(builder.particle_mass)
        young = 1000 * np.array(primvars.GetPrimvar("young_modulus_kpa").Get(), float)
        poisson = np.array(primvars.GetPrimvar("poisson_ratio").Get(), float)
        shear = young / (2 * (1 + poisson))
        bulk = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
        rows = np.column_stack([shear, bulk, np.zeros(len(young))])
        builder.tet_materials = [tuple(row) for row in rows.tolist()]
        start = np.array(builder.particle_q)
        height = start[:, axis].max() - start[:, axis]
        held = height < np.ptp(height) / 3
        for n in np.flatnonzero(held).tolist():
            builder.particle_mass[n] = 0.0
        builder.color()
        model = builder.finalize(device="cpu")
        solver = SolverVBD(model, iterations=ITERATIONS, particle_enable_tile_solve=False)
        now, then, control, path_m = model.state(), model.state(), model.control(), []
        for _ in range(STEPS):
            now.clear_forces()
            solver.step(now, then, control, None, STEP_S)
            now, then = then, now
            path_m.append(now.particle_q.numpy().copy())  # shared memory
    tets = np.array(builder.tet_indices).reshape(-1, 4)
    every = np.array(path_m)
    sag = (start - every)[:, :, axis]
    return {
        "said": [
            str(warning.message) for warning in said if "newton" in warning.category.__module__
        ],
        "counts": [builder.particle_count, builder.tet_count],
        "mass_kg": mass,
        "usual": list(usual[:2]),
        "rest_m3": (1 / np.linalg.det(np.array(builder.tet_poses)) / 6).tolist(),
        "finite": bool(np.isfinite(every).all()),
        "held_moved_m": float(np.abs((every - start)[:, held]).max()),
        "sag_m": float(sag.max()),
        "axis": axis,
        "held": np.flatnonzero(held).tolist(),
        "volume_ratios": [
            float(volumes(x, tets).sum() / volumes(start, tets).sum()) for x in every
        ],
        "least_ratio": float((volumes(every[-1], tets) / volumes(start, tets)).min()),
    }


def volumes(nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    corners = nodes[tets].astype(float)
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


@contextmanager
def printed() -> Iterator[list[str]]:
    """The lines that C++ wrote to standard error."""
    lines, kept = list[str](), os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(kept, 2)
            file.seek(0)
            lines += file.read().decode().splitlines()


if __name__ == "__main__":
    kind, *paths = sys.argv[1:]
    for path in paths:
        print(json.dumps({"vtk": vtk, "usd": usd, "newton": newton}[kind](path)), flush=True)
