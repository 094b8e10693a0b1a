"""Patient and side, from the images to the plan: they arrive everywhere, and a mismatch stops."""

from __future__ import annotations

import json
import shutil

import pytest

from stories import answered, cloud_by_rays, looking_down, refusal, succeeded, tumortrack
from tumortrack.core import store
from tumortrack.core.patient import Patient
from tumortrack.io.case import load_case
from tumortrack.io.ply import write_cloud_ply
from tumortrack_resection.files import read_plan

P1 = {"id": "P1", "side": "right"}  # of ``phantom_case``
OTHERS = (("--patient", "P2"), ("--side", "left"), ("--patient", "P1", "--side", "left"))


@pytest.fixture(scope="module")
def run(phantom_case, elastic_model, tmp_path_factory):
    """What `locate` writes, told whom it is about."""
    folder = tmp_path_factory.mktemp("patient")
    case = load_case(phantom_case)
    write_cloud_ply(folder / "cloud.ply", cloud_by_rays(case, looking_down(case)))
    command = ("locate", elastic_model, folder / "cloud.ply", "--out", folder / "run", "--grid", 32)
    assert "P1, right" in answered(tumortrack(*command, "--patient", "P1", "--side", "right"))
    return folder / "run"


def test_they_travel_from_the_case_to_model_run_and_plan(
    phantom_case, elastic_model, run, tmp_path
):
    assert store.read_json(phantom_case / "manifest.json")["patient"] == P1
    assert store.read_json(elastic_model / "manifest.json")["provenance"]["patient"] == P1
    assert store.read_json(run / "report.json")["patient"] == P1
    header = (run / "labels.seg.nrrd").read_bytes()[:4000]
    assert b"SCT^24028007^Right" in header
    plan = ("plan", run, tmp_path / "plan", "--no-arms", "--accept-poor", "--accept-budget")
    assert "P1, right" in succeeded(tumortrack(*plan, "--patient", "P1"))
    assert read_plan(tmp_path / "plan").patient == Patient("P1", "right")


@pytest.mark.parametrize("stated", OTHERS)
def test_another_patient_or_side_than_stated_stops(elastic_model, run, tmp_path, stated):
    cloud, place = run.parent / "cloud.ply", tmp_path / "new"
    for command in (
        ("locate", elastic_model, cloud, "--out", place),
        ("track", elastic_model, "virtual:nowhere", f"recording:{place}"),
        ("plan", run, place, "--no-arms", "--accept-poor"),
    ):
        line = refusal(tumortrack(*command, *stated))
        assert "P1, right" in line
        assert not place.exists()


def test_a_recording_of_another_patient_is_not_played(elastic_model, run, tmp_path):
    place = tmp_path / "seen"
    place.mkdir()
    shutil.copy(run.parent / "cloud.ply", place)
    about, report = place / "recording.json", tmp_path / "report.json"
    track = ("track", elastic_model, f"recording:{place}", "--report", report)
    about.write_text(json.dumps({"patient": {"id": "P2", "side": "right"}}))
    line = refusal(tumortrack(*track))
    assert "P2, right" in line
    assert not report.exists()
    for whose in ({"id": "P1", "side": "right"}, {"id": "unknown", "side": "unknown"}):
        about.write_text(json.dumps({"patient": whose}))
        succeeded(tumortrack(*track))
        report.unlink()


@pytest.mark.parametrize(("stated", "word"), [("", "identifier"), ("unknown", "unknown")])
def test_an_empty_variable_in_a_script_is_no_leave_to_take_anybody(elastic_model, stated, word):
    track = ("track", elastic_model, "virtual:nowhere")
    assert word in refusal(tumortrack(*track, "--patient", stated))


def test_folders_that_say_nothing_know_nobody_and_serve_nobody_in_particular(
    elastic_model, run, tmp_path
):
    model, old = tmp_path / "model", tmp_path / "run"
    shutil.copytree(elastic_model, model)
    about = json.loads((model / "manifest.json").read_text())
    del about["provenance"]["patient"]
    (model / "manifest.json").write_text(json.dumps(about))
    shutil.copytree(run, old)
    report = json.loads((old / "report.json").read_text())
    del report["patient"]
    (old / "report.json").write_text(json.dumps(report))
    store.seal(old, "run", {"report": "report.json"}, "camera")
    locate = ("locate", model, run.parent / "cloud.ply", "--out", tmp_path / "new", "--grid", 32)
    plan = ("plan", old, tmp_path / "plan", "--no-arms", "--accept-poor", "--accept-budget")
    for command in (locate, plan):
        line = refusal(tumortrack(*command, "--patient", "P1"))
        assert "--patient ID" in line
        assert "unknown" in answered(tumortrack(*command))
