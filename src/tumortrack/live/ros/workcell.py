"""What arms do, over ROS: joint states, markers of everything in the workcell, and a line of the
diagnostics. Metres and radians, in the published frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from tumortrack.core.colours import NONE, Colour
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import SensorCloud
from tumortrack.live.display import MOST_SEEN, seen_points, thinned, wxyz_of
from tumortrack.live.meter import Rate
from tumortrack.live.ros.messages import (
    ADD,
    DELETE,
    DELETE_ALL,
    LINE,
    MARKERS,
    MM_PER_M,
    Messages,
    Outgoing,
    PointBlock,
    marker,
    pose,
    rgba,
    text_marker,
    triangles_marker,
)
from tumortrack.live.ros.sensors import CLOUD, plain_cloud
from tumortrack.live.values import RigidShape, TrackingResult, Workcell

JOINTS = "sensor_msgs/msg/JointState"
STATE = "state"  # the text's namespace

_WARN, _STALE = 1, 3  # DiagnosticStatus
_TEXT_COLOUR: Colour = (235, 238, 242)
_TEXT_HEIGHT_M = 0.04
_TEXT_ABOVE_MM = 60.0


class WorkcellMessages:
    """Remembers what a publisher showed, so that what is gone is deleted.

    ``hz``: markers and observed points at most so often (0: with every result), but at once where
    the state changes or something is gone; joints come with every result. ``observed``: False
    leaves those points out.
    """

    def __init__(self, messages: Messages, hz: float, observed: bool = True) -> None:
        self._messages, self._observed = messages, observed
        self._markers_rate, self._points_rate = Rate(hz), Rate(hz)
        self._shown: set[str] = set()
        self._shown_state: tuple[str, bool] | None = None

    def outgoing(self, result: TrackingResult, header: Any) -> list[Outgoing]:
        """``joint_states`` (JointState; no names without arms); ``workcell`` (MarkerArray: a
        list of triangles per shape with its pose, a strip per line, the state as text above all;
        namespaces are their names; everything deleted without a workcell); and ``observed``
        (PointCloud2 of x, y, z: up to 20,000 points of what the camera saw, organ and background
        alike; none where it saw nothing). Nothing is sent on /tf, so a camera's own cloud could
        not be shown beside them."""
        joints = {} if result.workcell is None else result.workcell.joints_rad
        angles = np.array(list(joints.values()), np.float64)
        state = self._messages.make(JOINTS, header=header, name=list(joints), position=angles)
        out = [Outgoing("joint_states", JOINTS, state)]
        if (markers := self._markers(result, header)) is not None:
            out.append(Outgoing("workcell", MARKERS, self._messages.markers(markers)))
        if self._observed and (points := self._points(result, header)) is not None:
            out.append(Outgoing("observed", CLOUD, points))
        return out

    def status(self, result: TrackingResult) -> Any:
        """A DiagnosticStatus: OK with the state, WARN where the arms are halted, STALE without a
        workcell."""
        cell = result.workcell
        level, text = _STALE, "nothing is known of the arms"
        if cell is not None:
            level, text = _WARN if cell.halted else 0, describe(cell)
        values = {} if cell is None else {"state": cell.state, "halted": cell.halted}
        frame_id = result.published_frame.frame_id
        return self._messages.diagnostic(level, "tumortrack: arms", text, frame_id, values)

    def _points(self, result: TrackingResult, header: Any) -> Any | None:
        """None: they are not due."""
        points_mm = np.zeros((0, 3), np.float32)
        if result.observation is not None:
            if not self._points_rate.due():
                return None
            points_mm = thinned(seen_points(result.observation), MOST_SEEN)
            points_mm = transform_points(result.published_frame.published_from_camera, points_mm)
        return plain_cloud(SensorCloud(points_mm, result.stamp_ns), header, self._messages)

    def _markers(self, result: TrackingResult, header: Any) -> list[dict] | None:
        """All of them or, if they are not due, None: a slow receiver keeps the newest message
        alone, so each must be whole."""
        cell = result.workcell
        if cell is None:
            self._shown, self._shown_state = set(), None
            return [marker(header, action=DELETE_ALL)]
        names = {STATE, *(s.name for s in cell.shapes), *(line.name for line in cell.drawn_lines)}
        gone, self._shown = self._shown - names, names
        state = cell.state, bool(cell.halted)  # why may change with each frame
        changed, self._shown_state = gone or state != self._shown_state, state
        if not self._markers_rate.due() and not changed:
            return None
        return [
            *(marker(header, ns=name, action=DELETE) for name in sorted(gone)),
            *_surfaces(cell.shapes, header),
            *(
                marker(
                    header,
                    ns=line.name,
                    type=LINE,
                    action=ADD,
                    pose=pose(np.zeros(3)),
                    scale={"x": line.width_mm / MM_PER_M},
                    color=rgba(line.colour),
                    points=PointBlock(line.points_mm / MM_PER_M),
                )
                for line in cell.drawn_lines
            ),
            _state_text(result, cell, header),
        ]


def describe(cell: Workcell) -> str:
    """The state, and why the arms stand still."""
    return f"{cell.state}, halted: {cell.halted}" if cell.halted else cell.state


def _surfaces(shapes: tuple[RigidShape, ...], header: Any) -> list[dict]:
    if not shapes:
        return []
    poses = np.array([shape.published_from_shape for shape in shapes])
    return [
        triangles_marker(
            header,
            shape.name,
            shape.mesh.vertices_mm[shape.mesh.faces.ravel()],
            pose(shape.published_from_shape[:3, 3], wxyz),
            shape.colour,
            shape.opacity,
        )
        for shape, wxyz in zip(shapes, wxyz_of(poses[:, :3, :3]), strict=True)
    ]


def _state_text(result: TrackingResult, cell: Workcell, header: Any) -> dict:
    """Above everything: where arms are, z is up."""
    text = describe(cell)
    if result.estimate is None:
        text += f"\n{result.describe()}"
    box = cell.box_mm
    spots = [] if box is None else [box]
    spots += [line.points_mm for line in cell.drawn_lines]
    corners = np.concatenate(spots) if spots else np.zeros((1, 3))
    place_mm = (corners.min(0) + corners.max(0)) / 2
    place_mm[2] = corners[:, 2].max() + _TEXT_ABOVE_MM
    colour = NONE if cell.halted else _TEXT_COLOUR
    return text_marker(header, STATE, text, place_mm, _TEXT_HEIGHT_M, colour)
