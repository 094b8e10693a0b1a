"""A real arm of Universal Robots: ``ur:192.168.1.10?arm=cutter&execute=false``. By default
nothing is connected: each target is checked and counted. The checks here are no safety system:
that is in the arm's own controller, whose limits and planes must be set for this use."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.packages import to_install
from tumortrack.live.values import Controls, SinkConfig, SinkContext, TrackingResult
from tumortrack_resection.workcell import Arms, TipOf, Workcell

UR_JOINTS = (
    *("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"),
    *("wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
)
_WATCHDOG_S = SILENT_S = 0.2  # of silence, after which the controller and the sink stop the arm
OFF_DEG = 2.0  # tolerated between the arm and the plan before it may move
# Tolerated between the tool's tip and its target on a cut: at 10 mm/s servoing is 1.3 mm late. The
# joints' tolerance would be 40 mm there.
OFF_MM = 2.0
# An arm that begins off its first target joins the plan in this time: 2 degrees at the shoulder are
# 4 cm at the tool, which it would otherwise cover in 0.1 s.
EASE_S = 1.0
_STOP_M_S2 = 10.0  # servoStop's deceleration: ur_rtde's own
# Of UR5, UR5e, UR10 and UR10e (data sheets): a turn either way; the first two joints of the larger
# arms are slower, and their limits are used for all.
LIMIT_RAD = 2 * np.pi
SPEED_RAD_S = np.radians([120.0, 120.0, 180.0, 180.0, 180.0, 180.0])

_TICK_S = 0.02  # of the watchdog
_MUTE_S = 0.1  # without a new state from the arm, which sends 125 a second or more
# Safety modes of the controller (the maker's RTDE guide). It follows in normal and reduced mode; in
# every other mode, also of later controllers, the sink stops.
_FOLLOWS = 1, 2
_SAFETY = {
    3: "in a protective stop",
    4: "in recovery",
    5: "in a safeguard stop",
    6: "in an emergency stop of the system",
    7: "in an emergency stop",
    8: "stopped by a safety violation",
    9: "stopped by a fault",
}
_SHORTEST_S, _LONGEST_S = 0.008, 0.1  # for which the controller follows one target


Joints = Float64[np.ndarray, " 6"]


class UrSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="ur"):
    """One arm at ``host``.

    Attributes:
        arm: which arm's joints it follows: ``cutter_shoulder_pan_joint``, ...
        execute: false: only count what would be sent. true: move the arm.
        jump_deg: the largest step of a joint from one target to the next.
        force_n: at the tool; more stops the arms. 40 is above what a tool's weight and the sensor's
            offset read; it is no limit for tissue, which may tear at less.
        lookahead_s, gain: of servoJ: a longer time and a lower gain are smoother and later.
    """

    target: ClassVar[str] = "host"

    host: str
    arm: Literal["cutter", "holder"] = "cutter"
    execute: bool = False
    jump_deg: float = 5.0
    force_n: float = 40.0
    lookahead_s: float = 0.1
    gain: float = 300.0

    def __post_init__(self) -> None:
        self.check_between("ur:", jump_deg=(0.1, 20.0), force_n=(5.0, 150.0))
        self.check_between("ur:", lookahead_s=(0.03, 0.2), gain=(100.0, 2000.0))  # servoJ's own

    def open(self, context: SinkContext) -> UrSink:
        """Nothing, or with ``execute`` the connection to the arm, which does not move yet.
        InputError: no arms in this run; with ``execute``: as ``UrLink``."""
        arms = context.controller
        if arms is None:
            raise InputError("ur: nothing here moves an arm; it is for `tumortrack resect`.")
        tip_mm = arms.tip_mm if isinstance(arms, Arms) else None
        if self.execute and tip_mm is None:
            raise InputError("ur: nothing says where the arm's tool is; use `tumortrack resect`.")
        return UrSink(self, UrLink(self.host) if self.execute else None, context.controls, tip_mm)


class _Sent(NamedTuple):
    """A target as planned and as sent, when, its stamp, and how far each joint may lag behind."""

    planned: Joints
    joints: Joints
    when_s: float
    stamp_ns: int
    lag_rad: Joints


class UrSink:
    """Sends one arm's joint targets, and stops the arm (servoStop) if the arms are halted, there is
    no workcell, a target is refused, 0.2 s pass without a result, or the sink is closed. With every
    target, and 50 times a second between them, it checks that the arm responds, is under no safety
    stop, meets no force, and is where the targets have led it; if not, all arms stop for good.

    From a standstill it begins only if the arm is within 2 degrees of the target, which it then
    reaches within a second. On a cut the tool's tip must be within 2 mm of its target. If this
    process dies, the arm's controller stops the arm within 0.2 s (setWatchdog)."""

    def __init__(
        self, config: UrSinkConfig, link: UrLink | None, controls: Controls, tip_mm: TipOf | None
    ) -> None:
        self._config, self._link = config, link
        self._controls, self._tip_mm = controls, tip_mm
        self._cutting = False
        self._names = tuple(f"{config.arm}_{joint}" for joint in UR_JOINTS)
        self._last: _Sent | None = None  # None: the arm stands still
        self._offset: tuple[Joints, float] = (
            np.zeros(6),
            0.0,
        )  # from its first target, and since when
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._counts: Counter[str] = Counter()
        self._fault = self._trouble = ""  # permanent; found between two results, raised once
        self._watch = threading.Thread(target=self._keep_watch, name="ur", daemon=True)
        if link is not None:
            self._watch.start()

    @property
    def counts(self) -> dict[str, int]:
        """Results by outcome, and silences."""
        with self._lock:
            return dict(self._counts)

    def publish(self, result: TrackingResult) -> None:
        """Send the target, or check it; TumortrackError: it is refused, and the arm stops."""
        with self._lock:
            if self._closed.is_set():
                return
            if trouble := self._fault or self._trouble:
                self._trouble = ""
                raise TumortrackError(trouble)
            cell = result.control
            with self._failing_safe():
                if cell is None or cell.stopped:
                    self._counts["no arms" if cell is None else "halted"] += 1
                    self._stop()
                else:
                    self._stop_if_silent()
                    # After a standstill on a cut, the next motion begins on the cut.
                    cutting = isinstance(cell, Workcell) and cell.cutting
                    self._cutting = cutting or (self._cutting and self._last is None)
                    self._send(_target(cell.joints_rad, self._names), result.stamp_ns)

    def close(self) -> None:
        if self._closed.is_set():
            return
        self._closed.set()
        if self._link is None:
            return
        self._watch.join()
        with self._lock:
            try:
                self._stop()
            finally:
                self._link.close()

    @contextmanager
    def _failing_safe(self) -> Iterator[None]:
        """If the body fails, this arm no longer follows the plan: all arms stop for good, and
        TumortrackError says why."""
        try:
            yield
        except Exception as error:
            if self._link is not None:
                self._controls.aborted.set()
            if not isinstance(error, TumortrackError):  # of ur_rtde, which raises anything
                self._lose_link(error)
                raise TumortrackError(self._fault) from error
            self._counts["refused"] += 1
            self._stop()
            raise TumortrackError(f"ur {self._config.arm}: {error}") from error

    def _send(self, planned: Joints, stamp_ns: int) -> None:
        now_s, last, link = time.monotonic(), self._last, self._link
        if link is not None:
            joints_rad = self._check_arm(link, planned)
            if last is None:
                self._offset = joints_rad - planned, now_s
        offset_rad, begun_s = self._offset
        target = planned + offset_rad * max(1 - (now_s - begun_s) / EASE_S, 0.0)
        follow_s, lag_rad = _LONGEST_S, np.zeros(6)
        if last is not None:
            # By arrival or by stamps, whichever is longer: a thread may have waited.
            seconds = max(now_s - last.when_s, (stamp_ns - last.stamp_ns) * 1e-9, _SHORTEST_S)
            _check_step(target - last.joints, seconds, self._config.jump_deg)
            follow_s = min(seconds, _LONGEST_S)
            # servoJ lags behind by its lookahead time and one target.
            lag_rad = np.abs(target - last.joints) * (1 + self._config.lookahead_s / seconds)
        if link is not None:
            link.servo(target, follow_s, self._config.lookahead_s, self._config.gain)
        self._last = _Sent(planned, target, now_s, stamp_ns, lag_rad)
        self._counts["would send" if link is None else "sent"] += 1

    def _check_arm(self, link: UrLink, planned: Joints) -> Joints:
        """Where the arm is. Raises TumortrackError: it cannot follow, meets something, or is not at
        the last target or, before the first one, at this."""
        link.check(self._config.force_n)
        last = self._last or _Sent(planned, planned, 0.0, 0, np.zeros(6))
        joints_rad = link.compare(last.joints, np.radians(OFF_DEG) + last.lag_rad)
        if self._cutting and self._tip_mm is not None:
            ways_mm = (self._tip_mm(self._config.arm, at) for at in (joints_rad, last.planned))
            off_mm = float(np.linalg.norm(np.subtract(*ways_mm)))
            if not off_mm <= OFF_MM:
                raise TumortrackError(
                    f"the tool's tip is {off_mm:.1f} mm from where it should cut; allowed: "
                    f"{OFF_MM:g}"
                )
        return joints_rad

    def _stop(self) -> None:
        moving, self._last = self._last is not None, None
        if moving and self._link is not None:
            try:
                self._link.stop()
            except Exception as error:
                self._lose_link(error)

    def _stop_if_silent(self) -> None:
        if self._last is not None and time.monotonic() - self._last.when_s > SILENT_S:
            self._counts["silences"] += 1
            self._stop()

    def _lose_link(self, error: Exception) -> None:
        """Give the link up. The controller's watchdog, no longer kicked, stops the arm."""
        self._last = None
        self._fault = (
            f"ur {self._config.arm}: the arm at {self._config.host} is lost ({error}); look after "
            "it, then start again"
        )

    def _keep_watch(self) -> None:
        while not self._closed.wait(_TICK_S):
            with self._lock:
                self._stop_if_silent()
                if self._fault or self._link is None:
                    return
                try:
                    with self._failing_safe():
                        if self._last is not None:
                            self._check_arm(self._link, self._last.planned)
                        self._link.kick()
                except TumortrackError as error:
                    self._trouble = str(error)


def _target(joints_rad: Mapping[str, float], names: tuple[str, ...]) -> Joints:
    """One arm's joints in the maker's order; TumortrackError: one is missing, not a number, or
    beyond its limit."""
    if missing := [name for name in names if name not in joints_rad]:
        raise TumortrackError(f"there is no joint {missing[0]}; there are {', '.join(joints_rad)}")
    target = np.array([float(joints_rad[name]) for name in names])
    wrong = ~(np.abs(target) <= LIMIT_RAD)  # also if it is not a number
    if wrong.any():
        joint = int(wrong.argmax())
        raise TumortrackError(
            f"{UR_JOINTS[joint]} at {np.degrees(target[joint]):.1f} degrees; allowed: "
            f"{np.degrees(LIMIT_RAD):g} either way"
        )
    return target


def _check_step(step: Joints, seconds: float, jump_deg: float) -> None:
    """Raises TumortrackError: too large, or too fast."""
    jump, speed = np.degrees(np.abs(step)), np.abs(step) / seconds / SPEED_RAD_S
    if jump.max() > jump_deg:
        joint = int(jump.argmax())
        raise TumortrackError(
            f"{UR_JOINTS[joint]} jumps by {jump[joint]:.1f} degrees; allowed: {jump_deg:g}"
        )
    if speed.max() > 1:
        joint = int(speed.argmax())
        raise TumortrackError(
            f"{UR_JOINTS[joint]} would turn at {np.degrees(abs(step[joint]) / seconds):.0f} "
            f"degrees/s; allowed: {np.degrees(SPEED_RAD_S[joint]):.0f}"
        )


class UrLink:
    """ur_rtde's two interfaces to the controller of one arm; not thread-safe. Raises InputError:
    ur_rtde is missing, or the arm cannot be reached or controlled."""

    def __init__(self, host: str) -> None:
        try:
            import rtde_control
            import rtde_receive
        except ImportError as error:
            raise InputError(
                "ur with execute=true needs the package ur_rtde: "
                f"{to_install('tumortrack-resection[ur]')}."
            ) from error
        self._ends = ExitStack()  # the last first: the program, then both connections
        try:
            self._receive = rtde_receive.RTDEReceiveInterface(host)
            self._ends.callback(self._receive.disconnect)
            self._control = rtde_control.RTDEControlInterface(host)
        except RuntimeError as error:
            self._ends.close()
            raise InputError(
                f"ur: the arm at {host} cannot be controlled ({error}). Is it on, released, in "
                "remote control, and reachable on port 30004?"
            ) from error
        self._ends.callback(self._control.disconnect)
        self._ends.callback(self._control.stopScript)
        self._control.setWatchdog(1 / _WATCHDOG_S)
        self._last_state = (-1.0, 0.0)  # the arm's clock, and when it changed by ours

    def check(self, force_n: float) -> None:
        """Raises TumortrackError: the arm does not respond, cannot follow, or meets a force."""
        now_s, stamp_s = time.monotonic(), self._receive.getTimestamp()
        if stamp_s != self._last_state[0]:
            self._last_state = stamp_s, now_s
        if not self._receive.isConnected() or now_s - self._last_state[1] > _MUTE_S:
            raise TumortrackError("nothing is heard of the arm; is its network well?")
        if (mode := self._receive.getSafetyMode()) not in _FOLLOWS:
            fault = _SAFETY.get(mode, "in no mode in which it may be moved")
            raise TumortrackError(f"the arm is {fault} (safety mode {mode}); release it there")
        if not self._control.isProgramRunning():
            raise TumortrackError("the arm runs no program any more; start again")
        force = float(np.linalg.norm(self._receive.getActualTCPForce()[:3]))
        if not force <= force_n:
            raise TumortrackError(f"the tool meets {force:.0f} N; allowed: {force_n:g}")

    def compare(self, target: Joints, allowed_rad: Joints) -> Joints:
        """Where the arm is. Raises TumortrackError: it is not where the plan has it."""
        joints_rad = np.array(self._receive.getActualQ(), float)
        off_rad = np.abs(joints_rad - target)
        if not (off_rad <= allowed_rad).all():
            joint = int((off_rad - allowed_rad).argmax())
            off_deg, allowed_deg = np.degrees([off_rad[joint], allowed_rad[joint]])
            raise TumortrackError(
                f"{UR_JOINTS[joint]} is {off_deg:.1f} degrees from the plan; allowed: "
                f"{allowed_deg:.2g}. Move the arm there first"
            )
        return joints_rad

    def servo(self, target: Joints, follow_s: float, lookahead_s: float, gain: float) -> None:
        if not self._control.servoJ(target.tolist(), 0.0, 0.0, follow_s, lookahead_s, gain):
            raise TumortrackError("the arm did not take the target")

    def stop(self) -> None:
        if not self._control.servoStop(_STOP_M_S2):
            raise TumortrackError("the arm did not take the order to stop")

    def kick(self) -> None:
        self._control.kickWatchdog()

    def close(self) -> None:
        self._ends.close()
