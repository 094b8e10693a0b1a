"""The viewer's 3-D scene: observation, estimate, controller; published frame, mm.

Every node is made once and then changed in place, so that clients keep their buffers. Calls must
not overlap: the sink holds a lock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8

from tumortrack.core import colours
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import exact_margin, rough_margin, surface_distance
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.live import values as live
from tumortrack.live.values import TrackingResult, TransformedEstimate
from tumortrack.report.slices import SlicePlane
from tumortrack_devices.display import MOST_SEEN, seen_colours, seen_points, thinned, wxyz_of
from tumortrack_devices.extra_status import ExtraStatus
from tumortrack_devices.viewer.look import Viewpoint

if TYPE_CHECKING:
    from viser import MeshHandle, PointCloudHandle, ViserServer

_MOST_LABELLED = 15_000  # points shown
_TUMOR_WITH_POINTS = 0.3  # opacity
_SEEN_MM, _ORGAN_MM = 0.15, 0.15  # size of points: small, they lie over the tumors
_CLICKABLE_MM = 1.0  # of observed points, while a click is expected
_TOUCH_MM, _KNOWN_MM, _CONTRADICTING_MM = 2.0, 1.2, 1.8  # radii of their points
# Which corner of its label lies at a place to touch next, the best first: apart from each other.
_CORNERS_AT: tuple[Any, ...] = ("bottom-left", "top-left", "top-right")
_SAME_MM = 0.4  # between surfaces that coincide
_NO_POINTS = np.zeros((0, 3), np.float32)
_NOTHING = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a) if abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]
_FLAT: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
_HAIRLINE: dict[str, Any] = {"thickness": 1.0, "thickness_units": "screen", "visible": False}


@dataclass(frozen=True, kw_only=True)
class DisplayOptions:
    observed: bool = True
    organ: float = 0.35  # opacity
    margin: bool = True
    structures: bool = True
    evidence: bool = True  # and what to touch next
    points: str = "none"  # none | tumors | all
    slice_plane: bool = False
    helpers: bool = True  # axes and the region of the organ's points


class ViewerScene:
    def __init__(
        self, server: ViserServer, context: live.SinkContext, margin_mm: float | None
    ) -> None:
        self._nodes, self._margin_mm = server.scene, margin_mm
        self._pose = context.published_frame.published_from_camera
        self._at_rest, self._margins_ct = context.anatomy_ct, None
        if self._at_rest is not None:
            self._faces, self._bare_faces = self._at_rest.organ.faces, bare_faces(self._at_rest)
            if margin_mm:
                self._margins_ct = [exact_margin(part, margin_mm) for part in self._at_rest.tumors]
        self.options = DisplayOptions()
        self.extra_status = ExtraStatus()  # the sink keeps it up to date
        self.margins: dict[str, Mesh] = {}  # of the shown estimate, published frame
        self._shown: tuple[TrackingResult, TransformedEstimate] | None = None
        self._in_sight = list[bool]()  # of places to touch next: no tumor is in front
        self._has_organ = self._has_slice = self._clickable = False
        self.look = Viewpoint(server, self._pose)
        self._make_nodes(context)

    def _make_nodes(self, context: live.SinkContext) -> None:
        nodes = self._nodes
        turn, eye_mm = wxyz_of(self._pose[:3, :3]), self._pose[:3, 3]
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
        self._shells, self._parts = {}, {}
        self._name = context.parts[0]
        for label, name in enumerate(context.parts, start=1):
            look = {"color": colours.part_colour(label), "visible": False}
            if label > 1 and self._margin_mm != 0:
                # Only its far half: the near one would cover the organ.
                path = f"/estimate/margin_{name}"
                self._shells[name] = self._mesh(path, _NOTHING, opacity=0.3, side="back", **look)
            opacity = 0.35 if label == 1 else None
            path = f"/estimate/{name}"
            self._parts[name] = self._mesh(path, _NOTHING, opacity=opacity, **look)
        self._structures = {}
        for number, name in enumerate(context.structures):
            colour = colours.structure_colour(number)
            self._structures[name] = self._mesh(
                f"/estimate/{name}", _NOTHING, color=colour, side="double", visible=False
            )
        self._points = self._cloud("/estimate/points", 0.3, colours.ORGAN_PART)
        self._spots = {
            "next": self._cloud("/estimate/next", _TOUCH_MM, colours.TO_CUT),
            "known": self._cloud("/estimate/known", _KNOWN_MM, colours.WHITE),
            "contradicting": self._cloud(
                "/estimate/contradicting", _CONTRADICTING_MM, colours.NONE, "diamond"
            ),
        }
        self._labels = [
            nodes.add_label(f"/estimate/next_{n}", "", visible=False, anchor=corner)
            for n, corner in enumerate(_CORNERS_AT)
        ]
        clear = np.zeros((2, 2, 4), np.uint8)
        self._slice = nodes.add_image("/estimate/slice", clear, 1, 1, format="png", **_FLAT)
        self._control = nodes.add_frame("/workcell", show_axes=False, visible=False)
        # Look, place and node by name
        self._drawn: dict[str, tuple[dict[str, Any], np.ndarray, Any]] = {}

    def _cloud(
        self,
        name: str,
        size_mm: float,
        colour: colours.Colour,
        shape: Literal["circle", "diamond"] = "circle",
    ) -> PointCloudHandle:
        return self._nodes.add_point_cloud(
            name,
            _NO_POINTS,
            np.array(colour, np.uint8),
            point_size=size_mm,
            point_shape=shape,
            point_shading="flat",
            precision="float32",  # half precision is 0.125 mm at 150 mm
        )

    def _mesh(self, name: str, mesh: Mesh, **look: Any) -> MeshHandle:
        vertices, faces = mesh.vertices_mm.astype(np.float32), mesh.faces.astype(np.uint32)
        return self._nodes.add_mesh_simple(name, vertices, faces, **_FLAT, **look)

    def observe(self, result: TrackingResult) -> None:
        """Show the observed points, if any."""
        seen = _NO_POINTS if result.observation is None else seen_points(result.observation)
        organ = _NO_POINTS if result.organ is None else result.organ.points_mm
        shown = np.ones(len(seen), bool)
        if len(organ) and not self._clickable:
            shown = ~_before(seen, organ)
        if not np.array_equal(pose := result.published_frame.published_from_camera, self._pose):
            self._pose, self._axes.position = pose, pose[:3, 3]
            self._axes.wxyz = wxyz_of(pose[:3, :3])
        for node, points in ((self._seen, seen[shown]), (self._organ, organ)):
            published = transform_points(self._pose, thinned(points, MOST_SEEN))
            node.points = published.astype(np.float32)
        picture = None if result.observation is None else seen_colours(result.observation)
        self._seen.colors = np.array(colours.SEEN, np.uint8) if picture is None else picture[shown]
        if len(organ):
            lower, upper = organ.min(0), organ.max(0)
            corners = transform_points(self._pose, lower + _CORNERS * (upper - lower))
            self._region.points = corners[_EDGES].astype(np.float32)
            self.look.aim(float(np.median(organ[:, 2])), self._pose)
        self._has_organ = len(organ) > 0

    def show(self, result: TrackingResult) -> None:
        """Show the estimate of a result that has one."""
        estimate = result.transformed
        assert estimate is not None
        self._put_optional(result, estimate)
        self.margins = self._margins_of(result, estimate)
        meshes = {**estimate.meshes}
        if self._name in meshes:
            meshes[self._name] = self.look.last_drawn(self._bare(meshes))
        groups = (self._parts, meshes), (self._shells, self.margins)
        for nodes, surfaces in (*groups, (self._structures, estimate.structures)):
            for name, node in nodes.items():
                _put_mesh(node, surfaces.get(name, _NOTHING))
        tumors = [mesh for name, mesh in estimate.meshes.items() if name != self._name]
        self._put_extra_status(self.extra_status, tumors)
        self._shown = result, estimate
        self.apply()

    def _bare(self, meshes: Mapping[str, Mesh]) -> Mesh:
        """The organ's surface without what is also a tumor's, where it has the same triangles from
        frame to frame: with a motion, until more is cut of it."""
        organ = meshes[self._name]
        if self._at_rest is None:
            return organ
        if not np.array_equal(self._faces, organ.faces):
            self._faces = organ.faces
            self._bare_faces = bare_faces(Anatomy(tuple(meshes.values())))
        return Mesh(organ.vertices_mm, self._bare_faces)

    def hide(self) -> None:
        """Remove the estimate. Surfaces are emptied, not made invisible: browsers show one a frame
        later than the other, and old surfaces must not reappear."""
        for group in (self._parts, self._shells, self._structures):
            for node in group.values():
                _put_mesh(node, _NOTHING)
        self._put_extra_status(ExtraStatus())
        self._points.points, self._points.colors = _NO_POINTS, _NO_POINTS.astype(np.uint8)
        self._shown = None
        self._has_slice = self._slice.visible = False
        self.margins = {}

    def apply(self) -> None:
        """Set the visibility of all nodes."""
        options = self.options
        self._seen.visible = options.observed
        self._organ.visible = options.observed and not self._clickable
        self._axes.visible = options.helpers
        self._region.visible = options.helpers and self._has_organ
        if self._shown is None:
            return
        for name, node in self._parts.items():
            node.visible = name != self._name or options.organ > 0
            if name != self._name:  # opaque, except to show its inside
                node.opacity = _TUMOR_WITH_POINTS if options.points != "none" else None
        for node in self._shells.values():
            node.visible = options.margin
        for node in self._structures.values():
            node.visible = options.structures
        for spots in self._spots.values():
            spots.visible = options.evidence
        for label, in_sight in zip(self._labels, self._in_sight, strict=False):
            label.visible = options.evidence and in_sight
        self._parts[self._name].opacity = options.organ
        self._points.visible = options.points != "none"
        self._slice.visible = options.slice_plane and self._has_slice

    def change(self, options: DisplayOptions) -> None:
        self.options = options
        if self._shown is not None:
            self._put_optional(*self._shown)
        self.apply()

    def put_slice(
        self,
        picture: UInt8[np.ndarray, "h w 3"],
        plane: SlicePlane,
        published_from_camera: Float[np.ndarray, "4 4"],
    ) -> None:
        """Show the slice at its true pose."""
        self._has_slice = self.options.slice_plane
        if not self._has_slice:
            return
        # viser lays a picture's columns along x and its rows along y.
        axes = np.stack([plane.across, plane.down, np.cross(plane.across, plane.down)], axis=1)
        self._slice.position = transform_points(published_from_camera, plane.centre_mm[None])[0]
        self._slice.wxyz = wxyz_of(published_from_camera[:3, :3] @ axes)
        self._slice.render_width = self._slice.render_height = plane.side_mm
        solid = (picture > 8).any(2, keepdims=True)
        self._slice.image = np.concatenate([picture, solid.astype(np.uint8) * 255], axis=2)
        self.apply()

    def look_at_colours(self, asked: bool) -> None:
        """While a click is expected, show observed points large, and nothing over them."""
        self._clickable = asked
        self._seen.point_size = _CLICKABLE_MM if asked else _SEEN_MM
        self.apply()

    def mark(self, point_mm: Float[np.ndarray, " 3"] | None) -> None:
        """Mark where the user clicked (published frame); None: nowhere."""
        self._picked.visible = point_mm is not None
        if point_mm is not None:
            self._picked.position = point_mm

    def show_control(self, control: live.ControlState | None) -> None:
        """Show what a controller does; None: nothing. A shape's surface is sent once, then only its
        pose and its colour."""
        self._control.visible = control is not None
        if control is None:
            return
        shapes = {f"shape/{shape.name}": shape for shape in control.shapes}
        lines = {f"line/{line.name}": line for line in control.drawn_lines}
        for name in self._drawn.keys() - shapes.keys() - lines.keys():
            self._drawn.pop(name)[2].remove()
        poses = np.array([shape.published_from_shape for shape in control.shapes]).reshape(-1, 4, 4)
        turns = wxyz_of(poses[:, :3, :3]) if len(poses) else ()  # all at once: 5 times faster
        for (name, shape), wxyz in zip(shapes.items(), turns, strict=True):
            # None: opaque. With any opacity a mesh is drawn as translucent, and sorted.
            opacity = shape.opacity if shape.opacity < 1 else None
            look = {"mesh": shape.mesh, "color": shape.colour, "opacity": opacity}
            add: Callable[..., Any] = partial(self._mesh, flat_shading=True)
            node = self._placed_node(name, shape.published_from_shape, add, look)
            if node is not None:
                node.position, node.wxyz = shape.published_from_shape[:3, 3], wxyz
        for name, line in lines.items():
            points = line.points_mm.astype(np.float32)
            segments = np.stack([points[:-1], points[1:]], axis=1)
            look = {"colors": line.colour, "thickness": line.width_mm, "thickness_units": "world"}
            add = partial(self._nodes.add_line_segments, points=segments)
            if (node := self._placed_node(name, line.points_mm, add, look)) is not None:
                node.points = segments
        self.look.show_control(control)

    def _placed_node(
        self, name: str, place: np.ndarray, add: Callable[..., Any], look: dict[str, Any]
    ) -> Any | None:
        """The node to be moved, coloured or replaced if it looks different; None: it is in
        place."""
        unseen: tuple[dict[str, Any], np.ndarray | None, Any] = {}, None, None
        before, present, node = self._drawn.get(name, unseen)
        if before and before != look and {**before, "color": look.get("color")} == look:
            node.color = look["color"]
        elif before != look:
            kind, _, own = name.partition("/")
            # Further slashes would make a node move with another in viser.
            node, present = add(f"/workcell/{kind}/{own.replace('/', ':')}", **look), None
        self._drawn[name] = look, place, node
        return None if present is not None and np.array_equal(present, place) else node

    def _put_optional(self, result: TrackingResult, estimate: TransformedEstimate) -> None:
        """What is computed and sent only if the user wants to see it."""
        if self.options.points == "none":
            return
        least = 2 if self.options.points == "tumors" else 1
        some = thinned(np.flatnonzero(estimate.labels >= least), _MOST_LABELLED)
        self._points.points = estimate.points_mm[some].astype(np.float32)
        self._points.colors = colours.label_colours(estimate.labels[some])

    def _put_extra_status(self, extra_status: ExtraStatus, tumors: Sequence[Mesh] = ()) -> None:
        """What to touch next, and the evidence; their labels are made visible by ``apply``. A label
        is drawn over everything: that of a place behind a tumor is left out."""
        touches = extra_status.touches[: len(self._labels)]
        places = {
            "next": np.reshape([touch.place_mm for touch in touches], (-1, 3)),
            "known": extra_status.known_mm,
            "contradicting": extra_status.contradicting_mm,
        }
        for name, places_mm in places.items():
            self._spots[name].points = places_mm.astype(np.float32)
        self._in_sight = [not self.look.hidden(touch.place_mm, tumors) for touch in touches]
        for label in self._labels[len(touches) :]:
            label.visible = False
        for label, touch in zip(self._labels, touches, strict=False):
            label.text, label.position = touch.label, touch.place_mm

    def _margins_of(self, result: TrackingResult, estimate: TransformedEstimate) -> dict[str, Mesh]:
        assert result.estimate is not None
        tumors = {n: m for n, m in estimate.meshes.items() if n in self._shells}
        motion = result.estimate.motion
        if self._margin_mm is None:
            known = tumors.keys() & result.bounds.keys()
            return {n: rough_margin(tumors[n], result.bounds[n].error_bound95_mm) for n in known}
        if self._margins_ct is None or motion is None:
            return {name: rough_margin(mesh, self._margin_mm) for name, mesh in tumors.items()}
        return {
            name: margin.with_vertices(
                transform_points(self._pose, motion.forward(margin.vertices_mm))
            )
            for name, margin in zip(self._shells, self._margins_ct, strict=True)
            if name in tumors
        }


def _put_mesh(node: MeshHandle, mesh: Mesh) -> None:
    if not np.array_equal(node.faces, mesh.faces):
        node.faces = mesh.faces.astype(np.uint32)
    node.vertices = mesh.vertices_mm.astype(np.float32)


def _before(
    points_mm: Float[np.ndarray, "n 3"], organ_mm: Float[np.ndarray, "m 3"]
) -> Bool[np.ndarray, " n"]:
    """Which points the camera sees inside or in front of the organ: they would cover the tumors."""
    organ, points = (xyz[:, :2] / np.maximum(xyz[:, 2:], 1.0) for xyz in (organ_mm, points_mm))
    inside = ((points >= organ.min(0)) & (points <= organ.max(0))).all(1)
    return inside & (points_mm[:, 2] <= organ_mm[:, 2].max())


def bare_faces(anatomy: Anatomy) -> Int32[np.ndarray, "f 3"]:
    """The organ's triangles that are not also a tumor's: where a tumor bulges out of the organ both
    have the same surface, and drawn together they flicker."""
    organ = anatomy.organ
    shared = np.zeros(len(organ.vertices_mm), bool)
    for tumor in anatomy.tumors:
        shared |= surface_distance(tumor, organ.vertices_mm) < _SAME_MM
    return organ.faces[~shared[organ.faces].all(1)]
