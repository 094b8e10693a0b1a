"""What a source saw -> ROS messages, in the camera's frame, metres."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.ros.incoming import CAMERA_INFO, CLOUD, IMAGE
from tumortrack.live.ros.messages import Messages
from tumortrack.live.values import Observation

CAMERA_FRAME = "camera"
MM_PER_M = 1000
FLOAT32, UINT8 = 7, 2  # PointField's numbers


class Outgoing(NamedTuple):
    """A message and the end of the topic's name that it belongs on, as ``meshes``."""

    suffix: str
    message_type: str
    message: Any


def messages_seen(
    seen: Observation, messages: Messages, frame_id: str = CAMERA_FRAME
) -> list[Outgoing]:
    """What the source saw, in the camera's frame: ``depth/image_rect`` (32FC1, metres: float32
    there and back is exact to one part in 10 million, 1e-5 mm at 150 mm) and
    ``depth/camera_info``, or ``points``; and ``mask`` (mono8) where there is one.

    Raises:
        InputError: a stamp that ROS can't say.
    """
    header = messages.header(seen.stamp_ns, frame_id)
    if isinstance(seen.content, SensorCloud):
        return [Outgoing("points", CLOUD, plain_cloud(seen.content, header, messages))]
    image = depth_image(seen.content, header, messages)
    info = camera_info(seen.content, header, messages)
    out = [
        Outgoing("depth/image_rect", IMAGE, image),
        Outgoing("depth/camera_info", CAMERA_INFO, info),
    ]
    if seen.mask is not None:
        pixels = seen.mask.astype(np.uint8) * np.uint8(255)
        out.append(Outgoing("mask", IMAGE, _image(pixels, "mono8", header, messages)))
    return out


def depth_image(frame: DepthFrame, header: Any, messages: Messages) -> Any:
    """32FC1 in metres, NaN without return (REP 118)."""
    return _image(frame.depth_mm / np.float32(MM_PER_M), "32FC1", header, messages)


def _image(pixels: np.ndarray, encoding: str, header: Any, messages: Messages) -> Any:
    height, width = pixels.shape
    return messages.make(
        IMAGE,
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=width * pixels.itemsize,
        data=_octets(pixels.astype(pixels.dtype.newbyteorder("<"), copy=False)),
    )


def camera_info(frame: DepthFrame, header: Any, messages: Messages) -> Any:
    """The pinhole of a frame: K and P, no distortion."""
    camera = frame.intrinsics
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], float)
    p = np.hstack([k, np.zeros((3, 1))])
    return messages.make(
        CAMERA_INFO,
        header=header,
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=k.ravel(),
        r=np.eye(3).ravel(),
        p=p.ravel(),
    )


def plain_cloud(cloud: SensorCloud, header: Any, messages: Messages) -> Any:
    """x, y, z in metres, float32."""
    fields = [("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32)]
    metres = (cloud.points_mm / np.float32(MM_PER_M)).astype("<f4")
    return cloud_message(metres, fields, header, messages)


def cloud_message(
    table: np.ndarray, places: list[tuple[str, int, int]], header: Any, messages: Messages
) -> Any:
    """A PointCloud2 whose data are an array's bytes: one row of it, or one element, a point.

    ``places``: name, offset in bytes and PointField type of each field.
    """
    step = table.itemsize * math.prod(table.shape[1:])
    fields = [
        messages.make(
            "sensor_msgs/msg/PointField", name=name, offset=offset, datatype=kind, count=1
        )
        for name, offset, kind in places
    ]
    return messages.make(
        CLOUD,
        header=header,
        height=1,
        width=len(table),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(table),
        data=_octets(table),
        is_dense=True,
    )


def _octets(table: np.ndarray) -> np.ndarray:
    """An array's bytes, without a copy where they lie in one piece."""
    return np.ascontiguousarray(table).reshape(-1).view(np.uint8)
