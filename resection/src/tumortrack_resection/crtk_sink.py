"""Where an instrument's tip is to be, for an arm in a simulator that speaks CRTK:
``crtk:/PSM1?arm=cutter&simulator=true``. Real arms go by ``ur_sink``, which watches them."""

from __future__ import annotations

from collections import Counter
from typing import ClassVar, Literal

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult
from tumortrack_devices.display import wxyz_of
from tumortrack_devices.ros.bus import Via, check_topic, open_bus
from tumortrack_devices.ros.crtk import POSE, pose_fields
from tumortrack_resection.workcell import Workcell

_FLUSH_S = 5.0  # at most, for a busy simulator to take where the arm ends


class CrtkSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="crtk"):
    """``servo_cp`` (PoseStamped) below ``namespace``: the tip's frame, which points along its x,
    in the plan's frame, m.

    Attributes:
        arm: whose tip it is.
        simulator: true: who listens is a simulator; send. false: only count what would be sent.
    """

    target: ClassVar[str] = "namespace"

    namespace: str
    arm: Literal["cutter", "holder"] = "cutter"
    simulator: bool = False
    via: Via = "auto"

    def __post_init__(self) -> None:
        check_topic("namespace", self.namespace)

    def open(self, context: SinkContext) -> CrtkSink:
        if context.controller is None:
            raise InputError("crtk: nothing here moves an arm; it is for `tumortrack resect`.")
        return CrtkSink(self)


class CrtkSink:
    """Sends while the arms move: with good answers, and on their way home once all is cut. Nothing
    while they are halted or in a playback, which knows no answer. It goes on from where the arms
    then are."""

    def __init__(self, config: CrtkSinkConfig) -> None:
        self._arm, self.counts = config.arm, Counter[str]()
        self._bus = open_bus(config.via)
        self._publish = self._bus.publisher(f"{config.namespace}/servo_cp", POSE)
        self._sends = config.simulator
        self.notes = (self._bus.note,) if self._sends else ("DRY RUN: nothing is sent",)

    def publish(self, result: TrackingResult) -> None:
        """Send the target, or count it. TumortrackError: a playback, or there is no such tip."""
        cell = result.control
        if result.playback:
            raise TumortrackError("crtk sends nothing in a playback: give `resect` --live.")
        # Once all is cut the arms go home, whatever is known of the organ.
        known = result.quality == "good" or (isinstance(cell, Workcell) and cell.all_cut)
        if cell is None or cell.stopped or not known:
            self.counts["halted" if cell and cell.stopped else "not good"] += 1
            return
        name = f"{self._arm}/tip"
        tip = next((shape for shape in cell.shapes if shape.name == name), None)
        if tip is None:
            raise TumortrackError(f"crtk: nothing says where {name} is.")
        if self._sends:
            messages = self._bus.messages
            header = messages.header(result.stamp_ns, result.published_frame.frame_id)
            tip_pose = tip.published_from_shape
            pose = pose_fields(tip_pose[:3, 3], wxyz_of(tip_pose[:3, :3]))
            self._publish(messages.to_bytes(messages.make(POSE, header=header, pose=pose)))
        self.counts["sent" if self._sends else "would send"] += 1

    def close(self) -> None:
        self._bus.flush(_FLUSH_S)
        self._bus.close()
