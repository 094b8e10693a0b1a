"""Folders of an older schema are refused with the command that makes them again, and left alone.

tests/support/old_folders: manifests as commit fd9d9be8 wrote them (schema 5), without their files:
what a folder lacks must not matter before its schema does."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import pytest

import tumortrack as tt
from stories import succeeded, tumortrack
from tumortrack.cli.main import _parse, run
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError
from tumortrack_resection.files import read_plan

FOLDERS = Path(__file__).parents[1] / "support" / "old_folders"
READERS = {
    "case": (
        "locate case cloud.ply --out out", "track case virtual:case", "simulate case out",
        "evaluate case scenes out", "export case out", "train case out", "twin case out",
        "phantom-kit case out", "margins case scenes", "inspect case",
    ),
    "model": (
        "locate model cloud.ply --out out", "track model virtual:case", "evaluate model scenes out",
        "margins model scenes", "onnx model out.onnx", "inspect model",
    ),
    "run": ("plan run out", "export run out", "inspect run"),
    "plan": ("resect plan", "inspect plan"),
    "kit": ("inspect kit",),
}  # fmt: skip
REMADE = {  # by kind: the command, and the input that is not there yet
    "case": ("prepare", "ct"),
    "model": ("train", "CASE"),
    "run": ("locate", "CASE"),
    "plan": ("plan", "RUN"),
    "kit": ("phantom-kit", "CASE"),
}


@pytest.fixture
def old(tmp_path, monkeypatch):
    monkeypatch.chdir(shutil.copytree(FOLDERS, tmp_path / "old"))
    return tmp_path / "old"


def refused(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on which a command must have ended."""
    assert run(shlex.split(command)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def remade(line: str) -> str:
    """The command that a line ends with, without `tumortrack`."""
    return line.rpartition(": tumortrack ")[2]


@pytest.mark.parametrize(
    ("kind", "command"), [(kind, each) for kind, some in READERS.items() for each in some]
)
def test_a_reader_refuses_an_old_folder_and_names_what_remakes_it(kind, command, old, capsys):
    before = store.sha256_of(old)
    line = refused(command, capsys)
    assert store.sha256_of(old) == before
    assert line.startswith(f"tumortrack: {kind} ")
    words = shlex.split(remade(line))
    assert words[0] == REMADE[kind][0]
    assert any(word.startswith(kind) for word in words[1:])


@pytest.mark.parametrize("kind", REMADE)
def test_the_command_that_remakes_it_is_one(kind, old, capsys):
    """Its options are right, and it asks for the input."""
    command = remade(refused(f"inspect {kind}", capsys))
    assert f"{REMADE[kind][1]} " in refused(command, capsys)


@pytest.mark.slow
def test_a_case_is_remade_as_it_was(old, capsys):
    tt.scan_phantom(Path("ct"), spacing_mm=(3.0, 3.0, 3.0))
    succeeded(tumortrack(*shlex.split(remade(refused("inspect case", capsys)))))
    was = json.loads((FOLDERS / "case" / store.MANIFEST).read_text())
    case = tt.load_case("case")
    assert json.loads(json.dumps(case.report["options"])) == was["report"]["options"]
    assert (case.patient.id, case.patient.side) == ("P1", "right")


@pytest.mark.parametrize(
    "options",
    [
        {"tilt": 0.0, "min_tumor_ml": 0.0, "labels": True, "tumor": [0], "up": "0,-0.5,1"},
        {"organ": [1, 3], "structure": ["artery=4", "ureter=a b.stl"], "name": "liver"},
        {"term": ["10200004", "Liver structure"], "organ_hu": [-50.5, 300.0], "unit": "m"},
        {"rotations": "full", "sensor": "stereo", "side": None, "series": "2", "ct": "ct.nii"},
    ],
)
def test_all_options_of_a_case_are_in_its_command(options, old, capsys):
    manifest = store.read_json(Path("case/manifest.json"))
    asked = {**manifest["report"]["options"], "side": None, **options}
    store.write_json(Path("case/manifest.json"), {**manifest, "report": {"options": asked}})
    parsed = _parse(shlex.split(remade(refused("inspect case", capsys))))
    read = {name: getattr(parsed, name) for name in asked}
    assert json.loads(json.dumps(read, default=str)) == asked


def test_the_model_in_a_case_is_remade_with_it(old, capsys):
    shutil.copytree("model", "case/model")
    line = refused("locate case/model cloud.ply --out out", capsys)
    assert line.startswith("tumortrack: case/model ")
    assert remade(line) == remade(refused("inspect case", capsys))


def test_training_spares_an_old_model(old, phantom_case, capsys):
    before = store.sha256_of(old)
    assert "model_new" in refused(f"train {phantom_case} model", capsys)
    assert store.sha256_of(old) == before


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (tt.load_case, "case"),
        (tt.load_model, "case"),
        (tt.load_model, "model"),
        (tt.load_estimate, "run"),
        (read_plan, "plan"),
    ],
)
def test_python_raises(read, kind, old):
    with pytest.raises(ArtifactError, match=f"^{kind} has schema 5;"):
        read(Path(kind))


@pytest.mark.parametrize(
    "spoilt",
    [
        {},
        {"report": 5},
        {"report": {"options": {"organ": {}}}},
        {"report": {"source": "INPUT\n", "options": {"side": "left\nright", "a\nb": 1}}},
    ],
)
def test_a_manifest_that_says_little_is_refused_likewise(spoilt, old, capsys):
    store.write_json(Path("case/manifest.json"), {"kind": "case", "schema": 5, **spoilt})
    assert shlex.split(remade(refused("inspect case", capsys)))[:2] == ["prepare", "INPUT"]
