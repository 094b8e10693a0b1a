"""Steps for one patient: prepare -> check -> simulated states -> margins and evaluation -> summary.

Each is a ``run.Work``: it calls what the commands call, and writes the same bits wherever and
whenever it runs, so no times, paths or file names.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from PIL import Image

from tumortrack.assessment.bound_factor import NAME, write_factor
from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.case import prepare as preparing
from tumortrack.case.options import PrepareOptions
from tumortrack.core import store
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.io.case import Case, load_case, save_case
from tumortrack.io.scene_folder import read_scene
from tumortrack.organ.tets import lattice
from tumortrack.registration.base_model import Model
from tumortrack.report.pictures import qc_picture, scene_picture
from tumortrack.report.protocol import evaluate_scene
from tumortrack.tracking.model_files import case_model, load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks.fleet import checks
from tumortrack_benchmarks.fleet.patients import Patient, hashed
from tumortrack_benchmarks.fleet.run import File, Step, Work
from tumortrack_benchmarks.judging import judge_folder
from tumortrack_benchmarks.margins import Locating, found_factor, head_of, list_states, open_table
from tumortrack_benchmarks.physics.scenes import (
    StressConfig,
    StressScenes,
    bench_from_ct,
    simplified,
)

# Those of the wider world but for cut organs, which are not located any more.
FAMILIES = ("rest", "plate", "clamp", "twist", "pull", "tether", "roll")
_TEST = len(FAMILIES) * 100_000  # number of the first state that is evaluated on
_VERSIONS = {"evaluate": 6, "margins": 5}  # of other steps: 4
_WIDTH = 720  # pixels
Inputs = Mapping[str, Path]
Given = Mapping[str, Any]


def chain(patient: Patient) -> dict[str, Step]:
    """The patient's steps by name, each after those that it needs; ``summary`` is the wanted one.

    States come in groups, one of each family, so that a later run with more states keeps the
    earlier groups. Evaluation and margins never share a state. The input's content is part of the
    seed: a state's number alone would give every patient the same load, view and sensor errors.
    """
    steps: dict[str, Step] = {}
    source = hashed(patient.input)

    def add(name: str, work: Work, options: Given, inputs: Mapping[str, Step | File]) -> Step:
        kind = name.rstrip("0123456789-")
        steps[name] = Step(kind, _VERSIONS.get(kind, 4), work, dict(options), inputs)
        return steps[name]

    kind = "" if patient.input.is_dir() else "".join(patient.input.suffixes[-2:])
    given = {key: list(v) if isinstance(v, tuple) else v for key, v in patient.prepare.items()}
    case = add("prepare", prepare, {**given, "suffix": kind}, {"source": source})
    series = {"series": patient.prepare.get("series")}
    after = {"case": case, "check": add("check", check, series, {"case": case, "source": source})}
    groups: dict[str, dict[str, Step | File]] = {"margins": {}, "test": {}}
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
            groups[kind][f"states_{len(groups[kind]):04d}"] = add(name, states, here, after)
    method = {"fingerprint": fingerprint()}
    known = {"case": case, **groups["margins"]}
    margin = add("margins", margins, {"seed": patient.seed, **method}, known)
    judged = add("evaluate", evaluate, method, {"case": case, **groups["test"]})
    add("summary", summary, {}, {**after, "margins": margin, "evaluate": judged, **groups["test"]})
    return steps


def summary_of(patient: Patient) -> Step:
    return chain(patient)["summary"]


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
    config = StressConfig(seed=options["seed"], families=FAMILIES)
    organ = case.anatomy.organ
    lying = bench_from_ct(organ, case.up_lps)
    there = organ.with_vertices(organ.vertices_mm @ lying[:3, :3].T + lying[:3, 3])
    world = StressScenes.from_case(case, sha256, config, lattice(there, config.edge_mm))
    failures = {}
    for number in range(options["first"], options["first"] + options["count"]):
        shown = None
        for view in range(options["views"]):
            name = f"{number:06d}-{config.family(number)}-{view}"
            try:
                shown = shown or world.shown(number)
                again = number * 1000 + view
                scene = world.again(shown, again) if view else world.first(shown)
            except TumortrackError as error:
                failures[name] = f"{type(error).__name__}: {error}"
                if not view:
                    break
            else:
                scene.write(out / name)
    store.write_json(out / "failures.json", failures)


def margins(inputs: Inputs, options: Given, out: Path) -> None:
    """margins.jsonl, a line for each state, as `tumortrack margins` writes it; with enough states
    bound_factor.json, which belongs into the model's folder; and result.json: ``states``;
    ``answers``, the good ones; ``bound_factor``, or the ``reason`` why it is not known;
    ``largest_ratio`` of what an answer is off to its bound; ``holds_for``, the chance that one more
    exchangeable answer has no larger one: n / (n + 1)."""
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
            view = {"view": int(path.name.rsplit("-", 1)[1])}
            rows.append(view | judge_folder(tracker, anatomy, path))
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
    if judged["rows"]:
        name = max(judged["rows"], key=_far)["scene"]
        [folder] = [group / name for group in _groups(inputs) if (group / name).is_dir()]
        _worst_picture(load_model(inputs["case"]), folder, out / "worst.webp")


def _far(row: dict[str, Any]) -> tuple[int, float]:
    """Good answers first, then the largest error."""
    errors = [tumor.get("middle_mm", -np.inf) for tumor in row["tumors"]]
    return ["refused", "poor", "good"].index(row["verdict"]), max(errors, default=-np.inf)


def _worst_picture(model: Model, folder: Path, out: Path) -> None:
    """The estimate, if there is one, over the truth."""
    scene, tracker = read_scene(folder), Tracker(model)
    entry, estimate = evaluate_scene(
        lambda cloud: tracker.locate(cloud, full_view=scene.depth), scene, folder.name
    )
    with TemporaryDirectory() as aside:
        shown = estimate.meshes if estimate else {}
        scene_picture(scene, shown, entry, Path(aside) / "scene.png")
        thumbnail(Path(aside) / "scene.png", out)


def thumbnail(source: Path, out: Path) -> None:
    """A picture, no wider than ``_WIDTH``, as WebP."""
    with Image.open(source) as image:
        size = min(_WIDTH, image.width), round(image.height * min(1, _WIDTH / image.width))
        image.convert("RGB").resize(size).save(out, "WEBP", quality=80)


def _groups(inputs: Inputs) -> Iterator[Path]:
    return (inputs[name] for name in sorted(inputs) if name.startswith("states_"))


def _scenes(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir())
