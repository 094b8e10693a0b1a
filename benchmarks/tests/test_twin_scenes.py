"""Scenes of the digital twin: views, the folder and its resumption.

A smooth squeeze in closed form takes the solver's place.
"""

import json
import multiprocessing
import os
import shutil

import numpy as np
import pytest
import trimesh

import render_objects
from clock import PATIENCE_S
from refused import refused
from stories import succeeded, tumortrack
from tumortrack.core import store
from tumortrack.core.camera import deproject
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.mesh_query import contains, labels_of
from tumortrack.core.types import LabelVolume
from tumortrack.io.case import Case, load_case, save_case
from tumortrack.io.mesh_files import read_mesh
from tumortrack.io.scene_folder import list_scenes, read_scene
from tumortrack.report.inspection import describe
from tumortrack.report.metrics import label_grid
from tumortrack_benchmarks.physics import twin
from tumortrack_benchmarks.physics.equilibrium import Rod
from tumortrack_benchmarks.physics.families import Deformed
from tumortrack_benchmarks.physics.occluders import rod_mesh, shaft_over
from tumortrack_benchmarks.physics.twin import VARIANTS, VIEWS, Bench, make_scene, make_scenes

UP = (0.0, -1.0, 0.0)
HALF_HEIGHT = 28.0  # of the ellipsoid kidney along UP
BY_MM = {"D0": 0.0, "D1": 4.0, "D2": 8.0, "D3": 12.0, "G1": 8.0, "P1": 6.0}
POKE = {"tip_mm": [20.0, -4.0, 40.0], "axis": [0.0, 0.0, 1.0], "radius_mm": 4.0}


class Squeezed(Deformed):
    def forward(self, points_mm):
        sinking = self.about["by"] * np.exp(-(points_mm[:, 0] ** 2) / 800) * points_mm[:, 2]
        return points_mm - sinking[:, None] / (2 * HALF_HEIGHT) * [0.0, 0.0, 1.0]


def squeeze(bench, name, progress=print):
    progress("one step")
    organ, about = bench.stage.organ, {"by": BY_MM[name]}
    about |= {"poke": POKE} if name == "P1" else {}
    return Squeezed(organ, organ.mesh.nodes_mm, organ.mesh.tets, 10.0, None, about)


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    monkeypatch.setattr(twin, "solve", squeeze)
    monkeypatch.setattr(twin, "EDGE_MM", 12.0)


@pytest.fixture
def no_pictures(monkeypatch):
    """Pictures take most of a scene's time."""
    monkeypatch.setattr(twin, "twin_picture", lambda scene, path: path.write_bytes(b"picture"))


@pytest.fixture(scope="module")
def case_folder(tmp_path_factory):
    anatomy = render_objects.anatomy(3)
    lps_from_index = rigid(np.eye(3), np.array([-55.0, -33, -29]))
    labels = label_grid(anatomy, lps_from_index, (111, 67, 59))
    folder = tmp_path_factory.mktemp("cases") / "case"
    with store.new_folder(folder) as aside:
        save_case(Case(anatomy, LabelVolume(labels, lps_from_index), UP), aside)
    return folder


@pytest.fixture(scope="module")
def bench(case_folder, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(twin, "EDGE_MM", 12.0)
        case = load_case(case_folder)
        return Bench.from_anatomy(case.anatomy, UP, tmp_path_factory.mktemp("bench") / "tets")


@pytest.fixture
def scene(bench):
    def made(variant="D0", view="clean", seed=0):
        return make_scene(bench, squeeze(bench, VARIANTS[variant].state), variant, view, seed)

    return made


@pytest.fixture(scope="module")
def made(case_folder, tmp_path_factory):
    """Two variants in two views."""
    out = tmp_path_factory.mktemp("twin") / "scenes"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(twin, "solve", squeeze)
        patch.setattr(twin, "EDGE_MM", 12.0)
        make_scenes(case_folder, out, ("Rot90",), ("clean",))
        patch.setattr(twin, "twin_picture", lambda scene, path: path.write_bytes(b"picture"))
        make_scenes(case_folder, out, ("Rot90", "P1"), ("clean", "clutter"))
    return out


def test_a_camera_over_a_tall_organ_is_raised(case_folder, tmp_path):
    tall = load_case(case_folder).anatomy
    tall = tall.with_parts(
        part.with_vertices(part.vertices_mm * [1, 1.6, 1]) for part in tall.parts
    )
    bench = Bench.from_anatomy(tall, UP, tmp_path / "tets")
    far_mm = 3.2 * HALF_HEIGHT + 85
    meta = make_scene(bench, squeeze(bench, "D0"), "D0", "clean", 0).meta
    assert meta["crop_mm"] == [50.0, pytest.approx(far_mm, abs=0.5)]


def test_the_camera_looks_down_and_is_turned_about_its_axis(scene):
    points = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 60]])
    seen = transform_points(twin.camera_from_bench(150.0), points)
    assert np.allclose(seen, [[0, 0, 150], [10, 0, 150], [0, -10, 90]])
    plain, turned = (scene(name).reference for name in ("D0", "Rot90"))
    for before, after in zip(plain.parts, turned.parts, strict=True):
        assert np.array_equal(before.faces, after.faces)
        spin = before.vertices_mm[:, [1, 0, 2]] * [-1, 1, 1]
        assert np.allclose(spin, after.vertices_mm, atol=1e-10)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_crop_keeps_all_that_is_visible(scene, variant):
    made = scene(variant)
    seen = made.depth.depth_mm[np.isfinite(made.depth.depth_mm)]
    assert seen.min() > 50
    assert seen.max() < 150
    assert len(made.cloud.points_mm) == 5000
    # Clean points lie on the true surface of this very state: rays from the camera end there.
    points = made.cloud.points_mm[:100].astype(float)
    hits = render_objects.ray_hits(np.zeros(3), points, made.reference.organ, slack=1e-4)
    assert np.allclose(hits.min(1), 1, atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_a_shaft_never_touches_the_organ(scene, seed):
    made = scene("D0")
    rod = shaft_over(made.depth, 4.0, np.random.default_rng(seed))
    assert not contains(rod_mesh(rod), made.reference.organ.vertices_mm).any()
    # And its tip is near: over the organ's middle, a few mm above it.
    nearest = np.linalg.norm(made.cloud.points_mm - np.array(rod.tip_mm), axis=1).min()
    assert 0.9 < nearest < 15


def test_what_a_rod_hides_lies_behind_it(bench, scene):
    """Lost pixels are those whose line of sight passes the rod's axis within its radius."""
    covered, state = scene("P1"), squeeze(bench, "P1")
    del state.about["poke"]
    open_view = make_scene(bench, state, "P1", "clean", 0)
    before, after = open_view.depth.depth_mm, covered.depth.depth_mm
    lost = np.isfinite(before) & np.isnan(after)
    assert lost.sum() / np.isfinite(before).sum() == pytest.approx(
        covered.meta["seen"]["rod_covers_share"]
    )
    camera = covered.depth.intrinsics
    row, column = np.nonzero(np.isfinite(before))
    rays = np.stack(
        [(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(row))], axis=1
    )
    tip = transform_points(twin.camera_from_bench(150.0), np.array([[20.0, -4, 40]]))[0]
    axis = np.array([0.0, 0.0, -1.0])
    # Nearest approach of two lines, for rays that meet the rod above its round end.
    normal = np.cross(rays, axis)
    gap = np.abs(normal @ tip) / np.linalg.norm(normal, axis=1)
    outward = rays[:, :2] @ tip[:2] / np.hypot(*tip[:2]) * (tip[2] - 4) - np.hypot(*tip[:2])
    on_side = outward > 0.5  # beyond the tip as seen from the camera: only the side can hide it
    hidden = lost[row, column]
    assert hidden[on_side & (gap < 3.9)].all()
    assert not hidden[gap > 4.05].any()


def test_a_rod_has_its_size():
    solid = rod_mesh(Rod(np.array([1.0, 2.0, 90.0]), np.array([0.6, 0.0, -0.8]), 4.0, 60.0))
    mesh = trimesh.Trimesh(solid.vertices_mm, solid.faces)
    assert mesh.is_watertight
    along = (solid.vertices_mm - [1, 2, 90]) @ [0.6, 0, -0.8]
    assert along.min() == pytest.approx(0, abs=1e-9)
    assert along.max() == pytest.approx(60)
    whole = np.pi * 16 * 56 + 2 / 3 * np.pi * 64
    assert solid.volume_mm3 == pytest.approx(whole, rel=0.01)


def test_background_is_three_percent_and_only_adds(scene):
    clean = scene("D2")
    cluttered = scene("D2", "clutter")
    before, after = clean.depth.depth_mm, cluttered.depth.depth_mm
    organ = np.isfinite(before)
    assert np.array_equal(after[organ], before[organ])
    added = np.isfinite(after) & ~organ
    assert abs(added.sum() - 0.03 * np.isfinite(after).sum()) <= 1
    assert (after[added] < 150).all()
    assert (after[added] > 50).all()
    # So the cloud has about as many: 150 of 5000, a binomial draw.
    organ_points = deproject(clean.depth)
    kept = {tuple(p) for p in organ_points.tolist()}
    outliers = sum(tuple(p) not in kept for p in cluttered.cloud.points_mm.tolist())
    assert 100 <= outliers <= 200


@pytest.mark.parametrize("view", VIEWS)
def test_scenes_replay_bit_for_bit(scene, view):
    one, again, other = scene("D1", view, 3), scene("D1", view, 3), scene("D1", view, 4)
    assert np.array_equal(one.cloud.points_mm, again.cloud.points_mm)
    assert np.array_equal(one.depth.depth_mm, again.depth.depth_mm, equal_nan=True)
    assert one.meta == again.meta
    assert not np.array_equal(one.cloud.points_mm, other.cloud.points_mm)


def test_the_folder_holds_scenes_with_truth_targets_and_picture(made, case_folder):
    names = [p.name for p in list_scenes(made)]
    assert names == ["P1-clean", "P1-clutter", "Rot90-clean", "Rot90-clutter"]
    for name in names:
        back = read_scene(made / name)
        assert back.meta["case_sha256"] == store.sha256_of(case_folder / store.MANIFEST)
        assert len(back.reference.tumors) == 2
        assert back.depth is not None
        camera, labels = back.targets.points_mm, back.targets.labels
        assert np.bincount(labels).tolist() == [0, 100, 50, 50]
        assert np.array_equal(labels_of(back.reference, camera), labels)
    assert (made / "Rot90-clean" / "scene.png").stat().st_size > 30_000
    manifest = store.read_manifest(made, "twin")
    assert list(manifest["scenes"]) == [n for v in VARIANTS for n in names if n.startswith(f"{v}-")]
    assert any("4 scenes" in line for line in describe(made))


def test_vertices_keep_the_cases_order(made, case_folder):
    """Row n of a scene's mesh file is row n of the case's mesh as it is read."""
    case = read_mesh(case_folder / "tumor_1.ply")
    raw = trimesh.load(made / "Rot90-clean" / "tumor_1.ply", process=False)
    meta = json.loads((made / "Rot90-clean" / "meta.json").read_text())
    carried = transform_points(np.array(meta["camera_from_ct"]), case.vertices_mm)
    assert np.allclose(raw.vertices, carried, atol=1e-4)
    assert np.array_equal(raw.faces, case.faces)


def test_a_finished_folder_is_left_alone_and_can_be_extended(
    made, no_pictures, case_folder, tmp_path, monkeypatch
):
    out = shutil.copytree(made, tmp_path / "scenes")
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    with monkeypatch.context() as patch:
        patch.setattr(twin, "solve", None)  # nothing is solved again
        assert len(make_scenes(case_folder, out, ("Rot90", "P1"), ("clean", "clutter"))) == 4
    changed = [p.name for p, t in before.items() if p.stat().st_mtime_ns != t]
    assert changed == ["manifest.json"]
    said = []
    make_scenes(case_folder, out, ("D0", "D1"), ("clean",), report=said.append)
    assert len(store.read_manifest(out, "twin")["scenes"]) == 6
    assert said[-1] == "2 of 2 scenes: D1-clean"
    (out / "P1-clean" / "targets.csv").write_text("label\n")
    assert any("CHANGED" in line and "P1-clean" in line for line in describe(out))


def _die_in_d3(case_folder, out):
    def solve(bench, name, progress):
        if name == "D3":
            os.kill(os.getpid(), 9)
        return squeeze(bench, name, progress)

    twin.solve = solve
    make_scenes(case_folder, out, ("D1", "D3"), ("clean",))


def test_a_killed_run_loses_one_state_and_ends_as_if_it_had_lived(
    no_pictures, case_folder, tmp_path
):
    out, whole = tmp_path / "killed", tmp_path / "whole"
    make_scenes(case_folder, out, ("D0",), ("clean",))
    shutil.copytree(out, whole)  # with the same tetrahedra
    child = multiprocessing.get_context("fork").Process(target=_die_in_d3, args=(case_folder, out))
    child.start()
    child.join(5 * PATIENCE_S)
    assert child.exitcode == -9
    assert (out / "D1-clean").is_dir()
    assert not (out / "D3-clean").exists()
    for folder in (out, whole):
        make_scenes(case_folder, folder, ("D1", "D3"), ("clean",))
    for name in ("D1-clean", "D3-clean"):
        for file in ("cloud.ply", "depth.png", "kidney.ply", "targets.csv", "meta.json"):
            assert (out / name / file).read_bytes() == (whole / name / file).read_bytes()


def test_other_scenes_other_files_and_unknown_names_are_refused(made, case_folder, tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    with refused(InputError, "seed"):
        make_scenes(case_folder, made, ("D0",), ("clean",), seed=1)
    for folder, state, named in ((tmp_path, "D0", tmp_path), (tmp_path / "x", "D7", "D7")):
        with refused(InputError, named):
            make_scenes(case_folder, folder, (state,), ("clean",))
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_the_command_makes_what_is_asked_for(case_folder, tmp_path):
    out = tmp_path / "scenes"
    options = ["--states", "D0", "Rot90", "--views", "shaft", "--seed", "3"]
    said = succeeded(tumortrack("twin", case_folder, out, *options))
    assert [p.name for p in list_scenes(out)] == ["D0-shaft", "Rot90-shaft"]
    assert store.read_json(out / "twin.json")["seed"] == 3
    assert str(out) in said
