"""The kinds of networks, by their configuration."""

from __future__ import annotations

from tumortrack.occupancy.network import NetworkConfig, OccupancyNetwork
from tumortrack.registration.network import RegistrationNetwork

Network = OccupancyNetwork | RegistrationNetwork


def network_of(config: NetworkConfig) -> Network:
    """A network with weights from torch's global generator (``torch.manual_seed``)."""
    return RegistrationNetwork(config) if config.warps else OccupancyNetwork(config)
