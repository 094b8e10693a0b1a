"""ROS messages of a tracking result. Millimetres in, metres and radians out.

Every message has the result's stamp and frame. Without an estimate each topic says so: an empty
cloud, deleted markers, NaN positions, a diagnostic with the reason.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from textwrap import fill
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from tumortrack.core import colours
from tumortrack.core.colours import Colour
from tumortrack.core.geometry import transform_points
from tumortrack.core.organ import is_tumor, organ_name
from tumortrack.core.types import Mesh, SensorCloud
from tumortrack.live.values import (
    ControlState,
    RigidShape,
    SinkContext,
    TrackingResult,
    TransformedEstimate,
)
from tumortrack_devices.display import MOST_SEEN, seen_points, thinned
from tumortrack_devices.extra_status import ExtraStatus
from tumortrack_devices.network import Rate
from tumortrack_devices.ros.crtk import crtk_messages
from tumortrack_devices.ros.messages import MM_PER_M, Messages, Outgoing, PointBlock, xyz
from tumortrack_devices.ros.sensors import CLOUD, cloud_message, plain_cloud
from tumortrack_devices.ros.tf import TRANSFORMS, transform_fields

MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
PLACE = "geometry_msgs/msg/PointStamped"
JOINTS = "sensor_msgs/msg/JointState"
# Topics of what does not deform, sent when it changes and kept for who comes later: what stands
# still, and what moves, each surface in a frame of its own
PLANNED, LINKS = LATCHED = "planned", "links"

_STATE = "state"  # the marker namespace of the arms' text
_DELETE, _DELETE_ALL = 2, 3  # Marker's actions
_LINE, _SPHERES, _TEXT, _TRIANGLES = 4, 7, 9, 11  # and types
_LIFETIME_S = 2  # of markers, so that a stopped loop leaves nothing that looks current
_STATUS_HZ = 1.0  # of /diagnostics, as rqt's monitor expects; and at once when a level changes
_RATE_OVER = 30  # results
_OK, _WARN, _ERROR, _STALE = range(4)  # DiagnosticStatus
_LEVELS = {"good": _OK, "poor": _WARN, "none": _ERROR}
_STATE_COLOUR: Colour = (235, 238, 242)
ORGAN_OPACITY = 0.35
_TEXT_HEIGHT_M, _STATE_HEIGHT_M = 0.008, 0.025
_TEXT_COLUMNS, _STATE_COLUMNS = 44, 70  # RViz does not wrap: long lines leave the screen
_GAP_M = 0.012  # between lines, besides their height: measured in RViz of ROS 1; RViz 2 has 0.005
_ORIGIN = np.zeros(3)
# Namespaces, colours and radii (m) of what to touch next, and of evidence in use and left out.
_NEXT, _NEXT_TEXT = "next_touch", "next_touch_text"
_SPOTS = {
    _NEXT: (colours.TO_CUT, 0.002),
    "evidence": (colours.WHITE, 0.001),
    "contradicting": (colours.NONE, 0.0015),
}

_POINT = np.dtype(
    [(name, "<f4") for name in "xyz"] + [("label", "u1"), ("probability", "<f4"), ("rgb", "<u4")],
    align=True,
)


class ResultMessages:
    """The messages of one publisher. It remembers the markers that it sent, to delete those that
    are gone.

    ``namespace``: of the topics and of tf frames. ``hz``: limit for triangles, the arms' markers
    and observed points (0: with every result). Without ``observed`` those points are left out, and
    the words of CRTK: a recording has the image and the report instead.
    """

    def __init__(
        self,
        messages: Messages,
        context: SinkContext,
        hz: float = 0.0,
        observed: bool = True,
        namespace: str = "/tumortrack",
    ) -> None:
        self._messages, self._context, self._observed = messages, context, observed
        self._namespace = namespace.removeprefix("/")
        self._status_rate, self._levels = Rate(_STATUS_HZ), list[int]()
        self._times_s = deque[float](maxlen=_RATE_OVER)  # of the latest results
        self._meshes_rate, self._markers_rate, self._points_rate = Rate(hz), Rate(hz), Rate(hz)
        self._extra_status = ExtraStatus()
        self._spots_shown, self._shown = set[tuple[str, int]](), set[str]()
        self._shown_state: tuple[object, ...] | None = None
        self._latched = dict[str, object]()  # what was sent last

    def messages(self, result: TrackingResult) -> list[Outgoing]:
        """The messages of one result; docs/ros.md describes each topic. Raises InputError for a
        stamp beyond ROS's range."""
        header = self._messages.header(result.stamp_ns, result.published_frame.frame_id)
        self._extra_status.update(result)
        out: list[Outgoing] = []

        def send(suffix: str, kind: str, **values: Any) -> None:
            out.append(Outgoing(suffix, kind, self._messages.make(kind, **values)))

        def send_markers(suffix: str, markers: list[dict[str, Any]], **common: Any) -> None:
            common = {"header": header, **common}
            send(suffix, MARKERS, markers=[common | marker for marker in markers])

        cloud = _labelled_cloud(result.transformed, header, self._messages)
        out.append(Outgoing("cloud", CLOUD, cloud))
        send_markers("meshes", self._organ(result), lifetime={"sec": _LIFETIME_S})
        for name in self._context.parts:
            send(f"{name}/center", PLACE, header=header, point=_place(result.center_mm(name)))
        if self._observed:
            touches = self._extra_status.touches
            out += crtk_messages(result, self._context.parts, touches, self._messages)
        send("/tf", TRANSFORMS, transforms=self._frames(result))
        arms = [] if self._context.controller is None else [_arms_status(result)]
        status = [self._estimate_status(result), *arms]
        send("diagnostics", DIAGNOSTICS, header=header, status=status)
        levels = [entry["level"] for entry in status]
        if self._status_rate.due() or levels != self._levels:
            send("/diagnostics", DIAGNOSTICS, header=header, status=status)
        self._levels = levels
        if self._context.controller is not None:
            self._add_arms(result, header, send, send_markers)
            if self._observed and (points := self._points(result)) is not None:
                seen = plain_cloud(SensorCloud(points, result.stamp_ns), header, self._messages)
                out.append(Outgoing("observed", CLOUD, seen))
        return out

    def _add_arms(
        self,
        result: TrackingResult,
        header: Any,
        send: Callable[..., None],
        send_markers: Callable[..., None],
    ) -> None:
        """Their joints and shapes."""
        joints = {} if result.control is None else result.control.joints_rad
        angles = np.array(list(joints.values()), np.float64)
        send("joint_states", JOINTS, header=header, name=list(joints), position=angles)
        if (markers := self._workcell(result)) is not None:
            send_markers("workcell", markers, lifetime={"sec": _LIFETIME_S})
        for suffix in LATCHED:
            if (markers := self._rigid(suffix, result)) is not None:
                send_markers(suffix, markers, frame_locked=True)  # at any time, not their stamp's

    def _frames(self, result: TrackingResult) -> list[dict[str, Any]]:
        """A transform to each part, of good estimates only: tf can't mark one as poor; and to each
        shape that moves."""
        poses = {shape.name: shape.published_from_shape for shape in _shapes(result, LINKS)}
        if result.estimate is not None and result.quality == "good":
            parts = {name: result.part_pose(name) for name in result.estimate.meshes}
            poses = {name: pose for name, pose in parts.items() if pose is not None} | poses
        stamp_ns, parent = result.stamp_ns, result.published_frame.frame_id
        return [
            transform_fields(self._messages, stamp_ns, parent, self._frame_of(name), pose)
            for name, pose in poses.items()
        ]

    def _frame_of(self, name: str) -> str:
        return f"{self._namespace}/{name}"

    def _organ(self, result: TrackingResult) -> list[dict[str, Any]]:
        """Triangles per part, spots and a text of the quality; without an estimate all are
        deleted."""
        estimate = result.transformed
        markers: list[dict[str, Any]] = []
        if estimate is None:
            markers.append({"action": _DELETE_ALL})
        elif self._meshes_rate.due():
            for name in dict.fromkeys((*self._context.parts, *estimate.meshes)):
                if (mesh := estimate.meshes.get(name)) is None:
                    markers.append({"ns": name, "action": _DELETE})
                else:
                    opacity = 1.0 if is_tumor(name) else ORGAN_OPACITY
                    markers.append(_triangles(name, mesh, colours.name_colour(name), opacity))
            for number, (name, mesh) in enumerate(estimate.structures.items()):
                markers.append(_triangles(name, mesh, colours.structure_colour(number), 1.0))
        if estimate is not None:
            markers += self._spots()
        if estimate is not None or result.control is None:  # else it is in the workcell's text
            markers.append(_quality_text(result))
        return markers

    def _spots(self) -> list[dict[str, Any]]:
        """Where to touch next, with texts, and evidence; of what there was, its deletion."""
        extra_status, markers = self._extra_status, list[dict[str, Any]]()
        next_mm = np.reshape([touch.place_mm for touch in extra_status.touches], (-1, 3))
        every = next_mm, extra_status.known_mm, extra_status.contradicting_mm
        for (ns, (colour, radius_m)), places_mm in zip(_SPOTS.items(), every, strict=True):
            if len(places_mm):
                scale, points = xyz((2 * radius_m,) * 3), PointBlock(places_mm / MM_PER_M)
                markers.append(_marker(ns, _SPHERES, colour, scale=scale, points=points))
        for number, touch in enumerate(extra_status.touches):
            about = {"id": number, "text": touch.label, "scale": {"z": _TEXT_HEIGHT_M}}
            markers.append(_marker(_NEXT_TEXT, _TEXT, colours.WHITE, touch.place_mm, **about))
        now = {(marker["ns"], marker.get("id", 0)) for marker in markers}
        self._spots_shown |= now
        gone = sorted(self._spots_shown - now)
        return markers + [{"ns": ns, "id": number, "action": _DELETE} for ns, number in gone]

    def _workcell(self, result: TrackingResult) -> list[dict[str, Any]] | None:
        """All of its markers or, if they are not due, None: a slow receiver keeps only the newest
        message, so each must be complete."""
        control = result.control
        if control is None:
            self._shown, self._shown_state = set(), None
            return [{"action": _DELETE_ALL}]
        names = {_STATE, *(line.name for line in control.drawn_lines)}
        gone, self._shown = self._shown - names, names
        state = control.state, bool(control.stopped)  # not the reason: it changes with each frame
        changed, self._shown_state = gone or state != self._shown_state, state
        if not self._markers_rate.due() and not changed:
            return None
        markers: list[dict[str, Any]] = [{"ns": name, "action": _DELETE} for name in sorted(gone)]
        for line in control.drawn_lines:
            scale, points = {"x": line.width_mm / MM_PER_M}, PointBlock(line.points_mm / MM_PER_M)
            markers.append(_marker(line.name, _LINE, line.colour, scale=scale, points=points))
        return [*markers, _state_text(result, control)]

    def _rigid(self, suffix: str, result: TrackingResult) -> list[dict[str, Any]] | None:
        """All surfaces that do not deform and belong on this topic; None: it has them already.
        Those that move are drawn at the origin of their own frames."""
        shapes, parent = _shapes(result, suffix), result.published_frame.frame_id
        now = parent, [(shape.name, shape.mesh, shape.colour, shape.opacity) for shape in shapes]
        if self._latched.get(suffix) == now:
            return None
        self._latched[suffix] = now
        markers: list[dict[str, Any]] = [{"action": _DELETE_ALL}]
        for shape in shapes:
            mesh, frame = shape.mesh, self._frame_of(shape.name)
            if suffix == PLANNED:
                corners_mm = transform_points(shape.published_from_shape, mesh.vertices_mm)
                mesh, frame = mesh.with_vertices(corners_mm), parent
            header = {"header": self._messages.header(result.stamp_ns, frame)}
            marker = _triangles(shape.name, mesh, shape.colour, shape.opacity)
            markers.append(header | marker)
        return markers

    def _points(self, result: TrackingResult) -> Float32[np.ndarray, "n 3"] | None:
        """The observed points, published frame; None: they are not due."""
        if result.observation is None:
            return np.zeros((0, 3), np.float32)
        if not self._points_rate.due():
            return None
        points_mm = thinned(seen_points(result.observation), MOST_SEEN)
        return transform_points(result.published_frame.published_from_camera, points_mm)

    def _estimate_status(self, result: TrackingResult) -> dict[str, Any]:
        self._times_s.append(time.monotonic())
        past_s = self._times_s[-1] - self._times_s[0]
        values: dict[str, Any] = {
            "patient": self._context.patient.id,
            "side": self._context.patient.side,
            "quality": result.quality,
            "sequence": result.sequence,
            "stamp_ns": result.stamp_ns,
            "points": 0 if result.organ is None else len(result.organ.points_mm),
            "rate_hz": f"{(len(self._times_s) - 1) / past_s if past_s > 0 else 0.0:.1f}",
            "dropped": result.dropped,
        }
        if result.latency_ms is not None:
            values["latency_ms"] = f"{result.latency_ms:.3f}"
        values |= {f"{stage}_ms": f"{1000 * s:.3f}" for stage, s in result.seconds.items()}
        for rank, touch in enumerate(self._extra_status.touches, start=1):
            values[f"{_NEXT}_{rank}"] = touch.message
        return _status(_LEVELS[result.quality], "estimate", result.describe(), result, values)


def _place(place_mm: Float64[np.ndarray, " 3"] | None) -> dict[str, float]:
    """A Point; NaN where it is not known."""
    return xyz(np.full(3, np.nan) if place_mm is None else place_mm / MM_PER_M)


def _arms_status(result: TrackingResult) -> dict[str, Any]:
    """OK with the state, WARN where the arms are halted, STALE where nothing is known of them."""
    control = result.control
    if control is None:
        return _status(_STALE, "arms", "nothing is known of the arms", result, {})
    values = {"state": control.state, "halted": control.stopped}
    return _status(_WARN if control.stopped else _OK, "arms", _describe(control), result, values)


def _status(
    level: int, what: str, text: str, result: TrackingResult, values: dict[str, Any]
) -> dict[str, Any]:
    """A DiagnosticStatus with its values as text."""
    return {
        "level": level,
        "name": f"tumortrack: {what}",
        "message": text,
        "hardware_id": result.published_frame.frame_id,
        "values": [{"key": key, "value": str(value)} for key, value in values.items()],
    }


def _labelled_cloud(estimate: TransformedEstimate | None, header: Any, messages: Messages) -> Any:
    table = np.zeros(0 if estimate is None else len(estimate.points_mm), _POINT)
    if estimate is not None:
        metres = estimate.points_mm / np.float32(MM_PER_M)
        table["x"], table["y"], table["z"] = metres.T
        table["label"], table["probability"] = estimate.labels, estimate.probability
        red, green, blue = colours.label_colours(estimate.labels).T.astype(np.uint32)
        table["rgb"] = red << 16 | green << 8 | blue  # PCL's packing
    return cloud_message(table, header, messages)


def _quality_text(result: TrackingResult) -> dict[str, Any]:
    """Above the organ in the camera's image; without an organ, in front of the camera."""
    text, above_mm = fill(result.describe(), _TEXT_COLUMNS), np.array([[0.0, 0.0, 150.0]])
    if result.estimate is not None and (name := organ_name(result.estimate.meshes)):
        low, high = result.estimate.meshes[name].box_mm
        up_mm = 1000 * _TEXT_HEIGHT_M + _half_height_mm(text, _TEXT_HEIGHT_M)
        above_mm = np.array([[(low + high)[0] / 2, low[1] - up_mm, (low + high)[2] / 2]])
    position_mm = transform_points(result.published_frame.published_from_camera, above_mm)[0]
    colour, scale = colours.VERDICTS[result.quality], {"z": _TEXT_HEIGHT_M}
    return _marker("quality", _TEXT, colour, position_mm, text=text, scale=scale)


def _state_text(result: TrackingResult, control: ControlState) -> dict[str, Any]:
    """Its top is as high as the highest shape (where arms are, z is up), inside a view of all."""
    text = fill(_describe(control), _STATE_COLUMNS)
    if result.estimate is None:
        text += f"\n{fill(result.describe(), _STATE_COLUMNS)}"
    extents = [line.points_mm for line in control.drawn_lines]
    extents += [] if control.box_mm is None else [control.box_mm]
    corners = np.concatenate(extents) if extents else np.zeros((1, 3))
    position_mm = (corners.min(0) + corners.max(0)) / 2
    position_mm[2] = corners[:, 2].max() - _half_height_mm(text, _STATE_HEIGHT_M)
    colour, scale = colours.NONE if control.stopped else _STATE_COLOUR, {"z": _STATE_HEIGHT_M}
    return _marker(_STATE, _TEXT, colour, position_mm, text=text, scale=scale)


def _half_height_mm(text: str, height_m: float) -> float:
    """From the middle of a text, its position in RViz, to the middle of its first line."""
    return MM_PER_M * (height_m + _GAP_M) / 2 * text.count("\n")


def _describe(control: ControlState) -> str:
    if control.stopped:
        return f"{control.state}, halted: {control.stopped}"
    return control.state


def _shapes(result: TrackingResult, suffix: str) -> list[RigidShape]:
    """Those that belong on a latched topic."""
    every = () if result.control is None else result.control.shapes
    return [shape for shape in every if shape.still == (suffix == PLANNED)]


def _triangles(ns: str, mesh: Mesh, colour: Colour, opacity: float) -> dict[str, Any]:
    """A Marker of a mesh, by the three corners of each triangle."""
    points = PointBlock(mesh.vertices_mm[mesh.faces.ravel()] / MM_PER_M)
    marker = _marker(ns, _TRIANGLES, colour, scale=xyz((1, 1, 1)), points=points)
    marker["color"]["a"] = opacity
    return marker


def _marker(
    ns: str, kind: int, colour: Colour, position_mm: np.ndarray = _ORIGIN, **more: Any
) -> dict[str, Any]:
    """The common fields of visible Markers, and ``more``."""
    rgb = dict(zip("rgb", (value / 255 for value in colour), strict=True))
    pose = {"position": xyz(position_mm / MM_PER_M), "orientation": {"w": 1.0}}
    return {"ns": ns, "type": kind, "pose": pose, "color": {**rgb, "a": 1.0}, **more}
