"""What arms do, in the viewer's scene: shapes that move as wholes, and lines; published frame, mm.

A shape's surface goes to the page once, then only its place; calls must not overlap, as in
``view.scene``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack.track.live import Line, Shape, Workcell
from tumortrack.track.view.scene import wxyz_of

if TYPE_CHECKING:
    from viser import FrameHandle, LineSegmentsHandle, MeshHandle, ViserServer

_ROOT = "/workcell"


class Cell:
    """viser's nodes under ``/workcell``: ``shape/NAME`` and ``line/NAME``."""

    def __init__(self, server: ViserServer) -> None:
        self._nodes = server.scene
        self._root: FrameHandle = self._nodes.add_frame(_ROOT, show_axes=False, visible=False)
        self._shapes: dict[str, tuple[Shape, MeshHandle]] = {}
        self._lines: dict[str, tuple[Line, LineSegmentsHandle]] = {}

    def show(self, cell: Workcell) -> None:
        """Show this, and nothing of what was shown before."""
        drawn = [line for line in cell.lines if len(line.points_mm) > 1]
        for name in _gone(self._shapes, cell.shapes):
            self._shapes.pop(name)[1].remove()
        for name in _gone(self._lines, drawn):
            self._lines.pop(name)[1].remove()
        for shape in cell.shapes:
            self._put_shape(shape)
        for line in drawn:
            self._put_line(line)
        self._root.visible = True

    def hide(self) -> None:
        """Nothing of it stays visible."""
        self._root.visible = False

    def _put_shape(self, shape: Shape) -> None:
        before, node = self._shapes.get(shape.name, (None, None))
        if before is None or node is None or not _looks_alike(before, shape):
            node = self._nodes.add_mesh_simple(
                _node("shape", shape.name),
                shape.mesh.vertices_mm.astype(np.float32),
                shape.mesh.faces.astype(np.uint32),
                color=shape.colour,
                opacity=shape.opacity if shape.opacity < 1 else None,
                flat_shading=True,
                side="front",
                cast_shadow=False,
                receive_shadow=False,
            )
        way = shape.published_from_shape
        node.position, node.wxyz = way[:3, 3], wxyz_of(way[:3, :3])
        self._shapes[shape.name] = shape, node

    def _put_line(self, line: Line) -> None:
        points = line.points_mm.astype(np.float32)
        segments = np.stack([points[:-1], points[1:]], axis=1)
        before, node = self._lines.get(line.name, (None, None))
        if before is None or node is None or not _drawn_alike(before, line):
            node = self._nodes.add_line_segments(
                _node("line", line.name),
                segments,
                line.colour,
                thickness=line.width_mm,
                thickness_units="world",
            )
        elif not np.array_equal(before.points_mm, line.points_mm):
            node.points = segments
        self._lines[line.name] = line, node


def box_of(cell: Workcell) -> Float64[np.ndarray, "2 3"] | None:
    """The box round all shapes, as they stand; None without any."""
    places = [_box(shape.mesh, shape.published_from_shape) for shape in cell.shapes]
    if not places:
        return None
    corners = np.concatenate(places)
    return np.stack([corners.min(0), corners.max(0)])


def _box(mesh: Mesh, way: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "8 3"]:
    """Corners of the mesh's own box, moved."""
    corners = np.stack(np.meshgrid(*mesh.box_mm.T, indexing="ij"), axis=-1).reshape(8, 3)
    return transform_points(way, corners.astype(np.float64))


def _node(kind: str, name: str) -> str:
    """Without further slashes: to viser they say that one node moves with another."""
    return f"{_ROOT}/{kind}/{name.replace('/', ':')}"


def _gone(shown: Iterable[str], now: Iterable[Shape | Line]) -> set[str]:
    return set(shown) - {one.name for one in now}


def _looks_alike(one: Shape, two: Shape) -> bool:
    """Whether they differ in their place alone."""
    shades = one.colour == two.colour and one.opacity == two.opacity
    return shades and one.mesh is two.mesh


def _drawn_alike(one: Line, two: Line) -> bool:
    """Whether they differ in their points alone."""
    return one.colour == two.colour and one.width_mm == two.width_mm
