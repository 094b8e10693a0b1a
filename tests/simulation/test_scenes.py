"""Scenes and batches: replayed bit for bit, and true to the deformed surface."""

import msgspec
import numpy as np
import pytest

from refused import refused
from render_objects import anatomy, ray_hits
from tumortrack.core.camera import deproject
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.simulation.clutter import ClutterConfig
from tumortrack.simulation.deform import DragConfig, StretchConfig
from tumortrack.simulation.noise import D405_NOISE
from tumortrack.simulation.scene import STREAMS, SceneConfig, SceneRecipe, Simulator

ANATOMY = anatomy()
UP = (0.0, -1.0, 0.0)
CONFIG = SceneConfig()
NOISY = SceneConfig(noise=D405_NOISE, free_range=0.3)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(ANATOMY, UP, CONFIG)


def recipe(index, stream="train", seed=5):
    return SceneRecipe(seed, stream, index)


def test_a_recipe_replays_bit_for_bit():
    one, two = (Simulator(ANATOMY, UP, NOISY) for _ in range(2))
    first = [one.draw(recipe(i)) for i in range(4)]
    for i in (3, 0, 2, 1):  # in any order
        (scene, rng), (again, same) = first[i], two.draw(recipe(i))
        np.testing.assert_array_equal(again.cloud.points_mm, scene.cloud.points_mm)
        assert same.bit_generator.state == rng.bit_generator.state
        np.testing.assert_array_equal(two.render(recipe(i)).cloud.points_mm, scene.cloud.points_mm)


def test_every_seed_stream_and_index_is_a_scene_of_its_own(simulator):
    recipes = [recipe(i, stream, s) for i in (0, 1) for stream in STREAMS for s in (0, 1)]
    clouds = [simulator.render(r).cloud.points_mm for r in recipes]
    firsts = {tuple(cloud[0]) for cloud in clouds}
    states = {str(r.generator(a).bit_generator.state) for r in recipes for a in (0, 1)}
    assert len(firsts) == len(recipes) == 12
    assert len(states) == 24


def test_configuration_survives_json_and_names_its_deformations():
    config = SceneConfig(deform=(StretchConfig(), DragConfig(falloff="variance")), free_range=0.25)
    data = to_builtins(config)
    assert [d["type"] for d in data["deform"]] == ["stretch", "drag"]
    assert from_builtins(data, SceneConfig, "here") == config
    with refused(InputError, "squeeze"):
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


def test_free_scenes_are_seen_from_anywhere_and_keep_their_depth():
    config = SceneConfig(free_range=1.0, deform=(DragConfig(steps=()),))
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


def test_background_joins_a_scene_and_changes_nothing_else():
    clutter = ClutterConfig(scenes=1.0, largest_share=0.3)
    free = SceneConfig(free_range=1.0)
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
