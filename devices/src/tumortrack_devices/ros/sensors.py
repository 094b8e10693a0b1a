"""Depth images, clouds and masks <-> ROS messages, in the camera's frame; mm here, metres there.

Messages are rosbags' objects (``Messages.from_bytes``). InputError is raised if what they declare
does not fit their bytes, or is not supported (lens distortion, binning, region of interest, shift
or skew of the camera).
"""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from tumortrack.core.camera import plausible
from tumortrack.core.cloud import seen_points
from tumortrack.core.errors import InputError, readable
from tumortrack.core.types import DepthFrame, Intrinsics, SensorCloud
from tumortrack.core.units import depths_mm
from tumortrack.live.values import Observation
from tumortrack_devices.ros.messages import MM_PER_M, Messages, Outgoing, stamp_of

CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
CAMERA_FRAME = "camera"
_UINT8, _FLOAT32, _FLOAT64 = 2, 7, 8  # PointField's numbers
_FLOATS = {_FLOAT32: "f4", _FLOAT64: "f8"}
_POINT_FIELDS = {"|u1": _UINT8, "<f4": _FLOAT32, "<u4": _FLOAT32}  # PCL's four bytes of colour
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_MASKS = {"mono8": "u1", "8UC1": "u1"}
_PACKED = struct.Struct("<i2f")  # header of compressedDepth: the format, and two parameters
_PNG = ["compressedDepth", "png"]
_PICTURES = {"rgb8": "3u1", "bgr8": "3u1", "rgba8": "4u1", "bgra8": "4u1"} | _MASKS
_LONGEST_SIDE = 8192  # as of Intrinsics


def cloud_of(message: Any) -> SensorCloud:
    """A PointCloud2 in metres as points in mm, in the message's order, with its stamp.

    x, y and z are float32 or float64 at any offset; either byte order, organised or not, rows
    padded or not. Invalid points are dropped, as by ``seen_points``.
    """
    step, places = int(message.point_step), {}
    for field in message.fields:
        if field.name in places:
            raise InputError(f"a cloud came that has the field {field.name} twice; it is damaged.")
        if field.name in ("x", "y", "z"):
            places[field.name] = _place(field, step)
    if len(places) < 3:
        names = [field.name for field in message.fields][:12]
        raise InputError(f"a cloud came with the fields {names}; x, y and z are needed.")
    width, height, row = int(message.width), int(message.height), int(message.row_step)
    data = np.frombuffer(message.data, np.uint8)
    if row in (0, data.nbytes) and step * width * height == data.nbytes:  # as some state it
        row = step * width
    organised = height > 1
    claimed = row * (height - 1) + step * width if organised else step * width * height
    if claimed > data.nbytes or (organised and row < step * width):
        raise InputError(
            f"a cloud came that claims {width} x {height} points of {step} bytes in rows of {row}, "
            f"and holds {data.nbytes} bytes; it is damaged."
        )
    order = ">" if message.is_bigendian else "<"
    points_mm = np.empty((height, width, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32: infinite, and dropped
        for axis, name in enumerate("xyz" if points_mm.size else ""):
            offset, code = places[name]
            metres = np.ndarray((height, width), order + code, data, offset, (row, step))
            np.multiply(metres, 1000, out=points_mm[..., axis], casting="same_kind")
    points_mm, _ = seen_points(points_mm.reshape(-1, 3), "a cloud")
    return SensorCloud(points_mm, stamp_of(message.header))


def _place(field: Any, step: int) -> tuple[int, str]:
    """Offset and type of one coordinate within a point of ``step`` bytes."""
    code, offset = _FLOATS.get(int(field.datatype)), int(field.offset)
    if code is None or int(field.count) > 1:
        raise InputError(
            f"a cloud came whose {field.name} is of PointField type {field.datatype}, count "
            f"{field.count}; it must be one FLOAT32 (7) or FLOAT64 (8), in metres."
        )
    if offset + int(code[1]) > step:
        where = f"lies at byte {offset}, beyond its points of {step} bytes"
        raise InputError(f"a cloud came whose {field.name} {where}; it is damaged.")
    return offset, code


def depth_of(image: Any, info: Any, rectified: bool = False, unit_mm: float = 1.0) -> DepthFrame:
    """A depth Image and its CameraInfo as a frame, with the image's stamp.

    Args:
        image: 32FC1 (metres), 16UC1 or mono16 (whole numbers); no return: see ``depths_mm``.
        rectified: the image is rectified: its camera is P, and D was removed. Otherwise its camera
            is K, and D must be zero.
        unit_mm: one step of a 16-bit image; in ROS 1 mm (REP 118).
    """
    names = frame_of(image), frame_of(info)
    if all(names) and names[0] != names[1]:
        raise InputError(
            f"a depth image in the frame {names[0]!r} came with a camera_info of {names[1]!r}. "
            "Name the camera_info of this very image."
        )
    intrinsics = _intrinsics_of(info, rectified)
    values = _pixels(image, DEPTHS, "a depth image")
    if values.shape != (intrinsics.height, intrinsics.width):
        raise InputError(
            f"a depth image of {values.shape[1]} x {values.shape[0]} came with a camera_info of "
            f"{intrinsics.width} x {intrinsics.height}. Name the camera_info of this very image."
        )
    depth_mm = depths_mm(values, unit_mm if values.dtype.kind == "u" else MM_PER_M)
    return DepthFrame(depth_mm, intrinsics, stamp_of(image.header))


def image_of(message: Any, messages: Messages) -> Any:
    """The depth Image in a CompressedImage of image_transport's ``compressedDepth``: a 16-bit PNG
    after 12 bytes, of depths or, for metres, of a / (value - b). Raises InputError for another
    packing (JPEG, RVL), and for damaged ones."""
    from PIL import Image

    encoding, _, packing = str(message.format).partition(";")
    if encoding not in DEPTHS or packing.split() not in (["compressedDepth"], _PNG):
        raise InputError(
            f"a packed image came with the format {str(message.format)[:60]!r}; allowed: "
            "compressedDepth as PNG. Else give the raw topic."
        )
    data = bytes(message.data)
    with readable("a packed depth image", "came that is damaged"):
        with Image.open(io.BytesIO(data[_PACKED.size :]), formats=["PNG"]) as picture:
            if not picture.mode.startswith("I;16") or max(picture.size) > _LONGEST_SIDE:
                raise ValueError(f"mode {picture.mode}, {picture.width} x {picture.height}")
            depth = np.asarray(picture)
        _, a, b = _PACKED.unpack_from(data)
    if DEPTHS[encoding] == "f4":
        with np.errstate(all="ignore"):  # pixels without return are dropped later
            depth = np.where(depth == 0, np.nan, a / (depth - np.float64(b))).astype(np.float32)
    return _image(depth, encoding, message.header, messages)


def frame_of(message: Any) -> str:
    """The message's frame; empty: none. Some in ROS 1 begin with a slash."""
    return str(message.header.frame_id).strip().removeprefix("/")


def mask_of(image: Any) -> Bool[np.ndarray, "h w"]:
    """A mono8 or 8UC1 image as a mask: True where it is not 0."""
    return _pixels(image, _MASKS, "a mask") != 0


def picture_of(image: Any, frame: DepthFrame) -> UInt8[np.ndarray, "h w *rgb"] | None:
    """An rgb8, bgr8, rgba8, bgra8 or mono8 image as the picture of a depth image; None if it has
    another stamp. Raises InputError if it has another size."""
    if stamp_of(image.header) != frame.stamp_ns:
        return None
    picture = _pixels(image, _PICTURES, "a picture")
    if picture.shape[:2] != frame.depth_mm.shape:
        raise InputError(
            f"a picture of {picture.shape[1]} x {picture.shape[0]} pixels came for depth images of "
            f"{frame.intrinsics.width} x {frame.intrinsics.height}. Align one with the other."
        )
    if picture.ndim == 3:
        picture = picture[..., 2::-1] if image.encoding.startswith("bgr") else picture[..., :3]
    return picture


def _intrinsics_of(info: Any, rectified: bool) -> Intrinsics:
    width, height = int(info.width), int(info.height)
    roi = info.roi
    whole = (int(roi.width), int(roi.height)) in ((0, 0), (width, height))
    if not whole or roi.x_offset or roi.y_offset or max(info.binning_x, info.binning_y) > 1:
        raise InputError("a camera_info came with binning or a region. Send the whole image.")
    lens = {name.lower(): value for name, value in vars(info).items()}  # ROS 1 has capitals
    matrix = np.asarray(lens["p" if rectified else "k"], float).reshape(3, -1)
    if rectified and (matrix[:, 3] != 0).any():
        raise InputError("a camera_info came whose P has a shift. Give the left camera's depth.")
    if not rectified and (np.asarray(lens["d"], float) != 0).any():
        raise InputError("a camera_info has distortion (D); give rectified depth (rectified=true).")
    if matrix[0, 1] != 0:
        raise InputError("a camera_info came whose pixels are skewed, which is not supported.")
    fx, cx, fy, cy = matrix[0, 0], matrix[0, 2], matrix[1, 1], matrix[1, 2]
    camera = Intrinsics(width, height, float(fx), float(fy), float(cx), float(cy))
    return plausible(camera, "a camera_info came")


def _pixels(image: Any, allowed: dict[str, str], what: str) -> np.ndarray:
    """The image (height, width) or (height, width, channels), in this machine's byte order."""
    code = allowed.get(image.encoding)
    if code is None:
        given = str(image.encoding)[:40]
        raise InputError(f"{what} came with the encoding {given!r}; allowed: {', '.join(allowed)}.")
    width, height, step = int(image.width), int(image.height), int(image.step)
    data, wide = np.frombuffer(image.data, np.uint8), np.dtype(code).itemsize
    if step in (0, data.nbytes) and width * wide * height == data.nbytes:  # as of clouds
        step = width * wide
    fits = 0 < width <= _LONGEST_SIDE and 0 < height <= _LONGEST_SIDE
    if not fits or step < width * wide or step * height > data.nbytes:
        raise InputError(
            f"{what} came that claims {width} x {height} pixels in rows of {step} bytes, and holds "
            f"{data.nbytes} bytes; it is damaged (allowed: up to {_LONGEST_SIDE} a side)."
        )
    pixel = np.dtype(code).newbyteorder(">" if image.is_bigendian else "<")
    values = np.ndarray((height, width), pixel, data, 0, (step, wide))
    return values.astype(values.dtype.newbyteorder("="))


def messages_seen(
    seen: Observation, messages: Messages, frame_id: str = CAMERA_FRAME
) -> list[Outgoing]:
    """An observation in the camera's frame: ``depth/image_rect`` (32FC1, metres, NaN without
    return (REP 118); exact to one part in 10 million, 1e-5 mm at 150 mm) and ``depth/camera_info``
    (K and P, no distortion), or ``points``; where present, ``mask`` (mono8) and
    ``color/image_raw`` (mono8 or rgb8) with its camera_info. Raises InputError for a stamp beyond
    ROS's range."""
    header = messages.header(seen.stamp_ns, frame_id)
    frame = seen.content
    if isinstance(frame, SensorCloud):
        return [Outgoing("points", CLOUD, plain_cloud(frame, header, messages))]
    metres = frame.depth_mm / np.float32(MM_PER_M)
    camera = frame.intrinsics
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], float)
    p, size = np.hstack([k, np.zeros((3, 1))]), {"height": camera.height, "width": camera.width}
    lens = {"distortion_model": "plumb_bob", "d": np.zeros(5), "k": k.ravel(), "p": p.ravel()}
    info = messages.make(CAMERA_INFO, header=header, r=np.eye(3).ravel(), **size, **lens)
    out = [
        Outgoing("depth/image_rect", IMAGE, _image(metres, "32FC1", header, messages)),
        Outgoing("depth/camera_info", CAMERA_INFO, info),
    ]
    if seen.mask is not None:
        pixels = seen.mask.astype(np.uint8) * np.uint8(255)
        out.append(Outgoing("mask", IMAGE, _image(pixels, "mono8", header, messages)))
    if (picture := seen.picture) is not None:
        encoding = "mono8" if picture.ndim == 2 else "rgb8"
        out.append(Outgoing("color/image_raw", IMAGE, _image(picture, encoding, header, messages)))
        out.append(Outgoing("color/camera_info", CAMERA_INFO, info))
    return out


def _image(pixels: np.ndarray, encoding: str, header: Any, messages: Messages) -> Any:
    height, width = pixels.shape[:2]
    return messages.make(
        IMAGE,
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=pixels.nbytes // height,
        data=_octets(pixels.astype(pixels.dtype.newbyteorder("<"), copy=False)),
    )


def plain_cloud(cloud: SensorCloud, header: Any, messages: Messages) -> Any:
    """x, y, z in metres, float32."""
    metres = (cloud.points_mm / np.float32(MM_PER_M)).astype("<f4")
    return cloud_message(metres.view([(axis, "<f4") for axis in "xyz"]), header, messages)


def cloud_message(table: np.ndarray, header: Any, messages: Messages) -> Any:
    """A PointCloud2 of a structured array's bytes, one element per point."""
    fields = [
        {"name": name, "offset": at[1], "datatype": _POINT_FIELDS[at[0].str], "count": 1}
        for name, at in table.dtype.fields.items()  # type: ignore[union-attr]
    ]
    return messages.make(
        CLOUD,
        header=header,
        height=1,
        width=len(table),
        fields=fields,
        is_bigendian=False,
        point_step=table.itemsize,
        row_step=table.nbytes,
        data=_octets(table),
        is_dense=True,
    )


def _octets(table: np.ndarray) -> np.ndarray:
    """An array's bytes, without a copy if it is contiguous."""
    return np.ascontiguousarray(table).reshape(-1).view(np.uint8)
