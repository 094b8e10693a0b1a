"""The whole chain on real patients: label map and virtual CT -> case -> tumors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stories import answered, refusal, succeeded, tumortrack
from tumortrack.case.prepare import prepare
from tumortrack.cli.main import run
from tumortrack.io.case import load_case
from tumortrack.io.mesh_files import read_mesh
from tumortrack.io.volume import read_labels
from tumortrack.simulation.phantom.dicom import write_dicom_series
from tumortrack.simulation.phantom.scanner import ScannerParameters, scan


def locates_its_organ(case: Path, folder: Path) -> None:
    """Simulate a scene, locate in it: the organ is where it is."""
    succeeded(tumortrack("simulate", case, folder / "scenes", "--scenes", 1))
    cloud = folder / "scenes" / "0000" / "cloud.ply"
    answered(tumortrack("locate", case, cloud, "--out", folder / "out", "--grid", 48))
    kidney = json.loads((folder / "out" / "report.json").read_text())["parts"]["kidney"]
    truth = read_mesh(cloud.with_name("kidney.ply")).box_mm.mean(0)
    assert np.linalg.norm(np.array(kidney["center_mm"]) - truth) < 5


@pytest.mark.slow
def test_label_map_to_located_organ(shared_data, tmp_path):
    """All the way; from a CT the demo goes there. More patients: ``test_imaging_prepare``."""
    case = tmp_path / "case"
    source = shared_data / "kits19" / "case_00000" / "segmentation.nii.gz"
    succeeded(tumortrack("prepare", source, "--out", case))
    anatomy = load_case(case).anatomy
    assert anatomy.organ.volume_mm3 / 1000 == pytest.approx(215, rel=0.02)
    assert [t.volume_mm3 / 1000 for t in anatomy.tumors] == pytest.approx([7.8], rel=0.02)
    locates_its_organ(case, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("patient", ["case_00000", "case_00003"])
def test_virtual_ct_gives_back_the_anatomy(patient, shared_data, models_at_once, tmp_path):
    true = prepare(shared_data / "kits19" / patient / "segmentation.nii.gz")
    write_dicom_series(scan(true.labels, ScannerParameters(), 4), tmp_path / "dicom")
    assert run(["prepare", str(tmp_path / "dicom"), "--out", str(tmp_path / "ct_case")]) == 0
    prepared = load_case(tmp_path / "ct_case").anatomy
    assert len(prepared.parts) == len(true.anatomy.parts)
    for mine, theirs in zip(prepared.parts, true.anatomy.parts, strict=True):
        assert mine.volume_mm3 == pytest.approx(theirs.volume_mm3, rel=0.05)
        assert np.abs(mine.box_mm - theirs.box_mm).max() < 2.0  # in place, not mirrored
    assert (tmp_path / "ct_case" / "qc.png").stat().st_size > 20_000


@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_kidney_without_tumor_from_a_mask(side, shared_data, models_at_once, tmp_path, capsys):
    source = shared_data / "totalsegmentator" / f"kidney_{side}.nii.gz"
    assert run(["prepare", str(source), "--out", str(tmp_path / "case")]) == 0
    assert "tumor" in capsys.readouterr().out  # told that there is none
    anatomy = load_case(tmp_path / "case").anatomy
    assert anatomy.names == ("kidney",)
    labels = read_labels(source)
    voxels = np.argwhere(labels.labels > 0) @ labels.lps_from_index[:3, :3].T
    centre = voxels.mean(0) + labels.lps_from_index[:3, 3]
    assert (centre[0] > 0) == (side == "left")  # +x is the patient's left
    assert np.abs(anatomy.organ.vertices_mm.mean(0) - centre).max() < 6


@pytest.mark.slow
def test_a_body_ct_by_thresholds_is_refused_with_advice(shared_data, tmp_path):
    ct = shared_data / "totalsegmentator" / "example_ct.nii.gz"
    assert "--labels" in refusal(tumortrack("prepare", ct, "--out", tmp_path / "case"))
    assert not (tmp_path / "case").exists()


@pytest.mark.slow
def test_real_compressed_dicom_is_read_and_refused_for_what_it_is(shared_data, tmp_path):
    """20 slices of an abdomen hold no whole kidney: read, then told so; nothing is written."""
    folder: Path = shared_data / "totalsegmentator" / "example_ct_dicom"
    message = refusal(tumortrack("prepare", folder, "--out", tmp_path / "case"))
    assert "kidney" in message
    assert list(tmp_path.iterdir()) == []
