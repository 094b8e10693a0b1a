"""Bad input on the command line: one clear line, a non-zero exit code, nothing half written."""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np
import pytest
import trimesh
import tyro

from refused import refused
from stories import refusal, tumortrack
from tumortrack.case.options import PrepareOptions
from tumortrack.case.prepare import prepare
from tumortrack.cli.cases import Prepare
from tumortrack.cli.demo import Demo
from tumortrack.cli.main import run
from tumortrack.cli.training import Train
from tumortrack.core.errors import InputError


def _nifti(path: Path, array: np.ndarray) -> Path:
    image = nibabel.Nifti1Image(array, None)
    image.header.set_sform(np.eye(4), code=1)
    nibabel.save(image, path)
    return path


def _ball(value: int = 1) -> np.ndarray:
    index = np.indices((60, 60, 60)) - 30
    return (value * ((index**2).sum(0) < 625)).astype(np.int16)


def test_a_map_without_the_organ_leaves_nothing(tmp_path):
    """Damaged files: the attacks."""
    source = _nifti(tmp_path / "tumor.nii", _ball(2).astype(np.uint8))
    refusal(tumortrack("prepare", source, "--out", tmp_path / "case"))
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--up", "sideways"], "anterior"),
        (["--up", "0,0,0"], "0,0,0"),
        (["--organ", "300"], "1..255"),
        (["--organ-hu", "300", "-300"], "-300"),
        (["--patient", " "], "identifier"),
        (["--organ", "2", "--tumor", "0"], "--organ, --tumor"),
        (["--unit", "m"], "--unit"),
        (["--series", "1"], "--series"),
        (["--tilt", "61"], "0 to 60"),
        (["--tilt", "nan"], "0 to 60"),
    ],
)
def test_options_out_of_range_say_what_is_allowed(arguments, words, tmp_path, capsys):
    source = _nifti(tmp_path / "ball.nii", 1000 * _ball() - 900)
    assert run(["prepare", str(source), "--out", str(tmp_path / "case"), *arguments]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "case").exists()


@pytest.mark.parametrize(("name", "value"), [("rotations", "any"), ("sensor", "kinect")])
@pytest.mark.usefixtures("unchecked")
def test_a_choice_that_is_none_is_refused(name, value, tmp_path):
    done = tumortrack("prepare", "ball.nii", "--out", tmp_path / "case", f"--{name}", value)
    assert done.returncode == 2
    assert value in done.stderr
    with refused(InputError, f"{name} '{value}'"):
        PrepareOptions(**{name: value})


def test_options_of_other_inputs_are_refused(tmp_path):
    """What a label map or meshes never ask for would be ignored without a word."""
    labels = _nifti(tmp_path / "labels.nii", _ball().astype(np.uint8))
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
        with refused(InputError, "--" + next(iter(wrong)).replace("_", "-")):
            prepare(source, PrepareOptions(**wrong))


def test_an_unreadable_input_is_named_and_no_folder_stays(tmp_path):
    source = tmp_path / "ball.nii"
    source.symlink_to(source)
    with refused(InputError, "ball.nii"):
        Prepare(input=source, out=tmp_path / "new" / "dir" / "case").run()
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    "wrong", [{"minutes": 1.0, "steps": 10}, {"steps": -1}, {"minutes": np.nan}, {"workers": -2}]
)
def test_train_wants_one_end(wrong, phantom_case, tmp_path):
    with refused(InputError, f"--{next(iter(wrong))}"):
        Train(case=phantom_case, model=tmp_path / "model", **wrong).run()


@pytest.mark.parametrize(
    ("minutes", "scenes", "option"),
    [(-1.0, 2, "--minutes"), (np.nan, 2, "--minutes"), (1.0, 0, "--scenes"), (1.0, 11, "--scenes")],
)
def test_a_demo_of_nothing_is_refused_at_once(minutes, scenes, option, tmp_path):
    with refused(InputError, option):
        Demo(out=tmp_path / "demo", minutes=minutes, scenes=scenes).run()
    assert list(tmp_path.iterdir()) == []


def test_the_demo_replaces_nothing_but_a_demo(tmp_path):
    mine, file, demo = (tmp_path / name for name in ("mine", "file", "demo"))
    (mine / "case").mkdir(parents=True)
    (mine / "case" / "dear.txt").write_text("dear")
    file.write_text("dear")
    (demo / "case").mkdir(parents=True)
    (demo / "demo.json").write_text("{}")
    (demo / "notes.txt").write_text("dear")
    before = sorted(tmp_path.rglob("*"))
    for out, named in ((mine, "case"), (file, file), (demo, "notes.txt")):
        with refused(InputError, out, named):
            Demo(out=out, scenes=1).run()
    assert sorted(tmp_path.rglob("*")) == before


def test_the_window_of_hu_keeps_its_old_name():
    told = tyro.cli(Prepare, args=["ct.nii.gz", "case", "--kidney-hu", "-200", "250"])
    assert told.organ_hu == (-200.0, 250.0)
