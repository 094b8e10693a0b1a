"""Plans made on estimates cut the truth, and what the tables say of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import stress
import trimesh
from stress import Planner, cut_one, exophytic, tables_of, truth

from reports import bounded
from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.io.scene_folder import Scene
from tumortrack.registration.frame import estimate_of
from tumortrack_benchmarks.physics.cut import cut
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.located import of_estimate
from tumortrack_resection.values import ResectionConfig

CAMERA_FROM_TABLE = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 150.0]))
FAR_MM = 15.0  # so far off, the electrode goes through the tumor


def ball(radius_mm, center_mm, semi_axes=(1, 1, 1)):
    solid = trimesh.creation.icosphere(4, radius_mm)
    return Mesh(solid.vertices * np.array(semi_axes) + np.array(center_mm), solid.faces)


def kidney():
    """Table frame: one tumor of 8 mm, half sunk into the top; one of 4 mm, deep inside."""
    organ, tumor = ball(1, (0, 0, 30), (50, 30, 24)), ball(8, (0, 0, 54))
    whole = mesh_of(solid_of(organ, "organ") + solid_of(tumor, "tumor"))
    return Anatomy((whole, tumor, ball(4, (-38, 0, 27))))


def transformed(anatomy, b_from_a):
    parts = (
        part.with_vertices(transform_points(b_from_a, part.vertices_mm)) for part in anatomy.parts
    )
    return Anatomy(tuple(parts))


def located_as_it_is(anatomy):
    return of_estimate(truth(Scene(SensorCloud(np.ones((1, 3), np.float32)), anatomy)))


def test_a_plan_on_the_truth_takes_the_tumor_with_the_margin_that_was_asked_for():
    true = kidney()
    for margin_mm in (3.0, 7.0):
        config = ResectionConfig(tumor="tumor_1", margin_mm=margin_mm)
        plan = plan_resection(located_as_it_is(true), config)
        result = cut(true, plan)
        assert result.detached
        assert result.removed_share == 1.0
        assert margin_mm - 0.2 < result.margin_mm < margin_mm + 0.5
        assert result.hurt == ()
        assert result.piece_ml == pytest.approx(plan.volumes_ml["piece"], rel=0.05)
        assert result.kerf_ml == pytest.approx(plan.volumes_ml["kerf"], rel=0.2)


def shifted(shift_mm=0.0, bound_mm=None):
    """Answers the truth, shifted along the table's x; with a bound of tumor_1, if there is one."""

    def locate(scene):
        parts = (p.with_vertices(p.vertices_mm + [shift_mm, 0, 0]) for p in scene.reference.parts)
        meshes = dict(zip(scene.reference.names, parts, strict=True))
        estimate = stress.scattered(estimate_of(meshes, 64))
        return estimate if bound_mm is None else bounded(estimate, tumor_1=bound_mm)

    return locate


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    true = transformed(kidney(), CAMERA_FROM_TABLE)
    cloud = SensorCloud(true.organ.vertices_mm[true.organ.vertices_mm[:, 2] < 120])
    folder = tmp_path_factory.mktemp("cutting") / "scene"
    Scene(cloud, true, None, {"camera_from_bench": CAMERA_FROM_TABLE.tolist()}).write(folder)
    return folder


def cuts(scene, locate):
    """What each planner's plan did, for the one exophytic tumor."""
    tumors = exophytic(kidney())
    assert tumors == ["tumor_1"]
    return {row["planner"]: row for row in cut_one(scene, tumors, locate)}


def test_an_estimate_that_is_off_costs_up_to_as_much_margin(scene):
    """As much where a facet lies across the shift; most lie askew."""
    here, off, far = (cuts(scene, shifted(mm))["5 mm"] for mm in (0.0, 3.0, FAR_MM))
    assert here["removed_share"] == off["removed_share"] == 1.0
    assert here["margin_mm"] == pytest.approx(5.0, abs=0.3)
    assert 5.0 - 3.0 - 0.3 < off["margin_mm"] < 5.0 - 0.6
    assert 5.0 - FAR_MM - 0.3 < far["margin_mm"] < 0
    assert far["removed_share"] < 0.97
    assert far["cut_share"] > 0.02
    assert far["left_ml"] == pytest.approx(
        far["tumor_ml"] * (1 - far["removed_share"] - far["cut_share"]), abs=1e-9
    )


def test_a_margin_with_the_errors_pays_for_an_estimate_that_is_as_far_off(scene):
    """3 mm of it, with 2 mm of hand-eye, 3 of tool and 2 of motion as nobody states them."""
    rows = [*cut_one(scene, ["tumor_1"], shifted(3.0, bound_mm=3.0))]
    assert all(row["good"] for row in rows)
    assert [row["planner"] for row in rows] == ["5 mm", "5 mm + errors"]
    plain_mm, with_errors_mm = (row["margin_mm"] for row in rows)
    others_mm = 2.0 + np.hypot(3.0, np.hypot(2, 3))
    for kept_mm, asked_mm in (plain_mm, 5.0), (with_errors_mm, 5.0 + others_mm):
        assert asked_mm - 3.0 - 0.3 < kept_mm < asked_mm + 0.3
    assert plain_mm < 5.0 - 0.6
    assert rows[1]["healthy_ml"] > rows[0]["healthy_ml"] + 0.2
    cuts, _ = tables_of([{"case": "balls", "method": "model", **row} for row in rows])
    assert list(cuts["as asked %"]) == ["0.0 (0.0 to 97.5)", "100.0 (2.5 to 100.0)"]
    assert not cuts[["cut into it", "into another tumor"]].to_numpy().any()


def test_only_what_states_a_bound_is_planned_on_with_errors_and_no_margin_is_too_wide(scene):
    assert list(cuts(scene, shifted())) == ["5 mm"]
    located = replace(located_as_it_is(kidney()), bounds_mm={"tumor_1": 25.0})
    assert Planner(with_errors=True).tried(located, "tumor_1").margin_mm == 20.0


def test_tables_say_what_was_removed_and_why_not(scene):
    def nothing(scene):
        raise NoEstimate("the cloud shows no organ")

    methods = {"truth": truth, "model": shifted(FAR_MM), "blind": nothing}
    rows = [
        {"case": "balls", "method": name, **row}
        for name, locate in methods.items()
        for row in cut_one(scene, ["tumor_1"], locate)
    ]
    found, refused = tables_of(rows)
    known = found.set_index(["located by", "planner"]).T
    counts = ["asked", "plans", "free", "whole"]
    best = known["truth", "5 mm"]
    assert list(best[[*counts, "removed worst %", "left worst ml"]]) == [1] * 4 + ["100.0", "0.00"]
    assert list(known["model", "5 mm"][counts]) == [1, 1, 1, 0]
    assert list(known["blind", "5 mm"][[*counts, "worst mm"]]) == [1, 0, 0, 0, "–"]
    assert ("blind", "5 mm", "the cloud shows no organ", 1) in refused.itertuples(index=False)


def test_shares_are_never_rounded_to_all_or_none(scene):
    made = {"case": "balls", "method": "truth", **cuts(scene, truth)["5 mm"]}
    made |= {"removed_share": 0.99996, "cut_share": 0.00004}
    found, _ = tables_of([made | {"kerf_area_mm2": 1230.0, "kerf_ml": 2.5}])
    shares = ["removed median %", "removed worst %", "cut worst %"]
    assert list(found[shares].iloc[0]) == ["99.9", "99.9", "0.1"]
    wound = ["of that in kerfs mean ml", "kerf area mean cm2"]
    assert list(found[wound].iloc[0]) == ["2.5", "12.3"]
