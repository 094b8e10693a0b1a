"""Jobs -> measurements: one method on one scene under one fault, made once and kept as JSON.

A measurement's file name holds the hash of everything that decides its numbers (case, scene, fault,
method, grid), so that a study that was killed goes on where it stopped, and a measurement made from
other inputs is never taken for this one.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

import tumortrack
from tumortrack.core import store
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.report.metrics import distance_to_surface
from tumortrack.report.protocol import evaluate_scene
from tumortrack.sense.camera import deproject
from tumortrack.simulate.scene_folder import read_scene
from tumortrack_lab.bench.machine import cpu_name
from tumortrack_lab.peers.base import kabsch
from tumortrack_lab.study import document
from tumortrack_lab.study.methods import Answer, Method, StudyCase

CLEAN_VIEW = "clean"
_POINTS = 120  # vertices drawn of each tumor
_NEAR_MM, _FAR_MM = 50.0, 400.0  # of a depth image: what can be the organ at all
_SCHEMA = 1  # raise it when a measurement's metrics change their meaning


class MeasurementSpec(Config, frozen=True):
    """What decides a measurement's numbers, and the names under which tables find it."""

    case: str
    case_sha256: str
    scene: str
    scene_sha256: str
    variant: str
    view: str
    method: dict  # the method's identity: name, seed, and hashes or settings
    grid: int
    fault: str = "none"
    fault_seed: int = 0
    schema: int = _SCHEMA

    @property
    def digest(self) -> str:
        """sha256 of the whole specification."""
        return hashlib.sha256(json.dumps(to_builtins(self), sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class MeasurementStore:
    """The folder of all measurements: CASE/METHOD/SCENE-FAULT-GRID-DIGEST.json."""

    folder: Path

    def path(self, spec: MeasurementSpec) -> Path:
        method = f"{spec.method['name']}-{spec.method.get('seed', 0)}"
        file = f"{spec.scene}-{spec.fault}-{spec.grid}-{spec.digest[:16]}.json"
        return self.folder / spec.case / method / file

    def read(self, spec: MeasurementSpec) -> dict | None:
        """What was measured with exactly this specification, if anything. Raises ArtifactError:
        its file is damaged."""
        path = self.path(spec)
        measurement = store.read_json(path) if path.exists() else {}
        return measurement if measurement.get("spec") == to_builtins(spec) else None

    def write(self, spec: MeasurementSpec, measured: dict) -> dict:
        """Keep a measurement, in one step. Raises StorageError: the disk refused."""
        document.make_folder(self.path(spec).parent)
        measurement = {"spec": to_builtins(spec), **measured}
        store.write_json(self.path(spec), measurement)
        return measurement


@dataclass(frozen=True, eq=False)
class Job:
    """A measurement to be made: which method on which scene, at which grid, under which fault."""

    case: StudyCase
    method: Method
    variant: str
    view: str
    grid: int
    fault: str = "none"
    fault_seed: int = 0
    also: dict = field(default_factory=dict)  # what else decides it, beside the method's identity

    @property
    def scene(self) -> Path:
        return self.case.scene(self.variant, self.view)


class StudyStatus(NamedTuple):
    """Where the measuring stands."""

    done: int
    total: int
    measured: int
    name: str
    seconds_each: float
    seconds_left: float


def measure(
    jobs: Iterable[Job],
    kept: MeasurementStore,
    report: Callable[[StudyStatus], None] | None = None,
    one: Callable[[Job], dict] | None = None,
) -> list[dict]:
    """The measurements of these jobs in their order; only those that are not kept yet are made,
    each by ``one`` (``measure_one``). Raises InputError: a scene is missing or cannot be read;
    ArtifactError: a kept measurement or a model is damaged; StorageError: the disk refused."""
    jobs, hashed = list(jobs), cache(store.sha256_of)
    specs = [spec_of(job, hashed) for job in jobs]
    known = {spec.digest: kept.read(spec) for spec in specs}
    todo = {d: (s, j) for s, j in zip(specs, jobs, strict=True) if known[d := s.digest] is None}
    kinds = [f"{s.case} {s.method['name']} {s.grid}" for s, _ in todo.values()]
    seconds: list[float] = []
    for number, (digest, (spec, job)) in enumerate(todo.items(), start=1):
        start = time.perf_counter()
        known[digest] = kept.write(spec, (one or measure_one)(job))
        seconds.append(time.perf_counter() - start)
        if report:
            done = len(known) - len(todo) + number
            name = f"{spec.case} {spec.method['name']} {spec.scene} {spec.fault}"
            spent = pd.Series(seconds, kinds[:number]).groupby(level=0).mean()
            # A kind that was not measured yet counts with the mean of all.
            mean = float(np.mean(seconds))
            left = float(sum(spent.get(kind, mean) for kind in kinds[number:]))
            name = name.removesuffix(" none")
            report(StudyStatus(done, len(known), number, name, mean, left))
    return [found for spec in specs if (found := known[spec.digest]) is not None]


def spec_of(job: Job, hashed: Callable[[Path], str] = store.sha256_of) -> MeasurementSpec:
    """The job's full specification, inputs hashed."""
    if not job.scene.is_dir():
        raise InputError(
            f"{job.scene} does not exist; make the scenes with: tumortrack twin "
            f"{job.case.folder} {job.case.scenes}"
        )
    return MeasurementSpec(
        case=job.case.name,
        case_sha256=hashed(job.case.folder / store.MANIFEST),
        scene=job.scene.name,
        scene_sha256=hashed(job.scene),
        variant=job.variant,
        view=job.view,
        method={**job.method.identity, **job.also},
        grid=job.grid,
        fault=job.fault,
        fault_seed=job.fault_seed,
    )


def about_answer(job: Job, answer: Answer | None) -> dict:
    """What every measurement says of its method: seconds, training, machine, when, and how busy
    the machine was (``load``)."""
    import torch

    return {
        "frame_s": answer.frame_s if answer else None,
        "prepare_s": job.method.prepare_s,
        "method": job.method.about,
        "provenance": {
            "tumortrack": tumortrack.__version__,
            "device": job.method.device,
            "cpu": cpu_name(),
            "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0,
            "threads": torch.get_num_threads(),
            "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
            "when": time.strftime("%Y-%m-%d %H:%M", time.gmtime()),
        },
    }


def measure_one(job: Job) -> dict:
    """One measurement's numbers: the protocol's metrics, errors at points, target errors, times."""
    from tumortrack_lab.twin.faults import MOVED, disturbed

    scene = read_scene(job.scene)
    if job.fault != "none":
        scene = disturbed(scene, job.fault, job.fault_seed)
    answers: list[Answer] = []

    def locate(_: object) -> Estimate:
        answers.append(job.method.locate(scene, job.grid))
        return answers[0].estimate

    entry, estimate = evaluate_scene(locate, scene, job.scene.name)
    points: dict = {}
    if estimate:
        clean = job.case.scene(job.variant, CLEAN_VIEW)
        seen = scene if MOVED in scene.meta or not clean.is_dir() else read_scene(clean)
        visible_mm = seen.cloud.points_mm.astype(float)
        if seen.depth is not None:  # all its pixels
            visible_mm = deproject(seen.depth).astype(float)
            z = visible_mm[:, 2]
            visible_mm = visible_mm[(z > _NEAR_MM) & (z < _FAR_MM)]
        points = point_errors(scene.reference, job.case.anatomy_ct, visible_mm, estimate.meshes)
    return {
        **{key: entry[key] for key in ("parts", "miou", "failed")},
        "locate_s": entry.get("seconds"),
        "points": points,
        "targets_mm": entry.get("tre_mm"),
        **about_answer(job, answers[0] if answers else None),
    }


def point_errors(
    truth: Anatomy, rest_ct: Anatomy, visible_mm: Float[np.ndarray, "n 3"], meshes: dict[str, Mesh]
) -> dict[str, dict[str, list[float]]]:
    """By tumor that was found: depth, displacement and error of points of its true surface, mm.

    A network gives no correspondence, so the error of a point is its distance to the estimated
    surface (``meshes``, by part), for every method alike. Depth is the distance to the nearest
    point of ``visible_mm``, the visible surface without noise; displacement is that of
    ``displacements``. Camera frame but ``rest_ct``.
    """
    from scipy.spatial import cKDTree

    seen, moves = cKDTree(visible_mm), displacements(truth, rest_ct)
    out: dict[str, dict[str, list[float]]] = {}
    for name, part in zip(truth.names[1:], truth.tumors, strict=True):
        if name not in meshes or len(meshes[name].faces) == 0:
            continue
        corners = part.faces.reshape(-1)
        chosen = np.random.default_rng(0).integers(len(corners), size=_POINTS)
        points = part.vertices_mm[corners[chosen]]
        columns = {"depth_mm": seen.query(points)[0]}
        columns["error_mm"] = distance_to_surface(points, meshes[name])
        if name in moves:
            columns["displacement_mm"] = moves[name][chosen]
        out[name] = {key: np.round(values, 2).tolist() for key, values in columns.items()}
    return out


def displacements(truth: Anatomy, rest_ct: Anatomy) -> dict[str, Float[np.ndarray, " n"]]:
    """How far the corner of each face lies from its place under the organ's best rigid motion, mm;
    nothing where the surfaces are not the case's. A file keeps the order of faces, not vertices."""
    if [len(part.faces) for part in truth.parts] != [len(part.faces) for part in rest_ct.parts]:
        return {}
    now, before = (
        [part.vertices_mm[part.faces.reshape(-1)] for part in anatomy.parts]
        for anatomy in (truth, rest_ct)
    )
    best = kabsch(before[0], now[0], np.ones(len(now[0])))
    return {
        name: np.linalg.norm(a - transform_points(best, b), axis=1)
        for name, a, b in zip(truth.names, now, before, strict=True)
    }
