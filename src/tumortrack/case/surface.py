"""Smooth closed surfaces from labels: marching cubes (Lewiner et al. 2003, scikit-image) on a
blurred, resampled mask of each part, at the level where the mesh has the labels' volume."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm, transform_points
from tumortrack.core.grid import extent_mm, tight_box, voxel_ml
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.types import FIRST_TUMOR, Anatomy, LabelVolume, Mesh, part_names

_TRIANGLES = 28_000  # of the organ, about
_LARGE_MM3 = 8e5  # of an organ that needs no grid as fine as 1.5 mm
_BLUR_VOXELS = 0.9  # enough to remove steps of one voxel, too little to lose a small tumor
_STEPS_ACROSS = 14  # cells across the thinnest extent of a small part
_MOST_MARCHES = 16  # 2 to 4 suffice where the volume is a smooth function of the level
_REPORTED = ["labels_ml", "mesh_ml", "change_percent"]
_REPORTED += ["distance_mean_voxels", "distance_95_voxels", "distance_max_voxels"]


def surfaces(
    label_volume: LabelVolume, organ_kind: Organ = KIDNEY
) -> tuple[Anatomy, dict[str, list[Any]]]:
    """The organ's surface (all labels from 1 up) and one per tumor, LPS mm, faces outward; and a
    report: lists with an entry per part, ``names``, ``labels_ml``, ``mesh_ml``, ``change_percent``,
    ``dropped_ml``: of pieces that hang together by too little to stay joined on a smooth surface,
    and the vertices' distances to the labels' boundary, ``distance_mean_voxels``, ... Raises
    InputError: no organ, a gap in the tumor numbers, or a part too small for a surface."""
    labels, affine = label_volume.labels, label_volume.lps_from_index
    top = int(labels.max())
    if top == 0:
        raise InputError("the labels are empty: no organ to take a surface of.")
    masks = [labels > 0, *(labels == n for n in range(FIRST_TUMOR, top + 1))]
    names = part_names(len(masks), organ_kind.name)
    # The grid step for about that number of triangles, 2.2 per cell face
    volume_mm3 = 1000 * float(masks[0].sum()) * voxel_ml(affine)
    area_mm2 = 1.35 * 4.836 * volume_mm3 ** (2 / 3)  # a kidney has 1.35 times a sphere's area
    coarsest = 1.5 * max(1.0, volume_mm3 / _LARGE_MM3)
    step = float(np.clip(np.sqrt(2.2 * area_mm2 / _TRIANGLES), 0.4, coarsest))
    parts, rows, dropped_mm3 = [], [], list[float]()
    for name, mask in zip(names, masks, strict=True):
        if not mask.any():
            raise InputError(f"the labels have no voxel of {name}; number the tumors without gap.")
        parts.append(mesh := surface_of(name, mask, affine, step, dropped_mm3=dropped_mm3))
        ml, distance = float(mask.sum()) * voxel_ml(affine), _boundary_distance(mesh, mask, affine)
        figures = distance.mean(), np.percentile(distance, 95), distance.max()
        rows.append((ml, mesh.volume_ml, 100 * (mesh.volume_ml / ml - 1), *figures))
    columns = [[round(float(x), 4) for x in column] for column in zip(*rows, strict=True)]
    report: dict[str, list[Any]] = {
        "names": list(names),
        "dropped_ml": [round(mm3 / 1000, 4) for mm3 in dropped_mm3],
        **dict(zip(_REPORTED, columns, strict=True)),
    }
    return Anatomy(tuple(parts), organ_kind), report


def surface_of(
    name: str,
    mask: np.ndarray,
    affine: np.ndarray,
    step_mm: float,
    keep: Callable[[Mesh], Mesh] | None = None,
    dropped_mm3: list[float] | None = None,
) -> Mesh:
    """The closed surface of a mask, LPS mm, faces outward, with the mask's volume. ``keep`` selects
    pieces; None: the largest, and what the others have is added to ``dropped_mm3``. Raises
    InputError: the mask is too small or thin for a surface."""
    spacing = spacing_mm(affine)
    box = tight_box(mask)
    step_mm = min(step_mm, float(extent_mm(box, spacing).min()) / _STEPS_ACROSS)
    blur = np.maximum(_BLUR_VOXELS, 0.6 * step_mm / spacing)
    margin = np.ceil(4 * blur + 2).astype(int)
    field = np.pad(mask[box].astype(np.float32), [(m, m) for m in margin.tolist()])
    field = ndimage.gaussian_filter(field, blur, truncate=4.0)
    count = np.ceil((np.array(field.shape) - 1) * spacing / step_mm).astype(int) + 1
    field = ndimage.zoom(field, count / np.array(field.shape), order=3, grid_mode=False)
    scale = (np.array(mask[box].shape) + 2 * margin - 1) / (np.array(field.shape) - 1)
    offset = np.array([s.start for s in box]) - margin
    cell_mm3 = abs(float(np.linalg.det(affine[:3, :3] * scale)))
    wanted_mm3 = 1000 * float(mask.sum()) * voxel_ml(affine)

    # A first guess: the level that as many cells exceed as make the volume.
    level = float(-np.partition(-field.ravel(), n := int(wanted_mm3 / cell_mm3))[n])

    def march(level: float) -> tuple[Mesh, float, float]:
        from skimage import measure

        if not field.min() < level < field.max():
            raise InputError(f"{name} is too small or thin for a surface at this voxel size.")
        vertices, faces, _, _ = measure.marching_cubes(field, level, gradient_direction="ascent")
        vertices_mm = transform_points(affine, vertices.astype(np.float64) * scale + offset)
        mesh = Mesh(vertices_mm, faces[:, ::-1] if np.linalg.det(affine[:3, :3]) < 0 else faces)
        whole_mm3 = abs(mesh.volume_mm3)
        mesh = (keep or largest_shell)(mesh)
        mesh = mesh if mesh.volume_mm3 > 0 else Mesh(mesh.vertices_mm, mesh.faces[:, ::-1])
        return mesh, mesh.volume_mm3 / wanted_mm3 - 1, max(0.0, whole_mm3 - mesh.volume_mm3)

    mesh, lost_mm3 = _keep_volume(march, level, float(field.max()))
    if dropped_mm3 is not None:
        dropped_mm3.append(lost_mm3)
    return mesh


def _keep_volume(
    march: Callable[[float], tuple[Mesh, float, float]], level: float, highest: float
) -> tuple[Mesh, float]:
    """The mesh with the smallest error of volume, and what other pieces have, mm3: secant steps on
    the level, else bisection.

    The volume falls with the level, but may jump where a piece comes off; then no level is exact.
    """
    too_large, too_small = 0.0, highest
    tried: list[tuple[float, float]] = []
    for _ in range(_MOST_MARCHES):
        mesh, error, lost_mm3 = march(level)
        if all(abs(error) < abs(other) for _, other in tried):
            best = mesh, lost_mm3
        tried.append((level, error))
        if error > 0:
            too_large = level
        else:
            too_small = level
        if abs(error) < 2e-4 or too_small - too_large < 1e-3 * highest:
            break
        slope = -3.0
        if len(tried) > 1:
            slope = min(-0.1, (error - tried[-2][1]) / (level - tried[-2][0]))
        level -= error / slope
        if len(tried) > 5 or not too_large < level < too_small:
            level = (too_large + too_small) / 2
    return best


def _boundary_distance(mesh: Mesh, mask: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Distance of each vertex (4,000 of them at most) to the nearest face between mask and
    background, in units of a voxel's longest edge. Faces are sampled at 5 x 5 points, so that it is
    at most a tenth of a voxel too long."""
    box = tight_box(mask)
    padded = np.pad(mask[box], 1)
    raster = np.stack(np.meshgrid(*[np.linspace(-0.4, 0.4, 5)] * 2), -1).reshape(-1, 2)
    points = []
    for axis in range(3):
        low = np.argwhere(np.diff(padded.astype(np.int8), axis=axis) != 0) - 1.0
        low += [s.start for s in box]
        shift = np.insert(raster, axis, 0.5, axis=1)
        points.append((low[:, None] + shift).reshape(-1, 3))
    # A tree that is quick to build: points are many and queries few.
    places = transform_points(affine, np.concatenate(points))
    tree = cKDTree(places, balanced_tree=False, compact_nodes=False)
    vertices = mesh.vertices_mm[:: max(1, len(mesh.vertices_mm) // 4000)]
    return tree.query(vertices)[0] / float(spacing_mm(affine).max())


def largest_shell(mesh: Mesh) -> Mesh:
    """The connected piece with the largest absolute volume, without shells inside it and specks."""
    return next(shells(mesh), mesh)


def shells(mesh: Mesh) -> Iterator[Mesh]:
    """Connected pieces, the largest absolute volume first; walls of cavities have negative ones."""
    if len(mesh.faces) == 0:
        return
    i, j, k = mesh.faces.T
    n = len(mesh.vertices_mm)
    graph = coo_array((np.ones(2 * len(i), np.int8), (np.r_[i, j], np.r_[j, k])), shape=(n, n))
    piece = connected_components(graph, directed=False)[1][i]
    a, b, c = (mesh.vertices_mm[corner] - mesh.vertices_mm[0] for corner in (i, j, k))
    volumes = np.bincount(piece, np.einsum("ij,ij->i", a, np.cross(b, c)))  # times 6, signed
    if np.count_nonzero(volumes) == 1 and np.bincount(mesh.faces.ravel(), minlength=n).all():
        yield mesh  # all of it
        return
    for number in np.argsort(-np.abs(volumes)):
        if volumes[number]:  # vertices without faces have none
            used, compact = np.unique(mesh.faces[piece == number], return_inverse=True)
            yield Mesh(mesh.vertices_mm[used], compact.reshape(-1, 3))
