"""The factor by which a model's error bounds are multiplied, found on scenes of known truth."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError

NAME = "bound_factor.json"
_AGAIN = "Remove the file; then calibrate again: tumortrack margins CASE SCENES."


class BoundFactor(Config, frozen=True):
    """``answers``: of so many good ones, 95 % lie within ``factor`` times their bounds.
    ``model_sha256``: of the model's manifest; ``table_sha256``: of the answers, scene by scene."""

    factor: float
    answers: int
    seed: int
    model_sha256: str
    table_sha256: str
    fingerprint: str
    tumortrack: str

    def __post_init__(self) -> None:
        self.check_between(f"{NAME}:", factor=(0.01, 100))

    @property
    def message(self) -> str:
        return (
            f"on {self.answers} scenes of known truth the bounds hold for 95 % when multiplied by "
            f"{self.factor:.2f}"
        )


def write_factor(path: Path, found: BoundFactor) -> None:
    content = to_builtins(found)
    store.write_json(path, {"sha256": _digest(content), "bound_factor": content})


def read_factor(folder: Path) -> BoundFactor | None:
    """A model's factor, if it has one. Raises ArtifactError: the file was changed, or is of another
    model or another version of the method."""
    path = folder / NAME
    if not path.exists():
        return None
    found = read_sealed(path)
    if found.model_sha256 != store.sha256_of(folder / store.MANIFEST):
        raise ArtifactError(f"{path} is of another model, or this one was changed. {_AGAIN}")
    if found.fingerprint != fingerprint():
        raise ArtifactError(
            f"{path} was found with a version of the method whose estimates differ "
            f"({found.fingerprint}; this is {fingerprint()}). {_AGAIN}"
        )
    return found


def read_sealed(path: Path) -> BoundFactor:
    """The same of a file, without checking what it belongs to."""
    stored = store.read_json(path)
    content = stored.get("bound_factor")
    if not isinstance(content, dict) or stored.get("sha256") != _digest(content):
        raise ArtifactError(f"{path} was changed after it was written. {_AGAIN}")
    try:
        return from_builtins(content, BoundFactor, str(path))
    except InputError as error:
        raise ArtifactError(f"{error} {_AGAIN}") from error


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
