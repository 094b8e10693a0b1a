"""Folders of meshes: names, frames, units, repair."""

import re

import numpy as np
import pytest
import trimesh

from imaging_objects import OBLIQUE
from refused import refused
from tumortrack.case.meshes import is_simple, label_meshes, read_meshes
from tumortrack.core.errors import InputError
from tumortrack.core.raster import winding_numbers
from tumortrack.core.types import Mesh


def ball(radius, centre, stretch=(1.0, 1.0, 1.0)):
    mesh = trimesh.creation.icosphere(4, radius)
    return trimesh.Trimesh(mesh.vertices * stretch + np.array(centre), mesh.faces, process=False)


ORGAN = ball(25.0, (10.0, -20.0, 30.0), (1.0, 0.9, 2.0))
TUMOR = ball(9.0, (32.0, -17.0, 38.0))  # half outside
INNER = ball(6.0, (8.0, -22.0, 20.0))


def save(folder, name, mesh, space=None):
    """Write a mesh with 3D Slicer's comment."""
    path = folder / name
    mesh.export(path)
    if space is not None:
        content, word = path.read_bytes(), f"SPACE={space}".encode()
        path.write_bytes(
            {
                ".ply": content.replace(b"\nelement", b"\ncomment " + word + b"\nelement", 1),
                ".stl": word.ljust(80) + content[80:],
                ".obj": b"# " + word + b"\n" + content,
            }[path.suffix]
        )


def read(folder, unit=None):
    return read_meshes([*folder.iterdir()], unit)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
@pytest.mark.parametrize("space", [None, "LPS", "RAS"])
def test_no_mesh_is_mirrored(tmp_path, suffix, space):
    sign = [-1, -1, 1] if space == "RAS" else [1, 1, 1]
    for name, mesh in (("Kidney", ORGAN), ("tumor_2", INNER), ("Tumor_1", TUMOR)):
        moved = trimesh.Trimesh(mesh.vertices * sign, mesh.faces, process=False)
        save(tmp_path, f"{name}.{suffix}", moved, space)
    anatomy, notes = read(tmp_path)
    assert len(anatomy.parts) == 3
    for part, mesh in zip(anatomy.tumors, (TUMOR, INNER), strict=True):
        assert part.vertices_mm.mean(0) == pytest.approx(mesh.vertices.mean(0), abs=0.01)
        assert part.volume_mm3 == pytest.approx(mesh.volume, rel=1e-3)
    union = ORGAN.union(TUMOR)
    assert anatomy.organ.volume_mm3 == pytest.approx(union.volume, rel=1e-3)
    assert anatomy.organ.box_mm == pytest.approx(union.bounds, abs=0.01)
    assert any("SPACE=RAS" in note for note in notes) == (space == "RAS")


def test_unclear_names_are_refused(tmp_path):
    save(tmp_path, "kidney.ply", ORGAN)
    save(tmp_path, "thing.ply", INNER)
    with refused(InputError, "thing.ply"):
        read(tmp_path)
    (tmp_path / "thing.ply").rename(tmp_path / "organ.ply")
    with refused(InputError, "organ.ply"):
        read(tmp_path)
    (tmp_path / "organ.ply").rename(tmp_path / "kidney_tumor.ply")
    assert len(read(tmp_path)[0].parts) == 2


def test_metres_are_recognised_and_converted_on_request(tmp_path):
    save(tmp_path, "kidney.obj", trimesh.Trimesh(ORGAN.vertices / 1000, ORGAN.faces))
    with refused(InputError, "--unit m"):
        read(tmp_path)
    anatomy, _ = read(tmp_path, "m")
    assert anatomy.organ.volume_mm3 == pytest.approx(ORGAN.volume, rel=1e-3)


def too_large(folder):
    save(folder, "kidney.obj", trimesh.Trimesh(ORGAN.vertices * 40, ORGAN.faces))


def apart(folder):
    save(folder, "kidney.ply", ORGAN)
    save(folder, "tumor.ply", ball(6.0, (60, 60, 60)))


def open_wide(folder):
    keep = ORGAN.triangles_center[:, 2] < 60
    save(folder, "kidney.ply", trimesh.Trimesh(ORGAN.vertices, ORGAN.faces[keep]))


@pytest.mark.parametrize(
    ("make", "named"),
    [(too_large, "15 to 600 mm"), (apart, "tumor_1"), (open_wide, "1 holes")],
)
def test_what_cannot_be_an_organ_is_refused(tmp_path, make, named):
    make(tmp_path)
    with refused(InputError, named):
        read(tmp_path)


def test_a_bed_cut_out_for_the_tumor_is_filled(tmp_path):
    """Segments exported without overlap leave a cavity a little larger than the tumor."""
    save(tmp_path, "kidney.ply", ORGAN.difference(ball(6.2, (8.0, -22.0, 20.0))))
    save(tmp_path, "tumor.ply", INNER)
    anatomy, _ = read(tmp_path)
    assert anatomy.organ.volume_mm3 == pytest.approx(ORGAN.volume, rel=1e-3)


def test_inside_out_holes_and_double_faces_are_repaired_with_a_note(tmp_path):
    faces = ORGAN.faces[:, ::-1]
    faces = np.concatenate([np.delete(faces, [5, 700], 0), faces[100:103]])
    save(tmp_path, "kidney.ply", trimesh.Trimesh(ORGAN.vertices, faces, process=False))
    anatomy, notes = read(tmp_path)
    assert anatomy.organ.volume_mm3 == pytest.approx(ORGAN.volume, rel=1e-3)
    repairs = [note for note in notes if note.startswith("kidney.ply: ")]
    counts = [re.findall(r"\d+", note)[:1] for note in repairs]
    assert sorted(counts) == [[], ["2"], ["3"]]  # turned, holes closed, doubled faces


def test_a_self_crossing_mesh_is_remeshed_as_its_union(tmp_path):
    other = ball(20.0, (30.0, -20.0, 30.0))
    save(tmp_path, "kidney.ply", trimesh.util.concatenate([ORGAN, other]))
    anatomy, notes = read(tmp_path)
    assert len([note for note in notes if note.startswith("kidney.ply: ")]) == 1
    assert anatomy.organ.volume_mm3 == pytest.approx(ORGAN.union(other).volume, rel=0.01)


def test_winding_numbers_do_not_depend_on_the_grids_order_and_turn_with_the_faces():
    frame_from_index, shape = np.diag([2.7, 2.7, 2.7, 1.0]), (24, 26, 40)
    frame_from_index[:3, 3] = ORGAN.bounds[0] - 3
    ours = Mesh(ORGAN.vertices, ORGAN.faces)
    numbers = winding_numbers(ours, frame_from_index, shape)
    mirror = frame_from_index @ np.diag([-1.0, 1, 1, 1])
    mirror[:3, 3] += frame_from_index[:3, 0] * (shape[0] - 1)
    assert np.array_equal(winding_numbers(ours, mirror, shape)[::-1], numbers)
    inside_out = winding_numbers(Mesh(ORGAN.vertices, ORGAN.faces[:, ::-1]), mirror, shape)
    assert np.array_equal(-inside_out[::-1], numbers)
    assert is_simple(ours, 1.0)
    crossing = trimesh.util.concatenate([ORGAN, ball(20.0, (30.0, -20.0, 30.0))])
    assert not is_simple(Mesh(crossing.vertices, crossing.faces), 1.0)


def test_labels_of_meshes_have_their_volumes(tmp_path):
    for name, mesh in (("kidney", ORGAN), ("tumor_1", TUMOR), ("tumor_2", INNER)):
        save(tmp_path, f"{name}.stl", mesh)
    anatomy, _ = read(tmp_path)
    labels = label_meshes(anatomy)
    counts = np.bincount(labels.labels.ravel())
    assert counts[2] == pytest.approx(TUMOR.volume, rel=0.02)
    assert counts[3] == pytest.approx(INNER.volume, rel=0.03)
    assert counts[1:].sum() == pytest.approx(anatomy.organ.volume_mm3, rel=0.01)
    centre = labels.lps_from_index @ [*np.argwhere(labels.labels == 2).mean(0), 1]
    assert centre[:3] == pytest.approx([32, -17, 38], abs=0.1)


def test_winding_numbers_agree_with_an_independent_test():
    mesh = trimesh.Trimesh(ORGAN.vertices @ OBLIQUE.T, ORGAN.faces, process=False)
    ours = Mesh(mesh.vertices, mesh.faces)
    frame_from_index, shape = np.diag([2.7, 2.7, 2.7, 1.0]), (24, 26, 40)
    frame_from_index[:3, 3] = mesh.bounds[0] - 3
    numbers = winding_numbers(ours, frame_from_index, shape)
    centres = np.argwhere(np.ones(shape, bool)) * 2.7 + frame_from_index[:3, 3]
    assert np.array_equal(numbers.ravel() == 1, mesh.contains(centres))
    assert set(np.unique(numbers)) == {0, 1}
    mirror = frame_from_index @ np.diag([-1.0, 1, 1, 1])
    mirror[:3, 3] += frame_from_index[:3, 0] * (shape[0] - 1)
    assert np.array_equal(winding_numbers(ours, mirror, shape)[::-1], numbers)
    inside_out = winding_numbers(Mesh(mesh.vertices, mesh.faces[:, ::-1]), mirror, shape)
    assert np.array_equal(-inside_out[::-1], numbers)
    assert is_simple(ours, 1.0)
    crossing = trimesh.util.concatenate([mesh, trimesh.creation.box((30, 30, 30), np.eye(4))])
    assert not is_simple(Mesh(crossing.vertices, crossing.faces), 1.0)
