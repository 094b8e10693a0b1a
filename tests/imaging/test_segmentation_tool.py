"""prepare --segment: a tool of the user's makes the labels. Real processes; nnU-Net where it is
installed."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from imaging_objects import kidney_labels
from tumortrack import api
from tumortrack.core.errors import InputError
from tumortrack.core.types import LabelVolume
from tumortrack.imaging.nifti import write_volume_nifti
from tumortrack.imaging.options import PrepareOptions
from tumortrack.imaging.segmentation_tool import segmented_case
from tumortrack.imaging.volume import read_labels

# Takes TotalSegmentator's own options, and writes a mask by HU for each class, as it does.
THRESHOLDS = f"""#!{sys.executable}
import argparse, pathlib, sys
import nibabel, numpy
parser = argparse.ArgumentParser()
parser.add_argument("-i"); parser.add_argument("-o"); parser.add_argument("--task")
parser.add_argument("--roi_subset", nargs="+", default=["liver_lesions"])
given = parser.parse_args()
print("Predicting...", given.task, flush=True)
image = nibabel.load(given.i)
hu = numpy.asarray(image.dataobj)
out = pathlib.Path(given.o)
out.mkdir(parents=True)
for name in given.roi_subset:
    low = 300 if "lesion" in name else 50
    mask = (hu > low).astype(numpy.uint8)
    nibabel.save(nibabel.Nifti1Image(mask, image.affine), out / (name + ".nii.gz"))
"""


@pytest.fixture
def scanned(tmp_path: Path) -> tuple[Path, LabelVolume]:
    """A CT whose organ has 100 HU and whose tumors 400, and its labels."""
    labels = kidney_labels((2.0, 2.0, 2.0))
    hu = np.array([-100, 100, 400, 400], np.float32)[labels.labels]
    write_volume_nifti(tmp_path / "ct.nii.gz", hu, labels.lps_from_index)
    return tmp_path / "ct.nii.gz", labels


@pytest.fixture
def totalsegmentator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program of that name on the PATH, with all weights; the folder of these."""
    program = tmp_path / "bin" / "TotalSegmentator"
    program.parent.mkdir()
    program.write_text(THRESHOLDS)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent))
    weights = tmp_path / "weights"
    for number in (291, 292, 293, 294, 295, 298, 591):
        (weights / f"Dataset{number}_of_it").mkdir(parents=True)
        (weights / f"Dataset{number}_of_it" / "checkpoint_final.pth").write_text(str(number))
    monkeypatch.setenv("TOTALSEG_WEIGHTS_PATH", str(weights))
    return weights


def test_a_tool_segments_and_is_named(
    scanned: tuple[Path, LabelVolume], totalsegmentator: Path, tmp_path: Path, capfd
) -> None:
    ct, truth = scanned
    keep, asked = tmp_path / "case.labels.nii.gz", PrepareOptions(name="liver", patient="P1")
    case = segmented_case(ct, "totalsegmentator:liver_lesions", asked, keep)
    assert capfd.readouterr().out.split("\n")[:2] == [
        "Predicting... total", "Predicting... liver_lesions",
    ]  # fmt: skip
    assert case.anatomy.names == ("liver", "tumor_1", "tumor_2")
    assert case.patient.id == "P1"
    counts, wanted = (np.bincount(v.ravel())[1:] for v in (case.labels.labels, truth.labels))
    assert sorted(counts.tolist()) == sorted(wanted.tolist())
    assert case.ct is not None  # as where HU windows segment it
    assert set(np.unique(case.ct.hu[case.labels.labels > 1])) == {400.0}
    kept = read_labels(keep)  # on the CT's voxels, in our numbers
    np.testing.assert_array_equal(kept.labels, np.minimum(truth.labels, 2))
    np.testing.assert_allclose(kept.lps_from_index, truth.lps_from_index, atol=1e-4)
    about = case.report["segmentation"]
    assert about["label_map"] == keep.name
    assert len(about["weights_sha256"]) == 7
    assert about["commands"][1].endswith("-o out/lesions --task liver_lesions")
    assert any("check it in qc.png" in note for note in case.report["notes"])
    with pytest.raises(InputError, match=r"case\.labels\.nii\.gz exists already"):
        api.prepare(ct, tmp_path / "case", segment="totalsegmentator", name="liver")


def test_what_lacks_is_named_with_what_to_do(
    scanned: tuple[Path, LabelVolume], totalsegmentator: Path, tmp_path: Path, monkeypatch
) -> None:
    ct, _ = scanned

    def refused(spec: str, word: str, name: str = "liver") -> None:
        with pytest.raises(InputError, match=word):
            segmented_case(ct, spec, PrepareOptions(name=name), tmp_path / "new.nii.gz")
        assert not (tmp_path / "new.nii.gz").exists()

    refused("totalsegmentator:liver_vessels", "totalseg_download_weights -t liver_vessels")
    refused("totalsegmentator:face", "tasks are liver_lesions")
    refused("otsu", "is not known: totalsegmentator")
    refused("monai:", "is not known")
    program = tmp_path / "bin" / "TotalSegmentator"
    program.write_text(f"#!{sys.executable}\nimport sys\nprint('no GPU')\nsys.exit(3)\n")
    refused("totalsegmentator", "ended with code 3")
    program.write_text(f"#!{sys.executable}\n")  # another version, say
    refused("totalsegmentator", "wrote no liver.nii.gz")
    program.unlink()
    refused("totalsegmentator", "pip install TotalSegmentator")
    with pytest.raises(InputError, match="--organ means nothing"):
        segmented_case(ct, "totalsegmentator", PrepareOptions(organ=5), tmp_path / "new.nii.gz")
    with pytest.raises(InputError, match="needs a folder"):
        api.prepare(ct, segment="totalsegmentator")


def test_an_nnunet_folder_is_checked_before_it_runs(
    scanned: tuple[Path, LabelVolume], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ct, _ = scanned
    program = tmp_path / "bin" / "nnUNetv2_predict_from_modelfolder"
    program.parent.mkdir()
    model = tmp_path / "model"
    model.mkdir()

    def refused(word: str) -> None:
        with pytest.raises(InputError, match=word):
            segmented_case(ct, f"nnunet:{model}", PrepareOptions(), tmp_path / "new.nii.gz")

    monkeypatch.setenv("PATH", str(program.parent))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))  # nothing beside it
    refused("pip install nnunetv2")
    program.write_text("#!/bin/false\n")
    program.chmod(0o755)
    refused("there is no .*dataset.json")
    about = {"channel_names": {"0": "CT"}, "file_ending": ".nii.gz", "labels": {"liver": 1}}
    (model / "dataset.json").write_text(json.dumps(about))
    refused("lacks plans.json or fold_N")
    (model / "plans.json").write_text("{}")
    (model / "fold_0").mkdir()
    (model / "fold_0" / "checkpoint_final.pth").write_text("")
    refused("knows liver, and no kidney")
    (model / "dataset.json").write_text(json.dumps(about | {"channel_names": {"0": "a", "1": "b"}}))
    refused("one CT")


def test_names_are_understood_as_published_models_write_them(
    scanned: tuple[Path, LabelVolume], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ct, truth = scanned
    program, model = tmp_path / "bin" / "nnUNetv2_predict_from_modelfolder", tmp_path / "model"
    program.parent.mkdir()
    program.write_text(f"""#!{sys.executable}
import nibabel, numpy as np
ct = nibabel.load("in/ct_0000.nii.gz")
labels = np.select([ct.get_fdata() > 250, ct.get_fdata() > 0], [7, 3]).astype(np.uint8)
nibabel.save(nibabel.Nifti1Image(labels, ct.affine), "out/ct.nii.gz")
""")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    (model / "fold_0").mkdir(parents=True)
    (model / "fold_0" / "checkpoint_final.pth").write_text("")
    (model / "plans.json").write_text("{}")
    labels = {"background": 0, "Spleen": 1, "Right Kidney": 3, "renal-Neoplasm": 7}
    about = {"channel_names": {"0": "CT"}, "file_ending": ".nii.gz", "labels": labels}
    (model / "dataset.json").write_text(json.dumps(about))
    options = PrepareOptions(side="right")
    case = segmented_case(ct, f"nnunet:{model}", options, tmp_path / "new.nii.gz")
    assert case.anatomy.names == ("kidney", "tumor_1", "tumor_2")
    counts, wanted = (np.bincount(v.ravel())[1:] for v in (case.labels.labels, truth.labels))
    assert sorted(counts.tolist()) == sorted(wanted.tolist())


def test_nnunet_runs_end_to_end(scanned: tuple[Path, LabelVolume], tmp_path: Path) -> None:
    """The smallest model, saved by nnU-Net's own trainer, run by its own command."""
    pytest.importorskip("nnunetv2")
    from nnunet_objects import tiny_model

    ct, truth = scanned
    model = tiny_model(tmp_path, {"background": 0, "kidney": [1, 2], "tumor": 2})
    case = api.prepare(ct, tmp_path / "case", segment=f"nnunet:{model}")
    assert case.anatomy.names == ("kidney", "tumor_1", "tumor_2")
    volumes = case.report["volumes_ml"]
    voxel_ml = np.linalg.det(truth.lps_from_index[:3, :3]).__abs__() / 1000
    counts = np.bincount(truth.labels.ravel()) * voxel_ml
    assert volumes["kidney"] == pytest.approx(counts[1:].sum(), rel=0.02)
    assert volumes["tumor_1"] == pytest.approx(counts[2:].max(), rel=0.1)
    assert case.report["segmentation"]["tool"] == "nnU-Net"
