"""What a fleet does for a patient: the list, the chain, and what comes of it."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from tumortrack.assessment.bound import POOR_MM
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_files import write_anatomy
from tumortrack.core.types import Mesh
from tumortrack.tracking import model_files
from tumortrack_lab.fleet import checks, results
from tumortrack_lab.fleet.engine import run
from tumortrack_lab.fleet.executors import Serial
from tumortrack_lab.fleet.list import MISSING, Patient, read_list
from tumortrack_lab.fleet.steps import chain
from tumortrack_lab.fleet.store import Store
from tumortrack_lab.tets import lattice, tet_volumes

FEW = {"margin_states": 2, "test_states": 2, "views": 2}


def listed(folder: Path, text: str) -> list[Patient]:
    (folder / "list.csv").write_text(text)
    return read_list(folder / "list.csv")


def test_a_list_says_what_differs_from_the_defaults(tmp_path):
    rows = "name,input,side,organ_hu,views\nanna,ct/anna,left,-100 250,\n\nbo, /b.nii.gz ,,,3\n"
    anna, bo = listed(tmp_path, rows)
    assert anna.source == tmp_path / "ct/anna"
    assert bo.source == Path("/b.nii.gz")
    assert anna.prepare == {"side": "left", "organ_hu": (-100.0, 250.0)}
    assert bo.prepare == {}
    assert (anna.views, bo.views) == (Patient(name="x", source=Path()).views, 3)


def test_a_list_tells_all_that_is_wrong_by_line(tmp_path):
    rows = "name,input,side,seed\na,x,left,0\nb,,left,0\na,x,,\nc,x,up,0\nd,x,,-1\n../e,x,,\nf,x\n"
    with pytest.raises(InputError) as told:
        listed(tmp_path, rows)
    lines = str(told.value).splitlines()[1:]
    assert [line.split(":")[0].strip() for line in lines] == [f"line {n}" for n in range(3, 9)]
    with pytest.raises(InputError, match=r"no option 'sede'.*allowed: name, input"):
        listed(tmp_path, "name,input,sede\na,x,1\n")


def _outer(tets: np.ndarray) -> np.ndarray:
    """The faces of one tetrahedron alone; every other is shared by two."""
    corners = tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    faces, times = np.unique(np.sort(corners, axis=1), axis=0, return_counts=True)
    assert times.max() == 2
    return faces[times == 1]


def test_a_lattice_fills_a_ball_and_repeats_to_the_last_bit():
    ball = trimesh.creation.icosphere(subdivisions=3)
    surface = Mesh(ball.vertices * 30 + [5, -7, 11], ball.faces)
    mesh = lattice(surface, 8.0)
    assert mesh.volumes_mm3.sum() == pytest.approx(surface.volume_mm3, rel=0.03)
    outside = np.linalg.norm(mesh.nodes_mm - [5, -7, 11], axis=1) - 30
    assert np.median(np.abs(outside[np.unique(_outer(mesh.tets))])) < 8.0 / 8
    assert outside.max() < 8.0 / 2
    assert mesh.volumes_mm3.min() > 8.0**3 / 12 / 5 * 0.99
    edges = _outer(mesh.tets)[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2)  # of a closed surface
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    again = lattice(surface, 8.0)
    assert np.array_equal(again.nodes_mm, mesh.nodes_mm)
    assert np.array_equal(again.tets, mesh.tets)
    assert (tet_volumes(again.nodes_mm, again.tets) > 0).all()


@pytest.fixture(scope="module")
def fleets(tmp_path_factory):
    """The same organ under two names in two folders, each done by a fleet of its own; one of them
    with a patient whose organ is cut off and one without an input."""
    from imaging_objects import kidney_labels, write_nifti
    from warp_objects import ANATOMY, slim_clinic

    made = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_files, "clinic", lambda *_: slim_clinic())
        for name in ("erste", "zweite"):
            home = tmp_path_factory.mktemp(name)
            (home / f"{name} meshes").mkdir()
            write_anatomy(home / f"{name} meshes", ANATOMY)
            patients = [Patient(name=name, source=home / f"{name} meshes", **FEW)]
            if name == "zweite":
                whole = kidney_labels((2.0, 2.0, 2.0))
                found = np.argwhere(whole.labels > 0)
                ends = whole.labels[found.min(0)[0] + 3 :]
                write_nifti(home / "cut.nii.gz", ends, whole.lps_from_index, "sform")
                patients += [Patient(name="cut", source=home / "cut.nii.gz", **FEW)]
                patients += [Patient(name="gone", source=home / "gone.nii.gz", **FEW)]
            held = Store(str(home / "store"))
            tasks = [chain(patient)["summary"] for patient in patients]
            done = {one.task.patient: one for one in run(tasks, held, Serial(), tries=1)}
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
        files = files_of(first.get(task.key))
        assert files, name
        assert files == files_of(second.get(task.key)), name
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
        kind: [path.name for path in held.get(steps[f"states-{kind}-0"].key).iterdir()]
        for kind in ("margins", "test")
    }
    numbers = {kind: {name.split("-")[0] for name in names} for kind, names in kinds.items()}
    assert not {n for n in numbers["margins"] & numbers["test"] if n.isdigit()}
    assert sum("rest" in name for name in kinds["margins"]) == 1
    assert sum("rest" in name for name in kinds["test"]) == 2
    rows = json.loads((held.get(steps["evaluate"].key) / "rows.json").read_text())["rows"]
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
    result = json.loads((held.get(chain(one)["margins"].key) / "result.json").read_text())
    assert result["reason"].startswith("too few states")
    assert result["bound_factor"] is None
    answers = result["answers"]
    assert result["holds_for"] == answers / (answers + 1)
    assert (result["largest_ratio"] is not None) == (answers > 0)


def test_tables_say_who_failed_and_who_needs_an_eye(fleets):
    home, patients, _, _ = fleets[1]
    people = pd.read_parquet(home / "out" / results.PATIENTS).set_index("patient")
    assert people.state.to_dict() == {"zweite": "done", "cut": "cannot", "gone": "failed"}
    assert people.step["cut"] == "check"
    assert "cut off" in people.reason["cut"]
    scenes = pd.read_parquet(home / "out" / results.SCENES)
    assert set(scenes.patient) == {"zweite"}
    assert len(scenes) == people.scenes["zweite"]
    good = scenes[scenes.verdict == "good"]
    assert people.good["zweite"] == pytest.approx(len(good) / len(scenes))
    assert good.radius_mm.between(0.1, POOR_MM).all()
    looks = pd.read_csv(home / "out" / results.LOOK)
    assert "check: " in looks.reason[looks.patient == "cut"].item()
    assert "the side is unknown" in set(looks.reason[looks.patient == "zweite"])
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
