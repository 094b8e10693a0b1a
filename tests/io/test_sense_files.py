"""Clouds, depth images and intrinsics from and to files: round trips and damaged input."""

import io
import json
import math
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from depth_files import write_depth_png, write_intrinsics
from depth_objects import SMALL, dome, pixels, wall
from refused import refused
from tumortrack.core.camera import d405, deproject
from tumortrack.core.cloud import check_cloud
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthError, Intrinsics
from tumortrack.io.depth_files import (
    CALIBRATED_MM,
    intrinsics_json,
    read_cloud,
    read_depth_png,
    read_intrinsics,
)
from tumortrack.io.ply import write_cloud_ply
from tumortrack.simulation.noise import NoiseConfig, add_noise


@pytest.fixture
def points():
    return deproject(dome())[::40].copy()


def ply_bytes(points, form="binary_little_endian", before=(), dtype="<f4"):
    kind = {"f4": "float", "f8": "double"}[dtype[1:]]
    axes = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    header = f"ply\nformat {form} 1.0\n{''.join(before)}element vertex {len(points)}\n{axes}"
    header += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    if form == "ascii":
        body = "\n".join(" ".join(repr(float(x)) for x in p) for p in points).encode()
    else:
        body = points.astype(dtype).tobytes()
    return header.encode() + body


def pcd_bytes(points, encoding):
    from pypcd4 import Encoding, PointCloud

    stream = io.BytesIO()
    PointCloud.from_xyzi_points(np.c_[points, np.arange(len(points))]).save(
        stream, Encoding(encoding)
    )
    return stream.getvalue()


def npz_bytes(compressed=False, **arrays):
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)
    return stream.getvalue()


def cloud_files(points):
    """Every kind of cloud file: (suffix, content)."""
    return {
        "ply little": (".ply", ply_bytes(points)),
        "ply big": (".ply", ply_bytes(points, "binary_big_endian", dtype=">f8")),
        "ply ascii": (".ply", ply_bytes(points, "ascii", ["comment made by hand\n"])),
        "pcd ascii": (".pcd", pcd_bytes(points, "ascii")),
        "pcd binary": (".pcd", pcd_bytes(points, "binary")),
        "pcd compressed": (".pcd", pcd_bytes(points, "binary_compressed")),
        "npz": (".npz", npz_bytes(points=points, intensity=np.arange(len(points)))),
        "npz deflated": (".npz", npz_bytes(True, anything=points.astype(float))),
    }


KINDS = list(cloud_files(np.zeros((1, 3), np.float32)))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_cloud_file_gives_its_points(kind, points, tmp_path):
    suffix, content = cloud_files(points)[kind]
    path = tmp_path / f"cloud{suffix}"
    path.write_bytes(content)
    cloud, notes = read_cloud(path)
    np.testing.assert_allclose(cloud.points_mm, points, rtol=1e-6)
    assert notes == ()
    path.write_bytes(cloud_files(points / 1000)[kind][1])
    in_metres, _ = read_cloud(path, unit="m")
    np.testing.assert_allclose(in_metres.points_mm, points, rtol=1e-6)


def test_written_cloud_is_read_back_by_us_and_by_trimesh(points, tmp_path):
    import trimesh

    path = tmp_path / "cloud.ply"
    labels = (np.arange(len(points)) % 3).astype(np.uint8)
    probability = np.linspace(0, 1, len(points), dtype=np.float32)
    write_cloud_ply(path, points, label=labels, probability=probability)
    np.testing.assert_array_equal(read_cloud(path)[0].points_mm, points)
    loaded = trimesh.load(path)
    np.testing.assert_array_equal(loaded.vertices, points)
    raw = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(raw["label"], labels)
    np.testing.assert_array_equal(raw["probability"], probability)
    with refused(InputError, "label"):
        write_cloud_ply(path, points, label=labels[:5])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", ">f8"])
def test_signalling_nans_of_a_ply_are_dropped_without_a_warning(dtype, points, tmp_path):
    """Coordinates whose byte order the header states wrongly contain some."""
    stored = points.astype(dtype)
    bits, signalling = {"4": ("u4", 0x7F800001), "8": ("u8", 0x7FF0000000000001)}[dtype[2]]
    stored.view(dtype[0] + bits)[::3, 0] = signalling
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[dtype[0]]
    path = tmp_path / "cloud.ply"
    path.write_bytes(ply_bytes(stored, form, dtype=dtype))
    cloud, (note,) = read_cloud(path)
    assert note.startswith(f"dropped {len(points[::3])} of {len(points)} points")
    np.testing.assert_array_equal(cloud.points_mm, np.delete(points, np.s_[::3], axis=0))


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_organised_pcd_with_nans_loses_them_and_says_so(encoding, tmp_path):
    frame = dome()
    u, v = pixels(SMALL)
    z = frame.depth_mm
    grid = np.stack([(u - SMALL.cx) / SMALL.fx * z, (v - SMALL.cy) / SMALL.fy * z, z], -1)
    grid[np.isnan(z) & (u % 2 == 0)] = 0  # both ways to say "no return"
    content = pcd_bytes(grid.reshape(-1, 3).astype(np.float32), encoding)
    content = content.replace(b"WIDTH 101760\nHEIGHT 1\n", b"WIDTH 424\nHEIGHT 240\n")
    assert b"HEIGHT 240" in content
    path = tmp_path / "organised.pcd"
    path.write_bytes(content)
    cloud, (note,) = read_cloud(path)
    np.testing.assert_allclose(cloud.points_mm, deproject(frame), atol=1e-3)
    assert note.startswith(f"dropped {np.isnan(z).sum()} of 101760 points")
    check_cloud(cloud)


@pytest.mark.parametrize(
    "arrays",
    [
        {"a": np.ones((4, 3)), "b": np.ones((5, 3))},
        {"points": np.ones((4, 2))},
        {"points": np.full((4, 3), np.nan)},
        {"points": np.array([{}], dtype=object)},
        {},
    ],
)
def test_npz_without_one_cloud_is_refused(arrays, tmp_path):
    path = tmp_path / "cloud.npz"
    path.write_bytes(npz_bytes(**arrays))
    with refused(InputError, "cloud.npz"):
        read_cloud(path)


def test_points_mm_wins_and_contradicts_metres(points, tmp_path):
    path = tmp_path / "cloud.npz"
    path.write_bytes(npz_bytes(points=points / 1000, points_mm=points))
    np.testing.assert_array_equal(read_cloud(path)[0].points_mm, points)
    with refused(InputError, "--unit m"):
        read_cloud(path, unit="m")


def npy_claiming(shape):
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as z:
        z.writestr("points.npy", stream.getvalue())
    return archive.getvalue()


def huge_compressed_pcd():
    content = pcd_bytes(np.ones((300, 3), np.float32), "binary_compressed")
    start = content.index(b"compressed\n") + len(b"compressed\n")
    return content[:start] + struct.pack("<II", 16, 2**32 - 1) + content[start + 8 :]


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        (".ply", ply_bytes(np.ones((9, 3))).replace(b"vertex 9", b"vertex 4294967295")),
        (".ply", ply_bytes(np.ones((9, 3)), "ascii").replace(b"vertex 9", b"vertex 4294967295")),
        (".ply", ply_bytes(np.ones((9, 3)))[:-1]),
        (".pcd", pcd_bytes(np.ones((9, 3)), "binary").replace(b"POINTS 9", b"POINTS 4294967295")),
        (".pcd", pcd_bytes(np.ones((9, 3)), "ascii").replace(b"POINTS 9", b"POINTS 4294967295")),
        (".pcd", huge_compressed_pcd()),
        (".npz", npy_claiming((10**12, 3))),
        (".npz", npy_claiming((10**30, 3))),
    ],
)
def test_counts_beyond_the_file_are_refused_before_allocation(suffix, content, tmp_path):
    path = tmp_path / f"cloud{suffix}"
    path.write_bytes(content)
    with refused(InputError, path.name):
        read_cloud(path)


@pytest.mark.parametrize("name", ["no.ply", "no.xyz", "folder.ply", "empty.ply", "empty.npz"])
def test_paths_that_are_no_clouds(name, tmp_path):
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "empty.ply").touch()
    (tmp_path / "empty.npz").touch()
    with refused(InputError, name):
        read_cloud(tmp_path / name)


# depth images


@pytest.fixture
def stored(tmp_path):
    """Writes a frame and what its camera's file says, and reads them."""

    def written(frame, **said):
        png, camera = tmp_path / "depth.png", tmp_path / "intrinsics.json"
        write_depth_png(png, frame)
        camera.write_text(json.dumps(intrinsics_json(SMALL) | said))
        return read_depth_png(png, camera)

    return written


def test_depth_png_round_trip_within_half_a_unit(stored):
    frame = dome()
    again = stored(frame)
    assert again.intrinsics == SMALL
    np.testing.assert_array_equal(np.isnan(again.depth_mm), np.isnan(frame.depth_mm))
    assert np.nanmax(np.abs(again.depth_mm - frame.depth_mm)) <= 0.05001
    finer = NoiseConfig(quantum_mm=0.1)  # a sensor's own units survive exactly
    exact = add_noise(frame, finer, np.random.default_rng(0))
    np.testing.assert_allclose(stored(exact).depth_mm, exact.depth_mm, rtol=1e-6)


def test_unit_and_correction_are_what_the_intrinsics_file_says(stored):
    for unit_mm in (0.25, 1.0):
        assert (stored(wall(130.0), depth_unit_mm=unit_mm).depth_mm == 1300 * unit_mm).all()
    corrected = stored(wall(130.0), depth_scale=0.98, depth_offset_mm=1.5)
    assert corrected.depth_mm == pytest.approx(128.9, abs=1e-4)
    behind = stored(wall(19.0), depth_scale=0.98, depth_offset_mm=-19.0)
    assert np.isnan(behind.depth_mm).all()
    for key, value, named in (
        ("depth_unit_mm", 0.0, "depth_unit_mm"),
        *(("depth_scale", 98.0, "scale"), ("depth_offset_mm", 21, "offset_mm")),
        ("depth_offset_mm", "1 mm", "depth_offset_mm"),
        *(("depth_left_mm", mm, "depth_left_mm") for mm in (-1, 21, "1 mm")),
    ):
        with refused(InputError, named):
            stored(wall(130.0), **{key: value})


@pytest.mark.parametrize(
    ("said", "left_mm"),
    [
        ({}, None),
        ({"depth_left_mm": 0.4}, 0.4),
        ({"depth_scale": 0.99}, CALIBRATED_MM),
        ({"depth_offset_mm": 1.0, "depth_left_mm": 0}, 0.0),
    ],
)
def test_what_a_calibration_leaves_is_the_cameras(said, left_mm, stored):
    error = stored(wall(130.0), **said).intrinsics.depth_error
    assert error == (None if left_mm is None else DepthError(left_mm))
    assert intrinsics_json(replace(SMALL, depth_error=error)).get("depth_left_mm") == left_mm


@pytest.mark.parametrize("mm", [7000.0, 6553.5, -5.0])  # 65535 steps stand for no depth
def test_depths_that_16_bits_cannot_hold_are_refused(mm, tmp_path):
    with refused(InputError, "6553.4"):
        write_depth_png(tmp_path / "depth.png", wall(mm))
    assert not list(tmp_path.iterdir())


def test_depth_png_of_another_size_or_depth_is_refused(tmp_path):
    png, camera = tmp_path / "depth.png", tmp_path / "intrinsics.json"
    write_intrinsics(camera, d405())
    write_depth_png(png, wall(130.0))
    with refused(InputError, "424 x 240", "848 x 480"):
        read_depth_png(png, camera)
    write_intrinsics(camera, SMALL)
    Image.fromarray(np.zeros((240, 424), np.uint8)).save(png)
    with refused(InputError, "depth.png"):
        read_depth_png(png, camera)


GOOD = {"width": 848, "height": 480, "fx": 430.5, "fy": 431.0, "cx": 420.0, "cy": 239.0}


def test_intrinsics_by_either_name_of_the_principal_point(tmp_path):
    path = tmp_path / "intrinsics.json"
    expected = Intrinsics(848, 480, 430.5, 431.0, 420.0, 239.0)
    realsense = {**GOOD, "ppx": 420.0, "ppy": 239.0, "model": "x", "coeffs": [0, 0, 0, 0, 0]}
    del realsense["cx"], realsense["cy"]
    for data in (GOOD, realsense):
        path.write_text(json.dumps(data))
        assert read_intrinsics(path) == expected


@pytest.mark.parametrize(
    "change",
    [
        *({"coeffs": [0.1, 0, 0, 0, 0]}, {"k1": -0.2}, {"fx": "wide"}, {"fx": math.nan}),
        *({"fx": 10**400}, {"fx": None}, {"fx": [1, 2]}, {"fx": -3}),
        *({"width": 848.5}, {"width": 10**6}),
    ],
)
def test_unusable_intrinsics_are_refused_by_name(change, tmp_path):
    path = tmp_path / "intrinsics.json"
    path.write_text(json.dumps({**GOOD, **change}))
    with refused(InputError, next(iter(change))):
        read_intrinsics(path)
