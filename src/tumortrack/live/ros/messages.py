"""Messages of one ROS distribution, made by field names, and their bytes: CDR for ROS 2, ROS 1's
own.

Types come from rosbags, which is a Python library of the package index and needs no ROS. ROS 1
names the same types: ``sensor_msgs/msg/Image`` here is its ``sensor_msgs/Image``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError

Distro = Literal["noetic", "foxy", "galactic", "humble", "iron", "jazzy", "kilted", "lyrical"]

_POINT = "geometry_msgs/msg/Point"
_LATEST_S = 2**31 - 1  # ROS counts seconds in 32 bits, ROS 2 with a sign


class PointBlock(Sequence):
    """Points of a marker as one array, written in one piece.

    Stands where a message wants a list of points: tens of thousands of objects would take a tenth
    of a second to write. To iterate over it gives the array itself, once; an index gives a point.
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
        """A message: fields by name, those not named empty (0, "", no elements).

        Letters' case does not count: ROS 1 writes ``K`` where ROS 2 writes ``k``.
        """
        given = {name.lower(): value for name, value in values.items()}
        fields = {}
        for name, kind in self._store.fielddefs[message_type][1]:
            known = name.lower() in given
            fields[name] = given.pop(name.lower()) if known else self._empty(kind)
        if given:
            raise TypeError(f"{message_type} has no field {', '.join(given)}")
        return self._store.types[message_type](**fields)

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
        return from_bytes(self._store, data, message_type, ros1=self.is_ros1)

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
        stamp = self.time(stamp_ns)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def time(self, stamp_ns: int) -> Any:
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
        return self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def from_bytes(store: Any, data: bytes | memoryview, message_type: str, ros1: bool) -> Any:
    """The message that these bytes are, by a rosbags typestore.

    Raises:
        InputError: they are no such message.
    """
    from rosbags.serde import SerdeError

    read = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    try:
        return read(data, message_type)
    except KeyError as error:
        raise InputError(f"{message_type} is no message type that is known here.") from error
    except (SerdeError, AssertionError, MemoryError, IndexError, OverflowError) as error:
        raise InputError(
            f"{len(data)} bytes that came are no {message_type} ({error}). Are sender and receiver "
            "of the same ROS distribution?"
        ) from error


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
