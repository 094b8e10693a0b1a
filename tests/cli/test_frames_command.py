"""`tumortrack frames` on files as our commands and other programs write them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from refused import refused
from stories import cloud_by_rays, looking_down
from tumortrack.cli.main import run
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, rigid, transform_points
from tumortrack.io.case import load_case
from tumortrack.io.csv_tables import COLUMNS
from tumortrack.io.ply import write_cloud_ply
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.frame_files import KnownFrames
from tumortrack.live.poses import pose_row
from ultrasound_objects import stamped, words, write_meta_image

STEP_NS = 50_000_000
PLACES = np.array([[0.0, 0, 150], [60, 10, 160], [-20, 50, 140], [30, -40, 170]])


def pose(degrees: tuple[float, float, float], at: tuple[float, float, float]) -> Affine:
    turn = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    return rigid(turn, np.array(at, float))


BASE_CAMERA = pose((170, 5, 90), (420, -30, 510))
TRACKER_BASE = pose((10, 20, 30), (-300, 100, 900))
TRACKER_PROBE = pose((40, -10, 170), (30, 60, 700))
PROBE_IMAGE = pose((0, 0, 20), (10, -5, 60)) @ np.diag([0.085, 0.085, 0.085, 1])
BUMP = pose((0, 0, 2), (5, 0, 0))


def calibration(path: Path, base_camera: Affine = BASE_CAMERA, **more: object) -> Path:
    rows = {"robot_from_camera": base_camera.tolist()}
    path.write_text(json.dumps({"frame_id": "base_link", "unit": "mm", **rows, **more}))
    return path


def plus(path: Path, **transforms: Affine) -> Path:
    said = ""
    for name, matrix in transforms.items():
        of, _, to = name.partition("_to_")
        numbers = " ".join(f"{number:.9g}" for number in matrix.ravel())
        said += f'<Transform From="{of}" To="{to}" Matrix="{numbers}" Error="0.4" />\n'
    about = f"<CoordinateDefinitions>{said}</CoordinateDefinitions>"
    path.write_text(f'<?xml version="1.0"?>\n<PlusConfiguration>{about}</PlusConfiguration>')
    return path


def touches(path: Path, a: str, b: str, b_from_a: Affine, places_a: np.ndarray = PLACES) -> Path:
    header = ",".join(f"{frame}_{axis}" for frame in (a, b) for axis in "xyz")
    rows = np.column_stack([places_a, transform_points(b_from_a, places_a)])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.4f")
    return path


def poses(path: Path, frame: str, *of: Affine) -> Path:
    rows = [pose_row(n * STEP_NS, frame, one) for n, one in enumerate(of, start=1)]
    path.write_text("".join([f"{COLUMNS}\n", *rows]))
    return path


def frames(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict]:
    """The exit status and the report."""
    status = run(["frames", *map(str, words), "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_a_right_chain(tmp_path, capsys):
    files = [
        calibration(tmp_path / "calibration.json", error_mm=0.8, camera_frame_id="optical"),
        plus(
            tmp_path / "plus.xml",
            Image_to_Probe=PROBE_IMAGE,
            Probe_to_Tracker=TRACKER_PROBE,
            base_link_to_Tracker=TRACKER_BASE,
        ),
        touches(tmp_path / "touches.csv", "base_link", "camera", np.linalg.inv(BASE_CAMERA),
                transform_points(BASE_CAMERA, PLACES)),
    ]  # fmt: skip
    status, said = frames(capsys, *files, "--out", tmp_path / "frames.png")
    assert status == 0
    assert not said["wrong"]
    [group] = said["groups"]
    assert set(group) == {"camera", "optical", "base_link", "Tracker", "Probe", "Image"}
    want = np.linalg.inv(TRACKER_BASE @ BASE_CAMERA) @ TRACKER_PROBE @ PROBE_IMAGE
    np.testing.assert_allclose(said["first_from_frame"]["Image"], want, atol=1e-5)
    picture = np.asarray(Image.open(tmp_path / "frames.png").convert("RGB"))
    assert (picture != 255).any()
    assert all((picture[edge] == 255).all() for edge in (0, -1))
    status, said = frames(capsys, *files, "--to", "Tracker")
    np.testing.assert_allclose(said["first_from_frame"]["Probe"], TRACKER_PROBE, atol=1e-5)


def test_a_recording_has_the_chain_of_its_last_valid_frame(tmp_path, capsys):
    poses = np.array([TRACKER_PROBE, TRACKER_PROBE @ BUMP, TRACKER_PROBE])
    fields = stamped({"ProbeToTracker": poses})
    fields[2]["ProbeToTrackerTransformStatus"] = "INVALID"
    scan = write_meta_image(
        tmp_path / "scan.igs.mha",
        np.zeros((3, 8, 8), np.uint8),
        fields,
        {"ImageToProbeTransform": words(PROBE_IMAGE)},
    )
    status, said = frames(capsys, scan, "--to", "Tracker")
    assert status == 0
    found = said["first_from_frame"]
    np.testing.assert_allclose(found["Probe"], TRACKER_PROBE @ BUMP, atol=1e-6)
    np.testing.assert_allclose(found["Image"], TRACKER_PROBE @ BUMP @ PROBE_IMAGE, atol=1e-6)


def test_a_missing_link_is_named_and_touches_give_it(tmp_path, capsys):
    files = [
        calibration(tmp_path / "calibration.json"),
        plus(tmp_path / "plus.xml", Probe_to_Tracker=TRACKER_PROBE),
    ]
    status, said = frames(capsys, *files)
    assert status == 4
    assert len(said["groups"]) == 2
    [line] = said["wrong"]
    assert "camera_from_Tracker" in line
    more = touches(tmp_path / "touches.csv", "camera", "Tracker", TRACKER_BASE @ BASE_CAMERA)
    status, said = frames(capsys, *files, more)
    assert status == 0
    want = np.linalg.inv(TRACKER_BASE @ BASE_CAMERA)
    np.testing.assert_allclose(said["first_from_frame"]["Tracker"], want, atol=1e-3)
    assert frames(capsys, *files, "--same", "base_link=Tracker")[0] == 0


def test_a_disagreement_is_measured(tmp_path, capsys):
    bumped = calibration(tmp_path / "calibration.json", BASE_CAMERA @ BUMP)
    seen = touches(tmp_path / "touches.csv", "camera", "base_link", BASE_CAMERA)
    picture = tmp_path / "frames.png"
    assert run(["frames", *map(str, [bumped, seen, "--out", picture])]) == 4
    said = capsys.readouterr().out
    assert "5.0 mm at the organ and 2.0 degrees" in said
    assert picture.stat().st_size > 0
    assert frames(capsys, calibration(bumped), seen)[0] == 0


def test_an_inverted_calibration_is_named(tmp_path, capsys):
    files = [
        calibration(tmp_path / "inverted.json", np.linalg.inv(BASE_CAMERA)),
        touches(tmp_path / "touches.csv", "camera", "base_link", BASE_CAMERA),
    ]
    status, said = frames(capsys, *files)
    assert status == 4
    assert "inverted.json) is inverted" in said["wrong"][0]


def test_a_board_compares_two_frames(tmp_path, capsys):
    """Its poses before the camera, and by the tracker, as tables."""
    of_camera = [pose((n, 2 * n, 5 * n), (n, 0, 300 + n)) for n in range(12)]
    by_tracker = [TRACKER_BASE @ BASE_CAMERA @ one for one in of_camera]
    words = [
        calibration(tmp_path / "calibration.json"),
        plus(tmp_path / "plus.xml", base_link_to_Tracker=TRACKER_BASE),
        f"board={poses(tmp_path / 'camera.csv', 'camera', *of_camera)}",
        f"board={poses(tmp_path / 'tracker.csv', 'Tracker', *by_tracker)}",
    ]
    status, said = frames(capsys, *words)
    assert status == 0
    at = said["first_from_frame"]["board"]
    np.testing.assert_allclose(at, of_camera[-1], atol=1e-5)
    plus(tmp_path / "plus.xml", base_link_to_Tracker=BUMP @ TRACKER_BASE)
    assert frames(capsys, *words)[0] == 4
    assert frames(capsys, *words[2:])[0] == 0


def test_a_located_organ_and_a_camera_on_a_tool(tmp_path, capsys, phantom_case, elastic_model):
    """The folder of a `locate`, easy_handeye, and where the tool was."""
    case = load_case(phantom_case)
    camera_ct = looking_down(case)
    write_cloud_ply(tmp_path / "cloud.ply", cloud_by_rays(case, camera_ct).astype(np.float32))
    out = tmp_path / "RUN"
    assert run(["locate", str(elastic_model), str(tmp_path / "cloud.ply"), "--out", str(out)]) in (
        0,
        4,
    )
    capsys.readouterr()
    tool_camera, x = pose((0, 0, 90), (30, 0, 80)), tmp_path / "hand.yaml"
    turn = Rotation.from_matrix(tool_camera[:3, :3]).as_quat()
    names = dict(zip("xyz", tool_camera[:3, 3] / 1000, strict=True))
    names |= dict(zip(("qx", "qy", "qz", "qw"), turn, strict=True))
    lines = [f"  {name}: {number:.9f}" for name, number in names.items()]
    about = "eye_on_hand: true\nrobot_base_frame: base_link\ntracking_base_frame: optical\n"
    x.write_text("\n".join([f"{about}transformation:", *lines]))
    base_tool = BASE_CAMERA @ np.linalg.inv(tool_camera)
    table = poses(tmp_path / "poses.csv", "base_link", base_tool)
    status, said = frames(capsys, out, x, table)
    assert status == 0, said["wrong"]
    assert set(said["groups"][0]) == {"camera", "ct", "tool", "optical", "base_link"}
    np.testing.assert_allclose(said["first_from_frame"]["ct"], camera_ct, atol=5)
    want = np.linalg.inv(BASE_CAMERA)
    np.testing.assert_allclose(said["first_from_frame"]["base_link"], want, atol=1e-5)


def test_poses_of_several_cameras(tmp_path, capsys):
    rows = [np.eye(4).tolist(), BUMP.tolist()]
    about = {"unit": "mm", "frame_id": "room", "fixed_from_camera": rows}
    (tmp_path / "poses.json").write_text(json.dumps(about))
    said = frames(capsys, tmp_path / "poses.json")[1]
    np.testing.assert_allclose(said["first_from_frame"]["camera_2"], BUMP)


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("none.json", "{}", "none.json"),
        ("short.json", '{"base_from_camera": [[1, 0], [0, 1]]}', "base_from_camera"),
        ("words.json", '{"base_from_camera": [["a", 0], [0, 1]]}', "base_from_camera"),
        ("nan.json", json.dumps({"a_from_b": [[float("nan")] * 4] * 4}), "a_from_b"),
        ("plus.xml", '<!DOCTYPE a [<!ENTITY b "c">]><P><Transform/></P>', "DOCTYPE"),
        ("plus.xml", "<P><Transform From='a' To='b' Matrix='1 2 3'/></P>", "plus.xml"),
        ("plus.xml", "<P><Transform From='a' Matrix='1 2 3'/></P>", "plus.xml"),
        ("plus.xml", "<P>", "plus.xml"),
        ("two.csv", "a_x,a_y,a_z,b_x,b_y,b_z\n1,2,3,4,5,6\n2,3,4,5,6,7\n", "two.csv"),
        ("one.csv", "a_x,a_y,a_z\n1,2,3\n", "one.csv"),
        ("picture.png", "", "picture.png"),
    ],
)  # fmt: skip
def test_what_says_nothing_of_frames_is_refused(tmp_path, name, content, named):
    (tmp_path / name).write_text(content)
    with refused(InputError, named):
        KnownFrames().add(str(tmp_path / name))


def test_options_that_do_not_fit_are_refused(tmp_path, capsys):
    file = str(calibration(tmp_path / "calibration.json"))
    for more in (
        ["--to", "base"],
        ["--distance", "0"],
        ["--out", "frames.pdf"],
        ["--same", "base_link"],
    ):
        assert run(["frames", file, *more]) == 2
        said = capsys.readouterr().err
        assert more[0] in said or more[1] in said
    assert run(["frames"]) == 2
    assert read_frames(Path(file)).frame_id == "base_link"
    assert run(["frames", str(tmp_path / "absent.csv")]) == 2
    (tmp_path / "empty").mkdir()
    assert run(["frames", str(tmp_path / "empty")]) == 2
