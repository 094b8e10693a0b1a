"""ROS message types as Cyclone DDS knows types: name and fields, made from their definition.

Cyclone checks with them that bytes from the network are what their type says, lengths included,
before anybody here sees them. Values never pass through: only bytes do.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from tumortrack.core.errors import InputError

_NUMBERS = (
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
    *("float32", "float64"),
)


def dds_name(message_type: str) -> str:
    """``sensor_msgs/msg/Image`` -> ``sensor_msgs::msg::dds_::Image_``."""
    package, kind, name = message_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(type_name: str) -> str:
    """The way back; empty for a type that is none of ROS."""
    parts = type_name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return ""
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


@cache
def idl_type(message_type: str, distro: str) -> Any:
    """The type as a cyclonedds ``IdlStruct``; final, no key, as ROS 2 makes it.

    Raises:
        InputError: no such type in that distribution, or one with wide characters.
    """
    from cyclonedds.idl import make_idl_struct
    from rosbags.typesys import Stores, get_typestore

    fields = get_typestore(Stores[f"ROS2_{distro.upper()}"]).fielddefs.get(message_type)
    if fields is None:
        raise InputError(f"ROS 2 {distro} has no message type {message_type}.")
    members = {name: _member(kind, distro) for name, kind in fields[1]}
    name = message_type.rsplit("/", 1)[-1]
    return make_idl_struct(f"{name}_", dds_name(message_type), members)


def _member(kind: Any, distro: str) -> Any:
    from cyclonedds.idl import types
    from rosbags.interfaces import Nodetype

    node, content = kind
    if node == Nodetype.NAME:
        return idl_type(content, distro)
    if node == Nodetype.BASE:
        name = {"char": "uint8", "byte": "uint8", "octet": "uint8"}.get(content[0], content[0])
        if name in _NUMBERS:
            return getattr(types, name)
        if name in ("string", "bool"):
            return str if name == "string" else bool
        raise InputError(f"messages with fields of type {name} are not supported.")
    inner, length = content
    if node == Nodetype.ARRAY:
        return types.array(_member(inner, distro), length)
    return types.sequence(_member(inner, distro))
