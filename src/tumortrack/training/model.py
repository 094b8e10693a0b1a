"""A trained network as a folder: weights.safetensors and a manifest with all it depends on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays
from safetensors.torch import load, save

from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.models.config import TrainConfig
from tumortrack.models.in_distribution import InDistributionRange
from tumortrack.occupancy.compiled import Arithmetic, find
from tumortrack.registration.rest_shape import RestShape
from tumortrack.training.model_folder import KIND, SHAPE, WEIGHTS, read_model_manifest
from tumortrack.training.networks import Network, network_of


class UncertaintyCalibration(Config, frozen=True):
    """What validation taught of a warp's own figures: its standard deviations are to be multiplied
    by ``std_scale``; a fit that costs more than ``usual_cost`` is tried from other starts."""

    std_scale: float
    usual_cost: float


@dataclass(frozen=True, eq=False)
class Model:
    """A network in evaluation mode and what it was trained for.

    ``query_box_mm``: where the organ can lie, relative to the median of the observed points,
    camera frame (lower and upper corner). ``familiar``: what tells its clouds from others.
    ``provenance``: seeds, steps, hashes. A warp also has the organ's ``shape``, and ``trust``.
    ``arithmetic``: what `tumortrack compile` found fastest here; ``notes`` say what it did not.
    """

    network: Network
    config: TrainConfig
    parts: tuple[str, ...]
    query_box_mm: Float64[np.ndarray, "2 3"]
    familiar: InDistributionRange
    provenance: dict
    shape: RestShape | None = None
    trust: UncertaintyCalibration | None = None
    arithmetic: Arithmetic | None = None
    notes: tuple[str, ...] = ()


def save_model(model: Model, folder: Path) -> None:
    """Write weights and manifest into an existing folder, the manifest last."""
    weights = {k: v.contiguous() for k, v in model.network.state_dict().items()}
    store.write_atomically(folder / WEIGHTS, save(weights))
    if model.shape is not None:
        store.write_atomically(folder / SHAPE, save_arrays(model.shape.to_arrays()))
    content = {
        "parts": list(model.parts),
        "trust": None if model.trust is None else to_builtins(model.trust),
        "query_box_mm": model.query_box_mm.tolist(),
        "familiar": to_builtins(model.familiar),
        "provenance": model.provenance,
        "config": to_builtins(model.config),
    }
    store.seal(folder, KIND, content, frame="camera")


def load_model(folder: Path, device: str = "auto") -> Model:
    """Read a model folder.

    Raises:
        ArtifactError: missing, of another schema, damaged, or weights changed since training.
        InputError: CUDA asked for where there is none.
    """
    manifest = read_model_manifest(folder)
    try:
        config = from_builtins(manifest["config"], TrainConfig, f"{folder}: config")
        parts = tuple(manifest["parts"])
        box = np.array(manifest["query_box_mm"], float).reshape(2, 3)
        network = network_of(config.network)
        network.load_state_dict(load((folder / WEIGHTS).read_bytes()))
        weights_sha256 = str(manifest["files"][WEIGHTS])
        familiar = from_builtins(manifest["familiar"], InDistributionRange, f"{folder}: familiar")
        provenance = dict(manifest["provenance"])
        shape, trust = None, None
        if config.network.warps:
            shape = RestShape.from_arrays(load_arrays((folder / SHAPE).read_bytes()), len(parts))
            trust = from_builtins(manifest["trust"], UncertaintyCalibration, f"{folder}: trust")
    except InputError as error:
        raise ArtifactError(
            f"{error} The model was trained by another version of tumortrack; train it again."
        ) from error
    except (KeyError, TypeError, ValueError, RuntimeError, OSError) as error:
        raise ArtifactError(
            f"{folder} is not a whole model of this version: {error}. Train it again."
        ) from error
    where = choose_device(device)
    network.eval().requires_grad_(False).to(where)
    arithmetic, note = None, None
    if where.type == "cpu" and not config.network.warps:
        arithmetic, note = find(folder, weights_sha256)
    notes = () if note is None else (note,)
    return Model(network, config, parts, box, familiar, provenance, shape, trust, arithmetic, notes)


def choose_device(device: str) -> torch.device:
    """``auto`` takes CUDA where it is.

    Raises:
        InputError: ``cuda`` asked for, none there.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch sees no CUDA GPU here. Use --device cpu or auto.")
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(device)


def has_fast_bfloat16(device: torch.device) -> bool:
    """Whether bf16 matrix products run in hardware, and so pay."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capability = torch.cpu.get_capabilities()
    return bool(capability.get("avx512_bf16") or capability.get("amx_bf16"))
