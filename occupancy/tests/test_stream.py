"""Scenes with labelled points, and their batches: replayed bit for bit in any process."""

import multiprocessing
import pickle

import numpy as np
import pytest

from elastic_objects import SMALL as BODY
from elastic_objects import UP, organ
from render_objects import anatomy
from tumortrack.core.cloud import CloudConfig
from tumortrack.core.mesh_query import surface_distance, thinned
from tumortrack.organ.body import build_body
from tumortrack.simulation.deform import ElasticConfig
from tumortrack.simulation.noise import D405_NOISE
from tumortrack.simulation.scene import OccupancyConfig, SceneConfig, SceneRecipe, Simulator
from tumortrack_occupancy.training.query_points import OccupancyPool
from tumortrack_occupancy.training.stream import SceneStream, labelled_scene

ANATOMY = anatomy()
SMALL = OccupancyConfig(per_side=40, pool=3000)
NOISY = SceneConfig(occupancy=SMALL, noise=D405_NOISE, free_range=0.3)
TINY = SceneConfig(width=160, height=90, occupancy=SMALL, cloud=CloudConfig(n_points=200))


@pytest.fixture(scope="module")
def pool():
    return OccupancyPool(ANATOMY, SMALL, seed=1)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(ANATOMY, UP, SceneConfig(occupancy=SMALL))


def recipe(index):
    return SceneRecipe(5, "train", index)


def same(one, two):
    (scene, *samples), (other, *others) = one, two
    return np.array_equal(scene.cloud.points_mm, other.cloud.points_mm) and all(
        map(np.array_equal, samples, others)
    )


def test_a_recipe_replays_with_its_points(pool):
    one, two = (Simulator(ANATOMY, UP, NOISY) for _ in range(2))
    first = [labelled_scene(one, recipe(i), pool) for i in range(4)]
    for i in (3, 0, 2, 1):  # in any order
        assert same(first[i], labelled_scene(two, recipe(i), pool))
        np.testing.assert_array_equal(
            two.render(recipe(i)).cloud.points_mm, first[i][0].cloud.points_mm
        )


def test_labelled_points_lie_in_the_scene_as_the_reference_does(simulator, pool):
    scene, points_mm, labels = labelled_scene(simulator, recipe(3), pool)
    reference = simulator.reference(scene)
    for label, part in enumerate(reference.parts, start=1):
        own = points_mm[labels == label]
        lower, upper = part.box_mm
        assert len(own) >= 40
        assert (own > lower - 0.5).all()
        assert (own < upper + 0.5).all()
    assert reference.names == ("kidney", "tumor_1", "tumor_2")
    assert reference.organ.volume_mm3 == pytest.approx(ANATOMY.organ.volume_mm3, rel=0.1)
    cloud = scene.cloud.points_mm
    assert (cloud > reference.organ.box_mm[0] - 0.1).all()
    assert (cloud < reference.organ.box_mm[1] + 0.1).all()


def test_a_coarser_surface_shows_the_same_organ():
    organ, *tumors = ANATOMY.parts
    shown = ANATOMY.with_parts([thinned(organ, 2.5), *tumors])
    assert len(shown.organ.faces) < len(organ.faces)
    scene = Simulator(shown, UP, SceneConfig(occupancy=SMALL)).render(recipe(1))
    true = organ.with_vertices(scene.forward(organ.vertices_mm))
    assert surface_distance(true, scene.cloud.points_mm).mean() < 2.5 / 8


def stream(pool, config=TINY, size=3, name="train"):
    return SceneStream(ANATOMY, UP, config, pool, seed=5, stream=name, batch_size=size)


def batches_agree(one, two):
    for field in ("clouds_mm", "points_mm", "labels"):
        np.testing.assert_array_equal(getattr(one, field), getattr(two, field))


def test_a_batch_holds_its_recipes(pool):
    batch = stream(pool, size=3).batch(2)
    simulator = Simulator(ANATOMY, UP, TINY)
    assert batch.clouds_mm.shape == (3, 200, 3)
    for row, index in enumerate((6, 7, 8)):
        scene, points_mm, labels = labelled_scene(simulator, recipe(index), pool)
        np.testing.assert_array_equal(batch.clouds_mm[row], scene.cloud.points_mm)
        np.testing.assert_array_equal(batch.points_mm[row], points_mm)
        np.testing.assert_array_equal(batch.labels[row], labels)


def test_batches_do_not_depend_on_the_process(pool):
    used = stream(pool)
    expected = used.batch(1)
    batches_agree(stream(pool).batch(1), expected)
    used.batch(4)
    batches_agree(pickle.loads(pickle.dumps(used)).batch(1), expected)
    with multiprocessing.get_context("spawn").Pool(1) as workers:
        batches_agree(workers.apply(used.batch, (1,)), expected)
    other = stream(pool, name="validation").batch(1)
    assert not np.array_equal(other.clouds_mm, expected.clouds_mm)


def test_small_clouds_repeat_their_points(pool):
    wanted = 5000  # more than a small picture has
    config = SceneConfig(width=160, height=90, occupancy=SMALL, cloud=CloudConfig(n_points=wanted))
    (cloud,) = stream(pool, config, size=1).batch(0).clouds_mm
    unique, count = np.unique(cloud, axis=0, return_counts=True)
    drawn = Simulator(ANATOMY, UP, config).render(recipe(0)).cloud.points_mm
    assert cloud.shape == (wanted, 3)
    assert 200 <= len(drawn) < wanted
    np.testing.assert_array_equal(unique, np.unique(drawn, axis=0))
    assert np.ptp(count) <= 1


def test_batches_stay_whole_where_clouds_have_a_random_number_of_points():
    config = SceneConfig(occupancy=SMALL, cloud_points=(300, 3000), free_range=0.5)
    simulator = Simulator(ANATOMY, UP, config)
    counts = [len(simulator.render(recipe(i)).cloud.points_mm) for i in range(6)]
    pool = OccupancyPool(ANATOMY, SMALL, 1)
    batch = SceneStream(ANATOMY, UP, config, pool, 5, "train", 6).batch(0)
    assert batch.clouds_mm.shape == (6, 1000, 3)
    different = [len(np.unique(cloud, axis=0)) for cloud in batch.clouds_mm]
    assert different == [min(1000, count) for count in counts]


def test_a_stream_takes_its_body_along():
    body, few = build_body(organ(), UP, BODY, 3), OccupancyConfig(per_side=16, pool=4000)
    config = SceneConfig(deform=(ElasticConfig(body=BODY),), occupancy=few)
    pool = OccupancyPool(organ(), few, 0)
    stream = SceneStream(organ(), UP, config, pool, 0, "train", 2, body)
    here, there = stream.batch(1), pickle.loads(pickle.dumps(stream)).batch(1)
    np.testing.assert_array_equal(here.clouds_mm, there.clouds_mm)
    np.testing.assert_array_equal(here.points_mm, there.points_mm)
    scene = Simulator(organ(), UP, config, body).render(SceneRecipe(0, "train", 2))
    assert scene.deformation.record()["kind"] == "elastic"
    assert len(scene.deformation.record()["coefficients"]) == 20
