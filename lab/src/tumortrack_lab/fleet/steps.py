"""Steps for one patient: prepare -> check -> simulated states -> margins and evaluation -> summary.

Each function is a ``Work``: it calls what the commands call, and writes the same bits wherever and
whenever it runs, so no times, paths or file names (which `tumortrack margins` writes). The engine
records costs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tumortrack.core import store
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.rigid_fit import matched_vertices
from tumortrack.imaging import prepare as preparing
from tumortrack.imaging.case import Case, load_case, save_case
from tumortrack.imaging.options import PrepareOptions
from tumortrack.report.pictures import qc_picture
from tumortrack.simulate.scene_folder import read_scene
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.margins import NAME, write_sealed
from tumortrack.tracking.model_files import case_model, load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.fleet import checks
from tumortrack_lab.fleet.list import Patient, hashed
from tumortrack_lab.fleet.pictures import thumbnail, worst_picture
from tumortrack_lab.fleet.task import File, Task
from tumortrack_lab.margins.calibration import list_states, margins_of, row_of
from tumortrack_lab.margins.table import head_of, open_table
from tumortrack_lab.real.judging import judge
from tumortrack_lab.tets import lattice
from tumortrack_lab.twin.apparatus import bench_from_ct
from tumortrack_lab.world.scenes import World, WorldConfig, simplified

# Those of the wider world but for cut organs, which are not located any more.
FAMILIES = ("rest", "plate", "clamp", "twist", "pull", "tether", "roll")
_TEST = len(FAMILIES) * 100_000  # number of the first state that is evaluated on
CONFIDENCES = (0.9, 0.95)
_VERSIONS = {"evaluate": 5, "margins": 3}  # of other steps: 2
Inputs = Mapping[str, Path]
Given = Mapping[str, Any]


def chain(patient: Patient) -> dict[str, Task]:
    """The patient's tasks by step, each after those that it needs; ``summary`` is the wanted one.

    A task makes a group of states, one of each family, so that a later run with more states keeps
    the earlier groups. Evaluation and margins never share a state. The input's content is part of
    the seed: a state's number alone would give every patient the same load, view and sensor errors.
    """
    steps: dict[str, Task] = {}
    source = hashed(patient.source)

    def add(
        name: str, work: Any, options: Given, inputs: Mapping[str, Task | File], memory_mb: int
    ) -> Task:
        kind = name.rstrip("0123456789-")
        version = _VERSIONS.get(kind, 2)
        steps[name] = Task(patient.name, kind, version, work, dict(options), inputs, memory_mb)
        return steps[name]

    kind = "" if patient.source.is_dir() else "".join(patient.source.suffixes[-2:])
    given = {key: list(v) if isinstance(v, tuple) else v for key, v in patient.prepare.items()}
    case = add("prepare", prepare, {**given, "suffix": kind}, {"source": source}, 3000)
    series = {"series": patient.prepare.get("series")}
    checked = add("check", check, series, {"case": case, "source": source}, 2000)
    after = {"case": case, "check": checked}
    groups: dict[str, dict[str, Task | File]] = {"margins": {}, "test": {}}
    drawn = hashlib.sha256(f"{source.key} {patient.seed}".encode()).hexdigest()
    counts = {"margins": (0, patient.margin_states, 1)}
    counts["test"] = _TEST, patient.test_states, patient.views
    for kind, (first, count, views) in counts.items():
        for n in range(first, first + count, len(FAMILIES)):
            here = {
                "first": n, "count": min(len(FAMILIES), first + count - n), "views": views,
                "seed": int(drawn[:8], 16),
            }  # fmt: skip
            name = f"states-{kind}-{len(groups[kind])}"
            groups[kind][f"states_{len(groups[kind]):04d}"] = add(name, states, here, after, 1500)
    known, method = {"case": case, **groups["margins"]}, {"fingerprint": fingerprint()}
    margin = add("margins", margins, {"seed": patient.seed, **method}, known, 1500)
    judged = add("evaluate", evaluate, method, {"case": case, **groups["test"]}, 1500)
    results = {**after, "margins": margin, "evaluate": judged}
    add("summary", summary, {}, {**results, **groups["test"]}, 1500)
    return steps


def prepare(inputs: Inputs, options: Given, out: Path) -> None:
    """A case with its model, as from `tumortrack prepare`, but without its source's name."""
    given: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in options.items()
    }
    given.pop("suffix")
    case = preparing.prepare(inputs["source"], PrepareOptions(**given))
    case = replace(case, report={**case.report, "source": "input"})
    qc_picture(case.labels, case.ct, case.anatomy, out / "qc.png", str(case.patient))
    save_case(case, out)
    case_model(load_case(out))


def check(inputs: Inputs, options: Given, out: Path) -> None:
    """check.json: the anatomy in numbers, and ``doubts``: what a person should look at. Raises
    InputError: the case fails the quality check."""
    case = load_case(inputs["case"])
    cut = checks.is_cut_off(case, inputs["source"], options["series"])
    numbers = checks.described(case)
    if failures := checks.failures(numbers, cut):
        raise InputError(f"the quality check failed: {'; '.join(failures)}. Look at qc.png.")
    store.write_json(out / "check.json", {**numbers, "doubts": checks.doubts(case, numbers)})


def states(inputs: Inputs, options: Given, out: Path) -> None:
    """Scene folders of ``count`` states of the wider world from number ``first`` on, in ``views``
    views each, and failures.json: states without an equilibrium, views without an organ."""
    case, sha256 = load_case(inputs["case"]), store.sha256_of(inputs["case"] / store.MANIFEST)
    config = WorldConfig(seed=options["seed"], families=FAMILIES)
    organ = case.anatomy.organ
    lying = bench_from_ct(organ, case.up_lps)
    there = organ.moved(organ.vertices_mm @ lying[:3, :3].T + lying[:3, 3])
    world = World.of(case, sha256, config, lattice(there, config.edge_mm))
    failures = {}
    for number in range(options["first"], options["first"] + options["count"]):
        family, _ = world.recipe(number)
        try:
            scene = world.scene(number)
            scene.write(out / f"{number:06d}-{family}-0")
        except TumortrackError as error:
            failures[f"{number:06d}-{family}-0"] = f"{type(error).__name__}: {error}"
            continue
        for view in range(1, options["views"]):
            name = f"{number:06d}-{family}-{view}"
            try:
                shown = world.kept(scene)
                world.again(shown, number * 1000 + view, "none").write(out / name)
            except TumortrackError as error:
                failures[name] = f"{type(error).__name__}: {error}"
    store.write_json(out / "failures.json", failures)


def margins(inputs: Inputs, options: Given, out: Path) -> None:
    """margins.jsonl, a line for each state, as `tumortrack margins` writes it; result.json; and
    with enough states margins.json, which belongs into the model's folder.

    result.json: ``states``; ``answers``, the good estimates; ``reason`` why no margin is stated
    (empty: one is); ``margin_mm`` by confidence (medians over the answers); ``largest_miss_mm`` of
    the answers; ``holds_for``, the chance that one more exchangeable answer misses by no more than
    that: n / (n + 1).
    """
    model = inputs["case"] / Case.MODEL
    seed, digest = options["seed"], store.sha256_of(model / store.MANIFEST)
    tracker, rows = Tracker(load_model(model)), []
    groups = [folder for name, folder in inputs.items() if name.startswith("states_")]
    listed = list_states([folder for folder in groups if _scenes(folder)], seed)
    for state in sorted(listed, key=lambda state: state.folder.name):
        row = row_of(tracker, read_scene(state.folder), state, seed)
        rows.append(msgspec.structs.replace(row, scene=state.folder.name))
    head = head_of(digest, seed)
    with open_table(out / "margins.jsonl", head) as (_, add):
        for row in rows:
            add(row)
    good = [row for row in rows if not row.doubt]
    misses = [row.score("tumor") for row in good if "tumor" in row.misses]
    result: dict[str, Any] = {
        "states": len(rows), "answers": len(good), "reason": "", "margin_mm": {},
        "largest_miss_mm": max(misses, default=None),
        "holds_for": len(misses) / (len(misses) + 1),
    }  # fmt: skip
    try:
        table = store.sha256_of(out / "margins.jsonl")
        stated = margins_of(rows, table, CONFIDENCES, seed=seed)
        write_sealed(out / NAME, msgspec.structs.replace(stated, model_sha256=digest))
        for shells in stated.shells:
            at = [
                shells.radii["tumor"].at(s, r.measured) for r in good for _, s in r.misses["tumor"]
            ]
            known = [mm for mm in at if mm is not None]
            result["margin_mm"][f"{shells.confidence:g}"] = float(np.median(known))
    except InputError as error:
        result["reason"] = f"too few states: {error}"
    store.write_json(out / "result.json", result)


def evaluate(inputs: Inputs, options: Given, out: Path) -> None:
    """rows.json: verdict and errors of every scene, beside those of rigid poses."""
    anatomy = simplified(load_case(inputs["case"]).anatomy)
    tracker, rows = Tracker(load_model(inputs["case"])), []
    failures: dict[str, str] = {}
    for folder in _groups(inputs):
        failures |= store.read_json(folder / "failures.json")
        for path in _scenes(folder):
            scene = read_scene(path)
            ordered = [
                rest.moved(matched_vertices(rest, part))  # in the order of the case's vertices
                for rest, part in zip(anatomy.parts, scene.reference.parts, strict=True)
            ]
            scene = replace(scene, reference=anatomy.of(ordered))
            number, family, view = path.name.split("-")
            about = {"scene": path.name, "state": int(number), "family": family, "view": int(view)}
            about |= {name: scene.meta[name] for name in ("hidden_share", "visible_share")}
            about["segmentation"] = scene.meta["segmentation"]["kind"]
            rows.append(about | judge(tracker, anatomy, scene, scene.depth))
    store.write_json(out / "rows.json", {"rows": rows, "failures": failures})


def summary(inputs: Inputs, options: Given, out: Path) -> None:
    """summary.json: what the fleet's tables say of the patient; case.webp and, of the worst
    estimate, worst.webp."""
    checked = store.read_json(inputs["check"] / "check.json")
    result = store.read_json(inputs["margins"] / "result.json")
    judged = store.read_json(inputs["evaluate"] / "rows.json")
    made = store.read_json(inputs["case"] / Case.MODEL / store.MANIFEST)["provenance"]
    model = {key: value for key, value in made.items() if key.startswith("validation_")}
    content = {"check": checked, "margins": result, "model": model, **judged}
    store.write_json(out / "summary.json", content)
    thumbnail(inputs["case"] / "qc.png", out / "case.webp")
    worst_picture(inputs["case"], list(_groups(inputs)), judged["rows"], out / "worst.webp")


def _groups(inputs: Inputs) -> Iterator[Path]:
    return (inputs[name] for name in sorted(inputs) if name.startswith("states_"))


def _scenes(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir())
