"""A plan made on the estimate cuts the true anatomy: what is removed, and the margins.

The planner's own volumes are not used. The instrument is a line with a thickness: the true organ is
voxelised, and all that comes within the electrode's radius of its axis, over its whole bare length,
while it is energised, is gone. Tissue does not move while it is cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label, maximum_filter
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.mesh_query import contains, surface_distance
from tumortrack.core.raster import label_grid
from tumortrack.core.types import ORGAN, Anatomy, Mesh
from tumortrack.native import F32, F64, kernel
from tumortrack.report.metrics import distance_to_surface
from tumortrack_resection.values import ResectionPlan

Points = Float[np.ndarray, "n 3"]
Voxels = Bool[np.ndarray, "i j k"]

VOXEL_MM = 0.5
ELECTRODE_MM, RADIUS_MM = 70.0, 1.2  # of the bare electrode
STEP_MM = 0.3  # between poses: the kerf's walls are rough by 0.01 mm
# The grid is askew, so that a plane along the axes passes its voxels' centres at all distances.
_ASKEW = Rotation.from_rotvec([0.11, 0.17, 0.23]).as_matrix()
_ALONG_MM = 3.0, 0.5  # samples of the electrode: to find the poses that are nearest, and of these
_SOME = 29  # every so many samples give a bound of the least distance
_ROUGH_MM = 0.2  # by which ``surface_distance`` errs at most, twice
_TEARS = 0.5  # voxels: so thin a layer of tissue beside the kerf tears when the piece is lifted
_REACH_MM = 10.0  # the cup holds nothing farther from where it was to touch
_CUP_MM = 3.0  # it holds what lies so near to the first tissue that it meets
_STAYS = 0.35  # of all tissue: a smaller part beside the held one is not what stays
_ML = 1e-3  # of a mm3

# Ends of lines, reach -> voxels' squared distances are lowered to those from the lines, at least
# where that is less than the reach; all in voxels.
_approach = kernel("approach", F64["n", 2, 3], float, F32["i", "j", "k"].out)


@dataclass(frozen=True, eq=False)
class Swept:
    """Where the electrode was energised: the tip and the rear end of its bare axis at each pose, in
    steps of at most ``STEP_MM``, table frame, mm; and its radius."""

    ends_mm: Float[np.ndarray, "n 2 3"]
    radius_mm: float = RADIUS_MM

    def __post_init__(self) -> None:
        if not len(self.ends_mm):
            raise InputError("the electrode is never energised, so that nothing is cut.")


def swept_by(
    plan: ResectionPlan, electrode_mm: float = ELECTRODE_MM, radius_mm: float = RADIUS_MM
) -> Swept:
    """The poses of a plan that is followed exactly. Raises InputError: a cut has no direction of
    the electrode, as in the method ``published``."""
    ends = []
    for stroke in plan.cuts:
        if stroke.axis is None:
            raise InputError(
                f"sweep {stroke.sweep} does not say how the electrode lies; give poses of motions."
            )
        path = stroke.path_mm
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        at = np.unique(np.append(way, np.arange(0, way[-1], STEP_MM)))
        tips = np.column_stack([np.interp(at, way, axis) for axis in path.T])
        ends.append(np.stack([tips, tips - electrode_mm * stroke.axis], axis=1))
    return Swept(np.concatenate(ends), radius_mm)


@dataclass(frozen=True)
class CutResult:
    """Effects of a cut on the true anatomy. The piece is what the cup holds; what stays is the
    largest part of the rest, if that is a third of all or more; else nothing has come free."""

    tumor_ml: float  # true volume of the tumor that was to come away
    removed_share: float  # of it, what came away whole, in the piece
    cut_share: float  # of it, what the electrode destroyed
    left_share: float  # of it, all else: in what stays, or loose beside the piece
    healthy_ml: float  # parenchyma that is lost: in the piece, in kerfs, and loose beside it
    kerf_ml: float  # of that, in kerfs
    kerf_area_mm2: float  # of what stays, the surface that kerfs laid open: the wound
    piece_ml: float  # 0 where it did not come free
    detached: bool  # whether the piece came free
    # Least distance between the surfaces of the energised electrode and of the tumor. 0: it
    # touched; negative: its axis went so deep into the tumor.
    margin_mm: float
    hurt: tuple[str, ...]  # other tumors that the energised electrode touched

    @property
    def left_ml(self) -> float:
        return self.tumor_ml * self.left_share


def cut(
    truth: Anatomy, plan: ResectionPlan, swept: Swept | None = None, voxel_mm: float = VOXEL_MM
) -> CutResult:
    """Cut the true anatomy (table frame, mm) by a plan that is followed exactly, or by the poses of
    its motions.

    Pieces hang together over faces between voxels, but not through a layer beside a kerf that is
    thinner than half a voxel. Raises InputError: the truth lacks the plan's tumor; without poses, a
    cut of the plan does not say how the electrode lies.
    """
    if plan.tumor not in truth.names[1:]:
        raise InputError(
            f"the plan is for {plan.tumor}, which is not among the anatomy's parts: "
            f"{', '.join(truth.names)}."
        )
    swept, number = swept or swept_by(plan), truth.names.index(plan.tumor)
    margins_mm = {
        name: electrode_margin_mm(part, swept)
        for name, part in zip(truth.names[1:], truth.tumors, strict=True)
    }
    table_from_index, shape = _grid(truth, voxel_mm)
    labels = label_grid(truth, table_from_index, shape)
    tissue, tumor = labels > 0, labels == ORGAN + number
    index_from_table = np.linalg.inv(table_from_index)
    radius = swept.radius_mm / voxel_mm
    near = np.full(shape, (radius + 1) ** 2, np.float32)
    ends = transform_points(index_from_table, swept.ends_mm.reshape(-1, 3)).reshape(-1, 2, 3)
    _approach(np.ascontiguousarray(ends, np.float64), radius + 1, near)
    kerf = tissue & (near <= radius**2)
    pieces = _pieces(tissue & ~kerf, near > (radius + _TEARS) ** 2)
    held = _held(pieces, transform_points(index_from_table, plan.grasp_mm[None])[0], voxel_mm)
    sizes = np.bincount(pieces[pieces > 0], minlength=2)
    sizes[held] *= sizes[np.arange(len(sizes)) != held].max() < _STAYS * sizes.sum()
    stays = int(sizes.argmax())
    detached = held not in (0, stays)
    rest, piece = pieces == stays, (pieces == held) & detached
    voxel_ml, tumors = voxel_mm**3 * _ML, max(1, int(tumor.sum()))
    removed, destroyed = (float((of & tumor).sum()) / tumors for of in (piece, kerf))
    return CutResult(
        tumor_ml=float(tumor.sum()) * voxel_ml,
        removed_share=removed,
        cut_share=destroyed,
        left_share=max(0.0, 1 - removed - destroyed),
        healthy_ml=float(((labels == ORGAN) & ~rest).sum()) * voxel_ml,
        kerf_ml=float(((labels == ORGAN) & kerf).sum()) * voxel_ml,
        kerf_area_mm2=_wound(rest, kerf, near) * voxel_mm**2,
        piece_ml=float(piece.sum()) * voxel_ml,
        detached=detached,
        margin_mm=margins_mm.pop(plan.tumor),
        hurt=tuple(name for name, margin_mm in margins_mm.items() if margin_mm <= 0),
    )


def electrode_margin_mm(part: Mesh, swept: Swept) -> float:
    """Least distance between a closed surface and that of the electrode, right to 0.03 mm. 0: it
    touches; negative: its axis goes so deep into the part."""
    ends = swept.ends_mm
    for step_mm in _ALONG_MM:
        length_mm = float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max())
        along = np.linspace(0, 1, 1 + int(np.ceil(length_mm / step_mm)))[:, None]
        points = ends[:, None, 0] + along * (ends[:, None, 1] - ends[:, None, 0])
        off = _signed(part, points.reshape(-1, 3), step_mm).reshape(points.shape[:2])
        near = off < off.min() + step_mm / 2 + _ROUGH_MM
        ends = ends[near.any(1)]
    least_mm = float(np.copysign(distance_to_surface(points[near], part), off[near]).min())
    return min(least_mm, max(0.0, least_mm - swept.radius_mm))


def _signed(part: Mesh, points: Points, more_mm: float) -> Float[np.ndarray, " n"]:
    """``surface_distance``, negative inside; infinite where it is larger by ``more_mm`` than the
    least of some points, as the part's box shows."""
    low, high = part.box_mm
    beyond = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1)
    least_mm = surface_distance(part, points[::_SOME]).min()
    near, off = beyond < least_mm + more_mm, np.full(len(points), np.inf)
    off[near] = surface_distance(part, points[near])
    boxed = np.flatnonzero(beyond == 0)
    off[boxed[contains(part, points[boxed])]] *= -1
    return off


def _grid(truth: Anatomy, voxel_mm: float) -> tuple[np.ndarray, tuple[int, int, int]]:
    """``table_from_index`` (4, 4) and shape of a grid round all parts, with an empty border."""
    corners = np.concatenate([part.vertices_mm for part in truth.parts]) @ _ASKEW / voxel_mm
    low = np.floor(corners.min(0)) - 1
    i, j, k = (np.ceil(corners.max(0) - low) + 2).astype(int).tolist()
    scaled = _ASKEW * voxel_mm
    return rigid(scaled, scaled @ low), (i, j, k)


def _pieces(tissue: Voxels, holds: Voxels) -> Int[np.ndarray, "i j k"]:
    """Pieces that hang together where tissue ``holds``, from 1; other tissue joins a neighbour. 0:
    no tissue, or a crumb."""
    pieces = label(tissue & holds, output=np.int32)[0]
    thin = tissue & ~holds
    pieces[thin] = maximum_filter(pieces, 3)[thin]
    return pieces


def _held(pieces: Int[np.ndarray, "i j k"], grasp: np.ndarray, voxel_mm: float) -> int:
    """The piece with most tissue where the cup meets it; 0: there is none within its reach."""
    reach = (_REACH_MM + _CUP_MM) / voxel_mm
    low = np.clip(np.floor(grasp - reach), 0, pieces.shape).astype(int)
    stop = np.clip(np.ceil(grasp + reach), low, pieces.shape).astype(int)
    i, j, k = (slice(a, b) for a, b in zip(low, stop, strict=True))
    near = pieces[i, j, k]
    at = np.argwhere(near > 0)
    off_mm = np.linalg.norm(at + low - grasp, axis=1) * voxel_mm
    first_mm = off_mm.min(initial=np.inf)
    if first_mm > _REACH_MM:
        return 0
    return int(np.bincount(near[tuple(at[off_mm < first_mm + _CUP_MM].T)]).argmax())


def _wound(rest: Voxels, kerf: Voxels, near: Float[np.ndarray, "i j k"]) -> float:
    """Area of the faces between the two, in voxels: each face counts by how squarely it lies to the
    kerf's wall, so that a slanting wall has its true area."""
    slope, area = np.gradient(near), 0.0
    for axis, step in product(range(3), (-1, 1)):
        faces = kerf & np.roll(rest, step, axis)  # the border is empty: nothing comes round
        normal = np.stack([along[faces] for along in slope])
        area += float(np.abs(normal[axis] / np.linalg.norm(normal, axis=0)).sum())
    return area
