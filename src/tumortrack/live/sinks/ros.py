"""Results published in a ROS graph: ROS 2, without ROS or through the user's, and ROS 1."""

from __future__ import annotations

import time
from typing import ClassVar

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.meter import Rate
from tumortrack.live.ros.bus import Bus, Publisher, Via, check_topic, open_bus
from tumortrack.live.ros.messages import Messages, Outgoing
from tumortrack.live.ros.results import messages_of
from tumortrack.live.ros.rospy_node import MasterLost, RospyBus, check_name
from tumortrack.live.ros.workcell import WorkcellMessages
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult

_FLUSH_S = 0.2  # what was published last leaves within that time
_CHECK_S = 1.0  # how often the ROS 1 master is asked whether it knows the topics
_CHECK_SHARE = 0.1  # and at most so much of the time is spent waiting for its answer


class RosSinkConfig(SinkConfig, frozen=True, kw_only=True):
    """Topics under ``namespace``: see ``live.ros.results``.

    Attributes:
        mesh_hz: surfaces, and arms' markers, at most so often; 0: with every result.
    """

    target: ClassVar[str] = "namespace"

    namespace: str = "/tumortrack"
    mesh_hz: float = 10.0

    def __post_init__(self) -> None:
        if not 0 <= self.mesh_hz <= 1000:
            kind = self.__struct_config__.tag
            raise InputError(f"{kind}: mesh_hz {self.mesh_hz:g} must lie in 0..1000.")


class Ros2SinkConfig(RosSinkConfig, frozen=True, kw_only=True, tag="ros2"):
    """Topics of ROS 2.

    Attributes:
        via: dds: without ROS; rclpy: through the ROS that is sourced; auto: rclpy where there is.
    """

    via: Via = "auto"

    def __post_init__(self) -> None:
        check_topic(self.namespace, "ros2: the namespace")
        super().__post_init__()

    def open(self, context: SinkContext) -> RosSink:
        """Join the graph and announce the topics."""
        messages = Messages()
        return RosSink(self, context, open_bus(self.via, messages), messages)


class Ros1SinkConfig(RosSinkConfig, frozen=True, kw_only=True, tag="ros1"):
    """Topics of ROS 1."""

    def __post_init__(self) -> None:
        check_name(self.namespace)
        super().__post_init__()

    def open(self, context: SinkContext) -> Ros1Sink:
        """Announce the topics. Raises InputError without rospy or without a master."""
        messages = Messages("noetic")
        try:
            return Ros1Sink(self, context, RospyBus(messages), messages)
        except MasterLost as error:
            raise InputError(str(error)) from error


class RosSink:
    """Subscribers get the newest result; a slow one misses some and delays nobody. At the end, and
    whenever there is no estimate, all topics say so."""

    def __init__(
        self, config: RosSinkConfig, context: SinkContext, bus: Bus, messages: Messages
    ) -> None:
        self._bus, self._messages, self._parts = bus, messages, context.parts
        self._mesh_rate = Rate(config.mesh_hz)
        self._workcell = WorkcellMessages(messages, config.mesh_hz) if context.arms else None
        self._last: TrackingResult | None = None
        nothing = TrackingResult(sequence=0, stamp_ns=0, published_frame=context.published_frame)
        self._publishers: dict[str, Publisher] = {
            suffix: bus.publisher(f"{config.namespace}/{suffix}", message_type)
            for suffix, message_type, _ in self._messages_of(nothing)
        }

    def publish(self, result: TrackingResult) -> None:
        """Send it on every topic, on the others too where one fails.

        Raises:
            TumortrackError: a topic's message could not be sent; the ROS 1 master is gone.
            InputError: a stamp that ROS can't say.
        """
        self._last = result
        failed: list[str] = []
        meshes = result.estimate is None or self._mesh_rate.due()
        for suffix, _, message in self._messages_of(result, meshes):
            publisher = self._publishers[suffix]
            if not publisher.wanted:
                continue
            try:
                publisher.publish(self._messages.to_bytes(message))
            except InputError:
                raise
            except TumortrackError as error:
                failed.append(str(error))
        if failed:
            raise TumortrackError(" ".join(failed))

    def close(self) -> None:
        """Say that it is over, so that no estimate stays on a screen, and leave."""
        last, self._last = self._last, None
        try:
            if last is not None:
                self.publish(
                    TrackingResult(
                        sequence=last.sequence + 1,
                        stamp_ns=last.stamp_ns + 1,
                        reason="tracking has ended",
                        published_frame=last.published_frame,
                    )
                )
                self._last = None
                until_s = time.monotonic() + _FLUSH_S
                for publisher in self._publishers.values():
                    publisher.flush(max(0.0, until_s - time.monotonic()))
        finally:
            self._publishers = {}
            self._bus.close()

    def _messages_of(self, result: TrackingResult, meshes: bool = True) -> list[Outgoing]:
        return messages_of(result, self._messages, self._parts, meshes, self._workcell)


class Ros1Sink(RosSink):
    """Looks after its registrations. Without a master only those who were connected before get the
    results, and ``publish`` raises MasterLost."""

    def __init__(
        self, config: Ros1SinkConfig, context: SinkContext, bus: RospyBus, messages: Messages
    ) -> None:
        super().__init__(config, context, bus, messages)
        self._node_bus, self._lost = bus, ""
        self._check_at_s = time.monotonic() + _CHECK_S

    def publish(self, result: TrackingResult) -> None:
        super().publish(result)
        start_s = time.monotonic()
        if start_s >= self._check_at_s:
            try:
                self._node_bus.register_again()
                self._lost = ""
            except MasterLost as error:
                self._lost = str(error)
            end_s = time.monotonic()
            self._check_at_s = end_s + max(_CHECK_S, (end_s - start_s) / _CHECK_SHARE)
        if self._lost:
            raise MasterLost(self._lost)
