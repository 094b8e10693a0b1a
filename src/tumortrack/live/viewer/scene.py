"""The viewer's 3-D scene: what was seen, what was estimated; published frame, mm.

Every node is made once and then changed in place, so that clients keep their buffers. Calls must
not overlap: the sink holds a lock round them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, UInt8

from tumortrack.core import colours
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack.live.display import MOST_SEEN, seen_points, thinned, wxyz_of
from tumortrack.live.values import PublishedFrame, SinkContext, TrackingResult, TransformedEstimate
from tumortrack.live.viewer.look import Look
from tumortrack.live.viewer.slices import SlicePlane
from tumortrack.live.viewer.surfaces import bare_faces, exact_margin, rough_margin

if TYPE_CHECKING:
    from viser import ImageHandle, MeshHandle, PointCloudHandle, ViserServer

_MOST_LABELLED = 15_000  # points shown
_AXES_MM = 12.0
_TUMOR_WITH_POINTS = 0.3  # opacity
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a) if abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


@dataclass(frozen=True, kw_only=True)
class DisplayOptions:
    """What the user wants to see."""

    observed: bool = True
    kidney: float = 0.35  # opacity
    margin: bool = True
    points: str = "none"  # none | tumors | all
    by_probability: bool = False
    slice_plane: bool = False
    helpers: bool = True  # axes and the region of the organ's points


class ViewerScene:
    """viser's nodes, and what goes into them."""

    def __init__(self, server: ViserServer, context: SinkContext, margin_mm: float) -> None:
        self._nodes = server.scene
        self._margin_mm = margin_mm
        self._anatomy_ct, self._margins_ct = context.anatomy_ct, None
        if context.anatomy_ct is not None:
            self._bare_faces = bare_faces(context.anatomy_ct)
            if margin_mm > 0:
                tumors = context.anatomy_ct.tumors
                self._margins_ct = tuple(exact_margin(tumor, margin_mm) for tumor in tumors)
        self.options = DisplayOptions()
        self.margins: dict[str, Mesh] = {}  # of the shown estimate, published frame
        self._placed: TransformedEstimate | None = None
        self._has_organ = self._has_slice = False
        self._parts: dict[str, MeshHandle] = {}
        self._shells: dict[str, MeshHandle] = {}
        self.look = Look(server, context.published_frame)
        self._make_nodes(context)

    def observe(self, result: TrackingResult) -> None:
        """Show what this result saw; nothing, if it saw nothing."""
        way = result.published_frame.published_from_camera
        seen = (
            np.zeros((0, 3), np.float32)
            if result.observation is None
            else seen_points(result.observation)
        )
        organ = np.zeros((0, 3), np.float32) if result.organ is None else result.organ.points_mm
        self._put_points(self._seen, transform_points(way, thinned(seen, MOST_SEEN)), colours.SEEN)
        organ_there = transform_points(way, thinned(organ, MOST_SEEN))
        self._put_points(self._organ, organ_there, colours.ORGAN)
        self._axes.wxyz, self._axes.position = wxyz_of(way[:3, :3]), way[:3, 3]
        if len(organ):
            lower, upper = organ.min(0), organ.max(0)
            corners = transform_points(way, lower + _CORNERS * (upper - lower))
            self._region.points = corners[_EDGES].astype(np.float32)
            self.look.aim(result.published_frame, float(np.median(organ[:, 2])))
        self._has_organ = len(organ) > 0

    def show(self, result: TrackingResult) -> None:
        """Show this result's estimate, which it must have."""
        placed = result.transformed
        assert placed is not None
        self._put_labelled(placed)
        self.margins = self._margins_of(result, placed)
        for name, mesh in placed.meshes.items():
            if name in self._parts:
                shown = self.look.last_drawn(self._bare(mesh)) if name == "kidney" else mesh
                _put_mesh(self._parts[name], shown)
        for name, mesh in self.margins.items():
            _put_mesh(self._shells[name], mesh)
        self._placed = placed
        self.apply()

    def hide(self) -> None:
        """Nothing of any estimate stays visible."""
        self._placed = None
        self._has_slice = False
        self._estimate.visible = False
        self.margins = {}

    def apply(self) -> None:
        """Show and hide nodes by the options and by what there is."""
        options, placed = self.options, self._placed
        self._seen.visible = self._organ.visible = options.observed
        self._axes.visible = options.helpers
        self._region.visible = options.helpers and self._has_organ
        if placed is None:
            return
        for name, node in self._parts.items():
            node.visible = name in placed.meshes and (name != "kidney" or options.kidney > 0)
            if name != "kidney":  # solid, unless points are to be seen in it
                node.opacity = None if options.points == "none" else _TUMOR_WITH_POINTS
        for name, node in self._shells.items():
            node.visible = options.margin and name in self.margins
        self._parts["kidney"].opacity = options.kidney
        self._points.visible = options.points != "none"
        self._slice.visible = options.slice_plane and self._has_slice
        self._estimate.visible = True

    def redraw_points(self) -> None:
        """After a change of what labelled points are to be shown."""
        if self._placed is not None:
            self._put_labelled(self._placed)
            self.apply()

    def put_slice(
        self, picture: UInt8[np.ndarray, "h w 3"], plane: SlicePlane, frames: PublishedFrame
    ) -> None:
        """The slice as a plane of the scene, at its true place."""
        if not self.options.slice_plane:
            self._has_slice = False  # what was there is old by the time it is asked for
            return
        # viser lays a picture's columns along x and its rows along y.
        axes = np.stack([plane.across, plane.down, np.cross(plane.across, plane.down)], axis=1)
        way = frames.published_from_camera
        self._slice.position = transform_points(way, plane.centre_mm[None])[0]
        self._slice.wxyz = wxyz_of(way[:3, :3] @ axes)
        self._slice.render_width = self._slice.render_height = plane.side_mm
        solid = (picture > 8).any(2, keepdims=True)
        self._slice.image = np.concatenate([picture, solid.astype(np.uint8) * 255], axis=2)
        self._has_slice = True
        self.apply()

    def mark(self, point_mm: Float[np.ndarray, " 3"] | None, frames: PublishedFrame) -> None:
        """Where the user clicked (camera frame); None: nowhere."""
        self._picked.visible = point_mm is not None
        if point_mm is not None:
            there = transform_points(frames.published_from_camera, np.asarray(point_mm)[None])
            self._picked.position = there[0]

    def _make_nodes(self, context: SinkContext) -> None:
        nodes = self._nodes
        self._axes = nodes.add_frame("/camera", axes_length=_AXES_MM, axes_radius=0.35)
        self._seen = self._cloud("/seen", 0.2, colours.SEEN)
        self._organ = self._cloud("/organ", 0.3, colours.ORGAN)
        self._region = nodes.add_line_segments(
            "/region",
            np.zeros((12, 2, 3), np.float32),
            colours.REGION,
            thickness=1.0,
            thickness_units="screen",
        )
        self._region.visible = False
        self._picked = nodes.add_icosphere(
            "/picked", radius=1.5, color=colours.PICKED, visible=False, cast_shadow=False
        )
        self._estimate = nodes.add_frame("/estimate", show_axes=False, visible=False)
        self._shells = {
            # Of a margin its far half: the near one would cover the organ that it reaches out of.
            name: self._surface(f"/estimate/margin_{name}", label, 0.3, "back")
            for label, name in enumerate(context.parts[1:], start=2)
            if self._margin_mm > 0
        }
        self._parts = {
            name: self._surface(f"/estimate/{name}", label, 0.35 if label == 1 else None)
            for label, name in enumerate(context.parts, start=1)
        }
        self._points = self._cloud("/estimate/points", 0.3, colours.KIDNEY)
        blank = np.zeros((2, 2, 4), np.uint8)
        self._slice: ImageHandle = nodes.add_image(
            "/estimate/slice", blank, 1, 1, format="png", cast_shadow=False, receive_shadow=False
        )

    def _cloud(self, name: str, size_mm: float, colour: colours.Colour) -> PointCloudHandle:
        return self._nodes.add_point_cloud(
            name,
            np.zeros((0, 3), np.float32),
            np.array(colour, np.uint8),
            point_size=size_mm,
            point_shape="circle",
            point_shading="flat",
            precision="float32",  # half precision is 0.125 mm at 150 mm
        )

    def _surface(
        self, name: str, label: int, opacity: float | None, side: Literal["front", "back"] = "front"
    ) -> MeshHandle:
        return self._nodes.add_mesh_simple(
            name,
            np.zeros((3, 3), np.float32),
            np.array([[0, 1, 2]], np.uint32),
            color=colours.part_colour(label),
            opacity=opacity,
            side=side,
            visible=False,
            cast_shadow=False,
            receive_shadow=False,
        )

    def _put_points(
        self, node: PointCloudHandle, points: np.ndarray, colour: UInt8[np.ndarray, "n 3"] | tuple
    ) -> None:
        node.points = points.astype(np.float32)
        node.colors = np.asarray(colour, np.uint8)

    def _put_labelled(self, placed: TransformedEstimate) -> None:
        if self.options.points == "none":
            return
        least = 2 if self.options.points == "tumors" else 1
        some = thinned(np.flatnonzero(placed.labels >= least), _MOST_LABELLED)
        if self.options.by_probability:
            colour = colours.probability_colours(placed.probability[some])
        else:
            colour = colours.label_colours(placed.labels[some])
        self._put_points(self._points, placed.points_mm[some], colour)

    def _margins_of(self, result: TrackingResult, placed: TransformedEstimate) -> dict[str, Mesh]:
        assert result.estimate is not None
        tumors = {n: m for n, m in placed.meshes.items() if n in self._shells}
        motion = result.estimate.motion
        if self._margins_ct is None or motion is None:
            return {name: rough_margin(mesh, self._margin_mm) for name, mesh in tumors.items()}
        way = result.published_frame.published_from_camera
        at_rest = dict(zip(self._shells, self._margins_ct, strict=True))
        return {
            name: at_rest[name].moved(
                transform_points(way, motion.carry(at_rest[name].vertices_mm))
            )
            for name in tumors
        }

    def _bare(self, organ: Mesh) -> Mesh:
        """The organ's surface where it is no tumor's, if its triangles are those of the CT."""
        at_rest = self._anatomy_ct
        if at_rest is None or not np.array_equal(at_rest.organ.faces, organ.faces):
            return organ
        return Mesh(organ.vertices_mm, self._bare_faces)


def _put_mesh(node: MeshHandle, mesh: Mesh) -> None:
    if not np.array_equal(node.faces, mesh.faces):
        node.faces = mesh.faces.astype(np.uint32)
    node.vertices = mesh.vertices_mm.astype(np.float32)
