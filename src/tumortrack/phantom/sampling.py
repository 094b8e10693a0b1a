"""Random phantoms, and the measures that say whether a tumor lies as it should."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tumortrack.core.errors import NoEstimate
from tumortrack.phantom.digital import (
    SMALLEST_GAP_MM,
    Axes,
    PhantomParameters,
    TumorParameters,
    gap_mm,
    organ_mask,
    sorted_tumors,
    tumor_masks,
)

_SHAPE_TRIES, _PLACE_TRIES = 8, 40
_COVER_MM = 2.0
_EXOPHYTIC_SHARE = (0.35, 0.65)


@dataclass(frozen=True)
class TumorPlacement:
    """How one tumor lies in the organ."""

    outside_share: float
    """Share of the tumor's volume beyond the organ's own surface: 0 is endophytic."""
    cover_mm: float
    """Least parenchyma between tumor and organ surface; 0 where it breaks through."""


def placements(parameters: PhantomParameters, voxel_mm: float = 1.0) -> list[TumorPlacement]:
    """Measure every tumor, in label order, on a grid of ``voxel_mm`` by distance transform."""
    from scipy import ndimage

    axes_mm = _axes_round(parameters, voxel_mm)
    inside = organ_mask(parameters, axes_mm)
    depth_mm = ndimage.distance_transform_edt(inside, sampling=voxel_mm)
    return [
        TumorPlacement(float((mask & ~inside).sum() / mask.sum()), float(depth_mm[mask].min()))
        for mask in tumor_masks(parameters, axes_mm)
    ]


def random_phantom(seed: int) -> PhantomParameters:
    """A valid phantom of random shape, side and tumors: one endophytic, one or two exophytic.

    Endophytic tumors (18 to 38 mm) keep 2 mm of cover; of exophytic ones (14 to 32 mm) 35 to
    65 % lie outside the organ; tumors stay 3 mm apart. The same seed gives the same phantom.

    Raises:
        NoEstimate: no valid arrangement was found in a bounded number of tries.
    """
    rng = np.random.default_rng(seed)
    for _ in range(_SHAPE_TRIES):
        found = _with_tumors(_random_shape(rng), rng)
        if found is not None:
            return found
    raise NoEstimate(
        f"no valid phantom was found for seed {seed} in {_SHAPE_TRIES} tries; choose another seed."
    )


def _random_shape(rng: np.random.Generator) -> PhantomParameters:
    return PhantomParameters(
        size_mm=(
            float(rng.uniform(52, 66)),
            float(rng.uniform(44, 54)),
            float(rng.uniform(96, 120)),
        ),
        bend_mm=float(rng.uniform(7, 14)),
        taper=float(rng.uniform(0.03, 0.15)),
        hilum_depth_mm=float(rng.uniform(11, 19)),
        lump_mm=float(rng.uniform(0.5, 1.5)),
        shape_seed=int(rng.integers(2**31)),
        tumors=(),
        side="left" if rng.random() < 0.5 else "right",
    )


def _with_tumors(shape: PhantomParameters, rng: np.random.Generator) -> PhantomParameters | None:
    """The shape with random tumors, or None where they find no room."""
    endophytic_mm = float(rng.uniform(18, 38))
    exophytic_mm = rng.uniform(14, min(32.0, endophytic_mm - 1), size=rng.integers(1, 3))
    found = _add_tumor(shape, rng, endophytic_mm, exophytic=False)
    for diameter_mm in exophytic_mm:
        if found is not None:
            found = _add_tumor(found, rng, float(diameter_mm), exophytic=True)
    return found


def _add_tumor(
    phantom: PhantomParameters, rng: np.random.Generator, diameter_mm: float, exophytic: bool
) -> PhantomParameters | None:
    """Draw places of the right depth until the finished phantom measures as it should."""
    from scipy import ndimage

    axes_mm = _axes_round(phantom, 2.0)
    inside = organ_mask(phantom, axes_mm)
    depth_mm = ndimage.distance_transform_edt(inside, sampling=2.0)
    lobulation = float(rng.uniform(0.02, 0.1))
    if exophytic:  # centre a little below the surface, away from the medial side
        candidates = (depth_mm > 0) & (depth_mm < 0.25 * diameter_mm)
        candidates[axes_mm[0] > 0.15 * phantom.size_mm[0]] = False
    else:
        candidates = depth_mm > diameter_mm / 2 * (1 + lobulation) + _COVER_MM
    places = np.argwhere(candidates)
    for place in rng.permutation(places)[:_PLACE_TRIES]:
        x, y, z = (float(axis[n]) for axis, n in zip(axes_mm, place, strict=True))
        tumor = TumorParameters(diameter_mm=diameter_mm, center_mm=(x, y, z), lobulation=lobulation)
        if any(gap_mm(tumor, other) < SMALLEST_GAP_MM for other in phantom.tumors):
            continue
        grown = _replace_tumors(phantom, (*phantom.tumors, tumor))
        measured = placements(grown, 1.5)[sorted_tumors(grown).index(tumor)]
        low, high = _EXOPHYTIC_SHARE if exophytic else (0.0, 0.0)
        covered = exophytic or measured.cover_mm >= _COVER_MM
        if low <= measured.outside_share <= high and covered:
            return grown
    return None


def _replace_tumors(
    phantom: PhantomParameters, tumors: tuple[TumorParameters, ...]
) -> PhantomParameters:
    import msgspec

    return msgspec.structs.replace(phantom, tumors=tumors)


def _axes_round(parameters: PhantomParameters, voxel_mm: float) -> Axes:
    """Grid axes in the organ frame that hold organ and tumors."""
    reach_mm = np.array(parameters.size_mm) / 2 + 2 * voxel_mm
    for tumor in parameters.tumors:
        radius_mm = tumor.diameter_mm / 2 * (1 + tumor.lobulation)
        reach_mm = np.maximum(reach_mm, np.abs(tumor.center_mm) + radius_mm + voxel_mm)
    x, y, z = (np.arange(-r, r + voxel_mm, voxel_mm) for r in reach_mm)
    return x, y, z
