"""Peers by name, made ready for a case only when a cell of theirs has to be measured."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import tumortrack
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import OneWay
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import Peer, estimate_of
from tumortrack_lab.peers.kinds import PeerKind, peer_kinds
from tumortrack_lab.study.measure import StudyCase
from tumortrack_lab.study.methods import Answer, Method


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
            "versions": self.kind.versions,
            "tumortrack": tumortrack.__version__,
        }

    @cached_property
    def _peer(self) -> Peer:
        return self.kind.made_for(self.case.anatomy_ct, self.case.up_lps)

    @property
    def prepare_s(self) -> float | None:
        return self._peer.prepare_s

    @property
    def about(self) -> dict:
        return {"prepare_s": self.prepare_s}

    def locate(self, scene: Scene, grid: int) -> Answer:
        fit = self._peer.fit(scene)
        estimate = estimate_of(fit, self.case.anatomy_ct, scene.cloud.stamp_ns, grid)
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
