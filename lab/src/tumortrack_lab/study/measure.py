"""Measurements: one method on a case's scenes, made once and kept as JSON, a row a part."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tumortrack.core import store
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.report.metrics import distance_to_surface
from tumortrack.report.protocol import evaluate_scene
from tumortrack.sense.camera import deproject
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack_lab.bench.machine import cpu_name
from tumortrack_lab.peers.base import kabsch
from tumortrack_lab.study import trainings
from tumortrack_lab.study.document import make_folder
from tumortrack_lab.study.methods import Method, StudyCase

CLEAN_VIEW = "clean"
_POINTS = 120  # vertices drawn of each tumor
_NEAR_MM, _FAR_MM = 50.0, 400.0  # of a depth image: what can be the organ at all

One = Callable[[StudyCase, Method, str, str, int], list[dict[str, Any]]]


def measured(
    case: StudyCase, method: Method, variants: Sequence[str], view: str, grid: int, folder: Path,
    one: One | None = None, **also: Any,
) -> list[dict[str, Any]]:  # fmt: skip
    """Of each variant's scene the rows that ``one`` makes (``measure_one``). They are kept in
    ``folder``, and made again where a scene, the case, the method, the grid or ``also`` (JSON) has
    changed. Raises InputError: a scene is missing or cannot be read."""
    about = {
        "case": store.sha256_of(case.folder / store.MANIFEST),
        "scenes": {variant: store.sha256_of(case.scene(variant, view)) for variant in variants},
        "method": {"name": method.name, "seed": method.seed, **method.identity},
        "grid": grid,
        **also,
    }
    one = one or measure_one

    def measure() -> list[dict[str, Any]]:
        known = {"case": case.name, "method": method.name, "seed": method.seed, "view": view}
        known |= {"grid": grid, **method.about}
        rows = []
        for variant in variants:
            made = one(case, method, variant, view, grid)
            rows += [{**known, "variant": variant, **_machine(), **row} for row in made]
        return rows

    make_folder(folder)
    name = f"{case.name}-{method.name}-{method.seed}-{view}-{one.__name__}.json"
    return trainings.kept(folder / name, about, measure)


def _machine() -> dict[str, Any]:
    import torch

    return {
        "on": f"{cpu_name()} (PyTorch on {torch.get_num_threads()})",
        "when": time.strftime("%Y-%m-%d", time.gmtime()),
        "load": round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None,
    }


def measure_one(
    case: StudyCase, method: Method, variant: str, view: str, grid: int
) -> list[dict[str, Any]]:
    """One scene: the protocol's metrics, errors at points, target errors; a row a part."""
    scene = read_scene(case.scene(variant, view))

    def locate(_: object) -> Estimate:
        return method.locate(scene, grid)

    entry, estimate = evaluate_scene(locate, scene, f"{variant}-{view}")
    points: dict[str, Any] = {}
    if estimate:
        clean = read_scene(case.scene(variant, CLEAN_VIEW))
        points = point_errors(scene.reference, case.anatomy_ct, _visible(clean), estimate.meshes)
    targets = entry.get("tre_mm")
    whole = {
        "miou": entry["miou"],
        "failed": not all(part["found"] for part in entry["parts"].values()),
        "target_mm": targets["mean"] if targets else None,
    }
    return [
        {**whole, "part": name, **(part if part["found"] else {}), **points.get(name, {})}
        for name, part in entry["parts"].items()
    ]


def _visible(scene: Scene) -> Float[np.ndarray, "n 3"]:
    """All that is seen of the organ, camera frame, mm."""
    if scene.depth is None:
        return scene.cloud.points_mm.astype(float)
    points = deproject(scene.depth).astype(float)
    return points[(points[:, 2] > _NEAR_MM) & (points[:, 2] < _FAR_MM)]


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
