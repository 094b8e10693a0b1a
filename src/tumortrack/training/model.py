"""Model folders: weights.safetensors and a manifest with all that the weights depend on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from safetensors.torch import load, save

from tumortrack.core import store
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.models.config import (
    MlpDecoderConfig,
    NetworkConfig,
    RegistrationHeadConfig,
    TrainConfig,
)
from tumortrack.models.folder import KIND, WEIGHTS, read_model_manifest
from tumortrack.models.hardware import choose_device
from tumortrack.models.in_distribution import InDistributionRange
from tumortrack.models.model import Model
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.registration.model import RegistrationModel

_KINDS: dict[type, type[Model]] = {
    MlpDecoderConfig: OccupancyModel,
    RegistrationHeadConfig: RegistrationModel,
}


def model_class(config: NetworkConfig) -> type[Model]:
    """The kind of model that a network's configuration makes."""
    return _KINDS[type(config.decoder)]


def save_model(model: Model, folder: Path) -> None:
    """Write weights and manifest into an existing folder, the manifest last."""
    weights = {k: v.contiguous() for k, v in model.network.state_dict().items()}
    for name, data in {WEIGHTS: save(weights), **model.extra_files()}.items():
        store.write_atomically(folder / name, data)
    content = {
        "parts": list(model.parts),
        **model.extra_entries(),
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
    where = choose_device(device)
    try:
        config = from_builtins(manifest["config"], TrainConfig, f"{folder}: config")
        kind = model_class(config.network)
        network = kind.new_network(config.network)
        network.load_state_dict(load((folder / WEIGHTS).read_bytes()))
        return kind.from_folder(
            folder,
            manifest,
            network=network.eval().requires_grad_(False).to(where),
            config=config,
            parts=tuple(manifest["parts"]),
            query_box_mm=np.array(manifest["query_box_mm"], float).reshape(2, 3),
            familiar=from_builtins(
                manifest["familiar"], InDistributionRange, f"{folder}: familiar"
            ),
            provenance=dict(manifest["provenance"]),
        )
    except InputError as error:
        raise ArtifactError(
            f"{error} The model was trained by another version of tumortrack; train it again."
        ) from error
    except (KeyError, TypeError, ValueError, RuntimeError, OSError) as error:
        raise ArtifactError(
            f"{folder} is not a whole model of this version: {error}. Train it again."
        ) from error
