"""A case in a model's place: its model is made once, kept in it, and costs nobody a file."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from refused import refused
from stories import answered, cloud_by_rays, looking_down, refusal, succeeded, tumortrack
from tumortrack import api
from tumortrack.cli.main import run
from tumortrack.core import store
from tumortrack.core.errors import StorageError
from tumortrack.io.case import load_case
from tumortrack.io.model_folder import read_model_manifest, reliability_warning
from tumortrack.io.nifti import write_nifti
from tumortrack.io.ply import write_cloud_ply
from tumortrack.report.inspection import describe
from tumortrack.tracking import model_files


@pytest.fixture(scope="module")
def cloud(tmp_path_factory, phantom_case):
    case, file = load_case(phantom_case), tmp_path_factory.mktemp("seen") / "cloud.ply"
    write_cloud_ply(file, cloud_by_rays(case, looking_down(case)).astype(np.float32))
    return file


@pytest.fixture
def case(tmp_path, phantom_case):
    """Without a model."""
    return Path(shutil.copytree(phantom_case, tmp_path / "case"))


def ended(folder: Path) -> list[str]:
    """What is there, and nothing half written."""
    names = sorted(path.name for path in folder.iterdir())
    assert not [name for name in names if name.endswith((".part", ".old"))]
    return names


@pytest.mark.slow
def test_the_first_command_makes_it_and_all_others_take_it(case, cloud, tmp_path):
    run_folder, model = tmp_path / "run", case / "model"
    assert not model.exists()
    answered(tumortrack("locate", case, cloud, "--out", run_folder, "--grid", 32))
    made = store.sha256_of(model)
    report = store.read_json(run_folder / "report.json")
    assert report["model_sha256"] == store.sha256_of(model / store.MANIFEST)
    assert report["model"]["case_sha256"] == store.sha256_of(case / store.MANIFEST)
    scenes, source = tmp_path / "scenes", f"virtual:{case}?fps=5"
    succeeded(tumortrack("simulate", case, scenes, "--scenes", 1))
    tracked = tmp_path / "track.json"
    for command in (
        ("evaluate", case, scenes, tmp_path / "report", "--grid", 32),
        ("track", case, source, "--seconds", 5, "--stale", 30, "--report", tracked),
        ("compile", case),
    ):
        succeeded(tumortrack(*command))
    found = store.read_json(tracked)
    assert found["estimates"]["good"] > 0
    assert found["model"]["case_sha256"] == report["model"]["case_sha256"]
    assert store.sha256_of(model) == made
    for folder in (case, model):
        assert "30 degrees" in "\n".join(describe(folder))


def test_a_case_has_no_network_to_write(case, tmp_path):
    assert str(case) in refusal(tumortrack("onnx", case, tmp_path / "out.onnx"))
    assert ended(tmp_path) == ["case"]


@pytest.mark.slow
def test_an_interrupted_making_leaves_nothing(case, tmp_path):
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before, new = store.sha256_of(case), tmp_path / "new"
    for make in (
        lambda: model_files.case_model(load_case(case), stop),
        lambda: api.prepare(case / "labels.nii.gz", new, progress=stop),
    ):
        with pytest.raises(KeyboardInterrupt):
            make()
    assert store.sha256_of(case) == before
    assert "model" not in ended(new)  # but for which it is whole
    assert load_case(new).anatomy.names == load_case(case).anatomy.names
    assert ended(tmp_path) == ["case", "new"]


def test_a_case_that_cannot_be_written_to_says_so_at_once(case, monkeypatch, capsys):
    monkeypatch.setattr(model_files.os, "access", lambda *_: False)
    with refused(StorageError, case):
        model_files.case_model(load_case(case))
    assert run(["compile", str(case)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert "model" not in ended(case)


@pytest.mark.slow
def test_another_cases_model_is_replaced_and_a_strangers_file_is_not(
    models_at_once, case, elastic_model
):
    """As after a copy of one case's folder over another's."""
    kept = case / "model"
    shutil.copytree(elastic_model, kept)
    manifest = store.read_json(kept / store.MANIFEST)
    manifest["provenance"]["case_sha256"] = "another"
    store.write_json(kept / store.MANIFEST, manifest)
    (kept / "notes.txt").write_text("dear")
    with refused(api.InputError, "notes.txt"):
        api.load_model(case)
    assert models_at_once == []
    (kept / "notes.txt").unlink()
    assert api.load_model(case).provenance["case_sha256"] == load_case(case).sha256
    assert api.load_model(case).provenance["case_sha256"] == load_case(case).sha256
    assert len(models_at_once) == 1


@pytest.mark.slow
def test_a_case_is_replaced_with_its_model_and_with_nothing_else(
    models_at_once, case, tmp_path, capsys
):
    new = tmp_path / "new"
    command = ["prepare", str(case / "labels.nii.gz"), "--out", str(new)]
    assert run(command) == 0
    before = (new / "manifest.json").read_bytes()
    assert run(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    for stranger in (new / "notes.txt", new / "model" / "bound_factor.json"):
        stranger.write_text("dear")
        assert run([*command, "--overwrite"]) == 2
        assert str(stranger.relative_to(new)) in capsys.readouterr().err
        stranger.unlink()
    assert (new / "manifest.json").read_bytes() == before
    wider = ["--tilt", "40", "--rotations", "limited", "--sensor", "stereo", "--overwrite"]
    assert run([*command, *wider]) == 0
    assert (new / "manifest.json").read_bytes() != before
    assert "model" in ended(new)
    said = "\n".join(describe(new))
    assert "(stereo)" in said
    assert "40 degrees" in said
    assert run([*command, "--rotations", "full", "--overwrite"]) == 0
    assert "(d405)" in "\n".join(describe(new))
    assert ended(tmp_path) == ["case", "new"]
    assert len(models_at_once) == 3


@pytest.mark.slow
def test_train_says_that_nothing_needs_to_be_learnt(models_at_once, case, tmp_path, capsys):
    model, command = tmp_path / "model", ["train", str(case), str(tmp_path / "model")]
    for _ in range(2):  # the second time it is there
        assert run(command) == 0
        assert ended(model) == ["manifest.json", "shape.safetensors"]
    assert ended(case) == sorted(path.name for path in case.iterdir() if path.name != "model")
    for option in (("--rotations", "full"), ("--seed", "1")):
        assert run([*command, *option]) == 2
    (tmp_path / "mine" / "notes").mkdir(parents=True)
    (tmp_path / "begun" / "training").mkdir(parents=True)
    (model / "bound_factor.json").write_text("{}")
    made = len(models_at_once)
    for folder in (model, tmp_path / "mine", tmp_path / "begun"):
        before = store.sha256_of(folder)
        assert run(["train", str(case), str(folder)]) == 2
        assert str(folder) in capsys.readouterr().err
        assert store.sha256_of(folder) == before
    assert len(models_at_once) == made  # refused at once


@pytest.mark.slow
def test_prepare_says_that_a_ball_does_not_show_how_it_lies(tmp_path):
    """As `inspect` and every answer say it: the model was tried on scenes with a known truth."""
    index = np.stack(np.meshgrid(*[np.arange(56.0)] * 3, indexing="ij"), -1)
    labels = (np.linalg.norm(index - 28, axis=-1) < 24).astype(np.uint8)
    labels[np.linalg.norm(index - [40, 28, 28], axis=-1) < 7] = 2
    write_nifti(tmp_path / "ball.nii.gz", labels, np.diag([1.5, 1.5, 1.5, 1.0]), lps=True)
    said = tumortrack(
        "prepare", tmp_path / "ball.nii.gz", "--out", tmp_path / "case", "--rotations", "full"
    )
    weakness = reliability_warning(read_model_manifest(tmp_path / "case" / "model")["provenance"])
    assert weakness
    assert weakness in succeeded(said)
    assert weakness in "\n".join(describe(tmp_path / "case"))
