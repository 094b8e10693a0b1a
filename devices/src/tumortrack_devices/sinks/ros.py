"""Results published in a ROS 2 graph, without ROS or through the user's."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.geometry import Affine, transform_points
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult
from tumortrack_devices.ros.bus import Bus, Publish, Via, check_topic, open_bus
from tumortrack_devices.ros.messages import MM_PER_M
from tumortrack_devices.ros.results import LATCHED, PLACE, ResultMessages
from tumortrack_devices.ros.sensors import CAMERA_FRAME
from tumortrack_devices.ros.tf import TRANSFORMS, transform_fields

_FLUSH_S = 0.2  # for the last messages to leave
# What a user asks for, by topic under the namespace; ``halt`` where arms are controlled
_EMPTY = "std_msgs/msg/Empty"
ACKNOWLEDGE, HALT, POINT_AT = ("acknowledge", _EMPTY), ("halt", _EMPTY), ("point_at", PLACE)
_FARTHEST_M = 10.0  # of a place that is pointed at: no camera here sees so far
ASKED = dict((ACKNOWLEDGE, ("cut", _EMPTY), ("forget", _EMPTY), HALT, POINT_AT))


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
    whenever there is no estimate, all topics say so. What is asked for on the topics ``ASKED`` goes
    to the loop's controls with the next result."""

    def __init__(self, config: Ros2SinkConfig, context: SinkContext, bus: Bus) -> None:
        self._bus, self.notes = bus, (bus.note,)
        options = config.mesh_hz, True, config.namespace
        self._results = ResultMessages(bus.messages, context, *options)
        self._last: TrackingResult | None = None
        self._cameras: dict[str, Affine] = {}  # those on /tf_static
        self._static: Publish | None = None
        if config.camera_tf and not context.published_frame.moves:
            self._static = bus.publisher("/tf_static", TRANSFORMS, latched=True)
        self._controls, arms = context.controls, context.controller is not None
        self._asked = {
            name: bus.subscriber(f"{config.namespace}/{name}", kind)
            for name, kind in ASKED.items()
            if arms or name != "halt"
        }
        nothing = TrackingResult(sequence=0, stamp_ns=0, published_frame=context.published_frame)
        self._publishers = {
            out.suffix: bus.publisher(
                out.topic(config.namespace), out.message_type, out.suffix in LATCHED
            )
            for out in self._results.messages(nothing)
        }

    def publish(self, result: TrackingResult) -> None:
        """Do what was asked for, and send the result. Raises TumortrackError: a message was not
        sent; InputError: what was asked for cannot be done."""
        self._last = result
        try:
            self._obey(result)
        finally:
            self._send(result)

    def _send(self, result: TrackingResult) -> None:
        """On every topic, also on the others if one fails."""
        self._publish_cameras(result)
        failed: list[str] = []
        for suffix, _, message in self._results.messages(result):
            try:
                self._publishers[suffix](self._bus.messages.to_bytes(message))
            except TumortrackError as error:
                failed.append(str(error))
        if failed:
            raise TumortrackError(" ".join(failed))

    def _obey(self, result: TrackingResult) -> None:
        """Raises InputError: where the organ is said to be is no place."""
        self._bus.wait(0.0)
        asked = {name: subscriber.take() for name, subscriber in self._asked.items()}
        if asked["acknowledge"]:
            self._controls.acknowledged.set()
        if asked["cut"]:
            self._controls.cut.set()
        if asked.get("halt"):
            self._controls.aborted.set()
        if asked["forget"]:
            self._controls.forget()
        for raw in asked["point_at"][-1:]:
            said = self._bus.messages.from_bytes(raw, PLACE)
            place = np.array([said.point.x, said.point.y, said.point.z])
            self._controls.picked_mm = place_of(place, said.header.frame_id, result)

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
                self._send(TrackingResult(number, stamp_ns, reason=reason, published_frame=frame))
                self._bus.flush(_FLUSH_S)
        finally:
            self._bus.close()


def place_of(
    place: Float64[np.ndarray, " 3"], frame_id: str, result: TrackingResult
) -> Float64[np.ndarray, " 3"]:
    """A place on the organ in the published frame, mm. ``place``: in that frame or in the camera's,
    m. Raises InputError."""
    seen, published = result.observation, result.published_frame
    camera = (None if seen is None else seen.frame_id) or CAMERA_FRAME
    known, named = dict.fromkeys((published.frame_id, camera)), frame_id.removeprefix("/")
    if named not in known or not (np.abs(place) < _FARTHEST_M).all():
        raise InputError(
            f"point_at: {place.tolist()} in {frame_id!r} is no place; allowed are metres, below "
            f"{_FARTHEST_M:g}, in {' or '.join(known)}."
        )
    if named != camera:
        return place * MM_PER_M
    return transform_points(published.published_from_camera, place[None] * MM_PER_M)[0]
