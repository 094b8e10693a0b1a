"""Surfaces in or around an organ that move with it: vessels, collecting system, planned cuts.

They come from labels or from mesh files, closed or open, and change neither the organ nor its
physics. Where they reach out of the organ, its motion is extrapolated.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from tumortrack.case.meshes import read_lps
from tumortrack.case.options import PrepareOptions, parse_structures
from tumortrack.case.surface import surface_of
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm, transform_points
from tumortrack.core.grid import RawVolume, bounding_box
from tumortrack.core.report import Note
from tumortrack.core.types import ORGAN, Anatomy, LabelVolume, Mesh
from tumortrack.io.segments import Parts, StructureSources, check_side, is_organ, is_tumor

TRUSTED_MM = 5.0  # outside the organ; farther out the motion is a guess
_APART_MM = 50.0  # from the organ; farther away it must be in another frame or unit
_BAY_MM = 5.0  # half the width of a structure that runs into the organ and counts as organ there
_STEP_MM = 1.0
_LEAST_MM = 1.0  # of a structure's extent
_MOST_FACES = 200_000


def split_structures(
    volume: LabelVolume, sources: StructureSources, organ: int
) -> tuple[LabelVolume, dict[str, Mesh]]:
    """The labels without the structures, and the structures as surfaces, LPS mm. Where a structure
    lies in the organ, or in a bay up to 10 mm wide, its voxels become organ. Raises InputError: no
    such label, or the organ's own."""
    numbers = {name: number for name, number in sources.items() if not isinstance(number, Path)}
    if not numbers:  # without a copy of a large map
        return volume, {}
    labels, affine, meshes = volume.labels.copy(), volume.lps_from_index, {}
    removed = np.zeros(labels.shape, bool)
    for name, number in numbers.items():
        mask = volume.labels == number
        if number == organ or not mask.any():
            present = np.unique(volume.labels).tolist()
            raise InputError(f"--structure {name}={number}: the map's labels are {present}.")
        meshes[name] = surface_of(name, mask, affine, _STEP_MM, keep=lambda mesh: mesh)
        removed |= mask
    labels[removed] = 0
    spacing, box = spacing_mm(affine), bounding_box(labels == organ, affine, 3 * _BAY_MM)
    outside = labels[box] != organ
    grown = distance_transform_edt(outside, sampling=spacing) <= _BAY_MM
    closed = distance_transform_edt(grown, sampling=spacing) > _BAY_MM
    labels[box][closed & removed[box]] = organ
    return LabelVolume(labels, affine), meshes


def read_structures(
    sources: StructureSources, unit: str | None
) -> tuple[dict[str, Mesh], list[Note]]:
    """The structures in mesh files, LPS mm, and notes. Raises InputError: no mesh, or too large."""
    meshes, notes = {}, list[Note]()
    for name, path in sources.items():
        if isinstance(path, Path):
            meshes[name] = read_lps(path, 1000.0 if unit == "m" else 1.0, notes)
            if meshes[name].longest_mm < _LEAST_MM:
                raise InputError(
                    f"{path} is {meshes[name].longest_mm:.3g} mm long: it looks like metres. Give "
                    "--unit m, with all meshes in metres."
                )
            if len(meshes[name].faces) > _MOST_FACES:
                raise InputError(f"{path} has over {_MOST_FACES} triangles. Reduce it first.")
    return meshes, notes


def extent_report(
    meshes: Mapping[str, Mesh], anatomy: Anatomy, labels: LabelVolume
) -> tuple[dict[str, Any], list[str]]:
    """How far each structure extends outside the organ (JSON types), and notes on those whose
    motion is extrapolated. Raises InputError: one lies apart from the organ."""
    if not meshes:
        return {}, []
    report, notes, tree = {}, [], cKDTree(anatomy.organ.spread_mm())
    index_from_lps = np.linalg.inv(labels.lps_from_index)
    for name, mesh in meshes.items():
        index = np.rint(transform_points(index_from_lps, mesh.vertices_mm)).astype(int)
        inside = ((index >= 0) & (index < labels.labels.shape)).all(1)
        inside[inside] = labels.labels[tuple(index[inside].T)] > 0
        out_mm = np.where(inside, 0.0, tree.query(mesh.vertices_mm)[0])
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


def parts_of(raw: RawVolume, options: PrepareOptions, where: str) -> Parts:
    """As stated, or else by names; without either 1 is the organ and every other label a tumor.
    Raises InputError: labels have names, and none is the organ's."""
    names = {segment.number: segment.name for segment in raw.segments}
    sources = parse_structures(options.structure, options.name)
    numbers = {name: number for number, name in names.items()}
    structures = {name: numbers.get(str(source), source) for name, source in sources.items()}
    organ = options.organs or tuple(n for n in names if is_organ(names[n], options.name))
    tumors = options.tumors
    if not names:
        stated = tumors if tumors is not None or options.organs in ((), (ORGAN,)) else ()
        note = "tumors by their numbers alone: every label from 2 up" if stated is None else ""
        return Parts(organ or (ORGAN,), stated, structures, {}, tumors is not None, note)
    listing = ", ".join(f"{n} {name}" for n, name in names.items())
    if not organ:
        raise InputError(
            f"{where} holds {listing}: none is a {options.organ_kind.words} by name. Give --organ "
            "NUMBER, or --name of another organ."
        )
    check_side((names[n] for n in organ if n in names), options.stated_side)
    if tumors is None:
        tumors = tuple(n for n in names if is_tumor(names[n]) and n not in organ)
    taken = [" and ".join(names.get(n, f"{n}") for n in of) or "none" for of in (organ, tumors)]
    note = f"organ: {taken[0]}; tumors: {taken[1]}; of {listing}"
    return Parts(organ, tumors, structures, names, options.tumors is not None, note)
