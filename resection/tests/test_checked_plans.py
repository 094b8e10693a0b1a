"""Random organs, tumors and cells: whatever is not refused keeps its distances; and motions that
were tampered with are refused."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cut_objects import holds, keeps
from plan_objects import located_of, sphere, united
from refused import refused
from tumortrack.core.errors import NoPlan
from tumortrack.core.types import Mesh
from tumortrack_resection.arms.body import cell_urdf
from tumortrack_resection.arms.config import Base, CellConfig
from tumortrack_resection.arms.procedure import plan_motions
from tumortrack_resection.arms.trajectory import first_hit
from tumortrack_resection.check import TOLERANCE_MM, checked, clearances
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.motions import Motions, MotionStage
from tumortrack_resection.values import Located, ResectionConfig, ResectionPlan


class Case(NamedTuple):
    located: Located
    config: ResectionConfig
    cell: CellConfig

    def __repr__(self) -> str:  # of surfaces it would be thousands of numbers
        boxes = {name: mesh.box_mm.round(1).tolist() for name, mesh in self.located.meshes.items()}
        return f"Case({boxes}, {self.config}, {self.cell})"


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda value: round(value, 3))


@st.composite
def tumors(draw: st.DrawFn, half_mm: np.ndarray, radius_mm: tuple[float, float]) -> Mesh:
    """An ellipsoid or two to three balls, about half outside the organ; finely enough that its
    vertices say where it is."""
    turn, height = draw(between(0, 2 * np.pi)), draw(between(-0.5, 0.95))
    flat = np.sqrt(1 - height**2)
    place = half_mm * [flat * np.cos(turn), flat * np.sin(turn), height]
    place, radius = place * draw(between(0.9, 1.0)), draw(between(*radius_mm))
    lobes = draw(st.integers(0, 2))
    if not lobes:
        return sphere(place, radius * np.array([draw(between(0.8, 1.2)) for _ in range(3)]), 3)
    balls = [sphere(place, 0.9 * radius, 3)]
    for _ in range(lobes):
        off = np.array([draw(between(-0.5, 0.5)) for _ in range(3)])
        balls.append(sphere(place + radius * off, radius * draw(between(0.5, 0.8)), 3))
    return united(*balls)


@st.composite
def cases(draw: st.DrawFn, most_tumors: int = 2, most_facets: int = 6) -> Case:
    half_mm = np.array([draw(between(*of)) for of in ((40, 60), (24, 34), (20, 30))])
    parts = [sphere(np.zeros(3), half_mm, 3), draw(tumors(half_mm, (7, 12)))]
    if draw(st.integers(1, most_tumors)) == 2:
        parts.append(draw(tumors(half_mm, (5, 9))))
    angles = [draw(between(-180, 180)), draw(between(-40, 40)), draw(between(-40, 40))]
    turn = Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
    parts = [part.with_vertices(part.vertices_mm @ turn.T) for part in parts]
    low = min(float(part.box_mm[0, 2]) for part in parts)
    shift = [draw(between(-30, 30)), draw(between(-30, 30)), 120.0 - low]
    parts = [part.with_vertices(part.vertices_mm + shift) for part in parts]
    asked = len(parts) > 2 and draw(st.booleans())
    kept = {"tumor_2": draw(between(1, 6))} if asked else {}
    config = ResectionConfig(
        tumor="tumor_1",
        margin_mm=draw(between(2, 8)),
        most_facets=draw(st.integers(1, most_facets)),
        keep_away=kept,
    )
    off = [draw(between(-60, 60)) for _ in range(4)]
    cell = CellConfig(
        cutter_base=Base(position_mm=(850.0 + off[0], off[1], 100.0), yaw_deg=0.0),
        holder_base=Base(position_mm=(-520.0 + off[2], off[3], 150.0), yaw_deg=180.0),
        electrode_mm=draw(between(50, 90)),
        bend_deg=draw(st.sampled_from([0.0, 0.0, 20.0, 45.0])),
        clearance_mm=draw(between(5, 10)),
        organ_clearance_mm=draw(between(2, 5)),
    )
    located = located_of(*parts, n=8_000)
    assume(all(len(located.points_of(n)) for n in located.tumors))  # none is hidden in the other
    return Case(located, config, cell)


def many(count: int, of: st.SearchStrategy[Case]) -> Callable[[Callable[[Case], bool]], None]:
    """Runs a law on so many cases, the same every time; it says whether there was a plan, and for
    most there has to be one. Failing cases are not made smaller: each takes seconds."""

    def run(law: Callable[[Case], bool]) -> None:
        planned: list[bool] = []

        @given(of)
        @settings(
            max_examples=count,
            deadline=None,
            derandomize=True,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        def every(case: Case) -> None:
            planned.append(law(case))

        every()
        assert len(planned) >= count
        assert sum(planned) > len(planned) / 3

    return run


def plan_keeps_what_it_says(case: Case) -> bool:
    """Without arms."""
    try:
        plan = plan_resection(case.located, case.config, case.cell.tools)
    except NoPlan:
        return False
    holds(plan, case.located, case.config, case.cell.tools)
    return True


def arms_keep_what_was_planned(case: Case) -> bool:
    """Motions pass the check."""
    try:
        plan, motions = plan_motions(*case)
    except NoPlan:
        return False
    urdf = cell_urdf(case.cell)
    assert first_hit(motions, case.cell, case.located.organ) == ""
    found = checked(plan, motions, urdf, case.located)
    assert set(found.least_mm) == set(keeps(plan))
    for name, mm in keeps(plan).items():
        assert found.least_mm[name] >= mm - TOLERANCE_MM
    return True


def test_plans_of_random_organs():
    many(12, cases())(plan_keeps_what_it_says)


@pytest.mark.slow
def test_plans_of_many_random_organs():
    many(24, cases())(plan_keeps_what_it_says)


def test_motions_for_random_organs_and_cells_pass_the_check():
    many(3, cases(most_tumors=1, most_facets=3))(arms_keep_what_was_planned)


@pytest.mark.slow
def test_motions_for_many_random_organs_and_cells_pass_the_check():
    many(3, cases())(arms_keep_what_was_planned)


# Tampered motions ---------------------------------------------------------------------------------

CELL = CellConfig()
URDF = cell_urdf(CELL)


@cache
def made() -> tuple[Located, ResectionPlan, Motions]:
    """Two tumors, which the electrode passes at little more than the margin."""
    middle, half = np.array([0.0, 0.0, 145.0]), np.array([55.0, 30.0, 25.0])
    tumors = sphere([10.0, -27.0, 148.0], 11.0, 3), sphere([-20.0, -21.0, 158.0], 6.0, 3)
    located = located_of(sphere(middle, half, 3), *tumors, n=8_000)
    config = ResectionConfig(tumor="tumor_1", most_facets=3)
    return located, *plan_motions(located, config, CELL)


def with_joint(motions: Motions, stage: str, joint: int, by_rad: np.ndarray | float) -> Motions:
    """All samples of a stage shifted."""

    def shifted(one: MotionStage) -> MotionStage:
        joints = one.joints_rad.copy()
        joints[:, joint] += by_rad
        return replace(one, joints_rad=joints)

    stages = (shifted(one) if one.name == stage else one for one in motions.stages)
    return Motions(tuple(stages))


def test_motions_are_refused_only_where_they_come_too_near():
    located, plan, motions = made()
    found = checked(plan, motions, URDF, located)
    assert all(found.least_mm[name] >= mm for name, mm in keeps(plan).items())
    sweep = next(stage for stage in motions.stages if stage.name == "sweep 1")
    twitch = np.zeros(len(sweep.times_s))  # of 20 ms while it cuts
    twitch[int(np.flatnonzero(sweep.cutting).mean())] = 0.01
    for by_rad in (0.01, twitch):
        refused = 0
        for joint, sign in itertools.product((0, 1, 2), (-1, 1)):
            try:
                checked(plan, with_joint(motions, "sweep 1", joint, sign * by_rad), URDF, located)
            except NoPlan:
                refused += 1
        assert refused >= 2  # a centimetre towards the tumor, by either way


def test_motions_of_another_organ_are_refused():
    """The organ lies 3 mm farther towards where the electrode is."""
    located, plan, motions = made()
    for plane in plan.facets:
        b_from_a = np.eye(4)
        b_from_a[:3, 3] = 3.0 * plane[:3]
        with refused(NoPlan, "tumor_1"):
            checked(plan, motions, URDF, located.transformed(b_from_a))


def test_a_cell_with_another_electrode_is_not_taken_for_this_one():
    """A longer one, of which the motions know nothing, goes where its tip was not planned."""
    located, plan, motions = made()
    longer = cell_urdf(CellConfig(electrode_mm=CELL.electrode_mm + 30.0))
    parts = {name: located.meshes[name] for name in keeps(plan)}
    found = {
        urdf: min(
            one.least_mm - keeps(plan)[one.part]
            for one in clearances(urdf, motions, parts, plan.taken)
            if one.solid == "electrode"
        )
        for urdf in (URDF, longer)
    }
    assert found[URDF] >= 0
    if found[longer] < -TOLERANCE_MM:
        with pytest.raises(NoPlan):
            checked(plan, motions, longer, located)
