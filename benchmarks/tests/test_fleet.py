"""What a fleet does for a patient: the list, the chain, and what comes of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fleet_objects import executions, last, patients
from refused import refused
from stories import refusal, tumortrack
from tumortrack.assessment.bound import POOR_MM
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install
from tumortrack.io.mesh_files import write_anatomy
from tumortrack.tracking import model_files
from tumortrack_benchmarks.cli.fleet import progress_words
from tumortrack_benchmarks.fleet import checks, results
from tumortrack_benchmarks.fleet.patients import MISSING, Patient, hashed, read_list
from tumortrack_benchmarks.fleet.run import in_turn
from tumortrack_benchmarks.fleet.steps import chain, summary_of

FEW = {"margin_states": 2, "test_states": 2, "views": 2}


def listed(folder: Path, text: str) -> list[Patient]:
    (folder / "list.csv").write_text(text)
    return read_list(folder / "list.csv")


def test_a_list_says_what_differs_from_the_defaults(tmp_path):
    rows = "name,input,side,organ_hu,views\nanna,ct/anna,left,-100 250,\n\nbo, /b.nii.gz ,,,3\n"
    anna, bo = listed(tmp_path, rows)
    assert anna.input == tmp_path / "ct/anna"
    assert bo.input == Path("/b.nii.gz")
    assert anna.prepare == {"side": "left", "organ_hu": (-100.0, 250.0)}
    assert bo.prepare == {}
    assert (anna.views, bo.views) == (Patient(name="x", input=Path()).views, 3)


def test_a_list_tells_all_that_is_wrong_by_line(tmp_path):
    rows = "name,input,side,seed\na,x,left,0\nb,,left,0\na,x,,\nc,x,up,0\nd,x,,-1\n../e,x,,\nf,x\n"
    with pytest.raises(InputError) as told:
        listed(tmp_path, rows)
    lines = str(told.value).splitlines()[1:]
    assert [line.split(":")[0].strip() for line in lines] == [f"line {n}" for n in range(3, 9)]
    with refused(InputError, "sede"):
        listed(tmp_path, "name,input,sede\na,x,1\n")


@pytest.fixture(scope="module")
def fleets(tmp_path_factory):
    """The same organ under two names in two folders, each done by a fleet of its own; one of them
    with a patient whose organ is cut off and one without an input."""
    from imaging_objects import kidney_labels, write_nifti
    from warp_objects import ANATOMY, slim_elastic

    made = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_files, "elastic", lambda *_: slim_elastic())
        for name in ("erste", "zweite"):
            home = tmp_path_factory.mktemp(name)
            (home / f"{name} meshes").mkdir()
            write_anatomy(home / f"{name} meshes", ANATOMY)
            patients = [Patient(name=name, input=home / f"{name} meshes", **FEW)]
            if name == "zweite":
                whole = kidney_labels((2.0, 2.0, 2.0))
                found = np.argwhere(whole.labels > 0)
                ends = whole.labels[found.min(0)[0] + 3 :]
                write_nifti(home / "cut.nii.gz", ends, whole.lps_from_index, "sform")
                patients += [Patient(name="cut", input=home / "cut.nii.gz", **FEW)]
                patients += [Patient(name="gone", input=home / "gone.nii.gz", **FEW)]
            held = home / "store"
            wanted = {one.name: partial(summary_of, one) for one in patients}
            done = dict(filter(None, in_turn(wanted, held, False, 1)))
            results.write_results(home / "out", patients, done, held)
            made.append((home, patients, held, done))
    return made


def files_of(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def test_a_chain_gives_the_same_bits_in_another_folder(fleets):
    (_, [one], first, done), (_, [other, *_], second, _) = fleets
    assert done["erste"].state == "done", done["erste"]
    steps, same = chain(one), chain(other)
    for name, task in steps.items():
        assert task.key == same[name].key
        files = files_of(task.place(first))
        assert files, name
        assert files == files_of(task.place(second)), name
        texts = {name: data for name, data in files.items() if name.endswith((".json", ".jsonl"))}
        for file, data in texts.items():
            for word in (str(tempfile.gettempdir()).encode(), b"erste"):
                assert word not in data, (name, file, word)


def test_patients_are_shown_in_draws_of_their_own(fleets):
    _, [one, other, *_], _, _ = fleets[1]

    def seeds(patient):
        steps = chain(patient)
        return {steps[name].options["seed"] for name in ("states-margins-0", "states-test-0")}

    assert len(seeds(one) | seeds(other) | seeds(replace(one, seed=1))) == 3


def test_evaluation_has_states_of_its_own_and_more_views_of_them(fleets):
    _, [one], held, _ = fleets[0]
    steps = chain(one)
    kinds = {
        kind: [path.name for path in steps[f"states-{kind}-0"].place(held).iterdir()]
        for kind in ("margins", "test")
    }
    numbers = {kind: {name.split("-")[0] for name in names} for kind, names in kinds.items()}
    assert not {n for n in numbers["margins"] & numbers["test"] if n.isdigit()}
    assert sum("rest" in name for name in kinds["margins"]) == 1
    assert sum("rest" in name for name in kinds["test"]) == 2
    rows = json.loads((steps["evaluate"].place(held) / "rows.json").read_text())["rows"]
    rest = [row for row in rows if row["family"] == "rest"]
    assert {row["view"] for row in rest} == {0, 1}
    # at rest the best rigid pose leaves nothing but what segmentations err by
    for row in rest:
        assert row["rigid_target_mm"] < 1.0
        assert row["tumors"][0]["rigid_middle_mm"] < 1.0
        assert row["rigid_target_mm"] < row["rigid_fit_target_mm"] < 5.0
        assert {"rigid_fit_middle_mm", "rigid_fit_outside_mm"} < set(row["tumors"][0])


def test_few_states_give_no_factor_but_what_they_can(fleets):
    _, [one], held, _ = fleets[0]
    result = json.loads((chain(one)["margins"].place(held) / "result.json").read_text())
    assert result["reason"]
    assert result["bound_factor"] is None
    answers = result["answers"]
    assert result["holds_for"] == answers / (answers + 1)
    assert (result["largest_ratio"] is not None) == (answers > 0)


def test_tables_say_who_failed_and_who_needs_an_eye(fleets):
    home, patients, _, _ = fleets[1]
    people = pd.read_parquet(home / "out" / results.PATIENTS).set_index("patient")
    assert people.state.to_dict() == {"zweite": "done", "cut": "cannot", "gone": "failed"}
    assert people.step["cut"] == "check"
    scenes = pd.read_parquet(home / "out" / results.SCENES)
    assert set(scenes.patient) == {"zweite"}
    assert len(scenes) == people.scenes["zweite"]
    good = scenes[scenes.verdict == "good"]
    assert people.good["zweite"] == pytest.approx(len(good) / len(scenes))
    assert good.radius_mm.between(0.1, POOR_MM).all()
    views = pd.read_csv(home / "out" / results.LOOK)
    assert set(views.patient) == {"zweite", "cut", "gone"}
    page = (home / "out" / results.PAGE).read_text()
    for name in ("zweite.webp", "zweite-worst.webp", "cut.webp"):
        assert name in page
        assert (home / "out" / results.PICTURES / name).stat().st_size > 1000
    assert chain(patients[2])["prepare"].inputs["source"].key == MISSING


def test_wrong_answers_are_named():
    tumor = {"ml": 3.0, "kind": "endophytic"}
    rows = [
        {"scene": "a", "verdict": "good", "tumors": [{"middle_mm": 6.0}, {"middle_mm": 4.0}]},
        {"scene": "b", "verdict": "poor", "tumors": [{"middle_mm": 9.0}, {}]},
    ]
    lines = results.tumor_lines({"check": {"tumors": [tumor, tumor]}, "rows": rows})
    over = [(line["over_3_mm"], line["over_5_mm"]) for line in lines]
    assert over == [(True, True), (True, False), (False, False), (False, False)]


def test_an_organ_that_is_none_fails():
    whole = {"organ": "kidney", "organ_ml": 150.0, "tumors": [{"ml": 4.0}]}
    assert checks.failures(whole, cut_off=False) == []
    assert len(checks.failures({**whole, "organ_ml": 9.0, "tumors": []}, cut_off=True)) == 3
    assert len(checks.failures({**whole, "organ_ml": 2000.0}, cut_off=False)) == 1
    assert checks.failures({**whole, "organ": "liver", "organ_ml": 2000.0}, cut_off=False) == []


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where steps are logged."""
    monkeypatch.setenv("FLEET_FOLDER", str(tmp_path))
    (tmp_path / "faults.json").write_text("{}")
    return tmp_path


def outcomes(wanted, held, again=False, tries=3):
    return dict(filter(None, in_turn(wanted, held, again, tries)))


def states(wanted, held, **options):
    return [one.state for one in outcomes(wanted, held, **options).values()]


def values(held: Path) -> dict[str, bytes]:
    """Every result's files."""
    return {str(p.relative_to(held)): p.read_bytes() for p in held.glob("??/*/*") if p.is_file()}


def test_what_is_there_is_not_done_again(folder):
    held = folder / "store"
    first = outcomes(patients(3), held)
    assert [one.state for one in first.values()] == ["done", "cannot", "done"]
    assert first["P1"].step == "step1"
    assert str(folder) not in first["P1"].reason
    assert len(executions(folder)) == 3 + 2 + 3
    assert states(patients(4), held) == ["there", "cannot", "there", "done"]
    assert len(executions(folder)) == 8 + 3
    store.remove(last(0).inputs["before"].place(held))  # nobody needs it: the last one is there
    assert states({"P0": partial(last, 0)}, held) == ["there"]
    assert states(patients(2), held, again=True) == ["there", "cannot"]
    assert executions(folder)[11:] == ["P1-1"]


def test_a_damaged_result_is_noticed_and_made_again(folder):
    held = folder / "store"
    states({"P0": partial(last, 0)}, held)
    whole, end, middle = values(held), last(0).place(held), last(0).inputs["before"].place(held)
    for damage in (lambda p: p.write_bytes(b"something else"), Path.unlink):
        store.remove(end)
        damage(middle / "value")
        assert states({"P0": partial(last, 0)}, held) == ["done"]
        assert executions(folder)[-2:] == ["P0-1", "P0-2"]
        assert values(held) == whole
    store.remove(end)  # half of a result is none, and no name leads out of its folder
    end.mkdir()
    (end / "seal.json").write_text(json.dumps({"files": {"../../escaped": "0" * 64}}))
    assert states({"P0": partial(last, 0)}, held) == ["done"]
    assert values(held) == whole


def test_faults_of_the_machine_are_tried_again_and_stop_nobody_else(folder):
    (folder / "faults.json").write_text(json.dumps({"P0-1": "disk", "P2-2": "defect"}))
    found = outcomes(patients(4), folder / "store")
    assert [one.state for one in found.values()] == ["done", "cannot", "failed", "done"]
    assert "P2-2" in found["P2"].reason
    times = Counter(executions(folder))
    assert (times["P0-0"], times["P0-1"], times["P2-2"]) == (1, 2, 3)


def test_a_users_file_is_read_as_it_was_listed(folder):
    held, path = folder / "store", folder / "ct.raw"
    path.write_bytes(b"a CT")
    listed = hashed(path)
    for content in (b"another", None):
        path.write_bytes(content) if content else path.unlink()
        found = outcomes({"P0": partial(last, 0, source=listed)}, held)["P0"]
        assert found.state == "failed"
        assert str(path) in found.reason
    path.write_bytes(b"a CT")
    assert states({"P0": partial(last, 0, source=listed)}, held) == ["done"]


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="the extra `fleet` is not installed")
def test_ray_gives_the_same_bits_whatever_dies(folder):
    """A worker and the driver are killed, the disk is full for once, one patient has a defect."""
    states(patients(8), folder / "serial")
    (folder / "log").unlink()
    faults = {"wait_s": 0.3, "P2-1": "killed", "P3-1": "disk", "P4-2": "defect"}
    (folder / "faults.json").write_text(json.dumps(faults))
    held, environment = folder / "store", {"RAY_raylet_start_wait_time_s": "300"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))

    def drive() -> subprocess.Popen[str]:
        code = f"import fleet_objects, pathlib; fleet_objects.drive(pathlib.Path({str(held)!r}), 8)"
        return subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True,
            env={**os.environ, **environment},
        )  # fmt: skip

    first = drive()
    while len(values(held)) < 8:  # four results
        assert first.poll() is None
        time.sleep(0.05)
    first.kill()
    first.communicate()
    time.sleep(2.0)  # its workers end
    kept, begun = values(held), len(executions(folder))
    output, _ = drive().communicate(timeout=300)
    lines = [line for line in output.splitlines() if line.startswith('["')]
    found = {name: (state, step) for name, state, step, _ in map(json.loads, lines)}
    assert found["P1"] == ("cannot", "step1")
    assert found.pop("P4")[0] == "failed"
    assert {state for state, _ in found.values()} <= {"there", "done", "cannot"}
    done = {f"P{n}-{k}" for n in range(8) for k, seal in enumerate(_seals(n)) if seal in kept}
    assert done
    assert not done & set(executions(folder)[begun:])
    (folder / "faults.json").write_text("{}")  # the defect is mended
    states(patients(8), held)
    assert values(held) == values(folder / "serial")


def _seals(number: int) -> list[str]:
    """Of a patient's steps, from the first."""
    step, seals = last(number, number == 1), []
    while step is not None:
        seals.append(str(step.place(Path()) / "seal.json"))
        step = step.inputs.get("before")
    return seals[::-1]


def test_without_the_extra_one_line_says_how_to_get_it(tmp_path):
    hide = (
        "import importlib.util as u, sys; find = u.find_spec;"
        "u.find_spec = lambda name: None if name == 'ray' else find(name);"
    )
    code = f"{hide} from tumortrack.cli.main import run; sys.exit(run({['fleet', 'L', 'O']!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert to_install("tumortrack-benchmarks[fleet]") in done.stderr
    assert "s3:/b" in refusal(tumortrack("fleet", "L", tmp_path, "--serial", "--store", "s3://b/f"))


def test_no_rate_is_told_before_a_patient_is_through():
    assert "an hour" not in progress_words(3, Counter(there=1), 3600.0)
    words = progress_words(3, Counter(there=1, done=1), 3600.0)
    assert "1.0 an hour" in words
    assert "1:00:00" in words
