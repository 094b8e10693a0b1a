"""Pretrained weights as a folder, and as a start for a patient's own training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from tumortrack.core import store
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.models.config import NetworkConfig, RegistrationHeadConfig
from tumortrack.models.normalisation import Aligned
from tumortrack.training.model import model_class

KIND = "pretrained"
_WEIGHTS = "weights.safetensors"


@dataclass(frozen=True, eq=False)
class HeadStart:
    """Weights of a network that knows organs in general; ``sha256`` names them."""

    sha256: str
    config: NetworkConfig
    weights: dict[str, torch.Tensor]

    def check(self, network: NetworkConfig) -> None:
        """Refuse a network that these weights do not fit.

        Raises:
            InputError: another kind of network, or other sizes.
        """
        if not isinstance(network.decoder, RegistrationHeadConfig):
            raise InputError("--start is for the preset clinic; quick and paper have none.")
        if _shared(self.config) != _shared(network):
            raise InputError(
                "--start: these weights are of another network than the preset's (encoder, width "
                "or reach differ). Pretrain again with this version: tumortrack pretrain OUT."
            )


def _shared(config: NetworkConfig) -> tuple:
    """What must be the same for weights to fit; modes, points and size are the patient's."""
    normalisation = config.normalisation
    reach = normalisation.reach if isinstance(normalisation, Aligned) else None
    return config.encoder, getattr(config.decoder, "width", None), reach


def save_start(
    network: torch.nn.Module, config: NetworkConfig, provenance: dict, folder: Path
) -> None:
    """Write weights and manifest into an existing folder, the manifest last."""
    weights = {k: v.detach().cpu().contiguous() for k, v in network.state_dict().items()}
    store.write_atomically(folder / _WEIGHTS, save(weights))
    content = {"provenance": provenance, "config": to_builtins(config)}
    store.seal(folder, KIND, content, frame="camera")


def load_start(folder: Path) -> HeadStart:
    """Read a folder that `pretrain` wrote.

    Raises:
        ArtifactError: missing, another kind, damaged, or not of this version.
    """
    manifest = store.read_manifest(folder, KIND)
    try:
        config = from_builtins(manifest["config"], NetworkConfig, f"{folder}: config")
        weights = load((folder / _WEIGHTS).read_bytes())
        model_class(config).new_network(config).load_state_dict(weights)
    except (InputError, KeyError, RuntimeError, SafetensorError, OSError) as error:
        raise ArtifactError(
            f"{folder} holds no whole pretrained weights of this version: {error}. Make them "
            "again: tumortrack pretrain OUT."
        ) from error
    return HeadStart(store.sha256_of(folder / _WEIGHTS), config, weights)
