"""The tracker hears what the electrode cuts: all of its line, once, while it is energised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from live_objects import small_update
from tumortrack.core.evidence import Cut
from tumortrack.core.geometry import transform_points
from tumortrack_resection.arms.body import cell_urdf
from tumortrack_resection.arms.cell import ArmCell
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.budget import ErrorBudget
from tumortrack_resection.check import electrode_line
from tumortrack_resection.halt import Halt
from tumortrack_resection.motions import CUTTER, JOINTS, Execution, Motions, MotionStage
from tumortrack_resection.swept import Swept

LENGTH_MM, RADIUS_MM = 70.0, 1.2
CAMERA_FROM_TABLE = np.array([[1.0, 0, 0, -5], [0, -1, 0, 8], [0, 0, -1, 300], [0, 0, 0, 1]])
GOOD = replace(small_update(), quality="good")
FRAME_S = 0.05


def motions():
    """The first joint is how far (mm) the electrode, which stands upright, goes along x: 5 mm of
    approach, 20 mm of a cut, and back."""
    stages, ways = [], (("approach", 0, 5), ("sweep 1", 5, 25), ("lift", 25, 0))
    for name, first, last in ways:
        joints = np.zeros((11, len(JOINTS)))
        joints[:, 0] = np.linspace(first, last, 11)
        cuts = np.full(11, name == "sweep 1")
        stages.append(MotionStage(name, np.linspace(0, 4, 11), joints, cuts))
    return Motions(tuple(stages))


def line_mm(joints_rad):
    return np.array([[joints_rad[0], 2.0, 100.0], [joints_rad[0], 2.0, 100.0 + LENGTH_MM]])


class Arms:
    """And the places that were told, piece by piece, table frame."""

    def __init__(self):
        budget = ErrorBudget(margin_mm=8.0, tool_mm=3.0, hand_eye_mm=1.5)
        self.swept = Swept(line_mm, RADIUS_MM, budget)
        self.execution = Execution(motions())
        self.told = []

    def frame(self, seconds=FRAME_S):
        pieces = self.swept.evidence(CAMERA_FROM_TABLE, 7)
        for piece in pieces:
            places = transform_points(np.linalg.inv(CAMERA_FROM_TABLE), np.array(piece.places_mm))
            self.told.append(places)
        self.execution.step(seconds)
        self.swept.update(self.execution, GOOD)
        return pieces

    def until(self, state):
        while self.execution.state != state:
            assert self.execution.state == "sweep 1" or not self.frame()

    @property
    def at_mm(self):
        return self.execution.joints_rad[0]


def test_the_whole_line_is_told_where_the_energised_electrode_was_and_nowhere_else():
    arms = Arms()
    arms.until("sweep 1")
    while not arms.execution.cutting:
        assert not arms.frame()
    first_mm = arms.at_mm
    while arms.execution.cutting:
        last_mm = arms.at_mm
        arms.frame()
    arms.frame()
    while arms.execution.state != "done":
        assert not arms.frame()
    places = np.concatenate(arms.told)
    assert places[:, 0].min() == pytest.approx(first_mm, abs=0.5)
    assert places[:, 0].max() <= last_mm + 1e-9
    x, z = np.meshgrid(np.arange(first_mm, last_mm - 1, 0.5), np.arange(100.0, 170.1, 0.5))
    cut = np.column_stack([x.ravel(), np.full(x.size, 2.0), z.ravel()])
    assert cKDTree(places).query(cut)[0].max() < 1.0  # every place of it, a millimetre apart
    assert cKDTree(cut).query(places)[0].max() < 1.5  # and no other


def test_a_piece_says_when_by_what_and_how_sure():
    arms = Arms()
    while not (pieces := arms.frame()):
        pass
    (piece,) = pieces
    assert isinstance(piece, Cut)
    assert (piece.stamp_ns, piece.tool, piece.kerf_mm) == (7, CUTTER, 2 * RADIUS_MM)
    assert (piece.std_mm, piece.shared_std_mm) == pytest.approx((1.0, 0.5))


def test_what_is_cut_between_two_frames_is_told_whole_and_once():
    arms = Arms()
    arms.until("sweep 1")
    while not arms.execution.cutting:
        arms.frame()
    first_mm = arms.at_mm
    for _ in range(20):  # results without a frame
        arms.execution.step(FRAME_S)
        arms.swept.update(arms.execution, replace(GOOD, estimate=None))
    last_mm = arms.at_mm
    arms.frame()
    (places,) = arms.told
    assert np.ptp(places[:, 0]) == pytest.approx(last_mm - first_mm, abs=1.0)
    while len(arms.told) < 2:
        arms.frame()
    assert arms.told[1][:, 0].min() == places[:, 0].max()  # from there on


def test_an_electrode_that_halts_on_a_cut_cuts_nothing_more():
    arms = Arms()
    arms.until("sweep 1")
    for _ in range(20):
        arms.frame()
    arms.execution.halt(Halt("silent"))
    for _ in range(5):
        arms.frame(seconds=0.5)
    assert arms.execution.cutting
    told = len(arms.told)
    assert not any(arms.frame() for _ in range(5))
    arms.execution.go()
    while len(arms.told) == told:
        arms.frame()
    assert arms.told[told][:, 0].min() == arms.told[told - 1][:, 0].max()


def test_the_line_is_the_electrodes_from_its_tip_on():
    config = CellConfig()
    joints = np.array(config.home_rad)
    ends = electrode_line(cell_urdf(config))(joints)
    tip = ArmCell(config).tips(joints)[CUTTER]
    assert ends[0] == pytest.approx(tip[:3, 3], abs=1e-3)
    assert ends[1] == pytest.approx(tip[:3, 3] - config.electrode_mm * tip[:3, 0], abs=1e-3)
