"""The geometry of the built-in kidney phantom: parameters -> labels.

The organ is an implicit surface in the organ frame: axes as in LPS, origin at the centre of the
organ's box, mm. It is a right kidney: long axis superior-inferior, hilum medial (+x, patient left)
and slightly anterior. Its poles differ and its lumps are irregular, so that it has no symmetry
under rotation or reflection. Sizes follow the paper's hydrogel phantom (one endophytic, one
exophytic tumor); the shape is our own.
"""

from __future__ import annotations

import itertools
from typing import Literal

import numpy as np
from jaxtyping import Float

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import FIRST_TUMOR, ORGAN, LabelVolume

_LARGEST_GRID = 50_000_000  # voxels
_RIM_MM = 7.0  # width of the hilum's rounded rim

# The three axes of a grid in the organ frame, mm.
Axes = tuple[Float[np.ndarray, " i"], Float[np.ndarray, " j"], Float[np.ndarray, " k"]]

SMALLEST_GAP_MM = 3.0  # between tumors: closer ones merge in a CT's partial-volume rim


class TumorParameters(Config, frozen=True):
    """A lobulated ball, ``diameter_mm`` across in every direction."""

    diameter_mm: float
    center_mm: tuple[float, float, float]
    """Organ frame (medial is +x for a right kidney; a left one is mirrored with its tumors)."""
    lobulation: float = 0.08
    """Largest deviation from a ball, relative to the radius."""

    def __post_init__(self) -> None:
        self.check_between("tumor:", diameter_mm=(2, 120), lobulation=(0, 0.2))
        self.check_between("tumor:", center_mm=(-200, 200))

    @property
    def radius_mm(self) -> float:
        """The largest."""
        return self.diameter_mm / 2 * (1 + self.lobulation)


class PhantomParameters(Config, frozen=True):
    """The shape; by default the paper's phantom."""

    size_mm: tuple[float, float, float] = (60.0, 50.0, 110.0)
    """The organ's box without tumors: left-right, anterior-posterior, superior-inferior."""
    bend_mm: float = 12.0
    """How far the poles lean medially."""
    taper: float = 0.10
    """How much thicker the superior pole is, and how much thinner the inferior one."""
    hilum_depth_mm: float = 18.0
    """Depth of the carved slot; with its rounded rim the dent is some 4 mm shallower."""
    lump_mm: float = 1.2
    shape_seed: int = 1
    """Places the lumps of the organ and the lobes of the tumors."""
    tumors: tuple[TumorParameters, ...] = (
        TumorParameters(diameter_mm=38.0, center_mm=(-3.0, 1.0, 17.0)),
        TumorParameters(diameter_mm=32.0, center_mm=(-17.0, -15.5, -22.0)),
    )
    side: Literal["left", "right"] = "right"
    center_lps_mm: tuple[float, float, float] = (-62.0, 38.0, -45.0)

    def __post_init__(self) -> None:
        self.check_between("phantom:", size_mm=(20, 250), bend_mm=(0, 25), taper=(0, 0.3))
        self.check_between("phantom:", hilum_depth_mm=(0, 25), lump_mm=(0, 2))
        for a, b in itertools.combinations(self.tumors, 2):
            if gap_mm(a, b) < SMALLEST_GAP_MM:
                raise InputError(
                    f"the tumors of {a.diameter_mm} and {b.diameter_mm} mm may come within "
                    f"{gap_mm(a, b):.1f} mm of one another; place them {SMALLEST_GAP_MM} mm or "
                    "more apart."
                )


def phantom_labels(parameters: PhantomParameters, voxel_mm: float = 0.8) -> LabelVolume:
    """The phantom on an isotropic grid along the LPS axes; tumors are labelled by diameter, the
    largest first. Raises InputError: ``voxel_mm`` outside 0.2..4, more than 50 million voxels, or a
    tumor wholly outside the organ."""
    if not 0.2 <= voxel_mm <= 4:
        raise InputError(f"voxel size {voxel_mm} mm: allowed are 0.2 to 4 mm.")
    upper_mm = np.array(parameters.size_mm) / 2
    lower_mm = -upper_mm
    for tumor in parameters.tumors:
        lower_mm = np.minimum(lower_mm, np.array(tumor.center_mm) - tumor.radius_mm)
        upper_mm = np.maximum(upper_mm, np.array(tumor.center_mm) + tumor.radius_mm)
    counts = np.ceil((upper_mm - lower_mm + 8) / voxel_mm).astype(int) + 1
    if counts.prod() > _LARGEST_GRID:
        raise InputError(
            f"the phantom would have {' x '.join(map(str, counts))} voxels; at most 50 million are "
            "allowed. Choose a larger voxel size."
        )
    start_mm = (lower_mm + upper_mm) / 2 - (counts - 1) / 2 * voxel_mm
    x, y, z = (s + voxel_mm * np.arange(n) for s, n in zip(start_mm, counts, strict=True))
    axes = (x, y, z)
    inside = organ_field(parameters, axes) < 0
    labels = np.where(inside, ORGAN, 0).astype(np.uint8)
    for n, field in enumerate(tumor_fields(parameters, axes)):
        mask = field < 0
        if not (mask & inside).any():
            raise InputError(
                f"tumor {n + 1} lies wholly outside the organ; move its center_mm inwards."
            )
        labels[mask] = FIRST_TUMOR + n

    lps_from_index = np.diag([voxel_mm, voxel_mm, voxel_mm, 1.0])
    lps_from_index[:3, 3] = np.array(parameters.center_lps_mm) + start_mm
    if parameters.side == "left":  # mirror the body, keep the axes' directions
        labels = labels[::-1]
        lps_from_index[0, 3] = parameters.center_lps_mm[0] - x[-1]
    return LabelVolume(labels, lps_from_index)


def gap_mm(a: TumorParameters, b: TumorParameters) -> float:
    """A lower bound of the distance between two tumors' surfaces."""
    distance_mm = np.linalg.norm(np.subtract(a.center_mm, b.center_mm))
    return float(distance_mm - (a.radius_mm + b.radius_mm))


def organ_field(parameters: PhantomParameters, axes_mm: Axes) -> Float[np.ndarray, "i j k"]:
    """Approximate signed distance to the organ without its tumors, negative inside, on the grid of
    three axes (organ frame, mm)."""
    x, y, z = (np.linspace(-0.75 * length, 0.75 * length, 65) for length in parameters.size_mm)
    unscaled = (x, y, z)
    field = _unscaled_field(parameters, unscaled)
    scaled = []
    # Bending, hilum and lumps change the box: scale each axis so that it has the stated size.
    for axis, length_mm in enumerate(parameters.size_mm):
        others = tuple(other for other in range(3) if other != axis)
        nearest, at_mm, ends = field.min(axis=others), unscaled[axis], []
        inside = np.flatnonzero(nearest < 0)
        for inner, outer in ((inside[0], inside[0] - 1), (inside[-1], inside[-1] + 1)):
            t = nearest[inner] / (nearest[inner] - nearest[outer])
            ends.append(float(at_mm[inner] + t * (at_mm[outer] - at_mm[inner])))
        scaled.append(np.asarray(axes_mm[axis]) * (np.diff(ends)[0] / length_mm) + sum(ends) / 2)
    x, y, z = scaled
    return _unscaled_field(parameters, (x, y, z))


def _unscaled_field(parameters: PhantomParameters, axes_mm: Axes) -> Float[np.ndarray, "i j k"]:
    x, y, z = np.meshgrid(*axes_mm, indexing="ij", sparse=True)
    rx, ry, rz = np.array(parameters.size_mm) / 2
    along = z / rz
    # Bend and thickness vary along the organ; the cubic term makes the poles differ.
    spine_mm = parameters.bend_mm * (along**2 + 0.25 * along**3 - 0.35)
    thickness = 1 + parameters.taper * np.tanh(1.5 * along)
    body = _ellipsoid(
        ((x - spine_mm) / thickness, (y + 1.5 * along) / thickness, z), (rx, ry, rz), power=2.3
    )
    # The renal sinus: a slot from the medial side, slightly from the front
    turn = np.deg2rad(32.0)
    u = (x - rx - 2) * np.cos(turn) - (y + 8) * np.sin(turn)
    v = (x - rx - 2) * np.sin(turn) + (y + 8) * np.cos(turn)
    slot = _ellipsoid((u, v, z + 4), (parameters.hilum_depth_mm + 4, 9.0, 0.33 * rz), power=2.0)
    # Polynomial smooth maximum, which rounds the rim
    blend = np.clip(_RIM_MM - np.abs(body + slot), 0, None)
    carved = np.maximum(body, -slot) + blend**2 / (4 * _RIM_MM)
    return carved + _lumps(parameters, (x, y, z))


def _ellipsoid(point: tuple[np.ndarray, ...], radii: tuple[float, ...], power: float) -> np.ndarray:
    """Approximate signed distance to a superellipsoid: value over gradient length."""
    scaled = [np.abs(p) / r for p, r in zip(point, radii, strict=True)]
    norm = sum(s**power for s in scaled) ** (1 / power) + 1e-9
    gradient = [(s / norm) ** (power - 1) / r for s, r in zip(scaled, radii, strict=True)]
    return (norm - 1) / (np.sqrt(sum(g**2 for g in gradient)) + 1e-9)


def _lumps(parameters: PhantomParameters, point_mm: tuple[np.ndarray, ...]) -> np.ndarray:
    """Waves of 30 to 60 mm in random directions, their sum at most ``lump_mm``."""
    rng = np.random.default_rng((parameters.shape_seed, 0))
    total = np.zeros(np.broadcast_shapes(*(p.shape for p in point_mm)))
    for _ in range(4):
        direction = rng.normal(size=3)
        wave = direction / np.linalg.norm(direction) * 2 * np.pi / rng.uniform(30, 60)
        phase = rng.uniform(0, 2 * np.pi)
        angle = sum(w * p for w, p in zip(wave, point_mm, strict=True))
        total += np.sin(angle + phase) * parameters.lump_mm / 4
    return total


def tumor_fields(parameters: PhantomParameters, axes_mm: Axes) -> list[Float[np.ndarray, "i j k"]]:
    """Approximate signed distance to each tumor, in label order, as in ``organ_field``."""
    fields = []
    largest_first = sorted(parameters.tumors, key=lambda tumor: -tumor.diameter_mm)
    for number, tumor in enumerate(largest_first):
        rng = np.random.default_rng((parameters.shape_seed, 1, number))
        waves = rng.normal(size=(3, 3))
        waves *= 4.0 / np.linalg.norm(waves, axis=1, keepdims=True)
        offsets = [a - c for a, c in zip(axes_mm, tumor.center_mm, strict=True)]
        x, y, z = np.meshgrid(*offsets, indexing="ij", sparse=True)
        distance_mm = np.sqrt(x**2 + y**2 + z**2)
        length_mm = np.maximum(distance_mm, 1e-9)
        # An odd function: one side gains what the opposite side loses, so diameters are exact.
        lobes = sum(np.sin((a * x + b * y + c * z) / length_mm) for a, b, c in waves) / 3
        fields.append(distance_mm - tumor.diameter_mm / 2 * (1 + tumor.lobulation * lobes))
    return fields
