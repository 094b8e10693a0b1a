"""A `quick` or `paper` model."""

from __future__ import annotations

from dataclasses import dataclass

from tumortrack.models.model import Model
from tumortrack.occupancy.network import OccupancyNetwork


@dataclass(frozen=True, eq=False, kw_only=True)
class OccupancyModel(Model):
    """See ``Model``."""

    new_network = OccupancyNetwork

    network: OccupancyNetwork
