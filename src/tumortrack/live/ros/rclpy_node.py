"""ROS 2 topics through the user's own ROS: the same interface as ``dds``, by rclpy.

Serialised bytes pass through in both directions, so that rclpy's conversion to Python objects,
slow for clouds, is not used. Needs a sourced ROS 2, Humble or later, of this Python's version.
"""

from __future__ import annotations

import contextlib
import importlib
import threading
from collections import deque
from typing import Any

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.ros.messages import Messages


class RclpyBus:
    """A node of its own, in a context of its own; see ``bus.Bus``."""

    def __init__(self, _messages: Messages) -> None:
        """
        Raises:
            InputError: no rclpy that this Python can import.
        """
        try:
            import rclpy
            from rclpy.executors import SingleThreadedExecutor
        except ImportError as error:
            raise InputError(
                f"rclpy cannot be imported ({error}). Source ROS 2's setup.bash, with a Python of "
                "the same version; or use via=dds, which needs no ROS."
            ) from error
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context)  # its own context: no grip on signals
        self._node = rclpy.create_node("tumortrack", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._lock = threading.Lock()  # held while spinning: nothing is taken apart under it
        self._closed = False

    def publisher(self, topic: str, message_type: str) -> RclpyPublisher:
        from rclpy.qos import QoSProfile

        kind = _message_class(message_type)
        return RclpyPublisher(self._node.create_publisher(kind, topic, QoSProfile(depth=1)), topic)

    def subscriber(
        self, topic: str, message_type: str, depth: int = 5, latched: bool = False
    ) -> RclpySubscriber:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        qos = QoSProfile(
            depth=depth,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE),
        )
        subscriber = RclpySubscriber(depth)
        kind = _message_class(message_type)
        self._node.create_subscription(kind, topic, subscriber.came, qos, raw=True)
        return subscriber

    def types_of(self, topic: str) -> set[str]:
        return {one.topic_type for one in self._node.get_publishers_info_by_topic(topic)}

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


class RclpyPublisher:
    """See ``bus.Publisher``. rclpy's own defaults are ROS 2's: reliable, volatile."""

    wanted = True

    def __init__(self, publisher: Any, topic: str) -> None:
        self._publisher, self._topic = publisher, topic

    def publish(self, raw: bytes | memoryview) -> None:
        try:
            self._publisher.publish(bytes(raw))  # bytes: taken as serialised already
        except Exception as error:  # rclpy's own kinds differ between distributions
            raise TumortrackError(f"{self._topic}: a message was not sent ({error}).") from error

    def flush(self, timeout_s: float) -> None:
        from rclpy.duration import Duration

        # Not every RMW can say what arrived; then there is nothing to wait for.
        with contextlib.suppress(NotImplementedError, RuntimeError):
            self._publisher.wait_for_all_acked(Duration(seconds=timeout_s))


class RclpySubscriber:
    """See ``bus.Subscriber``; ``came`` is called while its bus waits."""

    def __init__(self, depth: int) -> None:
        self.lost = 0
        self._came: deque[bytes] = deque(maxlen=depth)

    def came(self, cdr: bytes) -> None:
        self.lost += len(self._came) == self._came.maxlen
        self._came.append(cdr)

    def take(self) -> list[bytes | memoryview]:
        taken: list[bytes | memoryview] = list(self._came)
        self._came.clear()
        return taken


def _message_class(message_type: str) -> Any:
    package, _, name = message_type.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the sourced ROS 2 has no message type {message_type}. Install the package "
            f"ros-<distribution>-{package.replace('_', '-')}."
        ) from error
