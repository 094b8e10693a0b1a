"""Depth images or clouds of a ROS 1 graph, through rospy."""

from __future__ import annotations

import time
from typing import Any, ClassVar, Literal

from tumortrack.core.errors import InputError
from tumortrack.live.ros import incoming, rospy_node
from tumortrack.live.ros.messages import Messages
from tumortrack.live.ros.newest import Newest, Raw
from tumortrack.live.values import Observation, SourceConfig, SourceLost

_BUFFER = 2**21  # bytes taken from the socket at once: a cloud in one go
_ALIVE_S = 1.0  # without a frame for so long: the master is asked
_SOON_S = 1.0  # after opening: the first CameraInfo and mask may still be on their way
_ANY = "*/msg/"  # the type of a topic that so far is only subscribed to


class Ros1SourceConfig(SourceConfig, frozen=True, kw_only=True, tag="ros1"):
    """A PointCloud2, or a depth Image with its CameraInfo; the master says which.

    Attributes:
        topic: of the cloud or the depth image.
        info: of the CameraInfo; empty: ``camera_info`` beside the image's topic.
        mask: of an image that is not 0 where the organ may be; empty: there is none.
        rectified: the depth image is a rectified one, its camera is the CameraInfo's P.
        unit_mm: of one step of a 16-bit depth image.
        clock: whose time the stamps are. host: this machine's, or one kept equal to it; other:
            another (simulated, replayed, of the camera); auto: other where ``/use_sim_time`` is
            set, else host.
    """

    target: ClassVar[str] = "topic"

    topic: str
    info: str = ""
    mask: str = ""
    rectified: bool = False
    unit_mm: float = 1.0
    clock: Literal["auto", "host", "other"] = "auto"

    def __post_init__(self) -> None:
        rospy_node.check_name(self.topic)
        for name in filter(None, (self.info, self.mask)):
            rospy_node.check_name(name)
        if not 0 < self.unit_mm <= 1000:
            raise InputError(f"ros1: unit_mm is {self.unit_mm:g}; it must lie in 0..1000 mm.")

    def open(self) -> Ros1Source:
        """Subscribe.

        Raises:
            SourceLost: no master, or nobody publishes the topic.
            InputError: no rospy; the topic is neither cloud nor image.
        """
        node = rospy_node.node()
        topic = node.resolved(self.topic)
        kind = _kind_of(node.master, topic)
        if self.mask and kind == incoming.CLOUD:
            raise InputError(f"ros1: a mask needs a depth image, and {topic} is a cloud.")
        return Ros1Source(self, node, topic, kind)


class Ros1Source:
    """An open subscription. Each frame is taken as it comes; read or not, the next replaces it."""

    waits = False

    def __init__(
        self, config: Ros1SourceConfig, node: rospy_node.Node, topic: str, kind: str
    ) -> None:
        self.host_clock = config.clock == "host" or (
            config.clock == "auto" and not node.master.simulated_time()
        )
        self._config, self._node, self._topic, self._kind = config, node, topic, kind
        self._messages = Messages("noetic")
        self._frames, self._infos, self._masks = Newest(), Newest(), Newest()
        self._heard_s = self._opened_s = time.monotonic()
        self._info = config.info or topic.rpartition("/")[0] + "/camera_info"
        beside = [name for name in (self._info, config.mask) if name]
        self._subscribers = [
            self._subscribe(node.resolved(name), newest)
            for name, newest in zip(beside, (self._infos, self._masks), strict=False)
            if kind == incoming.IMAGE
        ]
        self._subscribers.append(self._subscribe(topic, self._frames))

    @property
    def dropped(self) -> int:
        return self._frames.replaced

    def read(self, timeout_s: float) -> Observation | None:
        """The newest frame, as ``Source`` says; lost when nothing comes and the master is gone or
        was started anew. Frames go from node to node: with the master gone they may still come.
        """
        until_s = time.monotonic() + timeout_s
        raw = self._frames.take(timeout_s)
        if self._frames.closed:
            raise SourceLost(f"the source ros1:{self._config.topic} is closed")
        if raw is None:
            self._check_alive()
            return None
        self._heard_s = time.monotonic()
        if self._kind == incoming.CLOUD:
            return Observation(incoming.cloud_of(self._parsed(raw, incoming.CLOUD)), raw.arrived_ns)
        info = self._beside(self._infos, self._info, until_s)
        mask = self._beside(self._masks, self._config.mask, until_s)
        if info is None or (mask is None and self._config.mask):
            return None
        frame = incoming.depth_of(
            self._parsed(raw, incoming.IMAGE),
            self._parsed(info, incoming.CAMERA_INFO),
            self._config.rectified,
            self._config.unit_mm,
        )
        if mask is None:
            return Observation(frame, raw.arrived_ns)
        image = self._parsed(mask, incoming.IMAGE)
        return Observation(frame, raw.arrived_ns, incoming.mask_for(frame, image, mask.topic))

    def close(self) -> None:
        """Unsubscribe."""
        for newest in (self._frames, self._infos, self._masks):
            newest.close()
        for one in self._subscribers:
            one.unregister()

    def _subscribe(self, topic: str, newest: Newest) -> Any:
        rospy = self._node.rospy

        def came(message: Any) -> None:
            kind = rospy_node.full_type(message._connection_header["type"])
            newest.put(topic, kind, message._buff)

        return rospy.Subscriber(topic, rospy.AnyMsg, came, buff_size=_BUFFER, tcp_nodelay=True)

    def _parsed(self, raw: Raw, expected: str) -> Any:
        if raw.kind != expected:
            raise InputError(f"on {raw.topic} came a {raw.kind}; it must be {expected}.")
        return self._messages.from_bytes(raw.content, expected)

    def _beside(self, newest: Newest, topic: str, until_s: float) -> Raw | None:
        """What belongs to an image; None without a topic, and right after opening, when the first
        message may still be on its way."""
        if not topic:
            return None
        found = newest.latest(until_s - time.monotonic())
        if found is None and time.monotonic() - self._opened_s > _SOON_S:
            raise InputError(
                f"images come on {self._topic}, but nothing on {topic}. Say where it is: "
                f"ros1:{self._config.topic}?info=/.../camera_info&mask=/..."
            )
        return found

    def _check_alive(self) -> None:
        if time.monotonic() - self._heard_s < _ALIVE_S:
            return
        self._heard_s = time.monotonic()
        if not self._node.listens(self._topic):
            raise SourceLost("the ROS master was started anew; the topic is subscribed to again")


def _kind_of(master: rospy_node.Master, topic: str) -> str:
    published = master.published()
    types = {name: rospy_node.full_type(kind) for name, kind in master.types().items()}
    kind = types.get(topic, _ANY)
    if topic not in published or kind == _ANY:
        usable = {name for name, kind in types.items() if kind in (incoming.CLOUD, incoming.IMAGE)}
        there = ", ".join(sorted(usable & published)[:12]) or "none"
        raise SourceLost(f"nobody publishes {topic} at {master.uri}. Clouds and images: {there}")
    if kind not in (incoming.CLOUD, incoming.IMAGE):
        raise InputError(
            f"{topic} is a {kind}; it must be {incoming.CLOUD} or a depth {incoming.IMAGE}."
        )
    return kind
