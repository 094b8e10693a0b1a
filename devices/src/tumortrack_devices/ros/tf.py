"""tf: messages of transforms, and the pose of a camera from them (/tf interpolated, /tf_static
always)."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import Affine, rigid
from tumortrack.core.report import Finding
from tumortrack.live.poses import CameraPoses, PoseBuffer, PosesConfig
from tumortrack.live.values import Observation
from tumortrack_devices.display import wxyz_of
from tumortrack_devices.ros.bus import Bus, Via, open_bus
from tumortrack_devices.ros.messages import MM_PER_M, Messages, stamp_of, xyz

TRANSFORMS = "tf2_msgs/msg/TFMessage"
_WAIT_S = 0.1  # for a transform after the frame's stamp: publishers of 10 Hz and faster
_MOST = 1000  # messages between two frames: 30 publishers of 1 kHz at 30 Hz
_NOT_UNIT = 1e-3  # tolerance of a quaternion's length


class Ros2PosesConfig(PosesConfig, frozen=True, kw_only=True, tag="ros2"):
    """tf. ``frame``: the fixed one, such as base_link. ``camera``: the camera's, or its tool's if
    the calibration has tool_from_camera; empty: as in the source's messages."""

    target: ClassVar[str] = "frame"

    frame: str
    camera: str = ""
    via: Via = "auto"

    def open(self) -> TfPoses:
        return TfPoses(open_bus(self.via), self.frame, self.camera)


class TfPoses(CameraPoses):
    """Poses of the frame ``camera``, or if that is empty, of the observation's frame."""

    def __init__(self, bus: Bus, frame: str, camera: str) -> None:
        self.frame_id, self._camera, self._bus = frame.removeprefix("/"), camera, bus
        self._tf = bus.subscriber("/tf", TRANSFORMS, _MOST)
        self._tf_static = bus.subscriber("/tf_static", TRANSFORMS, _MOST, latched=True)
        # Each frame's parent, and its poses there, or its only one.
        self._known: dict[str, tuple[str, PoseBuffer | Affine]] = {}

    def pose(self, seen: Observation) -> Affine:
        """Waits for transforms that may still arrive."""
        until_s = time.monotonic() + _WAIT_S
        while True:
            self.take()
            try:
                return self.fixed_from(self._camera or seen.frame_id or "", seen.stamp_ns)
            except NoEstimate:
                if time.monotonic() >= until_s:
                    raise
            self._bus.wait(max(until_s - time.monotonic(), 0.0))

    def take(self) -> None:
        """Keep the transforms that have come."""
        for subscriber in (self._tf, self._tf_static):
            for raw in subscriber.take():
                for transform in self._bus.messages.from_bytes(raw, TRANSFORMS).transforms:
                    self._keep(transform, static=subscriber is self._tf_static)

    def known(self, seconds: float) -> dict[tuple[str, str], Affine]:
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            self._bus.wait(left_s)
            self.take()
        return {
            (parent, child): poses.newest if isinstance(poses, PoseBuffer) else poses
            for child, (parent, poses) in self._known.items()
        }

    def close(self) -> None:
        self._bus.close()

    def _keep(self, message: Any, static: bool) -> None:
        if (pose := pose_of(message)) is None:
            return
        parent = message.header.frame_id.removeprefix("/")
        child = message.child_frame_id.removeprefix("/")
        before, poses = self._known.get(child, ("", None))
        if static:
            self._known[child] = parent, pose
            return
        if before != parent or not isinstance(poses, PoseBuffer):
            self._known[child] = parent, (poses := PoseBuffer())
        poses.add(stamp_of(message.header), pose)

    def fixed_from(self, camera: str, stamp_ns: int) -> Affine:
        """The camera's (or another frame's) pose in the fixed frame, by their lowest common
        ancestor. Raises NoEstimate: it is not known from what was taken."""
        of_fixed, of_camera = self._ancestors(self.frame_id), self._ancestors(camera)
        common = next((name for name in of_camera if name in of_fixed), None)
        if common is None:
            values = {"camera": camera, "frame_id": self.frame_id}
            raise NoEstimate(Finding("unconnected", values))
        common_from = []
        for names in (of_fixed, of_camera):
            common_from.append(np.eye(4))
            for name in names[: names.index(common)]:
                pose = self._known[name][1]
                now = pose.at(stamp_ns) if isinstance(pose, PoseBuffer) else pose
                common_from[-1] = now @ common_from[-1]
        return np.linalg.inv(common_from[0]) @ common_from[1]

    def _ancestors(self, name: str) -> list[str]:
        """A frame, its parent, and so on."""
        names = [name]
        while (parent := self._known.get(names[-1], ("",))[0]) and parent not in names:
            names.append(parent)
        return names


def transform_fields(
    messages: Messages, stamp_ns: int, parent: str, child: str, parent_from_child: Affine
) -> dict[str, Any]:
    """The fields of a TransformStamped, from a pose in mm. Raises InputError for a stamp beyond
    ROS's range."""
    turn = wxyz_of(parent_from_child[:3, :3]).tolist()
    shift, rotation = xyz(parent_from_child[:3, 3] / MM_PER_M), dict(zip("wxyz", turn, strict=True))
    return {
        "header": messages.header(stamp_ns, parent),
        "child_frame_id": child,
        "transform": {"translation": shift, "rotation": rotation},
    }


def pose_of(message: Any) -> Affine | None:
    """Parent from child, mm, of a TransformStamped; None: it is no rigid transform."""
    return pose_from(message.transform.translation, message.transform.rotation)


def pose_from(shift: Any, turn: Any) -> Affine | None:
    """A pose in mm from a Vector3 or Point in metres and a Quaternion; None: it is not rigid."""
    numbers = np.array([turn.x, turn.y, turn.z, turn.w, shift.x, shift.y, shift.z])
    if not abs(np.linalg.norm(numbers[:4]) - 1) < _NOT_UNIT or not np.isfinite(numbers).all():
        return None
    return rigid(Rotation.from_quat(numbers[:4]).as_matrix(), numbers[4:] * MM_PER_M)
