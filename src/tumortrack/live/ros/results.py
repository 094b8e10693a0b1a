"""What is published over ROS of a tracking result. Millimetres in, metres out.

Every message has the result's stamp and frame. Without an estimate each topic says so: an empty
cloud, deleted markers, places that are NaN, a diagnostic with the reason.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tumortrack.core.colours import GOOD, NONE, POOR, Colour, label_colours, part_colour
from tumortrack.core.geometry import transform_points
from tumortrack.live.ros.messages import (
    DELETE,
    DELETE_ALL,
    MARKERS,
    MM_PER_M,
    Messages,
    Outgoing,
    marker,
    pose,
    text_marker,
    triangles_marker,
    xyz,
)
from tumortrack.live.ros.sensors import CLOUD, FLOAT32, UINT8, cloud_message
from tumortrack.live.ros.workcell import WorkcellMessages
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
    result: TrackingResult,
    messages: Messages,
    parts: tuple[str, ...] = (),
    meshes: bool = True,
    workcell: WorkcellMessages | None = None,
) -> list[Outgoing]:
    """What is published of one result.

    ``cloud`` (PointCloud2: x, y, z, label, probability, rgb), ``meshes`` (MarkerArray: a list of
    triangles per part and a text), ``diagnostics``, and for each of ``parts`` ``PART/center``
    (PointStamped: centre of its box; NaN where it was not found). With ``workcell`` also what arms
    do: see ``WorkcellMessages.outgoing``.

    Args:
        parts: the model's parts, kidney first; those that were not found are deleted.
        meshes: False leaves the triangles out, where meshes are sent at a lower rate; without an
            estimate, their deletion is sent all the same.
        workcell: where results may have a workcell, the memory of what was shown of it.

    Raises:
        InputError: a stamp that ROS can't say.
    """
    header = messages.header(result.stamp_ns, result.published_frame.frame_id)
    estimate = result.transformed
    names = parts or tuple(estimate.meshes if estimate else ())
    markers = messages.markers(_markers(result, names, header, meshes))
    return [
        Outgoing("cloud", CLOUD, _labelled_cloud(estimate, header, messages)),
        Outgoing("meshes", MARKERS, markers),
        *(
            Outgoing(f"{name}/center", PLACE, _center(result, name, header, messages))
            for name in names
        ),
        Outgoing("diagnostics", DIAGNOSTICS, _diagnostics(result, header, messages, workcell)),
        *(workcell.outgoing(result, header) if workcell is not None else ()),
    ]


def _labelled_cloud(estimate: TransformedEstimate | None, header: Any, messages: Messages) -> Any:
    table = np.zeros(0 if estimate is None else len(estimate.points_mm), _POINT)
    if estimate is not None:
        metres = estimate.points_mm / np.float32(MM_PER_M)
        table["x"], table["y"], table["z"] = metres.T
        table["label"], table["probability"] = estimate.labels, estimate.probability
        red, green, blue = label_colours(estimate.labels).T.astype(np.uint32)
        table["rgb"] = red << 16 | green << 8 | blue  # PCL's packing
    fields = [
        (name, place[1], UINT8 if place[0] == np.uint8 else FLOAT32)
        for name, place in _POINT.fields.items()  # type: ignore[union-attr]
    ]
    return cloud_message(table, fields, header, messages)


def _markers(
    result: TrackingResult, names: tuple[str, ...], header: Any, meshes: bool
) -> list[dict]:
    """Triangles per part and a text about their quality; everything deleted without estimate."""
    estimate, markers = result.transformed, []
    if estimate is None:
        markers.append(marker(header, action=DELETE_ALL))
    elif meshes:
        for label, name in enumerate(names, start=1):
            if (mesh := estimate.meshes.get(name)) is None:
                markers.append(marker(header, ns=name, action=DELETE))
                continue
            corners_mm = mesh.vertices_mm[mesh.faces.ravel()]
            colour, opacity = part_colour(label), _KIDNEY_OPACITY if label == 1 else 1.0
            at = pose(np.zeros(3))
            markers.append(triangles_marker(header, name, corners_mm, at, colour, opacity))
    if estimate is not None or result.workcell is None:  # else the workcell's text says it
        markers.append(_quality_text(result, header))
    return markers


def _quality_text(result: TrackingResult, header: Any) -> dict:
    """Above the organ, as the camera sees it; without one, in front of the camera."""
    above_mm = np.array([[0.0, 0.0, 150.0]])
    if result.estimate is not None and (organ := result.estimate.meshes.get("kidney")):
        low, high = organ.box_mm
        above_mm = np.array([[(low + high)[0] / 2, low[1] - 8.0, (low + high)[2] / 2]])
    place_mm = transform_points(result.published_frame.published_from_camera, above_mm)[0]
    colour = _TEXT_COLOURS[result.quality]
    return text_marker(header, "quality", result.describe(), place_mm, _TEXT_HEIGHT_M, colour)


def _center(result: TrackingResult, name: str, header: Any, messages: Messages) -> Any:
    center_mm = result.center_mm(name)
    metres = np.full(3, np.nan) if center_mm is None else center_mm / MM_PER_M
    return messages.make(PLACE, header=header, point=xyz(metres))


def _diagnostics(
    result: TrackingResult, header: Any, messages: Messages, workcell: WorkcellMessages | None
) -> Any:
    values: dict[str, Any] = {
        "quality": result.quality,
        "sequence": result.sequence,
        "stamp_ns": result.stamp_ns,
        "points": 0 if result.organ is None else len(result.organ.points_mm),
    }
    if result.latency_ms is not None:
        values["latency_ms"] = f"{result.latency_ms:.3f}"
    values |= {f"{stage}_ms": f"{1000 * s:.3f}" for stage, s in result.seconds.items()}
    status = messages.diagnostic(
        _LEVELS[result.quality],
        "tumortrack: estimate",
        result.describe(),
        result.published_frame.frame_id,
        values,
    )
    statuses = [status] if workcell is None else [status, workcell.status(result)]
    return messages.make(DIAGNOSTICS, header=header, status=statuses)
