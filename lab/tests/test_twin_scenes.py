"""Scenes of the digital twin: views, the folder and its resumption.

A stand-in takes the bench's place: a smooth squeeze with the same interface, solved at once.
"""

import json
import multiprocessing
import os
import shutil
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import render_objects
from tumortrack.cli import main as cli
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.mesh_query import contains, labels_of
from tumortrack.core.report import FitReport
from tumortrack.core.types import CameraLabels, LabelVolume
from tumortrack.imaging.case import Case, save_case
from tumortrack.report.inspection import describe
from tumortrack.report.metrics import label_grid
from tumortrack.report.protocol import evaluate_scenes
from tumortrack.sense.camera import deproject
from tumortrack.simulate.scene_folder import draw_targets, list_scenes, read_scene
from tumortrack_lab.twin import dataset
from tumortrack_lab.twin.apparatus import State
from tumortrack_lab.twin.dataset import TwinRun, make_scenes
from tumortrack_lab.twin.equilibrium import Rod
from tumortrack_lab.twin.occluders import rod_mesh, shaft_over
from tumortrack_lab.twin.views import (
    VARIANTS,
    VIEWS,
    EquilibriumState,
    ViewConfig,
    camera_from_bench,
    for_organ,
    make_scene,
)

UP = (0.0, -1.0, 0.0)
HALF_HEIGHT = 28.0  # of the ellipsoid kidney along UP
# CT frame -> bench: anterior (-y) becomes up, x stays.
BENCH_FROM_CT = rigid(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0, 0, HALF_HEIGHT]))
REPORTS = {
    "D0": {"state": "D0"},
    "D1": {"state": "D1", "by": 4.0, "plate_z_mm": 52.0, "volume_change": 0.001},
    "D2": {"state": "D2", "by": 8.0, "plate_z_mm": 48.0, "volume_change": 0.001},
    "D3": {"state": "D3", "by": 12.0, "plate_z_mm": 44.0, "volume_change": 0.001},
    "G1": {"state": "G1", "by": 8.0},
    "P1": {
        "state": "P1",
        "by": 6.0,
        "poke": {"tip_mm": [20.0, -4.0, 40.0], "axis": [0.0, 0.0, 1.0], "radius_mm": 4.0},
    },
}


class StandIn:
    """What the bench does, as a squeeze in closed form; counts what it solved."""

    solved: tuple = ()

    def __init__(self, anatomy_ct, up_lps, config):
        assert up_lps == UP
        self.bench_from_ct = BENCH_FROM_CT
        self.mesh = SimpleNamespace(nodes_mm=np.zeros((4, 3)))

    @staticmethod
    def solve(bench, name, warm=None, progress=None):
        StandIn.solved += ((name, None if warm is None else warm.name),)
        progress("one step")
        return State(name, np.full((4, 3), 1.0), REPORTS[name])

    def carry(self, state, points_ct):
        points = transform_points(BENCH_FROM_CT, points_ct)
        by = state.report.get("by", 0.0)
        sinking = by * np.exp(-(points[:, 0] ** 2) / 800) * points[:, 2] / (2 * HALF_HEIGHT)
        return points - sinking[:, None] * [0.0, 0.0, 1.0]


@lru_cache
def settled(state):
    case = render_objects.anatomy(4)
    bench = StandIn(case, UP, None)
    there = State(state, np.zeros((4, 3)), REPORTS[state])
    parts = tuple(p.moved(bench.carry(there, p.vertices_mm)) for p in case.parts)
    targets = bench.carry(there, draw_targets(case, 0).points_ct)
    return EquilibriumState(state, type(case)(parts), targets, BENCH_FROM_CT, REPORTS[state])


def scene(variant="D0", view="clean", seed=0, config=None):
    return make_scene(settled(VARIANTS[variant].state), variant, view, config or ViewConfig(), seed)


@pytest.fixture(scope="module")
def case_folder(tmp_path_factory):
    anatomy = render_objects.anatomy(3)
    low = np.array([-55.0, -33, -29])
    lps_from_index = rigid(np.eye(3), low)
    labels = label_grid(anatomy, lps_from_index, (111, 67, 59))
    folder = tmp_path_factory.mktemp("cases") / "case"
    with store.new_folder(folder) as aside:
        save_case(Case(anatomy, LabelVolume(labels, lps_from_index), UP), aside)
    return folder


SMALL = ViewConfig(width=424, height=240, n_points=2000)


@pytest.fixture
def no_pictures(monkeypatch):
    """Pictures take most of a scene's time, and are looked at elsewhere."""
    monkeypatch.setattr(dataset, "twin_picture", lambda scene, path: path.write_bytes(b"picture"))


@pytest.fixture(scope="module")
def made(case_folder, tmp_path_factory):
    """Two variants in two views."""
    out = tmp_path_factory.mktemp("twin") / "scenes"
    run = TwinRun(case_folder, view=SMALL, build=StandIn, solve=StandIn.solve)
    make_scenes(run, out, ("Rot90",), ("clean",))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "twin_picture", lambda scene, path: path.write_bytes(b"picture"))
        make_scenes(run, out, ("Rot90", "P1"), ("clean", "clutter"))
    return out


# --- views ---


def test_the_camera_looks_down_on_the_bench():
    to_camera = camera_from_bench(ViewConfig())
    points = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 60]])
    assert np.allclose(
        transform_points(to_camera, points), [[0, 0, 150], [10, 0, 150], [0, -10, 90]]
    )


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_rotations_are_d0_turned_about_the_cameras_axis(turn):
    plain, targets = scene("D0")
    turned, turned_targets = scene(f"Rot{turn}")
    angle = np.deg2rad(turn)
    spin = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    for before, after in zip(plain.reference.parts, turned.reference.parts, strict=True):
        assert np.array_equal(before.faces, after.faces)
        assert np.allclose(before.vertices_mm @ spin.T, after.vertices_mm, atol=1e-10)
    assert np.allclose(targets @ spin.T, turned_targets, atol=1e-10)
    # The vertices are turned by whole numbers: nothing is rounded.
    assert np.array_equal(np.rint(spin) @ plain.reference.organ.vertices_mm.T,
                          turned.reference.organ.vertices_mm.T)  # fmt: skip


def test_cameras_and_truth_agree_with_the_case():
    """camera_from_ct carries the case onto the reference where nothing is deformed."""
    made, _ = scene("Rot90")
    case = render_objects.anatomy(4)
    for part, truth in zip(case.parts, made.reference.parts, strict=True):
        carried = transform_points(np.array(made.meta["camera_from_ct"]), part.vertices_mm)
        assert np.allclose(carried, truth.vertices_mm, atol=1e-9)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_crop_keeps_all_that_is_visible(variant):
    made, _ = scene(variant)
    assert made.meta["seen"]["in_image_share"] == 1
    seen = made.depth.depth_mm[np.isfinite(made.depth.depth_mm)]
    assert seen.min() > 50
    assert seen.max() < 150
    assert len(made.cloud.points_mm) == 5000
    # Clean points lie on the true surface of this very state: rays from the camera end there.
    points = made.cloud.points_mm[:100].astype(float)
    hits = render_objects.ray_hits(np.zeros(3), points, made.reference.organ, slack=1e-4)
    assert np.allclose(hits.min(1), 1, atol=1e-4)


def test_the_camera_rises_over_tall_organs():
    plain = ViewConfig()
    assert for_organ(plain, 60.0) == plain
    tall = for_organ(plain, 90.0)
    assert tall.camera_above_mm == 175
    assert tall.far_mm == 175  # the support stays the limit
    made, targets = scene("Rot90", config=tall)
    assert made.meta["seen"]["in_image_share"] == 1
    _, lower_targets = scene("Rot90")
    assert np.allclose(targets - lower_targets, [0, 0, 25])


def test_a_shaft_only_takes_points_away():
    clean, _ = scene("D1")
    covered, _ = scene("D1", "shaft")
    before, after = clean.depth.depth_mm, covered.depth.depth_mm
    kept = np.isfinite(after)
    assert np.array_equal(after[kept], before[kept])
    lost = np.isfinite(before) & ~kept
    share = lost.sum() / np.isfinite(before).sum()
    assert share == pytest.approx(covered.meta["seen"]["shaft_covers_share"])
    assert 0.02 < share < 0.3


@pytest.mark.parametrize("seed", range(4))
def test_a_shaft_never_touches_the_organ(seed):
    made, _ = scene("D0")
    rod = shaft_over(made.depth, 4.0, np.random.default_rng(seed))
    inside = contains(rod_mesh(rod), made.reference.organ.vertices_mm)
    assert not inside.any()
    # And its tip is near: over the organ's middle, a few mm above it.
    nearest = np.linalg.norm(made.cloud.points_mm - np.array(rod.tip_mm), axis=1).min()
    assert 0.9 < nearest < 15


def test_what_a_rod_hides_lies_behind_it():
    """Lost pixels are those whose line of sight passes the rod's axis within its radius."""
    covered, _ = scene("P1")
    open_view, _ = make_scene(
        replace(settled("P1"), report={"state": "P1"}), "P1", "clean", ViewConfig(), 0
    )
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
    tip = transform_points(camera_from_bench(ViewConfig()), np.array([[20.0, -4, 40]]))[0]
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


def test_background_is_three_percent_and_only_adds():
    clean, _ = scene("D2")
    cluttered, _ = scene("D2", "clutter")
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
    strays = sum(tuple(p) not in kept for p in cluttered.cloud.points_mm.tolist())
    assert 100 <= strays <= 200


@pytest.mark.parametrize("view", VIEWS)
def test_scenes_replay_bit_for_bit(view):
    (one, targets), (again, targets_again) = scene("D1", view, 3), scene("D1", view, 3)
    assert np.array_equal(one.cloud.points_mm, again.cloud.points_mm)
    assert np.array_equal(one.depth.depth_mm, again.depth.depth_mm, equal_nan=True)
    assert np.array_equal(targets, targets_again)
    assert one.meta == again.meta
    other, _ = scene("D1", view, 4)
    assert not np.array_equal(one.cloud.points_mm, other.cloud.points_mm)


# --- targets ---


def test_targets_lie_inside_their_parts():
    anatomy = render_objects.anatomy(4)
    targets = draw_targets(anatomy, 0)
    assert np.bincount(targets.labels).tolist() == [0, 100, 50, 50]
    assert np.array_equal(labels_of(anatomy, targets.points_ct), targets.labels)
    assert np.array_equal(draw_targets(anatomy, 0).points_ct, targets.points_ct)
    # Known answer: the parts' own solid angles, not the ray test that drew the points.
    for label in (2, 3):
        mine = targets.points_ct[targets.labels == label][:10]
        winding = render_objects.winding_number(anatomy.parts[label - 1], mine)
        assert np.allclose(winding, 1, atol=0.01)


def test_an_organ_without_tumors_has_all_targets():
    organ = type(render_objects.anatomy(3))(render_objects.anatomy(3).parts[:1])
    targets = draw_targets(organ, 1)
    assert (targets.labels == 1).all()
    assert contains(organ.organ, targets.points_ct).all()


def test_a_tumor_that_others_cover_is_refused():
    parts = render_objects.anatomy(3).parts
    with pytest.raises(InputError, match="tumor_1 has no room"):
        draw_targets(type(render_objects.anatomy(3))((parts[0], parts[1], parts[1])), 0)


# --- the folder ---


def test_the_folder_holds_scenes_with_truth_targets_and_picture(made, case_folder):
    names = [p.name for p in list_scenes(made)]
    assert names == ["P1-clean", "P1-clutter", "Rot90-clean", "Rot90-clutter"]
    for name in names:
        folder = made / name
        back = read_scene(folder)
        assert back.meta["case_sha256"] == store.sha256_of(case_folder / store.MANIFEST)
        assert len(back.reference.tumors) == 2
        assert back.depth is not None
        table = np.genfromtxt(folder / "targets.csv", delimiter=",", names=True)
        assert ",".join(table.dtype.names) == "label,ct_x,ct_y,ct_z,camera_x,camera_y,camera_z"
        camera = np.stack([table[f"camera_{axis}"] for axis in "xyz"], axis=1)
        assert np.array_equal(labels_of(back.reference, camera), table["label"])
    assert (made / "Rot90-clean" / "scene.png").stat().st_size > 30_000
    manifest = store.read_manifest(made, "twin")
    assert list(manifest["scenes"]) == [n for v in VARIANTS for n in names if n.startswith(f"{v}-")]
    assert any("4 scenes" in line for line in describe(made))


def test_vertices_keep_the_cases_order(made, case_folder):
    """Row n of a scene's mesh file is row n of the case's mesh as it is read."""
    from tumortrack.core.mesh_files import read_mesh

    case = read_mesh(case_folder / "tumor_1.ply")
    raw = trimesh.load(made / "Rot90-clean" / "tumor_1.ply", process=False)
    meta = json.loads((made / "Rot90-clean" / "meta.json").read_text())
    carried = transform_points(np.array(meta["camera_from_ct"]), case.vertices_mm)
    assert np.allclose(raw.vertices, carried, atol=1e-4)
    assert np.array_equal(raw.faces, case.faces)


def test_the_protocol_reads_the_scenes(made, tmp_path):
    """A perfect answer from the kept truth scores as one."""
    scenes = tmp_path / "scenes"
    shutil.copytree(made / "P1-clutter", scenes / "P1-clutter")
    truth = read_scene(scenes / "P1-clutter").reference

    def locate(cloud):
        low = truth.organ.box_mm[0] - 2
        camera_from_index = rigid(np.eye(3), low) @ np.diag([2.0, 2, 2, 1])
        size = np.ceil((truth.organ.box_mm[1] + 2 - low) / 2).astype(int)
        labels = label_grid(truth, camera_from_index, tuple(size.tolist()))
        meshes = dict(zip(truth.names, truth.parts, strict=True))
        from tumortrack.core.types import OccupancyCloud

        points = OccupancyCloud(cloud.points_mm[:5], np.ones(5), np.ones(5))
        return Estimate(points, CameraLabels(labels, camera_from_index), meshes, FitReport())

    report = evaluate_scenes(locate, scenes, tmp_path / "report")
    assert report["summary"]["scenes"] == 1
    assert report["summary"]["failed"] == 0
    assert report["summary"]["miou"] == 1.0
    assert report["summary"]["tumor_1"]["hausdorff_mm"] < 1e-3


def test_a_finished_folder_is_left_alone_and_can_be_extended(
    made, no_pictures, case_folder, tmp_path
):
    out = shutil.copytree(made, tmp_path / "scenes")
    run = TwinRun(case_folder, view=SMALL, build=StandIn, solve=StandIn.solve)
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    StandIn.solved = ()
    assert len(make_scenes(run, out, ("Rot90", "P1"), ("clean", "clutter"))) == 4
    assert StandIn.solved == ()
    changed = [p.name for p, t in before.items() if p.stat().st_mtime_ns != t]
    assert changed == ["manifest.json"]
    said = []
    make_scenes(run, out, ("D0", "D1"), ("clean",), said.append)
    assert StandIn.solved == (("D1", None),)  # D0 was kept from Rot90
    assert len(store.read_manifest(out, "twin")["scenes"]) == 6
    assert said[-1] == "2 of 2 scenes: D1-clean"
    assert any("one step" in text for text in said)


def test_more_compression_goes_on_from_less(no_pictures, case_folder, tmp_path):
    run = TwinRun(case_folder, view=SMALL, build=StandIn, solve=StandIn.solve)
    make_scenes(run, tmp_path / "a", ("D1",), ("clean",))
    StandIn.solved = ()
    make_scenes(run, tmp_path / "a", ("D2", "D3"), ("clean",))  # D1 from its file
    assert StandIn.solved == (("D2", "D1"), ("D3", "D2"))


def _die_in_d3(case_folder, out):
    def solve(bench, name, warm=None, progress=None):
        if name == "D3":
            os.kill(os.getpid(), 9)
        return StandIn.solve(bench, name, warm, progress)

    run = TwinRun(case_folder, view=SMALL, build=StandIn, solve=solve)
    make_scenes(run, out, ("D1", "D3"), ("clean",))


def test_a_killed_run_loses_one_state_and_ends_as_if_it_had_lived(
    no_pictures, case_folder, tmp_path
):
    out = tmp_path / "killed"
    child = multiprocessing.get_context("fork").Process(target=_die_in_d3, args=(case_folder, out))
    child.start()
    child.join(60)
    assert child.exitcode == -9
    assert (out / "D1-clean").is_dir()
    assert not (out / "D3-clean").exists()
    assert "not finished (1 so far)" in describe(out)[0]
    run = TwinRun(case_folder, view=SMALL, build=StandIn, solve=StandIn.solve)
    StandIn.solved = ()
    make_scenes(run, out, ("D1", "D3"), ("clean",))
    assert StandIn.solved == (("D3", None),)
    make_scenes(run, tmp_path / "whole", ("D1", "D3"), ("clean",))
    for name in ("D1-clean", "D3-clean"):
        for file in ("cloud.ply", "depth.png", "kidney.ply", "targets.csv", "meta.json"):
            assert (out / name / file).read_bytes() == (
                tmp_path / "whole" / name / file
            ).read_bytes()


def test_other_scenes_other_files_and_unknown_names_are_refused(
    made, no_pictures, case_folder, tmp_path
):
    run = TwinRun(case_folder, view=SMALL, build=StandIn, solve=StandIn.solve)
    with pytest.raises(InputError, match="scenes of another seed"):
        make_scenes(replace(run, seed=1), made, ("D0",), ("clean",))
    softer = replace(run, bench=type(run.bench)(youngs_kpa=5.0), view=ViewConfig())
    with pytest.raises(InputError, match="another bench_config and view_config"):
        make_scenes(softer, made, ("D0",), ("clean",))
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files"):
        make_scenes(run, tmp_path, ("D0",), ("clean",))
    with pytest.raises(InputError, match="'D7' is not known; allowed: D0, D1"):
        make_scenes(run, tmp_path / "x", ("D7",), ("clean",))
    assert not (tmp_path / "x").exists()


def test_the_command_passes_its_options_on(no_pictures, case_folder, tmp_path, monkeypatch, capsys):
    def run(case, seed):
        return TwinRun(case, view=SMALL, seed=seed, build=StandIn, solve=StandIn.solve)

    out = tmp_path / "scenes"
    monkeypatch.setattr(dataset, "TwinRun", run)
    options = ["--states", "D1", "P1", "--views", "shaft", "--seed", "3"]
    monkeypatch.setattr("sys.argv", ["tumortrack", "twin", str(case_folder), str(out), *options])
    cli.main()
    assert [p.name for p in list_scenes(out)] == ["D1-shaft", "P1-shaft"]
    assert store.read_json(out / "twin.json")["seed"] == 3
    assert "2 scenes in" in capsys.readouterr().out


def test_a_damaged_state_is_named(made, no_pictures, case_folder, tmp_path):
    out = shutil.copytree(made, tmp_path / "scenes")
    (out / "states" / "D0.safetensors").write_bytes(b"rubbish")
    run = TwinRun(case_folder, view=SMALL, build=StandIn, solve=StandIn.solve)
    with pytest.raises(ArtifactError, match=r"D0.safetensors is damaged"):
        make_scenes(run, out, ("Rot180",), ("clean",))


def test_inspect_tells_what_changed(made, tmp_path):
    out = shutil.copytree(made, tmp_path / "scenes")
    (out / "P1-clean" / "targets.csv").write_text("label\n")
    assert any("CHANGED" in line and "P1-clean" in line for line in describe(out))
