"""What is published over ROS of an update. Metres out, millimetres in.

Every message carries the update's stamp and frame. Without an estimate each topic says so: an
empty cloud, markers deleted, places that are not a number, a diagnostic with the reason.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tumortrack.core.colours import GOOD, NONE, POOR, Colour, label_colours, part_colour
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack.live.ros.cell import WorkcellMessages, verdict
from tumortrack.live.ros.incoming import CLOUD
from tumortrack.live.ros.markers import (
    ADD,
    DELETE,
    DELETE_ALL,
    MARKERS,
    TEXT,
    TRIANGLES,
    colour,
    marker,
    point,
    pose,
)
from tumortrack.live.ros.messages import Messages, PointBlock
from tumortrack.live.ros.observed import FLOAT32, MM_PER_M, UINT8, Outgoing, cloud_message
from tumortrack.live.values import Quality, TrackingResult, TransformedEstimate

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
PLACE = "geometry_msgs/msg/PointStamped"

_LEVELS = {"good": 0, "poor": 1, "none": 2}  # DiagnosticStatus: OK, WARN, ERROR
_TEXT_COLOURS: dict[Quality, Colour] = {"good": GOOD, "poor": POOR, "none": NONE}
_KIDNEY_OPACITY = 0.35
_TEXT_HEIGHT_M = 0.008

_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "label", "probability", "rgb"],
        "formats": ["<f4", "<f4", "<f4", "u1", "<f4", "<u4"],
        "offsets": [0, 4, 8, 12, 16, 20],  # rising: ROS 1's reader goes by them, not by the list
        "itemsize": 24,
    }
)


def messages_of(
    update: TrackingResult,
    messages: Messages,
    parts: tuple[str, ...] = (),
    meshes: bool = True,
    cell: WorkcellMessages | None = None,
) -> list[Outgoing]:
    """What is published of one update.

    ``cloud`` (PointCloud2: x, y, z, label, probability, rgb), ``meshes`` (MarkerArray: a list of
    triangles per part and a text), ``diagnostics``, and for each of ``parts`` ``PART/center``
    (PointStamped: middle of its box; NaN where it was not found). With ``cell`` what arms do, too:
    ``joint_states`` and ``workcell``.

    Args:
        parts: the model's parts, kidney first; those that were not found are deleted.
        meshes: False leaves the triangles out, where meshes are sent at a lower rate; where there
            is no estimate, their deletion is sent all the same.
        cell: where updates may carry a workcell, the memory of what was shown of it.

    Raises:
        InputError: a stamp that ROS can't say.
    """
    header = messages.header(update.stamp_ns, update.frames.frame_id)
    placed = update.placed
    names = parts or tuple(placed.meshes if placed else ())
    return [
        Outgoing("cloud", CLOUD, _labelled_cloud(placed, header, messages)),
        Outgoing("meshes", MARKERS, _markers(update, names, header, messages, meshes)),
        *(
            Outgoing(f"{name}/center", PLACE, _center(update, name, header, messages))
            for name in names
        ),
        Outgoing("diagnostics", DIAGNOSTICS, _diagnostics(update, header, messages, cell)),
        *(cell.outgoing(update, header) if cell is not None else ()),
    ]


def ended(last: TrackingResult) -> TrackingResult:
    """What is published at the end, so that no estimate stays on a screen."""
    return TrackingResult(
        sequence=last.sequence + 1,
        stamp_ns=last.stamp_ns + 1,
        reason="tracking has ended",
        frames=last.frames,
    )


def _labelled_cloud(placed: TransformedEstimate | None, header: Any, messages: Messages) -> Any:
    n = 0 if placed is None else len(placed.points_mm)
    table = np.zeros(n, _POINT)
    if placed is not None:
        metres = placed.points_mm / np.float32(MM_PER_M)
        table["x"], table["y"], table["z"] = metres.T
        table["label"], table["probability"] = placed.labels, placed.probability
        red, green, blue = label_colours(placed.labels).T.astype(np.uint32)
        table["rgb"] = red << 16 | green << 8 | blue  # PCL's packing
    places = [
        (name, place[1], UINT8 if place[0] == np.uint8 else FLOAT32)
        for name, place in _POINT.fields.items()  # type: ignore[union-attr]
    ]
    return cloud_message(table, places, header, messages)


def _markers(
    update: TrackingResult, names: tuple[str, ...], header: Any, messages: Messages, meshes: bool
) -> Any:
    """Triangles per part and a text about their quality; everything deleted without estimate."""
    placed, markers = update.placed, []
    if placed is None:
        markers.append(marker(messages, header, action=DELETE_ALL))
    elif meshes:
        for label, name in enumerate(names, start=1):
            if name in placed.meshes:
                markers.append(_triangles(placed.meshes[name], name, label, header, messages))
            else:
                markers.append(marker(messages, header, ns=name, action=DELETE))
    if placed is not None or update.workcell is None:  # else said with what the arms do
        markers.append(_text(update, header, messages))
    return messages.make(MARKERS, markers=markers)


def _triangles(mesh: Mesh, name: str, label: int, header: Any, messages: Messages) -> Any:
    corners_m = mesh.vertices_mm[mesh.faces.ravel()] / MM_PER_M
    return marker(
        messages,
        header,
        ns=name,
        type=TRIANGLES,
        action=ADD,
        pose=pose(messages, np.zeros(3)),
        scale=messages.make("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0),
        color=colour(messages, part_colour(label), _KIDNEY_OPACITY if label == 1 else 1.0),
        points=PointBlock(corners_m),
    )


def _text(update: TrackingResult, header: Any, messages: Messages) -> Any:
    """Above the organ, as the camera sees it; without one, before the camera."""
    way, above_mm = update.frames.published_from_camera, np.array([[0.0, 0.0, 150.0]])
    if update.estimate is not None and (organ := update.estimate.meshes.get("kidney")):
        low, high = organ.box_mm
        above_mm = np.array([[(low + high)[0] / 2, low[1] - 8.0, (low + high)[2] / 2]])
    return marker(
        messages,
        header,
        ns="quality",
        type=TEXT,
        action=ADD,
        pose=pose(messages, transform_points(way, above_mm)[0] / MM_PER_M),
        scale=messages.make("geometry_msgs/msg/Vector3", z=_TEXT_HEIGHT_M),
        color=colour(messages, _TEXT_COLOURS[update.quality]),
        text=verdict(update),
    )


def _center(update: TrackingResult, name: str, header: Any, messages: Messages) -> Any:
    mesh = None if update.estimate is None else update.estimate.meshes.get(name)
    middle_m = np.full(3, np.nan)
    if mesh is not None:
        middle_mm = mesh.box_mm.mean(0, keepdims=True)
        middle_m = transform_points(update.frames.published_from_camera, middle_mm)[0] / MM_PER_M
    return messages.make(PLACE, header=header, point=point(messages, middle_m))


def _diagnostics(
    update: TrackingResult, header: Any, messages: Messages, cell: WorkcellMessages | None
) -> Any:
    said: dict[str, Any] = {
        "quality": update.quality,
        "sequence": update.sequence,
        "stamp_ns": update.stamp_ns,
        "points": 0 if update.organ is None else len(update.organ.points_mm),
    }
    if update.latency_ms is not None:
        said["latency_ms"] = f"{update.latency_ms:.3f}"
    said |= {f"{stage}_ms": f"{1000 * s:.3f}" for stage, s in update.seconds.items()}
    values = [
        messages.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
        for key, value in said.items()
    ]
    status = messages.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=_LEVELS[update.quality],
        name="tumortrack: estimate",
        message=verdict(update),
        hardware_id=update.frames.frame_id,
        values=values,
    )
    statuses = [status] if cell is None else [status, cell.status(update)]
    return messages.make(DIAGNOSTICS, header=header, status=statuses)
