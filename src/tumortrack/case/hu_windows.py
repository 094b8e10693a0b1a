"""Organ and tumor labels from a phantom's CT by HU windows. The scan also shows a table, a
registration block and partial-volume rims; the one free-standing organ is found among them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from tumortrack.case.options import MIN_TUMOR_ML, ORGAN_HU, TUMOR_HU
from tumortrack.core import grid as grids
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.core.grid import bounding_box, components, depth_mm, extent_mm, voxel_ml
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.types import FIRST_TUMOR, ORGAN, LabelVolume, Volume

_RIM_MM = 1.2  # half the width of a partial-volume rim at voxels below a millimetre
_REACH_MM = 30.0  # how far an exophytic tumor may reach out of the organ that was found
# Volume (ml) and longest side (mm) of a kidney, and of any other organ.
_KIDNEY_SIZES, _OTHER_SIZES = ((20.0, 1000.0), 220.0), ((10.0, 4000.0), 400.0)
_THINNEST_MM = 15.0
_STEP_MM = 1.5  # the search runs on cells of about this size
_OPEN_MM = 3.0  # what is thinner than twice this is not organ
_CUT_RADII_MM = (3.0, 4.5, 6.0, 8.0, 10.0, 12.0, 15.0)
_LEAST_SOLIDITY = 0.68  # share of the convex hull that is filled: real kidneys have 0.75 to 0.9
_LEAST_FLATNESS = 0.28  # shortest over longest principal spread: real kidneys have 0.4 to 0.5
_MOST_CONTACT = 0.25  # share of the surface where it was cut from something else
_MOST_TUMOR = 0.7  # share of the volume in the tumor window: a block is all of it
_LEAST_CONTACT = 0.08  # share of a tumor's surroundings that is parenchyma


def segment_ct(
    volume: Volume,
    organ_hu: tuple[float, float] = ORGAN_HU,
    tumor_hu: tuple[float, float] = TUMOR_HU,
    min_tumor_ml: float = MIN_TUMOR_ML,
    organ_kind: Organ = KIDNEY,
) -> tuple[LabelVolume, list[str]]:
    """Segment a phantom's CT by HU windows (half open, [low, high)), as in the paper: labels 1
    organ, 2, 3, ... tumors by volume, cropped to the organ; and notes.

    Table, registration block, air and specks are dropped: see ``_find_organ``. A piece in the tumor
    window with little parenchyma around it is not a tumor but a block beside the phantom. Between
    an exophytic tumor and air, partial volume makes a rim in the organ window; where it is thin it
    becomes tumor. Raises InputError: unusable windows, or nothing like an organ (a patient's
    CT)."""
    limits = (*organ_hu, *tumor_hu)
    if not (np.isfinite(limits).all() and organ_hu[0] < organ_hu[1] <= tumor_hu[0] < tumor_hu[1]):
        raise InputError(
            f"HU windows organ {organ_hu} and tumor {tumor_hu} are not usable: each needs "
            "low < high, and the tumor's must lie above the organ's."
        )
    hu, affine = volume.hu, volume.lps_from_index
    solid = (hu >= organ_hu[0]) & (hu < tumor_hu[1])
    dense = (hu >= tumor_hu[0]) & (hu < tumor_hu[1])
    organ = _find_organ(solid, dense, affine, organ_kind)
    everything_ml = float(solid.sum()) * voxel_ml(affine)
    box = bounding_box(organ, affine, _REACH_MM)
    affine = grids.moved_origin(affine, box)
    organ, tumors, more = _find_tumors(organ[box], solid[box], dense[box], affine, min_tumor_ml)
    note = (
        f"{float(organ.sum()) * voxel_ml(affine):.1f} ml of {everything_ml:.1f} ml between the HU "
        "limits are the organ; table, blocks, rims and specks were dropped"
    )
    if len(tumors) > 254:
        raise InputError(f"{len(tumors)} tumors found; raise --min-tumor-ml or check --tumor-hu.")
    labels = np.where(organ, ORGAN, 0).astype(np.uint8)
    for number, tumor in enumerate(sorted(tumors, key=lambda mask: -int(mask.sum())), FIRST_TUMOR):
        labels[tumor] = number
    return grids.cropped(labels, affine), [note, *more]


def _find_tumors(
    organ: np.ndarray, solid: np.ndarray, dense: np.ndarray, affine: np.ndarray, min_tumor_ml: float
) -> tuple[np.ndarray, list[np.ndarray], list[str]]:
    """The organ with tumors and without blocks, the tumors' masks, notes on what was dropped."""
    steps = spacing_mm(affine)
    rim_mm = max(_RIM_MM, 1.5 * float(steps.max()))
    parenchyma = _opened(organ & ~dense, steps, rim_mm)
    pieces, counts = components(dense)
    boxes = ndimage.find_objects(pieces)
    tumors, small, beside = [], [], []
    for n, ml in enumerate((counts * voxel_ml(affine)).tolist(), 1):
        grown = grids.grown_box(boxes[n - 1], dense.shape, np.ceil(3.5 / steps).astype(int))
        mask = pieces[grown] == n
        if ml < min_tumor_ml:
            if (mask & organ[grown]).any():
                small.append(ml)
            continue
        around = ndimage.distance_transform_edt(~mask, sampling=steps)
        shell = (around > 0) & (around <= max(3.0, 2.0 * float(steps.max())))
        if (shell & parenchyma[grown]).sum() < _LEAST_CONTACT * shell.sum():
            beside.append(ml)
            # The block and its rim are not organ, even if they touch it.
            organ[grown] &= (around > rim_mm) | parenchyma[grown]
            continue
        rim = solid[grown] & (around <= rim_mm) & ~parenchyma[grown] & ~dense[grown]
        tumor = np.zeros_like(organ)
        tumor[grown] = mask | rim
        organ |= tumor
        tumors.append(tumor)
    notes = []
    if small:
        what = f"below {min_tumor_ml:g} ml became organ (largest {max(small):.3f} ml)"
        notes.append(f"{len(small)} bright pieces {what}")
    if beside:
        what = f"beside the organ dropped (largest {max(beside):.1f} ml)"
        notes.append(f"{len(beside)} bright pieces {what}")
    if not tumors:
        notes.append("no tumor found in this organ")
    organ = ndimage.binary_fill_holes(components(organ)[0] == 1)
    return organ, [tumor & organ for tumor in tumors], notes


def _opened(mask: np.ndarray, steps_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """Morphological opening by a ball: removes what is thinner than twice the radius."""
    inner = depth_mm(mask, steps_mm) > radius_mm
    if not inner.any():
        return np.zeros_like(mask)
    return mask & (ndimage.distance_transform_edt(~inner, sampling=steps_mm) <= radius_mm)


class _Grid(NamedTuple):
    """The masks on coarse cells, and which sizes an organ may have."""

    solid: np.ndarray
    dense: np.ndarray
    lps_from_index: np.ndarray
    steps_mm: np.ndarray
    organ_ml: tuple[float, float]
    longest_mm: float


def _find_organ(
    solid: np.ndarray, dense: np.ndarray, lps_from_index: np.ndarray, organ_kind: Organ
) -> np.ndarray:
    """The voxels of ``solid`` in the one body like an organ; ``dense``: those in the tumor window.

    On coarse cells, erode more and more until a piece comes off that looks like an organ
    (``_is_organ``) once it is grown back and cut from its neighbours where they are narrowest
    (watershed of the distance to the background). The largest such piece is the organ; a deeper cut
    replaces it only if that frees it of a sheet. Attached thin sheets are removed.
    """
    factors = np.maximum(1, np.rint(_STEP_MM / spacing_mm(lps_from_index)).astype(int))
    coarse = lps_from_index @ np.diag([*factors, 1.0])
    sizes = _KIDNEY_SIZES if organ_kind.name == KIDNEY.name else _OTHER_SIZES
    cells = _coarse(solid, factors), _coarse(dense, factors)
    grid = _Grid(*cells, coarse, spacing_mm(coarse), *sizes)
    region = _search(grid) if grid.solid.any() else None
    if region is None:
        raise InputError(
            f"no free-standing {organ_kind.words} was found in this CT: nothing between the HU "
            "limits is "
            f"compact, {grid.organ_ml[0]:g} to {grid.organ_ml[1]:g} ml and apart from its "
            "surroundings and from the image's end. Thresholds suit a phantom's CT; of a patient's "
            "CT segment the organ first and give the label map with --labels."
        )
    return _refine(region, grid.solid & ~region, solid, factors)


def _coarse(mask: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Blocks of voxels of which half or more are True; False beyond the ends."""
    padded = np.pad(mask, [(0, -n % f) for n, f in zip(mask.shape, factors.tolist(), strict=True)])
    i, j, k = factors.tolist()
    x, y, z = np.array(padded.shape) // factors
    return 2 * padded.reshape(x, i, y, j, z, k).sum((1, 3, 5), dtype=np.int32) >= i * j * k


def _search(grid: _Grid) -> np.ndarray | None:
    depth = depth_mm(grid.solid, grid.steps_mm)
    # Eroding by r leaves at least a few percent even of the smallest organ.
    least = 0.02 * grid.organ_ml[0] / voxel_ml(grid.lps_from_index)
    organ: np.ndarray | None = None
    for radius in _CUT_RADII_MM:
        pieces, counts = components(depth > radius)
        best: np.ndarray | None = None
        for n, box in enumerate(ndimage.find_objects(pieces)[:12], 1):
            too_long = extent_mm(box, grid.steps_mm).max() > grid.longest_mm
            if counts[n - 1] < least or too_long:
                continue
            region = _grown_back(pieces == n, depth, radius, grid)
            if _is_organ(region, grid) and (best is None or region.sum() > best.sum()):
                best = region
        if best is not None and (organ is None or _sheds_sheet(organ, best, grid)):
            organ = best
    return organ


def _sheds_sheet(before: np.ndarray, after: np.ndarray, grid: _Grid) -> bool:
    """Whether a deeper cut frees the organ of something flat, not of a lump."""
    removed = before & ~after
    return (
        bool((after & before).sum() > 0.9 * after.sum())
        and _flatness(removed, grid.steps_mm) < _LEAST_FLATNESS
        and _solidity(after, grid.steps_mm) > _solidity(before, grid.steps_mm) + 0.05
    )


def _grown_back(core: np.ndarray, depth: np.ndarray, radius: float, grid: _Grid) -> np.ndarray:
    """Grow a core back to the surface, cut from its neighbours, without attached sheets."""
    from skimage.segmentation import watershed

    steps = grid.steps_mm
    box = bounding_box(core, grid.lps_from_index, radius + 12.0)
    solid = grid.solid[box]
    to_core = ndimage.distance_transform_edt(~core[box], sampling=steps)
    markers = np.where(core[box], 1, np.where(solid & (to_core > radius + 5.0), 2, 0))
    grown = watershed(-depth[box], markers, mask=solid) == 1
    thick = depth_mm(grown, steps) > _OPEN_MM
    if thick.any():
        to_thick = ndimage.distance_transform_edt(~thick, sampling=steps)
        grown &= to_thick <= _OPEN_MM + float(steps.max())
    region = np.zeros_like(grid.solid)
    region[box] = components(grown)[0] == 1
    return region


def _is_organ(region: np.ndarray, grid: _Grid) -> bool:
    if not region.any():
        return False
    ml = float(region.sum()) * voxel_ml(grid.lps_from_index)
    box = grids.tight_box(region)
    extent = extent_mm(box, grid.steps_mm)
    at_edge = any(s.start == 0 or s.stop == n for s, n in zip(box, region.shape, strict=True))
    return (
        grid.organ_ml[0] <= ml <= grid.organ_ml[1]
        and not at_edge
        and bool(extent.min() >= _THINNEST_MM and extent.max() <= grid.longest_mm)
        and bool((region & grid.dense).sum() <= _MOST_TUMOR * region.sum())
        and _contact(region, grid.solid) <= _MOST_CONTACT
        and _flatness(region[box], grid.steps_mm) >= _LEAST_FLATNESS
        and _solidity(region[box], grid.steps_mm) >= _LEAST_SOLIDITY
    )


def _contact(region: np.ndarray, solid: np.ndarray) -> float:
    """Share of the region's surface faces beyond which the solid continues."""
    faces = cut = 0
    for axis in range(3):
        a, b = (np.moveaxis(x, axis, 0) for x in (region, solid))
        edge = a[1:] != a[:-1]
        faces += int(edge.sum())
        cut += int((edge & b[1:] & b[:-1]).sum())
    return cut / max(faces, 1)


def _flatness(region: np.ndarray, steps_mm: np.ndarray) -> float:
    """Shortest over longest principal standard deviation: 1 for a ball, 0 for a sheet."""
    points = np.argwhere(region) * steps_mm
    if len(points) < 4:
        return 1.0
    spread = np.linalg.eigvalsh(np.cov(points.T))
    return float(np.sqrt(max(spread[0], 0.0) / max(spread[2], 1e-12)))


def _solidity(region: np.ndarray, steps_mm: np.ndarray) -> float:
    """Volume over the volume of the convex hull (of the voxels' centres, grown by half a voxel)."""
    shell = np.argwhere(region & ~ndimage.binary_erosion(region))
    corners = np.concatenate([shell - 0.5, shell + 0.5]) * steps_mm
    try:
        hull = ConvexHull(corners)
    except QhullError:
        return 0.0
    return float(region.sum() * np.prod(steps_mm) / hull.volume)


def _refine(
    region: np.ndarray, other: np.ndarray, solid: np.ndarray, factors: np.ndarray
) -> np.ndarray:
    """The coarse region on the voxels; cells that are not solid follow their nearest solid cell."""
    label = np.where(region, 1, np.where(other, 2, 0)).astype(np.uint8)
    reach = ndimage.binary_dilation(region, np.ones((3, 3, 3)))
    nearest = ndimage.distance_transform_edt(
        label == 0, return_distances=False, return_indices=True
    )
    label = np.where(reach, label[tuple(nearest)], 0)
    for axis, factor in enumerate(factors.tolist()):
        label = np.repeat(label, factor, axis)
    fine = label[tuple(slice(0, n) for n in solid.shape)] == 1
    return components(fine & solid)[0] == 1
