"""A small bench's second CT and depth images to a scene, as a user would; and what is refused."""

import json
import re
import shutil
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import bench_objects as bench
from refused import refused
from tumortrack.cli.main import run
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.io.scene_folder import read_scene
from tumortrack.live.calibration_file import read_frames
from tumortrack_experiment.kit_file import KIT_FILE, read_kit
from tumortrack_experiment.record.read import Moment, Recorded
from tumortrack_experiment.reference import scenes
from tumortrack_experiment.reference.deformed import parts_in, segment_deformed
from tumortrack_experiment.register.frames import check_kit, still_beads
from tumortrack_experiment.register.in_ct import find_balls, middles_mm
from tumortrack_experiment.register.in_depth import find_balls_seen

CT_FROM_BASE = rigid(
    Rotation.from_euler("xyz", [-80, 5, 20], degrees=True).as_matrix(), np.array([30, -200, 55.0])
)
POSE = bench.camera_from_base()
PINS = ((-20.0, 2, 10), (0, 10, 12), (4, -11, 18))
D1 = bench.State(pins=PINS)
TRUE = POSE @ np.linalg.inv(CT_FROM_BASE)  # camera_from_ct
WINDOWS = (-480.0, 300.0), (300.0, 1000.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folders of case, kit, CT and recording; the scan."""
    root = tmp_path_factory.mktemp("bench")
    case = bench.a_case(root / "case")
    bench.a_kit(root / "kit", root / "case", case)
    scan = bench.a_scan(D1, CT_FROM_BASE, 1.5)
    bench.write_scan(root / "ct2.nii.gz", scan)
    view = bench.a_view(D1, POSE, case)
    bench.write_view(root / "recording" / "D1", view)
    at = transform_points(np.linalg.inv(bench.BASE_FROM_CT), np.array(PINS))
    lines = ["ct_x,ct_y,ct_z", *(f"{x:.3f},{y:.3f},{z:.3f}" for x, y, z in at)]
    (root / "targets.csv").write_text("\n".join(lines))
    return root, case, scan, view


def reference(root, scenes_folder, *more, **other):
    paths = {"ct": root / "ct2.nii.gz", "recording": root / "recording", **other}
    return run(
        ["reference", str(paths["ct"]), str(paths["recording"]), str(scenes_folder)]
        + ["--kit", str(root / "kit"), "--case", str(root / "case"), *more]
    )


def test_beads_are_found_to_a_tenth_of_a_millimetre_in_a_coarse_ct(made):
    _, _, scan, _ = made
    true = transform_points(CT_FROM_BASE, bench.BEADS_MM)
    found = middles_mm(find_balls(scan, bench.BEAD_MM))  # but none of the pins of 3 mm
    assert len(found) == len(true)
    off = np.linalg.norm(found[:, None] - true, axis=2).min(0)
    assert off.max() < 0.15


def test_beads_are_found_in_a_noisy_depth_image(made):
    true = transform_points(POSE, bench.BEADS_MM)
    found = find_balls_seen(made[3], bench.BEAD_MM)
    off = np.linalg.norm(found[:, None] - true, axis=2).min(0)
    assert np.sqrt((off**2).mean()) < 0.5
    assert len(found) <= len(true) + 2


def test_a_second_ct_becomes_the_truth_of_what_the_camera_saw(made, tmp_path, capsys):
    root, case, _, _ = made
    pins = ["--targets", str(root / "targets.csv"), "--target-mm", "3"]
    assert reference(root, tmp_path / "scenes", *pins) == 0
    scene = read_scene(tmp_path / "scenes" / "D1")
    said = scene.meta["registration"]
    # The stated errors are those that occurred: at tumors, targets and the whole surface.
    assert 0 < said["fre_mm"] < 0.6
    for number, (middle, _) in enumerate(bench.TUMORS, 1):
        there = transform_points(CT_FROM_BASE, (middle * bench.STRETCH)[None])
        off = transform_points(np.array(said["rows"]), there) - transform_points(TRUE, there)
        assert np.linalg.norm(off) < 3 * said["tre_mm"][f"tumor_{number}"]
    assert abs(scene.reference.organ.volume_mm3 / case.anatomy.organ.volume_mm3 - 1) < 0.02
    volumes = [tumor.volume_mm3 for tumor in scene.reference.tumors]
    assert volumes[0] > 1.8 * volumes[1]  # tumor_1 of the case is the larger one
    pins_mm = transform_points(POSE, np.array(PINS) * bench.STRETCH)
    assert np.linalg.norm(scene.targets.points_mm - pins_mm, axis=1).max() < 0.6
    assert scene.targets.labels.tolist() == [1, 1, 1]
    near = (np.linalg.norm(scene.cloud.points_mm[:, None] - pins_mm, axis=2) < 45).any(1)
    assert near.all()  # no point of base, plate or beads
    assert abs(scene.meta["surface"]["median_mm"]) < 0.6
    assert set(scene.meta["inputs"]) == {"ct", "recording", "kit"}
    assert "camera_from_ct: 6 beads, FRE" in capsys.readouterr().out


def test_a_camera_that_moved_between_states_is_noticed(made, tmp_path, capsys):
    root, case, _, view = made
    recording = tmp_path / "recording"
    bench.write_view(recording / "D1", view)
    moved = bench.camera_from_base(shift_mm=(2.5, 0, 0))
    bench.write_view(recording / "rest", bench.a_view(D1, moved, case, seed=1))
    assert reference(root, tmp_path / "s", "--state", "D1", recording=recording) == 2
    assert re.search(r"moved by 2\.[3-7] mm between D1 and rest", capsys.readouterr().err)
    assert not (tmp_path / "s").exists()


def test_a_base_that_is_knocked_during_a_state_is_noticed(made):
    root, case, _, view = made
    knocked = bench.a_view(D1, bench.camera_from_base(shift_mm=(0, 2, 0)), case, seed=2)
    moments = [Moment(frame) for frame in [view] * 3 + [knocked] * 3]
    with refused(InputError, "D1"):
        still_beads(read_kit(root / "kit"), moments, "D1")


def test_an_unreadable_ct_is_one_line(made, tmp_path, capsys):
    root = made[0]
    damaged = tmp_path / "ct.nii.gz"
    damaged.write_bytes((root / "ct2.nii.gz").read_bytes()[:5000])
    assert reference(root, tmp_path / "s", ct=damaged) == 2
    said = capsys.readouterr().err
    assert str(damaged) in said
    assert said.count("\n") == 1


def test_another_case_than_the_kits_is_refused(made, tmp_path, capsys):
    root = made[0]
    shutil.copytree(root / "kit", tmp_path / "kit")
    kit = json.loads((tmp_path / "kit" / "kit.json").read_text())
    kit["case_sha256"] = "0" * 64
    (tmp_path / "kit" / "kit.json").write_text(json.dumps(kit))
    assert reference(root, tmp_path / "s", "--kit", str(tmp_path / "kit")) == 2
    assert "is not the case that this kit was made of" in capsys.readouterr().err


def test_a_recording_that_was_made_with_another_kit_is_told(made):
    path = made[0] / "kit" / KIT_FILE
    kit, content = read_kit(path), path.read_bytes()
    check_kit(Recorded(path.parent, {}, {}), kit)  # it does not say which
    check_kit(Recorded(path.parent, {}, {KIT_FILE: content}), kit)
    other = json.loads(content)
    other["beads"][2]["center_mm"][0] += 5.0
    recorded = Recorded(path.parent, {}, {KIT_FILE: json.dumps(other).encode()})
    with pytest.raises(InputError):
        check_kit(recorded, kit)
    with refused(InputError, KIT_FILE):
        check_kit(Recorded(path.parent, {}, {KIT_FILE: b"{"}), kit)


def segmented(made, scan, **changed):
    root, case, _, _ = made
    kit = msgspec.structs.replace(read_kit(root / "kit"), **changed)
    others = parts_in(kit, root / "kit", "D1"), []
    return segment_deformed(scan, CT_FROM_BASE, kit, case, others, WINDOWS)


def test_another_phantom_and_a_plate_taken_for_organ_are_refused(made):
    ml = made[1].anatomy.organ.volume_mm3 / 1000
    with refused(InputError, "45.0 ml"):
        segmented(made, made[2], organ_ml=45.0, tumors_ml=(2.1,))
    slab = bench.a_scan(replace(D1, slab=True, pins=()), CT_FROM_BASE, 1.5)
    with refused(InputError, f"{ml:.1f} ml"):
        segmented(made, slab)


def test_a_plate_that_the_ct_does_not_show_is_noticed(made):
    alone = bench.a_scan(bench.State(np.ones(3), press=False), CT_FROM_BASE, 2.0)
    with refused(InputError, "D1-plate"):
        segmented(made, alone)


def test_a_state_that_the_ct_does_not_show_is_noticed(made):
    root, case, _, view = made
    kit = read_kit(root / "kit")
    parts = [*parts_in(kit, root / "kit", "D1").values()]
    beads = transform_points(POSE, bench.BEADS_MM), bench.BEAD_MM
    others = scenes.kit_pixels(view, POSE, parts, beads)
    cloud = scenes.organ_cloud(view, others)

    def at(stretch, shift=(0, 0, 0)):
        organ = case.anatomy.organ
        rest = transform_points(bench.BASE_FROM_CT, organ.vertices_mm)
        return organ.with_vertices(transform_points(POSE, rest * stretch + shift))

    right = scenes.check_surface(view, others, at(bench.STRETCH), cloud)
    assert right["p95_mm"] < 1.5
    assert right["beside"] < 0.02
    for other in (at([0.95, 0.8, 1 / 0.76]), at(bench.STRETCH, (0, -15, 0))):
        with pytest.raises(InputError):
            scenes.check_surface(view, others, other, cloud)


def test_camera_and_robot_give_a_calibration_with_its_error(made, tmp_path, capsys):
    """Pointed at the beads' tops: `track` and `plan` read where the camera is, within what is
    stated."""
    root = made[0]
    robot_from_base = rigid(
        Rotation.from_rotvec([0, 0, 2.0]).as_matrix(), np.array([400, 90, 12.0])
    )
    tops = transform_points(robot_from_base, bench.BEADS_MM + [0, 0, bench.BEAD_MM / 2])
    rows = [f"B{n},{x},{y},{z}" for n, (x, y, z) in enumerate((tops / 1000).tolist(), 1)]
    table = tmp_path / "pointed.csv"
    table.write_text("\n".join(["bead,x,y,z", *rows]))
    view = ["--view", str(root / "recording" / "D1" / "depth.png"), "--unit", "m"]
    given = ["calibrate", "register", str(root / "kit"), str(tmp_path / "out"), *view]
    assert run([*given, "--robot-points", str(table), "--case", str(root / "case")]) == 0
    frames = read_frames(tmp_path / "out" / "calibration.json")
    true = robot_from_base @ np.linalg.inv(POSE)
    at = transform_points(POSE, np.array([[0, 0, 15.0]]))
    off = transform_points(frames.published_from_camera, at) - transform_points(true, at)
    assert np.linalg.norm(off) < frames.error_mm < 2
    said = json.loads((tmp_path / "out" / "report.json").read_text())
    assert set(said["transforms"]) == {"robot_from_camera"}
    capsys.readouterr()
    table.write_text(table.read_text().replace("B2,", "B9,"))
    again = [*given[:3], str(tmp_path / "again"), *view, "--robot-points", str(table)]
    assert run(again) == 2
    assert "the place named 'B9' is that of bead B2" in capsys.readouterr().err
