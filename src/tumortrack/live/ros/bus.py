"""A ROS graph as seen by one program: topics in and out as serialised bytes.

Two implementations have the interface ``Bus``: ``dds.DdsBus`` (by Cyclone DDS, no ROS needed) and
``ros2.RclpyBus`` (by the user's own ROS, with its RMW and security).
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from tumortrack.core.errors import InputError
from tumortrack.live.ros.messages import Messages


class Publisher(NamedTuple):
    """One topic out: reliable, the newest message only, volatile unless it was asked to be latched.

    ``publish`` sends a message, in ROS 2 CDR with its 4 bytes of header, or raises TumortrackError.
    ``flush`` returns when all reliable subscribers have what was sent, or after so many seconds.
    """

    publish: Callable[[bytes | memoryview], None]
    flush: Callable[[float], None]


class Subscriber:
    """One topic in, from reliable and best effort publishers alike. The graph's library hands each
    message over by ``came``; of more than ``most`` the oldest are lost."""

    def __init__(self, most: int) -> None:
        self.lost = 0  # messages that were sent and never taken, as far as is known
        self.pending: deque[Any] = deque(maxlen=most)

    def came(self, message: Any) -> None:
        self.lost += len(self.pending) == self.pending.maxlen
        self.pending.append(message)

    def take(self) -> list[bytes | memoryview]:
        """What came since the last call, oldest first. Raises InputError on another type."""
        return [self.pending.popleft() for _ in range(len(self.pending))]


@runtime_checkable
class Bus(Protocol):
    """A participant of the graph. Used by one thread; ``close`` perhaps from another, and twice.
    ``messages``: the types that travel there; ``note``: who can reach it, in words."""

    messages: Messages
    note: str

    def publisher(self, topic: str, kind: str, latched: bool = False) -> Publisher:
        """Announce ``topic``. ``latched``: who subscribes later gets the newest message, too
        (transient local), as on /tf_static."""

    def subscriber(self, topic: str, kind: str, most: int = 5, latched: bool = False) -> Subscriber:
        """Listen to ``topic`` and hold up to ``most`` messages. ``latched``: what was published
        before, too; such a subscriber does not hear publishers that keep nothing (transient local
        against volatile)."""

    def types_of(self, topic: str) -> set[str]:
        """Message types (``sensor_msgs/msg/Image``) with which the topic is published now."""

    def topics(self) -> dict[str, set[str]]:
        """The message types of all topics that are published now."""

    def wait(self, timeout_s: float) -> None:
        """Return as soon as a subscriber has something to take, or when the time is up."""

    def close(self) -> None:
        """Leave the graph."""


def check_topic(what: str, name: str) -> None:
    """Raises InputError unless ``name`` is a topic's full one, such as /camera/depth/image."""
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", name, re.ASCII):
        raise InputError(
            f"ros2: the {what} {name!r} is no full topic name; it must look like "
            "/camera/depth/image: letters, digits and underscores between slashes, no digit first."
        )
