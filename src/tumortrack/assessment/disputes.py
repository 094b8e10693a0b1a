"""What contradicted an answer speaks against the next ones too, until it is acknowledged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tumortrack.core.estimate import Estimate
from tumortrack.core.report import EvidenceReport, Finding

_OUTVOTED = 3  # later pieces at that place that agree with the answer, and so with each other
_THERE_MM = 15.0  # from what the answer has there: how far apart touches of one spot may lie
_OF_A_MOMENT = "held", "free"  # they say it again in each frame, as long as it is so


@dataclass
class _Dispute:
    name: str
    off_mm: float
    part: str
    vertex: int  # of the part's surface, where the answer has it instead
    against: int = 0


class Disputes:
    """Of one tracked organ. Vertices move with the tissue, so places need no motion."""

    def __init__(self) -> None:
        self._open: list[_Dispute] = []

    def acknowledge(self) -> None:
        """The user has seen them all."""
        self._open = []

    def update(self, estimate: Estimate) -> Finding | None:
        """With the next answer: what still speaks against it."""
        lasting = [e for e in estimate.report.evidence if e.name not in _OF_A_MOMENT]
        new = [each for each in lasting if not each.before]
        for dispute in self._open:
            there_mm = _surface(estimate, dispute.part)[dispute.vertex]
            agree = (each for each in new if not each.left_out)
            dispute.against += sum(_nearest(each, there_mm[None])[0] <= _THERE_MM for each in agree)
        self._open = [one for one in self._open if one.against < _OUTVOTED]
        old = [each for each in lasting if each.before]
        wrong = sum(each.left_out for each in old) > len(old) / 2  # rather the answer than they
        for each in (*new, *(old if wrong else ())):
            if each.left_out:
                vertex = _nearest(each, _surface(estimate, each.part))[1]
                self._open.append(_Dispute(each.name, each.off_mm, each.part, vertex))
        if not self._open:
            return None
        last = self._open[-1]
        return Finding("disputed", {"name": last.name, "off_mm": last.off_mm})


def _surface(estimate: Estimate, part: str) -> np.ndarray:
    meshes = {**estimate.meshes, **estimate.structures}
    return meshes.get(part, estimate.organ_mesh).vertices_mm


def _nearest(piece: EvidenceReport, surface_mm: np.ndarray) -> tuple[float, int]:
    """The least distance of its places from these, and of which."""
    away_mm = np.linalg.norm(np.array(piece.places_mm)[:, None] - surface_mm, axis=2)
    return float(away_mm.min()), int(away_mm.min(0).argmin())
