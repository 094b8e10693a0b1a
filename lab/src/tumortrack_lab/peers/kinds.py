"""Peers by name: ours, and those of installed packages, which have entry points of the group
``tumortrack.peers`` that name a ``PeerKind``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import entry_points, version
from typing import Any

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack_lab.peers.base import Peer, Rigid, RigidBound, RigidFit
from tumortrack_lab.peers.elastic import ElasticPeer, ElasticPeerConfig
from tumortrack_lab.peers.pose_search import Direction, RigidConfig

GROUP = "tumortrack.peers"


@dataclass(frozen=True)
class PeerKind:
    """How a peer is made for a patient, and what its answers depend on."""

    # make(anatomy_ct, up_lps, config), or make(anatomy_ct, up_lps) without config, gives a Peer.
    make: Callable[..., Any]
    config: Config | None = None
    packages: tuple[str, ...] = ()  # distributions; an entry point's own is added

    @property
    def versions(self) -> dict[str, str]:
        return {package: version(package) for package in self.packages}

    def made_for(self, anatomy_ct: Anatomy, up_lps: Direction) -> Peer:
        """The peer, ready for a patient (anatomy in LPS, mm; the direction facing the camera)."""
        settings = () if self.config is None else (self.config,)
        return self.make(anatomy_ct, up_lps, *settings)


def peer_kinds() -> dict[str, PeerKind]:
    """Every peer there is. Raises InputError: an entry point that names no ``PeerKind``, or takes
    the name of a peer of ours."""
    kinds = {
        "rigid_bound": PeerKind(RigidBound),
        "rigid_fit": PeerKind(RigidFit),
        "rigid": PeerKind(Rigid, RigidConfig(), ("small_gicp",)),
        "elastic": PeerKind(ElasticPeer, ElasticPeerConfig(), ("pytetwild", "scipy", "small_gicp")),
    }
    ours = {*kinds}
    for point in entry_points(group=GROUP):
        kind, origin = point.load(), point.dist.name if point.dist else point.value
        if point.name in ours:
            raise InputError(
                f"peer {point.name!r} of {origin} has the name of one of ours; rename it."
            )
        if not isinstance(kind, PeerKind):
            raise InputError(f"peer {point.name!r}: {point.value} of {origin} is no PeerKind.")
        extra = (point.dist.name,) if point.dist else ()
        kinds[point.name] = replace(kind, packages=(*kind.packages, *extra))
    return kinds
