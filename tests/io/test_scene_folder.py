"""Scenes on disk: round trip, other programs' scenes, broken ones."""

import json
from functools import partial

import numpy as np
import pytest

from refused import refused
from report_objects import ball as coarse_ball
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, DepthFrame, Intrinsics, Mesh, SensorCloud
from tumortrack.io.mesh_files import write_mesh
from tumortrack.io.scene_folder import Scene, list_scenes, read_scene

ball = partial(coarse_ball, subdivisions=4)


def make_scene(depth=True):
    rng = np.random.default_rng(0)
    intrinsics = Intrinsics(24, 16, 20.0, 21.0, 11.5, 7.5)
    image = rng.uniform(110, 150, (16, 24))
    image[:3] = np.nan
    reference = Anatomy((ball(25, (1, 2, 140)), ball(8, (5, 2, 138))))
    cloud = SensorCloud(rng.normal(0, 10, (500, 3)) + np.array([0, 0, 130]), 7_000)
    frame = DepthFrame(image, intrinsics, 7_000) if depth else None
    return Scene(cloud, reference, frame, {"seed": 3, "recipe": {"push_mm": 2.5}})


def foreign_scene(folder, kidney, *tumors):
    """As another program writes it: ASCII points, no depth, no meta.json."""
    folder.mkdir(parents=True)
    points = np.random.default_rng(1).normal(0, 10, (300, 3)) + np.array([0, 0, 130])
    lines = ["ply", "format ascii 1.0", "element vertex 300", "property float x",
             "property float y", "property float z", "end_header"]  # fmt: skip
    lines += [" ".join(f"{v:.4f}" for v in point) for point in points]
    (folder / "cloud.ply").write_text("\n".join(lines) + "\n")
    write_mesh(folder / "kidney.ply", kidney)
    for number, mesh in enumerate(tumors, start=1):
        write_mesh(folder / f"tumor_{number}.ply", mesh)
    return points


def test_round_trip(tmp_path):
    scene = make_scene()
    scene.write(tmp_path / "a")
    again = read_scene(tmp_path / "a")
    np.testing.assert_array_equal(again.cloud.points_mm, scene.cloud.points_mm)
    assert again.cloud.stamp_ns == 7_000
    assert again.reference.names == ("kidney", "tumor_1")
    for mine, yours in zip(scene.reference.parts, again.reference.parts, strict=True):
        assert yours.volume_mm3 == pytest.approx(mine.volume_mm3, rel=1e-5)
        np.testing.assert_allclose(yours.box_mm, mine.box_mm, atol=1e-4)
    np.testing.assert_allclose(again.depth.depth_mm, scene.depth.depth_mm, atol=0.0501)
    assert again.depth.intrinsics == scene.depth.intrinsics
    assert scene.meta.items() <= again.meta.items()


def test_foreign_scene_without_depth_or_meta(tmp_path):
    kidney, inner = ball(25, (0, 0, 140)), ball(8, (5, 0, 140))
    points = foreign_scene(tmp_path / "a", kidney, inner)
    scene = read_scene(tmp_path / "a")
    assert scene.depth is None
    assert scene.meta == {}
    np.testing.assert_allclose(scene.cloud.points_mm, points, atol=1e-3)
    # Nothing sticks out, so the organ stays as it was given.
    assert len(scene.reference.organ.faces) == len(kidney.faces)


def test_a_tumor_that_sticks_out_becomes_part_of_the_organ(tmp_path):
    kidney, tumor = ball(25, (0, 0, 140)), ball(10, (25, 0, 140))
    foreign_scene(tmp_path / "a", kidney, tumor)
    organ = read_scene(tmp_path / "a").reference.organ
    # Lens common to two spheres (radii R, r, distance d between the centres).
    R, r, d = 25.0, 10.0, 25.0
    lens = np.pi * (R + r - d) ** 2 * (d**2 + 2 * d * (R + r) - 3 * (R - r) ** 2) / (12 * d)
    union = 4 / 3 * np.pi * (R**3 + r**3) - lens
    assert organ.volume_mm3 == pytest.approx(union, rel=5e-3)
    assert organ.box_mm[1, 0] == pytest.approx(35, abs=0.1)


def open_surface(folder):
    kidney = ball(25, (0, 0, 140))
    (folder / "meta.json").unlink()
    write_mesh(folder / "kidney.ply", Mesh(kidney.vertices_mm, kidney.faces[:-40]))


def metres(folder):
    write_mesh(folder / "kidney.ply", ball(0.025, (0, 0, 0.14)))


@pytest.mark.parametrize(
    ("file", "spoil"),
    [
        ("cloud.ply", lambda f: (f / "cloud.ply").unlink()),
        ("kidney.ply", lambda f: (f / "kidney.ply").unlink()),
        ("intrinsics.json", lambda f: (f / "intrinsics.json").unlink()),
        ("kidney.ply", lambda f: (f / "kidney.ply").write_bytes(b"ply\nnonsense")),
        ("cloud.ply", lambda f: (f / "cloud.ply").write_bytes(b"\x00" * 50)),
        ("depth.png", lambda f: (f / "depth.png").write_bytes(b"no image")),
        ("meta.json", lambda f: (f / "meta.json").write_text("{")),
        ("meta.json", lambda f: (f / "meta.json").write_text('{"stamp_ns": "now"}')),
        ("tumor_2.ply", lambda f: (f / "tumor_1.ply").rename(f / "tumor_2.ply")),
        ("kidney.ply", open_surface),
        ("kidney.ply", metres),
    ],
)
def test_broken_scenes_are_refused(tmp_path, file, spoil):
    folder = tmp_path / "scene"
    make_scene().write(folder)
    assert json.loads((folder / "meta.json").read_text())["units"] == "mm"
    spoil(folder)
    with refused(InputError, file):
        read_scene(folder)


def test_folders_without_scenes_are_refused(tmp_path):
    for read, folder in ((list_scenes, tmp_path), (read_scene, tmp_path / "absent")):
        with refused(InputError, folder.name):
            read(folder)
