"""Artifact folders and mesh files: whole or absent, and damage is found."""

import json
import os
import shutil
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import trimesh

from refused import refused
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError, StorageError
from tumortrack.core.types import Mesh
from tumortrack.io.mesh_files import read_mesh


def box(extents=(2, 3, 4), center=(0, 0, 0)):
    solid = trimesh.creation.box(extents)
    return Mesh(solid.vertices + np.array(center, float), solid.faces)


# artifact folders


def leftovers(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("error", [RuntimeError, OSError, KeyboardInterrupt])
def test_new_folder_leaves_nothing_when_its_body_fails(tmp_path, error):
    raised = StorageError if error is OSError else error

    def fill():
        with store.new_folder(tmp_path / "a" / "case") as aside:
            (aside / "half").write_text("half")
            raise error

    with pytest.raises(raised):
        fill()
    assert leftovers(tmp_path / "a") == []


def test_new_folder_appears_whole_and_at_once(tmp_path):
    with store.new_folder(tmp_path / "case") as aside:
        (aside / "sub").mkdir()
        (aside / "sub" / "file").write_text("x")
        assert not (tmp_path / "case").exists()
    assert (tmp_path / "case" / "sub" / "file").read_text() == "x"
    assert (tmp_path / "case").stat().st_mode & 0o777 == 0o755
    assert leftovers(tmp_path) == ["case"]


def write_case(folder, name, kind="case"):
    with store.new_folder(folder, overwrite=True) as aside:
        (aside / name).write_text(name)
        store.seal(aside, kind, {}, frame="lps")


def test_existing_folder_is_refused_or_swapped(tmp_path):
    (tmp_path / "case").mkdir()  # an empty one may be filled
    for content in ("old", "new"):
        write_case(tmp_path / "case", content)
    assert leftovers(tmp_path / "case") == ["manifest.json", "new"]
    with (
        refused(InputError, "--overwrite"),
        store.new_folder(tmp_path / "case", overwrite=False),
    ):
        pytest.fail("the body must not run")
    with (
        pytest.raises(RuntimeError),
        store.new_folder(tmp_path / "case", overwrite=True),
    ):
        raise RuntimeError
    assert leftovers(tmp_path / "case") == ["manifest.json", "new"]
    assert leftovers(tmp_path) == ["case"]


def test_overwriting_spares_what_is_not_ours(tmp_path):
    """Only an artifact of the same kind with nothing else in it is replaced."""
    photos, file, run, used = (tmp_path / name for name in ("photos", "file", "run", "used"))
    photos.mkdir()
    (photos / "holiday.jpg").write_text("dear")
    (photos / "manifest.json").write_text('{"kind": "case"}')  # another program's
    file.write_text("dear")
    write_case(run, "report.json", kind="run")
    write_case(used, "kidney.ply")
    (used / "model").mkdir()  # trained inside the case's folder
    before = sorted(tmp_path.rglob("*"))
    for place in (photos, file, run, used):
        for write in (write_case, lambda path, _: store.check_place(path, "case", overwrite=True)):
            with refused(InputError, place.name):
                write(place, "kidney.ply")
    with pytest.raises(InputError), store.new_folder(run, overwrite=True):
        pass  # unsealed
    assert sorted(tmp_path.rglob("*")) == before
    store.check_place(run, "run", overwrite=True)


def test_overwriting_a_link_keeps_what_it_points_to(tmp_path):
    write_case(tmp_path / "real", "old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_case(tmp_path / "link", "new")
    assert leftovers(tmp_path / "link") == ["manifest.json", "new"]
    assert leftovers(tmp_path / "real") == ["manifest.json", "old"]
    assert leftovers(tmp_path) == ["link", "real"]


def test_old_folder_returns_when_the_swap_fails(tmp_path, monkeypatch):
    write_case(tmp_path / "case", "old")
    rename = store.os.rename

    def refuse(source, target):
        if str(source).endswith(".part"):
            raise OSError(5, "Input/output error")
        rename(source, target)

    monkeypatch.setattr(store.os, "rename", refuse)
    with (
        refused(StorageError, tmp_path / "case"),
        store.new_folder(tmp_path / "case", overwrite=True) as aside,
    ):
        store.seal(aside, "case", {}, frame="lps")
    assert leftovers(tmp_path) == ["case"]
    assert leftovers(tmp_path / "case") == ["manifest.json", "old"]


@pytest.fixture
def sealed(tmp_path):
    with store.new_folder(tmp_path / "case") as aside:
        (aside / "data.bin").write_bytes(bytes(range(200)))
        (aside / "more.txt").write_text("more")
        store.seal(aside, "case", {"up": [0, -1, 0]}, frame="lps")
    return tmp_path / "case"


def test_a_sealed_folder_reads_back(sealed):
    manifest = store.read_manifest(sealed, "case")
    assert set(manifest["files"]) == {"data.bin", "more.txt"}
    assert (manifest["up"], manifest["units"], manifest["frame"]) == ([0, -1, 0], "mm", "lps")
    # sha256 of the bytes 0 ... 199, by sha256sum
    assert manifest["files"]["data.bin"].startswith("1901da1c9f699b48")


def edit(folder, **changes):
    path = folder / store.MANIFEST
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def flip_a_bit(folder):
    data = bytearray((folder / "data.bin").read_bytes())
    data[77] ^= 1
    (folder / "data.bin").write_bytes(data)


def write_manifest(content: bytes):
    return lambda folder: (folder / store.MANIFEST).write_bytes(content)


@pytest.mark.parametrize(
    "damage",
    [
        flip_a_bit,
        lambda f: (f / "data.bin").unlink(),
        lambda f: (f / store.MANIFEST).unlink(),
        lambda f: edit(f, kind="model"),
        lambda f: edit(f, files=None),
        lambda f: edit(f, files={"../outside": "0"}),
        lambda f: edit(f, files={"": "0"}),
        lambda f: edit(f, files={"data.bin": 5}),
        *map(write_manifest, (b"{", b"[1]", b"\xff\xfe{}", b" " * (2**24 + 1))),
        *map(write_manifest, (b'{"a":' * 100_000, b'{"a":' + b"1" * 9000 + b"}")),
    ],
)
def test_damage_to_a_sealed_folder_is_found(sealed, damage):
    (sealed.parent / "outside").write_text("beside the folder")
    damage(sealed)
    with refused(ArtifactError, sealed):
        store.read_manifest(sealed, "case")


@pytest.mark.parametrize(
    ("kind", "command"),
    [
        ("case", "prepare"),
        ("twin", "twin"),
        ("model", "train"),
        ("run", "locate"),
        ("plan", "plan"),
    ],
)
def test_a_folder_of_another_schema_names_the_command_that_remakes_it(sealed, kind, command):
    edit(sealed, kind=kind, schema=1)
    with refused(ArtifactError, store.SCHEMA, f"tumortrack {command}"):
        store.read_manifest(sealed, kind)


def test_a_folders_digest_sees_names_and_contents(tmp_path):
    for name, files in {"a": {"x": "1", "y": "2"}, "b": {"y": "2", "x": "1"}}.items():
        (tmp_path / name).mkdir()
        for file, text in files.items():
            (tmp_path / name / file).write_text(text)
    same = store.sha256_of(tmp_path / "a")
    assert store.sha256_of(tmp_path / "b") == same
    (tmp_path / "b" / "x").rename(tmp_path / "b" / "z")
    assert store.sha256_of(tmp_path / "b") != same


def test_a_full_disk_keeps_what_was_there(tmp_path):
    """The kernel refuses to write beyond 4 kB (EFBIG), as it does on a full disk (ENOSPC)."""
    script = f"""
        import resource
        from pathlib import Path
        from tumortrack.core import store
        from tumortrack.core.errors import StorageError

        folder = Path({str(tmp_path)!r})
        store.write_atomically(folder / "file", b"old")
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

        def fill():
            with store.new_folder(folder / "case") as aside:
                (aside / "small").write_bytes(b"1")
                (aside / "big").write_bytes(bytes(9999))

        for write in (lambda: store.write_atomically(folder / "file", bytes(9999)), fill):
            try:
                write()
            except StorageError as error:
                print(error)
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert len(done.stdout.splitlines()) == 2
    assert (tmp_path / "file").read_bytes() == b"old"
    assert leftovers(tmp_path) == ["file"]


# mesh files


OFF = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
OFF += "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
THREE = "0 0 0\n1 0 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("missing.ply", None),
        ("mesh.vtk", "x"),
        ("empty.ply", ""),
        ("text.stl", "no mesh at all"),
        ("far.ply", OFF + THREE + "3 0 1 7\n"),
        ("line.ply", OFF + THREE + "3 0 1 1\n"),
        ("nan.ply", OFF + "nan 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
    ],
)
def test_what_is_no_mesh_is_refused(tmp_path, name, content):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(InputError):
        read_mesh(tmp_path / name)


def test_what_killed_processes_left_is_cleared_and_what_another_writes_is_not(tmp_path):
    for name in (".run.aaaaaaaa.part", ".run.bbbbbbbb.old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
    with refused(InputError, tmp_path / "run"), store.new_folder(tmp_path / "run"):
        pass
    assert (tmp_path / "run" / "file").read_text() == ".run.bbbbbbbb.old"  # it came back
    (tmp_path / ".run.cccccccc.old").mkdir()  # killed behind the second renaming
    with store.new_folder(tmp_path / "more") as aside:
        with store.new_folder(tmp_path / "more"):  # locks are of descriptors: as two processes
            assert aside.is_dir()
        with pytest.raises(InputError), store.new_folder(tmp_path / "run"):
            pass
        shutil.rmtree(tmp_path / "more")
    assert {path.name for path in tmp_path.iterdir()} == {"run", "more"}


def test_an_interrupted_write_leaves_the_old_file_alone(tmp_path, monkeypatch):
    store.write_atomically(tmp_path / "file", b"old")

    def interrupted(_):  # not by a signal, which a shell in the background has ignored
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        store.write_atomically(tmp_path / "file", b"new")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]
