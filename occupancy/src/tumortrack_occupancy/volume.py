"""Labels, smooth closed surfaces and distances from logits on a grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Float64, UInt8
from scipy import ndimage

from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.grid import grown_box, tight_box
from tumortrack.core.mesh_query import surface_distance
from tumortrack.core.report import Finding
from tumortrack.core.types import FIRST_TUMOR, ORGAN, OUTSIDE, Mesh, OccupancyCloud
from tumortrack_occupancy.kernels import trilinear

AT_ONCE = 2**18  # queries; bounds the memory for any grid
_SMALLEST_MARGIN = 1e-3  # a surface exactly through a grid point would not be closed
FIT_STEPS = 24  # of a lattice for surface_distances, along the box's longest side
LARGEST_MARGIN = 30.0  # larger logits do not change where a surface lies

Points = Float32[np.ndarray, "n 3"]  # camera frame, mm
Rows = Float32[np.ndarray, "n classes"]
Box = Float[np.ndarray, "2 3"]  # camera frame, mm: lower and upper corner
Affine = Float64[np.ndarray, "4 4"]
Labels = UInt8[np.ndarray, "i j k"]
Mask = Bool[np.ndarray, "i j k"]
Margins = Float16[np.ndarray, "parts i j k"]
LogitsAt = Callable[[Points], torch.Tensor]  # camera frame, mm -> (n, classes)


@dataclass(frozen=True, eq=False)
class LogitLattice:
    """Logits at origin + step * (i, j, k), camera frame, mm."""

    origin_mm: Float64[np.ndarray, " 3"]
    step_mm: float
    logits: Float32[np.ndarray, "i j k classes"]

    @property
    def box_mm(self) -> Float64[np.ndarray, "2 3"]:
        """From the first point to the last."""
        size = np.array(self.logits.shape[:3]) - 1
        return np.stack([self.origin_mm, self.origin_mm + self.step_mm * size])

    def interpolate(self, points_mm: Points) -> Rows:
        """Trilinear logits at points; outside the lattice those at its border."""
        place = ((points_mm - self.origin_mm) / self.step_mm).astype(np.float32)
        return trilinear(self.logits, place)

    def cut_off(self) -> bool:
        """Whether the organ, the largest connected component of what is not outside, reaches the
        border or is missing."""
        organ = _largest_component(self.logits.argmax(-1) != OUTSIDE)
        return not organ.any() or bool(organ.sum() > organ[1:-1, 1:-1, 1:-1].sum())


def lattice_over(logits_at: LogitsAt, box_mm: Box, steps: int) -> LogitLattice:
    """A lattice over a box, ``steps`` along its longest side, queried at every point."""
    step = float((box_mm[1] - box_mm[0]).max()) / steps
    axes = [np.arange(low, high + step, step) for low, high in box_mm.T]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
    logits = logits_at(grid.reshape(-1, 3)).float().cpu().numpy()
    return LogitLattice(box_mm[0].astype(float), step, logits.reshape(*grid.shape[:3], -1))


def margins_on(lattice: LogitLattice) -> tuple[Margins, Labels, Affine]:
    """``margins_of`` the parts, labels and ``camera_from_index`` of a lattice."""
    logits = torch.from_numpy(lattice.logits.reshape(-1, lattice.logits.shape[3]))
    shape = lattice.logits.shape[:3]
    labels = logits.argmax(-1).to(torch.uint8).numpy().reshape(shape)
    margins = np.ascontiguousarray(margins_of(logits).T).reshape(-1, *shape)
    camera_from_index = np.diag([lattice.step_mm] * 3 + [1.0])
    camera_from_index[:3, 3] = lattice.origin_mm
    return margins, labels, camera_from_index


def margins_of(logits: torch.Tensor) -> Float16[np.ndarray, "n parts"]:
    """By how much each part's logit wins (positive inside): (n, classes) -> (n, parts). The organ's
    margin is that of the best label inside over the outside, so that its zero set is the surface of
    the whole organ; a tumor's is over the best other label. In half precision, 2 bytes per voxel
    and part: 0.4 GB at 400^3 with two tumors."""
    columns = [logits[:, 1:].amax(1) - logits[:, 0]]
    for label in range(FIRST_TUMOR, logits.shape[1]):
        others = torch.cat([logits[:, :label], logits[:, label + 1 :]], 1).amax(1)
        columns.append(logits[:, label] - others)
    margins = torch.stack(columns, 1).clamp(-LARGEST_MARGIN, LARGEST_MARGIN)
    return margins.half().cpu().numpy()


def keep_largest_pieces(labels: Labels, n_parts: int) -> Labels:
    """Only the largest connected component of each part: other pieces of the organ become outside,
    those of a tumor organ."""
    kept = np.where(_largest_component(labels > 0), labels, 0).astype(np.uint8)
    for label in range(FIRST_TUMOR, n_parts + 1):
        mask = kept == label
        kept[mask & ~_largest_component(mask)] = ORGAN
    return kept


def drop_islands(
    cloud: OccupancyCloud, labels: Labels, kept: Labels, camera_from_index: Affine
) -> OccupancyCloud:
    """The cloud without what ``keep_largest_pieces`` dropped from the labels: points in an island
    of the organ are left out, those in a tumor's become organ. A point belongs to a piece if one of
    the voxels next to it does."""
    if np.array_equal(labels, kept):
        return cloud
    index_from_camera = np.linalg.inv(camera_from_index)
    index = np.rint(transform_points(index_from_camera, cloud.points_mm.astype(np.float64)))
    point_labels = cloud.labels.copy()
    same, stays = np.zeros(len(index), bool), np.zeros(len(index), bool)
    for off in np.ndindex(3, 3, 3):
        voxel = np.clip(index.astype(int) + off - 1, 0, np.array(kept.shape) - 1)
        beside = kept[tuple(voxel.T)]
        same |= beside == point_labels
        stays |= beside > 0
    point_labels[(point_labels >= FIRST_TUMOR) & ~same] = ORGAN
    points, probability = cloud.points_mm[stays], cloud.probability[stays]
    return OccupancyCloud(points, point_labels[stays], probability, cloud.stamp_ns)


def _largest_component(mask: Mask) -> Mask:
    if not mask.any():
        return mask
    box = tight_box(mask)
    pieces, count = ndimage.label(mask[box])
    if count < 2:
        return mask
    largest = np.zeros_like(mask)
    largest[box] = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
    return largest


def part_surfaces(
    margins: Margins, labels: Labels, camera_from_index: Affine, names: tuple[str, ...]
) -> dict[str, Mesh]:
    """Each part as a closed surface (marching cubes); parts without a voxel are left out."""
    from skimage import measure

    meshes = {}
    for n, name in enumerate(names):
        mask = labels > 0 if n == 0 else labels == n + 1
        if not mask.any():
            continue
        # One more voxel on each side: the surface lies between voxels of opposite sign.
        box = grown_box(tight_box(mask), mask.shape, np.ones(3, int))
        field = np.where(mask[box], margins[n][box], -np.abs(margins[n][box])).astype(np.float32)
        field = np.where(field > 0, 1, -1) * np.maximum(np.abs(field), _SMALLEST_MARGIN)
        # Padding closes surfaces at the grid's edge.
        padded = np.pad(field, 1, constant_values=-float(np.abs(field).max()))
        vertices, faces, _, _ = measure.marching_cubes(padded, 0.0, gradient_direction="ascent")
        index = vertices.astype(np.float64) - 1 + [part.start for part in box]
        mesh = Mesh(transform_points(camera_from_index, index), faces)
        outwards = mesh.volume_mm3 > 0
        meshes[name] = mesh if outwards else Mesh(mesh.vertices_mm, faces[:, ::-1])
    return meshes


def surface_distances(lattice: LogitLattice, points_mm: Points) -> Float32[np.ndarray, " n"]:
    """Distances of points (n, 3), camera frame, mm, from the organ's surface; NoEstimate if there
    is none in the lattice's box. The surface is the zero set of the margin, linear between the
    lattice's points: accurate to about half a mm for an organ on ``FIT_STEPS``."""
    from skimage import measure

    logits = lattice.logits
    field = (logits[..., 1:].max(-1) - logits[..., 0]).clip(-LARGEST_MARGIN, LARGEST_MARGIN)
    if not field.min() < 0 < field.max():
        raise NoEstimate(Finding("far_off"))
    corners, faces, _, _ = measure.marching_cubes(field, 0.0)
    surface = Mesh(corners * lattice.step_mm + lattice.origin_mm, faces)
    return surface_distance(surface, points_mm)
