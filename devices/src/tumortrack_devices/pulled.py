"""Where the vertices of a case go while a tool pulls at it: states that were solved beforehand
(``make pull``), and what lies between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import PchipInterpolator

from tumortrack.core import store
from tumortrack.core.errors import ArtifactError


@dataclass(frozen=True, eq=False)
class PulledStates:
    """``pulls_mm`` rise from 0. ``moved_mm``: by how much each has moved the vertices of all parts,
    one part after the other, from rest; CT frame. ``case_sha256``: of the case's manifest."""

    case_sha256: str
    pulls_mm: Float64[np.ndarray, " k"]
    moved_mm: Float64[np.ndarray, "k n 3"]

    def at(self, pull_mm: float) -> Float64[np.ndarray, "n 3"]:
        """Of a pull between the states; beyond them as of the last one."""
        low_mm, high_mm = float(self.pulls_mm[0]), float(self.pulls_mm[-1])
        return np.asarray(self._between(min(max(pull_mm, low_mm), high_mm)), np.float64)

    @cached_property
    def _between(self) -> PchipInterpolator:
        return PchipInterpolator(self.pulls_mm, self.moved_mm)

    def write(self, path: Path) -> None:
        """Raises StorageError: the disk refused."""
        from safetensors.numpy import save

        arrays = {"pulls_mm": self.pulls_mm, "moved_mm": self.moved_mm}
        store.write_atomically(path, save(arrays, metadata={"case_sha256": self.case_sha256}))

    @classmethod
    def read(cls, path: Path) -> PulledStates:
        """Raises ArtifactError: there are none in it."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, "np") as file:
                arrays = {name: file.get_tensor(name) for name in ("pulls_mm", "moved_mm")}
                read = cls(str((file.metadata() or {})["case_sha256"]), **arrays)
        except (OSError, SafetensorError, KeyError) as error:
            raise ArtifactError(
                f"{path} holds no states of a pulled organ ({error}); make them with: make pull."
            ) from error
        pulls_mm, shape = read.pulls_mm, read.moved_mm.shape
        rising = len(pulls_mm) > 1 and pulls_mm[0] == 0 and (np.diff(pulls_mm) > 0).all()
        if not (rising and len(shape) == 3 and shape[0] == len(pulls_mm) and shape[2] == 3):
            raise ArtifactError(f"{path}: its pulls do not rise from 0, each with a state.")
        return read
