"""ROS 2 without ROS installed (``dds``), or through the user's own (``rclpy``)."""

from __future__ import annotations

import contextlib
import importlib.util
import threading
from typing import Any, Literal

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.packages import to_install
from tumortrack_devices.ros.bus import Bus, Publisher, Subscriber
from tumortrack_devices.ros.messages import Messages

Via = Literal["auto", "dds", "rclpy"]


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


class RclpyBus:
    """ROS 2 through the user's own ROS, by a node in its own context. Serialised bytes pass through
    in both directions: rclpy's conversion to Python objects is slow for clouds. Needs a sourced
    ROS 2, Humble or later, of this Python's version."""

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
        self._node = rclpy.create_node("tumortrack", context=self._context)
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._lock = threading.Lock()  # held while spinning, so that close waits
        self._closed = False
        self.note = "as far as the sourced ROS 2 reaches, whoever is there can see and publish"

    def publisher(self, topic: str, kind: str, latched: bool = False) -> Publisher:
        from rclpy.duration import Duration

        durability = self._qos.DurabilityPolicy
        kept = durability.TRANSIENT_LOCAL if latched else durability.VOLATILE
        profile = self._qos.QoSProfile(depth=1, durability=kept)  # reliable by default
        writer = self._node.create_publisher(_message_class(kind), topic, profile)

        def publish(raw: bytes | memoryview) -> None:
            try:
                writer.publish(bytes(raw))  # bytes: taken as serialised already
            except Exception as error:  # rclpy's own types differ between distributions
                raise TumortrackError(f"{topic}: a message was not sent ({error}).") from error

        def flush(timeout_s: float) -> None:
            with contextlib.suppress(NotImplementedError, RuntimeError):  # not in every RMW
                writer.wait_for_all_acked(Duration(seconds=timeout_s))

        return Publisher(publish, flush)

    def subscriber(self, topic: str, kind: str, most: int = 5, latched: bool = False) -> Subscriber:
        reliability, durability = self._qos.ReliabilityPolicy, self._qos.DurabilityPolicy
        profile = self._qos.QoSProfile(
            depth=most,
            reliability=reliability.RELIABLE if latched else reliability.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
        )
        subscriber = Subscriber(most)
        receive, message_class = subscriber.receive, _message_class(kind)
        self._node.create_subscription(message_class, topic, receive, profile, raw=True)
        return subscriber

    def types_of(self, topic: str) -> set[str]:
        return {info.topic_type for info in self._node.get_publishers_info_by_topic(topic)}

    def topics(self) -> dict[str, set[str]]:
        return {topic: set(kinds) for topic, kinds in self._node.get_topic_names_and_types()}

    def wait(self, timeout_s: float) -> None:
        with self._lock:
            if not self._closed:
                self._executor.spin_once(timeout_sec=max(0.0, timeout_s))

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
