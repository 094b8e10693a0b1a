"""Peers by name, made ready for a case only when a cell of theirs has to be measured."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import tumortrack
from tumortrack.core import store
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack.evaluate.peers.base import Peer, estimate_of
from tumortrack.evaluate.study.measure import StudyCase
from tumortrack.evaluate.study.methods import Answer
from tumortrack.simulate.scene_folder import Scene


@dataclass(frozen=True)
class PeerKind:
    """How a peer is made: its class, its settings (None where it has none) and the packages
    that its answers depend on."""

    make: Callable[..., Any]
    config: Config | None = None
    packages: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PeerMethod:
    """A peer of one patient as a method. Its identity names settings, the peer's own source
    file by its sha256, and the versions of the packages it rests on."""

    name: str
    kind: PeerKind
    case: StudyCase
    device: str = "cpu"

    @cached_property
    def identity(self) -> dict:
        source = inspect.getsourcefile(self.kind.make)
        return {
            "kind": "peer",
            "name": self.name,
            "settings": to_builtins(self.kind.config) if self.kind.config else {},
            "code_sha256": store.sha256_of(Path(source)) if source else "",
            "versions": {package: version(package) for package in self.kind.packages},
            "tumortrack": tumortrack.__version__,
        }

    @cached_property
    def _peer(self) -> Peer:
        if self.kind.config is None:
            return self.kind.make(self._anatomy_ct)
        return self.kind.make(self._anatomy_ct, self.case.up_lps, self.kind.config)

    @property
    def _anatomy_ct(self) -> Anatomy:
        return self.case.anatomy_ct

    @property
    def prepare_s(self) -> float | None:
        return self._peer.prepare_s

    @property
    def about(self) -> dict:
        return {"prepare_s": self.prepare_s}

    def locate(self, scene: Scene, grid: int) -> Answer:
        fit = self._peer.fit(scene)
        estimate = estimate_of(fit, self._anatomy_ct, scene.cloud.stamp_ns, grid)
        return Answer(estimate, fit.seconds, fit.carry)


def peer_method(name: str, case: StudyCase) -> PeerMethod:
    """The peer with this name for a case.

    Raises:
        InputError: no such peer.
    """
    kinds = peer_kinds()
    if name not in kinds:
        raise InputError(f"peer {name!r} is unknown. Allowed: {', '.join(kinds)}.")
    return PeerMethod(name, kinds[name], case)


def peer_kinds() -> dict[str, PeerKind]:
    """Every peer there is."""
    from tumortrack.evaluate.peers.rigid import Rigid, RigidConfig
    from tumortrack.evaluate.peers.rigid_bound import RigidBound

    return {
        "rigid_bound": PeerKind(RigidBound),
        "rigid": PeerKind(Rigid, RigidConfig(), ("small_gicp",)),
        "rigid_any_rotation": PeerKind(Rigid, RigidConfig(orientation="unknown"), ("small_gicp",)),
    }
