"""Depth images or clouds from a ROS 2 graph."""

from __future__ import annotations

import threading
import time
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame
from tumortrack.live.values import Observation, SourceConfig, SourceLost
from tumortrack_devices.ros import sensors
from tumortrack_devices.ros.bus import Bus, Subscriber, Via, check_topic, open_bus
from tumortrack_devices.ros.messages import stamp_of

_KINDS = {"image": sensors.IMAGE, "packed": sensors.COMPRESSED, "cloud": sensors.CLOUD}
_PACKED = "/compressedDepth"  # image_transport appends it to the image's topic
_PICTURE_S = 0.03  # how much later than its depth image a picture may come: a frame at 30 Hz
_ALONE_S = 2.0  # for the publisher of a topic to be discovered
_LOOK_S = 0.1  # how often the graph is asked for the topic's type, until it is known
# A late frame, or a camera's computer with a wrong time, is no other clock; a bag is older.
_SAME_CLOCK_NS = 24 * 3600 * 1_000_000_000
_MASK_APART_NS = 500_000_000  # a mask of another time than this shows another place


class Ros2SourceConfig(SourceConfig, frozen=True, kw_only=True, tag="ros2"):
    """A topic of ROS 2, by its full name: a PointCloud2, or a depth Image with its CameraInfo;
    docs/ros.md has the options.

    ``clock`` of the stamps: host, this machine's or one synchronised with it; other (simulated,
    replayed, of the camera); auto: host if the first frame's stamp is less than a day off. A day,
    so that a stream that lags is not taken for one with its own clock.
    """

    target: ClassVar[str] = "topic"

    topic: str
    info: str = ""
    mask: str = ""
    picture: str = ""
    rectified: bool = False
    unit_mm: float = 1.0
    clock: Literal["auto", "host", "other"] = "auto"
    type: Literal["auto", "image", "packed", "cloud"] = "auto"
    via: Via = "auto"

    def __post_init__(self) -> None:
        for name in (self.topic, *filter(None, (self.info, self.mask, self.picture))):
            check_topic("topic", name)
        if not 0 < self.unit_mm <= 1000:
            raise InputError(f"ros2: unit_mm is {self.unit_mm:g}; it must lie in 0..1000 mm.")
        if self.type == "cloud" and (self.info or self.mask or self.picture):
            raise InputError("ros2: info, mask and picture belong to a depth image, not a cloud.")

    def open(self) -> RosSource:
        return RosSource(self, open_bus(self.via))


class RosSource:
    """An open subscription, to reliable and best effort publishers alike. The newest frame wins.
    Without a publisher for 2 s, ``read`` raises InputError."""

    lossless = on_demand = False

    def __init__(self, config: Ros2SourceConfig, bus: Bus) -> None:
        self._clock: str = config.clock  # or "known"
        self.host_clock = config.clock == "host"
        self._config, self._bus = config, bus
        self._kind = _KINDS.get(config.type, "")  # of message; empty: as published
        self._topic, self._name = config.topic, f"ros2:{config.topic}"
        namespace = config.topic.removesuffix(_PACKED).rpartition("/")[0]
        self._info_topic = config.info or f"{namespace}/camera_info"
        self._frames: Subscriber | None = None
        self._companions: list[tuple[str, str, Subscriber]] = []
        self._latest: dict[str, Any] = {}  # by topic: CameraInfo, mask and picture
        self._waiting: bytes | memoryview | None = None  # an image without its CameraInfo
        self._passed = 0
        self._opened_s = time.monotonic()
        self._lock, self._closed = threading.Lock(), False

    @property
    def dropped(self) -> int:
        return self._passed + (self._frames.lost if self._frames else 0)

    def read(self, timeout_s: float) -> Observation | None:
        until_s = time.monotonic() + timeout_s
        while True:
            if self._closed:
                raise SourceLost(f"the source {self._name} is closed")
            left_s = max(0.0, until_s - time.monotonic())
            known = self._frames is not None or self._subscribed(final=not left_s)
            raw = self._newest() if known else None
            complete = {topic for topic, *_ in self._companions} <= self._latest.keys()
            if raw is not None and (complete or not left_s):
                self._waiting = None
                return self._observed(raw, time.time_ns())
            if not left_s:
                return None
            self._bus.wait(left_s if known else min(left_s, _LOOK_S))

    def close(self) -> None:
        with self._lock:
            self._closed = True
            self._bus.close()

    def _subscribed(self, final: bool) -> bool:
        """Subscribe, once the type is known. ``final``: raise InputError if it is not usable."""
        mask, picture = self._config.mask, self._config.picture
        with self._lock:
            if self._closed:
                return False
            if not self._kind:
                published = self._bus.topics().get(self._topic, set())
                wanted = set(_KINDS.values()) - ({sensors.CLOUD} if mask or picture else set())
                usable = published & wanted
                if len(usable) != 1 and final and published:
                    raise InputError(
                        f"{self._topic} is published as {' and as '.join(sorted(published))}; it "
                        f"must be {' or '.join(sorted(wanted))}, and one of them (say which: "
                        "type=cloud, image or packed)."
                    )
                if final and not published and time.monotonic() - self._opened_s > _ALONE_S:
                    raise InputError(self._alone())
                if len(usable) != 1:
                    return False
                (self._kind,) = usable
            companions = {self._info_topic: sensors.CAMERA_INFO}
            companions |= dict.fromkeys(filter(None, (mask, picture)), sensors.IMAGE)
            # Volatile and latched: some nodes publish once and keep it for later subscribers.
            self._companions = [
                (topic, kind, self._bus.subscriber(topic, kind, 1, latched))
                for latched in (False, True)
                for topic, kind in ({} if self._kind == sensors.CLOUD else companions).items()
            ]
            self._frames = self._bus.subscriber(self._topic, self._kind)
        return True

    def _alone(self) -> str:
        topics = self._bus.topics().items()
        usable = sorted(topic for topic, kinds in topics if kinds & set(_KINDS.values()))
        others = f"images and clouds seen: {', '.join(usable)}"
        return (
            f"nobody publishes {self._topic}; {others if usable else 'nor any image or cloud'}. "
            "Look at the topic's name, at ROS_DOMAIN_ID and at the network."
        )

    def _newest(self) -> bytes | memoryview | None:
        assert self._frames is not None
        self._take_companions()
        if images := self._frames.take():
            self._passed += len(images) - 1 + (self._waiting is not None)
            self._waiting = images[-1]
        return self._waiting

    def _take_companions(self) -> None:
        for topic, kind, subscriber in self._companions:
            for raw in subscriber.take():
                self._latest[topic] = self._bus.messages.from_bytes(raw, kind)

    def _observed(self, raw: bytes | memoryview, arrived_ns: int) -> Observation:
        message = self._bus.messages.from_bytes(raw, self._kind)
        if self._kind == sensors.COMPRESSED:
            message = sensors.image_of(message, self._bus.messages)
        if self._clock == "auto":
            self._clock = "known"
            self.host_clock = abs(arrived_ns - stamp_of(message.header)) < _SAME_CLOCK_NS
        frame_id = sensors.frame_of(message)
        if self._kind == sensors.CLOUD:
            return Observation(sensors.cloud_of(message), arrived_ns, frame_id=frame_id)
        info = self._latest.get(self._info_topic)
        if info is None:
            raise InputError(
                f"images come on {self._topic}, but no camera_info on {self._info_topic}. "
                f"Name its topic: {self._name}?info=/.../camera_info."
            )
        frame = sensors.depth_of(message, info, self._config.rectified, self._config.unit_mm)
        mask = self._mask_for(frame) if self._config.mask else None
        picture = self._picture_for(frame) if self._config.picture else None
        return Observation(frame, arrived_ns, mask, None, frame_id, picture)

    def _picture_for(self, frame: DepthFrame) -> UInt8[np.ndarray, "h w *rgb"] | None:
        """The picture with the frame's stamp, which may come a little later."""
        topic, until_s = self._config.picture, time.monotonic() + _PICTURE_S
        while (image := self._latest.get(topic)) is None or (
            stamp_of(image.header) < frame.stamp_ns
        ):
            if (left_s := until_s - time.monotonic()) <= 0 or self._closed:
                break
            self._bus.wait(left_s)
            self._take_companions()
        return image and sensors.picture_of(image, frame)

    def _mask_for(self, frame: DepthFrame) -> Bool[np.ndarray, "h w"]:
        """The newest mask, checked against the frame."""
        topic, camera = self._config.mask, frame.intrinsics
        image = self._latest.get(topic)
        if image is None:
            raise InputError(f"no mask came on {topic} so far.")
        mask, older_ns = sensors.mask_of(image), frame.stamp_ns - stamp_of(image.header)
        if mask.shape != frame.depth_mm.shape:
            raise InputError(
                f"a mask of {mask.shape[1]} x {mask.shape[0]} pixels came for depth images of "
                f"{camera.width} x {camera.height}; they must be of one size."
            )
        if abs(older_ns) > _MASK_APART_NS:
            raise InputError(
                f"the newest mask on {topic} is {abs(older_ns) * 1e-9:.2f} s "
                f"{'older' if older_ns > 0 else 'newer'} than the frame; allowed: "
                f"{_MASK_APART_NS * 1e-9:g} s."
            )
        return mask
