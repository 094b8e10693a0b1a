"""The interface to a ROS graph: topics in and out as serialised bytes.

``Bus`` has two implementations: ``dds.DdsBus`` (Cyclone DDS, no ROS needed) and ``ros2.RclpyBus``
(the user's own ROS, with its RMW and security).
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from tumortrack.core.errors import InputError
from tumortrack_devices.ros.messages import Messages


class Publisher(NamedTuple):
    """One topic out: reliable, the newest message only, volatile unless latched.

    ``publish`` sends a message (ROS 2 CDR with its header of 4 bytes), or raises TumortrackError.
    ``flush`` returns when all reliable subscribers have received everything, or after that many
    seconds.
    """

    publish: Callable[[bytes | memoryview], None]
    flush: Callable[[float], None]


class Subscriber:
    """One topic in, from reliable and best effort publishers. The ROS library calls ``receive``
    with each message; of more than ``most`` the oldest are lost."""

    def __init__(self, most: int) -> None:
        self.lost = 0  # messages that were sent and never taken, as far as known
        self.pending: deque[Any] = deque(maxlen=most)

    def receive(self, message: Any) -> None:
        self.lost += len(self.pending) == self.pending.maxlen
        self.pending.append(message)

    def take(self) -> list[bytes | memoryview]:
        """The messages since the last call, oldest first."""
        return [self.pending.popleft() for _ in range(len(self.pending))]


@runtime_checkable
class Bus(Protocol):
    """A participant of the graph, used by one thread; ``close`` may come from another, and twice.
    ``messages``: its message types; ``note``: who can reach it, in words."""

    messages: Messages
    note: str

    def publisher(self, topic: str, kind: str, latched: bool = False) -> Publisher:
        """Announce ``topic``. ``latched``: later subscribers also get the newest message
        (transient local), as on /tf_static."""

    def subscriber(self, topic: str, kind: str, most: int = 5, latched: bool = False) -> Subscriber:
        """Listen to ``topic`` and hold up to ``most`` messages. ``latched``: also what was
        published before; such a subscriber does not match volatile publishers."""

    def types_of(self, topic: str) -> set[str]:
        """The message types (``sensor_msgs/msg/Image``) that the topic is published with now."""

    def topics(self) -> dict[str, set[str]]:
        """The message types of all topics."""

    def wait(self, timeout_s: float) -> None:
        """Return when a subscriber has something to take, or when the time is up."""

    def close(self) -> None:
        """Leave the graph."""


def check_topic(what: str, name: str) -> None:
    """Raises InputError unless ``name`` is a full topic name, such as /camera/depth/image."""
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", name, re.ASCII):
        raise InputError(
            f"ros2: the {what} {name!r} is no full topic name; it must look like "
            "/camera/depth/image: letters, digits and underscores between slashes, no digit first."
        )
