"""What arms do, in the viewer's scene: shapes that move as wholes, and lines; published frame, mm.

A shape's surface goes to the page once, then only its place; calls must not overlap, as in
``view.scene``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from tumortrack.live.display import wxyz_of
from tumortrack.live.values import Polyline, RigidShape, Workcell

if TYPE_CHECKING:
    from viser import FrameHandle, LineSegmentsHandle, MeshHandle, ViserServer

_ROOT = "/workcell"


class WorkcellView:
    """viser's nodes under ``/workcell``: ``shape/NAME`` and ``line/NAME``."""

    def __init__(self, server: ViserServer) -> None:
        self._nodes = server.scene
        self._root: FrameHandle = self._nodes.add_frame(_ROOT, show_axes=False, visible=False)
        self._shapes: dict[str, tuple[RigidShape, MeshHandle]] = {}
        self._lines: dict[str, tuple[Polyline, LineSegmentsHandle]] = {}

    def show(self, cell: Workcell) -> None:
        """Show this, and nothing of what was shown before."""
        drawn = cell.drawn_lines
        for name in _gone(self._shapes, cell.shapes):
            self._shapes.pop(name)[1].remove()
        for name in _gone(self._lines, drawn):
            self._lines.pop(name)[1].remove()
        places = np.array([shape.published_from_shape for shape in cell.shapes]).reshape(-1, 4, 4)
        turns = wxyz_of(places[:, :3, :3]) if len(places) else ()  # all at once: 5 times quicker
        for shape, wxyz in zip(cell.shapes, turns, strict=True):
            self._put_shape(shape, wxyz)
        for line in drawn:
            self._put_line(line)
        self._root.visible = True

    def hide(self) -> None:
        """Nothing of it stays visible."""
        self._root.visible = False

    def _put_shape(self, shape: RigidShape, wxyz: Float64[np.ndarray, " 4"]) -> None:
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
            before = None
        way = shape.published_from_shape
        if before is None or not np.array_equal(before.published_from_shape, way):
            node.position, node.wxyz = way[:3, 3], wxyz
        self._shapes[shape.name] = shape, node

    def _put_line(self, line: Polyline) -> None:
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


def _node(kind: str, name: str) -> str:
    """Without further slashes: to viser they say that one node moves with another."""
    return f"{_ROOT}/{kind}/{name.replace('/', ':')}"


def _gone(shown: Iterable[str], now: Iterable[RigidShape | Polyline]) -> set[str]:
    return set(shown) - {one.name for one in now}


def _looks_alike(one: RigidShape, two: RigidShape) -> bool:
    """Whether they differ in their place alone."""
    shades = one.colour == two.colour and one.opacity == two.opacity
    return shades and one.mesh is two.mesh


def _drawn_alike(one: Polyline, two: Polyline) -> bool:
    """Whether they differ in their points alone."""
    return one.colour == two.colour and one.width_mm == two.width_mm
