"""Laws of all readers of points, depths and poses, each tried on each reader: what means the same
is read as the same, what may mean two things is refused, nothing is lost without a note."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from depth_files import write_intrinsics
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.store import natural, read_json
from tumortrack.core.types import Intrinsics
from tumortrack.io.csv_tables import whole_in
from tumortrack.io.depth_files import read_camera, read_cloud, read_depth, read_poses
from tumortrack.io.evidence_files import read_evidence
from tumortrack.io.ply import cloud_ply
from tumortrack.io.points import read_points
from tumortrack.io.scene_folder import list_scenes
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.poses import FilePoses

QUOTED = '","'
STAMP_NS = 1_700_000_000_123_456_789


class Reader(NamedTuple):
    """``read``: to a value that can be compared; ``number``: a column of numbers."""

    read: Callable[[Path], Any]
    header: str
    rows: tuple[str, ...]
    number: str


def poses(path: Path) -> Any:
    read = FilePoses(path)
    return read.frame_id, read.touches, read.poses.at(STAMP_NS).tolist()


READERS = {
    "evidence": Reader(
        read_evidence,
        "piece,frame,kind,x_mm,y_mm,z_mm,stamp_ns,tool",
        (f"1,camera,touch,1.5,2,150,{STAMP_NS},probe", "2,camera,free_space,3,4,140,0,grasper"),
        "y_mm",
    ),
    "points": Reader(
        lambda path: (read_points(path).points_ct.tolist(), read_points(path).rows),
        "x,y,z,label",
        ("1,2,3,vessel", "-4.5,5,6,margin"),
        "y",
    ),
    "poses": Reader(
        poses,
        "stamp_ns,frame_id,x_mm,y_mm,z_mm,qw,qx,qy,qz,contact",
        (f"{STAMP_NS},base,1,2,3,1,0,0,0,0", f"{STAMP_NS + 9},base,4,5,6,0,1,0,0,1"),
        "y_mm",
    ),
}
SPELLINGS: dict[str, Callable[[list[str]], bytes]] = {
    "with a mark": lambda lines: b"\xef\xbb\xbf" + "\n".join(lines).encode(),
    "UTF-16": lambda lines: "\r\n".join(lines).encode("utf-16"),
    "lines of Windows": lambda lines: "\r\n".join([*lines, ""]).encode(),
    "spaces": lambda lines: "\n".join(line.replace(",", " , ") for line in lines).encode(),
    "commas at the end": lambda lines: "\n".join(line + ",," for line in lines).encode(),
    "empty rows": lambda lines: "\n\n,,,,\n".join([*lines, ""]).encode(),
    "quotes": lambda lines: "\n".join(f'"{line.replace(",", QUOTED)}"' for line in lines).encode(),
    "semicolons": lambda lines: "\n".join(line.replace(",", ";") for line in lines).encode(),
    "decimal commas": lambda lines: "\n".join(
        line.replace(",", ";").replace(".", ",") for line in lines
    ).encode(),
    "tabs": lambda lines: "\n".join(line.replace(",", "\t") for line in lines).encode(),
    "as Excel says it": lambda lines: "\n".join(["sep=,", *lines]).encode(),
    "a comment": lambda lines: "\n".join(["# of today", "", "# more", *lines]).encode(),
    "capitals": lambda lines: "\n".join([lines[0].upper(), *lines[1:]]).encode(),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("name", READERS)
def test_a_table_says_the_same_however_it_is_spelled(name, spelling, tmp_path):
    reader, path = READERS[name], tmp_path / "t.csv"
    lines = [reader.header, *reader.rows]
    path.write_text("\n".join(lines))
    told = reader.read(path)
    path.write_bytes(SPELLINGS[spelling](lines))
    assert reader.read(path) == told


@pytest.mark.parametrize("name", READERS)
def test_a_stamp_is_kept_to_the_last_digit(name, tmp_path):
    reader, path = READERS[name], tmp_path / "t.csv"
    text = "\n".join([reader.header, *reader.rows])
    path.write_text(text)
    told = reader.read(path)
    path.write_text(text.replace(str(STAMP_NS), "1.700000000123456789e18"))
    assert reader.read(path) == told
    if str(STAMP_NS) in text:
        path.write_text(text.replace(str(STAMP_NS), "1.5"))
        with pytest.raises(InputError):
            reader.read(path)


def with_cell(reader: Reader, text: str) -> list[str]:
    """The second row's number replaced."""
    cells = reader.rows[1].split(",")
    cells[reader.header.split(",").index(reader.number)] = text
    return [reader.header, reader.rows[0], ",".join(cells)]


FAULTS: dict[str, Callable[[Reader], list[str]]] = {
    "a column twice": lambda r: [f"{r.header},{r.number}", *(f"{row},7" for row in r.rows)],
    "a column twice but for case": lambda r: [
        f"{r.header},{r.number.upper()}",
        *(f"{row},7" for row in r.rows),
    ],
    "a comment below": lambda r: [r.header, *r.rows, "# the end"],
    "a cell too many": lambda r: [r.header, r.rows[0], f"{r.rows[1]},7"],
    "a cell too few": lambda r: [r.header, r.rows[0], r.rows[1].rpartition(",")[0]],
    "no number": lambda r: with_cell(r, "far"),
    "a number of Python's alone": lambda r: with_cell(r, "1_5"),
    "an empty number": lambda r: with_cell(r, ""),
    "no rows": lambda r: [r.header],
    "nothing": lambda r: [],
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", READERS)
def test_a_table_that_may_mean_two_things_is_refused_where_it_does(name, fault, tmp_path):
    reader, path = READERS[name], tmp_path / "t.csv"
    path.write_text("\n".join(FAULTS[fault](reader)))
    where = ["line 3"] if "cell" in fault or "number" in fault else []
    with refused(InputError, path, *where):
        reader.read(path)


@pytest.mark.parametrize("text", ["9e9999999", "1e999999999999999999", "sNaN", "-Infinity", "0.5"])
def test_a_number_that_is_not_whole_is_refused(text):
    with refused(InputError, "line 3", text):
        whole_in(text, "line 3")


def test_an_outline_of_one_piece_and_touches_of_their_own(tmp_path):
    path = tmp_path / "e.csv"
    path.write_text(
        "piece,frame,kind,x_mm,y_mm,z_mm,part\n"
        "a,camera,outline,1,2,150,tumor_1\na,camera,outline,3,4,151,tumor_1\n"
    )
    (outline,) = read_evidence(path)[1]
    assert outline.places == ((1.0, 2.0, 150.0), (3.0, 4.0, 151.0))
    path.write_text(path.read_text().replace("outline", "touch"))
    with refused(InputError, "line 3"):
        read_evidence(path)


def test_points_that_were_never_placed_are_left_out_and_counted(tmp_path):
    path = tmp_path / "Slicer.csv"
    path.write_text(
        "label,r,a,s,defined,selected\nA,1,2,3,1,1\nB,0,0,0,False,1\nC,4,5,6,1,1\nD,0,0,0,no,1\n"
        "E,0,0,0,0.0,1\nF,0,0,0,0,1\n"
    )
    table = read_points(path)
    assert table.points_ct.tolist() == [[-1, -2, 3], [-4, -5, 6]]
    assert [row[0] for row in table.rows] == ["A", "C"]
    (note,) = table.notes
    assert "4 of 6" in note
    path.write_text("label,r,a,s,defined\nB,0,0,0,0\n")
    with pytest.raises(InputError):
        read_points(path)


def test_evidence_that_is_none_and_a_tiff_of_several_images_are_refused(tmp_path):
    path = tmp_path / "e.json"
    path.write_text('{"frame": "camera", "unit": "mm", "evidence": []}')
    with refused(InputError, "e.json"):
        read_evidence(path)
    images = [Image.fromarray(DEPTHS.astype(np.uint16)) for _ in range(2)]
    images[0].save(tmp_path / "d.tif", save_all=True, append_images=images[1:])
    write_intrinsics(tmp_path / "i.json", CAMERA)
    with refused(InputError, "d.tif"):
        read_depth(tmp_path / "d.tif", tmp_path / "i.json")


@pytest.mark.parametrize("read", [read_json, read_evidence, read_frames])
def test_a_key_twice_is_refused(read, tmp_path):
    path = tmp_path / "f.json"
    path.write_text('{"frame_id": "a", "unit": "mm", "deep": [{"unit": "m", "unit": "mm"}]}')
    with refused(InputError, path, "'unit'"):
        read(path)


def test_files_are_listed_as_people_number_them(tmp_path):
    names = ["a", "a2", "a10", "a10b", "b", "frame_1.png", "frame_2.png", "frame_10.png", "frame_x"]
    paths = [tmp_path / name for name in names]
    assert sorted(reversed(paths), key=natural) == paths
    for n in (10, 9, 1):
        (tmp_path / f"scene{n}").mkdir()
        (tmp_path / f"scene{n}" / "cloud.ply").touch()
    assert [path.name for path in list_scenes(tmp_path)] == ["scene1", "scene9", "scene10"]


CAMERA = Intrinsics(4, 3, 4.0, 4.0, 1.5, 1.0)
DEPTHS = np.array([[1500, 1600, 1700, 1800], [0, 0, 0, 0], [1501, 1502, 1503, 1504]])
# By type of pixel: where there is no depth.
SENTINELS = {
    "<u2": [0, 65535],
    ">u2": [0, 65535],
    "<i4": [0, -1, 65535, 2**31 - 1],
    "<f4": [0.0, -1.0, np.nan, np.inf, -np.inf, np.finfo(np.float32).max, 65535.0, 65.535],
    "<f8": [0.0, np.nan, np.finfo(np.float64).max, 1e300],
}
STORED = [(".png", "<u2"), (".tif", "<u2"), (".tif", "<i4"), (".tif", "<f4")]
STORED += [(".npy", kind) for kind in SENTINELS]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("suffix", "kind"), STORED)
def test_what_stands_for_no_depth_counts_as_none(suffix, kind, tmp_path):
    raw = DEPTHS.astype(kind)
    raw[1] = np.resize(SENTINELS[kind], 4)
    path, camera = tmp_path / f"d{suffix}", tmp_path / "c.json"
    for first in range(0, len(SENTINELS[kind]), 4):
        raw[1] = np.resize(SENTINELS[kind][first:], 4)
        np.save(path, raw) if suffix == ".npy" else Image.fromarray(raw).save(path)
        write_intrinsics(camera, CAMERA, 0.1)
        frame, unit_mm = read_depth(path, camera)
        assert unit_mm == 0.1
        assert np.isnan(frame.depth_mm[1]).all()
        np.testing.assert_allclose(frame.depth_mm[::2], DEPTHS[::2] * 0.1, rtol=1e-6)


@pytest.mark.parametrize("kind", ["npy", "npz"])
def test_arrays_of_points_have_one_of_three_shapes_and_say_what_was_left_out(kind, tmp_path):
    path, points = tmp_path / f"a.{kind}", np.arange(36.0).reshape(12, 3) + 100
    normals = np.hstack([points, np.zeros((12, 3))])

    def read(array: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        np.save(path, array) if kind == "npy" else np.savez(path, cloud=array)
        cloud, notes = read_cloud(path)
        return cloud.points_mm, notes

    for array, wide in ((points, 0), (points.reshape(4, 3, 3), 0), (normals, 6)):
        read_mm, notes = read(array)
        np.testing.assert_array_equal(read_mm, points)
        assert [f"of {wide} columns" in note for note in notes] == [True] * bool(wide)
    for array in (points.reshape(9, 4), points.reshape(4, 3, 3).astype(np.uint8)):
        with pytest.raises(InputError):
            read(array)


def test_properties_of_points_may_be_capitals_but_not_twice(tmp_path):
    path, points = tmp_path / "a.ply", np.arange(12.0).reshape(4, 3) + 100
    content = cloud_ply(points, {})
    path.write_bytes(content.replace(b"float x", b"float X").replace(b"float z", b"float Z"))
    np.testing.assert_array_equal(read_cloud(path)[0].points_mm, points)
    path.write_bytes(content.replace(b"float y", b"float X"))
    with pytest.raises(InputError):
        read_cloud(path)


@pytest.mark.parametrize("axis", ["cx", "cy"])
def test_an_optical_axis_on_the_border_is_one_that_is_not_known(axis, tmp_path):
    path = tmp_path / "c.json"
    write_intrinsics(path, replace(CAMERA, **{axis: 0.5}))
    read_camera(path)
    write_intrinsics(path, replace(CAMERA, **{axis: 0.0}))
    with pytest.raises(InputError):
        read_camera(path)


def test_an_array_is_a_cloud_or_with_a_camera_a_depth_image(tmp_path):
    path, camera = tmp_path / "a.npy", tmp_path / "c.json"
    points = np.arange(12.0).reshape(4, 3) + 100
    np.save(path, points)
    np.testing.assert_array_equal(read_cloud(path)[0].points_mm, points)
    write_intrinsics(camera, CAMERA)
    with pytest.raises(InputError):
        read_depth(path, camera)  # 4 x 3, not 3 x 4
    np.save(path, np.array([{"a": 1}], object), allow_pickle=True)
    for read in (read_cloud, lambda file: read_depth(file, camera)):
        with pytest.raises(InputError):
            read(path)
    np.save(path, points)
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(InputError):
        read_cloud(path)


def test_a_depth_scale_that_is_a_unit_names_file_and_unit(tmp_path):
    path = tmp_path / "c.json"
    write_intrinsics(path, CAMERA)
    path.write_text(json.dumps({**json.loads(path.read_text()), "depth_scale": 0.1}))
    with refused(InputError, path, "depth_unit_mm"):
        read_camera(path)


def moved(shift: float) -> list[list[float]]:
    pose = np.eye(4)
    pose[2, 3] = shift
    return pose.tolist()


def frames(path: Path, unit: str, shift: float) -> float:
    given = {"frame_id": "base", "unit": unit, "robot_from_camera": moved(shift)}
    path.write_text(json.dumps(given))
    return float(read_frames(path).published_from_camera[2, 3])


def views(path: Path, unit: str, shift: float) -> float:
    given = {"frame_id": "base", "unit": unit, "fixed_from_camera": [moved(shift)]}
    path.write_text(json.dumps(given))
    return float(read_poses(path, 1)[1][0][2, 3])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("read", [frames, views])
def test_a_pose_beyond_any_room_is_refused_with_its_unit(read, tmp_path):
    path = tmp_path / "p.json"
    assert read(path, "mm", 400) == read(path, "m", 0.4) == 400
    assert read(path, "mm", 4999) == 4999
    for unit, shift in (("m", 400), ("m", 5.1), ("mm", 5100), ("m", 1e300), ("m", np.nan)):
        with refused(InputError, *([] if np.isnan(shift) else [f"{unit!r}"])):
            read(path, unit, shift)


# As easy_handeye (ROS 1, in both styles of YAML) and easy_handeye2 write a half turn about x.
HAND_EYES = {
    "block": "parameters:\n  eye_on_hand: {hand}\n  robot_base_frame: base_link\n"
    "  tracking_base_frame: optical\ntransformation:\n"
    "  qw: 0.0\n  qx: 1.0\n  qy: 0.0\n  qz: 0.0\n  x: 0.5\n  y: -0.1\n  z: 9.0e-1\n",
    "flow": "eye_on_hand: {hand}\nrobot_base_frame: base_link\ntracking_base_frame: optical\n"
    "transformation: {{qw: 0, qx: 1, qy: 0, qz: 0, x: 0.5, y: -0.1, z: 0.9}}\n",
    "two": "parameters:\n  calibration_type: {type}\n  robot_base_frame: 'base_link'\n"
    "  tracking_base_frame: optical\ntransform:\n  rotation:\n    w: 0.0\n    x: 1.0\n    y: 0.0\n"
    "    z: 0.0\n  translation:\n    x: 0.5\n    y: -0.1\n    z: 0.9\n",
}


@pytest.mark.parametrize("style", HAND_EYES)
@pytest.mark.parametrize("moves", [False, True])
def test_what_easy_handeye_writes_is_read(style, moves, tmp_path):
    path = tmp_path / "h.yaml"
    kind = "eye_in_hand" if moves else "eye_on_base"
    path.write_text(HAND_EYES[style].format(hand=str(moves).lower(), type=kind))
    frame = read_frames(path, moves)
    assert (frame.frame_id, frame.camera_frame_id) == ("base_link", "optical")
    half_turn = [[1, 0, 0, 500], [0, -1, 0, -100], [0, 0, -1, 900], [0, 0, 0, 1]]
    np.testing.assert_allclose(frame.published_from_camera, half_turn, atol=1e-9)
    with pytest.raises(InputError):
        read_frames(path, not moves)
    text = path.read_text()
    path.write_text(text + "# x: 0.4, y: far\n")
    np.testing.assert_allclose(read_frames(path, moves).published_from_camera, half_turn)
    for told in (
        text.replace("0.5", "far"),
        text.replace("1.0", "1.1").replace("qx: 1,", "qx: 2,"),  # no rotation
        text.replace("z: 0.9", "").replace("z: 9.0e-1", ""),
        text + "robot_base_frame: other\n",
        text.replace("0.5", "500"),  # mm
    ):
        path.write_text(told)
        with pytest.raises(InputError):
            read_frames(path, moves)
