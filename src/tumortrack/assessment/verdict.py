"""What an estimate is worth, the same for files and live frames: its assessment.

``judged`` bounds it and finds it good, or poor for a stated reason; ``assessed`` completes the
answer that is given: causes, advice, what to learn next.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import msgspec
import numpy as np

from tumortrack.assessment.advice import next_evidence
from tumortrack.assessment.bound import POOR_MM, bounds_of, depths_within_mm
from tumortrack.assessment.causes import KnownCauses, explained
from tumortrack.assessment.sight import Sight, sight_of
from tumortrack.core.assessment import Assessment, ErrorBound, deciding
from tumortrack.core.errors import NotThisOrgan
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import FREE, MOMENTARY
from tumortrack.core.report import (
    EvidenceReport,
    Finding,
    FitReport,
    Kind,
    Likely,
    NextEvidence,
    ViewsReport,
)
from tumortrack.core.types import Anatomy, View
from tumortrack.io.model_folder import reliability_warning
from tumortrack.registration.base_model import Model
from tumortrack.registration.in_distribution import FIT_FACTOR, RIVAL_COST
from tumortrack.registration.model import RegistrationModel
from tumortrack.simulation.noise import CAMERA_STD

# Where no bound is known: largest standard deviation of a tumor's centre, and largest
# distance to it in another fit that is nearly as likely.
_MAX_UNCERTAINTY_MM = 3.0
# What these limits rest on: docs/decisions/034-limits.md. Shares of the organ's image that are seen
# through: doubtful, impossible; without a motion surfaces are rougher.
_LIMITS, _ROUGH_LIMITS = (0.05, 0.09), (0.1, 0.2)
# The doubt about an earlier estimate stays if less than this share of what was in sight then is in
# sight now, unless the organ moved by more than this from one frame to the next.
_AS_MUCH, _MOVED_MM = 0.9, 10.0
# If the camera sees the surroundings in more than this share of a rim round the organ, most wrong
# places are seen through. The fit is then judged without outliers, and may cost ``FIT_FACTOR``
# times the usual cost.
_RIM_SHARE = 0.5
_MAX_OUTLIERS = 0.5  # share of the points: the breakdown point of robust estimates
_MAX_CAMERA_ERROR = 3.0  # standard deviations of a camera's pose
_FAR_TILTED, _UPSIDE_DOWN = 60.0, 110.0  # degrees
_MIN_PROBABILITY = 0.6  # mean over a tumor's points
# Pieces of evidence: of earlier frames; of this one, that agree, also for each that does not.
_FEW, _MANY, _FOR_EACH = 3, 8, 5
_MAX_UNSEEN = 0.1  # share of the organ's image without points of a cloud
# Of a flap's near side: where it was taken for the organ's surroundings, points showed 13 and
# 15 % of where it would have been, else a third or more. Tools hold it so near to its tumor.
_LEAST_OF_FLAP, _ON_FLAP_MM = 0.25, 10.0
_OUTVOTED = 3  # later pieces at that place that agree with the answer, and so with each other
_THERE_MM = 15.0  # from what the answer has there: how far apart touches of one spot may lie
Advise = Literal["all", "touches", "nothing"]


def judged(
    estimate: Estimate,
    views: Sequence[View],
    strictly: bool = False,
    factor: float = 1.0,
    last: Estimate | None = None,
) -> Estimate:
    """The estimate with its bounds and the finding that makes it poor, if any, and in its report
    the shares of the organ that are seen through, in sight and, of a cloud, not seen.

    An estimate is poor if it fits the points worse than usual in validation, if the camera sees
    through it, if it lies where a cloud has no points, if it lacks a tumor, or if a tumor's place
    is uncertain; good means only that none of these holds. Raises NotThisOrgan: a depth image sees
    through so much of it that the organ cannot be there. Clouds never raise it: they may be joined
    from several views.

    Args:
        views: of the organ; of each share, the worst counts.
        strictly: the fit must be no worse than usual, whatever the camera sees round the organ.
        factor: by which the bounds are multiplied.
        last: of the frame before; a doubt about it may last.
    """
    start_s, sight = time.perf_counter(), sight_of(estimate, views)
    doubtful, impossible = _LIMITS if estimate.motion is not None else _ROUGH_LIMITS
    if sight.by_depth > impossible:
        raise NotThisOrgan(Finding("organ_seen_through", {"percent": 100 * sight.by_depth}))
    report = estimate.report
    if sight.unseen is not None:
        report = msgspec.structs.replace(report, unseen=sight.unseen)
    bounds = bounds_of(report, factor)
    finding = finding_of(report, bounds, sight, doubtful, strictly)
    doubted = (sight.in_sight or 0.0) if sight.through > doubtful else None
    if doubted is None and last is not None and _still_hidden(estimate, sight, last):
        doubted = last.report.doubted_in_sight
        finding = finding or Finding("hidden_now")
    report = msgspec.structs.replace(
        report,
        seen_through=sight.through,
        in_sight=sight.in_sight,
        doubted_in_sight=doubted,
        timings=_timed(report, "judge", start_s),
    )
    assessment = Assessment(bounds=bounds, factor=factor, finding=finding)
    return replace(estimate, report=report, assessment=assessment)


def assessed(
    estimate: Estimate,
    views: Sequence[View],
    model: Model,
    known: KnownCauses = MappingProxyType({}),
    advise: Advise = "nothing",
    part: int | None = None,
) -> Estimate:
    """A judged estimate with whose it is, the causes if it is poor, and what to learn next.

    Args:
        known: causes of frames before, which are not searched for again.
        advise: what advice is made of.
        part: the number of the one that it is for; None: the tumor that is least sure.
    """
    start_s, report, said = time.perf_counter(), estimate.report, estimate.assessment
    finding, causes, advice = said.finding, tuple[Likely, ...](), ""
    if weakness := reliability_warning(model.provenance):
        finding = Finding("model", {"message": weakness})
    elif finding is not None:
        causes, advice = explained(model, views, estimate, known)
    pays = tuple[NextEvidence, ...]()
    if isinstance(model, RegistrationModel) and advise != "nothing":
        pays = next_evidence(estimate, part, model.config.refine, advise == "touches")
    return replace(
        estimate,
        assessment=msgspec.structs.replace(
            said, finding=finding, causes=causes, advice=advice, next_evidence=pays
        ),
        report=msgspec.structs.replace(report, timings=_timed(report, "explain", start_s)),
        patient=model.patient,
        organ=model.organ,
    )


def _timed(report: FitReport, stage: str, start_s: float) -> dict[str, float]:
    """The report's timings with those of a stage that ends now."""
    took_s, timings = time.perf_counter() - start_s, report.timings
    all_s, total_s = took_s + timings.get(stage, 0.0), took_s + timings.get("total", 0.0)
    return {**timings, stage: all_s, "total": total_s}


def _still_hidden(estimate: Estimate, sight: Sight, last: Estimate) -> bool:
    """Whether the camera saw through the ``last`` one at the same place and sees less of it now:
    what hides the organ since then is no evidence that it is there."""
    if last.report.doubted_in_sight is None:
        return False
    in_sight = 1.0 if sight.in_sight is None else sight.in_sight
    moved_mm = np.abs(estimate.organ_mesh.box_mm - last.organ_mesh.box_mm).max()
    return bool(in_sight < _AS_MUCH * last.report.doubted_in_sight and moved_mm <= _MOVED_MM)


def finding_of(
    report: FitReport,
    bounds: Mapping[str, ErrorBound],
    sight: Sight,
    doubtful: float = _LIMITS[0],
    strictly: bool = False,
) -> Finding | None:
    """What makes an estimate poor; None: nothing does. ``doubtful``: share that is seen through."""
    if sight.through > doubtful:
        return Finding("seen_through", {"percent": 100 * sight.through})
    finding = _misplaced_camera(report.views)
    finding = finding or _misfit(report, sight.rim > _RIM_SHARE and not strictly)
    finding = finding or _unseen_flap(report) or _doubt(report, bounds)
    unseen = sight.unseen or 0.0
    if finding is None and unseen > _MAX_UNSEEN and not _deciding(report, bounds):
        return Finding("unseen", {"percent": 100 * unseen})
    return finding


def _unseen_flap(report: FitReport) -> Finding | None:
    """Whether hardly anything is seen of a flap where it would be, nor known by a tool: it may have
    been lifted out of what is taken for the organ."""
    for name, seen in ({} if report.cut is None else report.cut.flaps).items():
        part = report.parts[name]
        if seen >= _LEAST_OF_FLAP or part.center_mm is None or part.box_mm is None:
            continue
        reach_mm = float(np.ptp(np.array(part.box_mm), axis=0).max()) / 2 + _ON_FLAP_MM
        places = [each.places_mm for each in report.evidence
                  if not each.rejected and each.name != FREE]  # fmt: skip
        away_mm = [np.linalg.norm(np.array(p) - part.center_mm, axis=1).min() for p in places]
        if min(away_mm, default=np.inf) > reach_mm:
            return Finding("flap", {"part": name, "percent": 100 * seen})
    return None


def _misplaced_camera(views: ViewsReport | None) -> Finding | None:
    """Whether a camera was found too far from its stated pose."""
    if views is None:
        return None
    most_mm, most_rad = _MAX_CAMERA_ERROR * CAMERA_STD[0], _MAX_CAMERA_ERROR * CAMERA_STD[-1]
    errors = zip(views.shift_mm, views.turn_degrees, strict=True)
    for view, (shift_mm, degrees) in enumerate(errors, start=1):
        if shift_mm > most_mm or degrees > np.rad2deg(most_rad):
            return Finding("poses", {"view": view, "shift_mm": shift_mm, "degrees": degrees})
    return None


def _misfit(report: FitReport, surroundings_seen: bool) -> Finding | None:
    """Too many outliers, or too high a cost. ``surroundings_seen``: a wrong place is seen
    through."""
    cost = report.fit_cost
    if cost is None:
        return None
    if surroundings_seen and cost.outliers > _MAX_OUTLIERS:
        return Finding("outliers", {"percent": 100 * cost.outliers})
    now, factor = (cost.without_outliers, FIT_FACTOR) if surroundings_seen else (cost.now, 1.0)
    if now > factor * cost.usual:
        times = now / cost.usual
        return Finding("fit", {"times": times, "digits": _telling(times, factor)})
    return None


def _doubt(report: FitReport, bounds: Mapping[str, ErrorBound]) -> Finding | None:
    """Another size or pose as likely; a part that is missing, or a tumor that may be far off."""
    size, cost = report.size, report.fit_cost
    if size is not None and size.gain > RIVAL_COST:
        return Finding("size", {"times": size.times})
    if cost is not None and cost.excluded_pose is not None:
        degrees = cost.excluded_pose.tilt_degrees
        turned: Kind = "tilted" if degrees > _FAR_TILTED else "not_turned"
        kind: Kind = "upside_down" if degrees > _UPSIDE_DOWN else turned
        return Finding(kind, {"degrees": degrees})
    if (finding := _contradiction(report.evidence)) is not None:
        return finding
    for name, part in report.parts.items():
        if not part.found:
            return Finding("missing", {"part": name})
    if not (deciding := _deciding(report, bounds)):
        return _unsure(report)
    bound_mm, name = max((each.error_bound95_mm, name) for name, each in deciding.items())
    if not bound_mm > POOR_MM:
        return None
    depth_mm = depths_within_mm(report, name)
    if 2 * depth_mm**2 > bound_mm**2:  # most of it
        return Finding("depths", {"depth_mm": depth_mm})
    about: dict[str, float | str | None] = {"part": name, "digits": _telling(bound_mm, POOR_MM)}
    return Finding("miss", {**about, "error_bound95_mm": bound_mm, "limit_mm": POOR_MM})


def _contradiction(evidence: Sequence[EvidenceReport]) -> Finding | None:
    """Evidence that was left out and decides: of earlier frames most of it, as the answer is rather
    wrong; of this one what a tool holds, or more than many that agree outvote."""
    old = [each.rejected for each in evidence if each.before]
    out = [not each.before and each.rejected for each in evidence]
    agree = len(evidence) - len(old) - sum(out)
    outvoted = agree >= max(_MANY, _FOR_EACH * sum(out))
    most_old = len(old) >= _FEW and sum(old) > len(old) / 2
    wrong = [
        (each.off_mm, number, each.name)
        for number, each in enumerate(evidence, start=1)
        if each.rejected and (most_old if each.before else not outvoted or each.name == "grasp")
    ]
    if not wrong:
        return None
    off_mm, number, name = max(wrong)  # as causes.py names it
    return Finding("evidence", {"name": name, "number": number, "off_mm": off_mm})


def _telling(value: float, limit: float) -> str:
    """As many decimals as tell a value from the limit that it exceeds."""
    return next((n for n in "123" if round(value, int(n)) > limit), "4")


def _deciding(report: FitReport, bounds: Mapping[str, ErrorBound]) -> Mapping[str, ErrorBound]:
    """The bounds by which an answer is judged: all tumors', or of an organ without tumors its own;
    empty if one is not known."""
    known = deciding(bounds)
    return known if known.keys() >= {*(report.tumors or report.parts)} else {}


def _unsure(report: FitReport) -> Finding | None:
    """Another fit that is as likely, or an uncertain part."""
    for other in () if report.fit_cost is None else report.fit_cost.others:
        name, distance_mm = max(other.distance_mm.items(), key=lambda item: item[1])
        if distance_mm > _MAX_UNCERTAINTY_MM:
            return Finding("alternative", {"part": name, "distance_mm": distance_mm})
    for name, part in report.parts.items():
        if part.center_std_mm is not None and part.center_std_mm > _MAX_UNCERTAINTY_MM:
            return Finding("unsure", {"part": name, "std_mm": part.center_std_mm})
        if part.probability is not None and part.probability < _MIN_PROBABILITY:
            return Finding("improbable", {"part": name, "probability": part.probability})
    return None


@dataclass
class _Dispute:
    name: str
    off_mm: float
    part: str
    vertex: int  # of the part's surface, where the answer has it instead
    against: int = 0


class Disputes:
    """What contradicted an answer of one tracked organ speaks against the next ones too, until it
    is acknowledged. Vertices move with the tissue, so places need no motion."""

    def __init__(self) -> None:
        self._open: list[_Dispute] = []

    def acknowledge(self) -> None:
        """The user has seen them all."""
        self._open = []

    def carry_over(self, before: Anatomy | None, now: Anatomy | None) -> None:
        """The organ has another surface from now on, as more was cut of it."""
        if before is None or now is None:
            return
        for dispute in self._open:
            was, is_now = (each.closed.get(dispute.part, each.organ) for each in (before, now))
            there_ct = was.vertices_mm[dispute.vertex]
            away_mm = np.linalg.norm(is_now.vertices_mm - there_ct, axis=1)
            dispute.vertex = int(away_mm.argmin())

    def update(self, estimate: Estimate) -> Finding | None:
        """With the next answer: what still speaks against it."""
        lasting = [e for e in estimate.report.evidence if e.name not in MOMENTARY]
        new = [each for each in lasting if not each.before]
        for dispute in self._open:
            there_mm = _surface(estimate, dispute.part)[dispute.vertex]
            agree = (each for each in new if not each.rejected)
            dispute.against += sum(_nearest(each, there_mm[None])[0] <= _THERE_MM for each in agree)
        self._open = [one for one in self._open if one.against < _OUTVOTED]
        old = [each for each in lasting if each.before]
        wrong = sum(each.rejected for each in old) > len(old) / 2  # rather the answer than they
        for each in (*new, *(old if wrong else ())):
            if each.rejected:
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
