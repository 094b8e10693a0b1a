"""Random organs with random tumors: other organs than the model's, and for tests.

Each is the built-in phantom's implicit surface with parameters of its own, turned at random in the
CT and seen from a random side: kidneys; and, roughly, livers (large, bent, with a cleft between
lobes) and prostates (small, round). Nothing in them comes from a patient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from tumortrack.core.errors import TumortrackError
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.simulation.phantom import digital

_STEP_MM = 2.0  # of the grid that surfaces are drawn from
_MARGIN_MM = 6.0
_MOST_TUMORS = 3
_SIDEWAYS_DEG = 60.0  # between anterior and the side that faces the camera, at most
_ATTEMPTS = 100
_FIELD_LIMIT_MM = 2 * _STEP_MM  # vertices lie where neighbouring nodes differ in sign


Range = tuple[float, float]


@dataclass(frozen=True)
class Shape:
    """Ranges, mm; ``across``: width and thickness over the length; ``tumor_mm``: diameters."""

    organ: Organ
    length_mm: Range
    across: tuple[Range, Range]
    bend_mm: Range
    taper: float
    cleft_mm: Range
    tumor_mm: Range


SHAPES = {
    "kidney": Shape(
        KIDNEY, (90, 130), ((0.45, 0.62), (0.38, 0.52)), (2, 18), 0.25, (6, 24), (10, 45)
    ),
    "liver": Shape(
        Organ("liver"), (150, 200), ((0.5, 0.7), (0.35, 0.5)), (10, 25), 0.3, (12, 25), (10, 45)
    ),
    "prostate": Shape(
        Organ("prostate"), (38, 55), ((0.95, 1.3), (0.7, 0.95)), (0, 2), 0.2, (0, 2), (6, 16)
    ),
}  # fmt: skip


def random_anatomy(
    seed: int, shape: Shape = SHAPES["kidney"]
) -> tuple[Anatomy, tuple[float, float, float]]:
    """An organ (a kidney of 90 to 130 mm) with one to three tumors (of 10 to 45 mm), deep or
    bulging, and the direction that faces the camera: CT frame (LPS), mm; closed surfaces, tumors in
    label order.

    The same seed gives the same organ. Raises InputError: a negative seed."""
    rng = np.random.default_rng([seed, 0x81D])
    parameters = _random_parameters(rng, shape)
    turn = Rotation.random(rng=rng).as_matrix()
    if rng.uniform() < 0.5:  # a left kidney: the mirror image
        turn = turn @ np.diag([-1.0, 1.0, 1.0])
    centre = rng.uniform(-100, 100, 3)
    fields, axes = _fields(parameters)
    parts = []
    for field in fields:
        mesh = _surface(field, axes)
        faces = mesh.faces if np.linalg.det(turn) > 0 else mesh.faces[:, ::-1]  # outward again
        parts.append(Mesh(mesh.vertices_mm @ turn.T + centre, faces))
    aside = Rotation.from_euler("z", rng.uniform(-_SIDEWAYS_DEG, _SIDEWAYS_DEG), degrees=True)
    x, y, z = turn @ aside.apply([0.0, -1.0, 0.0])
    return Anatomy(tuple(parts), shape.organ), (float(x), float(y), float(z))


def _random_parameters(rng: np.random.Generator, shape: Shape) -> digital.PhantomParameters:
    """The shape of a random organ and its tumors."""
    length = rng.uniform(*shape.length_mm)
    width, thickness = (length * rng.uniform(*share) for share in shape.across)
    size = width, thickness, length
    return digital.PhantomParameters(
        size_mm=size,
        bend_mm=rng.uniform(*shape.bend_mm),
        taper=rng.uniform(0, shape.taper),
        hilum_depth_mm=rng.uniform(*shape.cleft_mm),
        lump_mm=rng.uniform(0.3, 2.0),
        shape_seed=int(rng.integers(1 << 31)),
        tumors=_random_tumors(size, shape.tumor_mm, rng),
    )


def _random_tumors(
    size_mm: tuple[float, float, float], diameters_mm: Range, rng: np.random.Generator
) -> tuple[digital.TumorParameters, ...]:
    """Tumors that do not touch, with centres anywhere from the middle to the organ's surface."""
    wanted = int(rng.integers(1, _MOST_TUMORS + 1))
    tumors: list[digital.TumorParameters] = []
    for _ in range(_ATTEMPTS):
        direction = rng.normal(size=3)
        depth = rng.uniform(0.1, 0.95) * np.array(size_mm) / 2
        x, y, z = direction / np.linalg.norm(direction) * depth
        diameter = float(np.exp(rng.uniform(*np.log(diameters_mm))))
        tumor = digital.TumorParameters(diameter_mm=diameter, center_mm=(x, y, z))
        if all(digital.gap_mm(tumor, other) >= digital.SMALLEST_GAP_MM for other in tumors):
            tumors.append(tumor)
        if len(tumors) == wanted:
            break
    return tuple(tumors)


def _fields(parameters: digital.PhantomParameters) -> tuple[list[np.ndarray], digital.Axes]:
    """Approximate signed distances to the whole organ and to each tumor, on a grid round them."""
    reach = np.array(parameters.size_mm) / 2
    for tumor in parameters.tumors:
        reach = np.maximum(reach, np.abs(tumor.center_mm) + 0.6 * tumor.diameter_mm)
    reach = reach + _MARGIN_MM
    x, y, z = (np.arange(-length, length + _STEP_MM, _STEP_MM) for length in reach)
    tumors = digital.tumor_fields(parameters, (x, y, z))
    whole = np.minimum.reduce([digital.organ_field(parameters, (x, y, z)), *tumors])
    return [whole, *tumors], (x, y, z)


def _surface(field_mm: np.ndarray, axes: digital.Axes) -> Mesh:
    """The closed zero surface of a field, its largest piece, organ frame."""
    capped = np.clip(field_mm, -_FIELD_LIMIT_MM, _FIELD_LIMIT_MM)
    vertices, faces, _, _ = marching_cubes(capped, 0.0, spacing=(_STEP_MM,) * 3)
    pieces = trimesh.Trimesh(vertices, faces[:, ::-1]).split(only_watertight=True)
    if len(pieces) == 0:
        raise TumortrackError("a random kidney's surface is not closed; take another seed.")
    largest = max(pieces, key=lambda piece: abs(piece.volume))
    mesh = Mesh(largest.vertices + [axis[0] for axis in axes], largest.faces)
    return mesh if mesh.volume_mm3 > 0 else Mesh(mesh.vertices_mm, mesh.faces[:, ::-1])
