"""Organ and tumors of a deformed phantom from its CT on the base, held against the case."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.case.hu_windows import segment_ct
from tumortrack.case.surface import surfaces
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm, transform_points
from tumortrack.core.grid import grown_box, moved_origin, voxel_ml
from tumortrack.core.raster import voxelise
from tumortrack.core.types import Anatomy, Mesh, Volume
from tumortrack.io.case import Case
from tumortrack.io.mesh_files import read_mesh
from tumortrack_experiment.kit_file import Kit
from tumortrack_experiment.register.in_ct import Ball

AIR_HU = -1000.0
_LEAST_PRINT_HU = -900.0  # of a print that is mostly hollow
_ROUND_MM = 35.0  # that a pressed organ may come out of its box at rest, or beside the beads
_BEAD_RIM_MM = 1.5
_ORGAN_PERCENT = 5.0  # hydrogel keeps its volume; a second scan at 1 mm finds it to 1 %
_TUMOR_PERCENT, _TUMOR_VOXELS = 15.0, 0.5  # of its volume, or all round, whichever is more
_STANDS_MM = (-2.0, 6.0)  # the organ's lowest point over the plate
_USUAL_SHIFT_MM = 15.0  # of a tumor by the paper's plates
_USUAL_CHANGE = 0.1  # of its volume


def parts_in(kit: Kit, folder: Path, state: str) -> dict[str, Mesh]:
    """The kit's parts that stand on the base in a state by name, base frame. Raises InputError: a
    part's file is missing or damaged."""
    folder = folder if folder.is_dir() else folder.parent
    found = {}
    for part in kit.parts:
        if part.base_from_part is not None and part.state in ("", state):
            mesh = read_mesh(folder / part.file)
            base_from_part = np.array(part.base_from_part)
            found[part.name] = mesh.with_vertices(
                transform_points(base_from_part, mesh.vertices_mm)
            )
    return found


def segment_deformed(
    volume: Volume,
    ct_from_base: Float64[np.ndarray, "4 4"],
    kit: Kit,
    case: Case,
    others: tuple[dict[str, Mesh], list[Ball]],
    windows: tuple[tuple[float, float], tuple[float, float]],
) -> tuple[Anatomy, dict[str, Any]]:
    """Take away what stands on the base and what lies under it, segment the rest by HU windows, and
    compare: surfaces (LPS of this CT), tumors numbered as the case's, and plain JSON. ``others``:
    the parts that stand there, base frame, and the bright balls of the CT.

    Raises:
        InputError: no organ, or organ and tumors are not those that the kit's molds cast.
    """
    rest_mm = transform_points(np.array(kit.base_from_ct), case.anatomy.organ.vertices_mm)
    alone = _without_base(_cropped(volume, ct_from_base, kit, rest_mm), ct_from_base, kit, others)
    labels, notes = segment_ct(alone, *windows)
    anatomy, _ = surfaces(labels)
    base_from_ct = np.linalg.inv(ct_from_base)
    in_base = [transform_points(base_from_ct, part.vertices_mm) for part in anatomy.parts]
    counts = np.bincount(labels.labels.ravel())[1:] * voxel_ml(labels.lps_from_index)
    found_ml = [float(counts.sum()), *counts[1:].tolist()]
    lowest_mm = float(in_base[0][:, 2].min())
    _check(found_ml, kit, lowest_mm)
    middles = np.array([at.mean(0) for at in in_base[1:]]).reshape(-1, 3)
    at_rest = np.array([tumor.vertices_mm.mean(0) for tumor in case.anatomy.tumors]).reshape(-1, 3)
    places = transform_points(np.array(kit.base_from_ct), at_rest)
    step_mm = float(spacing_mm(volume.lps_from_index).mean())
    order = _order(found_ml[1:], middles, kit, places, step_mm)
    tumors = [anatomy.tumors[n] for n in order]
    report = {
        "organ_ml": found_ml[0],
        "tumors_ml": [found_ml[1 + n] for n in order],
        "kit_ml": [kit.organ_ml, *kit.tumors_ml],
        "lowest_mm": lowest_mm,
        "tumor_shift_mm": np.linalg.norm(middles[order] - places, axis=1).tolist(),
        "notes": notes,
    }
    return case.anatomy.with_parts((anatomy.organ, *tumors)), report


def _cropped(volume: Volume, ct_from_base: np.ndarray, kit: Kit, rest_mm: np.ndarray) -> Volume:
    """The voxels about the organ's place on the base."""
    box = np.stack([rest_mm.min(0), rest_mm.max(0)]) + np.array([[-_ROUND_MM], [_ROUND_MM]])
    box[0, 2] = -5.0
    corners = np.stack(np.meshgrid(*box.T), -1).reshape(-1, 3)
    index_from_base = np.linalg.inv(volume.lps_from_index) @ ct_from_base
    index = transform_points(index_from_base, corners)
    ends = zip(np.floor(index.min(0)).astype(int), np.ceil(index.max(0)).astype(int), strict=True)
    sides = [slice(max(0, int(a)), max(0, int(b))) for a, b in ends]
    inner = grown_box(sides, volume.hu.shape)
    if min(side.stop - side.start for side in inner) < 2:
        raise InputError("the organ's place on the base lies outside the CT. Scan the whole base.")
    return Volume(volume.hu[inner], moved_origin(volume.lps_from_index, inner))


def _without_base(
    volume: Volume,
    ct_from_base: np.ndarray,
    kit: Kit,
    others: tuple[dict[str, Mesh], list[Ball]],
) -> Volume:
    """The CT with air for all that is under the organ and for the kit's parts, whose rims the
    segmentation drops as sheets; balls inside something are filled with what is round them.
    Raises InputError: a part is not there."""
    hu, affine = volume.hu.copy(), volume.lps_from_index
    parts, balls = others
    base_from_index = np.linalg.inv(ct_from_base) @ affine
    i, j, k = np.ogrid[tuple(slice(0, n) for n in hu.shape)]
    x, y, z, shift = base_from_index[2]
    hu[x * i + y * j + z * k + shift < 0] = AIR_HU
    for name, part in parts.items():
        there = part.with_vertices(transform_points(ct_from_base, part.vertices_mm))
        inside = voxelise(there, affine, hu.shape)
        if inside.any() and np.median(volume.hu[inside]) < _LEAST_PRINT_HU:
            raise InputError(
                f"where the kit has the part {name} in this state, the CT has air. It shows "
                "another state (--state), or the part stands elsewhere."
            )
        hu[inside] = AIR_HU
    steps = spacing_mm(affine)
    reach_mm = kit.bead_diameter_mm / 2 + _BEAD_RIM_MM + float(steps.max()) / 2
    for ball in balls:
        at = transform_points(np.linalg.inv(affine), ball.center_mm[None])[0]
        away = sum(((axis - c) * s) ** 2 for axis, c, s in zip((i, j, k), at, steps, strict=True))
        hu[away < reach_mm**2] = ball.hu_around
    return Volume(hu, affine)


def _check(found_ml: list[float], kit: Kit, lowest_mm: float) -> None:
    """Raises InputError, with all numbers, where this is not what the molds cast."""
    faults = []
    change = 100 * (found_ml[0] / kit.organ_ml - 1)
    if abs(change) > _ORGAN_PERCENT:
        faults.append(
            f"the organ has {found_ml[0]:.1f} ml, {change:+.2g} %, where {_ORGAN_PERCENT:g} % are "
            "allowed (another state or phantom, or a plate taken for organ?)"
        )
    if len(found_ml) - 1 != len(kit.tumors_ml):
        faults.append(f"it has {len(found_ml) - 1} tumors instead of {len(kit.tumors_ml)}")
    if not _STANDS_MM[0] <= lowest_mm <= _STANDS_MM[1]:
        faults.append(
            f"its lowest point is {lowest_mm:.1f} mm over the base ({_STANDS_MM[0]:g} to "
            f"{_STANDS_MM[1]:g} are allowed): it does not stand there"
        )
    if faults:
        raise InputError(
            f"the CT does not show the kit's organ of {kit.organ_ml:.1f} ml with tumors of "
            f"{', '.join(f'{ml:.1f}' for ml in kit.tumors_ml)} ml: {'; '.join(faults)}. Check that "
            "it is this phantom, in this state (--state), and the HU windows."
        )


def _order(
    found_ml: list[float], found_mm: np.ndarray, kit: Kit, places: np.ndarray, step_mm: float
) -> list[int]:
    """Which of the tumors found is the case's first, second, ...: by volume and by place. Raises
    InputError: one has another volume."""
    from scipy.optimize import linear_sum_assignment

    if not len(places):
        return []
    ratio = np.log(np.array(found_ml) / np.array(kit.tumors_ml)[:, None]) / _USUAL_CHANGE
    away = np.linalg.norm(found_mm - places[:, None], axis=2) / _USUAL_SHIFT_MM
    order = [int(n) for n in linear_sum_assignment(ratio**2 + away**2)[1]]
    for number, (n, ml) in enumerate(zip(order, kit.tumors_ml, strict=True), 1):
        rim_ml = _TUMOR_VOXELS * step_mm * (36 * np.pi) ** (1 / 3) * (1000 * ml) ** (2 / 3) / 1000
        allowed_ml = max(_TUMOR_PERCENT / 100 * ml, rim_ml)  # of a ball's surface
        if abs(found_ml[n] - ml) > allowed_ml:
            raise InputError(
                f"the tumor in tumor_{number}'s place has {found_ml[n]:.1f} ml; the kit's has "
                f"{ml:.1f} +- {allowed_ml:.1f} ml. Check that it is this phantom, and --tumor-hu."
            )
    return order
