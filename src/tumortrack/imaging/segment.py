"""Labels of organ and tumors: from a phantom's CT by HU windows, or from a label map."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.core.types import FIRST_TUMOR, ORGAN, LabelVolume, Volume
from tumortrack.imaging.grid import bounding_box, components, cropped, moved_origin, voxel_ml
from tumortrack.imaging.organ import find_organ
from tumortrack.imaging.select import MIN_TUMOR_ML, select_labels

__all__ = ["KIDNEY_HU", "TUMOR_HU", "segment_ct", "select_labels"]

KIDNEY_HU = (-300.0, 300.0)
TUMOR_HU = (300.0, 1000.0)
_RIM_MM = 1.2  # half of what a partial-volume rim can measure, at voxels below a millimetre
_REACH_MM = 30.0  # an exophytic tumor's far side may lie this far off the organ found
_LEAST_CONTACT = 0.08  # share of a tumor's surroundings that is parenchyma


def segment_ct(
    volume: Volume,
    kidney_hu: tuple[float, float] = KIDNEY_HU,
    tumor_hu: tuple[float, float] = TUMOR_HU,
    min_tumor_ml: float = MIN_TUMOR_ML,
) -> tuple[LabelVolume, list[str]]:
    """Segment a phantom's CT by HU windows (half open, [low, high)), as in the paper.

    Table, registration block, air and specks go: see ``organ.find_organ`` for the rule. A piece
    of the tumor window counts as a tumor when parenchyma fills at least 8 % of the shell 3 mm
    about it (a block beside the phantom has none: its own rim is too thin to be parenchyma).
    The rim between an exophytic tumor and air falls into the kidney's window by partial volume;
    where it is thinner than 2.4 mm (at least three voxels) it is given to the tumor.

    Returns:
        Labels 1 organ, 2, 3, ... tumors by volume, cropped round the organ; and notes.

    Raises:
        InputError: unusable windows, or no kidney-like body (a patient's CT).
    """
    _check_windows(kidney_hu, tumor_hu)
    hu, affine = volume.hu, volume.lps_from_index
    solid = (hu >= kidney_hu[0]) & (hu < tumor_hu[1])
    dense = (hu >= tumor_hu[0]) & (hu < tumor_hu[1])
    organ = find_organ(solid, dense, affine)
    everything_ml = float(solid.sum()) * voxel_ml(affine)

    box = bounding_box(organ, affine, _REACH_MM)
    organ, solid, dense = organ[box], solid[box], dense[box]
    affine = moved_origin(affine, box)
    notes = []
    organ, tumors, more = _tumors_of(organ, solid, dense, affine, min_tumor_ml)
    kept_ml = float(organ.sum()) * voxel_ml(affine)
    notes.append(
        f"{kept_ml:.1f} ml of {everything_ml:.1f} ml between the HU limits are the kidney; table, "
        "blocks, rims and specks were dropped"
    )
    labels = _number_by_volume(organ, tumors)
    return cropped(labels, affine), notes + more


def _check_windows(kidney_hu: tuple[float, float], tumor_hu: tuple[float, float]) -> None:
    limits = (*kidney_hu, *tumor_hu)
    if not (np.isfinite(limits).all() and kidney_hu[0] < kidney_hu[1] <= tumor_hu[0] < tumor_hu[1]):
        raise InputError(
            f"HU windows kidney {kidney_hu} and tumor {tumor_hu} are not usable: each needs "
            "low < high, and the tumor's must lie above the kidney's."
        )


def _tumors_of(
    organ: Bool[np.ndarray, "i j k"],
    solid: Bool[np.ndarray, "i j k"],
    dense: Bool[np.ndarray, "i j k"],
    affine: Float[np.ndarray, "4 4"],
    min_tumor_ml: float,
) -> tuple[Bool[np.ndarray, "i j k"], list[np.ndarray], list[str]]:
    """The organ, corrected by its tumors; the tumors' masks; notes on what was dropped."""
    from scipy import ndimage

    steps = spacing_mm(affine)
    rim_mm = max(_RIM_MM, 1.5 * float(steps.max()))
    parenchyma = _opened(organ & ~dense, steps, rim_mm)
    pieces, counts = components(dense)
    unit = voxel_ml(affine)
    boxes = ndimage.find_objects(pieces)
    tumors, small, beside = [], [], []
    for n, count in enumerate(counts.tolist(), 1):
        grown = _grown_box(boxes[n - 1], dense.shape, np.ceil(3.5 / steps).astype(int))
        mask = pieces[grown] == n
        if count * unit < min_tumor_ml:
            if (mask & organ[grown]).any():
                small.append(count * unit)
            continue
        around = ndimage.distance_transform_edt(~mask, sampling=steps)
        shell = (around > 0) & (around <= max(3.0, 2.0 * float(steps.max())))
        if (shell & parenchyma[grown]).sum() < _LEAST_CONTACT * shell.sum():
            beside.append(count * unit)
            # The piece and its rim are no part of the organ, even if they touch it.
            organ[grown] &= (around > rim_mm) | parenchyma[grown]
            continue
        rim = solid[grown] & (around <= rim_mm) & ~parenchyma[grown] & ~dense[grown]
        whole = np.zeros_like(organ)
        whole[grown] = mask | rim
        organ |= whole
        tumors.append(whole)
    notes = []
    if small:
        text = f"{len(small)} bright pieces below {min_tumor_ml:g} ml became organ"
        notes.append(f"{text} (largest {max(small):.3f} ml)")
    if beside:
        text = f"{len(beside)} bright pieces beside the organ dropped"
        notes.append(f"{text} (largest {max(beside):.1f} ml)")
    if not tumors:
        notes.append("no tumor found in this organ")
    numbered, _ = components(organ)
    organ = ndimage.binary_fill_holes(numbered == 1)
    return organ, [t & organ for t in tumors], notes


def _grown_box(
    box: tuple[slice, ...], shape: tuple[int, ...], margin: np.ndarray
) -> tuple[slice, ...]:
    """A box grown by a margin in voxels, within the grid."""
    return tuple(
        slice(max(0, s.start - m), min(n, s.stop + m))
        for s, n, m in zip(box, shape, margin.tolist(), strict=True)
    )


def _opened(mask: np.ndarray, steps_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """Morphological opening by a ball: what is thinner than twice the radius goes."""
    from scipy import ndimage

    inner = ndimage.distance_transform_edt(np.pad(mask, 1), sampling=steps_mm)
    inner = inner[1:-1, 1:-1, 1:-1] > radius_mm
    if not inner.any():
        return np.zeros_like(mask)
    return mask & (ndimage.distance_transform_edt(~inner, sampling=steps_mm) <= radius_mm)


def _number_by_volume(organ: np.ndarray, tumors: list[np.ndarray]) -> UInt8[np.ndarray, "i j k"]:
    if len(tumors) > 254:
        raise InputError(f"{len(tumors)} tumors found; raise --min-tumor-ml or check --tumor-hu.")
    labels = np.where(organ, ORGAN, 0).astype(np.uint8)
    order = sorted(range(len(tumors)), key=lambda n: -int(tumors[n].sum()))
    for number, n in enumerate(order, FIRST_TUMOR):
        labels[tumors[n]] = number
    return labels
