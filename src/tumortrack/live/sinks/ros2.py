"""What is estimated, published in a ROS 2 graph, without ROS or through the user's."""

from __future__ import annotations

import time
from typing import ClassVar

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.ros.bus import Bus, Publisher, Via, check_topic, open_bus
from tumortrack.live.ros.cell import WorkcellMessages
from tumortrack.live.ros.markers import Rate
from tumortrack.live.ros.messages import Messages
from tumortrack.live.ros.observed import Outgoing
from tumortrack.live.ros.outgoing import ended, messages_of
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult

_FLUSH_S = 0.2  # what was published last leaves within that time


class Ros2SinkConfig(SinkConfig, frozen=True, kw_only=True, tag="ros2"):
    """Topics under ``namespace``: see ``live.ros.outgoing``.

    Attributes:
        mesh_hz: surfaces, and arms' markers, at most so often; 0: with every update.
        via: dds: without ROS; rclpy: through the ROS that is sourced; auto: rclpy where there is.
    """

    target: ClassVar[str] = "namespace"

    namespace: str = "/tumortrack"
    mesh_hz: float = 10.0
    via: Via = "auto"

    def __post_init__(self) -> None:
        check_topic(self.namespace, "ros2: the namespace")
        if not 0 <= self.mesh_hz <= 1000:
            raise InputError(f"ros2: mesh_hz {self.mesh_hz:g} must lie in 0..1000.")

    def open(self, setting: SinkContext) -> Ros2Sink:
        """Join the graph and announce the topics.

        Raises:
            InputError: the way is not there (``bus.open_bus``).
        """
        messages = Messages()
        return Ros2Sink(self, setting, open_bus(self.via, messages), messages)


class Ros2Sink:
    """Whoever subscribes gets the newest update; one that is slow misses some and holds up nobody.
    At the end, and whenever there is no estimate, all topics say so."""

    def __init__(
        self, config: Ros2SinkConfig, setting: SinkContext, bus: Bus, messages: Messages
    ) -> None:
        self._bus, self._messages, self._parts = bus, messages, setting.parts
        self._mesh_rate = Rate(config.mesh_hz)
        self._cell = WorkcellMessages(messages, config.mesh_hz) if setting.arms else None
        self._last: TrackingResult | None = None
        nothing = TrackingResult(sequence=0, stamp_ns=0, frames=setting.frames)
        self._publishers: dict[str, Publisher] = {
            suffix: bus.publisher(f"{config.namespace}/{suffix}", message_type)
            for suffix, message_type, _ in self._messages_of(nothing)
        }

    def publish(self, update: TrackingResult) -> None:
        """Send it on every topic, the others too where one fails.

        Raises:
            TumortrackError: a topic's message could not be sent.
            InputError: a stamp that ROS can't say.
        """
        self._last = update
        failed: list[str] = []
        meshes = update.estimate is None or self._mesh_rate.due()
        for suffix, _, message in self._messages_of(update, meshes):
            try:
                self._publishers[suffix].publish(self._messages.to_bytes(message))
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
                self.publish(ended(last))
            self._last = None
            until_s = time.monotonic() + _FLUSH_S
            for publisher in self._publishers.values():
                publisher.flush(max(0.0, until_s - time.monotonic()))
        finally:
            self._publishers = {}
            self._bus.close()

    def _messages_of(self, update: TrackingResult, meshes: bool = True) -> list[Outgoing]:
        return messages_of(update, self._messages, self._parts, meshes, self._cell)
