"""A ROS graph as seen by one program: topics in and out as serialised bytes.

Three implementations have this interface: ``dds`` (ROS 2 by Cyclone DDS, no ROS needed), ``rclpy``
(ROS 2 by the user's own ROS, with its RMW and security) and ``rospy`` (ROS 1).
"""

from __future__ import annotations

import importlib.util
import os
from typing import Literal, Protocol, runtime_checkable

from tumortrack.core.errors import InputError
from tumortrack.live.ros.messages import Messages

Via = Literal["auto", "dds", "rclpy"]

# Domain 233 and above have ports beyond 65535 (DDSI-RTPS 9.6.1.1).
_LARGEST_DOMAIN = 232


@runtime_checkable
class Publisher(Protocol):
    """One topic out: reliable, volatile, the newest message only, as ROS 2 nodes publish."""

    @property
    def wanted(self) -> bool:
        """False if surely nobody subscribes."""
        ...

    def publish(self, raw: bytes | memoryview) -> None:
        """Send a message: in ROS 2 CDR with its 4 bytes of header.

        Raises:
            TumortrackError: it could not be sent.
        """
        ...

    def flush(self, timeout_s: float) -> None:
        """Return when all reliable subscribers have what was sent, or when the time is up."""
        ...


@runtime_checkable
class Subscriber(Protocol):
    """One topic in, from reliable and best effort publishers alike."""

    @property
    def lost(self) -> int:
        """Messages that were sent and never taken, as far as is known."""
        ...

    def take(self) -> list[bytes | memoryview]:
        """What came since the last call, oldest first, at most the depth asked for.

        Raises:
            InputError: a message of another type.
        """
        ...


@runtime_checkable
class Bus(Protocol):
    """A participant of the graph. Used by one thread; ``close`` perhaps from another."""

    def publisher(self, topic: str, message_type: str) -> Publisher: ...

    def subscriber(
        self, topic: str, message_type: str, depth: int = 5, latched: bool = False
    ) -> Subscriber:
        """Listen to ``topic``. ``latched``: to what was published before, too; such a subscriber
        does not hear publishers that keep nothing (transient local against volatile)."""
        ...

    def types_of(self, topic: str) -> set[str]:
        """Message types (``sensor_msgs/msg/Image``) with which the topic is published now."""
        ...

    def wait(self, timeout_s: float) -> None:
        """Return as soon as a subscriber has something to take, or when the time is up."""
        ...

    def close(self) -> None:
        """Leave the graph; may be called twice."""
        ...


def open_bus(via: Via, messages: Messages) -> Bus:
    """Join the ROS 2 graph of ``ROS_DOMAIN_ID``; ``auto``: by rclpy where it can be imported.

    Raises:
        InputError: that way is not there; an unusable environment.
    """
    if via == "rclpy" or (via == "auto" and importlib.util.find_spec("rclpy")):
        from tumortrack.live.ros.rclpy_node import RclpyBus

        return RclpyBus(messages)
    from tumortrack.live.ros.dds import DdsBus

    return DdsBus(messages, domain_id())


def domain_id() -> int:
    """The ROS domain, from the environment.

    Raises:
        InputError: ``ROS_DOMAIN_ID`` is no whole number in 0..232.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not (text.isdecimal() and text.isascii() and int(text) <= _LARGEST_DOMAIN):
        raise InputError(
            f"ROS_DOMAIN_ID is {text!r}; it must be a whole number in 0..{_LARGEST_DOMAIN}."
        )
    return int(text)


def check_topic(topic: str, what: str) -> None:
    """Raises InputError unless ``topic`` is a full topic name such as /camera/depth/image."""
    parts = topic.split("/")
    good = (
        len(parts) > 1
        and parts[0] == ""
        and all(part.isascii() and part.isidentifier() for part in parts[1:])
    )
    if not good:
        raise InputError(
            f"{what} {topic!r} is no full topic name; it must look like /camera/depth/image: "
            "letters, digits and underscores between slashes, no digit first."
        )
