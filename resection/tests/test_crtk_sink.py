"""A simulator that speaks CRTK gets where a tip is to be, and nothing else."""

from __future__ import annotations

import queue
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clients
import needs
from clock import until
from live_objects import small_setting
from refused import refused
from ros2_objects import own_graph, process
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.geometry import rigid
from tumortrack.live.spec import SINKS
from tumortrack.live.values import ControlState, RigidShape, TrackingResult
from tumortrack_resection.crtk_sink import CrtkSinkConfig
from workcell_objects import box, virtual, with_arms, working

needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")

PEER = Path(__file__).parents[2] / "devices" / "tests" / "support" / "crtk_peer.py"
TURNED = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.fixture(autouse=True)
def _own_graph() -> Iterator[None]:
    with own_graph():
        yield


def at(number: int) -> TrackingResult:
    """The holder's tip is ``number`` mm from the table, and turned."""
    tip = RigidShape(
        "holder/tip", box(8, 8, 8), rigid(TURNED, np.array([1.0, 2, number])), (0, 0, 0)
    )
    update = working(number)
    shapes = (*(s for s in update.control.shapes if s.name != "holder/tip"), tip)
    return replace(update, control=replace(update.control, shapes=shapes))


def halted(number: int) -> TrackingResult:
    return replace(at(number), control=replace(at(number).control, stopped="no estimate"))


def test_a_simulator_hears_the_tip_while_the_answer_is_good_and_nothing_is_halted() -> None:
    config = SINKS.parse("crtk:/PSM1?arm=holder&simulator=true&via=dds")
    sink = config.open(with_arms())
    environment = clients.environment("ros-jazzy-rclpy")
    try:
        with process(sys.executable, PEER, "simulator", environment=environment) as simulator:
            simulator.line()

            def heard_it() -> bool:  # it may not be matched yet
                sink.publish(at(1))
                with suppress(queue.Empty):
                    return bool(simulator.line(0.2))
                return False

            until(heard_it, "the first target")
            sent = sink.counts["sent"]
            for unsent in (
                halted(101),
                replace(at(102), quality="poor", warning="few points"),
                replace(at(103), estimate=None, quality="none"),
                replace(at(104), control=None),
            ):
                sink.publish(unsent)
            assert (sink.counts["sent"], sink.counts["halted"]) == (sent, 1)
            sink.publish(at(105))
            heard = simulator.lines_until(lambda said: said["matrix"][2][3] > 104)
    finally:
        sink.close()
    heights_mm = [round(said["matrix"][2][3], 6) for said in heard]
    assert heights_mm[-1] == 105
    assert not {101, 102, 103, 104} & set(heights_mm)
    last = heard[-1]
    np.testing.assert_allclose(last["matrix"], rigid(TURNED, np.array([1.0, 2, 105])), atol=1e-9)
    assert (last["frame"], last["stamp_ns"]) == ("table", at(105).stamp_ns)


def test_by_default_it_only_counts() -> None:
    sink = CrtkSinkConfig(namespace="/PSM1", via="dds").open(with_arms())
    try:
        sink.publish(at(1))
        sink.publish(halted(2))
        assert sink.counts == {"would send": 1, "halted": 1}
    finally:
        sink.close()


def test_a_playback_and_a_tip_that_nobody_knows_move_no_simulator() -> None:
    sink = CrtkSinkConfig(namespace="/PSM1", simulator=True, via="dds").open(with_arms())
    try:
        with refused(TumortrackError, "--live"):
            sink.publish(virtual(1))
        with refused(TumortrackError, "cutter/tip"):
            sink.publish(replace(at(1), control=ControlState("hold")))
        assert not sink.counts["sent"]
    finally:
        sink.close()


def test_what_moves_no_arm_has_no_such_sink() -> None:
    with refused(InputError, "resect"):
        CrtkSinkConfig(namespace="/PSM1").open(small_setting())
    with refused(InputError, "PSM1"):
        CrtkSinkConfig(namespace="PSM1")
