"""What rigid registration would have answered, beside an estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy, Mesh, SensorCloud
from tumortrack.io.scene_folder import Scene, Targets
from tumortrack.report.baselines import Baselines, baselines_of, best_rigid_pose, rigid_fit
from tumortrack.tracking.model_files import load_model

TURN = Rotation.from_euler("xyz", [35, -50, 110], degrees=True).as_matrix()
CAMERA_FROM_CT = rigid(TURN, np.array([12.0, -7.0, 140.0]))


@pytest.fixture(scope="module")
def rest(elastic_model):
    return load_model(elastic_model, "cpu").shape


def scene_of(anatomy_ct: Anatomy, pose=CAMERA_FROM_CT, shift_mm=0.0) -> Scene:
    """The organ there, its first tumor moved by so much along x; all of it is seen."""
    parts = [
        part.with_vertices(transform_points(pose, part.vertices_mm)) for part in anatomy_ct.parts
    ]
    parts[1] = parts[1].with_vertices(parts[1].vertices_mm + [shift_mm, 0, 0])
    return Scene(SensorCloud(parts[0].vertices_mm), anatomy_ct.with_parts(parts))


def in_another_order(mesh: Mesh) -> Mesh:
    """The same surface as another program may write it."""
    return Mesh(mesh.vertices_mm, mesh.faces[::-1])


@pytest.mark.parametrize("by", ["triangles", "targets", "surfaces"])
def test_the_oracle_finds_a_rigid_motion(rest, by):
    scene = scene_of(rest.anatomy_ct)
    if by != "triangles":
        others = map(in_another_order, scene.reference.parts)
        scene = replace(scene, reference=rest.anatomy_ct.with_parts(others))
    if by == "targets":
        points_ct = rest.anatomy_ct.organ.vertices_mm[:50]
        places_mm = transform_points(CAMERA_FROM_CT, points_ct)
        scene = replace(scene, targets=Targets(points_ct, places_mm, np.ones(50, np.uint8)))
    pose, how = best_rigid_pose(rest.anatomy_ct, scene)
    assert how == by
    points = rest.anatomy_ct.organ.vertices_mm
    off_mm = transform_points(pose, points) - transform_points(CAMERA_FROM_CT, points)
    assert np.linalg.norm(off_mm, axis=1).max() < (0.3 if by == "surfaces" else 1e-6)


def test_the_rigid_fit_goes_back_to_the_points(rest):
    """From 4 mm and 5 degrees beside them."""
    scene = scene_of(rest.anatomy_ct)
    aside = rigid(Rotation.from_rotvec([0, 0, np.radians(5)]).as_matrix(), np.zeros(3))
    start = CAMERA_FROM_CT @ aside
    start[:3, 3] += [4.0, 0, 0]
    found = rigid_fit(rest.distances[0], scene.cloud, start)
    points = rest.anatomy_ct.organ.vertices_mm
    off_mm = transform_points(found, points) - transform_points(CAMERA_FROM_CT, points)
    assert np.linalg.norm(off_mm, axis=1).max() < 0.3


def test_alternatives_are_as_far_off_as_the_tumor_moved(rest):
    answers = Baselines(rest)(scene_of(rest.anatomy_ct, shift_mm=6.0))
    for answer in answers.values():
        assert list(answer["parts"]) == list(rest.anatomy_ct.names[1:])
        assert answer["parts"]["tumor_1"]["center_mm"] == pytest.approx(6.0, abs=0.3)
        assert "tre_mm" not in answer  # the scene has no targets
    assert answers["best_rigid_pose"]["by"] == "triangles"


def test_what_cannot_be_compared_says_why(rest):
    scene = scene_of(rest.anatomy_ct)
    alone = replace(scene, reference=rest.anatomy_ct.with_parts(scene.reference.parts[:1]))
    answers = Baselines(rest)(alone)
    assert set(answers) == {"best_rigid_pose", "rigid_fit"}
    for answer in answers.values():
        assert answer["not_available"].startswith("the scene has kidney, but the model's case")
    assert baselines_of(None) is None
