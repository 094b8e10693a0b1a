"""Find one free-standing kidney in a mask that also holds a table, a block and rims."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.imaging.grid import bounding_box, components, voxel_ml

KIDNEY_ML = (20.0, 1000.0)
LONGEST_MM = 220.0
_THINNEST_MM = 15.0
_STEP_MM = 1.5  # the search runs on cells of about this size
_OPEN_MM = 3.0  # what is thinner than twice this is no kidney
_CUT_RADII_MM = (3.0, 4.5, 6.0, 8.0, 10.0, 12.0, 15.0)
_LEAST_SOLIDITY = 0.68  # share of the convex hull that is filled: real kidneys have 0.75 to 0.9
_LEAST_FLATNESS = 0.28  # shortest over longest principal spread: real kidneys have 0.4 to 0.5
_MOST_CONTACT = 0.25  # share of the surface that was cut off something else
_MOST_TUMOR = 0.7  # share of the volume in the tumor window: a block is all of it


@dataclass(frozen=True, eq=False)
class _Grid:
    """The solid mask and tumor share on coarse cells."""

    solid: Bool[np.ndarray, "i j k"]
    dense: Bool[np.ndarray, "i j k"]
    lps_from_index: Float[np.ndarray, "4 4"]

    @property
    def steps_mm(self) -> np.ndarray:
        return spacing_mm(self.lps_from_index)


def find_organ(
    solid: Bool[np.ndarray, "i j k"],
    dense: Bool[np.ndarray, "i j k"],
    lps_from_index: Float[np.ndarray, "4 4"],
) -> Bool[np.ndarray, "i j k"]:
    """The voxels of ``solid`` that belong to the one kidney-like body.

    The rule, on cells of about 1.5 mm: erode by 3 mm, then by up to 15 mm, until a piece stands
    alone that, grown back and cut from its neighbours at the narrowest place (watershed of the
    distance to the background), has 20 to 1000 ml, is 15 to 220 mm long in every direction,
    fills two thirds of its convex hull, does not touch the scan's edge, is mostly kidney window
    and was cut along at most a quarter of its surface, and is no sheet (shortest over longest
    principal spread above 0.28). The largest such piece is the kidney; a deeper cut replaces it
    only where that frees it of a sheet. Attached sheets thinner than 6 mm go.

    Args:
        dense: the part of ``solid`` in the tumor window.

    Raises:
        InputError: there is no such piece; it suggests a label map.
    """
    factors = np.maximum(1, np.rint(_STEP_MM / spacing_mm(lps_from_index)).astype(int))
    grid = _Grid(
        _block_mean(solid, factors) >= 0.5,
        _block_mean(dense, factors) >= 0.5,
        lps_from_index @ np.diag([*factors, 1.0]),
    )
    region = _search(grid)
    if region is None:
        raise InputError(
            "no free-standing kidney was found in this CT: nothing between the HU limits is "
            f"compact, {KIDNEY_ML[0]:g} to {KIDNEY_ML[1]:g} ml and apart from its surroundings. "
            "Thresholds suit a phantom's CT; of a patient's CT segment the kidney first and give "
            "the label map with --labels."
        )
    return _refine(region, grid.solid & ~region, solid, factors)


def _block_mean(mask: np.ndarray, factors: np.ndarray) -> Float[np.ndarray, "i j k"]:
    """Mean over blocks of ``factors`` voxels; the ends are padded with False."""
    f = factors.tolist()
    out = np.pad(mask, [(0, -n % k) for n, k in zip(mask.shape, f, strict=True)])
    for axis in (2, 1, 0):
        shape = (*out.shape[:axis], out.shape[axis] // f[axis], f[axis], *out.shape[axis + 1 :])
        out = out.reshape(shape).mean(axis + 1, dtype=np.float32)
    return out.astype(float)


def _search(grid: _Grid) -> np.ndarray | None:
    from scipy import ndimage

    if not grid.solid.any():
        return None
    depth = ndimage.distance_transform_edt(np.pad(grid.solid, 1), sampling=grid.steps_mm)
    depth = depth[1:-1, 1:-1, 1:-1]
    least = KIDNEY_ML[0] / voxel_ml(grid.lps_from_index)
    found: np.ndarray | None = None
    for radius in _CUT_RADII_MM:
        pieces, counts = components(depth > radius)
        best: np.ndarray | None = None
        for n, box in enumerate(ndimage.find_objects(pieces)[:12], 1):
            # Eroding by r leaves at least a few percent even of the smallest kidney.
            if counts[n - 1] < 0.02 * least or _too_long(box, grid):
                continue
            region = _piece_region(pieces == n, depth, radius, grid)
            if _is_kidney(region, grid) and (best is None or region.sum() > best.sum()):
                best = region
        if best is not None and (found is None or _sheds_sheet(found, best, grid)):
            found = best
    return found


def _sheds_sheet(before: np.ndarray, after: np.ndarray, grid: _Grid) -> bool:
    """A deeper cut is better where it frees the kidney of a flat thing, never of a lump."""
    off = before & ~after
    return (
        bool((after & before).sum() > 0.9 * after.sum())
        and _flatness(off, grid.steps_mm) < _LEAST_FLATNESS
        and _solidity(after, grid.steps_mm) > _solidity(before, grid.steps_mm) + 0.05
    )


def _too_long(box: tuple[slice, ...], grid: _Grid) -> bool:
    extent = np.array([s.stop - s.start for s in box]) * grid.steps_mm
    return bool(extent.max() > LONGEST_MM)


def _piece_region(core: np.ndarray, depth: np.ndarray, radius: float, grid: _Grid) -> np.ndarray:
    """Grow a core back to the surface, cut from its neighbours, without attached sheets."""
    from scipy import ndimage
    from skimage.segmentation import watershed

    steps = grid.steps_mm
    box = bounding_box(core, grid.lps_from_index, radius + 12.0)
    solid = grid.solid[box]
    away = ndimage.distance_transform_edt(~core[box], sampling=steps)
    markers = np.where(core[box], 1, np.where(solid & (away > radius + 5.0), 2, 0))
    own = watershed(-depth[box], markers, mask=solid) == 1
    inner = ndimage.distance_transform_edt(np.pad(own, 1), sampling=steps)[1:-1, 1:-1, 1:-1]
    core_again = inner > _OPEN_MM
    if core_again.any():
        back = ndimage.distance_transform_edt(~core_again, sampling=steps)
        own &= back <= _OPEN_MM + float(steps.max())
    pieces, counts = components(own)
    region = np.zeros_like(grid.solid)
    if len(counts):
        region[box] = pieces == 1
    return region


def _is_kidney(region: np.ndarray, grid: _Grid) -> bool:
    if not region.any():
        return False
    ml = float(region.sum()) * voxel_ml(grid.lps_from_index)
    if not KIDNEY_ML[0] <= ml <= KIDNEY_ML[1]:
        return False
    box = bounding_box(region, grid.lps_from_index, 0.0)
    extent = np.array([s.stop - s.start for s in box]) * grid.steps_mm
    at_edge = any(s.start == 0 or s.stop == n for s, n in zip(box, region.shape, strict=True))
    if at_edge or extent.max() > LONGEST_MM or extent.min() < _THINNEST_MM:
        return False
    if (region & grid.dense).sum() > _MOST_TUMOR * region.sum():
        return False
    if _contact(region, grid.solid) > _MOST_CONTACT:
        return False
    if _flatness(region[box], grid.steps_mm) < _LEAST_FLATNESS:
        return False
    return _solidity(region[box], grid.steps_mm) >= _LEAST_SOLIDITY


def _contact(region: np.ndarray, solid: np.ndarray) -> float:
    """Share of the region's surface faces behind which the solid goes on."""
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
    from scipy import ndimage
    from scipy.spatial import ConvexHull, QhullError

    shell = np.argwhere(region & ~ndimage.binary_erosion(region))
    corners = np.concatenate([shell - 0.5, shell + 0.5]) * steps_mm
    try:
        hull = ConvexHull(corners)
    except QhullError:
        return 0.0
    return float(region.sum() * np.prod(steps_mm) / hull.volume)


def _refine(
    region: np.ndarray, other: np.ndarray, solid: np.ndarray, factors: np.ndarray
) -> Bool[np.ndarray, "i j k"]:
    """Carry the coarse decision to the voxels: cells that were neither ask their nearest cell."""
    from scipy import ndimage

    label = np.where(region, 1, np.where(other, 2, 0)).astype(np.uint8)
    reach = ndimage.binary_dilation(region, np.ones((3, 3, 3)), iterations=1)
    nearest = ndimage.distance_transform_edt(
        label == 0, return_distances=False, return_indices=True
    )
    label = np.where(reach, label[tuple(nearest)], 0)
    for axis, factor in enumerate(factors.tolist()):
        label = np.repeat(label, factor, axis)
    fine = label[tuple(slice(0, n) for n in solid.shape)] == 1
    pieces, counts = components(fine & solid)
    return pieces == 1 if len(counts) else fine & solid
