"""What a fleet computes: tasks, each a pure function of its options and of other tasks' results.

A task's key is a hash of everything that its result depends on, so that no run, machine or user
computes a result that is already in the store.
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
    """What a step does, on one core. Importable by name, so that another process can do it.

    Arguments are the folders of its inputs by name, its options, and an empty folder to write into.
    The same inputs and options give the same files bit for bit, on any machine: no file states a
    time, a path or a host.

    Raises:
        TumortrackError: it cannot be done with these inputs, now or later; any other error may be
            the machine's, and the task is tried again.
    """

    def __call__(
        self, inputs: Mapping[str, Path], options: Mapping[str, Any], out: Path
    ) -> None: ...


@dataclass(frozen=True, eq=False)
class File:
    """A user's file or folder: where it is, and the sha256 of its content."""

    path: str
    key: str


@dataclass(frozen=True, eq=False)
class Task:
    """One step of one patient. ``version`` rises when a step's result changes; ``memory_mb``: what
    it takes while it runs."""

    patient: str
    step: str
    version: int
    work: Work
    options: Mapping[str, Any]  # of JSON's kinds
    inputs: Mapping[str, Task | File]
    memory_mb: int = 1500

    @cached_property
    def key(self) -> str:
        """sha256 of all that the result depends on; the patient's name is not part of it."""
        content = {
            "step": self.step,
            "version": self.version,
            "options": dict(self.options),
            "inputs": {name: source.key for name, source in sorted(self.inputs.items())},
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
