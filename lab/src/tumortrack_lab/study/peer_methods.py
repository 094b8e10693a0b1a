"""Peers by name, made ready for a case only when a cell of theirs has to be measured."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import tumortrack
from tumortrack.core import store
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import OneWay
from tumortrack.core.types import Anatomy
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import estimate_of
from tumortrack_lab.study.measure import StudyCase
from tumortrack_lab.study.methods import Answer, Method


@dataclass(frozen=True)
class PeerKind:
    """How a peer is made: its class, its settings (None where it has none), and the packages and
    the outside program that its answers depend on."""

    make: Callable[..., Any]
    config: Config | None = None
    packages: tuple[str, ...] = ()
    program_sha256: str | None = None


@dataclass(frozen=True, eq=False)
class PeerMethod(Method):
    """A peer of one patient as a method. Its identity names its settings, the peers' code by its
    sha256, and the versions of the packages it rests on."""

    name: str
    kind: PeerKind
    case: StudyCase
    device: str = "cpu"

    @cached_property
    def identity(self) -> dict:
        settings = to_builtins(self.kind.config) if self.kind.config else {}
        if self.kind.program_sha256:
            settings["program"] = self.kind.program_sha256  # wherever it lies
        return {
            "kind": "peer",
            "name": self.name,
            "settings": settings,
            "code_sha256": peers_code_sha256(),
            "versions": {package: version(package) for package in self.kind.packages},
            "tumortrack": tumortrack.__version__,
        }

    @cached_property
    def _peer(self) -> Any:  # a Peer
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
        return Answer(replace(estimate, motion=OneWay(fit.carry)), fit.seconds)


@cache
def peers_code_sha256() -> str:
    """Of all peers' code."""
    return code_sha256(sorted((Path(__file__).parent.parent / "peers").glob("*.py")))


def code_sha256(paths: Iterable[Path]) -> str:
    """Of files of code without comments and docstrings: after a change of what they do, it is
    measured anew; after a change of words it is not."""
    digest = hashlib.sha256()
    for path in paths:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
                node
            ):
                node.body = node.body[1:]
        digest.update(f"{path.name}\0{ast.dump(tree)}\n".encode())
    return digest.hexdigest()


def peer_method(name: str, case: StudyCase, bcpd: Path | None = None) -> PeerMethod:
    """The peer with this name for a case; ``bcpd`` is the built program of that peer.

    Raises:
        InputError: no such peer, or no program for ``bcpd``.
    """
    kinds = peer_kinds(bcpd)
    if name not in kinds:
        raise InputError(f"peer {name!r} is unknown. Allowed: {', '.join(kinds)}.")
    return PeerMethod(name, kinds[name], case)


def peer_kinds(bcpd: Path | None = None) -> dict[str, PeerKind]:
    """Every peer there is; ``bcpd`` only with its program.

    Raises:
        InputError: the program does not exist.
    """
    from tumortrack_lab.peers.bcpd import Bcpd, BcpdConfig
    from tumortrack_lab.peers.cpd import Cpd, CpdConfig
    from tumortrack_lab.peers.elastic import ElasticPeer, ElasticPeerConfig
    from tumortrack_lab.peers.rigid import Rigid, RigidConfig
    from tumortrack_lab.peers.rigid_bound import RigidBound

    kinds = {
        "rigid_bound": PeerKind(RigidBound),
        "rigid": PeerKind(Rigid, RigidConfig(), ("small_gicp",)),
        "rigid_any_rotation": PeerKind(Rigid, RigidConfig(orientation="unknown"), ("small_gicp",)),
        "cpd": PeerKind(Cpd, CpdConfig(), ("pycpd", "small_gicp")),
        "elastic": PeerKind(ElasticPeer, ElasticPeerConfig(), ("pytetwild", "scipy", "small_gicp")),
    }
    if bcpd is not None:
        if not bcpd.is_file():
            raise InputError(f"{bcpd} does not exist; give the built program of BCPD, or none.")
        program = PeerKind(
            Bcpd, BcpdConfig(program=str(bcpd)), ("small_gicp",), store.sha256_of(bcpd)
        )
        kinds["bcpd"] = program
    return kinds
