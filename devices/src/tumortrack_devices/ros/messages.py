"""Messages of ROS 2, made from field names, and their bytes (CDR); and of ROS 1, from its bags.

Types come from rosbags, a pure Python library that needs no ROS. ROS 1 has shorter names for the
same types: ``sensor_msgs/msg/Image`` here is its ``sensor_msgs/Image``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.resources import files
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install

Distro = Literal["noetic", "humble"]

MM_PER_M = 1000
_POINT = "geometry_msgs/msg/Point"
_LATEST_S = 2**31 - 1  # ROS counts seconds in 32 bits, ROS 2 in signed ones
_ZEROS = bytes(4096)  # in ROS 1's form: any message, empty


class Outgoing(NamedTuple):
    """A message, and the last part of its topic's name (``meshes``), or a full name (``/tf``)."""

    suffix: str
    message_type: str
    message: Any

    def topic(self, namespace: str) -> str:
        return self.suffix if self.suffix.startswith("/") else f"{namespace}/{self.suffix}"


class PointBlock:
    """A marker's points as one array, its only element, written in one piece: tens of thousands of
    point messages would take a tenth of a second."""

    def __init__(self, points: Float64[np.ndarray, "n 3"]) -> None:
        self.array = np.ascontiguousarray(points, "<f8")

    def __len__(self) -> int:
        return len(self.array)

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.array,) if len(self.array) else ())


class Messages:
    """The message types of one distribution; ROS 2's are the same from Humble to Lyrical.
    ``store``: rosbags' typestore of them."""

    def __init__(self, distro: Distro = "humble") -> None:
        self._is_ros1 = distro == "noetic"
        self.store = _store(distro)

    def make(self, message_type: str, **values: Any) -> Any:
        """A message: fields by name, the others empty (0, "", no elements). A dictionary stands for
        a nested message, a list of dictionaries for several. Case does not matter: ROS 1 writes
        ``K`` where ROS 2 writes ``k``."""
        about = self.store.get_msgdef(message_type)
        message, _ = about.deserialize_ros1(_ZEROS, 0, about.cls, self.store)
        fields = {name.lower(): (name, kind) for name, kind in about.fields}
        for given, value in values.items():
            if given.lower() not in fields:
                raise TypeError(f"{message_type} has no field {given}")
            name, (_, inner) = fields[given.lower()]
            if isinstance(value, dict):
                value = self.make(inner, **value)
            elif isinstance(value, list):
                of = inner[0][1]
                value = [self.make(of, **v) if isinstance(v, dict) else v for v in value]
            setattr(message, name, value)
        return message

    def to_bytes(self, message: Any) -> memoryview:
        """As on the wire: CDR with its header in ROS 2, ROS 1's form in Noetic."""
        write = self.store.serialize_ros1 if self._is_ros1 else self.store.serialize_cdr
        return write(message, message.__msgtype__)

    def from_bytes(self, data: bytes | memoryview, message_type: str) -> Any:
        """Raises InputError if the bytes are not of that type."""
        from rosbags.serde import SerdeError

        read = self.store.deserialize_ros1 if self._is_ros1 else self.store.deserialize_cdr
        try:
            return read(data, message_type)
        except KeyError as error:
            raise InputError(f"{message_type} is no message type that is known here.") from error
        except (SerdeError, AssertionError, MemoryError, IndexError, OverflowError) as error:
            raise InputError(
                f"{len(data)} bytes that came are no {message_type} ({error}). Are sender and "
                "receiver of the same ROS distribution?"
            ) from error

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Raises InputError before 1970 or after 2038: beyond 32 bits of seconds."""
        seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
        if not 0 <= seconds <= _LATEST_S:
            raise InputError(
                f"the stamp {stamp_ns} ns cannot be said in ROS, whose clock runs from 1970 to "
                "2038. Set the clock of the source."
            )
        stamp = {"sec": seconds, "nanosec": nanoseconds}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def xyz(numbers: Iterable[float]) -> dict[str, Any]:
    """The fields of a Point or a Vector3."""
    return dict(zip("xyz", map(float, numbers), strict=True))


def stamp_of(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


@cache
def _store(distro: Distro) -> Any:
    """A typestore that also writes ``PointBlock``; shared and never changed afterwards."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise InputError(
            f"ROS messages need the package rosbags: {to_install('tumortrack-devices')}."
        ) from error
    store = get_typestore(Stores.ROS1_NOETIC if distro == "noetic" else Stores.ROS2_HUMBLE)
    if distro != "noetic":
        text = files(__package__).joinpath("moveit.msg").read_text("utf-8")
        store.register(get_types_from_msg(text, "moveit_msgs/msg/PlanningScene"))
    known = store.get_msgdef(_POINT)

    def size(pos: int, point: Any, _store: Any) -> int:
        return pos + getattr(point, "nbytes", 24)

    def write(raw: memoryview, pos: int, point: Any, store: Any) -> int:
        if not isinstance(point, np.ndarray):
            return known.serialize_cdr_le(raw, pos, point, store)
        raw[pos : pos + point.nbytes] = point.data.cast("B")
        return pos + point.nbytes

    # No fixed size: messages that hold points then call `size`, and align before they write.
    store.cache[_POINT] = dataclasses.replace(
        known, size_cdr=0, getsize_cdr=size, serialize_cdr_le=write
    )
    return store
