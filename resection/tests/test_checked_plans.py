"""Random organs, tumors and cells: whatever is not refused keeps its distances, by a slow check of
its own as well; and motions that were tampered with are refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cut_objects import beyond, in_box, in_plane, on_axes, swept, to_axes
from plan_objects import located_of, sphere, united
from slow_check import least_mm
from tumortrack.core.errors import NoPlan
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Anatomy, Mesh
from tumortrack_lab.cut import cut as cut_out
from tumortrack_resection.arms.body import cell_urdf
from tumortrack_resection.arms.config import Base, CellConfig
from tumortrack_resection.arms.procedure import plan_motions
from tumortrack_resection.arms.trajectory import first_hit
from tumortrack_resection.budget import foreseen_mm
from tumortrack_resection.check import TOLERANCE_MM, clearances
from tumortrack_resection.checking import checked
from tumortrack_resection.motions import Motions, MotionStage
from tumortrack_resection.resection import plan_resection
from tumortrack_resection.values import Located, ResectionConfig, ResectionPlan, name_of

AGREES_MM = 0.05


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
    parts = [part.moved(part.vertices_mm @ turn.T) for part in parts]
    low = min(float(part.box_mm[0, 2]) for part in parts)
    shift = [draw(between(-30, 30)), draw(between(-30, 30)), 120.0 - low]
    parts = [part.moved(part.vertices_mm + shift) for part in parts]
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
    assume(all(len(located.of(n)) for n in located.tumors))  # none is hidden in the other
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


def keeps(plan: ResectionPlan) -> dict[str, float]:
    return {**dict.fromkeys(plan.taken, plan.margin_mm), **plan.keep_mm}


def plan_keeps_what_it_says(case: Case) -> bool:
    """Without arms: distances along the lines, what they cut, and whether the piece comes away."""
    located, config, tools = case.located, case.config, case.cell.tools
    try:
        plan = plan_resection(located, config, tools)
    except NoPlan:
        return False
    assert len(plan.facets) <= config.most_facets
    assert {name_of(n) for n in located.tumors} == set(keeps(plan))
    foreseen = foreseen_mm(plan, located, tools)
    lines = [swept(cut, tools.electrode_mm) for cut in plan.cuts]
    for name, mm in keeps(plan).items():
        points = located.meshes[name].spread_mm(1.0)
        gap = min(to_axes(points, ends).min() for ends in lines) - tools.radius_mm
        assert gap > mm - TOLERANCE_MM / 2
        assert foreseen[name] == pytest.approx(gap, abs=0.3)
    for number, (ends, plane) in enumerate(zip(lines, plan.facets, strict=True)):
        others = np.delete(plan.facets, number, axis=0)
        assert np.abs(beyond(plane[None], ends.reshape(-1, 3))).max() < 1e-6
        cut = on_axes(ends).reshape(-1, 3)
        cut = cut[in_box(located.organ, cut)]
        cut = cut[contains(located.organ, cut)]
        assert beyond(others, cut).max(initial=0) < 1.5
        wall = in_plane(plane, located.organ)
        wall = wall[in_box(located.organ, wall) & (beyond(others, wall) <= 0).all(1)]
        wall = wall[contains(located.organ, wall)]
        assert to_axes(wall, ends).max(initial=0) < tools.radius_mm
    parts = [located.meshes[name_of(n)] for n in located.tumors]
    done = cut_out(Anatomy((located.organ, *parts)), plan, voxel_mm=0.7)
    assert done.detached
    assert (done.removed_share, done.cut_share, done.hurt) == (1.0, 0.0, ())
    assert (plan.facets[:, :3] @ plan.lift).max() < 0
    return True


def arms_keep_what_was_planned(case: Case) -> bool:
    """Motions pass the check, which agrees with the slow one."""
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
        mesh, carried = case.located.meshes[name], name in plan.taken
        slow = least_mm(urdf, motions, mesh, case.cell.electrode_mm, carried)
        assert found.least_mm[name] == pytest.approx(slow, abs=AGREES_MM)
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


def slowly(motions: Motions, name: str, plan: ResectionPlan, located: Located) -> float:
    mesh, carried = located.meshes[name], name in plan.taken
    return least_mm(URDF, motions, mesh, CELL.electrode_mm, carried)


def test_motions_as_they_were_planned_are_not_refused():
    located, plan, motions = made()
    found = checked(plan, motions, URDF, located)
    for name, mm in keeps(plan).items():
        slow = slowly(motions, name, plan, located)
        assert found.least_mm[name] == pytest.approx(slow, abs=AGREES_MM)
        assert slow >= mm


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_sweep_with_a_joint_off_is_refused_where_the_electrode_comes_nearer(number):
    located, plan, motions = made()
    name = f"sweep {number}"
    (sweep,) = [stage for stage in motions.stages if stage.name == name]
    needs, refused = keeps(plan), 0
    for joint in (0, 1, 4):
        for by_rad in (-0.004, 0.004):
            alone = with_joint(Motions((sweep,)), name, joint, by_rad)
            lacking = [
                mm - slowly(alone, part, plan, located) for part, mm in needs.items()
            ]  # fmt: skip
            if max(lacking) < TOLERANCE_MM + AGREES_MM:
                continue
            refused += 1
            with pytest.raises(NoPlan, match="electrode"):
                checked(plan, with_joint(motions, name, joint, by_rad), URDF, located)
    assert refused >= 2


def test_a_single_sample_off_is_refused():
    """A twitch of 20 ms while it cuts, towards the tumor."""
    located, plan, motions = made()
    sweep = next(stage for stage in motions.stages if stage.name == "sweep 1")
    middle = int(np.flatnonzero(sweep.cutting).mean())
    twitch = np.zeros(len(sweep.times_s))
    twitch[middle] = 0.01
    for joint in (0, 1, 2):
        for sign in (-1, 1):
            odd = with_joint(motions, "sweep 1", joint, sign * twitch)
            near = min(
                slowly(odd, part, plan, located) - mm for part, mm in keeps(plan).items()
            )  # fmt: skip
            if near < -TOLERANCE_MM - AGREES_MM:
                with pytest.raises(NoPlan, match="electrode"):
                    checked(plan, odd, URDF, located)
                return
    raise AssertionError("no joint brings it nearer")


def test_motions_of_another_organ_are_refused():
    """The organ lies 3 mm farther towards where the electrode is."""
    located, plan, motions = made()
    for plane in plan.facets:
        b_from_a = np.eye(4)
        b_from_a[:3, 3] = 3.0 * plane[:3]
        with pytest.raises(NoPlan, match="tumor_1"):
            checked(plan, motions, URDF, located.moved(b_from_a))


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
