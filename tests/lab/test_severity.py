"""Faults in degrees: each as severe as asked, growing from one draw; and their curves."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import render_objects
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.sense.camera import project
from tumortrack.sense.noise import CLEAN, D405_NOISE
from tumortrack.sense.render import render_depth
from tumortrack.simulate.scene_folder import draw_targets
from tumortrack_lab.study.measure import MeasurementSpec
from tumortrack_lab.study.methods import Network, StudyCase, peer_method
from tumortrack_lab.study.plan import FULL, QUICK, Methods, jobs_of, scenes_of
from tumortrack_lab.study.plots import severity_curves
from tumortrack_lab.study.tables import by_seed, levels_of, severities, text, tidy
from tumortrack_lab.twin.faults import (
    FAULTS,
    KINDS,
    MOVED,
    SCALED,
    Severity,
    clean_level,
    disturbed,
    parse,
    scaled,
)
from tumortrack_lab.twin.occluders import hide_share
from tumortrack_lab.twin.views import EquilibriumState, ViewConfig, make_scene

HALF_HEIGHT = 24.0  # of the ellipsoid kidney
TURN = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
BENCH_FROM_CT = rigid(TURN, np.array([0, 0, HALF_HEIGHT]))
SMALL = ViewConfig(width=424, height=240, n_points=3000)


@lru_cache
def clean(report=""):
    case = render_objects.anatomy(4)
    parts = tuple(p.moved(transform_points(BENCH_FROM_CT, p.vertices_mm)) for p in case.parts)
    inner = draw_targets(case, 0)
    targets = transform_points(BENCH_FROM_CT, inner.points_ct)
    about = {"state": "D2"}
    if report:
        about["poke"] = {"tip_mm": [20.0, -4, 40], "axis": [0.0, 0, 1], "radius_mm": 4.0}
    settled = EquilibriumState("D2", type(case)(parts), targets, BENCH_FROM_CT, about)
    scene, camera_mm = make_scene(settled, "D2", "clean", SMALL, 0)
    return replace(scene, targets=inner.at(camera_mm))


def at(name, seed=0):
    return disturbed(clean(), name, seed)


def seen(scene):
    return np.isfinite(scene.depth.depth_mm)


# --- names ---


def test_names_are_read_back_and_faults_keep_theirs():
    for name in (*FULL.severities, *QUICK.severities):
        assert parse(name).name == name
    assert {parse(name).kind for name in FULL.severities} == set(KINDS)
    assert all(parse(fault) is None for fault in FAULTS)
    assert parse("noise=0.50") == Severity("noise", 0.5)
    for bad, words in (
        ("fog=2", "'fog' is not known"),
        ("noise=loud", "no number"),
        ("visible=5", "10 to 100"),
        ("tilt=nan", "0 to 75"),
    ):
        with pytest.raises(InputError, match=words):
            parse(bad)


def test_a_level_without_fault_is_the_clean_scene():
    for name in ("noise=0", "visible=100", "outliers=0", "points=5000", "offset=0", "tilt=0"):
        assert at(name) is clean()
    assert not any(clean_level(s.kind) == s.level for s in map(parse, FULL.severities))
    with pytest.raises(InputError, match="clean scenes of the twin"):
        disturbed(at("offset=2"), "noise=2", 0)


@pytest.mark.parametrize("name", ["noise=2", "visible=60", "outliers=10", "points=700", "tilt=30"])
def test_severities_replay_and_other_seeds_differ(name):
    one, again, other = at(name), at(name), at(name, 1)
    np.testing.assert_array_equal(one.cloud.points_mm, again.cloud.points_mm)
    np.testing.assert_array_equal(one.depth.depth_mm, again.depth.depth_mm)
    assert one.meta == again.meta
    assert (one.meta["fault"], one.meta["fault_seed"]) == (name, 0)
    assert not np.array_equal(one.cloud.points_mm, other.cloud.points_mm)


# --- the sensor ---


def test_noise_grows_with_its_factor():
    assert scaled(D405_NOISE, 1.0) == D405_NOISE
    nothing = scaled(D405_NOISE, 0.0)
    assert all(getattr(nothing, name) == 0 for name in SCALED)
    assert nothing.quantum_mm == D405_NOISE.quantum_mm
    four = scaled(D405_NOISE, 4.0)
    assert (four.axial_mm, four.hole_share, four.grazing_share) == (0.8, 0.08, 1.0)
    # Nothing with an amplitude is forgotten: what is left of the model is lengths and the unit.
    kept = {n for n in D405_NOISE.__struct_fields__ if getattr(nothing, n) != getattr(CLEAN, n)}
    assert kept == {"quantum_mm", "correlated_share"}
    errors = []
    before = clean().depth.depth_mm
    for level in (0.5, 1, 2, 4):
        after = at(f"noise={level}").depth.depth_mm
        both = np.isfinite(after) & seen(clean())
        errors.append(np.median(np.abs(after - before)[both]))
    assert np.all(np.diff(errors) > 0)
    assert 5 < errors[3] / errors[0] < 11  # eightfold, but for steps of 0.1 mm


def test_an_offset_is_the_same_everywhere():
    moved = at("offset=4")
    gap = (clean().depth.depth_mm - moved.depth.depth_mm)[seen(clean())]
    np.testing.assert_allclose(gap, 4, atol=1e-4)
    assert moved.reference is clean().reference


@pytest.mark.parametrize("count", [500, 1000, 2000])
def test_a_thinner_cloud_is_part_of_the_clean_one(count):
    thin = at(f"points={count}").cloud.points_mm
    assert len(np.unique(thin, axis=0)) == count
    assert set(map(tuple, thin.tolist())) <= set(map(tuple, clean().cloud.points_mm.tolist()))


@pytest.mark.parametrize("percent", [1, 10, 20])
def test_outliers_have_their_share_and_hide_nothing(percent):
    more = at(f"outliers={percent}")
    assert (seen(more) >= seen(clean())).all()
    assert 1 - seen(clean()).sum() / seen(more).sum() == pytest.approx(percent / 100, abs=2e-3)


# --- what hides the organ ---


@pytest.mark.parametrize("seed", range(5))
def test_what_is_visible_is_what_was_asked(seed):
    total, before = seen(clean()).sum(), seen(clean())
    for level in (80, 60, 40, 20):
        hidden = at(f"visible={level}", seed)
        assert seen(hidden).sum() / total == pytest.approx(level / 100, abs=0.01)
        np.testing.assert_array_equal(
            hidden.depth.depth_mm[seen(hidden)], clean().depth.depth_mm[seen(hidden)]
        )
        # The same things reach farther: hardly anything comes back into view.
        back = seen(hidden) & ~before
        assert back.sum() < 0.03 * total
        before = seen(hidden)


def test_shafts_lumps_and_drapes_take_part_and_come_from_any_side():
    depth = clean().depth
    middles = []
    for seed in range(12):
        half = hide_share(depth, 0.5, 4.0, np.random.default_rng(seed))
        lost = np.isfinite(depth.depth_mm) & np.isnan(half.depth_mm)
        assert lost.sum() / np.isfinite(depth.depth_mm).sum() == pytest.approx(0.5, abs=0.01)
        row, column = np.nonzero(lost)
        middles.append([column.mean() - 211.5, row.mean() - 119.5])
    right, down = np.array(middles).T
    assert right.min() < -5 < 5 < right.max()
    assert down.min() < -2 < 2 < down.max()
    with pytest.raises(InputError, match=r"0 to 0\.9"):
        hide_share(depth, 0.95, 4.0, np.random.default_rng(0))
    empty = type(depth)(np.full_like(depth.depth_mm, np.nan), depth.intrinsics)
    with pytest.raises(InputError, match="no return"):
        hide_share(empty, 0.5, 4.0, np.random.default_rng(0))


# --- another camera ---


@pytest.mark.parametrize("distance", [80, 200, 300])
def test_distance_is_to_the_nearest_point(distance):
    far = at(f"distance={distance}")
    assert far.reference.organ.vertices_mm[:, 2].min() == pytest.approx(distance)
    assert np.nanmin(far.depth.depth_mm) == pytest.approx(distance, abs=0.2)
    shift = far.reference.organ.vertices_mm - clean().reference.organ.vertices_mm
    assert np.ptp(shift, axis=0).max() < 1e-9


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_tilt_turns_truth_targets_and_image_together(seed):
    tilted = at("tilt=45", seed)
    moved = np.array(tilted.meta[MOVED])
    turn = moved[:3, :3]
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(45)
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    assert axis[2] == pytest.approx(0, abs=1e-12)  # in the image plane
    centre = clean().reference.organ.box_mm.mean(0)
    np.testing.assert_allclose(transform_points(moved, centre[None])[0], centre)
    for before, after in zip(clean().reference.parts, tilted.reference.parts, strict=True):
        np.testing.assert_allclose(transform_points(moved, before.vertices_mm), after.vertices_mm)
    targets = tilted.targets
    np.testing.assert_allclose(
        transform_points(np.linalg.inv(moved), targets.points_mm), clean().targets.points_mm
    )
    np.testing.assert_array_equal(targets.points_ct, clean().targets.points_ct)
    # The CT still lies where the truth does (nothing is deformed here), and the cloud on it.
    camera_from_ct = np.array(tilted.meta["camera_from_ct"])
    organ = render_objects.anatomy(4).organ
    np.testing.assert_allclose(
        transform_points(camera_from_ct, organ.vertices_mm), tilted.reference.organ.vertices_mm
    )
    points = tilted.cloud.points_mm[:60].astype(float)
    hits = render_objects.ray_hits(np.zeros(3), points, tilted.reference.organ, slack=1e-4)
    np.testing.assert_allclose(hits.min(1), 1, atol=1e-4)
    pixels, _ = project(points, tilted.depth.intrinsics)
    np.testing.assert_allclose(pixels, np.rint(pixels), atol=1e-3)


def test_an_unmoved_camera_sees_the_clean_image():
    """What is rendered again is what the twin rendered."""
    organ = clean().reference.organ
    again = render_depth(organ.vertices_mm, organ.faces, clean().depth.intrinsics)
    np.testing.assert_array_equal(again.depth_mm, clean().depth.depth_mm)
    nearest = float(organ.vertices_mm[:, 2].min())
    np.testing.assert_allclose(at(f"distance={nearest!r}").depth.depth_mm, again.depth_mm)


def test_a_rod_in_view_cannot_be_seen_from_elsewhere():
    with pytest.raises(InputError, match="rod in view"):
        disturbed(clean("P1"), "tilt=30", 0)
    assert seen(disturbed(clean("P1"), "offset=2", 0)).any()


# --- the study ---


def measurement(fault, draw, error_mm, variant="D2", seed=0, method="M_lim", target=None):
    """A measurement; ``error_mm`` None: tumor 2 was not found."""
    part = {"found": True, "iou": 0.5}
    keys = ("hausdorff_mm", "hausdorff_one_sided_mm", "center_mm")
    first = {**part, **dict.fromkeys(keys, 1.5)}
    lost = {"found": False, "iou": 0.0}
    second = lost if error_mm is None else {**part, **dict.fromkeys(keys, error_mm)}
    return {
        "spec": {
            "case": "x", "scene": f"{variant}-clean", "variant": variant, "view": "clean",
            "fault": fault, "fault_seed": draw,
            "method": {"name": method, "seed": seed},
        },
        "parts": {"kidney": part, "tumor_1": first, "tumor_2": second},
        "miou": 0.5,
        "failed": "not found: tumor_2" if error_mm is None else None,
        "targets_mm": target and {"mean": target},
    }  # fmt: skip


MEASUREMENTS = [
    measurement("clean", 0, 1.0),
    measurement("clean", 0, 3.0, "G1"),
    *(measurement("visible=40", n, error) for n, error in enumerate((4.0, 10.0, 40.0))),
    *(measurement("noise=2", n, error) for n, error in enumerate((None, None, 7.0))),
    measurement("distance=200", 0, 2.5),
    measurement("clean", 0, 2.0, method="rigid", target=2.2),
    measurement("visible=40", 0, 20.0, method="rigid", target=8.8),
]


def test_curves_begin_at_the_clean_scene():
    frame = tidy(MEASUREMENTS)
    mine = frame[frame.method == "M_lim"]

    def curve(kind):
        return [
            (at, text(by_seed(here[here.part == "tumor_2"], "hausdorff_mm")))
            for at, here in levels_of(mine, kind)
        ]

    assert curve("visible") == [(100.0, "2.0"), (40.0, "10.0")]
    assert curve("distance") == [(200.0, "2.5")]
    assert curve("noise") == [(0.0, "2.0"), (2.0, "not found")]
    assert curve("tilt") == []


def test_the_table_has_a_row_for_every_level():
    rows = [
        [one.strip() for one in line.strip("|").split("|")]
        for line in severities(tidy(MEASUREMENTS)).splitlines()[2:]
    ]
    assert len(rows) == 2 + 2 + 1 + 2
    first, second = rows[0], rows[1]
    slim = "slim network, limited turns"
    assert first[:3] == [slim, "sensor noise, times the D405's", "0"]
    assert first[3:9] == ["1.5", "1.5", "1.5", "2.0", "2.0", "2.0"]
    assert second[:3] == ["", "", "2"]
    assert second[-1] == "2 of 3"
    assert [row[:3] for row in rows[2:4]] == [
        [slim, "visible surface left, %", "100"],
        ["", "", "40"],
    ]
    rigid_rows = rows[-2:]
    assert [row[-3] for row in rigid_rows] == ["2.2", "8.8"]
    assert first[-3] == "–"


def test_the_picture_is_drawn_even_where_nothing_was_found(tmp_path):
    path = tmp_path / "severity.png"
    severity_curves(tidy(MEASUREMENTS), path)
    assert path.stat().st_size > 10_000
    lost = [measurement("clean", 0, None), measurement("tilt=30", 0, None)]
    severity_curves(tidy(lost), path)
    assert path.stat().st_size > 5_000


def test_the_plan_measures_each_level_once_beside_one_clean_scene(tmp_path):
    case = StudyCase("x", tmp_path, tmp_path, render_objects.anatomy(2), (0.0, -1.0, 0.0), True)
    made = []

    def model(*given):
        made.append(given[1:])
        return Network(given[1], tmp_path)

    def peer(name, case):
        made.append((name,))
        return peer_method(name, case)

    jobs = jobs_of(FULL, "severity", (case,), Methods(model, peer, model))
    per_method = 2 * (1 + 3 * len(FULL.severities))
    assert len(jobs) == 3 * per_method
    assert sorted(made) == [("M_lim", 0), ("clinic", 0), ("rigid",)]
    assert len({(id(j.method), j.variant, j.fault, j.fault_seed) for j in jobs}) == len(jobs)
    assert {job.view for job in jobs} == {"clean"}
    assert scenes_of(FULL, "severity", case) == (("D2", "G1"), ("clean",))


def test_earlier_measurements_keep_their_names():
    """Recorded before there were severities."""
    spec = MeasurementSpec(
        case="c", case_sha256="a", scene="D2-clean", scene_sha256="b", variant="D2", view="clean",
        method={"name": "M_lim", "seed": 0}, grid=160, fault="noise", fault_seed=1,
    )  # fmt: skip
    assert spec.digest.startswith("b6bcbc79cc21a8c4")
