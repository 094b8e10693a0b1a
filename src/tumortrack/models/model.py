"""A trained model as a value: what both methods have in common, and what each of them adds."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor, nn

from tumortrack.core.organ import Organ, organ_in
from tumortrack.core.patient import Patient, patient_in
from tumortrack.models.config import TrainConfig
from tumortrack.models.in_distribution import InDistributionRange
from tumortrack.models.margins import ModelMargins

_OPSET = 18  # of ONNX files


# What to trace for an ONNX file, on which inputs, and the names for ``torch.onnx.export``.
OnnxParts = tuple[nn.Module, tuple[Tensor, ...], dict[str, Any]]


class Network(nn.Module):
    """A network that can be trained and exported."""

    def loss(self, *scenes: Tensor, first: int = 0) -> Tensor:
        """What a batch costs: clouds (B, N, 3), the scenes' points (B, P, 3) with their labels
        (B, P), poses (B, 4, 4); camera frame, mm. ``first``: the first cloud's number in a batch
        that is split over several processes."""
        raise NotImplementedError

    def onnx_parts(self, cloud_mm: Tensor) -> OnnxParts:
        """The parts of a file for clouds like this one, (1, N, 3)."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """A network in evaluation mode and what it was trained for. ``query_box_mm``: where the organ
    can lie (lower and upper corner), relative to the median of the observed points, camera frame;
    ``provenance``: seeds, steps, hashes; ``margins``: None where it was not calibrated."""

    # From a NetworkConfig, with weights from torch's global generator (``torch.manual_seed``).
    new_network: ClassVar[type[Network]]

    network: Network
    config: TrainConfig
    parts: tuple[str, ...]
    query_box_mm: Float64[np.ndarray, "2 3"]
    in_distribution: InDistributionRange
    provenance: dict[str, Any] = field(default_factory=dict)
    margins: ModelMargins | None = None

    @property
    def patient(self) -> Patient:
        """Whose organ it was trained for, as far as it is known."""
        return patient_in(self.provenance.get("patient"), "provenance")

    @property
    def organ(self) -> Organ:
        """Which organ it was trained for."""
        return organ_in(self.provenance.get("organ"), "provenance")

    def extra_files(self) -> dict[str, bytes]:
        """Files of a model folder besides the weights, by name."""
        return {}

    def extra_entries(self) -> dict[str, Any]:
        """Entries of the manifest that only this kind has."""
        return {"trust": None}

    @classmethod
    def from_folder(cls: type[M], folder: Path, manifest: dict[str, Any], **known: Any) -> M:
        """The model of a folder whose fields ``known`` are read already; InputError, KeyError,
        ValueError or OSError where the folder lacks something."""
        return cls(**known)


M = TypeVar("M", bound=Model)


def onnx_bytes(model: Model) -> bytes:
    """A model's network as an ONNX file, in single precision, for other programs. Farthest points
    and balls are written out in plain operators; the number of queries is free, the number of
    points is the one that the model was trained with (repeat the points of a smaller cloud).
    Occupancy networks: ``cloud_mm`` (1, N, 3) and ``queries_mm`` (1, Q, 3) -> ``logits`` (1, Q,
    classes). Networks that place the organ: ``cloud_mm`` -> ``rotation`` (2, 3, 3), ``centre_mm``
    (2, 3), ``coefficients`` (2, M), ``right_way`` (2,). Camera frame, mm, float32."""
    points, generator = model.config.scene.cloud.n_points, torch.Generator().manual_seed(0)
    cloud = torch.randn(1, points, 3, generator=generator) * 20 + torch.tensor([0.0, 0.0, 130.0])
    module, inputs, names = model.network.onnx_parts(cloud)
    content: Any = io.BytesIO()  # the annotation lacks files, which work as well
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shapes are constants here: on purpose
        torch.onnx.export(module, inputs, content, dynamo=False, opset_version=_OPSET, **names)
    return content.getvalue()
