"""Structures and other tumors from which the electrode keeps a distance, or the plan is none."""

from dataclasses import replace

import numpy as np
import pytest

from cut_objects import swept, to_axes
from plan_objects import RADIUS_MM, TUMOR_MM, located, sphere
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.types import Mesh
from tumortrack_resection.facets import Tools
from tumortrack_resection.resection import plan_resection
from tumortrack_resection.values import UNGUARDED, Located, ResectionConfig, ResectionPlan

MARGIN_MM = 5.0


def beside(off_mm: float) -> Located:
    """With a ball of 1 mm radius in the organ, so far beyond the margin."""
    away = RADIUS_MM + MARGIN_MM + off_mm + 1.0
    ball = sphere(TUMOR_MM + [0.0, away, 0.0], 1.0)
    return replace(located(n=12_000), structures={"artery": ball})


def gap_mm(plan: ResectionPlan, mesh: Mesh) -> float:
    """Of the electrode's surface on all cuts."""
    points = mesh.spread_mm(1.0)  # 5 mm are at most 0.04 mm too long
    return min(to_axes(points, swept(cut)).min() for cut in plan.cuts) - Tools().radius_mm


def unguarded(plan: ResectionPlan) -> list[str]:
    return [note for note in plan.warnings if note.startswith(UNGUARDED)]


@pytest.mark.parametrize("off_mm", [0.0, 3.0, 12.0])
@pytest.mark.parametrize("keep_mm", [1.0, 5.0])
def test_cuts_keep_the_distance_from_a_structure(off_mm, keep_mm):
    """Beside it or beyond it: the piece is another where it lies in the way."""
    seen = beside(off_mm)
    plan = plan_resection(seen, ResectionConfig(keep_away={"artery": keep_mm}))
    assert plan.keep_mm == {"artery": keep_mm}
    assert gap_mm(plan, seen.structures["artery"]) > keep_mm - 0.05
    assert gap_mm(plan, seen.meshes["tumor_1"]) >= MARGIN_MM
    assert not unguarded(plan)


def test_a_distance_that_nobody_asked_for_is_not_kept_and_said():
    seen = beside(2.0)
    free = plan_resection(seen, ResectionConfig())
    alone = plan_resection(replace(seen, structures={}), ResectionConfig())
    assert np.array_equal(free.facets, alone.facets)
    assert gap_mm(free, seen.structures["artery"]) < 3.0
    (note,) = unguarded(free)
    assert "artery" in note
    assert not unguarded(alone)


@pytest.mark.parametrize("method", ["margin", "published"])
def test_what_leaves_the_cuts_as_they_are_changes_nothing(method):
    seen = beside(30.0)
    plans = [
        plan_resection(seen, ResectionConfig(method=method, keep_away=kept))
        for kept in ({}, {"artery": 3.0})
    ]
    for one, other in zip(*(plan.cuts for plan in plans), strict=True):
        assert np.array_equal(one.path_mm, other.path_mm)
    assert [plan.keep_mm for plan in plans] == [{}, {"artery": 3.0}]
    assert [bool(unguarded(plan)) for plan in plans] == [True, False]


def test_a_structure_round_the_tumor_is_no_plan_by_its_name():
    seen = replace(located(n=12_000), structures={"vein": sphere(TUMOR_MM, RADIUS_MM + 5.0)})
    with pytest.raises(NoPlan, match="vein"):
        plan_resection(seen, ResectionConfig(keep_away={"vein": 3.0}))


def test_an_open_structure_keeps_its_distance_too():
    """It crosses the edges between facets."""
    corners = TUMOR_MM + np.array([[-30.0, 22, -30], [30, 22, -30], [30, 22, 30], [-30, 22, 30]])
    sheet = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    seen = replace(located(), structures={"fascia": sheet})
    plan = plan_resection(seen, ResectionConfig(keep_away={"fascia": 1.0}))
    assert gap_mm(plan, sheet) > 1.0 - 0.05


def test_what_cannot_be_kept_away_from_is_refused():
    with pytest.raises(InputError, match=r"--keep-away vein.* artery"):
        plan_resection(beside(2.0), ResectionConfig(keep_away={"vein": 3.0}))
    with pytest.raises(InputError, match=r"--keep-away tumor_2"):
        plan_resection(beside(2.0), ResectionConfig(keep_away={"tumor_2": 3.0}))
    for mm in (0.0, -1.0, 51.0, float("nan")):
        with pytest.raises(InputError, match="keep_away"):
            ResectionConfig(keep_away={"artery": mm})


def test_a_tumor_with_a_surface_and_no_points_is_kept_away_from():
    """As of a tumor that is smaller than the spacing of the cloud's points."""
    seen = located(sphere(TUMOR_MM, RADIUS_MM), n=12_000)
    ball = sphere(TUMOR_MM + [0.0, RADIUS_MM + MARGIN_MM + 6.0, 0.0], 1.0)
    seen = replace(seen, meshes={**seen.meshes, "tumor_2": ball})
    assert seen.tumors == (2, 3)
    plan = plan_resection(seen, ResectionConfig(tumor="tumor_1", keep_away={"tumor_2": 2.0}))
    assert gap_mm(plan, ball) > 2.0 - 0.05
    with pytest.raises(NoPlan):
        plan_resection(seen, ResectionConfig(tumor="tumor_2"))


def test_a_short_electrode_is_named_as_the_reason():
    with pytest.raises(NoPlan, match="electrode"):
        plan_resection(beside(12.0), ResectionConfig(), Tools(electrode_mm=15.0))
