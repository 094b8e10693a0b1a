"""Results published in a ROS 2 graph, without ROS or through the user's."""

from __future__ import annotations

import time
from typing import ClassVar

from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import Affine
from tumortrack.live.ros.bus import Bus, Publisher, check_topic
from tumortrack.live.ros.results import ResultMessages
from tumortrack.live.ros.ros2 import Via, open_bus
from tumortrack.live.ros.sensors import CAMERA_FRAME
from tumortrack.live.ros.tf import TRANSFORMS, transform_fields
from tumortrack.live.values import CameraView, SinkConfig, SinkContext, TrackingResult

_FLUSH_S = 0.2  # what was published last leaves within that time


class Ros2SinkConfig(SinkConfig, frozen=True, kw_only=True, tag="ros2"):
    """Topics under ``namespace``: see ``live.ros.results``. ``mesh_hz``: surfaces, and arms'
    markers, at most so often; 0: with every result. ``camera_tf``: also say, on /tf_static, where
    cameras that stand still are; not where somebody else says it of the same frames."""

    target: ClassVar[str] = "namespace"

    namespace: str = "/tumortrack"
    mesh_hz: float = 10.0
    camera_tf: bool = False
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
        namespace = config.namespace
        self._results = ResultMessages(bus.messages, context, config.mesh_hz, True, namespace)
        self._last: TrackingResult | None = None
        self._cameras: dict[str, Affine] = {}  # that /tf_static has
        self._static: Publisher | None = None
        if config.camera_tf and not context.published_frame.moves:
            self._static = bus.publisher("/tf_static", TRANSFORMS, latched=True)
        nothing = TrackingResult(sequence=0, stamp_ns=0, published_frame=context.published_frame)
        self._publishers = {
            one.suffix: bus.publisher(one.topic(namespace), one.message_type)
            for one in self._results.of(nothing)
        }

    def publish(self, result: TrackingResult) -> None:
        """Send it on every topic, on the others too where one fails."""
        self._last = result
        self._say_cameras(result)
        failed: list[str] = []
        for suffix, _, message in self._results.of(result):
            publisher = self._publishers[suffix]
            try:
                publisher.publish(self._bus.messages.to_bytes(message))
            except TumortrackError as error:
                failed.append(str(error))
        if failed:
            raise TumortrackError(" ".join(failed))

    def _say_cameras(self, result: TrackingResult) -> None:
        """Where they are, all in one message that is kept, once another one is known."""
        if self._static is None or result.observation is None:
            return
        frame, messages = result.published_frame, self._bus.messages
        alone = CameraView(1, result.observation, frame.published_from_camera)
        cameras = {
            view.seen.frame_id or CAMERA_FRAME: view.published_from_camera
            for view in result.views or (alone,)
        }
        cameras.pop(frame.frame_id, None)
        if cameras.keys() <= self._cameras.keys():
            return
        self._cameras |= cameras
        said = [
            transform_fields(messages, result.stamp_ns, frame.frame_id, name, place)
            for name, place in self._cameras.items()
        ]
        message = messages.make(TRANSFORMS, transforms=said)
        self._static.publish(messages.to_bytes(message))

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
