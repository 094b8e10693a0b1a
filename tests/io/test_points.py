"""Points of the CT asked for by `locate --map`: reading, refusing, answering."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest
import trimesh

from elastic_objects import CENTER
from motions import CAMERA_FROM_CT, Wave
from one_way import OneWay
from refused import refused
from report_objects import ball
from reports import report_of
from tumortrack.cli.locate import Locate
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, CameraLabels, OccupancyCloud
from tumortrack.io.depth_files import read_cloud
from tumortrack.io.ply import write_cloud_ply
from tumortrack.io.points import camera_table, check_near_organ, read_points
from tumortrack.io.run_folder import write_estimate

MIDDLE = np.array([60.0, 40.0, -300.0])
BOX = np.stack([MIDDLE - 30, MIDDLE + 30])


def anatomy():
    return Anatomy((ball(30, MIDDLE), ball(8, MIDDLE + [5, 0, 0])))


def some_points(count=7):
    return np.round(MIDDLE + np.random.default_rng(0).uniform(-30, 30, (count, 3)), 3)


def located(motion=None):
    """An estimate whose cloud has a point of each label."""
    points_mm = transform_points(CAMERA_FROM_CT, MIDDLE + np.array([[0.0, 0, 0], [5, 1, 2]]))
    labels = np.ones((2, 2, 2), np.uint8)
    volume = CameraLabels(labels, np.eye(4))
    parts = {"kidney": {"found": True, "volume_ml": 113.0, "center_mm": [0.0, 0.0, 100.0]}}
    return Estimate(
        OccupancyCloud(points_mm, np.array([1, 2]), np.array([0.9, 0.8])),
        volume,
        {"kidney": ball(30, [0, 0, 100])},
        report_of(parts=parts, timings={"total": 0.1}),
        motion,
    )


def rows_of(text):
    return list(csv.DictReader(io.StringIO(text)))


def places(rows, frame="camera"):
    return np.array([[float(row[f"{frame}_{axis}"]) for axis in "xyz"] for row in rows])


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


# --- the estimate's folder ---


def ply_columns(path):
    """Names and float values of a PLY's vertices, read by another program."""
    vertex = trimesh.load(path).metadata["_ply_raw"]["vertex"]
    return {name: vertex["data"][name].ravel() for name in vertex["properties"]}


def test_the_occupancy_cloud_says_where_its_points_were_in_the_ct(tmp_path):
    estimate = located(Wave())
    write_estimate(tmp_path / "out", estimate)
    columns = ply_columns(tmp_path / "out" / "occupancy.ply")
    assert columns["ct_x"].dtype == np.float32
    ct = np.stack([columns[f"ct_{axis}"] for axis in "xyz"], axis=1).astype(float)
    camera = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(float)
    np.testing.assert_allclose(Wave().forward(ct), camera, atol=1e-3)
    assert np.linalg.norm(ct - MIDDLE, axis=1).max() < 15
    read_back, _ = read_cloud(tmp_path / "out" / "occupancy.ply")
    np.testing.assert_array_equal(read_back.points_mm, estimate.cloud.points_mm)


@pytest.mark.parametrize("motion", [None, OneWay(Wave().forward)])
def test_without_a_way_back_the_cloud_has_no_places_in_the_ct(tmp_path, motion):
    write_estimate(tmp_path / "out", located(motion))
    assert "ct_x" not in ply_columns(tmp_path / "out" / "occupancy.ply")
    assert not (tmp_path / "out" / "points.csv").exists()


# --- CSV ---


@pytest.mark.parametrize("names", ["x,y,z", "ct_x,ct_y,ct_z", "l,p,s", "X, Y ,Z"])
def test_points_keep_their_columns_and_get_their_place(tmp_path, names):
    points = some_points()
    lines = [f'v{n},{",".join(map(str, p))},"a, b"' for n, p in enumerate(points)]
    path = written(tmp_path / "p.csv", "\ufeff" + "\n".join([f"name,{names},why", *lines, "", ""]))
    table = read_points(path)
    np.testing.assert_array_equal(table.points_ct, points)
    rows = rows_of(camera_table(table, Wave()).decode())
    np.testing.assert_allclose(places(rows), Wave().forward(points), atol=6e-5)
    assert list(rows[0])[0::4] == ["name", "why"]
    assert [row["name"] for row in rows] == [f"v{n}" for n in range(len(points))]
    assert rows[2]["why"] == "a, b"
    assert "std_mm" not in rows[0]


def test_ras_columns_are_turned_to_lps(tmp_path):
    path = written(tmp_path / "p.csv", "r,a,s\n-60,-40,-300\n")
    np.testing.assert_array_equal(read_points(path).points_ct, [[60, 40, -300]])


def test_how_unsure_a_point_is_stands_beside_it(tmp_path):
    path = written(tmp_path / "p.csv", "x,y,z\n60,40,-300\n-80,40,-300\n")
    rows = rows_of(camera_table(read_points(path), Wave(sure=True)).decode())
    assert [float(row["std_mm"]) for row in rows] == [1.1, 1.3]


def test_an_answer_can_be_asked_again(tmp_path):
    path = written(tmp_path / "p.csv", "name,x,y,z\nhilum,60,40,-300\n")
    table = read_points(path)
    first = camera_table(table, Wave(height_mm=1, sure=True))
    again = read_points(written(tmp_path / "q.csv", first.decode()))
    assert again.columns == table.columns
    assert len(again.notes) == 1
    assert camera_table(again, Wave(height_mm=3)) == camera_table(table, Wave(height_mm=3))


# --- 3D Slicer ---

FCSV = """# Markups fiducial file version = 4.11
# CoordinateSystem = {}
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
1,{},0,0,0,1,1,1,0,hilum,"vein, left",vtkMRMLScalarVolumeNode1
2,1,2,3,0,0,0,1,1,1,0,F-2,,,{},0
"""
LPS_PLACE, RAS_PLACE = "60.5,40,-300", "-60.5,-40,-300"


@pytest.mark.parametrize(
    ("system", "place"),
    [("LPS", LPS_PLACE), ("RAS", RAS_PLACE), ("1", LPS_PLACE), ("0", RAS_PLACE)],
)
def test_fiducial_lists_honour_their_coordinate_system(tmp_path, system, place):
    path = written(tmp_path / "F.fcsv", FCSV.format(system, place, 2))
    table = read_points(path)
    sign = 1 if place == LPS_PLACE else -1
    np.testing.assert_array_equal(table.points_ct, [[60.5, 40, -300], [sign, 2 * sign, 3]])
    rows = rows_of(camera_table(table, Wave()).decode())
    assert (rows[0]["label"], rows[0]["description"]) == ("hilum", "vein, left")
    np.testing.assert_array_equal(places(rows, "ct"), table.points_ct)
    np.testing.assert_allclose(places(rows), Wave().forward(table.points_ct), atol=6e-5)


def test_a_fiducial_may_begin_with_the_sign_of_a_comment(tmp_path):
    text = FCSV.format("LPS", LPS_PLACE, 2).replace("\n1,", "\n#1,").replace("F-2", "F#2")
    table = read_points(written(tmp_path / "F.fcsv", text))
    np.testing.assert_array_equal(table.points_ct, [[60.5, 40, -300], [1, 2, 3]])
    assert [row[0] for row in table.rows] == ["hilum", "F#2"]


def test_fiducials_without_a_place_are_left_out_with_a_note(tmp_path):
    table = read_points(written(tmp_path / "F.fcsv", FCSV.format("LPS", LPS_PLACE, 0)))
    np.testing.assert_array_equal(table.points_ct, [[60.5, 40, -300]])
    (note,) = table.notes
    assert "F-2" in note


def markups(system="LPS", place=(60.5, 40, -300), **more):
    points = [
        {"id": "1", "label": "hilum", "position": list(place), "positionStatus": "defined"},
        {"id": "2", "label": "open", "position": [0.0, 0.0, 0.0], "positionStatus": "undefined"},
    ]
    one = {"type": "Fiducial", "coordinateSystem": system, "controlPoints": points, **more}
    return {"@schema": "x", "markups": [{k: v for k, v in one.items() if v is not None}]}


@pytest.mark.parametrize(
    ("system", "place"), [("LPS", (60.5, 40, -300)), ("RAS", (-60.5, -40, -300))]
)
@pytest.mark.parametrize("units", ["mm", ["mm", "mm", "mm"], None])
def test_markups_honour_their_coordinate_system(tmp_path, system, place, units):
    content = markups(system, place, coordinateUnits=units)
    content["markups"] += markups("LPS", (70, 50, -310))["markups"]
    table = read_points(written(tmp_path / "F.mrk.json", json.dumps(content)))
    np.testing.assert_array_equal(table.points_ct, [[60.5, 40, -300], [70, 50, -310]])
    assert table.rows[0][0] == "hilum"
    assert "open, open" in table.notes[0]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("p.csv", "1,2,3\n4,5,6\n"),
        ("p.csv", "x,y\n1,2\n"),
        ("p.csv", "x y z\n1 2 3\n"),
        ("p.csv", "x,y,z\n1,2,3\n1,2,nan\n"),
        ("p.csv", "x,y,z\n1,1e300,3\n"),
        ("p.csv", 'x,y,z\n1,2,"3\n'),
        ("p.csv", b"x,y,z\n\xff\xfe,2,3\n"),
        ("p.txt", "x,y,z\n1,2,3\n"),
        ("p.fcsv", b"\x80"),
        ("p.fcsv", FCSV.format("2", LPS_PLACE, 2)),
        ("p.fcsv", FCSV.replace("# CoordinateSystem = {}\n", "").format(LPS_PLACE, 2)),
        ("p.fcsv", FCSV.replace("# columns", "# names").format("LPS", LPS_PLACE, 2)),
        ("p.fcsv", FCSV.format("LPS", "1,b,3", 2)),
        ("p.fcsv", FCSV.format("LPS", "1,nan,3", 2)),
        ("p.fcsv", "# CoordinateSystem = LPS\n# columns = id,x,y,z\n"),
        ("p.mrk.json", b"\x80"),
        ("p.mrk.json", markups("IJK")),
        ("p.mrk.json", markups(None)),
        ("p.mrk.json", markups(coordinateUnits="m")),
        ("p.mrk.json", markups(place=(1, 2))),
        ("p.mrk.json", markups(place=("a", 1, 2))),
        ("p.mrk.json", {"markups": []}),
        ("p.mrk.json", [1]),
        ("none.csv", None),
    ],
)
def test_files_that_are_none_are_refused(tmp_path, name, content):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        written(path, content if isinstance(content, str) else json.dumps(content))
    with refused(InputError, name):
        read_points(path)


# --- are they about this organ ---


def test_points_about_the_organ_pass():
    assert check_near_organ(some_points(), BOX, "p") == ()
    assert check_near_organ(MIDDLE[None] + [120.0, 0, 0], BOX, "p") == ()  # 90 mm from the box
    at_origin = np.array([[-30.0, -30, -30], [30, 30, 30]])
    assert check_near_organ(np.zeros((1, 3)), at_origin, "p") == ()
    assert check_near_organ(np.array([[0.0, 0, 0], [12, 0, 0]]), at_origin, "p") == ()


@pytest.mark.parametrize(
    ("points", "box"),
    [
        (some_points() * [-1, -1, 1], BOX),  # RAS
        (some_points() / 1000, BOX),  # metres
        ((some_points() - MIDDLE) / 1000, BOX - MIDDLE),
        (some_points() + [0, 200, 0], BOX),  # another frame
    ],
)
def test_points_in_another_frame_or_unit_are_refused(points, box):
    with pytest.raises(InputError):
        check_near_organ(points, box, "p")


def test_single_strays_are_told_and_kept():
    points = np.concatenate([some_points(3), MIDDLE[None] + [0, 0, 131.0]])
    (note,) = check_near_organ(points, BOX, "p")
    assert "1 of 4 points" in note


def test_a_motion_without_an_answer_is_no_answer(tmp_path):
    table = read_points(written(tmp_path / "p.csv", "x,y,z\n1,2,3\n"))
    with pytest.raises(NoEstimate):
        camera_table(table, OneWay(lambda points: points * np.nan))
    with pytest.raises(InputError):
        write_estimate(tmp_path / "out", located(), points=table)
    assert not (tmp_path / "out").exists()


# --- the command ---


@pytest.fixture
def cloud(tmp_path):
    points = Wave().forward(anatomy().organ.vertices_mm).astype(np.float32)
    write_cloud_ply(tmp_path / "cloud.ply", points)
    return tmp_path / "cloud.ply"


def test_points_that_cannot_be_meant_are_refused_before_anything_is_written(
    slim_model, cloud, tmp_path
):
    asked = written(tmp_path / "asked.csv", "x,y,z\n{},{},{}\n".format(*CENTER * [-1, -1, 1]))
    with refused(InputError, asked, "RAS"):
        Locate(model=slim_model, cloud=cloud, out=tmp_path / "out", map=asked).run()
    assert not (tmp_path / "out").exists()


def test_python_takes_the_commands_options(slim_model, cloud, tmp_path):
    import tumortrack as tt

    for cloud_of, options, named in (
        (cloud, {"crop": 1}, "crop"),
        (str(cloud.rename(tmp_path / "depth.png")), {"intrinsics": "absent.json"}, "absent"),
        ([cloud], {"intrinsics": ["a.json", "b.json"]}, "2 times"),
    ):
        with refused(InputError, named):
            tt.locate_files(str(slim_model), cloud_of, **options)
