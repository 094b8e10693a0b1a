"""Bad input on the command line: one clear line, a non-zero exit code, nothing half written."""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np
import pytest
import trimesh
import tyro

from stories import refusal, tumortrack
from tumortrack.cli.cases import Prepare
from tumortrack.cli.demo import Demo
from tumortrack.cli.main import run
from tumortrack.cli.training import Train
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install
from tumortrack.imaging.options import PrepareOptions
from tumortrack.imaging.prepare import prepare


def _nifti(path: Path, array: np.ndarray, affine: np.ndarray) -> Path:
    image = nibabel.Nifti1Image(array, None)
    image.header.set_sform(affine, code=1)
    image.header["pixdim"][1:4] = np.linalg.norm(affine[:3, :3], axis=0)
    nibabel.save(image, path)
    return path


def _ball(shape: tuple[int, int, int] = (60, 60, 60), radius: float = 25.0) -> np.ndarray:
    index = np.indices(shape) - np.array(shape)[:, None, None, None] / 2
    return ((index**2).sum(0) < radius**2).astype(np.uint8)


def _missing(folder: Path) -> Path:
    return folder / "nothing.nii.gz"


def _empty_folder(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def _not_a_volume(folder: Path) -> Path:
    path = folder / "text.nii.gz"
    path.write_text("no volume at all")
    return path


def _nan_affine(folder: Path) -> Path:
    affine = np.eye(4)
    affine[0, 3] = np.nan
    return _nifti(folder / "nan.nii", _ball(), affine)


def _singular_affine(folder: Path) -> Path:
    return _nifti(folder / "singular.nii", _ball(), np.diag([1.0, 1.0, 0.0, 1.0]))


def _metres(folder: Path) -> Path:
    return _nifti(folder / "metres.nii", _ball(), np.diag([0.001, 0.001, 0.001, 1.0]))


def _detached(folder: Path) -> Path:
    secret = folder / "secret.raw"
    secret.write_bytes(b"x" * 27_000)
    path = folder / "detached.nrrd"
    path.write_text(
        "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 30 30 30\nspace: left-posterior-superior\n"
        "space directions: (1,0,0) (0,1,0) (0,0,1)\nencoding: raw\ndata file: secret.raw\n\n"
    )
    return path


def _huge_header(folder: Path) -> Path:
    path = folder / "huge.nrrd"
    path.write_text(
        "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 30000 30000 30000\n"
        "space: left-posterior-superior\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"
        "encoding: raw\n\n"
    )
    return path


def _without_organ(folder: Path) -> Path:
    return _nifti(folder / "tumor_only.nii", (2 * _ball()).astype(np.uint8), np.eye(4))


def _huge_stl(folder: Path) -> Path:
    (folder / "meshes").mkdir()
    claims = np.array([2**32 - 1], np.uint32).tobytes()
    (folder / "meshes" / "kidney.stl").write_bytes(b"\0" * 80 + claims + b"\0" * 50)
    return folder / "meshes"


def _open_mesh(folder: Path) -> Path:
    (folder / "meshes").mkdir()
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=30)
    half = trimesh.Trimesh(sphere.vertices, sphere.faces[: len(sphere.faces) // 2], process=False)
    half.export(folder / "meshes" / "kidney.stl")
    return folder / "meshes"


@pytest.mark.parametrize(
    "make",
    [
        _missing,
        _empty_folder,
        _not_a_volume,
        _nan_affine,
        _singular_affine,
        _metres,
        _detached,
        _huge_header,
        _without_organ,
        _huge_stl,
        _open_mesh,
    ],
)
def test_prepare_refuses(make, tmp_path):
    source = make(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    message = refusal(tumortrack("prepare", source, tmp_path / "case"))
    assert len(message) > 40  # says what and what to do
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--up", "sideways"], "anterior"),
        (["--up", "0,0,0"], "three numbers"),
        (["--organ", "300"], "1..255"),
        (["--organ-hu", "300", "-300"], "low < high"),
        (["--patient", " "], "is no identifier"),
        (["--organ", "2", "--tumor", "0"], "--organ, --tumor means nothing"),
        (["--unit", "m"], "--unit means nothing"),
        (["--series", "1"], "--series means nothing"),
        (["--tilt", "61"], "tilt is 61 degrees; allowed: 0 to 60"),
        (["--tilt", "-1"], "allowed: 0 to 60"),
        (["--tilt", "nan"], "allowed: 0 to 60"),
    ],
)
def test_options_out_of_range_say_what_is_allowed(arguments, words, tmp_path):
    source = _nifti(tmp_path / "ball.nii", 1000 * _ball().astype(np.int16) - 900, np.eye(4))
    assert words in refusal(tumortrack("prepare", source, tmp_path / "case", *arguments))
    assert not (tmp_path / "case").exists()


@pytest.mark.parametrize(
    ("option", "value", "others"),
    [("--rotations", "any", "('limited', "), ("--sensor", "kinect", "('d405', ")],
)
@pytest.mark.usefixtures("unchecked")
def test_a_choice_that_is_none_says_what_is_one(option, value, others, tmp_path):
    source = _nifti(tmp_path / "ball.nii", _ball(), np.eye(4))
    done = tumortrack("prepare", source, tmp_path / "case", option, value)
    assert done.returncode == 2
    assert option in done.stderr
    assert value in done.stderr
    assert others in done.stderr
    name = option.removeprefix("--")
    with pytest.raises(InputError, match=f"{name} '{value}' is not allowed"):
        PrepareOptions(**{name: value})


def test_options_of_other_inputs_are_refused(tmp_path):
    """What a label map or meshes never ask for would be ignored without a word."""
    labels = _nifti(tmp_path / "labels.nii", _ball(), np.eye(4))
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.icosphere(3, 30.0).export(meshes / "kidney.stl")
    for source, wrong in (
        (labels, {"tumor_hu": (200.0, 900.0)}),
        (labels, {"unit": "m"}),
        (labels, {"series": "1"}),
        (meshes, {"organ_hu": (0.0, 200.0)}),
        (meshes, {"labels": True}),
        (meshes, {"series": "1"}),
    ):
        with pytest.raises(InputError, match="--" + next(iter(wrong)).replace("_", "-")):
            prepare(source, PrepareOptions(**wrong))


def test_an_unreadable_input_is_named_and_no_folder_stays(tmp_path, monkeypatch):
    source = _nifti(tmp_path / "ball.nii", _ball(), np.eye(4))

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tumortrack.imaging.volume.read_raw", refuse)
    with pytest.raises(InputError, match=r"ball\.nii cannot be read: Permission denied"):
        Prepare(input=source, case=tmp_path / "new" / "dir" / "case").run()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ball.nii"]


@pytest.mark.parametrize(
    "arguments", [["demo", "--preset", "quick"], ["train", "--preset", "paper"]]
)
def test_the_papers_method_names_its_package_where_it_is_not_installed(
    arguments, phantom_case, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("tumortrack.models.method.entry_points", lambda group: [])
    out = str(tmp_path / "out")
    places = ["--out", out] if arguments[0] == "demo" else [str(phantom_case), out]
    assert run([*arguments, *places]) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert to_install("tumortrack-occupancy") in said.err
    assert said.out == ""
    assert list(tmp_path.iterdir()) == []


def test_train_wants_one_end(tmp_path):
    with pytest.raises(InputError, match="--minutes and --steps"):
        Train(case=tmp_path / "case", model=tmp_path / "model", minutes=1.0, steps=10).run()


@pytest.mark.parametrize(
    ("minutes", "scenes", "words"),
    [(-1.0, 2, "--minutes"), (np.nan, 2, "--minutes"), (1.0, 0, "--scenes"), (1.0, 11, "--scenes")],
)
def test_a_demo_of_nothing_is_refused_at_once(minutes, scenes, words, tmp_path):
    with pytest.raises(InputError, match=words):
        Demo(out=tmp_path / "demo", minutes=minutes, scenes=scenes).run()
    assert list(tmp_path.iterdir()) == []


def test_the_demo_replaces_nothing_but_a_demo(tmp_path, monkeypatch):
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tumortrack.phantom.scanner.scan", stop)
    mine = tmp_path / "mine"
    (mine / "case").mkdir(parents=True)
    (mine / "case" / "dear.txt").write_text("dear")
    (tmp_path / "file").write_text("dear")
    before = sorted(tmp_path.rglob("*"))
    for out, words in ((mine, "no demo wrote"), (tmp_path / "file", "is a file")):
        with pytest.raises(InputError, match=words):
            Demo(out=out, scenes=1).run()
    assert sorted(tmp_path.rglob("*")) == before
    demo = tmp_path / "demo"
    with pytest.raises(KeyboardInterrupt):
        Demo(out=demo, scenes=1).run()
    (demo / "case").mkdir()  # what a demo that was stopped left there
    with pytest.raises(KeyboardInterrupt):
        Demo(out=demo, scenes=1).run()
    assert [p.name for p in demo.iterdir()] == ["demo.json"]
    (demo / "notes.txt").write_text("dear")
    with pytest.raises(InputError, match=r"notes\.txt"):
        Demo(out=demo, scenes=1).run()


def test_the_window_of_hu_keeps_its_old_name():
    told = tyro.cli(Prepare, args=["ct.nii.gz", "case", "--kidney-hu", "-200", "250"])
    assert told.organ_hu == (-200.0, 250.0)
