"""A ROS 2 graph: topics in and out as serialised bytes, without ROS installed (``dds.DdsBus``) or
through the user's own (``RclpyBus``)."""

from __future__ import annotations

import contextlib
import importlib.util
import re
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Literal, Protocol, runtime_checkable

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.packages import to_install
from tumortrack_devices.ros.messages import Messages

Via = Literal["auto", "dds", "rclpy"]
Publish = Callable[[bytes | memoryview], None]
"""Sends a message (ROS 2 CDR with its header of 4 bytes), or raises TumortrackError."""


@runtime_checkable
class Subscriber(Protocol):
    """One topic in, from reliable and best effort publishers. ``lost``: messages that were sent and
    never taken, as far as known."""

    lost: int

    def take(self) -> list[bytes | memoryview]:
        """The messages since the last call, oldest first."""


@runtime_checkable
class Bus(Protocol):
    """A participant of the graph, used by one thread; ``close`` may come from another, and twice.
    ``messages``: its message types; ``note``: who can reach it, in words."""

    messages: Messages
    note: str

    def publisher(self, topic: str, kind: str, latched: bool = False) -> Publish:
        """Announce ``topic``: reliable, the newest message only. ``latched``: later subscribers
        also get that one (transient local), as on /tf_static."""

    def subscriber(self, topic: str, kind: str, most: int = 5, latched: bool = False) -> Subscriber:
        """Listen to ``topic`` and hold up to ``most`` messages. ``latched``: also what was
        published before; such a subscriber does not match volatile publishers."""

    def topics(self) -> dict[str, set[str]]:
        """The message types (``sensor_msgs/msg/Image``) that each topic is published with now."""

    def wait(self, timeout_s: float) -> None:
        """Return when a subscriber has something to take, or when the time is up."""

    def flush(self, timeout_s: float) -> None:
        """Return when all reliable subscribers have received everything, or when the time is up."""

    def close(self) -> None:
        """Leave the graph."""


def check_topic(what: str, name: str) -> None:
    """Raises InputError unless ``name`` is a full topic name, such as /camera/depth/image."""
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", name, re.ASCII):
        raise InputError(
            f"ros2: the {what} {name!r} is no full topic name; it must look like "
            "/camera/depth/image: letters, digits and underscores between slashes, no digit first."
        )


def open_bus(via: Via) -> Bus:
    """Join the ROS 2 graph of ``ROS_DOMAIN_ID``; ``auto``: by rclpy if it can be imported. Raises
    InputError if that is not installed, or the environment cannot be used."""
    messages = Messages()
    if via == "rclpy" or (via == "auto" and importlib.util.find_spec("rclpy")):
        return RclpyBus(messages)
    try:
        from tumortrack_devices.ros.dds import DdsBus
    except ImportError as error:
        raise InputError(
            f"ROS 2 without ROS needs cyclonedds: {to_install('tumortrack-devices')}. It "
            "exists for x86-64 and Python up to 3.13; elsewhere use your ROS's own rclpy."
        ) from error
    return DdsBus(messages)


class RclpySubscriber:
    """``receive`` is called by rclpy; of more than ``most`` messages the oldest are lost."""

    def __init__(self, most: int) -> None:
        self.lost = 0
        self._pending: deque[Any] = deque(maxlen=most)

    def receive(self, message: Any) -> None:
        self.lost += len(self._pending) == self._pending.maxlen
        self._pending.append(message)

    def take(self) -> list[bytes | memoryview]:
        return [self._pending.popleft() for _ in range(len(self._pending))]


class RclpyBus:
    """See ``Bus``: a node in its own context, in a sourced ROS 2, Humble or later, of this Python's
    version. Messages pass as bytes: rclpy's conversion to Python objects is slow for clouds."""

    def __init__(self, messages: Messages) -> None:
        try:
            import rclpy
            from rclpy import executors, qos
        except ImportError as error:
            raise InputError(
                f"rclpy cannot be imported ({error}). Source ROS 2's setup.bash, with a Python of "
                "the same version; or use via=dds, which needs no ROS."
            ) from error
        self.messages, self._qos = messages, qos
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context)  # its own context: no signal handlers
        name = f"tumortrack_{secrets.token_hex(3)}"  # each its own: a run has several
        self._node = rclpy.create_node(name, context=self._context)
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._lock, self._closed = threading.Lock(), False  # held while spinning: close waits
        self.note = "as far as the sourced ROS 2 reaches, whoever is there can see and publish"

    def publisher(self, topic: str, kind: str, latched: bool = False) -> Publish:
        durability = self._qos.DurabilityPolicy
        kept = durability.TRANSIENT_LOCAL if latched else durability.VOLATILE
        profile = self._qos.QoSProfile(depth=1, durability=kept)  # reliable by default
        writer = self._node.create_publisher(_message_class(kind), topic, profile)

        def publish(raw: bytes | memoryview) -> None:
            try:
                writer.publish(bytes(raw))  # bytes: taken as serialised already
            except Exception as error:  # rclpy's own types differ between distributions
                raise TumortrackError(f"{topic}: a message was not sent ({error}).") from error

        return publish

    def subscriber(self, topic: str, kind: str, most: int = 5, latched: bool = False) -> Subscriber:
        reliability, durability = self._qos.ReliabilityPolicy, self._qos.DurabilityPolicy
        profile = self._qos.QoSProfile(
            depth=most,
            reliability=reliability.RELIABLE if latched else reliability.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
        )
        made, message_class = RclpySubscriber(most), _message_class(kind)
        self._node.create_subscription(message_class, topic, made.receive, profile, raw=True)
        return made

    def topics(self) -> dict[str, set[str]]:
        of = self._node.get_publishers_info_by_topic
        names = [name for name, _ in self._node.get_topic_names_and_types()]
        kinds = {name: {info.topic_type for info in of(name)} for name in names}
        return {name: published for name, published in kinds.items() if published}

    def wait(self, timeout_s: float) -> None:
        with self._lock:
            if not self._closed:
                self._executor.spin_once(timeout_sec=max(0.0, timeout_s))

    def flush(self, timeout_s: float) -> None:
        from rclpy.duration import Duration

        until_s = time.monotonic() + timeout_s
        for writer in self._node.publishers:
            left_s = max(0.0, until_s - time.monotonic())
            with contextlib.suppress(NotImplementedError, RuntimeError):  # not in every RMW
                writer.wait_for_all_acked(Duration(seconds=left_s))

    def close(self) -> None:
        with self._lock:
            closed, self._closed = self._closed, True
        if not closed:
            self._executor.shutdown()
            self._node.destroy_node()
            self._context.try_shutdown()


def _message_class(message_type: str) -> Any:
    package, _, name = message_type.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the sourced ROS 2 has no message type {message_type}. Install the package "
            f"ros-<distribution>-{package.replace('_', '-')}."
        ) from error
