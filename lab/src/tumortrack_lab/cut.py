"""A plan made on the estimate cuts the true anatomy: what is removed, and the margins.

The planner's own volumes are not used. The true organ is voxelised, faces between voxels are
severed where a stroke or a level sheet passes between their centres, and the largest connected
piece is what stays. Tissue does not move while it is cut. No voxel is removed, so that a cut has
no volume and leaves no diagonal way through.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import binary_dilation, binary_erosion, label
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.types import ORGAN, Anatomy
from tumortrack.imaging.raster import expand, label_grid
from tumortrack.report.metrics import distance_to_surface
from tumortrack_resection.values import Cut, CutLayer, ResectionPlan

Flat = Float[np.ndarray, "_ 2"]
Points = Float[np.ndarray, "_ 3"]
Mask = Bool[np.ndarray, "i j"]
Voxels = Bool[np.ndarray, "i j k"]

# In voxels: with this offset no line runs exactly through a voxel's centre, where rounding would
# decide on which side it passes. So closed lines separate inside from outside.
_ASIDE = 1e-7 * np.sqrt([2.0, 3.0])
VOXEL_MM = 0.5
SAMPLES_MM = 0.4  # between points of the cut's surface
_SAME_MM = 1e-6  # of heights
_BESIDE_MM = 0.5  # an outline this close to a stroke is cut: its chords leave it by less
_TEARS_MM2 = 2.0  # a thinner bridge tears when the piece is lifted
_ML = 1e-3  # of a mm3


class Severed:
    """Which faces between neighbouring voxels of a grid are cut; axis by axis, face n between
    voxels n and n + 1."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.shape = shape
        self.faces = [
            np.zeros(tuple(n - (axis == a) for a, n in enumerate(shape)), bool) for axis in range(3)
        ]

    def wall(self, path: Flat, first: int, stop: int) -> None:
        """Cut along a line (x and y in voxels), in the levels first .. stop - 1."""
        i, j, _ = self.shape
        path = path + _ASIDE
        self.faces[0][:, :, first:stop] |= (_crossings(path, (i, j))[1:-1] > 0)[:, :, None]
        across = _crossings(path[:, ::-1], (j, i))[1:-1].T
        self.faces[1][:, :, first:stop] |= (across > 0)[:, :, None]

    def sheet(self, columns: Mask, level: int) -> None:
        """Cut these columns level, between the levels level - 1 and level."""
        if 0 < level < self.shape[2]:
            self.faces[2][:, :, level - 1] |= columns


def within(rings: tuple[Flat, ...], shape: tuple[int, int]) -> Mask:
    """Which of the points (i, j), i < shape[0], j < shape[1], lie within rings (the first point not
    repeated) by the even-odd rule."""
    counts = np.zeros((shape[0] + 1, shape[1]), int)
    for ring in rings:
        counts += _crossings(_closed(ring) + _ASIDE, shape)
    return np.cumsum(counts, axis=0)[:-1] % 2 == 1


def _closed(ring: Flat) -> Flat:
    return np.concatenate([ring, ring[:1]])


def _crossings(path: Flat, shape: tuple[int, int]) -> Int[np.ndarray, "i j"]:
    """How often a line crosses each row j just before point i; (shape[0] + 1, shape[1])."""
    start, end = path[:-1], path[1:]
    low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    first = np.clip(np.ceil(low), 0, shape[1]).astype(int)
    stop = np.clip(np.ceil(high), 0, shape[1]).astype(int)
    part, step = expand(np.maximum(stop - first, 0))
    row = first[part] + step
    share = (row - start[part, 1]) / (end[part, 1] - start[part, 1])
    at = start[part, 0] + share * (end[part, 0] - start[part, 0])
    counts = np.zeros((shape[0] + 1, shape[1]), int)
    np.add.at(counts, (np.clip(np.ceil(at), 0, shape[0]).astype(int), row), 1)
    return counts


def pieces_of(tissue: Voxels, severed: Severed) -> Int[np.ndarray, "i j k"]:
    """Pieces connected over faces that are not severed: 1 is the largest; 0: no tissue."""
    # On a grid of half the spacing, with a cell for each voxel and for each face that holds.
    cells = np.zeros([2 * n - 1 for n in tissue.shape], bool)
    cells[::2, ::2, ::2] = tissue
    for axis, cut in enumerate(severed.faces):
        before = (slice(None),) * axis
        low, high = (*before, slice(None, -1)), (*before, slice(1, None))
        between = tuple(slice(int(a == axis), None, 2) for a in range(3))
        cells[between] = tissue[low] & tissue[high] & ~cut
    pieces = label(cells, output=np.int32)[0][::2, ::2, ::2]
    sizes = np.bincount(pieces[tissue])
    rank = np.argsort(np.argsort(-sizes, kind="stable")) + 1
    return np.where(tissue, rank[pieces], 0)


@dataclass(frozen=True)
class CutResult:
    """Effects of a cut on the true anatomy. The piece is what the layers enclose."""

    tumor_ml: float  # true volume of the tumor that was to come away
    removed_share: float  # of it, what came away within the piece
    loose_share: float  # of it, what came off beside the piece, for a cut went through the tumor
    enclosed_share: float  # of it, what lies within the layers, whether or not they came free
    healthy_ml: float  # organ without tumors that has come away, within the piece or beside it
    piece_ml: float  # 0 where it did not come free
    detached: bool  # whether the piece came free
    # Area of the piece's outline that lies in tissue and that no stroke went along. Less than 2 mm2
    # tears, and counts as cut.
    bridge_mm2: float
    # Least distance between a cut within tissue and the tumor's surface; negative: this deep the
    # cut went into the tumor. None where nothing was cut at all.
    margin_mm: float | None
    hurt: tuple[str, ...]  # other tumors that were cut into

    @property
    def left_ml(self) -> float:
        """Tumor that does not come away with the piece."""
        return self.tumor_ml * (1 - self.removed_share)


def cut(truth: Anatomy, plan: ResectionPlan, voxel_mm: float = VOXEL_MM) -> CutResult:
    """Cut the true anatomy (table frame, mm) by a plan.

    Cut are walls, along the strokes alone, each from the bottom to the top of the layer in which
    its stroke lies; and level sheets, at the bottom of each layer where none goes on below. Raises
    InputError: the truth lacks the plan's tumor, or a stroke lies in none of its layers.
    """
    if plan.tumor not in truth.names[1:]:
        raise InputError(
            f"the plan is for {plan.tumor}, which is not among the anatomy's parts: "
            f"{', '.join(truth.names)}."
        )
    cutting, number = _Cutting(truth, plan, voxel_mm), truth.names.index(plan.tumor)
    bridge_mm2 = cutting.bridge_mm2()
    labels = cutting.labels
    tissue, tumor = labels > 0, labels == ORGAN + number
    pieces = pieces_of(tissue, cutting.severed(torn=bridge_mm2 < _TEARS_MM2))
    enclosed = cutting.enclosed() & tissue
    largest = int(np.bincount(pieces[enclosed], minlength=1).argmax())  # 0: nothing enclosed
    piece = pieces == largest if largest > 1 else np.zeros_like(tissue)
    surface = cutting.surface()
    labels_there = cutting.at(surface)
    surface, labels_there = surface[labels_there > 0], labels_there[labels_there > 0]
    deep, margin_mm = surface[labels_there == ORGAN + number], None
    if len(deep):
        margin_mm = -float(distance_to_surface(deep, truth.parts[number]).max())
    elif len(surface):
        margin_mm = float(distance_to_surface(surface, truth.parts[number]).min())
    voxel_ml = voxel_mm**3 * _ML
    return CutResult(
        tumor_ml=float(tumor.sum()) * voxel_ml,
        removed_share=_share(piece, tumor),
        loose_share=_share((pieces > 1) & ~piece, tumor),
        enclosed_share=_share(enclosed, tumor),
        healthy_ml=float(((pieces > 1) & (labels == ORGAN)).sum()) * voxel_ml,
        piece_ml=float(piece.sum()) * voxel_ml,
        detached=largest > 1,
        bridge_mm2=bridge_mm2,
        margin_mm=margin_mm,
        hurt=tuple(
            truth.names[n]
            for n in range(1, len(truth.names))
            if n != number and (labels_there == ORGAN + n).any()
        ),
    )


class _Cutting:
    """A plan in the true anatomy, whose voxel (i, j, k) lies at low_mm + voxel_mm (i, j, k).
    ``walls``: strokes along outlines, with the layer whose wall each cuts; ``box_mm``: of the
    organ, beyond which nothing is looked at."""

    def __init__(self, truth: Anatomy, plan: ResectionPlan, voxel_mm: float) -> None:
        self.layers, self.box_mm, self.voxel_mm = plan.layers, truth.organ.box_mm, voxel_mm
        corners = np.concatenate([part.box_mm for part in truth.parts])
        self.low_mm = low_mm = corners.min(0) - voxel_mm
        # The lowest layer's bottom lies midway between two levels, so that half a voxel all over
        # the largest sheet is no bias of the volumes.
        bottom_mm = min(layer.bottom_mm for layer in plan.layers) + voxel_mm / 2
        low_mm[2] = bottom_mm - voxel_mm * np.ceil((bottom_mm - low_mm[2]) / voxel_mm)
        i, j, k = (np.ceil((corners.max(0) - low_mm) / voxel_mm) + 2).astype(int).tolist()
        table_from_index = np.diag([voxel_mm, voxel_mm, voxel_mm, 1.0])
        table_from_index[:3, 3] = low_mm
        self.labels = label_grid(truth, table_from_index, (i, j, k))
        self.walls: list[tuple[Cut, CutLayer]] = []
        for stroke in (stroke for stroke in plan.cuts if stroke.kind == "wall"):
            at = stroke.height_mm + _SAME_MM
            here = [layer for layer in plan.layers if layer.bottom_mm <= at < layer.top_mm]
            if not here:
                raise InputError(
                    f"a stroke at {stroke.height_mm:g} mm lies in none of the plan's layers."
                )
            self.walls.append((stroke, here[0]))

    def flat(self, path_mm: np.ndarray) -> Flat:
        """A line in voxels."""
        return (path_mm[:, :2] - self.low_mm[:2]) / self.voxel_mm

    def columns(self, layer: CutLayer) -> Mask:
        """Which columns of voxels lie within a layer."""
        return within(tuple(map(self.flat, layer.rings_mm)), self.labels.shape[:2])

    def levels(self, layer: CutLayer) -> tuple[int, int]:
        """First level of a layer and first beyond it, by the voxels' centres."""
        heights = np.array([layer.bottom_mm, layer.top_mm])
        levels = np.ceil((heights - self.low_mm[2]) / self.voxel_mm)
        first, stop = np.clip(levels, 0, self.labels.shape[2]).astype(int).tolist()
        return first, stop

    def at(self, points_mm: Points) -> UInt8[np.ndarray, " n"]:
        """Labels of the nearest voxels; 0 beyond the grid."""
        index = np.rint((points_mm - self.low_mm) / self.voxel_mm).astype(int)
        known = ((index >= 0) & (index < self.labels.shape)).all(1)
        out = np.zeros(len(points_mm), np.uint8)
        out[known] = self.labels[tuple(index[known].T)]
        return out

    def severed(self, torn: bool) -> Severed:
        """A sheet reaches one voxel further than its outlines, for the strokes' chords leave those.
        ``torn``: what the strokes left of the outlines is severed too."""
        near, severed = np.ones((3, 3), bool), Severed(self.labels.shape)
        for stroke, layer in self.walls:
            severed.wall(self.flat(stroke.path_mm), *self.levels(layer))
        for layer in self.layers:
            for ring in layer.rings_mm if torn else ():
                severed.wall(self.flat(_closed(ring)), *self.levels(layer))
            sheet = binary_dilation(self.columns(layer), near)
            for lower in self._below(layer):
                sheet &= ~binary_erosion(self.columns(lower), near)
            severed.sheet(sheet, self.levels(layer)[0])
        return severed

    def enclosed(self) -> Voxels:
        inside = np.zeros(self.labels.shape, bool)
        for layer in self.layers:
            inside[:, :, slice(*self.levels(layer))] |= self.columns(layer)[:, :, None]
        return inside

    def surface(self) -> Points:
        """Points all over walls and sheets, SAMPLES_MM apart."""
        points = [self._curtain(stroke.path_mm[:, :2], layer) for stroke, layer in self.walls]
        points += [self._flat(layer, self._below(layer), layer.bottom_mm) for layer in self.layers]
        return np.concatenate(points)

    def bridge_mm2(self) -> float:
        """Area within tissue of what encloses the piece and was not cut: of outlines, that no
        stroke goes along; and where a layer is wider than the one above it, that rim."""
        held = 0
        for layer in self.layers:
            strokes = [_even(s.path_mm[:, :2]) for s, wall in self.walls if wall is layer]
            for ring in layer.rings_mm:
                points = self._curtain(_closed(ring), layer)
                points = points[self.at(points) > 0]
                if strokes and len(points):
                    beside = cKDTree(np.concatenate(strokes)).query(points[:, :2])[0]
                    points = points[beside > _BESIDE_MM]
                held += len(points)
            above = [other for other in self.layers if layer in self._below(other)]
            if np.isfinite(layer.top_mm):
                rim = self._flat(layer, above, layer.top_mm)
                held += int((self.at(rim) > 0).sum())
        return held * SAMPLES_MM**2

    def _below(self, layer: CutLayer) -> list[CutLayer]:
        """The layers whose top is this one's bottom."""
        return [other for other in self.layers if abs(other.top_mm - layer.bottom_mm) < _SAME_MM]

    def _curtain(self, path: Flat, layer: CutLayer) -> Points:
        """Points on the wall over a line, from the layer's bottom to its top, within the box."""
        low = max(layer.bottom_mm, self.box_mm[0, 2]) + SAMPLES_MM / 2
        heights = np.arange(low, min(layer.top_mm, self.box_mm[1, 2]), SAMPLES_MM)
        flat = _even(path)
        return np.column_stack([np.tile(flat, (len(heights), 1)), np.repeat(heights, len(flat))])

    def _flat(self, layer: CutLayer, without: list[CutLayer], height_mm: float) -> Points:
        """Points level within a layer and outside others, within the box."""
        low, high = self.box_mm[:, :2]
        shape = tuple((np.ceil((high - low) / SAMPLES_MM).astype(int) + 1).tolist())

        def inside(layer: CutLayer) -> Mask:
            return within(tuple((ring - low) / SAMPLES_MM for ring in layer.rings_mm), shape)

        kept = inside(layer)
        for other in without:
            kept &= ~inside(other)
        heights = np.full(kept.sum(), height_mm)
        return np.column_stack([low + SAMPLES_MM * np.argwhere(kept), heights])


def _even(path: Flat) -> Flat:
    """Points along a line, SAMPLES_MM apart, its end included."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.append(np.arange(0, way[-1], SAMPLES_MM), way[-1])
    return np.column_stack([np.interp(at, way, axis) for axis in path.T])


def _share(of: Voxels, whole: Voxels) -> float:
    return float((of & whole).sum() / max(1, whole.sum()))
