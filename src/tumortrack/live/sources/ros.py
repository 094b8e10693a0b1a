"""Depth images or clouds of a ROS graph: ROS 2, without ROS or through the user's, and ROS 1."""

from __future__ import annotations

import threading
import time
from typing import Any, ClassVar, Literal

from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame
from tumortrack.live.ros.bus import Bus, Subscriber, Via, check_topic, open_bus
from tumortrack.live.ros.messages import Messages, stamp_of
from tumortrack.live.ros.rospy_node import RospyBus, check_name
from tumortrack.live.ros.sensors import CAMERA_INFO, CLOUD, IMAGE, cloud_of, depth_of, mask_for
from tumortrack.live.values import Observation, SourceConfig, SourceLost

_KINDS = {"image": IMAGE, "cloud": CLOUD}
_LOOK_S = 0.1  # how often the graph is asked for the topic's type, until it is known
# A late frame, or a camera's computer with a wrong time, is no other clock; a bag is older.
_SAME_CLOCK_NS = 24 * 3600 * 1_000_000_000
_ALIVE_S = 1.0  # without a frame for so long: the ROS 1 master is asked


class RosSourceConfig(SourceConfig, frozen=True, kw_only=True):
    """A PointCloud2, or a depth Image with its CameraInfo.

    Attributes:
        topic: of the cloud or the depth image.
        info: of the CameraInfo; empty: ``camera_info`` beside the image's topic.
        mask: of an image that is not 0 where the organ may be; empty: there is none.
        rectified: the depth image is a rectified one, its camera is the CameraInfo's P.
        unit_mm: of one step of a 16-bit depth image.
        clock: whose time the stamps are. host: this machine's, or one kept equal to it; other:
            another (simulated, replayed, of the camera); auto: see the kind.
    """

    target: ClassVar[str] = "topic"

    topic: str
    info: str = ""
    mask: str = ""
    rectified: bool = False
    unit_mm: float = 1.0
    clock: Literal["auto", "host", "other"] = "auto"

    def __post_init__(self) -> None:
        for name in (self.topic, *filter(None, (self.info, self.mask))):
            self._check_name(name)
        if not 0 < self.unit_mm <= 1000:
            kind = self.__struct_config__.tag
            raise InputError(f"{kind}: unit_mm is {self.unit_mm:g}; it must lie in 0..1000 mm.")

    def _check_name(self, name: str) -> None:
        """Raises InputError for what is no topic's name."""


class Ros2SourceConfig(RosSourceConfig, frozen=True, kw_only=True, tag="ros2"):
    """A topic of ROS 2, by its full name.

    Attributes:
        type: which of both; auto: what is published there.
        clock: auto: host if the first frame's stamp is less than a day off. A day, so that a
            stream that lags is recognised as such, and not taken for one with its own clock.
        via: dds: without ROS; rclpy: through the ROS that is sourced; auto: rclpy where there is.
    """

    type: Literal["auto", "image", "cloud"] = "auto"
    via: Via = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.type == "cloud" and (self.info or self.mask):
            raise InputError("ros2: info and mask belong to a depth image, and not to a cloud.")

    def _check_name(self, name: str) -> None:
        check_topic(name, "ros2: the topic")

    def open(self) -> RosSource:
        """Join the graph; the topic may come later."""
        messages = Messages()
        return RosSource(self, open_bus(self.via, messages), messages, _KINDS.get(self.type, ""))


class Ros1SourceConfig(RosSourceConfig, frozen=True, kw_only=True, tag="ros1"):
    """A topic of ROS 1; the master knows its type.

    Attributes:
        clock: auto: other where ``/use_sim_time`` is set, else host.
    """

    def _check_name(self, name: str) -> None:
        check_name(name)

    def open(self) -> Ros1Source:
        """Subscribe.

        Raises:
            SourceLost: no master, or nobody publishes the topic.
            InputError: no rospy; the topic is neither cloud nor image.
        """
        messages = Messages("noetic")
        return Ros1Source(self, RospyBus(messages), messages)


class RosSource:
    """An open subscription, from reliable and best effort publishers alike. The newest frame wins.
    No publisher is no fault: then nothing comes."""

    lossless = False
    _patience_s = 0.0  # after opening: the first CameraInfo and mask may still be on their way

    def __init__(self, config: RosSourceConfig, bus: Bus, messages: Messages, kind: str) -> None:
        self.host_clock = config.clock == "host"
        self._clock_known = config.clock != "auto"
        self._config, self._bus, self._messages = config, bus, messages
        self._name = f"{config.__struct_config__.tag}:{config.topic}"
        self._topic = config.topic
        self._info_topic = config.info or config.topic.rpartition("/")[0] + "/camera_info"
        self._kind = kind  # of message; empty until it is known
        self._frames: Subscriber | None = None
        self._beside: list[tuple[str, Subscriber]] = []
        self._latest: dict[str, Any] = {}  # by type of message: CameraInfo and mask
        self._waiting: bytes | memoryview | None = None  # an image whose CameraInfo is not here yet
        self._passed = 0
        self._opened_s = self._heard_s = time.monotonic()
        self._lock, self._closed = threading.Lock(), False

    @property
    def dropped(self) -> int:
        return self._passed + (self._frames.lost if self._frames else 0)

    def read(self, timeout_s: float) -> Observation | None:
        """See ``Source``."""
        until_s = time.monotonic() + timeout_s
        while True:
            if self._closed:
                raise SourceLost(f"the source {self._name} is closed")
            now_s = time.monotonic()
            left_s = max(0.0, until_s - now_s)
            known = self._frames is not None or self._found(final=not left_s)
            raw = self._newest() if known else None
            impatient = not left_s and now_s - self._opened_s >= self._patience_s
            if raw is not None and (self._complete() or impatient):
                self._waiting = None
                return self._observed(raw, time.time_ns())
            if not left_s:
                self._check_alive()
                return None
            self._bus.wait(left_s if known else min(left_s, _LOOK_S))

    def close(self) -> None:
        """Unsubscribe, and wake whoever reads."""
        with self._lock:
            self._closed = True
            self._bus.close()

    def _check_alive(self) -> None:
        """Raises SourceLost if nothing can come any more."""

    def _found(self, final: bool) -> bool:
        """Subscribe, once the type is known. ``final``: say what is wrong with what is there."""
        with self._lock:
            if self._closed:
                return False
            mask = self._config.mask
            if not self._kind:
                there = self._bus.types_of(self._topic)
                wanted = {IMAGE} if mask else set(_KINDS.values())
                usable = there & wanted
                if len(usable) != 1:
                    if final and there:
                        raise InputError(_unusable(self._topic, there, wanted))
                    return False
                (self._kind,) = usable
            self._subscribe(mask)
        return True

    def _subscribe(self, mask: str) -> None:
        if self._kind == IMAGE:
            # In both ways: some nodes publish it once and keep it for those who come later.
            for latched in (False, True):
                for topic, kind in ((self._info_topic, CAMERA_INFO), (mask, IMAGE)):
                    if topic:
                        subscriber = self._bus.subscriber(topic, kind, 1, latched)
                        self._beside.append((kind, subscriber))
        self._frames = self._bus.subscriber(self._topic, self._kind)

    def _newest(self) -> bytes | memoryview | None:
        assert self._frames is not None
        for kind, subscriber in self._beside:
            for raw in subscriber.take():
                self._latest[kind] = self._messages.from_bytes(raw, kind)
        if came := self._frames.take():
            self._passed += len(came) - 1 + (self._waiting is not None)
            self._waiting = came[-1]
            self._heard_s = time.monotonic()
        return self._waiting

    def _complete(self) -> bool:
        needed = {CAMERA_INFO, IMAGE} if self._config.mask else {CAMERA_INFO}
        return self._kind == CLOUD or needed <= self._latest.keys()

    def _observed(self, raw: bytes | memoryview, arrived_ns: int) -> Observation:
        message = self._messages.from_bytes(raw, self._kind)
        if not self._clock_known:
            self._clock_known = True
            self.host_clock = abs(arrived_ns - stamp_of(message.header)) < _SAME_CLOCK_NS
        if self._kind == CLOUD:
            return Observation(cloud_of(message), arrived_ns)
        info = self._latest.get(CAMERA_INFO)
        if info is None:
            raise InputError(
                f"images come on {self._topic}, but no camera_info on {self._info_topic}. "
                f"Name its topic: {self._name}?info=/.../camera_info."
            )
        frame = depth_of(message, info, self._config.rectified, self._config.unit_mm)
        return Observation(frame, arrived_ns, self._mask_for(frame) if self._config.mask else None)

    def _mask_for(self, frame: DepthFrame) -> Any:
        image = self._latest.get(IMAGE)
        if image is None:
            raise InputError(f"no mask came on {self._config.mask} so far.")
        return mask_for(frame, image, self._config.mask)


class Ros1Source(RosSource):
    """Lost when nothing comes and the master is gone or was restarted. Frames go from node to node:
    without a master they may still come."""

    _patience_s = 1.0

    def __init__(self, config: Ros1SourceConfig, bus: RospyBus, messages: Messages) -> None:
        node = bus.node
        topic = node.resolved(config.topic)
        super().__init__(config, bus, messages, _ros1_type(bus, topic))
        if config.mask and self._kind == CLOUD:
            raise InputError(f"ros1: a mask needs a depth image, and {topic} is a cloud.")
        self._node, self._topic = node, topic
        self._info_topic = config.info or topic.rpartition("/")[0] + "/camera_info"
        if not self._clock_known:
            self._clock_known, self.host_clock = True, not node.master.simulated_time()
        self._found(final=True)

    def _check_alive(self) -> None:
        if time.monotonic() - self._heard_s < _ALIVE_S:
            return
        self._heard_s = time.monotonic()
        if not self._node.listens(self._topic):
            raise SourceLost("the ROS master was started anew; the topic is subscribed to again")


def _ros1_type(bus: RospyBus, topic: str) -> str:
    known = bus.node.master.published_types()
    usable = [name for name, kind in known.items() if kind in _KINDS.values()]
    if topic not in known:
        there = ", ".join(sorted(usable)[:12]) or "none"
        uri = bus.node.master.uri
        raise SourceLost(f"nobody publishes {topic} at {uri}. Clouds and images: {there}")
    if topic not in usable:
        raise InputError(f"{topic} is a {known[topic]}; it must be {CLOUD} or a depth {IMAGE}.")
    return known[topic]


def _unusable(topic: str, there: set[str], wanted: set[str]) -> str:
    return (
        f"{topic} is published as {' and as '.join(sorted(there))}; it must be "
        f"{' or '.join(sorted(wanted))}, and one of them (say which: type=cloud or type=image)."
    )
