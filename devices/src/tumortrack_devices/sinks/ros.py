"""Results published in a ROS 2 graph, without ROS or through the user's."""

from __future__ import annotations

from typing import ClassVar

from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import Affine
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult
from tumortrack_devices.ros.bus import Bus, Publish, Via, check_topic, open_bus
from tumortrack_devices.ros.results import LATCHED, ResultMessages
from tumortrack_devices.ros.sensors import CAMERA_FRAME
from tumortrack_devices.ros.tf import TRANSFORMS, transform_fields

_FLUSH_S = 0.2  # for the last messages to leave
ACKNOWLEDGE = "acknowledge", "std_msgs/msg/Empty"


class Ros2SinkConfig(SinkConfig, frozen=True, kw_only=True, tag="ros2"):
    """Topics under ``namespace``: see ``ros.results``. ``mesh_hz``: limit for surfaces and the
    arms' markers; 0: with every result. ``camera_tf``: also publish the poses of fixed cameras on
    /tf_static; not if another node publishes these frames."""

    target: ClassVar[str] = "namespace"

    namespace: str = "/tumortrack"
    mesh_hz: float = 10.0
    camera_tf: bool = False
    via: Via = "auto"

    def __post_init__(self) -> None:
        check_topic("namespace", self.namespace)
        self.check_between("ros2:", mesh_hz=(0, 1000))

    def open(self, context: SinkContext) -> RosSink:
        return RosSink(self, context, open_bus(self.via))


class RosSink:
    """Subscribers get the newest result; slow ones miss some and delay nobody. At the end, and
    whenever there is no estimate, all topics say so. A message on ``ACKNOWLEDGE`` says that the
    user has seen what contradicts the answer."""

    def __init__(self, config: Ros2SinkConfig, context: SinkContext, bus: Bus) -> None:
        self._bus, self.notes = bus, (bus.note,)
        options = config.mesh_hz, True, config.namespace
        self._results = ResultMessages(bus.messages, context, *options)
        self._last: TrackingResult | None = None
        self._cameras: dict[str, Affine] = {}  # those on /tf_static
        self._static: Publish | None = None
        if config.camera_tf and not context.published_frame.moves:
            self._static = bus.publisher("/tf_static", TRANSFORMS, latched=True)
        topic, kind = ACKNOWLEDGE
        self._seen = bus.subscriber(f"{config.namespace}/{topic}", kind)
        self._acknowledged = context.controls.acknowledged
        nothing = TrackingResult(sequence=0, stamp_ns=0, published_frame=context.published_frame)
        self._publishers = {
            out.suffix: bus.publisher(
                out.topic(config.namespace), out.message_type, out.suffix == LATCHED
            )
            for out in self._results.messages(nothing)
        }

    def publish(self, result: TrackingResult) -> None:
        """Send it on every topic, also on the others if one fails."""
        self._last = result
        self._bus.wait(0.0)
        if self._seen.take():
            self._acknowledged.set()
        self._publish_cameras(result)
        failed: list[str] = []
        for suffix, _, message in self._results.messages(result):
            try:
                self._publishers[suffix](self._bus.messages.to_bytes(message))
            except TumortrackError as error:
                failed.append(str(error))
        if failed:
            raise TumortrackError(" ".join(failed))

    def _publish_cameras(self, result: TrackingResult) -> None:
        """All known poses in one latched message, whenever there is another camera."""
        if self._static is None or result.observation is None:
            return
        parent, messages = result.published_frame.frame_id, self._bus.messages
        cameras = {
            view.seen.frame_id or CAMERA_FRAME: view.published_from_camera
            for view in result.camera_views
        }
        cameras.pop(parent, None)
        if cameras.keys() <= self._cameras.keys():
            return
        self._cameras |= cameras
        transforms = [
            transform_fields(messages, result.stamp_ns, parent, name, pose)
            for name, pose in self._cameras.items()
        ]
        message = messages.make(TRANSFORMS, transforms=transforms)
        self._static(messages.to_bytes(message))

    def close(self) -> None:
        """Publish that tracking has ended, so that no estimate stays on a screen, and leave."""
        last, self._last = self._last, None
        try:
            if last is not None:
                frame, reason = last.published_frame, "tracking has ended"
                number, stamp_ns = last.sequence + 1, last.stamp_ns + 1
                self.publish(TrackingResult(number, stamp_ns, reason=reason, published_frame=frame))
                self._last = None
                self._bus.flush(_FLUSH_S)
        finally:
            self._bus.close()
