"""A real arm follows what it must, and nothing else: its controller is made up."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from clock import Clock, until
from live_objects import small_setting, small_update
from refused import refused
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.packages import to_install
from tumortrack.live.spec import SINKS
from tumortrack_resection.ur_sink import SILENT_S, UR_JOINTS, UrSink, UrSinkConfig
from tumortrack_resection.workcell import Workcell
from workcell_objects import with_arms, workcell, working

# A fake controller of a real arm, which records its calls.


class FakeArm:
    """One controller behind both of ur_rtde's interfaces."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []
        self.opened: list[str] = []
        self.actual = list(angles(0.0))
        self.running, self.safety_mode, self.fails = True, 1, ""
        self.kicks, self.follows, self.mute, self.force = 0, True, False, [1.0, 2.0, -3.0, 9, 9, 9]

    def modules(self) -> dict[str, ModuleType]:
        arm = self

        class RTDEControlInterface:
            def __init__(self, hostname: str) -> None:
                if arm.fails == "connect":
                    raise RuntimeError("Could not connect to: 10.0.0.9 at 30004, verify the IP")
                arm.opened.append(f"control {hostname}")

            def setWatchdog(self, min_frequency: float) -> bool:  # noqa: N802
                arm.calls.append(("watchdog", min_frequency))
                return True

            def kickWatchdog(self) -> bool:  # noqa: N802
                arm.kicks += 1
                return True

            def isProgramRunning(self) -> bool:  # noqa: N802
                return arm.running

            def servoJ(self, q, speed, acceleration, time, lookahead_time, gain) -> bool:  # noqa: N802
                if arm.fails == "servo":
                    raise RuntimeError("connection lost")
                arm.calls.append(("servo", q, time, lookahead_time, gain))
                arm.actual = list(q) if arm.follows else arm.actual
                return arm.fails != "refuse"

            def servoStop(self, a: float = 10.0) -> bool:  # noqa: N802
                arm.calls.append(("stop", a))
                return True

            def stopScript(self) -> None:  # noqa: N802
                arm.calls.append(("script ends",))

            def disconnect(self) -> None:
                arm.calls.append(("bye",))

        class RTDEReceiveInterface:
            def __init__(self, hostname: str) -> None:
                arm.opened.append(f"receive {hostname}")

            def getActualQ(self) -> list[float]:  # noqa: N802
                return arm.actual

            def getSafetyMode(self) -> int:  # noqa: N802
                return arm.safety_mode

            def getActualTCPForce(self) -> list[float]:  # noqa: N802
                return arm.force

            def getTimestamp(self) -> float:  # noqa: N802
                return 7.0 if arm.mute else time.monotonic()

            def isConnected(self) -> bool:  # noqa: N802
                return True

            def disconnect(self) -> None:
                pass

        control, receive = ModuleType("rtde_control"), ModuleType("rtde_receive")
        control.RTDEControlInterface = RTDEControlInterface  # type: ignore[attr-defined]
        receive.RTDEReceiveInterface = RTDEReceiveInterface  # type: ignore[attr-defined]
        return {"rtde_control": control, "rtde_receive": receive}

    def what(self) -> list[str]:
        return [call[0] for call in self.calls if call[0] != "watchdog"]


def angles(progress: float) -> list[float]:
    cell = workcell(progress)
    return [cell.joints_rad[f"cutter_{joint}"] for joint in UR_JOINTS]


@pytest.fixture
def arm(monkeypatch) -> FakeArm:
    fake = FakeArm()
    for name, module in fake.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    return fake


@pytest.fixture
def moving(arm, monkeypatch) -> Iterator:
    """Opens sinks that execute, and closes them. On a loaded machine a test may pause for long."""
    used: list[UrSink] = []

    def opened(silent_s: float = 20.0, **options) -> UrSink:
        monkeypatch.setattr("tumortrack_resection.ur_sink.SILENT_S", silent_s)
        used.append(UrSinkConfig(host="10.0.0.9", execute=True, **options).open(with_arms()))
        return used[-1]

    yield opened
    arm.fails = ""
    for sink in used:
        sink.close()
        sink.close()


def test_by_default_nothing_is_connected_and_targets_are_counted(arm, monkeypatch):
    monkeypatch.setattr("tumortrack_resection.ur_sink.SILENT_S", 20.0)  # as of a busy machine
    config = SINKS.parse("ur:10.0.0.9?arm=holder")
    assert config == UrSinkConfig(host="10.0.0.9", arm="holder", execute=False)
    sink = config.open(with_arms())
    for n in range(5):
        sink.publish(working(n, n * 0.01))
    sink.publish(working(5, 0.05, halted="the tumor moved"))
    sink.publish(small_update(6))
    sink.close()
    assert sink.counts == {"would send": 5, "halted": 1, "no arms": 1}
    assert arm.opened == arm.calls == []


@pytest.mark.parametrize(
    ("joints", "named"),
    [
        ({"cutter_elbow_joint": 6.3}, ["elbow_joint", "361.0 degrees", 360]),
        ({"cutter_elbow_joint": float("nan")}, ["elbow_joint", "nan"]),
        ({"cutter_wrist_3_joint": None}, ["cutter_wrist_3_joint"]),
        ({"cutter_wrist_1_joint": 0.3 + 0.12}, ["wrist_1_joint", "6.9 degrees", 5]),
        ({"cutter_shoulder_pan_joint": 0.08}, ["shoulder_pan_joint", "139", 120]),
    ],
)
def test_targets_that_an_arm_must_not_follow_are_refused(monkeypatch, joints, named):
    monkeypatch.setattr("tumortrack_resection.ur_sink.time", Clock())  # speeds are of the stamps
    sink = UrSinkConfig(host="10.0.0.9").open(with_arms())
    sink.publish(working(0))
    update = working(1)
    assert update.control is not None
    changed = {k: v for k, v in (update.control.joints_rad | joints).items() if v is not None}
    with refused(TumortrackError, *named):
        sink.publish(replace(update, control=replace(update.control, joints_rad=changed)))
    assert sink.counts == {"would send": 1, "refused": 1}


def test_an_arm_follows_the_targets_and_is_stopped_at_the_end(arm, moving):
    sink = moving(gain=400.0)
    assert arm.opened == ["receive 10.0.0.9", "control 10.0.0.9"]
    assert arm.calls == [("watchdog", 5.0)]
    for n in range(4):
        sink.publish(working(n, n * 0.02))
    until(lambda: arm.kicks)
    sink.close()
    assert arm.what() == ["servo"] * 4 + ["stop", "script ends", "bye"]
    for n, (_, q, follow_s, lookahead_s, gain) in enumerate(arm.calls[1:5]):
        assert q == pytest.approx(angles(n * 0.02))
        assert (lookahead_s, gain) == (0.1, 400.0)
        assert (follow_s == 0.1) if n == 0 else (0.032 < follow_s <= 0.1)
    assert sink.counts == {"sent": 4}


def test_an_arm_elsewhere_is_not_moved(arm, moving):
    sink = moving()
    arm.actual[2] += np.radians(2.5)
    with refused(TumortrackError, "elbow_joint", "2.5 degrees"):
        sink.publish(working(0))
    assert arm.what() == []
    arm.actual[2] -= np.radians(1.0)
    sink.publish(working(1))
    assert arm.what() == ["servo"]


def test_an_arm_that_begins_beside_its_target_joins_the_plan_slowly(arm, moving, monkeypatch):
    clock = Clock()
    monkeypatch.setattr("tumortrack_resection.ur_sink.time", clock)
    sink = moving()
    arm.actual[0] += np.radians(1.5)
    sent = []
    for n in range(61):
        sink.publish(working(n, 0.002 * n))
        sent.append(np.degrees(arm.calls[-1][1][0] - angles(0.002 * n)[0]))
        clock.sleep(0.02)
    assert sent[0] == pytest.approx(1.5)
    assert np.diff(sent[:51]) == pytest.approx(-0.03)  # 1.5 degrees in a second
    assert np.array(sent[51:]) == pytest.approx(0.0, abs=1e-9)


def cutting(number, yes):
    result = working(number)
    return replace(result, control=Workcell(**vars(result.control), cutting=yes))


def test_on_a_cut_the_tools_tip_is_where_it_should_be_to_2_mm(arm, moving):
    """A tenth of a degree at the shoulder, a metre away, are 1.75 mm, and far within 2 degrees."""
    sink = moving()
    arm.actual[5] += np.radians(1.1)  # the tool alone turns: 100 mm, so 1.9 mm
    sink.publish(cutting(0, True))
    arm.follows = False
    arm.actual = angles(0.0)
    arm.actual[0] += np.radians(0.1)
    sink.publish(cutting(1, True))
    sink.publish(cutting(2, False))  # before it is off: the watch looks at any moment
    arm.actual[0] += np.radians(0.05)
    sink.publish(cutting(3, False))
    with refused(TumortrackError, "2.6 mm"):
        sink.publish(cutting(4, True))
    assert arm.what() == ["servo", "servo", "servo", "servo", "stop"]


def test_an_arm_that_stood_still_on_a_cut_begins_there_whatever_comes_next(arm, moving):
    """A plan made anew in the middle of a cut begins with a way that is no cut."""
    sink = moving()
    sink.publish(cutting(0, True))
    sink.publish(working(1, 0.0, "the tumor has moved"))
    arm.actual[0] += np.radians(0.15)
    with refused(TumortrackError, "2.6 mm"):
        sink.publish(cutting(2, False))
    assert arm.what() == ["servo", "stop"]


@pytest.mark.parametrize("why", ["halted", "no arms", "jump"])
def test_an_arm_is_stopped_and_begins_again_only_where_it_stands(arm, moving, why):
    sink = moving()
    sink.publish(working(0))
    sink.publish(working(1, 0.01))
    if why == "jump":
        with pytest.raises(TumortrackError):
            sink.publish(working(2, 0.99))
    else:
        sink.publish(working(2, 0.01, "hidden") if why == "halted" else small_update(2))
    assert arm.what() == ["servo", "servo", "stop"]
    with pytest.raises(TumortrackError):  # it went on without the arm
        sink.publish(working(3, 0.5))
    assert arm.what() == ["servo", "servo", "stop"]
    arm.actual = angles(0.5)
    sink.publish(working(4, 0.5))
    assert arm.what() == ["servo", "servo", "stop", "servo"]


def test_silence_stops_an_arm(arm, moving):
    sink = moving(SILENT_S)
    start_s = time.monotonic()
    sink.publish(working(0))
    until(lambda: "stop" in arm.what())
    assert time.monotonic() - start_s > SILENT_S
    kicks = arm.kicks
    until(lambda: arm.kicks > kicks)  # the program itself is well
    assert arm.what() == ["servo", "stop"]
    assert sink.counts == {"sent": 1, "silences": 1}


def _push(arm: FakeArm) -> None:
    arm.force = [0.0, -41.0, 0.0, 0.0, 0.0, 0.0]


def _turn(arm: FakeArm) -> None:
    arm.actual = [q + np.radians(4) for q in arm.actual]


ARM_FAULTS = {
    "protective": (lambda arm: setattr(arm, "safety_mode", 3), "safety mode 3"),
    "emergency": (lambda arm: setattr(arm, "safety_mode", 7), "safety mode 7"),
    "unknown mode": (lambda arm: setattr(arm, "safety_mode", 12), "safety mode 12"),
    "program": (lambda arm: setattr(arm, "running", False), ""),
    "force": (_push, "41 N"),
    "elsewhere": (_turn, "4.0 degrees"),
    "mute": (lambda arm: setattr(arm, "mute", True), ""),
}


@pytest.mark.parametrize("fault", ARM_FAULTS)
def test_whatever_happens_to_an_arm_between_two_targets_stops_all_arms(arm, monkeypatch, fault):
    """Found by the sink's own thread: no further result is needed."""
    monkeypatch.setattr("tumortrack_resection.ur_sink.SILENT_S", 20.0)
    setting, (happens, named) = with_arms(), ARM_FAULTS[fault]
    sink = UrSinkConfig(host="10.0.0.9", execute=True).open(setting)
    sink.publish(working(0))
    happens(arm)
    until(setting.controls.aborted.is_set)
    until(lambda: "stop" in arm.what())
    with refused(TumortrackError, named):
        sink.publish(working(1, 0.01))
    sink.close()
    assert arm.what()[:2] == ["servo", "stop"]
    assert sink.counts == {"sent": 1, "refused": 1}


@pytest.mark.parametrize("behind_deg", [3.1, 3.3])
def test_an_arm_may_be_behind_by_the_time_it_looks_ahead(arm, moving, monkeypatch, behind_deg):
    """0.2 degrees every 20 ms, looked ahead 0.1 s: 0.2 + 1.0 degrees, and 2 more anywhere."""
    monkeypatch.setattr("tumortrack_resection.ur_sink._TICK_S", 30.0)  # its thread looks away
    monkeypatch.setattr("tumortrack_resection.ur_sink.time", Clock())
    arm.follows = False
    sink = moving()
    results = []
    for n in range(3):
        cell = working(0).control
        assert cell is not None
        turned = {name: rad + n * np.radians(0.2) for name, rad in cell.joints_rad.items()}
        stamp_ns = 10**9 + n * 20_000_000
        results.append(
            replace(working(0), stamp_ns=stamp_ns, control=replace(cell, joints_rad=turned))
        )
    sink.publish(results[0])
    sink.publish(results[1])
    arm.actual = (np.array(angles(0.0)) + np.radians(0.2 - behind_deg)).tolist()
    if behind_deg < 3.2:
        sink.publish(results[2])
    else:
        with refused(TumortrackError, "3.3 degrees", 3.2):
            sink.publish(results[2])


@pytest.mark.parametrize("why", ["refused", "fault", "halted"])
def test_an_arm_that_gives_up_stops_all_arms_for_good(arm, monkeypatch, why):
    monkeypatch.setattr("tumortrack_resection.ur_sink.SILENT_S", 20.0)
    setting = with_arms()
    sink = UrSinkConfig(host="10.0.0.9", execute=True).open(setting)
    sink.publish(working(0))
    if why == "halted":  # as planned: no reason to give up
        sink.publish(working(1, 0.01, "hidden"))
    else:
        arm.fails = "servo" if why == "fault" else ""
        with pytest.raises(TumortrackError):
            sink.publish(working(1, 0.01 if why == "fault" else 0.99))
    arm.fails = ""
    sink.close()
    assert setting.controls.aborted.is_set() == (why != "halted")
    dry = with_arms()
    checked = UrSinkConfig(host="10.0.0.9").open(dry)
    checked.publish(working(0))
    with pytest.raises(TumortrackError):
        checked.publish(working(1, 0.99))
    assert not dry.controls.aborted.is_set()  # nothing moved: nothing to stop


def test_a_broken_link_is_left_to_the_controllers_watchdog(arm, moving):
    sink = moving()
    sink.publish(working(0))
    arm.fails = "servo"
    for n in (1, 2):
        with refused(TumortrackError, "10.0.0.9", "connection lost"):
            sink.publish(working(n, 0.01))
    until(lambda: "ur" not in [one.name for one in threading.enumerate()], "the watch's end")
    assert arm.what() == ["servo"]


def test_what_cannot_work_is_refused(arm, monkeypatch):
    with pytest.raises(InputError):
        UrSinkConfig(host="10.0.0.9").open(small_setting())
    for bad in ({"gain": 10.0}, {"lookahead_s": 1.0}, {"jump_deg": float("nan")}):
        with refused(InputError, *bad):
            UrSinkConfig(host="10.0.0.9", **bad)
    arm.fails = "connect"
    with refused(InputError, "10.0.0.9"):
        UrSinkConfig(host="10.0.0.9", execute=True).open(with_arms())
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    with refused(InputError, to_install("tumortrack-resection[ur]")):
        UrSinkConfig(host="10.0.0.9", execute=True).open(with_arms())
    assert arm.calls == []
