"""What lies in or about an organ and moves with it: vessels, collecting system, planned cuts.

Surfaces, closed or open, of label numbers or of mesh files. They change neither the organ nor its
physics; where they reach out of the organ, its motion is extrapolated.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm, transform_points
from tumortrack.core.organ import check_name
from tumortrack.core.types import Anatomy, LabelVolume, Mesh
from tumortrack.imaging.grid import bounding_box
from tumortrack.imaging.meshes import read_lps
from tumortrack.imaging.surface import surface_of

TRUSTED_MM = 5.0  # outside the organ; farther out a motion is a guess
_APART_MM = 50.0  # from the organ: of another frame or unit
_BAY_MM = 5.0  # half the width of what runs into an organ and still counts as the organ's
_STEP_MM = 1.0
_MOST_FACES = 200_000

Stated = dict[str, int | Path]


def stated_structures(options: tuple[str, ...], organ: str) -> Stated:
    """By name: a label number, or a mesh's path. Raises InputError: not NAME=NUMBER or NAME=PATH, a
    name twice, or one that is not allowed."""
    found: Stated = {}
    for option in options:
        name, _, value = option.partition("=")
        if not value:
            raise InputError(f"--structure {option!r} is not NAME=NUMBER or NAME=PATH.")
        check_name(name, "a structure", "--structure")
        if name in found or name == organ:
            raise InputError(f"--structure {name}: that name is taken. Give another.")
        found[name] = int(value) if value.isdecimal() else Path(value)
    return found


def set_apart(
    volume: LabelVolume, stated: Stated, organ: int
) -> tuple[LabelVolume, dict[str, Mesh]]:
    """The labels without the structures', and these as surfaces, LPS mm. What of a structure lies
    in the organ, or runs into it in a bay up to 10 mm wide, becomes organ. Raises InputError: no
    such label, or the organ's own."""
    labels, affine, meshes = volume.labels.copy(), volume.lps_from_index, {}
    apart = np.zeros(labels.shape, bool)
    for name, number in stated.items():
        if isinstance(number, Path):
            continue
        mine = volume.labels == number
        if number == organ or not mine.any():
            present = np.unique(volume.labels).tolist()
            raise InputError(f"--structure {name}={number}: the map's labels are {present}.")
        meshes[name] = surface_of(name, mine, affine, _STEP_MM, keep=lambda mesh: mesh)
        apart |= mine
    if meshes:
        labels[apart] = 0
        spacing, box = spacing_mm(affine), bounding_box(labels == organ, affine, 3 * _BAY_MM)
        outside = labels[box] != organ
        grown = distance_transform_edt(outside, sampling=spacing) <= _BAY_MM
        closed = distance_transform_edt(grown, sampling=spacing) > _BAY_MM
        labels[box][closed & apart[box]] = organ
    return LabelVolume(labels, affine), meshes


def read_structures(stated: Stated, unit: str | None) -> tuple[dict[str, Mesh], list[str]]:
    """Those in mesh files, LPS mm, as they are, and notes. Raises InputError: no mesh, or one of
    too many triangles."""
    meshes, notes = {}, list[str]()
    for name, path in stated.items():
        if isinstance(path, Path):
            meshes[name] = read_lps(path, 1000.0 if unit == "m" else 1.0, notes)
            if len(meshes[name].faces) > _MOST_FACES:
                raise InputError(f"{path} has over {_MOST_FACES} triangles. Reduce it first.")
    return meshes, notes


def described(
    meshes: Mapping[str, Mesh], anatomy: Anatomy, labels: LabelVolume
) -> tuple[dict[str, Any], list[str]]:
    """How far each reaches out of the organ (JSON types), and notes on those that are extrapolated.
    Raises InputError: one that lies apart from the organ."""
    report, notes, tree = {}, [], cKDTree(anatomy.organ.spread_mm())
    index_from_lps = np.linalg.inv(labels.lps_from_index)
    for name, mesh in meshes.items():
        index = np.rint(transform_points(index_from_lps, mesh.vertices_mm)).astype(int)
        there = ((index >= 0) & (index < labels.labels.shape)).all(1)
        there[there] = labels.labels[tuple(index[there].T)] > 0
        out_mm = np.where(there, 0.0, tree.query(mesh.vertices_mm)[0])
        if out_mm.min() > _APART_MM:
            raise InputError(
                f"the structure {name} lies {out_mm.min():.0f} mm from the organ. Check that it "
                "has the organ's frame (LPS) and unit (mm; --unit m)."
            )
        share = float((out_mm > TRUSTED_MM).mean())
        report[name] = {"outside_mm": float(out_mm.max()), "extrapolated": share}
        if share > 0:
            notes.append(
                f"{name} reaches {out_mm.max():.0f} mm out of the organ: where it is farther out "
                f"than {TRUSTED_MM:g} mm ({share:.0%} of it) its motion is a guess"
            )
    return report, notes
