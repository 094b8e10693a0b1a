"""Measurements: one method on one scene under one fault, measured once and kept as one JSON file.

A file's name holds the hash of everything that decides its numbers (case, scene, fault, method,
grid), so that a study that was killed goes on where it stopped, and a measurement made from other
inputs is never taken for this one.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import tumortrack
from tumortrack.core import store
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import StorageError
from tumortrack_lab.bench.machine import cpu_name

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


class MeasurementStore:
    """The folder of all measurements: CASE/METHOD/SCENE-FAULT-GRID-DIGEST.json."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, spec: MeasurementSpec) -> Path:
        method = f"{spec.method['name']}-{spec.method.get('seed', 0)}"
        file = f"{spec.scene}-{spec.fault}-{spec.grid}-{spec.digest[:16]}.json"
        return self.folder / spec.case / method / file

    def read(self, spec: MeasurementSpec) -> dict | None:
        """What was measured with exactly this specification; None where nothing was.

        Raises:
            ArtifactError: its file is damaged.
        """
        path = self.path(spec)
        if not path.exists():
            return None
        measurement = store.read_json(path)
        return measurement if measurement.get("spec") == to_builtins(spec) else None

    def write(self, spec: MeasurementSpec, measured: dict) -> dict:
        """Keep a measurement, in one step.

        Raises:
            StorageError: the disk refused.
        """
        path = self.path(spec)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot write {path.parent}: {error.strerror}.") from error
        measurement = {"spec": to_builtins(spec), **measured}
        store.write_json(path, measurement)
        return measurement


def provenance(device: str) -> dict:
    """Where and by what something is measured; ``load`` is how busy the machine was."""
    import torch

    return {
        "tumortrack": tumortrack.__version__,
        "device": device,
        "cpu": cpu_name(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0,
        "threads": torch.get_num_threads(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
    }
