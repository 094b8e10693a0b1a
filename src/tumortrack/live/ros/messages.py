"""Messages of one ROS distribution, made from field names, and their bytes: CDR for ROS 2, ROS 1's
own format for ROS 1.

Types come from rosbags, a pure Python library that needs no ROS. ROS 1 has the same types by
shorter names: ``sensor_msgs/msg/Image`` here is its ``sensor_msgs/Image``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Float64

from tumortrack.core.colours import Colour
from tumortrack.core.errors import InputError

Distro = Literal["noetic", "foxy", "galactic", "humble", "iron", "jazzy", "kilted", "lyrical"]

MM_PER_M = 1000
MARKERS = "visualization_msgs/msg/MarkerArray"
ADD, DELETE, DELETE_ALL = 0, 2, 3  # Marker's actions
LINE, TEXT, TRIANGLES = 4, 9, 11  # and types
# Markers vanish if nothing follows, so that a stopped loop leaves nothing that looks current.
MARKER_LIFETIME_S = 2

_POINT = "geometry_msgs/msg/Point"
_LATEST_S = 2**31 - 1  # ROS counts seconds in 32 bits, ROS 2 with a sign


class Outgoing(NamedTuple):
    """A message, and the end of the name of its topic (``meshes``)."""

    suffix: str
    message_type: str
    message: Any


class PointBlock(Sequence):
    """Points of a marker as one array, written in one piece.

    It replaces a list of point messages: tens of thousands of objects would take a tenth of a
    second to write. Iterating over it gives the array itself, once; an index gives a point.
    """

    def __init__(self, points: Float64[np.ndarray, "n 3"]) -> None:
        self.array = np.ascontiguousarray(points, "<f8")

    def __len__(self) -> int:
        return len(self.array)

    def __getitem__(self, index: Any) -> Any:
        return self.array[index]

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.array,) if len(self.array) else ())


class Messages:
    """The message types of one distribution."""

    def __init__(self, distro: Distro = "humble") -> None:
        if distro not in get_args(Distro):
            raise InputError(
                f"ROS distribution {distro!r} is not known; allowed: {', '.join(get_args(Distro))}."
            )
        self.distro = distro
        self.is_ros1 = distro == "noetic"
        self._store = _store(distro)

    def make(self, message_type: str, **values: Any) -> Any:
        """A message: fields by name, the others empty (0, "", no elements). A dictionary stands for
        a message inside it, a list of dictionaries for several.

        Letters' case does not count: ROS 1 writes ``K`` where ROS 2 writes ``k``.
        """
        given = {name.lower(): value for name, value in values.items()}
        fields = {}
        for name, kind in self._store.fielddefs[message_type][1]:
            known = name.lower() in given
            fields[name] = self._value(kind, given.pop(name.lower()) if known else None)
        if given:
            raise TypeError(f"{message_type} has no field {', '.join(given)}")
        return self._store.types[message_type](**fields)

    def _value(self, kind: Any, value: Any) -> Any:
        if value is None:
            return self._empty(kind)
        if isinstance(value, dict):
            return self.make(kind[1], **value)
        if isinstance(value, list):
            inner = kind[1][0][1]
            return [self.make(inner, **one) if isinstance(one, dict) else one for one in value]
        return value

    def _empty(self, kind: Any) -> Any:
        from rosbags.interfaces import Nodetype

        node, content = kind
        if node == Nodetype.NAME:
            return self.make(content)
        if node == Nodetype.BASE:
            return {"string": "", "bool": False}.get(content[0], 0)
        (inner, what), length = content
        if inner == Nodetype.NAME or what[0] == "string":
            filled = length if node == Nodetype.ARRAY else 0
            return [self._empty((inner, what)) for _ in range(filled)]
        dtype = {"char": "uint8", "byte": "uint8"}.get(what[0], what[0])
        return np.zeros(length if node == Nodetype.ARRAY else 0, dtype)

    def to_bytes(self, message: Any) -> memoryview:
        """What goes over the wire: CDR with its header in ROS 2, ROS 1's form in Noetic."""
        name = message.__msgtype__
        if self.is_ros1:
            return self._store.serialize_ros1(message, name)
        return self._store.serialize_cdr(message, name)

    def from_bytes(self, data: bytes | memoryview, message_type: str) -> Any:
        """The message that these bytes are.

        Raises:
            InputError: they are no such message.
        """
        from rosbags.serde import SerdeError

        read = self._store.deserialize_ros1 if self.is_ros1 else self._store.deserialize_cdr
        try:
            return read(data, message_type)
        except KeyError as error:
            raise InputError(f"{message_type} is no message type that is known here.") from error
        except (SerdeError, AssertionError, MemoryError, IndexError, OverflowError) as error:
            raise InputError(
                f"{len(data)} bytes that came are no {message_type} ({error}). Are sender and "
                "receiver of the same ROS distribution?"
            ) from error

    def definition(self, message_type: str) -> str:
        """The type in ROS's own words, with the types that it is made of."""
        return self._store.generate_msgdef(message_type, ros_version=1 if self.is_ros1 else 2)[0]

    def md5(self, message_type: str) -> str:
        """By which ROS 1 knows the type."""
        return self._store.generate_msgdef(message_type)[1]

    def type_hash(self, message_type: str) -> str:
        """By which ROS 2 knows the type: ``RIHS01_...`` (REP 2011)."""
        return self._store.hash_rihs01(message_type)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """
        Raises:
            InputError: before 1970 or after 2038, which ROS's 32 bits of seconds can't say.
        """
        seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
        if not 0 <= seconds <= _LATEST_S:
            raise InputError(
                f"the stamp {stamp_ns} ns cannot be said in ROS, whose clock runs from 1970 to "
                "2038. Set the clock of the source."
            )
        stamp = {"sec": seconds, "nanosec": nanoseconds}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def markers(self, markers: list[dict]) -> Any:
        """A MarkerArray; see ``marker``."""
        return self.make(MARKERS, markers=markers)

    def diagnostic(self, level: int, name: str, message: str, id: str, values: dict) -> Any:
        """A DiagnosticStatus with its values as text."""
        return self.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=name,
            message=message,
            hardware_id=id,
            values=[{"key": key, "value": str(value)} for key, value in values.items()],
        )


def marker(header: Any, **values: Any) -> dict:
    """A Marker's fields."""
    return {"header": header, "lifetime": {"sec": MARKER_LIFETIME_S}, **values}


def text_marker(
    header: Any, ns: str, text: str, place_mm: np.ndarray, height_m: float, colour: Colour
) -> dict:
    """A Marker of text that faces the viewer."""
    return marker(
        header,
        ns=ns,
        type=TEXT,
        action=ADD,
        pose=pose(place_mm),
        scale={"z": height_m},
        color=rgba(colour),
        text=text,
    )


def triangles_marker(
    header: Any, ns: str, corners_mm: np.ndarray, at: dict, colour: Colour, opacity: float
) -> dict:
    """A Marker of triangles, three corners each, at a pose."""
    return marker(
        header,
        ns=ns,
        type=TRIANGLES,
        action=ADD,
        pose=at,
        scale=xyz((1.0, 1.0, 1.0)),
        color=rgba(colour, opacity),
        points=PointBlock(corners_mm / MM_PER_M),
    )


def pose(place_mm: Float[np.ndarray, " 3"], wxyz: Float[np.ndarray, " 4"] | None = None) -> dict:
    """A Pose's fields; without a quaternion not turned."""
    turn = {"w": 1.0} if wxyz is None else dict(zip("wxyz", wxyz.tolist(), strict=True))
    return {"position": xyz(place_mm / MM_PER_M), "orientation": turn}


def xyz(numbers: Iterable[float]) -> dict:
    """The fields of a Point or a Vector3."""
    return dict(zip("xyz", map(float, numbers), strict=True))


def rgba(colour: Colour, opacity: float = 1.0) -> dict:
    """A ColorRGBA's fields."""
    return {**dict(zip("rgb", (value / 255 for value in colour), strict=True)), "a": opacity}


def stamp_of(header: Any) -> int:
    """A header's stamp in ns."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


@cache
def _store(distro: Distro) -> Any:
    """A typestore that also writes ``PointBlock``. Shared: it never changes afterwards."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            "ROS messages need the package rosbags: pip install 'tumortrack[live]'."
        ) from error
    name = "ROS1_NOETIC" if distro == "noetic" else f"ROS2_{distro.upper()}"
    store = get_typestore(Stores[name])
    known = store.get_msgdef(_POINT)

    def size(pos: int, point: Any, _store: Any) -> int:
        return pos + (point.nbytes if isinstance(point, np.ndarray) else 24)

    def writer(write_one: Any) -> Any:
        def write(raw: memoryview, pos: int, point: Any, store: Any) -> int:
            if not isinstance(point, np.ndarray):
                return write_one(raw, pos, point, store)
            raw[pos : pos + point.nbytes] = point.data.cast("B")
            return pos + point.nbytes

        return write

    # No fixed size: whoever holds points then asks `size`, and aligns before it writes.
    store.cache[_POINT] = dataclasses.replace(
        known,
        size_cdr=0,
        size_ros1=0,
        getsize_cdr=size,
        getsize_ros1=size,
        serialize_cdr_le=writer(known.serialize_cdr_le),
        serialize_ros1=writer(known.serialize_ros1),
    )
    return store
