"""Solved states on disk: one file each, so that none is solved twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import ArtifactError
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Anatomy
from tumortrack_lab.twin.bench import State
from tumortrack_lab.twin.states import solve
from tumortrack_lab.twin.variants import EquilibriumState

# More compression goes on from less: the same answer in fewer load steps.
_GOES_ON_FROM = {"D2": "D1", "D3": "D2"}


class StateCache:
    """The states of one case in a folder; the bench is built when the first one is needed."""

    def __init__(
        self,
        folder: Path,
        anatomy_ct: Anatomy,
        targets_ct: Float64[np.ndarray, "n 3"],
        build: Callable[[], Any],
        solve: Callable[..., State] = solve,
    ) -> None:
        self._folder = folder
        self._anatomy_ct = anatomy_ct
        self._targets_ct = targets_ct
        self._build = build
        self._solver = solve
        self._bench: Any = None

    def has(self, state: str) -> bool:
        """Is it solved already?"""
        return self._path(state).exists()

    def get(self, state: str, say: Callable[[str], None]) -> EquilibriumState:
        """The state, solved and kept if it is not there yet; ``say`` hears of each load step.

        Raises:
            ArtifactError: its file is damaged.
            TumortrackError: there is no equilibrium.
            StorageError: the disk refused.
        """
        if not self.has(state):
            self._solve(state, say)
        tensors, about = self._read(state)
        parts = tuple(
            part.moved(tensors[name])
            for name, part in zip(self._anatomy_ct.names, self._anatomy_ct.parts, strict=True)
        )
        return EquilibriumState(
            state, Anatomy(parts), tensors["targets"], tensors["bench_from_ct"], about["report"]
        )

    def _solve(self, state: str, say: Callable[[str], None]) -> None:
        from safetensors.numpy import save

        if self._bench is None:
            say("bench: filling the organ with tetrahedra")
            self._bench = self._build()
        bench = self._bench
        mesh = _digest(bench.mesh.nodes_mm)
        warm = self._warm(state, mesh)
        solved = self._solver(bench, state, warm, lambda line: say(f"{state}: {line}"))
        tensors = {
            name: bench.carry(solved, part.vertices_mm)
            for name, part in zip(self._anatomy_ct.names, self._anatomy_ct.parts, strict=True)
        }
        tensors["targets"] = bench.carry(solved, self._targets_ct)
        tensors["bench_from_ct"] = bench.bench_from_ct
        tensors["nodes"] = solved.nodes_mm
        metadata = {"report": json.dumps(solved.report, allow_nan=False), "mesh": mesh}
        contiguous = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
        write_atomically(self._path(state), save(contiguous, metadata))

    def _warm(self, state: str, mesh: str) -> State | None:
        """The kept state to go on from, where it was solved on the same tetrahedra."""
        before = _GOES_ON_FROM.get(state)
        if before is None or not self.has(before):
            return None
        tensors, about = self._read(before)
        if about["mesh"] != mesh:
            return None
        return State(before, tensors["nodes"], about["report"])

    def _read(self, state: str) -> tuple[dict[str, np.ndarray], dict]:
        from safetensors import SafetensorError, safe_open

        path = self._path(state)
        try:
            with safe_open(path, framework="np") as file:
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                metadata = file.metadata() or {}
            about = {"report": json.loads(metadata["report"]), "mesh": metadata["mesh"]}
            for name in (*self._anatomy_ct.names, "targets", "bench_from_ct", "nodes"):
                tensors[name]
        except (SafetensorError, KeyError, ValueError, OSError) as error:
            raise ArtifactError(
                f"{path} is damaged: {error}. Remove it, and the state is solved again."
            ) from error
        return tensors, about

    def _path(self, state: str) -> Path:
        return self._folder / f"{state}.safetensors"


def _digest(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
