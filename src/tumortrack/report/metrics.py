"""Metrics of an estimated anatomy against the true one. Pure functions, exact definitions.

Surface distances are measured from samples of one surface to the other surface itself (nearest
triangle, exact point-to-triangle distance), not to its vertices: libraries differ by millimetres
in HD95 and directed distances because they leave that open.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points, transform_points
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Anatomy, CameraLabels, Mesh
from tumortrack.imaging.raster import expand, label_grid
from tumortrack.simulate.scene_folder import Targets

# Vertices are sampled too, so the maximum misses at most s^2 / (8 R) where a flat piece of size s
# lies over a surface of radius R: 0.025 mm at R = 5 mm.
SPACING_MM = 1.0
_SEED_SPACING_MM = 2.0  # of the samples through which the nearest triangles are looked up
_NEIGHBOURS = 4  # triangles tried exactly for each sample


@dataclass(frozen=True)
class SurfaceDistances:
    """Distances between an estimated and a reference surface, mm.

    With d(p, S) the distance of a point to the nearest point of a surface S, E the estimate, R the
    reference:
    hausdorff: the larger of the two directed maxima, over p in E of d(p, R) and the other way;
    hausdorff_one_sided: the first of them alone, the paper's measure;
    hausdorff_95: the larger of the two directed 95th percentiles, each over surface area;
    surface: the mean of the two directed means, each over surface area.
    """

    hausdorff_mm: float
    hausdorff_one_sided_mm: float
    hausdorff_95_mm: float
    surface_mm: float


def surface_samples(
    mesh: Mesh, spacing_mm: float = SPACING_MM
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Points on a surface, the area each stands for, and the face it lies on.

    Deterministic: every triangle is cut into n^2 equal ones with edges <= spacing, whose centroids
    carry the area (mm^2). The vertices follow with area 0, so that extremes are included.
    """
    triangles = mesh.vertices_mm[mesh.faces]
    edges = triangles - np.roll(triangles, 1, axis=1)
    cuts = np.maximum(np.ceil(np.linalg.norm(edges, axis=2).max(1) / spacing_mm), 1).astype(int)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    face, cell = expand(cuts**2)
    n = cuts[face]
    # Row r of the cut triangle holds 2 r + 1 cells, pointing up (even) and down (odd) in turn.
    row = np.floor(np.sqrt(cell)).astype(int)
    place = cell - row**2
    down = place % 2
    u = (row - place // 2 - down + np.where(down, 2 / 3, 1 / 3)) / n
    v = (place // 2 + np.where(down, 2 / 3, 1 / 3)) / n
    a, b, c = (triangles[face, corner] for corner in range(3))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    corner_face = np.zeros(len(mesh.vertices_mm), int)
    corner_face[mesh.faces.reshape(-1)] = np.repeat(np.arange(len(mesh.faces)), 3)
    used = np.unique(mesh.faces)
    return (
        np.concatenate([points, mesh.vertices_mm[used]]),
        np.concatenate([area[face] / n**2, np.zeros(len(used))]),
        np.concatenate([face, corner_face[used]]),
    )


def triangle_distance(
    points_mm: Float[np.ndarray, "n 3"], triangles_mm: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, " n"]:
    """Exact distance of each point to its triangle (interior, edges and corners), mm."""
    from trimesh.triangles import closest_point  # slow to import

    return np.linalg.norm(points_mm - closest_point(triangles_mm, points_mm), axis=1)


def surface_distances(
    estimate: Mesh, reference: Mesh, spacing_mm: float = SPACING_MM
) -> SurfaceDistances:
    """Distances between two surfaces in the same frame. Raises InputError: one has no triangles."""
    if len(estimate.faces) == 0 or len(reference.faces) == 0:
        raise InputError("surface distances need two surfaces with triangles; one is empty.")
    points_out, weights_out, _ = surface_samples(estimate, spacing_mm)
    points_back, weights_back, _ = surface_samples(reference, spacing_mm)
    out = distance_to_surface(points_out, reference)
    back = distance_to_surface(points_back, estimate)
    pairs = (out, weights_out), (back, weights_back)
    by_area = [np.percentile(d, 95, weights=w, method="inverted_cdf") for d, w in pairs]
    return SurfaceDistances(
        hausdorff_mm=float(max(out.max(), back.max())),
        hausdorff_one_sided_mm=float(out.max()),
        hausdorff_95_mm=float(max(by_area)),
        surface_mm=sum(float(np.average(d, weights=w)) for d, w in pairs) / 2,
    )


def distance_to_surface(
    points_mm: Float[np.ndarray, "n 3"], target: Mesh
) -> Float[np.ndarray, " n"]:
    """Distance of every point to a surface: exact to the triangles of the nearest few samples and
    to one at the nearest vertex, whose triangles may be too thin to have samples near it.

    Against all triangles this errs by less than 0.01 mm (tested), always upwards.
    """
    seeds, area, seed_face = surface_samples(target, _SEED_SPACING_MM)
    middle = area > 0
    count = min(_NEIGHBOURS, int(middle.sum()))
    near = cKDTree(seeds[middle]).query(points_mm, k=count, workers=-1)[1]
    corner = cKDTree(seeds[~middle]).query(points_mm, workers=-1)[1]
    triangles = target.vertices_mm[target.faces]
    faces = np.column_stack([seed_face[middle][near], seed_face[~middle][corner]])
    best = np.full(len(points_mm), np.inf)
    for column in range(count + 1):
        new = np.flatnonzero((faces[:, :column] != faces[:, column : column + 1]).all(1))
        distance = triangle_distance(points_mm[new], triangles[faces[new, column]])
        best[new] = np.minimum(best[new], distance)
    return best


def outward_miss(estimate: Mesh, reference: Mesh) -> float:
    """The largest distance, mm, by which the reference sticks out of the estimate's closed surface:
    a shell as wide about the estimate holds all of the reference. 0: it sticks out nowhere."""
    points_mm = surface_samples(reference)[0]
    outside = points_mm[~contains(estimate, points_mm)]
    return float(distance_to_surface(outside, estimate).max()) if len(outside) else 0.0


def part_distances(estimate: Mesh, reference: Mesh) -> dict[str, float]:
    """Of two surfaces, by name: ``SurfaceDistances`` and ``center_mm``."""
    distances = asdict(surface_distances(estimate, reference))
    return {**distances, "center_mm": box_center_distance(estimate, reference)}


def target_errors(carried_mm: Points, targets: Targets) -> dict[str, Any]:
    """Target registration error: how far the targets, as carried to the camera frame, lie from
    their true places; ``mean``, ``rms``, ``median``, ``p95`` and ``max`` in mm, ``count`` (of
    targets), ``each``: every target's (mm, in their order), and ``max_label``: the label of the one
    that is farthest off.

    Source: Fitzpatrick & West 2001, "The distribution of target registration error in rigid-body
    point-based registration", doi 10.1109/42.952729.
    """
    error = np.linalg.norm(carried_mm - targets.points_mm, axis=1)
    return {
        "mean": float(error.mean()),
        "rms": float(np.sqrt((error**2).mean())),
        "median": float(np.median(error)),
        "p95": float(np.percentile(error, 95)),
        "max": float(error.max()),
        "max_label": int(targets.labels[error.argmax()]),
        "count": len(error),
        "each": error.round(2).tolist(),
    }


def box_center_distance(estimate: Mesh, reference: Mesh) -> float:
    """Distance between the centres of the two axis-aligned bounding boxes, mm."""
    return float(np.linalg.norm(estimate.box_mm.mean(0) - reference.box_mm.mean(0)))


def label_ious(estimate: CameraLabels, reference: Anatomy) -> dict[str, float]:
    """Intersection over union per part, on the estimate's voxel lattice.

    The lattice is extended to the reference, so that truth outside the estimate's box counts as
    missed. The organ's name means the parenchyma (label 1, without tumors). A part that is absent
    from the estimate has IoU 0.
    """
    index_from_camera = np.linalg.inv(estimate.camera_from_index)
    index = np.concatenate(
        [transform_points(index_from_camera, part.vertices_mm) for part in reference.parts]
    )
    low, high = np.floor(index.min(0)).astype(int), np.ceil(index.max(0)).astype(int) + 1
    camera_from_box = estimate.camera_from_index.copy()
    camera_from_box[:3, 3] += camera_from_box[:3, :3] @ low
    truth = label_grid(reference, camera_from_box, tuple((high - low).tolist()))
    start, stop = np.maximum(low, 0), np.minimum(high, estimate.labels.shape)
    stop = np.maximum(stop, start)
    shared_estimate = estimate.labels[tuple(map(slice, start, stop))]
    shared_truth = truth[tuple(map(slice, start - low, stop - low))]
    ious = {}
    for label, name in enumerate(reference.names, start=1):
        common = np.count_nonzero((shared_estimate == label) & (shared_truth == label))
        union = np.count_nonzero(estimate.labels == label) + np.count_nonzero(truth == label)
        ious[name] = float(common / (union - common)) if union else 0.0
    return ious


def mean_iou(ious: dict[str, float]) -> float:
    """mIoU: the mean over the reference's parts (parenchyma and each tumor), outside excluded."""
    return float(np.mean(list(ious.values())))
