"""The wider world: forces against differences, states against what their loads must do, the second
camera's noise against its own law, and scenes that replay."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import trimesh
from scipy import ndimage
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from refused import refused
from stress_objects import ellipsoid, organ, world
from tumortrack.core import store
from tumortrack.core.camera import d405
from tumortrack.core.geometry import transform_points
from tumortrack.core.rigid_fit import kabsch
from tumortrack.core.solids import solid_of
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.organ.tets import TetMesh
from tumortrack_benchmarks.physics import segmentation
from tumortrack_benchmarks.physics.equilibrium import Rod, find_equilibrium
from tumortrack_benchmarks.physics.families import FAMILIES, Deformed, solve
from tumortrack_benchmarks.physics.forces import Bed, Capsule, LoadedBody, Springs, Touch, Weight
from tumortrack_benchmarks.physics.kidneys import random_anatomy
from tumortrack_benchmarks.physics.noise import StereoCamera, StereoConfig
from tumortrack_benchmarks.physics.organ import Slit, Stage, cut_open
from tumortrack_benchmarks.physics.solid import NeoHookeanSolid
from tumortrack_benchmarks.physics.tets import tetrahedralise

CAMERA = d405(424, 240)
SILENT = {"bias_px": 0.0, "lens_px": 0.0, "slant_px": 0.0, "gloss_degrees": 0.0, "quantum_mm": 0.0}


@cache
def state(family: str, seed: int) -> Deformed:
    return solve(organ(), family, seed)


def soft(mesh: TetMesh) -> NeoHookeanSolid:
    return NeoHookeanSolid(mesh, np.full(len(mesh.tets), 4.0), 0.49)


def test_every_forces_gradient_is_its_energys_slope() -> None:
    stage = Stage(organ(), soft(organ().mesh))
    rng, rest = np.random.default_rng(0), organ().mesh.nodes_mm
    bed = stage.touch(organ().bed.under(organ().points_mm, 12.0), 3.0, friction=0.5)
    bed.remember(rest - [0, 0, 1.0])
    rod = stage.touch(Rod(np.array([0, 0, 37.0]), np.array([0, 0.6, 0.8]), 6.0))
    forces = [
        bed, rod, stage.grip(np.arange(20), np.ones(3), 300.0),
        Capsule.from_mesh(organ().mesh, 20.0),
        Weight(rng.normal(size=rest.shape)),
    ]  # fmt: skip
    assert {type(force) for force in forces} == {Touch, Springs, Capsule, Weight}
    bent = rest * [1.02, 1.03, 0.98] - [0.3, 0.2, 0.8]
    way, step = rng.normal(size=rest.shape), 1e-5
    for force in forces:
        slope = (force.energy(bent + step * way)[0] - force.energy(bent - step * way)[0]) / 2 / step
        energy, gradient = force.energy(bent)
        assert energy != 0
        assert slope == pytest.approx(float((gradient * way).sum()), rel=1e-4)


def test_a_bed_knows_how_far_a_sphere_reaches_into_it() -> None:
    bed = Bed.from_organ(ellipsoid((25.0, 25.0, 25.0)))
    directions = np.array([[1.0, 0, 0], [0, -0.6, -0.8], [0, 0, -1.0]])
    for radius in (22.0, 25.0, 30.0):
        distance, slope = bed.outside(radius * directions)
        np.testing.assert_allclose(distance, radius - 25.0, atol=0.4)
        np.testing.assert_allclose(slope, directions, atol=0.08)
    depth, normal = bed.under(np.zeros((3, 3)), -10.0).distance(30.0 * directions)
    assert depth[0] > 5  # above the rim there is nothing
    np.testing.assert_allclose(depth[1:], -5.0, atol=0.4)
    np.testing.assert_allclose(normal[1:], -directions[1:], atol=0.08)


def test_the_bed_is_a_cubic_spline_of_its_grid_with_its_slope():
    rng = np.random.default_rng(0)
    bed = Bed(rng.normal(size=(7, 5, 9)), np.array([1.0, -2.0, 3.0]))
    points = bed.origin_mm + 2.5 * rng.uniform([1, 1, 1], [4.9, 2.9, 6.9], (50, 3))
    off, slope = bed.outside(points)
    places = ((points - bed.origin_mm) / 2.5).T
    expected = ndimage.map_coordinates(bed.values, places, order=3, prefilter=False)
    np.testing.assert_allclose(off, expected, atol=1e-12)
    for axis, step in enumerate(1e-4 * np.eye(3)):
        ahead, behind = bed.outside(points + step)[0], bed.outside(points - step)[0]
        np.testing.assert_allclose(slope[:, axis], (ahead - behind) / 2e-4, atol=1e-6)
    with refused(ValueError, 4):
        Bed(np.zeros((7, 3, 9)), np.zeros(3))


def test_an_organ_at_rest_stays_and_one_that_is_lifted_falls_back_into_its_bed() -> None:
    solid = soft(organ().mesh)
    stage, rest = Stage(organ(), solid), organ().mesh.nodes_mm
    bed = stage.touch(organ().bed.under(organ().points_mm, 10.0), 1.0)
    nodes, about = find_equilibrium(LoadedBody(solid, (bed,)), rest)
    assert about.iterations == 0
    np.testing.assert_array_equal(nodes, rest)
    np.testing.assert_array_equal(state("rest", 3).forward(organ().points_mm), organ().points_mm)
    weight = Weight(np.full(rest.shape, [0.0, 0, -1e-5]) * solid.node_volumes_mm3[:, None])
    fallen, _ = find_equilibrium(LoadedBody(solid, (bed, weight)), rest + [0, 0, 3.0], 400)
    assert -1.0 < (fallen - rest)[:, 2].mean() < 0.2


def test_a_cut_through_a_block_leaves_two_pieces_and_a_slit_one() -> None:
    mesh = tetrahedralise(Mesh(*trimesh_box(30.0)), 6.0)
    x = np.array([1.0, 0.0, 0.0])

    def pieces(radius: float) -> int:
        wound = cut_open(mesh, Slit(np.array([0.0, 0.0, 15.0]), x, radius))
        assert wound.mesh.volumes_mm3 == pytest.approx(mesh.volumes_mm3)
        assert len(wound.walls) % 2 == 0
        assert len(wound.mesh.nodes_mm) > len(mesh.nodes_mm)
        return int(connected_components(soft(wound.mesh).rest_stiffness)[0])

    assert pieces(100.0) == 2
    assert pieces(12.0) == 1


def trimesh_box(side_mm: float) -> tuple[np.ndarray, np.ndarray]:
    box = trimesh.creation.box((side_mm,) * 3).subdivide().subdivide()
    return box.vertices, box.faces


def test_a_twist_turns_the_ends_oppositely_by_what_was_asked() -> None:
    twisted = state("twist", 0)
    x, asked = organ().points_mm[:, 0], twisted.about["load"]["degrees"]
    turns = []
    for end in (x < np.quantile(x, 0.1), x > np.quantile(x, 0.9)):
        points = organ().points_mm[end]
        turn = kabsch(points, twisted.forward(points), np.ones(len(points)))[:3, :3]
        turns.append(np.rad2deg(Rotation.from_matrix(turn).as_rotvec()[0]))
    assert turns[0] * turns[1] < 0
    assert turns[1] - turns[0] == pytest.approx(asked, rel=0.3)


def test_a_slit_opens_and_the_tissue_beside_it_stays_whole() -> None:
    cut = state("cut", 1)
    assert cut.wound is not None
    slit, rest = cut.wound.slit, organ().points_mm
    side = (rest - slit.middle_mm) @ slit.normal
    near = (np.linalg.norm(rest - slit.middle_mm, axis=1) < 0.5 * slit.radius_mm) & (
        np.abs(side) < 7.0
    )
    moved = (cut.forward(rest) - rest) @ slit.normal
    owners = cut.wound.side[organ().owner]
    apart = moved[near & owners].mean() - moved[near & ~owners].mean()
    assert apart > 0.4 * cut.about["load"]["open_mm"]
    whole = organ().mesh.nodes_mm
    far = np.linalg.norm(whole - slit.middle_mm, axis=1) > 2 * slit.radius_mm
    at = {tuple(p) for p in whole[far]}
    same = [tuple(p) for p in cut.wound.mesh.nodes_mm if tuple(p) in at]
    assert len(same) == far.sum()  # not doubled


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "rest"])
def test_states_of_a_family_deform_and_keep_their_volume(family: str) -> None:
    made = state(family, 1 if family == "cut" else 0)
    limit = 0.02 if made.about["material"]["poisson"] >= 0.49 else 0.05
    assert abs(made.about["volume_change"]) < limit
    assert made.about["least_stretch"] > 0.3
    points = organ().points_mm
    there = made.forward(points)
    best = kabsch(points, there, np.ones(len(points)))
    left = np.linalg.norm(transform_points(best, points) - there, axis=1)
    assert left.max() > 0.3  # no rigid motion


def measured(frames: int = 1, z_mm: float = 150.0, **options: float) -> np.ndarray:
    rng = np.random.default_rng(5)
    camera = StereoCamera(CAMERA, StereoConfig(**{**SILENT, **options}), rng)
    flat = np.full((240, 424), z_mm, np.float32)
    return np.stack([camera.see(flat).depth_mm for _ in range(frames)]) - z_mm


def test_depth_noise_grows_with_distance_squared_and_is_as_wide_as_its_window() -> None:
    near, far = (np.nanstd(measured(z_mm=z)[0, 90:150, 160:260]) for z in (100.0, 200.0))
    assert far / near == pytest.approx(4.0, rel=0.02)
    # f b / z^2 of a pixel at 848 wide: what 0.08 px make at 200 mm
    assert far == pytest.approx(200**2 * 0.08 / (2 * CAMERA.fx * 18.0), rel=0.15)
    error = measured(subpixel_px=0.08, correlation_px=4.0)[0, 20:220, 20:400]
    for apart in (1, 2, 4):  # pixels: half of the matched image's; smoothed by 2
        pair = np.corrcoef(error[:, apart:].ravel(), error[:, :-apart].ravel())[0, 1]
        assert pair == pytest.approx(np.exp(-((apart / 4) ** 2)), abs=0.06)


def test_most_of_the_noise_stands_still_and_the_rest_fades() -> None:
    frames = measured(frames=4, correlation_px=0.5)[:, 20:220, 20:400]
    for apart in (1, 2, 3):
        pair = np.corrcoef(frames[0].ravel(), frames[apart].ravel())[0, 1]
        assert pair == pytest.approx(0.7 + 0.3 * 0.5**apart, abs=0.03)


def test_the_second_camera_does_not_see_past_an_edge() -> None:
    flat = np.full((240, 424), 200.0, np.float32)
    flat[:, 200:300] = 120.0
    camera = StereoCamera(CAMERA, StereoConfig(**SILENT, subpixel_px=0.0), np.random.default_rng(0))
    lost = np.isnan(camera.see(flat).depth_mm[120])
    wide = CAMERA.fx * 18.0 * (1 / 120 - 1 / 200)
    assert lost[150:200].sum() == pytest.approx(wide, abs=2)
    assert not lost[310:].any()


def test_wet_highlights_lose_returns_where_the_lamp_is_mirrored() -> None:
    assert not np.isnan(measured(gloss_degrees=0.0)).any()
    lost = np.isnan(measured(gloss_degrees=5.0)[0])
    assert 0.001 < lost.mean() < 0.2
    row, column = np.nonzero(lost)  # straight before the camera, where the lamp is beside it
    assert np.hypot(row.mean() - 120, column.mean() - 212) < 90


def test_segmentation_errors_are_as_large_as_they_say() -> None:
    sphere = Anatomy((ellipsoid((25.0, 25.0, 25.0)),))
    up, rng = np.array([0.0, 0.0, 1.0]), np.random.default_rng(0)
    radius = {}
    for kind in segmentation.KINDS:
        true, about = segmentation.perturbed(sphere, kind, up, rng)
        radius[kind] = np.linalg.norm(true.organ.vertices_mm, axis=1) - 25.0
        assert about["kind"] == kind
    assert np.abs(radius["none"]).max() < 1e-9
    by = radius["voxel"].mean()
    assert 0.7 <= abs(by) <= 1.5
    np.testing.assert_allclose(radius["voxel"], by, atol=0.02)
    pole = np.abs(sphere.organ.vertices_mm[:, 2]) > 20.0
    assert radius["slices"][pole].std() > 1.5 * radius["slices"][~pole].std() > 0
    assert np.abs(radius["slices"]).max() < 4.0
    spread = [
        segmentation.perturbed(sphere, "reader", up, np.random.default_rng(n))[1]["rms_mm"][0]
        for n in range(30)
    ]
    assert np.sqrt(np.mean(np.square(spread))) == pytest.approx(segmentation.READER_MM, rel=0.2)


def test_the_same_number_is_the_same_scene_to_the_byte(tmp_path) -> None:
    made = world(hidden=1.0)
    digests = []
    for name in ("a", "b"):
        made.scene(4).write(tmp_path / name)
        digests.append(store.sha256_of(tmp_path / name))
    assert digests[0] == digests[1]
    made.scene(5).write(tmp_path / "c")
    assert store.sha256_of(tmp_path / "c") != digests[0]


def test_a_state_is_seen_again_from_elsewhere() -> None:
    made = world(families=("rest", "plate", "cut"), hidden=0.0)
    for number in (1, 2):
        shown, there = made.shown(number), []
        scenes = made.first(shown), made.again(shown, 5)
        for scene in scenes:
            assert scene.meta["state"] == f"0-{number}"
            assert scene.targets is not None
            assert scene.meta["cloud_on_organ"] > 0.9
            back = np.linalg.inv(np.array(scene.meta["camera_from_bench"]))
            points = [scene.targets.points_mm, scene.reference.tumors[0].vertices_mm]
            there.append(transform_points(back, np.concatenate(points)))
        np.testing.assert_allclose(there[0], there[1], atol=1e-9)
        views = [np.array(scene.meta["camera_from_bench"]) for scene in scenes]
        assert np.abs(views[0] - views[1]).max() > 0.1


def test_a_hand_or_instruments_hide_the_share_that_was_asked_for() -> None:
    made, shares = world(hidden=1.0, segmentation=0.0), []
    for number in range(4):
        meta = made.scene(number).meta
        assert meta["hidden_share"] == pytest.approx(meta["hidden_wanted"], abs=0.04)
        assert meta["visible_share"] < 1.02 - meta["hidden_share"]
        shares.append(meta["hidden_share"])
    assert np.ptp(shares) > 0.2


@pytest.mark.parametrize("seed", range(4))
def test_a_random_kidney_is_closed_holds_its_tumors_and_repeats(seed) -> None:
    (anatomy, up), (again, _) = random_anatomy(seed), random_anatomy(seed)
    assert np.array_equal(anatomy.organ.vertices_mm, again.organ.vertices_mm)
    assert not np.isclose(anatomy.organ.volume_mm3, random_anatomy(seed + 1)[0].organ.volume_mm3)
    assert np.linalg.norm(up) == pytest.approx(1)
    solids = [solid_of(part, "part") for part in anatomy.parts]
    assert 1 <= len(anatomy.tumors) <= 3
    spread = anatomy.organ.vertices_mm - anatomy.organ.vertices_mm.mean(0)
    axis = np.linalg.svd(spread, full_matrices=False)[2][0]
    assert 80 < np.ptp(spread @ axis) < 165  # 90 to 130 mm, and bulging tumors
    for part, solid in zip(anatomy.parts, solids, strict=True):
        assert solid.volume() == pytest.approx(part.volume_mm3, rel=1e-3)
    for part, tumor in zip(anatomy.tumors, solids[1:], strict=True):
        assert 0.4 < part.volume_mm3 / 1000 < 55  # balls of 10 to 45 mm, in ml
        assert (tumor - solids[0]).volume() < 0.01 * tumor.volume()
