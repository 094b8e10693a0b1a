"""Scenes that the package brings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from typing import Any

import msgspec
import numpy as np
from safetensors import safe_open
from safetensors.numpy import save

from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, DepthError, DepthFrame, Intrinsics, Mesh, SensorCloud
from tumortrack.io.depth_files import DEPTH_UNIT_MM
from tumortrack.io.evidence_files import EvidenceFile, evidence_json
from tumortrack.io.scene_folder import Scene, Targets

FILE = "phantom_scenes.safetensors"
SPACING_MM = (0.6, 0.6, 0.8)  # of the CT, ``scan_phantom(folder, 1, SPACING_MM)``
SCENES = 10
_STEP_MM = 0.001  # of displacements: what is apart at rest stays apart


def phantom_scenes(count: int = SCENES) -> dict[str, Scene]:
    """The first so many of ten scenes of the built-in phantom, by name: at rest, pressed, cut,
    sunk, poked, pulled, partly hidden, with and without touches.

    Finite elements deformed it, which share nothing with the elastic body of the default method,
    and another model of a stereo camera saw it. ``meta["words"]`` says what was done; ``evidence``
    has the touches. True surfaces have the triangles of the case that ``prepare`` makes of
    ``scan_phantom(folder, 1, (0.6, 0.6, 0.8))``, and are right to 0.001 mm. See docs/results.md.

    Raises:
        InputError: a count outside 1 to 10.
    """
    if not 1 <= count <= SCENES:
        raise InputError(f"the phantom has {SCENES} scenes, not {count}; allowed: 1 to {SCENES}.")
    file = resources.files("tumortrack.simulation").joinpath(FILE)
    with resources.as_file(file) as path, safe_open(path, framework="np") as kept:
        entries = json.loads(kept.metadata()["scenes"])
        arrays = {name: kept.get_tensor(name) for name in kept.keys()}  # noqa: SIM118
    return {name: _scene(entry, arrays) for name, entry in list(entries.items())[:count]}


def _scene(entry: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> Scene:
    error = DepthError(*entry["intrinsics"].pop("depth_error"))
    of, camera = entry["arrays"], Intrinsics(**entry["intrinsics"], depth_error=error)
    at_rest_mm = transform_points(np.array(entry["meta"]["camera_from_ct"]), arrays["rest_ct"])
    places_mm = at_rest_mm + arrays[f"{of}/moved"] * _STEP_MM
    *parts, targets_mm = np.split(places_mm, np.cumsum(entry["counts"]))
    faces = (arrays[f"faces/{n}"].astype(np.int32) for n in range(len(parts)))
    depth = arrays[f"{of}/depth"].astype(np.float32) * np.float32(DEPTH_UNIT_MM)
    depth[depth == 0] = np.nan
    evidence = from_builtins(entry["evidence"], EvidenceFile, FILE).evidence
    return Scene(
        SensorCloud(arrays[f"{of}/cloud"], depth_error=error),
        Anatomy(tuple(map(Mesh, parts, faces))),
        DepthFrame(depth, camera),
        entry["meta"],
        Targets(arrays["rest_ct"][-len(targets_mm) :].astype(float), targets_mm, arrays["labels"]),
        evidence,
    )


def packed(scenes: Mapping[str, Scene], anatomy_ct: Anatomy) -> bytes:
    """What ``phantom_scenes`` reads, of scenes whose surfaces have the triangles of ``anatomy_ct``
    and whose targets are the same points. Those that share a cloud share all but evidence and
    ``meta``, which states ``camera_from_ct``."""
    entries, arrays = dict[str, Any](), dict[str, np.ndarray]()
    rest = np.concatenate([part.vertices_mm for part in anatomy_ct.parts])
    for name, scene in scenes.items():
        assert scene.depth is not None
        assert scene.targets is not None
        of = next(n for n, other in scenes.items() if other.cloud is scene.cloud)
        parts = [part.vertices_mm for part in scene.reference.parts]
        places_mm = np.concatenate([*parts, scene.targets.points_mm])
        rest_ct = np.concatenate([rest, scene.targets.points_ct]).astype(np.float32)
        moved_mm = places_mm - transform_points(np.array(scene.meta["camera_from_ct"]), rest_ct)
        assert np.abs(moved_mm).max() < _STEP_MM * np.iinfo(np.int16).max
        entries[name] = {
            "arrays": of,
            "counts": [len(part) for part in parts],
            "intrinsics": asdict(scene.depth.intrinsics),
            "meta": scene.meta,
            "evidence": msgspec.json.decode(evidence_json(scene.evidence)),
        }
        steps = np.rint(np.nan_to_num(scene.depth.depth_mm.astype(float)) / DEPTH_UNIT_MM)
        arrays |= {
            f"{of}/moved": np.rint(moved_mm / _STEP_MM).astype(np.int16),
            f"{of}/depth": steps.astype(np.uint16),
            f"{of}/cloud": scene.cloud.points_mm,
        }
        faces = {f"faces/{n}": part.faces for n, part in enumerate(scene.reference.parts)}
        arrays |= {key: each.astype(np.uint16) for key, each in faces.items()}
        arrays |= {"rest_ct": rest_ct, "labels": scene.targets.labels}
    ordered = {name: np.ascontiguousarray(each) for name, each in arrays.items()}
    return save(ordered, {"scenes": json.dumps(entries)})
