"""The viewer's 3-D scene: what was seen, what was estimated, what arms do; published frame, mm.

Every node is made once and then changed in place, so that clients keep their buffers. Calls must
not overlap: the sink holds a lock round them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tumortrack.core import colours
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack.live import values as live
from tumortrack.live.display import MOST_SEEN, seen_colours, seen_points, thinned, wxyz_of
from tumortrack.live.values import TrackingResult, TransformedEstimate
from tumortrack.live.viewer.look import Viewpoint
from tumortrack.live.viewer.slices import SlicePlane
from tumortrack.live.viewer.surfaces import bare_faces
from tumortrack.models.margins import stated_radius
from tumortrack.tracking.shells import exact_margin, rough_margin

if TYPE_CHECKING:
    from viser import MeshHandle, PointCloudHandle, ViserServer

_MOST_LABELLED = 15_000  # points shown
# Standard deviations of the ellipsoid that holds 95 % of a normal distribution in three dimensions:
# the root of the 95 % quantile of chi squared with three degrees of freedom.
_ELLIPSOID = 2.7955
_ELLIPSOID_COLOUR = 255, 255, 255  # stands out from every part
_TUMOR_WITH_POINTS = 0.3  # opacity
# Size of points: small, they lie over the tumors; of what was seen, while a click is asked for.
_SEEN_MM, _ORGAN_MM, _LOOKED_AT_MM = 0.15, 0.15, 1.0
_NO_POINTS = np.zeros((0, 3), np.float32)
_NOTHING = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a) if abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]
_FLAT: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
_HAIRLINE: dict[str, Any] = {"thickness": 1.0, "thickness_units": "screen", "visible": False}


@dataclass(frozen=True, kw_only=True)
class DisplayOptions:
    """What the user wants to see."""

    observed: bool = True
    organ: float = 0.35  # opacity
    margin: bool = True
    structures: bool = True
    ellipsoids: bool = False
    points: str = "none"  # none | tumors | all
    slice_plane: bool = False
    helpers: bool = True  # axes and the region of the organ's points


class ViewerScene:
    """viser's nodes, and what goes into them."""

    def __init__(
        self, server: ViserServer, context: live.SinkContext, margin_mm: float | None
    ) -> None:
        self._nodes, self._margin_mm = server.scene, margin_mm
        self._way = context.published_frame.published_from_camera
        self._at_rest, self._margins_ct = context.anatomy_ct, None
        if self._at_rest is not None:
            self._bare_faces = bare_faces(self._at_rest)
            if margin_mm:
                self._margins_ct = [exact_margin(part, margin_mm) for part in self._at_rest.tumors]
        self.options = DisplayOptions()
        self.margins: dict[str, Mesh] = {}  # of the shown estimate, published frame
        self._shown: tuple[TrackingResult, TransformedEstimate] | None = None
        self._has_organ = self._has_slice = self._looks_at_colours = False
        self.look = Viewpoint(server, self._way)
        self._make_nodes(context)

    def _make_nodes(self, context: live.SinkContext) -> None:
        nodes = self._nodes
        turn, eye_mm = wxyz_of(self._way[:3, :3]), self._way[:3, 3]
        self._axes = nodes.add_frame(
            "/camera", axes_length=12.0, axes_radius=0.35, wxyz=turn, position=eye_mm
        )
        self._seen = self._cloud("/seen", _SEEN_MM, colours.SEEN)
        self._organ = self._cloud("/organ", _ORGAN_MM, colours.ORGAN)
        blank = np.zeros((12, 2, 3), np.float32)
        self._region = nodes.add_line_segments("/region", blank, colours.REGION, **_HAIRLINE)
        self._picked = nodes.add_icosphere(
            "/picked", radius=1.5, color=colours.PICKED, visible=False, cast_shadow=False
        )
        nodes.add_frame("/estimate", show_axes=False)
        self._shells, self._parts, self._ellipsoids = {}, {}, {}
        self._name = context.parts[0]
        for label, name in enumerate(context.parts, start=1):
            look = {"color": colours.part_colour(label), "visible": False}
            if label > 1 and self._margin_mm != 0:
                # Its far half: the near one would cover the organ that it reaches out of.
                path = f"/estimate/margin_{name}"
                self._shells[name] = self._mesh(path, _NOTHING, opacity=0.3, side="back", **look)
            opacity = 0.35 if label == 1 else None
            path = f"/estimate/{name}"
            self._parts[name] = self._mesh(path, _NOTHING, opacity=opacity, **look)
            if label > 1:
                path = f"/estimate/ellipsoid_{name}"
                look |= {"color": _ELLIPSOID_COLOUR, "opacity": 0.8}
                self._ellipsoids[name] = self._mesh(path, _NOTHING, **look)
        self._structures = {}
        for number, name in enumerate(context.structures):
            colour = colours.structure_colour(number)
            self._structures[name] = self._mesh(
                f"/estimate/{name}", _NOTHING, color=colour, side="double", visible=False
            )
        self._points = self._cloud("/estimate/points", 0.3, colours.ORGAN_PART)
        clear = np.zeros((2, 2, 4), np.uint8)
        self._slice = nodes.add_image("/estimate/slice", clear, 1, 1, format="png", **_FLAT)
        self._cell = nodes.add_frame("/workcell", show_axes=False, visible=False)
        self._drawn: dict[str, tuple[object, np.ndarray, Any]] = {}  # look, place and node by name

    def _cloud(self, name: str, size_mm: float, colour: colours.Colour) -> PointCloudHandle:
        return self._nodes.add_point_cloud(
            name,
            _NO_POINTS,
            np.array(colour, np.uint8),
            point_size=size_mm,
            point_shape="circle",
            point_shading="flat",
            precision="float32",  # half precision is 0.125 mm at 150 mm
        )

    def _mesh(self, name: str, mesh: Mesh, **look: Any) -> MeshHandle:
        vertices, faces = mesh.vertices_mm.astype(np.float32), mesh.faces.astype(np.uint32)
        return self._nodes.add_mesh_simple(name, vertices, faces, **_FLAT, **look)

    def observe(self, result: TrackingResult) -> None:
        """Show what this result saw; nothing, if it saw nothing."""
        seen = _NO_POINTS if result.observation is None else seen_points(result.observation)
        organ = _NO_POINTS if result.organ is None else result.organ.points_mm
        beside = np.ones(len(seen), bool)
        if len(organ) and not self._looks_at_colours:
            beside = ~_before(seen, organ)
        if not np.array_equal(way := result.published_frame.published_from_camera, self._way):
            self._way, self._axes.position = way, way[:3, 3]
            self._axes.wxyz = wxyz_of(way[:3, :3])
        for node, points in ((self._seen, seen[beside]), (self._organ, organ)):
            there = transform_points(self._way, thinned(points, MOST_SEEN))
            node.points = there.astype(np.float32)
        picture = None if result.observation is None else seen_colours(result.observation)
        self._seen.colors = np.array(colours.SEEN, np.uint8) if picture is None else picture[beside]
        if len(organ):
            lower, upper = organ.min(0), organ.max(0)
            corners = transform_points(self._way, lower + _CORNERS * (upper - lower))
            self._region.points = corners[_EDGES].astype(np.float32)
            self.look.aim(float(np.median(organ[:, 2])), self._way)
        self._has_organ = len(organ) > 0

    def show(self, result: TrackingResult) -> None:
        """Show this result's estimate, which it must have."""
        placed = result.transformed
        assert placed is not None
        self._put_asked_for(result, placed)
        self.margins = self._margins_of(result, placed)
        for name, node in self._parts.items():
            mesh = placed.meshes.get(name, _NOTHING)
            shown = self.look.last_drawn(self._bare(mesh)) if name == self._name else mesh
            _put_mesh(node, shown)
        for name, node in self._shells.items():
            _put_mesh(node, self.margins.get(name, _NOTHING))
        for name, node in self._structures.items():
            _put_mesh(node, placed.structures.get(name, _NOTHING))
        self._shown = result, placed
        self.apply()

    def hide(self) -> None:
        """Nothing of any estimate stays. Surfaces are emptied, not made invisible: browsers show
        the one a frame later than the other, and old surfaces could not come back."""
        shown = self._parts, self._shells, self._ellipsoids, self._structures
        for node in chain.from_iterable(group.values() for group in shown):
            _put_mesh(node, _NOTHING)
        self._points.points, self._points.colors = _NO_POINTS, _NO_POINTS.astype(np.uint8)
        self._shown = None
        self._has_slice = self._slice.visible = False
        self.margins = {}

    def apply(self) -> None:
        """Show and hide nodes by the options and by what there is."""
        options = self.options
        self._seen.visible = options.observed
        self._organ.visible = options.observed and not self._looks_at_colours
        self._axes.visible = options.helpers
        self._region.visible = options.helpers and self._has_organ
        if self._shown is None:
            return
        for name, node in self._parts.items():
            node.visible = name != self._name or options.organ > 0
            if name != self._name:  # solid, unless something is to be seen in it
                looked_into = options.points != "none" or options.ellipsoids
                node.opacity = _TUMOR_WITH_POINTS if looked_into else None
        for node in self._shells.values():
            node.visible = options.margin
        for node in self._ellipsoids.values():
            node.visible = options.ellipsoids
        for node in self._structures.values():
            node.visible = options.structures
        self._parts[self._name].opacity = options.organ
        self._points.visible = options.points != "none"
        self._slice.visible = options.slice_plane and self._has_slice

    def change(self, options: DisplayOptions) -> None:
        """What the user wants to see is another."""
        self.options = options
        if self._shown is not None:
            self._put_asked_for(*self._shown)
        self.apply()

    def put_slice(
        self,
        picture: UInt8[np.ndarray, "h w 3"],
        plane: SlicePlane,
        published_from_camera: Float[np.ndarray, "4 4"],
    ) -> None:
        """The slice as a plane of the scene, at its true place."""
        self._has_slice = self.options.slice_plane
        if not self._has_slice:
            return  # what was there is old by the time it is asked for
        # viser lays a picture's columns along x and its rows along y.
        axes = np.stack([plane.across, plane.down, np.cross(plane.across, plane.down)], axis=1)
        self._slice.position = transform_points(published_from_camera, plane.centre_mm[None])[0]
        self._slice.wxyz = wxyz_of(published_from_camera[:3, :3] @ axes)
        self._slice.render_width = self._slice.render_height = plane.side_mm
        solid = (picture > 8).any(2, keepdims=True)
        self._slice.image = np.concatenate([picture, solid.astype(np.uint8) * 255], axis=2)
        self.apply()

    def look_at_colours(self, asked: bool) -> None:
        """Nothing lies over what was seen, and it is seen well, as long as a click is asked for."""
        self._looks_at_colours = asked
        self._seen.point_size = _LOOKED_AT_MM if asked else _SEEN_MM
        self.apply()

    def mark(self, point_mm: Float[np.ndarray, " 3"] | None) -> None:
        """Where the user clicked (published frame); None: nowhere."""
        self._picked.visible = point_mm is not None
        if point_mm is not None:
            self._picked.position = point_mm

    def show_cell(self, cell: live.Workcell | None) -> None:
        """Show what arms do, and nothing of what was shown before; None: nothing. A shape's surface
        goes to the page once, then only its place."""
        self._cell.visible = cell is not None
        if cell is None:
            return
        shapes = {f"shape/{shape.name}": shape for shape in cell.shapes}
        lines = {f"line/{line.name}": line for line in cell.drawn_lines}
        for name in self._drawn.keys() - shapes.keys() - lines.keys():
            self._drawn.pop(name)[2].remove()
        places = np.array([shape.published_from_shape for shape in cell.shapes]).reshape(-1, 4, 4)
        turns = wxyz_of(places[:, :3, :3]) if len(places) else ()  # all at once: 5 times quicker
        for (name, shape), wxyz in zip(shapes.items(), turns, strict=True):
            look = {"mesh": shape.mesh, "color": shape.colour, "opacity": shape.opacity}
            node = self._placed_node(name, shape.published_from_shape, self._add_shape, look)
            if node is not None:
                node.position, node.wxyz = shape.published_from_shape[:3, 3], wxyz
        for name, line in lines.items():
            points = line.points_mm.astype(np.float32)
            segments = np.stack([points[:-1], points[1:]], axis=1)
            look = {"colors": line.colour, "thickness": line.width_mm, "thickness_units": "world"}
            add = partial(self._nodes.add_line_segments, points=segments)
            if (node := self._placed_node(name, line.points_mm, add, look)) is not None:
                node.points = segments
        self.look.oversee(cell)

    def _placed_node(
        self, name: str, place: np.ndarray, add: Callable[..., Any], look: dict[str, Any]
    ) -> Any | None:
        """The node to be moved, made anew where it looks otherwise; None: it lies there already."""
        before, there, node = self._drawn.get(name, (None, None, None))
        if before != look:
            kind, _, own = name.partition("/")
            # Without further slashes: to viser they say that one node moves with another.
            node, there = add(f"/workcell/{kind}/{own.replace('/', ':')}", **look), None
        self._drawn[name] = look, place, node
        return None if there is not None and np.array_equal(there, place) else node

    def _add_shape(self, name: str, opacity: float, **look: Any) -> MeshHandle:
        # A mesh with an opacity is drawn as translucent, and sorted.
        solid = opacity if opacity < 1 else None
        return self._mesh(name, opacity=solid, flat_shading=True, **look)

    def _put_asked_for(self, result: TrackingResult, placed: TransformedEstimate) -> None:
        """What is computed and sent only if the user wants to see it."""
        if self.options.ellipsoids:
            for name, node in self._ellipsoids.items():
                _put_mesh(node, self._ellipsoid(result, name))
        if self.options.points == "none":
            return
        least = 2 if self.options.points == "tumors" else 1
        some = thinned(np.flatnonzero(placed.labels >= least), _MOST_LABELLED)
        self._points.points = placed.points_mm[some].astype(np.float32)
        self._points.colors = colours.label_colours(placed.labels[some])

    def _margins_of(self, result: TrackingResult, placed: TransformedEstimate) -> dict[str, Mesh]:
        assert result.estimate is not None
        tumors = {n: m for n, m in placed.meshes.items() if n in self._shells}
        motion = result.estimate.motion
        if self._margin_mm is None:
            margin = result.estimate.report.margin
            radii = {name: stated_radius(margin, name) for name in tumors}
            return {n: rough_margin(tumors[n], radius.mm) for n, radius in radii.items() if radius}
        if self._margins_ct is None or motion is None:
            return {name: rough_margin(mesh, self._margin_mm) for name, mesh in tumors.items()}
        return {
            name: margin.moved(transform_points(self._way, motion.carry(margin.vertices_mm)))
            for name, margin in zip(self._shells, self._margins_ct, strict=True)
            if name in tumors
        }

    @cached_property
    def _ball(self) -> Mesh:
        from trimesh.creation import icosphere

        ball = icosphere(3)
        return Mesh(ball.vertices, ball.faces)

    def _ellipsoid(self, result: TrackingResult, name: str) -> Mesh:
        """Where the middle of a tumor lies with 95 % probability, if the fit's own covariance were
        all there is to know; published frame. Nothing without a motion."""
        assert result.estimate is not None
        motion, part = result.estimate.motion, result.estimate.report.parts.get(name)
        if self._at_rest is None or motion is None or part is None or part.center_axes is None:
            return _NOTHING
        at_rest = dict(zip(self._at_rest.names, self._at_rest.parts, strict=True))[name]
        middle_mm = motion.carry(at_rest.box_mm.mean(0, keepdims=True))
        radii_mm = _ELLIPSOID * np.array(part.center_axes_std_mm)
        places_mm = middle_mm + (self._ball.vertices_mm * radii_mm) @ np.array(part.center_axes)
        return self._ball.moved(transform_points(self._way, places_mm))

    def _bare(self, organ: Mesh) -> Mesh:
        """The organ's surface where it is no tumor's, if its triangles are those of the CT."""
        if self._at_rest is None or not np.array_equal(self._at_rest.organ.faces, organ.faces):
            return organ
        return Mesh(organ.vertices_mm, self._bare_faces)


def _put_mesh(node: MeshHandle, mesh: Mesh) -> None:
    if not np.array_equal(node.faces, mesh.faces):
        node.faces = mesh.faces.astype(np.uint32)
    node.vertices = mesh.vertices_mm.astype(np.float32)


def _before(
    points_mm: Float[np.ndarray, "n 3"], organ_mm: Float[np.ndarray, "m 3"]
) -> Bool[np.ndarray, " n"]:
    """Which points the camera sees within or before the organ's: they would cover the tumors."""
    sides, there = (xyz[:, :2] / np.maximum(xyz[:, 2:], 1.0) for xyz in (organ_mm, points_mm))
    inside = ((there >= sides.min(0)) & (there <= sides.max(0))).all(1)
    return inside & (points_mm[:, 2] <= organ_mm[:, 2].max())
