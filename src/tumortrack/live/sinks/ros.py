"""Results published in a ROS 2 graph, without ROS or through the user's."""

from __future__ import annotations

import time
from typing import ClassVar

from tumortrack.core.errors import TumortrackError
from tumortrack.live.ros.bus import Bus, check_topic
from tumortrack.live.ros.results import ResultMessages
from tumortrack.live.ros.ros2 import Via, open_bus
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult

_FLUSH_S = 0.2  # what was published last leaves within that time


class Ros2SinkConfig(SinkConfig, frozen=True, kw_only=True, tag="ros2"):
    """Topics under ``namespace``: see ``live.ros.results``. ``mesh_hz``: surfaces, and arms'
    markers, at most so often; 0: with every result."""

    target: ClassVar[str] = "namespace"

    namespace: str = "/tumortrack"
    mesh_hz: float = 10.0
    via: Via = "auto"

    def __post_init__(self) -> None:
        check_topic("namespace", self.namespace)
        self.check_between("ros2:", mesh_hz=(0, 1000))

    def open(self, context: SinkContext) -> RosSink:
        """Join the graph and announce the topics."""
        return RosSink(self, context, open_bus(self.via))


class RosSink:
    """Subscribers get the newest result; a slow one misses some and delays nobody. At the end, and
    whenever there is no estimate, all topics say so."""

    def __init__(self, config: Ros2SinkConfig, context: SinkContext, bus: Bus) -> None:
        self._bus, self.notes = bus, (bus.note,)
        self._results = ResultMessages(bus.messages, context, config.mesh_hz)
        self._last: TrackingResult | None = None
        nothing = TrackingResult(sequence=0, stamp_ns=0, published_frame=context.published_frame)
        self._publishers = {
            suffix: bus.publisher(f"{config.namespace}/{suffix}", message_type)
            for suffix, message_type, _ in self._results.of(nothing)
        }

    def publish(self, result: TrackingResult) -> None:
        """Send it on every topic, on the others too where one fails."""
        self._last = result
        failed: list[str] = []
        for suffix, _, message in self._results.of(result):
            publisher = self._publishers[suffix]
            try:
                publisher.publish(self._bus.messages.to_bytes(message))
            except TumortrackError as error:
                failed.append(str(error))
        if failed:
            raise TumortrackError(" ".join(failed))

    def close(self) -> None:
        """Say that it is over, so that no estimate stays on a screen, and leave."""
        last, self._last = self._last, None
        try:
            if last is not None:
                frame, reason = last.published_frame, "tracking has ended"
                sequence, stamp_ns = last.sequence + 1, last.stamp_ns + 1
                over = TrackingResult(sequence, stamp_ns, reason=reason, published_frame=frame)
                self.publish(over)
                self._last = None
                until_s = time.monotonic() + _FLUSH_S
                for publisher in self._publishers.values():
                    publisher.flush(max(0.0, until_s - time.monotonic()))
        finally:
            self._publishers = {}
            self._bus.close()
