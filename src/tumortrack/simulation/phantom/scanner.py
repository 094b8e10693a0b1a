"""A virtual CT scanner: label map -> CT volume with table and registration block, blurred by the
point-spread function and the voxel size, with correlated Gaussian noise. Beam hardening, scatter
and streaks are not modelled."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32
from scipy import ndimage
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, spacing_mm, transform_points
from tumortrack.core.types import ORGAN, LabelVolume, Volume

AIR_HU = -1000.0
_LOWEST_HU, _HIGHEST_HU = -1024, 3071  # the 12 bits of a clinical scanner
_LARGEST_SCAN = 400_000_000  # voxels

_Object = tuple[np.ndarray, np.ndarray, float]  # lower and upper corner, HU


class ScannerParameters(Config, frozen=True):
    """Materials, objects next to the phantom, and the scanner's resolution and noise.

    Organ: 10 % PVA hydrogel, like soft tissue (doi 10.1088/0031-9155/55/4/018). Tumors: 2.27 %
    BaSO4 by weight, which adds some 550 HU (NIST XCOM at 60 keV). Block: polyoxymethylene,
    intentionally inside the tumor window."""

    organ_hu: float = 40.0
    tumor_hu: float = 570.0
    spacing_mm: tuple[float, float, float] = (0.6, 0.6, 0.8)
    margin_mm: float = 12.0
    """Of air around the label map; the table ends with the field of view."""
    tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotates the voxel grid about the patient's x, y, z axes: an oblique volume."""
    psf_sigma_mm: float = 0.65
    noise_hu: float = 14.0
    noise_correlation_voxels: float = 0.7
    table_hu: float = -80.0
    """A thin carbon skin; thickness 0: no table."""
    table_thickness_mm: float = 2.0
    table_gap_mm: float = 4.0
    """A foam pad, like air, between phantom and table."""
    block_hu: float = 340.0
    block_size_mm: tuple[float, float, float] = (22.0, 22.0, 40.0)
    """Left-right, anterior-posterior, superior-inferior; 0: no block."""
    block_gap_mm: float = 14.0
    """Between the label map's box and the block, on the patient's right."""

    def __post_init__(self) -> None:
        hu, extent = (AIR_HU, 3000), (0, 200)
        self.check_between("scan:", organ_hu=hu, tumor_hu=hu, table_hu=hu, block_hu=hu)
        self.check_between("scan:", spacing_mm=(0.2, 10), tilt_deg=(-180, 180), noise_hu=extent)
        lengths = ("margin_mm", "table_thickness_mm", "table_gap_mm", "block_gap_mm")
        others = ("block_size_mm", "psf_sigma_mm", "noise_correlation_voxels")
        self.check_between("scan:", **dict.fromkeys((*lengths, *others), extent))


def scan(
    labels: LabelVolume,
    parameters: ScannerParameters,
    seed: int,
    material_hu: Mapping[int, float] | None = None,
) -> Volume:
    """Scan the box around a label map: 1 is hydrogel, 2 and above tumor with contrast, 0 air;
    ``material_hu`` overrides them by label. HU are whole numbers in -1024..3071; the same seed
    gives the same volume. Raises InputError: an empty map, or more than 400 million voxels."""
    body = _crop(labels)
    ends = np.indices((2, 2, 2)).reshape(3, -1).T * (np.array(body.labels.shape) - 1.0)
    corners = transform_points(body.lps_from_index, ends)
    box_mm = np.stack([corners.min(0), corners.max(0)])  # of voxel centres
    objects = _objects(box_mm, parameters)
    lps_from_index, shape = _field_of_view(box_mm, objects, parameters)
    sigma_mm = _blur_mm(np.eye(3), lps_from_index, parameters)
    hu = _scan_labels(body, lps_from_index, shape, parameters, material_hu or {})
    for box in objects:
        _add_box(hu, lps_from_index, box, sigma_mm)
    hu += _noise(shape, parameters, seed)
    return Volume(np.clip(np.rint(hu), _LOWEST_HU, _HIGHEST_HU), lps_from_index)


def _crop(labels: LabelVolume) -> LabelVolume:
    """The map's box around all labels, with an empty voxel on every side."""
    if not labels.labels.any():
        raise InputError("the label map is empty (0 everywhere); there is nothing to scan.")
    box = ndimage.find_objects((labels.labels > 0).astype(np.uint8))[0]
    lps_from_crop = labels.lps_from_index.copy()
    lps_from_crop[:3, 3] += lps_from_crop[:3, :3] @ [side.start - 1 for side in box]
    return LabelVolume(np.pad(labels.labels[box], 1), lps_from_crop)


def _objects(box_mm: np.ndarray, parameters: ScannerParameters) -> list[_Object]:
    """Table and block as (lower, upper, HU) boxes along the LPS axes."""
    objects, block = [], np.array(parameters.block_size_mm)
    lower, upper = box_mm.copy()
    if block.min() > 0:
        # It stands on the pad next to the phantom, a little towards the feet.
        right_mm, middle_mm = lower[0] - parameters.block_gap_mm, box_mm.mean(0)[2]
        corner = np.array([right_mm, upper[1], middle_mm - 5 + block[2] / 2])
        objects.append((corner - block, corner, parameters.block_hu))
        lower[0] = corner[0] - block[0]
    if parameters.table_thickness_mm > 0:
        top_mm = upper[1] + parameters.table_gap_mm
        lower, upper = lower - parameters.margin_mm, upper + parameters.margin_mm
        lower[1], upper[1] = top_mm, top_mm + parameters.table_thickness_mm
        objects.append((lower, upper, parameters.table_hu))
    return objects


def _field_of_view(
    box_mm: np.ndarray, objects: list[_Object], parameters: ScannerParameters
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """``lps_from_index`` and shape of a grid that holds everything, tilted as requested."""
    lower = np.min([box_mm[0] - parameters.margin_mm, *(o[0] - 4 for o in objects)], axis=0)
    upper = np.max([box_mm[1] + parameters.margin_mm, *(o[1] + 4 for o in objects)], axis=0)
    rotation = Rotation.from_euler("xyz", parameters.tilt_deg, degrees=True).as_matrix()
    half_mm = np.abs(rotation.T) @ ((upper - lower) / 2)
    spacing = np.array(parameters.spacing_mm)
    counts = np.ceil(2 * half_mm / spacing).astype(int) + 1
    if counts.prod() > _LARGEST_SCAN:
        raise InputError(
            f"the scan would have {' x '.join(map(str, counts))} voxels; at most 400 million are "
            "allowed. Choose a larger spacing_mm, or a label map of one organ."
        )
    origin = (lower + upper) / 2 - rotation @ (spacing * (counts - 1) / 2)
    i, j, k = counts.tolist()
    return rigid(rotation, origin) @ np.diag([*spacing, 1.0]), (i, j, k)


def _blur_mm(
    axes: np.ndarray, lps_from_index: np.ndarray, parameters: ScannerParameters
) -> np.ndarray:
    """Standard deviation of the blur along three directions (columns, LPS): point spread, and
    averaging over a voxel, which has the variance h^2/12."""
    voxel = ((axes.T @ lps_from_index[:3, :3]) ** 2).sum(1) / 12
    return np.sqrt(parameters.psf_sigma_mm**2 + voxel)


def _scan_labels(
    body: LabelVolume,
    lps_from_index: np.ndarray,
    shape: tuple[int, int, int],
    parameters: ScannerParameters,
    material_hu: Mapping[int, float],
) -> Float32[np.ndarray, "i j k"]:
    """The label map's HU, blurred on its own grid and resampled to the scanner's."""
    hu_of_label = np.full(256, parameters.tumor_hu, np.float32)
    hu_of_label[[0, ORGAN, *material_hu]] = [AIR_HU, parameters.organ_hu, *material_hu.values()]
    spacing = spacing_mm(body.lps_from_index)
    directions = body.lps_from_index[:3, :3] / spacing
    sigma = _blur_mm(directions, lps_from_index, parameters) / spacing
    pad = int(np.ceil(4 * sigma.max())) + 1
    padded = np.pad(hu_of_label[body.labels], pad, constant_values=AIR_HU)
    body_from_index = np.linalg.inv(body.lps_from_index) @ lps_from_index
    blurred = ndimage.gaussian_filter(padded, sigma, mode="nearest")
    matrix, offset = body_from_index[:3, :3], body_from_index[:3, 3] + pad
    return ndimage.affine_transform(
        blurred, matrix, offset, shape, np.float32, order=1, mode="constant", cval=AIR_HU
    )


def _add_box(
    hu: np.ndarray, lps_from_index: np.ndarray, box: _Object, sigma_mm: np.ndarray
) -> None:
    """Add a box along the LPS axes, blurred exactly: a product of three error functions."""
    lower, upper = (np.asarray(corner, np.float32) for corner in box[:2])
    sigma = np.maximum(sigma_mm, 1e-6).astype(np.float32)
    i, j = (np.arange(n, dtype=np.float32) for n in hu.shape[:2])
    a = lps_from_index.astype(np.float32)
    for k in range(hu.shape[2]):
        share = np.full(hu.shape[:2], box[2] - AIR_HU, np.float32)
        for axis in range(3):
            at = a[axis, 0] * i[:, None] + a[axis, 1] * j + (a[axis, 2] * k + a[axis, 3])
            share *= ndtr((at - lower[axis]) / sigma[axis]) - ndtr((at - upper[axis]) / sigma[axis])
        hu[:, :, k] += share


def _noise(shape: tuple[int, ...], parameters: ScannerParameters, seed: int) -> np.ndarray:
    """Gaussian noise of the stated standard deviation, correlated between neighbouring voxels."""
    noise = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)
    width = parameters.noise_correlation_voxels
    impulse = np.zeros(1 + 2 * int(np.ceil(5 * width)))
    impulse[len(impulse) // 2] = 1.0
    kernel = ndimage.gaussian_filter1d(impulse, width) if width > 0 else impulse
    for axis in range(3):  # a kernel of unit energy keeps the standard deviation
        noise = ndimage.correlate1d(noise, kernel / np.linalg.norm(kernel), axis, mode="wrap")
    return noise * np.float32(parameters.noise_hu)
