"""Plans made on estimates cut the truth: kept, and what the tables say of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from reports import bounded
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.cut import cut
from tumortrack_lab.peers.base import Fit, estimate_of, rigid_carry
from tumortrack_lab.study.measure import measured
from tumortrack_lab.study.methods import Method, StudyCase
from tumortrack_lab.study.resection import (
    PLANNERS,
    Planner,
    cut_one,
    cutting,
    scattered,
    summary,
    tables_of,
    tidy_plans,
    truth,
)
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.located import of_estimate
from tumortrack_resection.values import ResectionConfig

CAMERA_FROM_TABLE = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 150.0]))
OURS = Planner()
FAR_MM = 15.0  # so far off, the electrode goes through the tumor


def ball(radius_mm, center_mm, semi_axes=(1, 1, 1)):
    solid = trimesh.creation.icosphere(4, radius_mm)
    return Mesh(solid.vertices * np.array(semi_axes) + np.array(center_mm), solid.faces)


def kidney():
    """Table frame: one tumor of 8 mm, half sunk into the top; one of 4 mm, deep inside."""
    organ, tumor = ball(1, (0, 0, 30), (50, 30, 24)), ball(8, (0, 0, 54))
    whole = mesh_of(solid_of(organ, "organ") + solid_of(tumor, "tumor"))
    return Anatomy((whole, tumor, ball(4, (-38, 0, 27))))


def moved(anatomy, b_from_a):
    parts = (part.moved(transform_points(b_from_a, part.vertices_mm)) for part in anatomy.parts)
    return Anatomy(tuple(parts))


def located_as_it_is(anatomy):
    return of_estimate(scattered(estimate_of(Fit(lambda points: points), anatomy)))


def test_a_plan_on_the_truth_takes_the_tumor_with_the_margin_that_was_asked_for():
    truth = kidney()
    for margin_mm in (3.0, 7.0):
        config = ResectionConfig(tumor="tumor_1", margin_mm=margin_mm)
        plan = plan_resection(located_as_it_is(truth), config)
        result = cut(truth, plan)
        assert result.detached
        assert result.removed_share == 1.0
        assert margin_mm - 0.2 < result.margin_mm < margin_mm + 0.5
        assert result.hurt == ()
        assert result.piece_ml == pytest.approx(plan.volumes_ml["piece"], rel=0.05)
        assert result.kerf_ml == pytest.approx(plan.volumes_ml["kerf"], rel=0.2)


def shifted(shift_mm=0.0, bound_mm=None, nothing=False, name="clinic", calls=None):
    """Answers the truth, shifted along the table's x; good, with a bound of tumor_1, if it is told
    one."""

    def locate(scene, grid):
        if calls is not None:
            calls.append("asked")
        if nothing:
            raise NoEstimate("the cloud shows no organ")
        carry = rigid_carry(rigid(np.eye(3), np.array([shift_mm, 0.0, 0.0])))
        estimate = scattered(estimate_of(Fit(carry), scene.reference, grid=grid))
        return estimate if bound_mm is None else bounded(estimate, tumor_1=bound_mm)

    return Method(name, {"shift_mm": shift_mm}, locate)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    root = tmp_path_factory.mktemp("cutting")
    (root / "case").mkdir()
    store.write_json(root / "case" / store.MANIFEST, {"kind": "case"})
    truth = moved(kidney(), CAMERA_FROM_TABLE)
    cloud = SensorCloud(truth.organ.vertices_mm[truth.organ.vertices_mm[:, 2] < 120])
    for variant in ("D0", "D1"):
        meta = {"camera_from_bench": CAMERA_FROM_TABLE.tolist()}
        Scene(cloud, truth, None, meta).write(root / "scenes" / f"{variant}-noise")
    Scene(cloud, truth).write(root / "scenes" / "G1-noise")
    return StudyCase("balls", root / "case", root / "scenes", kidney(), (0.0, 0.0, 1.0))


def cuts(case, method, variant="D0"):
    """What each planner's plan did, for the one exophytic tumor."""
    rows = cut_one(case, method, variant, "noise", 64)
    assert {row["tumor"] for row in rows} == {"tumor_1"}
    return {row["planner"]: row for row in rows}


def test_an_estimate_that_is_off_costs_up_to_as_much_margin(case):
    """As much where a facet lies across the shift; most lie askew."""
    here, off, far = (cuts(case, shifted(shift_mm=mm))[OURS.name] for mm in (0.0, 3.0, FAR_MM))
    assert here["removed_share"] == off["removed_share"] == 1.0
    assert here["margin_mm"] == pytest.approx(5.0, abs=0.3)
    assert 5.0 - 3.0 - 0.3 < off["margin_mm"] < 5.0 - 0.6
    assert 5.0 - FAR_MM - 0.3 < far["margin_mm"] < 0
    assert far["removed_share"] < 0.97
    assert far["cut_share"] > 0.02
    assert far["left_ml"] == pytest.approx(
        far["tumor_ml"] * (1 - far["removed_share"] - far["cut_share"]), abs=1e-9
    )


def test_a_margin_with_the_errors_pays_for_an_estimate_that_is_as_far_off(case):
    """3 mm of it, with 2 mm of hand-eye, 3 of tool and 2 of motion as nobody states them."""
    rows = cut_one(case, shifted(shift_mm=3.0, bound_mm=3.0), "D0", "noise", 64)
    assert all(row["good"] for row in rows)
    assert [row["planner"] for row in rows] == ["5 mm", "5 mm + errors"]
    plain_mm, with_errors_mm = (row["margin_mm"] for row in rows)
    others_mm = 2.0 + np.hypot(3.0, np.hypot(2, 3))
    for kept_mm, asked_mm in (plain_mm, 5.0), (with_errors_mm, 5.0 + others_mm):
        assert asked_mm - 3.0 - 0.3 < kept_mm < asked_mm + 0.3
    assert plain_mm < 5.0 - 0.6
    assert rows[1]["healthy_ml"] > rows[0]["healthy_ml"] + 0.2
    cuts, _ = tables_of([{"case": "balls", "method": "clinic", **row} for row in rows])
    assert list(cuts["as asked %"]) == ["0.0 (0.0 to 97.5)", "100.0 (2.5 to 100.0)"]
    assert not cuts[["cut into it", "into another tumor"]].to_numpy().any()


def test_only_what_states_a_bound_is_planned_on_with_errors(case):
    assert list(cuts(case, shifted())) == [OURS.name]


def test_no_margin_is_wider_than_allowed(case):
    located = replace(located_as_it_is(kidney()), bounds_mm={"tumor_1": 25.0})
    plan = Planner(with_errors=True).tried(located, "tumor_1")
    assert plan.margin_mm == 20.0


def test_plans_are_measured_once_and_apart_from_accuracy(case, tmp_path):
    calls = []
    about = case, shifted(calls=calls), ("D0", "D1"), "noise", 64, tmp_path
    first = measured(*about, cut_one, **cutting())
    assert len(calls) == 2
    assert measured(*about, cut_one, **cutting()) == first
    assert len(calls) == 2
    measured(*about, cut_one, cutting="by other rules")
    assert len(calls) == 4


def test_a_scene_without_a_table_is_refused(case):
    with pytest.raises(InputError, match="where its table is"):
        cut_one(case, truth(), "G1", "noise", 64)


def test_tables_say_what_was_removed_and_why_not(case, tmp_path):
    methods = (truth(), shifted(shift_mm=FAR_MM), shifted(nothing=True, name="M_lim"))
    found = [
        row
        for method in methods
        for row in measured(case, method, ("D0",), "noise", 64, tmp_path, cut_one, **cutting())
    ]
    assert [
        group for group, _ in tidy_plans(found).groupby(["method", "planner"], observed=True)
    ] == [
        (name, planner.name)
        for name in ("clinic", "M_lim", "truth")
        for planner in (PLANNERS if name == "M_lim" else (OURS,))
    ]
    cuts, refused = tables_of(found)
    known = cuts.set_index(["located by", "planner"]).T
    counts = ["asked", "plans", "free", "whole"]
    best = known["truth", "5 mm"]
    assert list(best[[*counts, "removed worst %", "left worst ml"]]) == [
        1,
        1,
        1,
        1,
        "100.0",
        "0.00",
    ]
    assert list(known["clinic", "5 mm"][counts]) == [1, 1, 1, 0]
    assert list(known["M_lim", "5 mm"][[*counts, "worst mm"]]) == [1, 0, 0, 0, "–"]
    assert ("M_lim", "5 mm", "the cloud shows no organ", 1) in refused.itertuples(index=False)
    assert "| truth | 5 mm | 1 | 1 |" in summary(cuts)


def test_shares_are_never_rounded_to_all_or_none(case):
    known = {"case": "balls", "method": "truth"}
    (row,) = [r for r in cut_one(case, truth(), "D0", "noise", 64) if r["planner"] == OURS.name]
    made = {**known, **row, "removed_share": 0.99996, "cut_share": 0.00004}
    cuts, _ = tables_of([made | {"kerf_area_mm2": 1230.0, "kerf_ml": 2.5}])
    shares = ["removed median %", "removed worst %", "cut worst %"]
    assert list(cuts[shares].iloc[0]) == ["99.9", "99.9", "0.1"]
    wound = ["of that in kerfs mean ml", "kerf area mean cm2"]
    assert list(cuts[wound].iloc[0]) == ["2.5", "12.3"]
