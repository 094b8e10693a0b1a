"""What arms do, over ROS: joint states, markers of everything that stands in the workcell, and a
line of the diagnostics. Metres and radians, in the published frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from tumortrack.core.colours import NONE, Colour
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import SensorCloud
from tumortrack.live.ros.incoming import CLOUD
from tumortrack.live.ros.markers import (
    ADD,
    DELETE,
    DELETE_ALL,
    LINE,
    MARKERS,
    TEXT,
    TRIANGLES,
    Rate,
    colour,
    marker,
    pose,
)
from tumortrack.live.ros.messages import Messages, PointBlock
from tumortrack.live.ros.observed import MM_PER_M, Outgoing, plain_cloud
from tumortrack.live.values import Polyline, RigidShape, TrackingResult, Workcell
from tumortrack.live.viewer.points import MOST_SEEN, seen_points, thinned
from tumortrack.live.viewer.workcell import box_of, wxyz_of

JOINTS = "sensor_msgs/msg/JointState"
STATE = "state"  # the text's namespace

_WARN, _STALE = 1, 3  # DiagnosticStatus
_TEXT_COLOUR: Colour = (235, 238, 242)
_TEXT_HEIGHT_M = 0.04
_TEXT_ABOVE_MM = 60.0


class WorkcellMessages:
    """A publisher's memory of what it showed, so that what is gone is deleted.

    ``hz``: markers and observed points at most so often (0: each time), but at once where the
    state changes or something is gone; joints come with every update. ``observed``: without, those
    points never come.
    """

    def __init__(self, messages: Messages, hz: float, observed: bool = True) -> None:
        self._messages, self._observed = messages, observed
        self._markers_rate, self._points_rate = Rate(hz), Rate(hz)
        self._shown: set[str] = set()
        self._said: tuple[str, bool] | None = None

    def outgoing(self, update: TrackingResult, header: Any) -> list[Outgoing]:
        """``joint_states`` (JointState; no names without arms) and ``workcell`` (MarkerArray: a
        list of triangles per shape with its pose, a strip per line, the state as text above all;
        namespaces are their names; everything deleted without a workcell); and ``observed``
        (PointCloud2 of x, y, z: up to 20,000 points of what the camera saw, without organ or
        background being told apart; no points where it saw nothing). Nothing is sent on /tf, so
        that a camera's own cloud could not be shown beside them."""
        cell = update.workcell
        out = [Outgoing("joint_states", JOINTS, self._joints(cell, header))]
        if (markers := self._markers(update, header)) is not None:
            array = self._messages.make(MARKERS, markers=markers)
            out.append(Outgoing("workcell", MARKERS, array))
        if self._observed and (points := self._points(update, header)) is not None:
            out.append(Outgoing("observed", CLOUD, points))
        return out

    def status(self, update: TrackingResult) -> Any:
        """A DiagnosticStatus: OK with the state, WARN where the arms are halted, STALE without a
        workcell."""
        cell = update.workcell
        level, said = _STALE, "nothing is known of the arms"
        if cell is not None:
            level = _WARN if cell.halted else 0
            said = words(cell)
        values = {} if cell is None else {"state": cell.state, "halted": cell.halted}
        return self._messages.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name="tumortrack: arms",
            message=said,
            hardware_id=update.frames.frame_id,
            values=[
                self._messages.make("diagnostic_msgs/msg/KeyValue", key=key, value=value)
                for key, value in values.items()
            ],
        )

    def _joints(self, cell: Workcell | None, header: Any) -> Any:
        joints = {} if cell is None else cell.joints_rad
        return self._messages.make(
            JOINTS,
            header=header,
            name=list(joints),
            position=np.array(list(joints.values()), np.float64),
        )

    def _points(self, update: TrackingResult, header: Any) -> Any | None:
        """None: it is not their turn."""
        points_mm = np.zeros((0, 3), np.float32)
        if update.seen is not None:
            if not self._points_rate.due():
                return None
            points_mm = thinned(seen_points(update), MOST_SEEN)
            points_mm = transform_points(update.frames.published_from_camera, points_mm)
        return plain_cloud(SensorCloud(points_mm, update.stamp_ns), header, self._messages)

    def _markers(self, update: TrackingResult, header: Any) -> list[Any] | None:
        """All or, if it is not their turn, None: receivers that are slow keep the newest message
        alone, so each must be whole."""
        messages, cell = self._messages, update.workcell
        if cell is None:
            self._shown, self._said = set(), None
            return [marker(messages, header, action=DELETE_ALL)]
        shapes, lines = cell.shapes, [line for line in cell.lines if len(line.points_mm) > 1]
        names = {STATE, *(shape.name for shape in shapes), *(line.name for line in lines)}
        gone, self._shown = self._shown - names, names
        said = cell.state, bool(cell.halted)  # why may change with each frame
        changed, self._said = gone or said != self._said, said
        if not self._markers_rate.due() and not changed:
            return None
        return [
            *(marker(messages, header, ns=name, action=DELETE) for name in sorted(gone)),
            *_surfaces(shapes, header, messages),
            *(_strip(line, header, messages) for line in lines),
            _text(update, cell, header, messages),
        ]


def verdict(update: TrackingResult) -> str:
    """How good the estimate is, or why there is none."""
    if update.estimate is None:
        return f"no estimate: {update.reason}"
    return f"{update.quality}: {update.warning}" if update.warning else update.quality


def words(cell: Workcell) -> str:
    """The state, and why the arms stand still."""
    return f"{cell.state}, halted: {cell.halted}" if cell.halted else cell.state


def _surfaces(shapes: tuple[RigidShape, ...], header: Any, messages: Messages) -> Iterator[Any]:
    ways = np.array([shape.published_from_shape for shape in shapes]).reshape(-1, 4, 4)
    turns = wxyz_of(ways[:, :3, :3]) if shapes else ()
    scale = messages.make("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0)
    for shape, way, wxyz in zip(shapes, ways, turns, strict=True):
        corners_m = shape.mesh.vertices_mm[shape.mesh.faces.ravel()] / MM_PER_M
        yield marker(
            messages,
            header,
            ns=shape.name,
            type=TRIANGLES,
            action=ADD,
            pose=pose(messages, way[:3, 3] / MM_PER_M, wxyz),
            scale=scale,
            color=colour(messages, shape.colour, shape.opacity),
            points=PointBlock(corners_m),
        )


def _strip(line: Polyline, header: Any, messages: Messages) -> Any:
    return marker(
        messages,
        header,
        ns=line.name,
        type=LINE,
        action=ADD,
        pose=pose(messages, np.zeros(3)),
        scale=messages.make("geometry_msgs/msg/Vector3", x=line.width_mm / MM_PER_M),
        color=colour(messages, line.colour),
        points=PointBlock(line.points_mm / MM_PER_M),
    )


def _text(update: TrackingResult, cell: Workcell, header: Any, messages: Messages) -> Any:
    """Above everything: where arms are, z is up."""
    said = words(cell) if update.estimate is not None else f"{words(cell)}\n{verdict(update)}"
    box = box_of(cell)
    spots = [] if box is None else [box]
    spots += [line.points_mm for line in cell.lines if len(line.points_mm) > 1]
    corners = np.concatenate(spots) if spots else np.zeros((1, 3))
    place_mm = (corners.min(0) + corners.max(0)) / 2
    place_mm[2] = corners[:, 2].max() + _TEXT_ABOVE_MM
    return marker(
        messages,
        header,
        ns=STATE,
        type=TEXT,
        action=ADD,
        pose=pose(messages, place_mm / MM_PER_M),
        scale=messages.make("geometry_msgs/msg/Vector3", z=_TEXT_HEIGHT_M),
        color=colour(messages, NONE if cell.halted else _TEXT_COLOUR),
        text=said,
    )
