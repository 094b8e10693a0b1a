"""Coarser scenes show the same organ, off by no more than is stated; states are shared."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from elastic_objects import SMALL, UP, organ
from tumortrack.core.errors import InputError
from tumortrack.report.metrics import distance_to_surface
from tumortrack.sense.noise import D405_NOISE
from tumortrack.simulate.coarse import CoarseConfig, coarsened
from tumortrack.simulate.deform import DragConfig, ElasticConfig
from tumortrack.simulate.elastic.body import ElasticBody, build_body
from tumortrack.simulate.occupancy import FixedPoints
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, SceneStream, Simulator

ANATOMY = organ()
FULL = SceneConfig(deform=(ElasticConfig(body=SMALL),))
COARSE = CoarseConfig(pixels=2, surface_mm=0.3, views=4)


@pytest.fixture(scope="module")
def body() -> ElasticBody:
    return build_body(ANATOMY, UP, SMALL, 3)


def stream(body: ElasticBody) -> SceneStream:
    coarse_ct, scene = coarsened(ANATOMY, FULL, COARSE)
    points = FixedPoints(ANATOMY.organ.vertices_mm[::50].astype(np.float32))
    return SceneStream(coarse_ct, UP, scene, points, 5, "train", 3, body)


def test_a_coarse_scene_lies_on_the_whole_organ_s_surface(body):
    """Within what its triangles are off, and bent edges of some millimetres besides."""
    coarse_ct, scene = coarsened(ANATOMY, FULL, COARSE)
    assert len(coarse_ct.organ.faces) < len(ANATOMY.organ.faces) / 2
    assert coarse_ct.tumors == ANATOMY.tumors
    simulator = Simulator(coarse_ct, UP, scene, body)
    away = []
    for index in range(4):
        made = simulator.render(SceneRecipe(5, "train", index))
        assert made.frame.depth_mm.shape == (120, 212)
        whole = ANATOMY.organ.moved(made.carry(ANATOMY.organ.vertices_mm))
        away.append(distance_to_surface(made.cloud.points_mm, whole))
    assert 0.02 < np.percentile(np.concatenate(away), 95) < COARSE.surface_mm + 0.1


def test_so_many_views_show_one_state_whichever_batch_is_made_first(body):
    one = stream(body)
    batches = [one.batch(index) for index in (0, 1, 2)]
    again = stream(body)
    for index in (2, 0, 1):  # batches of three scenes, states of four
        np.testing.assert_array_equal(again.batch(index).clouds_mm, batches[index].clouds_mm)
        np.testing.assert_array_equal(again.batch(index).points_mm, batches[index].points_mm)
    points = np.concatenate([batch.points_mm for batch in batches])
    poses = np.concatenate([batch.camera_from_ct for batch in batches])
    moved = np.einsum("bji,bpj->bpi", poses[:, :3, :3], points - poses[:, None, :3, 3])  # to the CT
    for first in (0, 4):
        np.testing.assert_allclose(moved[first + 1 : first + 4] - moved[first], 0, atol=2e-3)
        assert np.abs(poses[first] - poses[first + 1]).max() > 0.1
    assert np.abs(moved[0] - moved[4]).max() > 0.5


def test_lengths_of_the_noise_keep_their_share_of_the_image():
    _, scene = coarsened(ANATOMY, msgspec.structs.replace(FULL, noise=D405_NOISE), COARSE)
    noise = scene.noise
    assert (noise.edge_px, noise.hole_px, noise.correlation_px) == (1, 4, 2)
    assert noise.axial_mm == D405_NOISE.axial_mm


def test_without_coarseness_nothing_changes_and_drags_cannot_share_states():
    assert coarsened(ANATOMY, FULL, None) == (ANATOMY, FULL)
    with pytest.raises(InputError, match="only elastic states"):
        coarsened(ANATOMY, SceneConfig(deform=(DragConfig(),)), COARSE)
    with pytest.raises(InputError, match="allowed: 1 to 8"):
        CoarseConfig(pixels=0)
