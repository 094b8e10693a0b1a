"""Scenes and batches: replayed bit for bit, and true to the deformed surface."""

import multiprocessing
import pickle

import msgspec
import numpy as np
import pytest

from render_objects import anatomy, ray_hits
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.sense.camera import deproject
from tumortrack.sense.cloud import CloudConfig
from tumortrack.sense.clutter import ClutterConfig
from tumortrack.sense.noise import D405_NOISE
from tumortrack.simulate.deform import DragConfig, StretchConfig
from tumortrack.simulate.occupancy import OccupancyConfig, OccupancyPool
from tumortrack.simulate.scene import (
    STREAMS,
    PoseConfig,
    SceneConfig,
    SceneRecipe,
    SceneStream,
    Simulator,
)

ANATOMY = anatomy()
UP = (0.0, -1.0, 0.0)
SMALL = OccupancyConfig(per_side=40, pool=3000)
CONFIG = SceneConfig(occupancy=SMALL)
NOISY = SceneConfig(occupancy=SMALL, noise=D405_NOISE, free_range=0.3)
TINY = SceneConfig(width=160, height=90, occupancy=SMALL, cloud=CloudConfig(n_points=200))


@pytest.fixture(scope="module")
def pool():
    return OccupancyPool(ANATOMY, SMALL, seed=1)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(ANATOMY, UP, CONFIG)


def recipe(index, stream="train", seed=5):
    return SceneRecipe(seed, stream, index)


def same(one, two):
    (scene, *samples), (other, *others) = one, two
    return np.array_equal(scene.cloud.points_mm, other.cloud.points_mm) and all(
        map(np.array_equal, samples, others)
    )


def test_a_recipe_replays_bit_for_bit(pool):
    one, two = (Simulator(ANATOMY, UP, NOISY) for _ in range(2))
    first = [one.pair(recipe(i), pool) for i in range(4)]
    for i in (3, 0, 2, 1):  # in any order
        assert same(first[i], two.pair(recipe(i), pool))
        np.testing.assert_array_equal(
            two.render(recipe(i)).cloud.points_mm, first[i][0].cloud.points_mm
        )


def test_every_seed_stream_and_index_is_a_scene_of_its_own(simulator, pool):
    recipes = [recipe(i, stream, s) for i in (0, 1) for stream in STREAMS for s in (0, 1)]
    clouds = [simulator.pair(r, pool)[0].cloud.points_mm for r in recipes]
    firsts = {tuple(cloud[0]) for cloud in clouds}
    states = {str(r.generator(a).bit_generator.state) for r in recipes for a in (0, 1)}
    assert len(firsts) == len(recipes) == 12
    assert len(states) == 24


def test_configuration_survives_json_and_names_its_deformations():
    config = SceneConfig(deform=(StretchConfig(), DragConfig(falloff="variance")), free_range=0.25)
    data = to_builtins(config)
    assert [d["type"] for d in data["deform"]] == ["stretch", "drag"]
    assert from_builtins(data, SceneConfig, "here") == config
    with pytest.raises(InputError, match="squeeze"):
        from_builtins({**data, "deform": [{"type": "squeeze"}]}, SceneConfig, "here")


@pytest.mark.parametrize("index", [0, 1])
def test_the_cloud_lies_on_the_deformed_surface(simulator, index):
    scene = simulator.render(recipe(index))
    truth = simulator.reference(scene)
    assert (
        np.abs(scene.deformation.apply(ANATOMY.organ.vertices_mm) - ANATOMY.organ.vertices_mm).max()
        > 1
    )
    points = scene.cloud.points_mm[:400].astype(float)
    hits = np.concatenate(
        [ray_hits(np.zeros(3), p, truth.organ, 1e-3) for p in np.split(points, 4)]
    )
    length = np.linalg.norm(points, axis=1)
    assert (np.abs(hits - 1).min(1) * length).max() < 0.1  # on the surface, every one
    assert np.mean(np.abs(hits.min(1) - 1) * length < 0.1) > 0.99  # and on its near side


def test_the_cloud_is_a_unique_draw_of_the_image_in_range(simulator):
    for index in range(4):
        scene = simulator.render(recipe(index))
        points = scene.cloud.points_mm
        assert len(np.unique(points, axis=0)) == len(points) == 1000
        assert points[:, 2].min() > 110
        assert points[:, 2].max() < 150
        pixels = {tuple(p) for p in deproject(scene.frame).tolist()}
        assert {tuple(p) for p in points.tolist()} <= pixels


def test_free_scenes_are_seen_from_anywhere_and_keep_their_depth():
    config = SceneConfig(occupancy=SMALL, free_range=1.0, deform=(DragConfig(steps=()),))
    free = Simulator(ANATOMY, UP, config)
    nearest = []
    for index in range(30):
        scene = free.render(recipe(index))
        image, z = scene.frame.depth_mm, scene.cloud.points_mm[:, 2]
        nearest.append(np.nanmin(image))
        assert 80 - 0.5 < nearest[-1] < 250 + 8  # the image's border may cut the nearest point
        span = np.nanmax(image) - np.nanmin(image)
        assert np.ptp(z) > 0.85 * span  # nothing cropped away
    assert min(nearest) < 110
    assert max(nearest) > 200


def test_the_share_of_free_scenes_is_as_asked():
    half = Simulator(ANATOMY, UP, SceneConfig(occupancy=SMALL, free_range=0.5))
    nearest = [np.nanmin(half.render(recipe(i)).frame.depth_mm) for i in range(60)]
    # Free ones start at 80..250 mm, the others at 110..125: 91 % of the free ones show.
    assert 15 < np.sum((np.array(nearest) < 105) | (np.array(nearest) > 132)) < 40


def test_labelled_points_lie_in_the_scene_as_the_reference_does(simulator, pool):
    scene, points_mm, labels = simulator.pair(recipe(3), pool)
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


def test_deformations_are_chosen_with_equal_chance():
    models = StretchConfig(), DragConfig()
    both = SceneConfig(deform=models, width=160, height=90, occupancy=SMALL)
    simulator = Simulator(ANATOMY, UP, both)
    kinds = [simulator.render(recipe(i)).deformation.record()["kind"] for i in range(60)]
    assert 18 < kinds.count("drag") < 42
    assert kinds.count("drag") + kinds.count("stretch") == 60


def test_background_joins_a_scene_and_changes_nothing_else():
    clutter = ClutterConfig(scenes=1.0, largest_share=0.3)
    free = SceneConfig(occupancy=SMALL, free_range=1.0)
    clean, spoiled = (
        Simulator(ANATOMY, UP, config)
        for config in (free, msgspec.structs.replace(free, clutter=clutter))
    )
    added = []
    for index in range(12):
        one, two = clean.render(recipe(index)), spoiled.render(recipe(index))
        assert one.deformation.record() == two.deformation.record()
        np.testing.assert_array_equal(one.camera_from_ct, two.camera_from_ct)
        seen = np.isfinite(one.frame.depth_mm)
        np.testing.assert_array_equal(one.frame.depth_mm[seen], two.frame.depth_mm[seen])
        organ = {tuple(p) for p in deproject(one.frame).tolist()}
        added.append(np.mean([tuple(p) not in organ for p in two.cloud.points_mm.tolist()]))
    assert max(added) <= 0.36  # the image's share of 0.3, drawn at random
    assert np.mean(added) > 0.05


def test_recipes_are_numbered_from_zero():
    for bad in ((-1, 0), (0, -1)):
        with pytest.raises(InputError, match=r"0 or more|from 0 to"):
            SceneRecipe(bad[0], "test", bad[1])


def test_a_range_that_shows_nothing_is_an_error():
    far = SceneConfig(pose=PoseConfig(nearest_mm=(400.0, 410.0)), occupancy=SMALL)
    with pytest.raises(TumortrackError, match="no pose in 20"):
        Simulator(ANATOMY, UP, far).render(recipe(0))


# batches


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
        scene, points_mm, labels = simulator.pair(recipe(index), pool)
        np.testing.assert_array_equal(batch.clouds_mm[row], scene.cloud.points_mm)
        np.testing.assert_array_equal(batch.points_mm[row], points_mm)
        np.testing.assert_array_equal(batch.labels[row], labels)


def test_batches_do_not_depend_on_who_asks(pool):
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
