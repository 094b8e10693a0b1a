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

from tumortrack.core import store
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.rigid_fit import matched_vertices
from tumortrack.imaging import prepare as preparing
from tumortrack.imaging.case import Case, load_case, save_case
from tumortrack.imaging.options import PrepareOptions
from tumortrack.report.pictures import qc_picture
from tumortrack.simulate.scene_folder import read_scene
from tumortrack.tracking.bound_factor import NAME, write_factor
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.model_files import case_model, load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.fleet import checks
from tumortrack_lab.fleet.list import Patient, hashed
from tumortrack_lab.fleet.pictures import thumbnail, worst_picture
from tumortrack_lab.fleet.task import File, Task
from tumortrack_lab.margins.factor import Locating, found_factor, list_states
from tumortrack_lab.margins.table import head_of, open_table
from tumortrack_lab.real.judging import judge
from tumortrack_lab.tets import lattice
from tumortrack_lab.twin.apparatus import bench_from_ct
from tumortrack_lab.world.scenes import World, WorldConfig, simplified

# Those of the wider world but for cut organs, which are not located any more.
FAMILIES = ("rest", "plate", "clamp", "twist", "pull", "tether", "roll")
_TEST = len(FAMILIES) * 100_000  # number of the first state that is evaluated on
_VERSIONS = {"evaluate": 5, "margins": 4}  # of other steps: 3
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
        version = _VERSIONS.get(kind, 3)
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
    with enough states bound_factor.json, which belongs into the model's folder.

    result.json: ``states``; ``answers``, the good ones; ``bound_factor``, by which their bounds are
    to be multiplied; or the ``reason`` why it is not known; ``largest_ratio`` of what an answer is
    off to its bound; ``holds_for``, the chance that one more exchangeable answer has no larger one:
    n / (n + 1).
    """
    model = inputs["case"] / Case.MODEL
    seed, digest = options["seed"], store.sha256_of(model / store.MANIFEST)
    locating, rows = Locating(Tracker(load_model(model)), seed), []
    states = list_states([folder for folder in _groups(inputs) if _scenes(folder)], seed)
    for state in sorted(states, key=lambda state: state.name):
        row = locating.row(read_scene(state), state)
        rows.append(msgspec.structs.replace(row, scene=state.name))
    with open_table(out / "margins.jsonl", head_of(digest, seed)) as (_, add):
        for row in rows:
            add(row)
    ratios = [row.ratio for row in rows if row.ratio is not None]
    result: dict[str, Any] = {
        "states": len(rows), "answers": len(ratios), "reason": "", "bound_factor": None,
        "largest_ratio": max(ratios, default=None), "holds_for": len(ratios) / (len(ratios) + 1),
    }  # fmt: skip
    try:
        found = found_factor(rows, digest, store.sha256_of(out / "margins.jsonl"), seed)
        write_factor(out / NAME, found)
        result["bound_factor"] = found.factor
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
