"""Whether a folder holds a model; without PyTorch, whose import takes a second."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tumortrack.core import store
from tumortrack.core.errors import ArtifactError

KIND = "model"
SHAPE = "shape.safetensors"
WEIGHTS = "weights.safetensors"


def is_finished(folder: Path) -> bool:
    """Whether the folder holds a finished model (rather than a training under way)."""
    return (folder / store.MANIFEST).is_file()


def read_model_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a finished model; ArtifactError for no model, a training that has not ended,
    another schema, a file missing or changed."""
    if not is_finished(folder) and (folder / "training").is_dir():
        raise ArtifactError(
            f"{folder} holds a training that has not ended. Run the same `tumortrack train` "
            "command again to go on with it."
        )
    return store.read_manifest(folder, KIND)


def has_shape(manifest: dict[str, Any]) -> bool:
    """Whether the model knows the organ's shape, and so which point of the CT lies where."""
    return SHAPE in manifest["files"]
