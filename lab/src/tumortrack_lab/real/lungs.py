"""Breathing lungs: measured displacement fields, applied to kidneys.

Landmark pairs of ten patients (DIR-QA: Fu et al. 2019, doi 10.1002/mp.13726; GPL-3, they stay with
the user): the same vessel branches at the ends of exhalation and inhalation, as voxel indices
(row, column, slice). The spacings are those of the images (Castillo et al. 2009,
doi 10.1088/0031-9155/54/7/001); with them the 300 pairs of the older set have the published mean
displacements to 0.01 mm, and lungs are wider from left to right than from front to back. Which way
a column runs is not stated; the patient's left is taken, as in most CTs.

Lungs are compressible and full of air, and lobes slide; kidneys do neither. So this tests how a
method copes with real deformations of another kind than its own, not how well it does on kidneys.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator
from scipy.io import loadmat
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points, rigid, transform_points
from tumortrack.core.rigid_fit import fit_over_volume
from tumortrack.core.types import Mesh

# Of the images by patient, mm: along rows and columns; slices are 2.5 mm apart.
IN_PLANE_MM = (0.97, 1.16, 1.15, 1.13, 1.10, 0.97, 0.97, 0.97, 0.97, 0.97)
SLICE_MM = 2.5
PATIENTS = range(1, len(IN_PLANE_MM) + 1)
# Chosen on left-out pairs of five patients: medians of 0.31 to 0.61 mm with 10 and 100, 0.44 to
# 0.99 mm with 10,000.
SMOOTHING = 100.0
HELD_OUT = 0.1
WITHIN_MM, WITHIN_SHARE = 15.0, 0.95  # so much of the organ has a landmark so near
SCALES = (1.0, 0.8, 0.65)  # of the kidney in the lung, the first that finds a place
PLACES = 200  # tried at each scale
# Amplitude, and whether the organ as a whole keeps its volume, as a kidney does.
VARIANTS = {
    "as in the lung": (1.0, False),
    "volume kept": (1.0, True),
    "volume kept, twice": (2.0, True),
}
_STEP_MM = 0.5  # of difference quotients
WHERE = "the folder 'Dense Sets of Landmark Pairs' of https://github.com/deshanyang/DIR-QA"


class Landmarks(NamedTuple):
    """Where the same points are at the ends of exhalation and inhalation: LPS, mm."""

    exhaled_mm: Float[np.ndarray, "n 3"]
    inhaled_mm: Float[np.ndarray, "n 3"]


def landmark_file(data: Path, patient: int) -> Path:
    return data / "dirqa" / f"case{patient}.mat"


def read_landmarks(path: Path, patient: int) -> Landmarks:
    """Raises InputError: no such file, or not two tables of equally many finite indices."""
    if not path.is_file():
        raise InputError(f"{path} is missing: put a copy of {WHERE} there, as {path.parent}.")
    try:
        tables = loadmat(path)
        both = [np.asarray(tables[f"landmark_{phase}"], float) for phase in ("EE", "EI")]
    except (OSError, ValueError, KeyError, NotImplementedError) as error:
        raise InputError(f"{path} has no landmark_EE and landmark_EI: {error}.") from error
    exhaled, inhaled = both
    if exhaled.shape != inhaled.shape or exhaled.shape[1:] != (3,) or not np.isfinite(both).all():
        raise InputError(
            f"{path}: landmarks of shapes {exhaled.shape} and {inhaled.shape}, or not finite."
        )
    across_mm = IN_PLANE_MM[patient - 1]
    # row: to the back; column: to the left; slice: to the feet
    scaled = (table[:, [1, 0, 2]] * [across_mm, across_mm, -SLICE_MM] for table in both)
    return Landmarks(*scaled)


@dataclass(frozen=True, eq=False)
class Field:
    """A patient's smooth displacement from exhalation to inhalation: a thin-plate spline through
    its landmarks, smoothed."""

    landmarks: Landmarks
    smoothing: float = SMOOTHING

    @cached_property
    def at(self) -> RBFInterpolator:
        """Called with points: their displacements, mm."""
        rest_mm, there_mm = self.landmarks
        kernel = "thin_plate_spline"
        return RBFInterpolator(rest_mm, there_mm - rest_mm, smoothing=self.smoothing, kernel=kernel)


def held_out_mm(
    landmarks: Landmarks, smoothing: float, rng: np.random.Generator
) -> Float[np.ndarray, " n"]:
    """Errors, mm, at a tenth of the pairs, of a field fitted to the others."""
    out = np.zeros(len(landmarks.exhaled_mm), bool)
    out[rng.choice(len(out), round(HELD_OUT * len(out)), replace=False)] = True
    field = Field(Landmarks(*(points_mm[~out] for points_mm in landmarks)), smoothing)
    rest_mm, there_mm = (points_mm[out] for points_mm in landmarks)
    return np.linalg.norm(rest_mm + field.at(rest_mm) - there_mm, axis=1)


@dataclass(frozen=True, eq=False)
class LungState:
    """A kidney (CT frame) as a piece of lung deforms. ``simulate.deform.base.Deformation``.

    A point x lies at centre_lung + scale R (x - centre_ct) in the lung, and is displaced there;
    ``back`` takes the rigid part out (that of least squares over the organ's volume), and with it
    the growth of the whole organ where its volume is kept. The rest is multiplied by ``amplitude``.
    """

    field: Field
    lung_from_ct: Float[np.ndarray, "4 4"]  # a rotation times scale, and a shift
    back: Float[np.ndarray, "4 4"]  # within the CT frame
    amplitude: float

    def apply(self, points_ct: Points) -> Points:
        points = np.asarray(points_ct, float)
        off_mm = transform_points(self.back, self._breathed(points)) - points
        return points + self.amplitude * off_mm

    def record(self) -> dict[str, Any]:
        return {"amplitude": self.amplitude, "lung_from_ct": self.lung_from_ct.tolist()}

    def _breathed(self, points_ct: Points) -> Points:
        lung_mm = transform_points(self.lung_from_ct, points_ct)
        turned = np.linalg.inv(self.lung_from_ct)[:3, :3]
        return points_ct + self.field.at(lung_mm) @ turned.T

    def stretch(self, points_ct: Points) -> Float[np.ndarray, " n"]:
        """The volume ratio at each point; 0 and below: space is folded over."""
        columns = [
            (self.apply(points_ct + step) - self.apply(points_ct - step)) / (2 * _STEP_MM)
            for step in _STEP_MM * np.eye(3)
        ]
        return np.linalg.det(np.stack(columns, axis=-1))


def states(field: Field, organ: Mesh, rng: np.random.Generator) -> dict[str, LungState]:
    """The organ (CT frame) at one place of the lung, in one orientation, by ``VARIANTS``. Raises
    InputError: no room for it between the landmarks."""
    lung_from_ct = place(field.landmarks.exhaled_mm, organ, rng)
    breathed = LungState(field, lung_from_ct, np.eye(4), 1.0).apply(organ.vertices_mm)
    rigid_back = fit_over_volume(organ.moved(breathed), organ)[0]
    shrink = float(np.cbrt(organ.volume_mm3 / organ.moved(breathed).volume_mm3))
    as_large = rigid(shrink * np.eye(3), (1 - shrink) * organ.box_mm.mean(0)) @ rigid_back
    return {
        name: LungState(field, lung_from_ct, as_large if kept else rigid_back, amplitude)
        for name, (amplitude, kept) in VARIANTS.items()
    }


def place(landmarks_mm: Points, organ: Mesh, rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    """A random pose of the organ among the landmarks, scaled down if there is no room."""
    tree, middle = cKDTree(landmarks_mm), organ.box_mm.mean(0)
    some = organ.vertices_mm[:: max(1, len(organ.vertices_mm) // 500)]
    for scale in SCALES:
        for _ in range(PLACES):
            linear = scale * Rotation.random(rng=rng).as_matrix()
            lung_from_ct = np.eye(4)
            lung_from_ct[:3, :3] = linear
            centre_mm = landmarks_mm[rng.integers(len(landmarks_mm))]
            lung_from_ct[:3, 3] = centre_mm - linear @ middle
            far_mm = tree.query(transform_points(lung_from_ct, some))[0]
            if (far_mm <= WITHIN_MM).mean() >= WITHIN_SHARE:
                return lung_from_ct
    raise InputError(f"no place for an organ even {SCALES[-1]:g} times its size in this lung.")
