"""What weakens a case is said by every command that uses it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stories import answered, cloud_by_rays, looking_down, succeeded, tumortrack
from tumortrack.core.types import LabelVolume
from tumortrack.imaging.case import load_case
from tumortrack.imaging.nifti import write_nifti
from tumortrack.sense.ply import write_cloud_ply
from tumortrack_resection.files import read_plan

pytestmark = pytest.mark.slow


def test_an_organ_cut_by_its_image_is_said_by_prepare_locate_track_and_plan(phantom_case, tmp_path):
    whole = load_case(phantom_case).labels
    behind = whole.labels == 3  # of the second tumor, which stays
    first, last = np.flatnonzero(behind.any((0, 1)))[[0, -1]]
    cut = LabelVolume(whole.labels[..., max(0, first - 12) : last + 12], whole.lps_from_index)
    assert cut.labels[..., -1].any()
    write_nifti(tmp_path / "cut.nii.gz", cut.labels, cut.lps_from_index, lps=True)
    folder = tmp_path / "case"
    said = tumortrack("prepare", tmp_path / "cut.nii.gz", folder)
    succeeded(said)
    case = load_case(folder)
    assert "cut" in [warning.kind for warning in case.warnings]
    (warning,) = (warning.words for warning in case.warnings if warning.kind == "cut")
    assert warning in said.stdout + said.stderr

    write_cloud_ply(tmp_path / "cloud.ply", cloud_by_rays(case, looking_down(case)))
    run = tmp_path / "run"
    said = tumortrack("locate", folder, tmp_path / "cloud.ply", run, "--grid", 32)
    answered(said)
    assert warning in said.stdout + said.stderr
    assert warning in json.loads((run / "report.json").read_text())["notes"]

    command = "plan", run, tmp_path / "plan", "--margin", 2
    said = tumortrack(*command, "--accept-poor", "--accept-budget")
    succeeded(said)
    assert warning in said.stdout + said.stderr
    assert any(warning in note for note in read_plan(tmp_path / "plan").plan.warnings)

    report = tmp_path / "track.json"
    said = tumortrack("track", folder, f"virtual:{folder}", "--seconds", 2, "--report", report)
    succeeded(said)
    assert warning in said.stdout + said.stderr
    assert warning in json.loads(report.read_text())["notes"]
