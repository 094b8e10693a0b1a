"""A tool in a ROS 2 graph: its frame in tf, and a topic that says when it touches."""

from __future__ import annotations

from typing import ClassVar

from tumortrack.core.geometry import Affine
from tumortrack.live.values import SinkContext
from tumortrack_devices.ros.bus import Via, check_topic, open_bus
from tumortrack_devices.ros.tf import TfPoses
from tumortrack_devices.tools.tip import TipConfig, TipTool

_BOOL = "std_msgs/msg/Bool"
_MOST = 100  # messages between two frames


class Ros2ToolConfig(TipConfig, frozen=True, kw_only=True, tag="ros2"):
    """``frame``: the tool's in tf. ``contact``: a topic (std_msgs/Bool), true while the tip
    touches; empty: there is none."""

    target: ClassVar[str] = "frame"

    frame: str
    contact: str = ""
    via: Via = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.contact:
            check_topic("contact", self.contact)

    def open(self, context: SinkContext, name: str) -> Ros2Tool:
        return Ros2Tool(self, context, name)


class Ros2Tool(TipTool):
    """A contact has no stamp: it counts from the frame before which it came."""

    def __init__(self, config: Ros2ToolConfig, context: SinkContext, name: str) -> None:
        super().__init__(config, context, name, "")
        self._frame, self._bus = config.frame.removeprefix("/"), open_bus(config.via)
        self._poses = TfPoses(self._bus, context.published_frame.frame_id, "")
        self._said = self._bus.subscriber(config.contact, _BOOL, _MOST) if config.contact else None

    def refresh(self, stamp_ns: int) -> None:
        self._poses.take()
        for raw in () if self._said is None else self._said.take():
            self.contact(stamp_ns, bool(self._bus.messages.from_bytes(raw, _BOOL).data))

    def pose(self, stamp_ns: int) -> Affine:
        return self._poses.fixed_from(self._frame, stamp_ns)

    def close(self) -> None:
        self._poses.close()
