"""What is estimated, published in a ROS 1 graph through rospy."""

from __future__ import annotations

import time
from typing import Any, ClassVar

from tumortrack.core.errors import InputError
from tumortrack.live.ros import rospy_node
from tumortrack.live.ros.cell import WorkcellMessages
from tumortrack.live.ros.markers import Rate
from tumortrack.live.ros.messages import Messages
from tumortrack.live.ros.observed import Outgoing
from tumortrack.live.ros.outgoing import ended, messages_of
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult

_CHECK_S = 1.0  # how often the master is asked whether it knows the topics
_CHECK_SHARE = 0.1  # and at most so much of the time is spent waiting for its answer
_FLUSH_S = 0.2  # what was published last leaves within that time


class Ros1SinkConfig(SinkConfig, frozen=True, kw_only=True, tag="ros1"):
    """Topics under ``namespace``: see ``live.ros.outgoing``.

    Attributes:
        mesh_hz: surfaces, and arms' markers, at most so often; 0: with every update.
    """

    target: ClassVar[str] = "namespace"

    namespace: str = "/tumortrack"
    mesh_hz: float = 10.0

    def __post_init__(self) -> None:
        rospy_node.check_name(self.namespace)
        if not 0 <= self.mesh_hz <= 1000:
            raise InputError(f"ros1: mesh_hz {self.mesh_hz:g} must lie in 0..1000.")

    def open(self, setting: SinkContext) -> Ros1Sink:
        """Advertise.

        Raises:
            InputError: no rospy, or no master.
        """
        try:
            return Ros1Sink(self, setting, rospy_node.node())
        except rospy_node.MasterLost as error:
            raise InputError(str(error)) from error


class Ros1Sink:
    """Whoever subscribes gets the newest update as fast as it takes them. At the end, and whenever
    there is no estimate, all topics say so."""

    def __init__(self, config: Ros1SinkConfig, setting: SinkContext, node: rospy_node.Node) -> None:
        self._node, self._parts = node, setting.parts
        self._messages = Messages("noetic")
        self._mesh_rate = Rate(config.mesh_hz)
        self._cell = WorkcellMessages(self._messages, config.mesh_hz) if setting.arms else None
        self._last: TrackingResult | None = None
        self._lost = ""
        nothing = TrackingResult(sequence=0, stamp_ns=0, frames=setting.frames)
        self._publishers: dict[str, Any] = {
            suffix: self._advertise(f"{config.namespace}/{suffix}", message_type)
            for suffix, message_type, _ in self._messages_of(nothing)
        }
        self._check_at_s = time.monotonic() + _CHECK_S

    def publish(self, update: TrackingResult) -> None:
        """Send what is known of this update.

        Raises:
            MasterLost: the master is gone. Only those who were connected before get the update.
            InputError: a stamp that ROS can't say.
        """
        self._last = update
        meshes = update.estimate is None or self._mesh_rate.due()
        for out in self._messages_of(update, meshes):
            publisher = self._publishers[out.suffix]
            if publisher.get_num_connections():
                raw = publisher.data_class()
                raw._buff = self._messages.to_bytes(out.message)
                publisher.publish(raw)
        self._look_after_registrations()
        if self._lost:
            raise rospy_node.MasterLost(self._lost)

    def close(self) -> None:
        """Say that it is over, so that no estimate stays on a screen, and take the topics back."""
        if not self._publishers:
            return
        last, publishers = self._last, self._publishers
        try:
            if last is not None:
                self.publish(ended(last))
                time.sleep(_FLUSH_S)
        finally:
            self._publishers = {}
            for one in publishers.values():
                one.unregister()

    def _messages_of(self, update: TrackingResult, meshes: bool = True) -> list[Outgoing]:
        return messages_of(update, self._messages, self._parts, meshes, self._cell)

    def _advertise(self, topic: str, message_type: str) -> Any:
        kind = rospy_node.raw_class(
            message_type.replace("/msg/", "/"),
            self._messages.md5(message_type),
            self._messages.definition(message_type),
        )
        return self._node.rospy.Publisher(topic, kind, queue_size=1, tcp_nodelay=True)

    def _look_after_registrations(self) -> None:
        start_s = time.monotonic()
        if start_s < self._check_at_s:
            return
        try:
            self._node.register_again(list(self._publishers.values()))
            self._lost = ""
        except rospy_node.MasterLost as error:
            self._lost = str(error)
        end_s = time.monotonic()
        self._check_at_s = end_s + max(_CHECK_S, (end_s - start_s) / _CHECK_SHARE)
