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
from refused import refused
from tumortrack import api
from tumortrack.case.options import PrepareOptions
from tumortrack.case.segmentation_tool import segmented_case
from tumortrack.core.errors import InputError
from tumortrack.core.grid import voxel_ml
from tumortrack.core.types import LabelVolume
from tumortrack.io.case import Case
from tumortrack.io.nifti import write_volume_nifti
from tumortrack.io.volume import read_labels

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


@pytest.fixture
def nnunet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program of that name on the PATH, which tells HU apart, and the folder of a model whose
    labels are named as published ones are."""
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
    return model


def same_counts(case: Case, truth: LabelVolume) -> bool:
    counts = (np.bincount(v.labels.ravel())[1:] for v in (case.labels, truth))
    return len({tuple(sorted(each.tolist())) for each in counts}) == 1


def test_a_tool_segments_and_is_named(scanned, totalsegmentator, tmp_path, capfd):
    ct, truth = scanned
    keep, asked = tmp_path / "case.labels.nii.gz", PrepareOptions(name="liver", patient="P1")
    case = segmented_case(ct, "totalsegmentator:liver_lesions", asked, keep)
    assert capfd.readouterr().out.split("\n")[:2] == [
        "Predicting... total", "Predicting... liver_lesions",
    ]  # fmt: skip
    assert case.anatomy.names == ("liver", "tumor_1", "tumor_2")
    assert case.patient.id == "P1"
    assert same_counts(case, truth)
    assert set(np.unique(case.ct.hu[case.labels.labels > 1])) == {400.0}
    kept = read_labels(keep)  # on the CT's voxels, in our numbers
    np.testing.assert_array_equal(kept.labels, np.minimum(truth.labels, 2))
    np.testing.assert_allclose(kept.lps_from_index, truth.lps_from_index, atol=1e-4)
    about = case.report["segmentation"]
    assert (about["label_map"], len(about["weights_sha256"])) == (keep.name, 7)
    assert about["commands"][1].endswith("-o out/lesions --task liver_lesions")
    assert any("qc.png" in note for note in case.report["notes"])
    with refused(InputError, "case.labels.nii.gz"):
        api.prepare(ct, tmp_path / "case", segment="totalsegmentator", name="liver")
    with pytest.raises(InputError):  # where would the map go?
        api.prepare(ct, segment="totalsegmentator")


def refused_of(ct: Path, spec: str, *data: object, **options) -> None:
    keep = ct.parent / "new.nii.gz"
    with refused(InputError, *data):
        segmented_case(ct, spec, PrepareOptions(**options), keep)
    assert not keep.exists()


@pytest.mark.parametrize(
    ("spec", "word"),
    [
        ("totalsegmentator:liver_vessels", "totalseg_download_weights -t liver_vessels"),
        ("totalsegmentator:face", "face"),
        ("otsu", "otsu"),
        ("monai:", "monai"),
    ],
)
def test_an_unknown_tool_and_weights_that_lack_are_named(scanned, totalsegmentator, spec, word):
    refused_of(scanned[0], spec, word, name="liver")


def test_a_tool_that_fails_is_named_with_what_to_do(scanned, totalsegmentator, tmp_path):
    (ct, _), program = scanned, tmp_path / "bin" / "TotalSegmentator"
    refused_of(ct, "totalsegmentator", "--organ", organ=5)
    program.write_text(f"#!{sys.executable}\nimport sys\nprint('no GPU')\nsys.exit(3)\n")
    refused_of(ct, "totalsegmentator", program, 3, name="liver")
    program.write_text(f"#!{sys.executable}\n")  # another version, say
    refused_of(ct, "totalsegmentator", "liver.nii.gz", name="liver")
    program.unlink()
    refused_of(ct, "totalsegmentator", "pip install TotalSegmentator", name="liver")


def test_an_nnunet_folder_is_checked_before_it_runs(scanned, nnunet, tmp_path, monkeypatch):
    (ct, _), spec, dataset = scanned, f"nnunet:{nnunet}", nnunet / "dataset.json"
    about = json.loads(dataset.read_text())
    for change, word in (
        ({"labels": {"liver": 1}}, "kidney"), ({"channel_names": {"0": "a", "1": "b"}}, ".nii.gz"),
    ):  # fmt: skip
        dataset.write_text(json.dumps(about | change))
        refused_of(ct, spec, word)
    (nnunet / "plans.json").unlink()
    refused_of(ct, spec, "plans.json")
    dataset.unlink()
    refused_of(ct, spec, "dataset.json")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))  # nothing beside it
    refused_of(ct, spec, "pip install nnunetv2")


def test_names_are_understood_as_published_models_write_them(scanned, nnunet, tmp_path):
    ct, truth = scanned
    options = PrepareOptions(side="right")
    case = segmented_case(ct, f"nnunet:{nnunet}", options, tmp_path / "new.nii.gz")
    assert case.anatomy.names == ("kidney", "tumor_1", "tumor_2")
    assert same_counts(case, truth)


def test_nnunet_runs_end_to_end(scanned: tuple[Path, LabelVolume], tmp_path: Path) -> None:
    """The smallest model, saved by nnU-Net's own trainer, run by its own command."""
    pytest.importorskip("nnunetv2")
    from nnunet_objects import tiny_model

    ct, truth = scanned
    model = tiny_model(tmp_path, {"background": 0, "kidney": [1, 2], "tumor": 2})
    case = api.prepare(ct, tmp_path / "case", segment=f"nnunet:{model}")
    assert case.anatomy.names == ("kidney", "tumor_1", "tumor_2")
    volumes = case.report["volumes_ml"]
    counts = np.bincount(truth.labels.ravel()) * voxel_ml(truth.lps_from_index)
    assert volumes["kidney"] == pytest.approx(counts[1:].sum(), rel=0.02)
    assert volumes["tumor_1"] == pytest.approx(counts[2:].max(), rel=0.1)
    assert case.report["segmentation"]["tool"] == "nnU-Net"
