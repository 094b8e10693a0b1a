"""Folders of models and of pretrained weights: weights.safetensors and a manifest with all that
the weights depend on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.torch import load, save
from torch import Tensor, nn

from tumortrack.core import store
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError, PackageError
from tumortrack.core.organ import Organ
from tumortrack.core.types import part_names
from tumortrack.models.config import NetworkConfig, RegistrationHeadConfig, TrainConfig
from tumortrack.models.folder import KIND, WEIGHTS, organ_of, read_model_manifest, read_tensors
from tumortrack.models.hardware import choose_device
from tumortrack.models.in_distribution import InDistributionRange
from tumortrack.models.margins import read_margins
from tumortrack.models.model import Model, Network
from tumortrack.models.normalisation import Aligned
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.registration.model import RegistrationModel

PRETRAINED = "pretrained"  # kind of a folder
SHIPPED = Path(__file__).parents[1] / "models" / "kidneys"  # weights that are the package's own
_LARGEST_BOX_MM = 1000.0


def model_class(config: NetworkConfig) -> type[Model]:
    """The kind of model that a network's configuration makes."""
    registers = isinstance(config.decoder, RegistrationHeadConfig)
    return RegistrationModel if registers else OccupancyModel


def save_model(model: Model, folder: Path) -> None:
    """Write weights and manifest into an existing folder, the manifest last."""
    for name, data in {WEIGHTS: _weights(model.network), **model.extra_files()}.items():
        store.write_atomically(folder / name, data)
    content = {
        "parts": list(model.parts),
        **model.extra_entries(),
        "query_box_mm": model.query_box_mm.tolist(),
        "familiar": to_builtins(model.in_distribution),
        "provenance": model.provenance,
        "config": to_builtins(model.config),
    }
    store.seal(folder, KIND, content, frame="camera")


def load_model(folder: Path, device: str = "auto", with_margins: bool = True) -> Model:
    """Read a model folder.

    Args:
        with_margins: and its margins, where it was calibrated.

    Raises:
        ArtifactError: missing, of another schema, damaged, or weights changed since training; its
            margins are another model's, or of another version of the method.
        InputError: CUDA is requested where there is none.
    """
    manifest = read_model_manifest(folder)
    where = choose_device(device)
    try:
        config = from_builtins(manifest["config"], TrainConfig, f"{folder}: config")
        kind = model_class(config.network)
        network = _filled(kind, config.network, read_tensors(folder / WEIGHTS, load))
        known = from_builtins(manifest["familiar"], InDistributionRange, f"{folder}: familiar")
        model = kind.from_folder(
            folder,
            manifest,
            network=network.eval().requires_grad_(False).to(where),
            config=config,
            parts=_parts(manifest["parts"], organ_of(manifest, folder)),
            query_box_mm=_query_box(manifest["query_box_mm"]),
            in_distribution=known,
            provenance=dict(manifest["provenance"]),
            margins=read_margins(folder) if with_margins else None,
        )
        model.patient  # noqa: B018 - nonsense is told here
        return model
    except (ArtifactError, PackageError):
        raise
    except InputError as error:
        raise ArtifactError(
            f"{error} The model was trained by another version of tumortrack, or with a package "
            "that is not installed here. Install that package, or train the model again."
        ) from error
    except (KeyError, TypeError, ValueError, RuntimeError, OSError) as error:
        raise ArtifactError(
            f"{folder} is not a whole model of this version: {error}. Train it again."
        ) from error


def _filled(kind: type[Model], config: NetworkConfig, weights: dict[str, Tensor]) -> Network:
    """The network with these weights; RuntimeError for others."""
    network = kind.new_network(config)
    network.load_state_dict(weights)
    return network


def _parts(stated: list[str], organ: Organ) -> tuple[str, ...]:
    if not stated or tuple(stated) != part_names(len(stated), organ.name):
        raise InputError(f"parts {stated} are not {organ.name}, tumor_1, tumor_2, ...")
    return tuple(stated)


def _query_box(stated: list[list[float]]) -> np.ndarray:
    box_mm = np.array(stated, float).reshape(2, 3)
    if not ((box_mm[0] < box_mm[1]).all() and (np.abs(box_mm) < _LARGEST_BOX_MM).all()):
        raise InputError(f"query_box_mm {stated} is not a box about an organ.")
    return box_mm


def _weights(network: nn.Module) -> bytes:
    return save({k: v.detach().cpu().contiguous() for k, v in network.state_dict().items()})


@dataclass(frozen=True, eq=False)
class PretrainedWeights:
    """Weights of a network for organs in general; ``sha256`` names them."""

    sha256: str
    config: NetworkConfig
    weights: dict[str, Tensor]

    def check(self, network: NetworkConfig) -> None:
        """Refuse a network of another kind or other sizes, by InputError."""
        if not isinstance(network.decoder, RegistrationHeadConfig):
            raise InputError("--start is for the preset clinic; quick and paper have none.")
        if _shared(self.config) != _shared(network):
            raise InputError(
                "--start: these weights are of another network than the preset's (encoder, width "
                "or reach differ). Pretrain again with this version: tumortrack pretrain OUT."
            )


def _shared(config: NetworkConfig) -> tuple[Any, ...]:
    """What must be the same for weights to fit; modes, points and size are the patient's."""
    normalisation = config.normalisation
    reach = normalisation.reach if isinstance(normalisation, Aligned) else None
    return config.encoder, getattr(config.decoder, "width", None), reach


def load_start(folder: Path) -> PretrainedWeights:
    """Read a folder that `pretrain` wrote; one that is missing, of another kind, damaged or not of
    this version raises ArtifactError."""
    manifest = store.read_manifest(folder, PRETRAINED)
    try:
        config = from_builtins(manifest["config"], NetworkConfig, f"{folder}: config")
        weights = {k: v.float() for k, v in read_tensors(folder / WEIGHTS, load).items()}
        _filled(model_class(config), config, weights)
    except (InputError, KeyError, ValueError, RuntimeError, OSError) as error:
        raise ArtifactError(
            f"{folder} holds no whole pretrained weights of this version: {error}. Make them "
            "again: tumortrack pretrain OUT."
        ) from error
    return PretrainedWeights(store.sha256_of(folder / WEIGHTS), config, weights)


def start_of(network: NetworkConfig, folder: Path | None) -> PretrainedWeights | None:
    """The weights that a training starts from: those of ``folder``, which may be ``none``; of None
    the package's own where the network places an organ."""
    if folder is None and model_class(network) is not RegistrationModel:
        return None
    return None if str(folder) == "none" else load_start(folder or SHIPPED)
