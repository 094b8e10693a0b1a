"""An arm whose ROS 2 topics have the names of CRTK, the Collaborative Robotics Toolkit, such as a
dVRK's: https://crtk-robotics.readthedocs.io."""

from __future__ import annotations

import math
import time
from typing import Any, ClassVar, Literal

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine
from tumortrack.live.poses import PoseBuffer
from tumortrack.live.values import SinkContext
from tumortrack_devices.ros.bus import Via, check_topic, open_bus
from tumortrack_devices.ros.crtk import POSE
from tumortrack_devices.ros.messages import stamp_of
from tumortrack_devices.ros.results import JOINTS
from tumortrack_devices.ros.sensors import frame_of
from tumortrack_devices.ros.tf import pose_from
from tumortrack_devices.tools.tip import TipConfig, TipTool

_PEDAL = "sensor_msgs/msg/Joy"  # a dVRK's: 1 pressed, 0 released, 2 a tap that has ended
_MOST = 1000  # messages between two frames: 30 Hz beside an arm of 1 kHz, and a few lost frames
_SILENT_S = 5.0  # without a pose before it is said
_WIDER_DEG = 5.0  # than it closed at: then it is open


class CrtkToolConfig(TipConfig, frozen=True, kw_only=True, tag="crtk"):
    """The arm of ``namespace``. It only reads.

    Attributes:
        pose: its topic below the namespace (PoseStamped): measured_cp, setpoint_cp, or
            local/measured_cp, which a dVRK gives in the arm's own base whatever base frame is set.
        jaw: its jaw's (JointState); empty: there is none, and touches are clicked.
        pedal: topic of what energises it (Joy, its first button), such as a dVRK's
            /footpedals/coag; needed with ``electrode_mm``, whose jaw says nothing then.
        closed_deg: it touches, or with ``holds`` grips, from when the jaw closes to this angle
            until it is 5 degrees wider. One that has not been seen open does neither.
    """

    target: ClassVar[str] = "namespace"

    namespace: str
    pose: Literal["measured_cp", "local/measured_cp", "setpoint_cp"] = "measured_cp"
    jaw: str = "jaw/measured_js"
    pedal: str = ""
    closed_deg: float = 10.0
    via: Via = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_topic("pose", f"{self.namespace}/{self.pose}")
        if self.jaw:
            check_topic("jaw", f"{self.namespace}/{self.jaw}")
        if self.pedal:
            check_topic("pedal", self.pedal)
        if bool(self.pedal) is not (self.electrode_mm > 0):
            raise InputError("crtk: a cutter needs both electrode_mm= and pedal=TOPIC.")
        self.check_between("crtk:", closed_deg=(0, 90))

    def open(self, context: SinkContext, name: str) -> CrtkTool:
        return CrtkTool(self, context, name)


class CrtkTool(TipTool):
    """A message whose stamp is 0 is invalid by CRTK, and ignored."""

    def __init__(self, config: CrtkToolConfig, context: SinkContext, name: str) -> None:
        super().__init__(config, context, name, "")
        self._topic, self._closed_deg = f"{config.namespace}/{config.pose}", config.closed_deg
        self._bus, self._poses = open_bus(config.via), PoseBuffer()
        self._placed = self._bus.subscriber(self._topic, POSE, _MOST)
        jaw = f"{config.namespace}/{config.jaw}"
        grips = config.jaw and not config.pedal
        self._jaw = self._bus.subscriber(jaw, JOINTS, _MOST) if grips else None
        pedal = config.pedal
        self._pedal = self._bus.subscriber(pedal, _PEDAL, _MOST) if pedal else None
        self._open, self._closed = False, False  # as seen of the jaw
        self._heard_s = time.monotonic()

    def refresh(self, stamp_ns: int) -> None:
        read = self._bus.messages.from_bytes
        for raw in self._placed.take():
            self._move(read(raw, POSE))
        for raw in () if self._jaw is None else self._jaw.take():
            self._turn(read(raw, JOINTS))
        for raw in () if self._pedal is None else self._pedal.take():
            said = read(raw, _PEDAL)
            self.contact(stamp_of(said.header) or stamp_ns, said.buttons[:1].tolist() == [1])
        if time.monotonic() - self._heard_s > _SILENT_S:
            self.trouble = f"no valid pose (geometry_msgs/PoseStamped) comes on {self._topic}"

    def pose(self, stamp_ns: int) -> Affine:
        return self._poses.at(stamp_ns)

    def close(self) -> None:
        self._bus.close()

    def _move(self, message: Any) -> None:
        pose = pose_from(message.pose.position, message.pose.orientation)
        if pose is not None and (stamp_ns := stamp_of(message.header)):
            self.check_frame(frame_of(message))
            self._poses.add(stamp_ns, pose)
            self._heard_s = time.monotonic()

    def _turn(self, message: Any) -> None:
        stamp_ns, angles_rad = stamp_of(message.header), message.position
        if not stamp_ns or not len(angles_rad) or not math.isfinite(angles_rad[0]):
            return
        limit_deg = self._closed_deg + (_WIDER_DEG if self._closed else 0.0)
        closed = math.degrees(angles_rad[0]) <= limit_deg
        self._open |= not closed
        self._closed = closed and self._open
        self.contact(stamp_ns, self._closed)
