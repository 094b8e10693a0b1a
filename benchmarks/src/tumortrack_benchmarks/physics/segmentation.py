"""How the true organ differs from the model's case: errors of the CT's segmentation.

The case is a segmentation; the patient's organ differs. Surfaces keep their triangles, vertices
move along their normals; scenes show the moved surfaces, the model knows the others.
Two readers of one CT agree to a Dice score of 0.98 on kidneys and 0.92 on tumors (Heller et al.
2021, doi 10.1016/j.media.2020.101821): about a millimetre on such surfaces.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates

from tumortrack.core.geometry import rotation_onto, triangles_of
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Anatomy, Mesh

Kind = Literal["none", "voxel", "slices", "reader"]
KINDS: tuple[Kind, ...] = get_args(Kind)
VOXEL_MM = (0.7, 1.5)  # of clinical CT
READER_MM, READER_REACH_MM = 1.0, (8.0, 25.0)  # standard deviation, how far it goes one way
_GRID_MM, _REACH_MM = 1.5, 4.5


def perturbed(
    anatomy: Anatomy, kind: Kind, axis: np.ndarray, rng: np.random.Generator
) -> tuple[Anatomy, dict]:
    """The true anatomy, and the errors. ``axis``: the slices' normal, unit. Tumors and organ have
    independent errors, as they are outlined apart."""
    if kind == "none":
        return anatomy, {"kind": kind}
    if kind == "voxel":
        by_mm = rng.uniform(*VOXEL_MM) * rng.choice([-1.0, 1.0], len(anatomy.parts))
        shifts = [
            np.full(len(p.vertices_mm), mm) for p, mm in zip(anatomy.parts, by_mm, strict=True)
        ]
        about: dict = {"by_mm": by_mm.tolist()}
    elif kind == "slices":
        thick, phase = float(rng.uniform(3.0, 5.0)), float(rng.uniform())
        shifts = [_sliced(part, thick, phase, axis) for part in anatomy.parts]
        about = {"slices_mm": thick}
    else:
        reach = float(rng.uniform(*READER_REACH_MM))
        shifts = [_disagreement(part, reach, rng) for part in anatomy.parts]
        about = {"reach_mm": reach}
    parts = tuple(
        part.with_vertices(part.vertices_mm + shift[:, None] * _vertex_normals(part))
        for part, shift in zip(anatomy.parts, shifts, strict=True)
    )
    rms = [float(np.sqrt((shift**2).mean())) for shift in shifts]
    return anatomy.with_parts(parts), {"kind": kind, **about, "rms_mm": rms}


def _disagreement(mesh: Mesh, reach_mm: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth Gaussian field at the vertices: a sum of plane waves, whose correlation falls as
    exp(-(d / reach)^2 / 2)."""
    waves = rng.normal(0, 1 / reach_mm, (3, 64))
    phases = rng.uniform(0, 2 * np.pi, 64)
    return READER_MM * np.sqrt(2 / 64) * np.cos(mesh.vertices_mm @ waves + phases).sum(1)


def _sliced(mesh: Mesh, thick_mm: float, phase: float, axis: np.ndarray) -> np.ndarray:
    """Each vertex's shift if the shape is known only in slices: each shows the mean over its
    thickness, and the steps between them are smoothed along the slices' normal."""
    turn = rotation_onto(axis, np.array([0.0, 0.0, 1.0]))
    there = mesh.vertices_mm @ turn.T
    low = there.min(0) - 2 * _REACH_MM - [0, 0, phase * thick_mm]
    shape = tuple(np.ceil((there.max(0) - low + 2 * _REACH_MM + thick_mm) / _GRID_MM).astype(int))
    nodes = low + _GRID_MM * np.indices(shape).reshape(3, -1).T
    inside = contains(mesh.with_vertices(there), nodes).reshape(shape).astype(np.float32)
    number = np.floor(_GRID_MM * np.arange(shape[2]) / thick_mm).astype(int)
    slices = np.stack([inside[..., number == n].mean(-1) for n in range(number[-1] + 1)], axis=-1)
    stairs = (slices > 0.5).astype(np.float32)[..., number]
    smooth = gaussian_filter1d(stairs, thick_mm / 2 / _GRID_MM, axis=2)
    for across in (0, 1):  # the drawn line's own pixels
        smooth = gaussian_filter1d(smooth, 1.0 / _GRID_MM, axis=across)
    out = _vertex_normals(mesh) @ turn.T
    steps = np.arange(-_REACH_MM, _REACH_MM + 0.1, 0.25)
    places = (there[:, None] + steps[:, None] * out[:, None] - low) / _GRID_MM
    value = map_coordinates(smooth, places.reshape(-1, 3).T, order=1).reshape(len(there), -1)
    crossing = (value[:, :-1] >= 0.5) & (value[:, 1:] < 0.5)
    away = np.where(crossing, np.abs(steps[:-1] + 0.125), np.inf)
    best = away.argmin(1)
    row = np.arange(len(there))
    a, b = value[row, best], value[row, best + 1]
    shift = steps[best] + 0.25 * (a - 0.5) / np.maximum(a - b, 1e-6)
    return np.where(np.isfinite(away.min(1)), shift, 0.0)


def _vertex_normals(mesh: Mesh) -> np.ndarray:
    """Outward unit normals: the mean of each vertex's triangles, by area."""
    normals = np.zeros_like(mesh.vertices_mm)
    doubled = triangles_of(mesh.vertices_mm, mesh.faces)[1]
    for corner in mesh.faces.T:
        np.add.at(normals, corner, doubled)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
