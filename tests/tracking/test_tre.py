"""Target registration error: targets in scenes, the figure in reports."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from motions import Wave
from one_way import OneWay
from refused import refused
from report_objects import ball
from stories import succeeded, tumortrack, write_phantom_case
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import labels_of
from tumortrack.core.report import FitReport
from tumortrack.core.types import (
    Anatomy,
    CameraLabels,
    OccupancyCloud,
    SensorCloud,
)
from tumortrack.io.case import load_case
from tumortrack.io.scene_folder import Scene, Targets, draw_targets, read_scene, read_targets
from tumortrack.report.metrics import label_grid, target_errors
from tumortrack.report.protocol import evaluate_scene, evaluate_scenes
from tumortrack.report.summary import headlines, summarise, target_text
from tumortrack.simulation.scene import SceneRecipe
from tumortrack_devices.sources.virtual import VirtualSourceConfig


def anatomy_ct():
    return Anatomy((ball(22), ball(7, (6, 3, -2))))


def truth():
    return Anatomy(
        tuple(p.with_vertices(Wave().forward(p.vertices_mm)) for p in anatomy_ct().parts)
    )


def scene(with_targets=True):
    inner = draw_targets(anatomy_ct(), 0)
    targets = inner.at(Wave().forward(inner.points_ct)) if with_targets else None
    return Scene(SensorCloud(truth().organ.vertices_mm), truth(), targets=targets)


def estimate(motion):
    """The truth, with this motion."""
    camera_from_index = np.eye(4)
    camera_from_index[:3, 3] = truth().organ.box_mm[0] - 2
    labels = label_grid(truth(), camera_from_index, (56, 56, 56))
    points_mm = np.argwhere(labels) + camera_from_index[:3, 3]
    meshes = dict(zip(truth().names, truth().parts, strict=True))
    cloud = OccupancyCloud(points_mm, labels[labels > 0], np.ones(len(points_mm)))
    return Estimate(cloud, CameraLabels(labels, camera_from_index), meshes, FitReport(), motion)


def shifted(distance_mm):
    return OneWay(lambda points: Wave().forward(points) + [0.0, distance_mm, 0.0])


# --- the figure ---


def test_known_errors_give_known_figures():
    ct = np.zeros((100, 3))
    targets = Targets(ct, ct, np.ones(100, np.uint8))
    errors = np.arange(1.0, 101.0)
    motion = OneWay(lambda points: points + errors[:, None] * [0.6, 0.0, 0.8])
    found = target_errors(motion.forward(ct), targets)
    assert found["mean"] == pytest.approx(50.5)
    assert found["median"] == pytest.approx(50.5)
    assert found["rms"] == pytest.approx(np.sqrt(101 * 201 / 6))
    assert found["p95"] == pytest.approx(95.05)
    assert found["max"] == pytest.approx(100)
    assert (found["count"], found["max_label"]) == (100, 1)
    assert found["each"] == errors.tolist()


def test_the_true_motion_has_no_error_and_a_rigid_one_has_the_waves():
    targets = scene().targets
    assert target_errors(Wave().forward(targets.points_ct), targets)["max"] < 1e-9
    rigid = target_errors(Wave(height_mm=0.0).forward(targets.points_ct), targets)
    wave = 5 * np.abs(np.sin(targets.points_ct @ [0.02, 0.05, 0.01]))
    assert rigid["max"] == pytest.approx(wave.max())
    assert rigid["mean"] == pytest.approx(wave.mean())


# --- scenes hold targets ---


@pytest.mark.parametrize("seed", [-1, 2**32, 10**30])
def test_a_seed_of_more_than_32_bits_is_refused(seed):
    for use in (
        lambda: draw_targets(anatomy_ct(), seed),
        lambda: SceneRecipe(seed, "test", 0),
        lambda: FollowOptions(seed=seed),
        lambda: VirtualSourceConfig(case=Path("case"), seed=seed),
    ):
        with refused(InputError, str(seed)):
            use()
    assert len(draw_targets(anatomy_ct(), 2**32 - 1).points_ct)


def test_targets_come_back_from_a_scenes_folder(tmp_path):
    made = scene()
    made.write(tmp_path / "scene")
    back = read_scene(tmp_path / "scene").targets
    np.testing.assert_allclose(back.points_ct, made.targets.points_ct, atol=6e-6)
    np.testing.assert_allclose(back.points_mm, made.targets.points_mm, atol=6e-6)
    np.testing.assert_array_equal(back.labels, made.targets.labels)
    assert np.bincount(back.labels).tolist() == [0, 100, 100]
    scene(with_targets=False).write(tmp_path / "without")
    assert read_scene(tmp_path / "without").targets is None


HEAD = "label,ct_x,ct_y,ct_z,camera_x,camera_y,camera_z\n"


def test_targets_of_other_programs_are_read(tmp_path):
    path = tmp_path / "targets.csv"
    path.write_text("name,camera_z,camera_y,camera_x,ct_z,ct_y,ct_x,label\na,6,5,4,3,2,1,2\n")
    found = read_targets(path)
    np.testing.assert_array_equal(found.points_ct, [[1, 2, 3]])
    np.testing.assert_array_equal(found.points_mm, [[4, 5, 6]])
    assert found.labels.tolist() == [2]


@pytest.mark.parametrize(
    "text",
    [
        "",
        HEAD,
        "label,x,y,z\n1,2,3,4\n",
        HEAD + "1,2,3,4,5,6\n",
        HEAD + "1,2,3,4,5,6,nan\n",
        HEAD + "1,2,3,4,5,6,seven\n",
        *(f"{HEAD}{label},2,3,4,5,6,7\n" for label in ("0", "1.5", "-1", "300")),
    ],
)
def test_broken_targets_are_refused_with_their_scene(tmp_path, text):
    scene(with_targets=False).write(tmp_path / "scene")
    (tmp_path / "scene" / "targets.csv").write_text(text)
    with refused(InputError, "targets.csv"):
        read_scene(tmp_path / "scene")


@pytest.mark.slow
def test_simulate_writes_targets_that_follow_the_organ(tmp_path):
    write_phantom_case(tmp_path / "case")
    command = ["simulate", tmp_path / "case", tmp_path / "scenes", "--scenes", 2, "--squeeze"]
    succeeded(tumortrack(*command))
    case = load_case(tmp_path / "case")
    first, second = (read_scene(tmp_path / "scenes" / name) for name in ("0000", "0001"))
    np.testing.assert_array_equal(first.targets.points_ct, second.targets.points_ct)
    for made in (first, second):
        targets = made.targets
        assert len(targets.labels) == 200
        np.testing.assert_array_equal(labels_of(case.anatomy, targets.points_ct), targets.labels)
        # Where the deformed surfaces are, not only where the pose is. Points within a hair of a
        # triangulated surface may change sides.
        assert (labels_of(made.reference, targets.points_mm) == targets.labels).mean() > 0.98
        posed = transform_points(np.array(made.meta["camera_from_ct"]), targets.points_ct)
        assert np.linalg.norm(posed - targets.points_mm, axis=1).max() > 2
    # The same command makes the same targets.
    before = (tmp_path / "scenes" / "0001" / "targets.csv").read_bytes()
    folder = tmp_path / "again"
    succeeded(tumortrack(*command[:2], folder, *command[3:]))
    assert (folder / "0001" / "targets.csv").read_bytes() == before


# --- the protocol ---


def test_an_entry_has_the_error_where_it_can_be_measured():
    entry, _ = evaluate_scene(lambda _: estimate(shifted(2.5)), scene(), "s")
    assert entry["tre_mm"]["mean"] == pytest.approx(2.5)
    assert entry["tre_mm"]["max"] == pytest.approx(2.5)
    assert entry["tre_mm"]["count"] == 200
    assert "tre_mm" not in evaluate_scene(lambda _: estimate(None), scene(), "s")[0]
    plain = scene(with_targets=False)
    assert "tre_mm" not in evaluate_scene(lambda _: estimate(Wave()), plain, "s")[0]


def nothing(_):
    raise NoEstimate("no organ was found")


def test_a_scene_where_nothing_was_found_is_infinitely_far():
    failed, _ = evaluate_scene(nothing, scene(), "s")
    assert failed["tre_mm"] is None
    entries = [evaluate_scene(lambda _, d=d: estimate(shifted(d)), scene(), "s")[0] for d in (1, 3)]
    assert summarise(entries)["tre_mm"]["mean"] == pytest.approx(2)
    one = summarise([*entries, failed])["tre_mm"]
    assert (one["median"], one["scenes"]) == (pytest.approx(3), 3)
    assert summarise([*entries, failed, failed])["tre_mm"]["mean"] is None
    # Without any answer there is nothing to say of a motion; without targets neither.
    assert "tre_mm" not in summarise([failed, failed])
    lost, _ = evaluate_scene(nothing, scene(with_targets=False), "s")
    assert "tre_mm" not in lost
    assert summarise([*entries, lost])["tre_mm"]["scenes"] == 2


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tre")
    for n in range(3):
        scene().write(folder / "scenes" / f"scene_{n}")
    answers = iter([shifted(1.25), shifted(4.5), shifted(2.0)])
    report = evaluate_scenes(
        lambda _: estimate(next(answers)), folder / "scenes", folder / "report"
    )
    return folder / "report", report


def test_report_page_and_table_tell_the_error(evaluated):
    out, report = evaluated
    assert json.loads((out / "report.json").read_text()) == report
    assert report["summary"]["tre_mm"]["mean"] == pytest.approx(2.0, abs=1e-4)
    assert report["summary"]["tre_mm"]["scenes"] == 3
    # Medians of 1.25, 4.5 and 2 mm would be 2 mm; the worst is that of the second scene.
    pooled = report["summary"]["errors"]["all"]["estimate"]["target_mm"]
    assert (pooled["count"], pooled["scene"]) == (600, "scene_1")
    assert pooled["worst"] == pytest.approx(4.5, abs=1e-4)
    assert pooled["median"] == pytest.approx(2.0, abs=0.01)
    assert pooled["p95"] == pytest.approx(4.5, abs=0.01)
    assert "max" not in report["summary"]["tre_mm"]  # a median of maxima is no largest error
    page = (out / "index.html").read_text()
    assert target_text(report["scenes"][1]["tre_mm"]) in page
    assert sum("600 targets" in line for line in headlines(report["summary"])) == 1
    assert "600 targets" in page
