"""Metrics of an estimated anatomy against the true one. Pure functions, exact definitions.

Surface distances are measured from samples of one surface to the other surface itself (nearest
triangle, exact point-to-triangle distance), not to its vertices: libraries differ by millimetres
in HD95 and directed distances because they leave that open.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points, transform_points
from tumortrack.core.mesh_query import SPACING_MM, contains, nearest_places, surface_samples
from tumortrack.core.raster import label_grid
from tumortrack.core.types import Anatomy, CameraLabels, Mesh
from tumortrack.io.scene_folder import Targets


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


def surface_distances(
    estimate: Mesh, reference: Mesh, spacing_mm: float = SPACING_MM
) -> SurfaceDistances:
    """Distances between two surfaces in the same frame. Raises InputError: one has no triangles."""
    if len(estimate.faces) == 0 or len(reference.faces) == 0:
        raise InputError("surface distances need two surfaces with triangles; one is empty.")
    points_out, weights_out = surface_samples(estimate, spacing_mm)
    points_back, weights_back = surface_samples(reference, spacing_mm)
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
    """Distance of every point to a surface, exact."""
    return np.linalg.norm(points_mm - nearest_places(target, points_mm), axis=1)


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
