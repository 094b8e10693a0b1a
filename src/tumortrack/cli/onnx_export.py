"""`tumortrack onnx`: a model's network for other programs."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.models.folder import read_model_manifest


def write_onnx(folder: Path, out: Path, overwrite: bool) -> None:
    """Write OUT.onnx.

    Raises:
        InputError: OUT exists or is named otherwise; the package onnx is not installed.
        ArtifactError: no model.
        StorageError: the disk refused.
    """
    if out.suffix != ".onnx":
        raise InputError(f"{out} must end in .onnx.")
    if out.exists() and not overwrite:
        raise InputError(f"{out} exists already. Choose another file, or give --overwrite.")
    if not out.parent.is_dir():
        raise InputError(f"{out.parent} is no folder; make it first.")
    read_model_manifest(folder)
    if find_spec("onnx") is None:  # so far said before PyTorch's seconds
        raise InputError("writing ONNX needs the package onnx: pip install 'tumortrack[onnx]'.")

    from tumortrack.models.onnx_file import onnx_bytes
    from tumortrack.training.model import load_model

    model = load_model(folder, "cpu")
    content = onnx_bytes(model)
    store.write_atomically(out, content)
    points = model.config.scene.cloud.n_points
    say(f"written to {out} ({len(content) / 2**20:.1f} MB): clouds of {points} points, mm.")
