"""Depth images or clouds of a ROS 2 graph, without ROS or through the user's."""

from __future__ import annotations

import threading
import time
from typing import Any, ClassVar, Literal

from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame
from tumortrack.live.ros import incoming
from tumortrack.live.ros.bus import Bus, Subscriber, Via, check_topic, open_bus
from tumortrack.live.ros.messages import Messages, stamp_of
from tumortrack.live.values import Observation, SourceConfig, SourceLost

_KINDS = {"image": incoming.IMAGE, "cloud": incoming.CLOUD}
_LOOK_S = 0.1  # how often the graph is asked for the topic's type, until it is known
# A late frame, or a camera's computer with a wrong time, is no other clock; a bag is older.
_SAME_CLOCK_NS = 24 * 3600 * 1_000_000_000


class Ros2SourceConfig(SourceConfig, frozen=True, kw_only=True, tag="ros2"):
    """A PointCloud2, or a depth Image with its CameraInfo.

    Attributes:
        topic: of the cloud or the depth image, in full.
        type: which of both; auto: what is published there.
        info: of the CameraInfo; empty: ``camera_info`` beside the image's topic.
        mask: of an image that is not 0 where the organ may be; empty: there is none.
        rectified: the depth image is a rectified one, its camera is the CameraInfo's P.
        unit_mm: of one step of a 16-bit depth image.
        clock: whose time the stamps are. host: this machine's, or one kept equal to it; other:
            another (simulated, replayed, of the camera); auto: host if the first frame's stamp is
            less than a day off. A day, so that a stream that lags is taken for what it is,
            and not for one with a clock of its own.
        via: dds: without ROS; rclpy: through the ROS that is sourced; auto: rclpy where there is.
    """

    target: ClassVar[str] = "topic"

    topic: str
    type: Literal["auto", "image", "cloud"] = "auto"
    info: str = ""
    mask: str = ""
    rectified: bool = False
    unit_mm: float = 1.0
    clock: Literal["auto", "host", "other"] = "auto"
    via: Via = "auto"

    def __post_init__(self) -> None:
        check_topic(self.topic, "ros2: the topic")
        for name in filter(None, (self.info, self.mask)):
            check_topic(name, "ros2: the topic")
        if self.type == "cloud" and (self.info or self.mask):
            raise InputError("ros2: info and mask belong to a depth image, and not to a cloud.")
        if not 0 < self.unit_mm <= 1000:
            raise InputError(f"ros2: unit_mm is {self.unit_mm:g}; it must lie in 0..1000 mm.")

    def open(self) -> Ros2Source:
        """Join the graph; the topic may come later.

        Raises:
            InputError: the way is not there (``bus.open_bus``).
        """
        messages = Messages()
        return Ros2Source(self, open_bus(self.via, messages), messages)


class Ros2Source:
    """An open subscription, from reliable and best effort publishers alike. The newest frame wins;
    nobody publishing is no fault: nothing comes then."""

    waits = False

    def __init__(self, config: Ros2SourceConfig, bus: Bus, messages: Messages) -> None:
        self.host_clock = config.clock == "host"
        self._clock_known = config.clock != "auto"
        self._config, self._bus, self._messages = config, bus, messages
        self._info_topic = config.info or config.topic.rpartition("/")[0] + "/camera_info"
        self._kind = _KINDS.get(config.type, "")
        self._frames: Subscriber | None = None
        self._side: list[tuple[str, Subscriber]] = []
        self._latest: dict[str, Any] = {}  # by topic: CameraInfo and mask
        self._waiting: bytes | memoryview | None = None  # an image whose CameraInfo is not here yet
        self._passed = 0
        self._lock, self._closed = threading.Lock(), False

    @property
    def dropped(self) -> int:
        return self._passed + (self._frames.lost if self._frames else 0)

    def read(self, timeout_s: float) -> Observation | None:
        """As ``Source`` says."""
        until_s = time.monotonic() + timeout_s
        while True:
            if self._closed:
                raise SourceLost(f"ros2: the source {self._config.topic} is closed")
            left_s = max(0.0, until_s - time.monotonic())
            known = self._frames is not None or self._found(final=not left_s)
            raw = self._newest() if known else None
            if raw is not None and (self._ready() or not left_s):
                self._waiting = None
                return self._seen(raw, time.time_ns())
            if not left_s:
                return None
            self._bus.wait(left_s if known else min(left_s, _LOOK_S))

    def close(self) -> None:
        """Unsubscribe; whoever reads is woken."""
        with self._lock:
            self._closed = True
            self._bus.close()

    def _found(self, final: bool) -> bool:
        """Listen, once it is known to what. ``final``: say what is wrong with what is there."""
        with self._lock:
            return not self._closed and self._subscribe(final)

    def _subscribe(self, final: bool) -> bool:
        topic, mask = self._config.topic, self._config.mask
        if not self._kind:
            there = self._bus.types_of(topic)
            wanted = {incoming.IMAGE} if mask else set(_KINDS.values())
            usable = there & wanted
            if len(usable) != 1:
                if final and there:
                    raise InputError(_unusable(topic, there, wanted))
                return False
            (self._kind,) = usable
        if self._kind == incoming.IMAGE:
            # Heard in both ways: some nodes publish it once and keep it for who comes later.
            for latched in (False, True):
                self._listen_beside(self._info_topic, incoming.CAMERA_INFO, latched)
                if mask:
                    self._listen_beside(mask, incoming.IMAGE, latched)
        self._frames = self._bus.subscriber(self._config.topic, self._kind)
        return True

    def _listen_beside(self, topic: str, kind: str, latched: bool) -> None:
        self._side.append((kind, self._bus.subscriber(topic, kind, 1, latched)))

    def _newest(self) -> bytes | memoryview | None:
        assert self._frames is not None
        for kind, subscriber in self._side:
            for raw in subscriber.take():
                self._latest[kind] = self._messages.from_bytes(raw, kind)
        came = self._frames.take()
        if came:
            self._passed += len(came) - 1 + (self._waiting is not None)
            self._waiting = came[-1]
        return self._waiting

    def _ready(self) -> bool:
        return self._kind == incoming.CLOUD or incoming.CAMERA_INFO in self._latest

    def _seen(self, raw: bytes | memoryview, arrived_ns: int) -> Observation:
        message = self._messages.from_bytes(raw, self._kind)
        if not self._clock_known:
            self._clock_known = True
            self.host_clock = abs(arrived_ns - stamp_of(message.header)) < _SAME_CLOCK_NS
        if self._kind == incoming.CLOUD:
            return Observation(incoming.cloud_of(message), arrived_ns)
        info = self._latest.get(incoming.CAMERA_INFO)
        if info is None:
            raise InputError(
                f"images come on {self._config.topic}, but no camera_info on {self._info_topic}. "
                f"Name its topic: ros2:{self._config.topic}?info=/.../camera_info."
            )
        frame = incoming.depth_of(message, info, self._config.rectified, self._config.unit_mm)
        return Observation(frame, arrived_ns, self._mask_for(frame) if self._config.mask else None)

    def _mask_for(self, frame: DepthFrame) -> Any:
        image = self._latest.get(incoming.IMAGE)
        if image is None:
            raise InputError(f"no mask came on {self._config.mask} so far.")
        return incoming.mask_for(frame, image, self._config.mask)


def _unusable(topic: str, there: set[str], wanted: set[str]) -> str:
    return (
        f"{topic} is published as {' and as '.join(sorted(there))}; it must be "
        f"{' or '.join(sorted(wanted))}, and one of them (say which: type=cloud or type=image)."
    )
