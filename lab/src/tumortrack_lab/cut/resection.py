"""A plan made on the estimate cuts the true anatomy: what is removed, and the margins.

The planner's own volumes are not used. The true organ is voxelised, faces between voxels are
severed where a stroke or a level sheet passes between their centres, and the largest connected
piece is what stays. Tissue does not move while it is cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.types import ORGAN, Anatomy, Mesh
from tumortrack.imaging.raster import label_grid
from tumortrack.plan.values import Cut, CutLayer, ResectionPlan
from tumortrack.report.metrics import distance_to_surface
from tumortrack_lab.cut.severing import Flat, Mask, Severed, Voxels, pieces_of, within

VOXEL_MM = 0.5
SAMPLES_MM = 0.4  # between points of the cut's surface
_SAME_MM = 1e-6  # of heights
_BESIDE_MM = 0.5  # an outline this close to a stroke is cut: its chords leave it by less
_TEARS_MM2 = 2.0  # a thinner bridge tears when the piece is lifted
_ML = 1e-3  # of a mm3

Points = Float[np.ndarray, "_ 3"]
Box = Float64[np.ndarray, "2 3"]


@dataclass(frozen=True)
class CutResult:
    """What a cut did to the true anatomy.

    Attributes:
        tumor_ml: true volume of the tumor that was to come away.
        removed_share: of it, what came away within the piece that the layers enclose.
        loose_share: of it, what came off beside that piece, for a cut went through the tumor.
        enclosed_share: of it, what lies within the layers, whether or not they came free.
        healthy_ml: organ without tumors that has come away, within that piece or beside it.
        piece_ml: all of that piece; 0 where it did not come free.
        detached: whether it came free.
        bridge_mm2: area of its outline that lies in tissue and that no stroke went along. Less
            than 2 mm2 tears, and counts as cut.
        margin_mm: least distance between a cut within tissue and the tumor's surface; negative:
            this deep the cut went into the tumor. None where nothing was cut at all.
        hurt: other tumors that were cut into.
    """

    tumor_ml: float
    removed_share: float
    loose_share: float
    enclosed_share: float
    healthy_ml: float
    piece_ml: float
    detached: bool
    bridge_mm2: float
    margin_mm: float | None
    hurt: tuple[str, ...]

    @property
    def left_ml(self) -> float:
        """Tumor that does not come away with the piece."""
        return self.tumor_ml * (1 - self.removed_share)


def cut(truth: Anatomy, plan: ResectionPlan, voxel_mm: float = VOXEL_MM) -> CutResult:
    """Cut the true anatomy (table frame, mm) by a plan.

    Cut are walls, along the strokes alone, each from the bottom to the top of the layer in which
    its stroke lies; and level sheets, at the bottom of each layer where none goes on below.

    Raises:
        InputError: the truth lacks the plan's tumor, or a stroke lies in none of its layers.
    """
    if plan.tumor not in truth.names[1:]:
        raise InputError(
            f"the plan is for {plan.tumor}, which is not among the anatomy's parts: "
            f"{', '.join(truth.names)}."
        )
    cutting = _Cutting(_grid_for(truth, plan.layers, voxel_mm), plan, truth.organ.box_mm)
    grid, number = cutting.grid, truth.names.index(plan.tumor)
    bridge_mm2 = cutting.bridge_mm2()
    tissue, tumor = grid.labels > 0, grid.labels == ORGAN + number
    pieces = pieces_of(tissue, cutting.severed(torn=bridge_mm2 < _TEARS_MM2))
    enclosed = cutting.enclosed() & tissue
    largest = int(np.bincount(pieces[enclosed], minlength=1).argmax())  # 0: nothing enclosed
    piece = pieces == largest if largest > 1 else np.zeros_like(tissue)
    surface = cutting.surface()
    found = grid.at(surface)
    surface, found = surface[found > 0], found[found > 0]
    voxel_ml = voxel_mm**3 * _ML
    return CutResult(
        tumor_ml=float(tumor.sum()) * voxel_ml,
        removed_share=_share(piece, tumor),
        loose_share=_share((pieces > 1) & ~piece, tumor),
        enclosed_share=_share(enclosed, tumor),
        healthy_ml=float(((pieces > 1) & (grid.labels == ORGAN)).sum()) * voxel_ml,
        piece_ml=float(piece.sum()) * voxel_ml,
        detached=largest > 1,
        bridge_mm2=bridge_mm2,
        margin_mm=_margin_mm(surface, found == ORGAN + number, truth.parts[number]),
        hurt=tuple(
            name
            for n, name in enumerate(truth.names[1:], start=1)
            if n != number and (found == ORGAN + n).any()
        ),
    )


@dataclass(frozen=True, eq=False)
class _Grid:
    """The true anatomy in voxels: voxel (i, j, k) lies at low_mm + voxel_mm (i, j, k)."""

    low_mm: Float64[np.ndarray, " 3"]
    voxel_mm: float
    labels: UInt8[np.ndarray, "i j k"]

    def rings(self, layer: CutLayer) -> tuple[Flat, ...]:
        """A layer's rings in voxels."""
        return tuple((ring - self.low_mm[:2]) / self.voxel_mm for ring in layer.rings_mm)

    def level(self, height_mm: float) -> int:
        """The lowest level whose voxels' centres lie no lower than this."""
        level = np.ceil((height_mm - self.low_mm[2]) / self.voxel_mm)
        return int(np.clip(level, 0, self.labels.shape[2]))

    def columns(self, layer: CutLayer) -> Mask:
        """Which columns of voxels lie within a layer."""
        return within(self.rings(layer), self.labels.shape[:2])

    def at(self, points_mm: Points) -> UInt8[np.ndarray, " n"]:
        """Labels of the nearest voxels; 0 beyond the grid."""
        index = np.rint((points_mm - self.low_mm) / self.voxel_mm).astype(int)
        known = ((index >= 0) & (index < self.labels.shape)).all(1)
        out = np.zeros(len(points_mm), np.uint8)
        out[known] = self.labels[tuple(index[known].T)]
        return out


def _grid_for(truth: Anatomy, layers: Sequence[CutLayer], voxel_mm: float) -> _Grid:
    """Over the whole anatomy; the lowest layer's bottom lies midway between two levels, so that
    half a voxel all over the largest sheet is no bias of the volumes."""
    corners = np.concatenate([part.box_mm for part in truth.parts])
    low_mm = corners.min(0) - voxel_mm
    bottom_mm = min(layer.bottom_mm for layer in layers) + voxel_mm / 2
    low_mm[2] = bottom_mm - voxel_mm * np.ceil((bottom_mm - low_mm[2]) / voxel_mm)
    shape = tuple((np.ceil((corners.max(0) - low_mm) / voxel_mm) + 2).astype(int).tolist())
    table_from_index = np.diag([voxel_mm, voxel_mm, voxel_mm, 1.0])
    table_from_index[:3, 3] = low_mm
    return _Grid(low_mm, voxel_mm, label_grid(truth, table_from_index, shape))


class _Cutting:
    """A plan in the true anatomy.

    Attributes:
        walls: each stroke along an outline, with the layer whose wall it cuts.
        box_mm: of the organ; beyond it nothing is looked at.
    """

    def __init__(self, grid: _Grid, plan: ResectionPlan, box_mm: Box) -> None:
        self.grid, self.layers, self.box_mm = grid, plan.layers, box_mm
        self.walls: list[tuple[Cut, CutLayer]] = []
        for stroke in (stroke for stroke in plan.cuts if stroke.kind == "wall"):
            height = stroke.height_mm
            here = [
                layer
                for layer in plan.layers
                if layer.bottom_mm - _SAME_MM <= height < layer.top_mm - _SAME_MM
            ]
            if not here:
                raise InputError(f"a stroke at {height:g} mm lies in none of the plan's layers.")
            self.walls.append((stroke, here[0]))

    def severed(self, torn: bool) -> Severed:
        """A sheet reaches one voxel further than its outlines, for the strokes' chords leave those.
        ``torn``: what the strokes left of the outlines is severed too."""
        from scipy.ndimage import binary_dilation, binary_erosion

        grid, near = self.grid, np.ones((3, 3), bool)
        severed = Severed(grid.labels.shape)
        for stroke, layer in self.walls:
            path = (stroke.path_mm[:, :2] - grid.low_mm[:2]) / grid.voxel_mm
            severed.wall(path, grid.level(layer.bottom_mm), grid.level(layer.top_mm))
        for layer in self.layers:
            for ring in grid.rings(layer) if torn else ():
                closed = np.concatenate([ring, ring[:1]])
                severed.wall(closed, grid.level(layer.bottom_mm), grid.level(layer.top_mm))
            sheet = binary_dilation(grid.columns(layer), near)
            for lower in self._below(layer):
                sheet &= ~binary_erosion(grid.columns(lower), near)
            severed.sheet(sheet, grid.level(layer.bottom_mm))
        return severed

    def enclosed(self) -> Voxels:
        """What lies within the layers."""
        grid = self.grid
        inside = np.zeros(grid.labels.shape, bool)
        for layer in self.layers:
            levels = slice(grid.level(layer.bottom_mm), grid.level(layer.top_mm))
            inside[:, :, levels] |= grid.columns(layer)[:, :, None]
        return inside

    def surface(self) -> Points:
        """Points all over walls and sheets, SAMPLES_MM apart."""
        points = [self._curtain(stroke.path_mm[:, :2], layer) for stroke, layer in self.walls]
        points += [self._flat(layer, self._below(layer), layer.bottom_mm) for layer in self.layers]
        return np.concatenate(points)

    def bridge_mm2(self) -> float:
        """Area within tissue of what encloses the piece and was not cut: of outlines, that no
        stroke goes along; and where a layer is wider than the one above it, that rim."""
        from scipy.spatial import cKDTree

        held = 0
        for layer in self.layers:
            strokes = [_even(s.path_mm[:, :2]) for s, wall in self.walls if wall is layer]
            for ring in layer.rings_mm:
                points = self._curtain(np.concatenate([ring, ring[:1]]), layer)
                points = points[self.grid.at(points) > 0]
                if strokes and len(points):
                    beside = cKDTree(np.concatenate(strokes)).query(points[:, :2])[0]
                    points = points[beside > _BESIDE_MM]
                held += len(points)
            above = [other for other in self.layers if layer in self._below(other)]
            if np.isfinite(layer.top_mm):
                rim = self._flat(layer, above, layer.top_mm)
                held += int((self.grid.at(rim) > 0).sum())
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


def _margin_mm(surface: Points, inside: Bool[np.ndarray, " n"], tumor: Mesh) -> float | None:
    """Signed distance of the nearest, or else the deepest, of the cut's points."""
    if not len(surface):
        return None
    if inside.any():
        return -float(distance_to_surface(surface[inside], tumor).max())
    return float(distance_to_surface(surface, tumor).min())


def _share(of: Voxels, whole: Voxels) -> float:
    return float((of & whole).sum() / max(1, whole.sum()))
