"""The wider world: forces against differences, states against what their loads must do, the second
camera's noise against its own law, and scenes that replay."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from reports import report_of
from tumortrack.core import store
from tumortrack.core.assessment import Assessment, ErrorBound
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.rigid_fit import kabsch
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.sense.camera import d405
from tumortrack.simulate.scene_folder import read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.tets import TetMesh, tetrahedralise
from tumortrack_lab.twin.equilibrium import Rod, find_equilibrium
from tumortrack_lab.twin.solid import NeoHookeanSolid
from tumortrack_lab.world import estimates, segmentation
from tumortrack_lab.world.families import FAMILIES, Deformed, solve
from tumortrack_lab.world.forces import Bed, Capsule, LoadedBody, Springs, Touch, Weight
from tumortrack_lab.world.noise import StereoCamera, StereoConfig
from tumortrack_lab.world.organ import Slit, Stage, cut_open
from world_objects import ellipsoid, organ, world

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
        bed, rod, stage.grip(np.arange(20), np.ones(3), 300.0), Capsule.of(organ().mesh, 20.0),
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
    bed = Bed.of(ellipsoid((25.0, 25.0, 25.0)))
    directions = np.array([[1.0, 0, 0], [0, -0.6, -0.8], [0, 0, -1.0]])
    for radius in (22.0, 25.0, 30.0):
        distance, slope = bed.outside(radius * directions)
        np.testing.assert_allclose(distance, radius - 25.0, atol=0.4)
        np.testing.assert_allclose(slope, directions, atol=0.08)
    depth, normal = bed.under(np.zeros((3, 3)), -10.0).distance(30.0 * directions)
    assert depth[0] > 5  # above the rim there is nothing
    np.testing.assert_allclose(depth[1:], -5.0, atol=0.4)
    np.testing.assert_allclose(normal[1:], -directions[1:], atol=0.08)


def test_an_organ_at_rest_stays_and_one_that_is_lifted_falls_back_into_its_bed() -> None:
    solid = soft(organ().mesh)
    stage, rest = Stage(organ(), solid), organ().mesh.nodes_mm
    bed = stage.touch(organ().bed.under(organ().points_mm, 10.0), 1.0)
    nodes, about = find_equilibrium(LoadedBody(solid, (bed,)), rest)
    assert about.iterations == 0
    np.testing.assert_array_equal(nodes, rest)
    np.testing.assert_array_equal(state("rest", 3).carry(organ().points_mm), organ().points_mm)
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
        turn = kabsch(points, twisted.carry(points), np.ones(len(points)))[:3, :3]
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
    moved = (cut.carry(rest) - rest) @ slit.normal
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
    there = made.carry(points)
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


def test_a_kept_state_is_seen_again_from_elsewhere(tmp_path) -> None:
    first = world(families=("rest", "plate", "cut"), hidden=0.0)
    other = world(seed=9, disturbances=("hidden",))
    for number in range(3):
        first.scene(number).write(tmp_path / str(number))
        kept = read_scene(tmp_path / str(number))
        again = other.again(other.kept(kept), 5, "hidden")
        there = []
        for scene in (kept, again):
            assert scene.meta["case_sha256"] == first.case_sha256
            assert scene.meta["state"] == f"0-{number}"
            assert scene.targets is not None
            back = np.linalg.inv(np.array(scene.meta["camera_from_bench"]))
            points = [scene.targets.points_mm, scene.reference.tumors[0].vertices_mm]
            there.append(transform_points(back, np.concatenate(points)))
        np.testing.assert_array_equal(again.targets.points_ct, kept.targets.points_ct)
        np.testing.assert_allclose(there[0], there[1], atol=1e-3)
        views = [np.array(scene.meta["camera_from_bench"]) for scene in (kept, again)]
        assert np.abs(views[0] - views[1]).max() > 0.1
        assert 0.26 < again.meta["hidden_share"] < 0.74
        assert again.meta["cloud_on_organ"] > 0.9
    with pytest.raises(InputError, match="another organ"):
        replace(other, case_sha256="ffff").kept(kept)


def test_states_and_disturbances_meet_in_all_pairs() -> None:
    made = world(families=("rest", "plate"), disturbances=("hidden", "strays", "fat", "side"))
    pairs = [made.recipe(number, 2, draw) for number in range(4) for draw in range(2)]
    assert len(set(pairs)) == len(pairs) == 8


def test_estimates_are_held_against_truth_and_rigid_pose_once_and_wrong_ones_named(
    tmp_path, monkeypatch
) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / store.MANIFEST).write_text("{}")
    out, made = tmp_path / "organ", world(disturbances=("none", "nothing"), hidden=0.0)
    names = ["0-rest-none", "1-rest-nothing"]
    scenes = [made.scene(number) for number in range(2)]
    for name, scene in zip(names, scenes, strict=True):
        scene.write(out / name)
    back = np.linalg.inv(np.array(scenes[0].meta["camera_from_bench"]))
    shift = np.linalg.inv(back)  # before the camera, and 10 mm beside where it lies
    shift[:3, 3] += [6.0, 8.0, 0.0]
    motion = SimpleNamespace(
        carry=lambda points: transform_points(shift @ made.bench_from_ct, points),
        std_mm=lambda points: np.ones(len(points)),
    )
    told = report_of(parts={"kidney": {}, "tumor_1": {}})
    said = Assessment(bounds={"tumor_1": ErrorBound(3.0)})
    about = {"quality": "good", "reason": "", "motion": motion, "report": told, "assessment": said}
    answer, asked = SimpleNamespace(**about), []
    monkeypatch.setattr(Tracker, "follow", lambda _, cloud, seen: asked.append(cloud) or answer)
    monkeypatch.setattr(estimates, "load_model", lambda *args, **how: None)
    monkeypatch.setattr(estimates, "Tracker", lambda model: Tracker.__new__(Tracker))
    for upto in (1, 2, 2):
        estimates.measure(tmp_path / "model", made.anatomy_ct, out, names[:upto])
    assert len(asked) == 2
    rows = estimates.read_rows([out])
    assert rows.off[0] == pytest.approx(10.0, abs=1.5)  # as segmentation errs
    assert rows["shape"][0] < 1.5
    assert rows.rigid[0] < 1.5
    assert 0 < rows.fit[0] < 3.0
    assert list(rows.wrong) == [True, True]
    lines, off = estimates.verdicts(rows), f"{rows.off[0]:.1f}"
    known = lines.set_index(["by", "value"]).T
    assert list(known["family", "rest"])[:6] == [1, 0, 0, 1, 1, off]
    assert list(known["disturbance", "nothing"])[:6] == [1, 0, 0, 1, 1, ""]
    each = (f"{rows[name][0]:.1f}" for name in ("off", "rigid", "fit"))
    shown = " | ".join(f"{mm} / {mm} / {mm}" for mm in each)
    assert f"| rest | 1 | 1 | 1 | {shown} |" in estimates.summary(lines)
    before = estimates.verdicts(rows.assign(fit=np.nan))
    assert f"| {shown.rpartition(' |')[0]} | – |" in estimates.summary(before)
    wrong = estimates.wrong_ones(rows)
    assert list(wrong.wrong) == ["wrong pose", "not this organ"]
    assert list(wrong.scene) == names
    assert estimates.wrong_ones(rows.assign(wrong=False)).empty
    monkeypatch.setattr(estimates, "fingerprint", lambda: "another")
    with pytest.raises(InputError, match="another version"):
        estimates.read_rows([out])


def test_a_hand_or_instruments_hide_the_share_that_was_asked_for() -> None:
    made, shares = world(hidden=1.0, segmentation=0.0), []
    for number in range(4):
        meta = made.scene(number).meta
        assert meta["hidden_share"] == pytest.approx(meta["hidden_wanted"], abs=0.04)
        assert meta["visible_share"] < 1.02 - meta["hidden_share"]
        shares.append(meta["hidden_share"])
    assert np.ptp(shares) > 0.2


def test_disturbed_scenes_say_what_disturbs_them() -> None:
    kinds = ("strays", "white", "scale", "side", "mirrored", "foreign", "nothing")
    made = world(disturbances=kinds, hidden=0.0, segmentation=0.0)
    scenes = {kind: made.scene(number) for number, kind in enumerate(kinds)}
    for kind, scene in scenes.items():
        assert scene.meta["disturbance"]["kind"] == kind
        right = kind not in ("mirrored", "foreign", "nothing")
        assert scene.meta["model_organ"] is right
        assert (scene.targets is not None) is right
    how = {kind: scene.meta["disturbance"] for kind, scene in scenes.items()}
    z_mm = scenes["scale"].reference.organ.vertices_mm[:, 2].min()
    seen = scenes["scale"].cloud.points_mm[:, 2].min()
    assert seen == pytest.approx(how["scale"]["scale"] * z_mm + how["scale"]["offset_mm"], abs=4.0)
    assert scenes["side"].meta["cloud_on_organ"] > 0.9
    box = np.ptp(scenes["mirrored"].reference.tumors[0].vertices_mm, axis=0)
    assert (box > 10).all()
    assert scenes["nothing"].reference.tumors == ()
