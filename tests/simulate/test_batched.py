"""Scenes made in batches on a torch device are those of the compiled simulator."""

import pickle

import msgspec
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from render_objects import anatomy, bumpy
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.geometry import transform_points
from tumortrack.sense.camera import d405, project
from tumortrack.sense.cloud import CloudConfig
from tumortrack.sense.noise import D405_NOISE
from tumortrack.sense.render import render_depth
from tumortrack.simulate.batched.render import depth_images
from tumortrack.simulate.batched.stream import DeviceStream, carried, why_not
from tumortrack.simulate.deform import (
    ChainConfig,
    DragConfig,
    ElasticConfig,
    RestConfig,
    StretchConfig,
)
from tumortrack.simulate.occupancy import FixedPoints, OccupancyConfig, OccupancyPool
from tumortrack.simulate.scene import PoseConfig, SceneConfig, SceneRecipe, SceneStream, Simulator
from tumortrack.training.presets import paper, quick
from tumortrack.training.scenes import batches_on, scenes_for
from tumortrack.training.train import TrainingRun, train

ANATOMY = anatomy()
UP = (0.0, -1.0, 0.0)
CPU = torch.device("cpu")
SMALL = OccupancyConfig(per_side=40, pool=3000)
SQUEEZED = ChainConfig(links=(DragConfig(), StretchConfig()))
CONFIGS = {
    "paper": SceneConfig(occupancy=SMALL),
    "full": SceneConfig(occupancy=SMALL, pose=PoseConfig(rotations="full")),
    "squeezed": SceneConfig(
        occupancy=SMALL,
        deform=(DragConfig(), SQUEEZED, StretchConfig(), RestConfig()),
        free_range=0.5,
        cloud_points=(300, 3000),
    ),
    # half of the draws show too little, and few pixels in range must do for many points
    "far": SceneConfig(
        width=160, height=90, occupancy=SMALL, pose=PoseConfig(nearest_mm=(110.0, 165.0))
    ),
}
SIZE = 6


@pytest.fixture(scope="module")
def pool():
    return OccupancyPool(ANATOMY, SMALL, seed=1)


def stream(pool, config, size=SIZE):
    return SceneStream(ANATOMY, UP, config, pool, seed=5, stream="train", batch_size=size)


@pytest.fixture(scope="module", params=CONFIGS)
def both(request, pool):
    """A configuration's reference stream and the stream on a device."""
    reference = stream(pool, CONFIGS[request.param])
    return reference, DeviceStream(reference, CPU)


def rendered(reference, index):
    simulator = Simulator(ANATOMY, UP, reference.config)
    recipes = [SceneRecipe(5, "train", i) for i in range(index * SIZE, (index + 1) * SIZE)]
    return [simulator.render(recipe) for recipe in recipes]


def test_a_batch_is_the_reference_s(both):
    reference, device = both
    for index in (0, 3):
        expected = reference.batch(index)
        clouds, points, labels, poses = device.batch(index)
        np.testing.assert_array_equal(poses.numpy(), expected.camera_from_ct)
        assert clouds.shape == expected.clouds_mm.shape
        for row in range(SIZE):  # the same points with the same labels, each once
            distance, found = cKDTree(expected.points_mm[row]).query(points[row].numpy())
            assert distance.max() < 1e-3
            assert len(set(found)) == len(found) == len(expected.labels[row])
            assert (labels[row].numpy() == expected.labels[row][found]).mean() >= 0.999
        # Of the clouds each point and its place in the order; a pixel that turned on a silhouette
        # may alter the choice in one scene.
        off = np.abs(clouds.numpy() - expected.clouds_mm).max(axis=(1, 2))
        assert np.sum(off < 0.01) >= SIZE - 1


def test_depth_images_are_the_reference_s_but_for_single_pixels(both):
    reference, device = both
    images = device.render(device.plan(1))
    plan, depth_mm = images.plan, images.depth_mm
    for row, scene in enumerate(rendered(reference, 1)):
        seen, expected = depth_mm[row].numpy(), scene.frame.depth_mm
        assert np.sum(np.isnan(seen) != np.isnan(expected)) <= 2
        off = np.abs(seen - expected)
        assert np.nanmedian(off) < 1e-4
        assert np.nansum(off > 0.01) <= 2
        assert np.isfinite(expected).sum() > 300
        near, far = plan.near_mm[row], plan.far_mm[row]
        assert np.sum((expected > near) & (expected < far)) >= len(scene.cloud.points_mm)


def test_labelled_points_keep_their_order_by_part_and_side(both, pool):
    reference, device = both
    labels = device.batch(2)[2].numpy()
    k = SMALL.per_side
    expected = reference.batch(2).labels
    for n in range(len(ANATOMY.parts)):
        inside = slice(2 * k * n, 2 * k * n + k)
        np.testing.assert_array_equal(
            np.sort(labels[:, inside], 1), np.sort(expected[:, inside], 1)
        )
        assert (labels[:, inside] > n).all()
    np.testing.assert_array_equal(labels[:, 6 * k :], expected[:, 6 * k :])


def test_scenes_that_show_too_little_are_drawn_again(pool):
    reference = stream(pool, CONFIGS["far"])
    device = DeviceStream(reference, CPU)
    first = device.plan(0)
    images = device.render(first)
    plan = images.plan
    again = plan.attempts > 0
    assert 0 < again.sum() < SIZE
    assert (images.available >= 200).all()
    same = (plan.camera_from_ct == first.camera_from_ct).all(axis=(1, 2))
    np.testing.assert_array_equal(same, ~again)
    for pose, scene in zip(plan.camera_from_ct, rendered(reference, 0), strict=True):
        np.testing.assert_array_equal(pose, scene.camera_from_ct)


def test_a_range_that_shows_nothing_is_an_error(pool):
    far = SceneConfig(
        width=160, height=90, occupancy=SMALL, pose=PoseConfig(nearest_mm=(400.0, 410.0))
    )
    with pytest.raises(TumortrackError, match="no pose in 20"):
        DeviceStream(stream(pool, far, 2), CPU).batch(0)


def test_batches_do_not_depend_on_their_size_or_who_plans(pool):
    config = CONFIGS["squeezed"]
    large = DeviceStream(stream(pool, config, 6), CPU).batch(1)
    device = DeviceStream(stream(pool, config, 3), CPU)
    device.batch(7)
    elsewhere = pickle.loads(pickle.dumps(device))
    plans = [pickle.loads(pickle.dumps(elsewhere.plan(index))) for index in (2, 3)]
    images = [device.render(plan) for plan in plans]
    made = [device.assemble(p, device.sample(p)) for p in images]
    small = [torch.cat(parts) for parts in zip(*made, strict=True)]
    for one, two in zip(large, small, strict=True):
        torch.testing.assert_close(one, two, atol=1e-3, rtol=0)


def test_no_setting_of_a_training_loop_reaches_the_scenes(pool):
    device = DeviceStream(stream(pool, CONFIGS["squeezed"], 3), CPU)
    expected = device.batch(0)
    with torch.inference_mode():
        inferred = device.batch(0)
    with torch.autocast("cpu", torch.bfloat16):
        cast = device.batch(0)
    for one, two, three in zip(expected, inferred, cast, strict=True):
        torch.testing.assert_close(one, two, atol=0, rtol=0)
        torch.testing.assert_close(one, three, atol=0, rtol=0)
        assert torch.isfinite(one).all()
        assert not one.requires_grad
    weight = torch.ones(3, requires_grad=True)
    (expected[0] @ weight).square().sum().backward()  # the values can be learnt from
    assert weight.grad is not None
    assert torch.isfinite(weight.grad).all()


def test_motion_carries_as_the_deformation_and_pose_do(both):
    reference, device = both
    plan = device.plan(0)
    points_ct = ANATOMY.parts[1].vertices_mm
    sent = torch.tensor(points_ct.T, dtype=torch.float32)[:, None].expand(-1, SIZE, -1)
    placed = carried(plan, sent).permute(1, 2, 0).numpy()
    simulator = Simulator(ANATOMY, UP, reference.config)
    moved = []
    for row in range(SIZE):
        rng = plan.recipes[row].generator(int(plan.attempts[row]))
        camera_from_ct, deformation, _ = simulator.draw(rng)
        deformed = deformation.apply(points_ct)
        expected = transform_points(camera_from_ct, deformed)
        np.testing.assert_allclose(placed[row], expected, atol=2e-4)
        moved.append(np.abs(deformed - points_ct).max())
    assert max(moved) > 0.5


@pytest.mark.parametrize("away_mm", [33.8, 60.0, 130.0])
def test_of_the_same_vertices_the_image_is_the_same_to_the_last_bit(away_mm):
    """Also where a surface leaves the image or reaches behind the camera."""
    camera = d405(160, 90)
    rng = np.random.default_rng(0)
    meshes = [bumpy(30, (*rng.uniform(-1, 1, 2), away_mm)) for _ in range(3)]
    vertices = np.stack([mesh.vertices_mm for mesh in meshes]).astype(np.float32)
    sent = torch.from_numpy(vertices).permute(2, 0, 1)
    faces = torch.tensor(meshes[0].faces, dtype=torch.int64)
    images = depth_images(sent, faces, camera).numpy()
    for image, corners in zip(images, vertices, strict=True):
        expected = render_depth(corners, meshes[0].faces, camera).depth_mm
        np.testing.assert_array_equal(image, expected)
        assert np.isfinite(expected).any()
    assert (away_mm > 34) == (vertices[..., 2].min() > 1)


def test_clouds_lie_in_range_and_on_pixels(both):
    reference, device = both
    clouds, _, _, _ = device.batch(4)
    images = device.render(device.plan(4))
    plan = images.plan
    for row, cloud in enumerate(clouds.numpy()):
        assert (cloud[:, 2] > plan.near_mm[row]).all()
        assert (cloud[:, 2] < plan.far_mm[row]).all()
        pixels, _ = project(cloud, d405(reference.config.width, reference.config.height))
        np.testing.assert_allclose(pixels, np.rint(pixels), atol=1e-3)
        wanted = min(int(plan.n_points[row]), int(images.available[row]), len(cloud))
        assert len(np.unique(cloud, axis=0)) == wanted


def test_what_it_cannot_make_it_refuses_by_name(pool):
    for config in CONFIGS.values():
        assert why_not(stream(pool, config)) is None
    for config, name in (
        (SceneConfig(noise=D405_NOISE), "sensor noise"),
        (SceneConfig(deform=(ElasticConfig(),)), "deformations"),
        (SceneConfig(deform=(ChainConfig(links=(StretchConfig(), DragConfig())),)), "deformations"),
    ):
        assert name in (why_not(stream(pool, config)) or "")
    fixed = FixedPoints(np.zeros((4, 3), np.float32))
    assert "same in every scene" in (why_not(stream(fixed, CONFIGS["paper"])) or "")


def test_a_cloud_of_more_points_than_pixels_repeats_them(pool):
    config = SceneConfig(width=160, height=90, occupancy=SMALL, cloud=CloudConfig(n_points=5000))
    reference = stream(pool, config, 2)
    clouds = DeviceStream(reference, CPU).batch(0)[0].numpy()
    np.testing.assert_allclose(clouds, reference.batch(0).clouds_mm, atol=0.01)
    assert len(np.unique(clouds[0], axis=0)) < 5000


# in training


def test_batches_come_in_the_order_of_their_steps_however_many_are_made_at_once(pool):
    reference = stream(pool, CONFIGS["far"], 2)
    device = DeviceStream(reference, CPU)
    made = [
        batches_on(CPU, reference, range(3, 15, 2), 5, workers=workers, at_once=at_once)
        for workers, at_once in ((1, 9), (0, 1))  # four batches together, one alone
    ]
    for index, *others in zip((3, 0, 2, 4, 1, 3), *made, strict=True):
        expected = device.batch(index)
        for batch in others:
            for one, two in zip(batch, expected, strict=True):
                torch.testing.assert_close(one, two, atol=1e-3, rtol=0)


def test_a_gpu_makes_what_it_can_and_the_user_hears_of_the_rest(pool):
    gpu = torch.device("cuda")  # nothing is made here: no GPU is needed
    able, unable = stream(pool, paper(ANATOMY).scene), stream(pool, quick(ANATOMY).scene)
    scenes = scenes_for(able, range(1), 0, 3, gpu)
    assert (scenes.maker, scenes.note) == ("batched on cuda", "")
    scenes = scenes_for(unable, range(1), 0, 3, gpu)
    assert scenes.maker == "3 processes"
    assert "3 processes on the CPU" in scenes.note
    assert "sensor noise" in scenes.note
    for told in (
        scenes_for(able, range(1), 0, 3, CPU),
        scenes_for(able, range(1), 0, 3, gpu, "workers"),
    ):
        assert (told.maker, told.note) == ("3 processes", "")
    with pytest.raises(InputError, match="sensor noise"):
        scenes_for(unable, range(1), 0, 3, CPU, "device")


def test_a_network_learns_from_them_as_from_the_reference_s(tmp_path):
    config = msgspec.structs.replace(
        quick(ANATOMY), scene=CONFIGS["far"], batch_size=4, validation_pairs=1
    )
    losses, makers = [], []
    for maker in ("device", "workers"):
        folder = tmp_path / maker
        folder.mkdir()
        told: list[float] = []
        run = TrainingRun(ANATOMY, UP, "", config, steps=2, device="cpu", workers=0, scenes=maker)
        model = train(run, folder, lambda status, told=told: told.append(status.loss))
        losses.append(told[-1])
        makers.append(model.provenance["scenes"])
    assert makers == ["batched on cpu", "0 processes"]
    assert losses[0] == pytest.approx(losses[1], rel=0.02)
