"""What a fleet computes: tasks, each a pure function of its options and of other tasks' results.

A task's key is a hash of all that decides its result, so that what lies in the store under that key
is never computed again, by whichever run, machine or user.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Work(Protocol):
    """What a step does. Importable by name, so that another process can do it.

    Given the folders of its inputs by name, its options, a folder to write into (empty, there
    already) and its number of cores. The same inputs and options give the same files to the last
    bit, on any number of machines: nothing written states a time, a path or a host.

    Raises:
        TumortrackError: it cannot be done with these inputs, and never will be; any other error may
            be the machine's, and the task is tried again.
    """

    def __call__(
        self, inputs: Mapping[str, Path], options: Mapping[str, Any], out: Path, cores: int
    ) -> None: ...


@dataclass(frozen=True)
class Needs:
    """What a task takes while it runs."""

    cores: int = 1
    memory_mb: int = 1500
    gpus: float = 0.0


@dataclass(frozen=True, eq=False)
class File:
    """A user's file or folder: where it is, and the sha256 of its content."""

    path: str
    sha256: str

    @property
    def key(self) -> str:
        return self.sha256


@dataclass(frozen=True, eq=False)
class Task:
    """One step of one patient. ``version`` rises when a step's result changes."""

    patient: str
    step: str
    version: int
    work: Work
    options: Mapping[str, Any]  # of JSON's kinds
    inputs: Mapping[str, Task | File]
    needs: Needs = Needs()

    @cached_property
    def key(self) -> str:
        """sha256 of all that decides the result; the patient's name does not."""
        content = {
            "step": self.step,
            "version": self.version,
            "options": dict(self.options),
            "inputs": {name: one.key for name, one in sorted(self.inputs.items())},
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
