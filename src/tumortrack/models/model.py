"""A trained model as a value: what both methods share, and what each of them adds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64
from torch import Tensor, nn

from tumortrack.models.config import NetworkConfig, TrainConfig
from tumortrack.models.in_distribution import InDistributionRange


class Network(nn.Module):
    """A network as training sees it."""

    def loss(
        self,
        clouds_mm: Tensor,
        points_mm: Tensor,
        labels: Tensor,
        camera_from_ct: Tensor,
        *,
        first: int = 0,
    ) -> Tensor:
        """What a batch costs: clouds (B, N, 3), the scenes' points (B, P, 3) with their labels
        (B, P), poses (B, 4, 4); camera frame, mm. ``first``: the first cloud's number in a batch
        that several processes share."""
        raise NotImplementedError

    def onnx_parts(self, cloud_mm: Tensor) -> tuple[nn.Module, tuple[Tensor, ...], dict[str, Any]]:
        """What to trace for an ONNX file, on which inputs, and ``torch.onnx.export``'s names."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class Model(ABC):
    """A network in evaluation mode and what it was trained for.

    Attributes:
        query_box_mm: where the organ can lie, relative to the median of the observed points,
            camera frame (lower and upper corner).
        familiar: what tells clouds of this organ from others.
        provenance: seeds, steps, hashes.
        notes: for the user, about this machine.
    """

    network: Network
    config: TrainConfig
    parts: tuple[str, ...]
    query_box_mm: Float64[np.ndarray, "2 3"]
    familiar: InDistributionRange
    provenance: dict = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @classmethod
    @abstractmethod
    def new_network(cls, config: NetworkConfig) -> Network:
        """A network with weights from torch's global generator (``torch.manual_seed``)."""

    def extra_files(self) -> dict[str, bytes]:
        """Files of a model folder besides the weights, by name."""
        return {}

    def extra_entries(self) -> dict[str, Any]:
        """Entries of the manifest that only this kind has."""
        return {"trust": None}

    @classmethod
    @abstractmethod
    def from_folder(cls: type[M], folder: Path, manifest: dict, **common: Any) -> M:
        """The model of a folder whose fields ``common`` are read already.

        Raises:
            InputError, KeyError, ValueError, OSError: the folder lacks something.
        """


M = TypeVar("M", bound=Model)
