"""A `quick` or `paper` model: the network, and the arithmetic that is fastest here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tumortrack.models.config import NetworkConfig
from tumortrack.models.folder import WEIGHTS
from tumortrack.models.model import Model
from tumortrack.occupancy.compiled import find
from tumortrack.occupancy.inference import Arithmetic
from tumortrack.occupancy.network import OccupancyNetwork


@dataclass(frozen=True, eq=False, kw_only=True)
class OccupancyModel(Model):
    """See ``Model``; ``arithmetic`` is what `tumortrack compile` found fastest on this machine."""

    network: OccupancyNetwork
    arithmetic: Arithmetic | None = None

    @classmethod
    def new_network(cls, config: NetworkConfig) -> OccupancyNetwork:
        return OccupancyNetwork(config)

    @classmethod
    def from_folder(cls, folder: Path, manifest: dict[str, Any], **common: Any) -> OccupancyModel:
        if next(common["network"].parameters()).device.type != "cpu":
            return cls(**common)
        arithmetic, note = find(folder, str(manifest["files"][WEIGHTS]))
        return cls(arithmetic=arithmetic, notes=() if note is None else (note,), **common)
