"""The controller of one arm of Universal Robots', through ur_rtde."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, TumortrackError

UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
SILENT_S = 0.2  # without a word the controller stops the arm by itself
OFF_DEG = 2.0  # between the arm and the plan, before it may move
_STOP_M_S2 = 10.0  # servoStop's deceleration: ur_rtde's own


class UrLink:
    """ur_rtde's two interfaces to one arm. Not for two threads at once."""

    def __init__(self, control: Any, receive: Any) -> None:
        self._control, self._receive = control, receive
        control.setWatchdog(1 / SILENT_S)

    def check(self) -> None:
        """Raises TumortrackError where the arm cannot follow."""
        if self._receive.isEmergencyStopped() or self._receive.isProtectiveStopped():
            raise TumortrackError("the arm is in an emergency or protective stop; release it there")
        if not self._control.isProgramRunning():
            raise TumortrackError("the arm runs no program any more; start again")

    def compare(self, target: Float64[np.ndarray, " 6"]) -> None:
        """Raises TumortrackError where the arm is not where the plan has it."""
        off_deg = np.degrees(np.abs(np.array(self._receive.getActualQ()) - target))
        if not off_deg.max() <= OFF_DEG:
            raise TumortrackError(
                f"{UR_JOINTS[int(off_deg.argmax())]} is {off_deg.max():.1f} degrees from the plan; "
                f"allowed: {OFF_DEG:g}. Move the arm there first"
            )

    def servo(
        self, target: Float64[np.ndarray, " 6"], follow_s: float, lookahead_s: float, gain: float
    ) -> None:
        if not self._control.servoJ(target.tolist(), 0.0, 0.0, follow_s, lookahead_s, gain):
            raise TumortrackError("the arm did not take the target")

    def stop(self) -> None:
        if not self._control.servoStop(_STOP_M_S2):
            raise TumortrackError("the arm did not take the order to stop")

    def kick(self) -> None:
        self._control.kickWatchdog()

    def close(self) -> None:
        self._control.stopScript()
        self._control.disconnect()
        self._receive.disconnect()


def connected(host: str) -> UrLink:
    """
    Raises:
        InputError: ur_rtde is missing, or the arm cannot be reached or controlled.
    """
    control_module, receive_module = _rtde()
    try:
        receive = receive_module.RTDEReceiveInterface(host)
        control = control_module.RTDEControlInterface(host)
    except RuntimeError as error:
        raise InputError(
            f"ur: the arm at {host} cannot be controlled ({error}). Is it on, released, in remote "
            "control, and reachable on port 30004?"
        ) from error
    return UrLink(control, receive)


def _rtde() -> tuple[ModuleType, ModuleType]:
    try:
        import rtde_control
        import rtde_receive
    except ImportError as error:
        raise InputError(
            "ur with execute=true needs the package ur_rtde: pip install 'tumortrack[ur]'."
        ) from error
    return rtde_control, rtde_receive
