"""The margins that a model states: calibrated radii, the limits within which they hold, and what
they were calibrated on."""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from tumortrack.assessment.verdict import cloud_shares
from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.organ import is_tumor
from tumortrack.core.report import Finding, FitReport, MarginReport, StatedMargin
from tumortrack.core.types import SensorCloud
from tumortrack.sense.cloud import FEWEST_POINTS
from tumortrack.tracking.fingerprint import fingerprint

NAME = "margins.json"
Kind = Literal["tumor", "organ", "map"]
_WHAT = {"tumor": "a tumor's surface", "organ": "the organ's surface", "map": "mapped points"}
UNKNOWN = "the model was not calibrated (tumortrack margins)"


class Radius(Config, frozen=True):
    """A radius: ``scaled`` times a part's size, or ``constant_mm`` for any size; ``used`` is the
    one with the smaller mean over the states it was chosen on. The size is ``offset_mm`` + s +
    ``bend_mm`` times the square root of the elastic state's rarity, where s (mm) is the largest
    estimated standard deviation over the surface: the more an organ is bent, the less a library of
    states says about it. ``scaled`` is None if the method knows no s."""

    used: Literal["scaled", "constant"]
    constant_mm: float
    scaled: float | None = None
    offset_mm: float = 0.0
    bend_mm: float = 0.0

    def __post_init__(self) -> None:
        limits = (0, 1000)
        self.check_between("margins:", constant_mm=limits, offset_mm=limits, bend_mm=limits)
        if self.scaled is not None:
            self.check_between("margins:", scaled=(0, 1e6))
        elif self.used == "scaled":
            raise InputError("margins: a scaled radius needs its factor.")

    def size_mm(self, std_mm: float, figures: dict[str, float]) -> float:
        """``figures``: of the estimate (``measured``); without rarity the size is unbounded."""
        bending = math.sqrt(figures.get("rarity", math.inf)) if self.bend_mm else 0.0
        return self.offset_mm + std_mm + self.bend_mm * bending

    def at(self, std_mm: float | None, figures: dict[str, float]) -> float | None:
        """mm; None if it depends on a standard deviation that is not known."""
        if self.used == "constant":
            return self.constant_mm
        assert self.scaled is not None
        return None if std_mm is None else self.scaled * self.size_mm(std_mm, figures)


class Shells(Config, frozen=True):
    """The radii at one ``confidence``: of tumors, of the organ's surface and of mapped points."""

    confidence: float
    radii: dict[Kind, Radius]

    def __post_init__(self) -> None:
        self.check_between("margins:", confidence=(0.5, 0.99))


class Group(Config, frozen=True):
    """Numbers of states of one family, visible share and organ: all, with a good estimate, accepted
    by the limits, and of the accepted ones those that tested the limits and calibrated the radii.
    """

    label: tuple[str, str, str]
    states: int
    good: int
    accepted: int
    tested: int
    calibrated: int


class ModelMargins(Config, frozen=True):
    """A model's margins, and what they were calibrated on.

    Attributes:
        model_sha256: of the model's manifest.
        table_sha256: of the calibration's results, scene by scene.
        limits: of ``measured`` figures; an estimate has a margin only if it exceeds none. They are
            chosen so that few accepted estimates err by more than ``widest_mm`` (``risk_bound``).
        shells: by rising confidence.
        groups: what was calibrated on, as given; ``joined``: small group -> the larger group whose
            results count for it.
        risk_bound: upper bound, with 95 % confidence, of the share of accepted answers outside the
            widest margin of a tumor, in the worst group of the tested states.
        accepted, missed: shares of all tested states: accepted; accepted and outside the margin.
        evidence: the kinds beside the cloud that they hold with, and least numbers of pieces.
        others: with other evidence.
    """

    fingerprint: str
    tumortrack: str
    model_sha256: str
    table_sha256: str
    seed: int
    widest_mm: float
    limits: dict[str, float]
    shells: tuple[Shells, ...]
    groups: tuple[Group, ...]
    joined: dict[str, str]
    risk_bound: float
    accepted: float
    missed: float
    evidence: dict[str, int] = msgspec.field(default_factory=dict)
    others: tuple[ModelMargins, ...] = ()

    def __post_init__(self) -> None:
        if not self.shells or not all(map(math.isfinite, self.limits.values())):
            raise InputError("margins: no radii, or limits that are no numbers.")


def write_sealed(path: Path, margins: ModelMargins) -> None:
    """Write a file for ``read_sealed``, atomically. Raises StorageError."""
    content = to_builtins(margins)
    store.write_json(path, {"sha256": _digest(content), "margins": content})


def read_margins(folder: Path) -> ModelMargins | None:
    """A model's margins, if it has any. Raises ArtifactError: they were changed, or belong to
    another model or another version of the method."""
    path = folder / NAME
    if not path.exists():
        return None
    margins = read_sealed(path)
    if margins.model_sha256 != store.sha256_of(folder / store.MANIFEST):
        raise ArtifactError(f"{path} is of another model, or this one was changed. {_AGAIN}")
    return margins


def read_sealed(path: Path) -> ModelMargins:
    """``read_margins`` of a file, without checking which model it belongs to."""
    stored = store.read_json(path)
    content = stored.get("margins")
    if not isinstance(content, dict) or stored.get("sha256") != _digest(content):
        raise ArtifactError(f"{path} was changed after it was written. {_AGAIN}")
    if content.get("fingerprint") != fingerprint():
        raise ArtifactError(
            f"{path} was calibrated with a version of the method whose estimates differ "
            f"({content.get('fingerprint', 'an older one')}; this is {fingerprint()}). {_AGAIN}"
        )
    try:
        return from_builtins(content, ModelMargins, str(path))
    except InputError as error:
        raise ArtifactError(f"{error} {_AGAIN}") from error


_AGAIN = "Calibrate again (tumortrack margins MODEL SCENES), or remove the file."


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def measured(report: FitReport) -> dict[str, float]:
    """The figures of an estimate that have limits; larger is worse."""
    deviations = [part.surface_std_mm for part in report.tumors.values()]
    known, cost = [std_mm for std_mm in deviations if std_mm is not None], report.fit_cost
    values = {
        "fit_cost": None if cost is None else cost.now / cost.usual,
        "rarity": None if report.motion is None else report.motion.rarity,
        "unseen": report.unseen,
        "seen_through": report.seen_through,
        "unsure_mm": max(known, default=None),
    }
    return {name: float(value) for name, value in values.items() if value is not None}


def figures(report: FitReport, margins: ModelMargins) -> dict[str, float]:
    """``measured``, and the largest size of a tumor (``Radius``)."""
    deviations = [part.surface_std_mm for part in report.tumors.values()]
    return sized(measured(report), deviations, margins.shells[-1].radii["tumor"])


def sized(
    figures: dict[str, float], deviations: Sequence[float | None], radius: Radius
) -> dict[str, float]:
    """The figures with ``size_mm``, the largest of a tumor; unchanged if the radius has no size."""
    known = [std_mm for std_mm in deviations if std_mm is not None]
    if radius.scaled is None or len(known) < len(deviations):
        return figures
    return {**figures, "size_mm": max(radius.size_mm(std_mm, figures) for std_mm in known)}


def given_evidence(report: FitReport) -> dict[str, int]:
    """How many pieces of each kind of this moment an estimate was given; of outlines, how many each
    tumor has. Those left out count: calibrations have false ones, too, and many make it poor."""
    pieces = [each for each in report.evidence if not each.before]
    given = dict(Counter(each.name for each in pieces))
    if "outline" in given:
        outlined = Counter(each.part for each in pieces if each.name == "outline")
        given["outline"] = min((outlined[name] for name in report.tumors), default=0)
    return given


def evidence_words(evidence: dict[str, int]) -> str:
    """As `tumortrack margins --evidence` takes it."""
    return "+".join(f"{name}{number}" for name, number in sorted(evidence.items()))


def margins_with(report: FitReport, margins: ModelMargins) -> ModelMargins | None:
    """Those of an estimate's evidence: of the same kinds, and of the most pieces that it has."""
    given = given_evidence(report)
    every = [each for each in (margins, *margins.others) if each.evidence.keys() == given.keys()]
    held = [each for each in every if all(n <= given[name] for name, n in each.evidence.items())]
    return max(held, key=lambda each: sum(each.evidence.values()), default=None)


def exceeded(limits: dict[str, float], figures: dict[str, float]) -> Finding | None:
    """The first limit that is exceeded."""
    for name, limit in limits.items():
        if not (value := figures.get(name, math.inf)) <= limit:
            return Finding("beyond_margins", {"figure": name, "value": value, "limit": limit})
    return None


def stated_margin(report: FitReport, margins: ModelMargins | None, good: bool) -> MarginReport:
    """The margins stated with an estimate, or why there are none. ``good``: no check failed, and
    no limit is exceeded."""
    if report.looks is not None:
        return MarginReport(reason="margins are of single views, not of several")
    if 0 < report.points < FEWEST_POINTS:
        return MarginReport(reason="margins are of clouds, not of touches alone")
    if margins is None:
        return MarginReport(reason=UNKNOWN)
    if any(each.before and not each.left_out for each in report.evidence):
        return MarginReport(reason="margins are of evidence of this moment, not of earlier frames")
    if (margins := margins_with(report, margins)) is None:
        evidence = given_evidence(report)
        if not all(evidence.values()):
            return MarginReport(reason="margins are of outlines of every tumor, not of some")
        how = f"tumortrack margins MODEL SCENES --evidence {(name := evidence_words(evidence))}"
        return MarginReport(reason=f"margins with {name} were not calibrated ({how})")
    if not good:
        return MarginReport(reason="a poor estimate has no margin")
    if report.smoothing is not None and report.smoothing.time_s > 0:
        return MarginReport(reason="margins are of single clouds, not of smoothed motions")
    parts, figures, stated = report.parts, measured(report), list[StatedMargin]()
    kinds: dict[str, Kind] = {name: "tumor" for name in parts}
    kinds |= {next(iter(parts)): "organ", "map": "map"}
    deviations = {name: part.surface_std_mm for name, part in parts.items()}
    deviations["map"] = next(iter(deviations.values()))
    for shells in margins.shells:
        radii = {
            name: shells.radii[kind].at(deviations[name], figures)
            for name, kind in kinds.items()
            if kind in shells.radii
        }
        known = {name: radius for name, radius in radii.items() if radius is not None}
        stated.append(StatedMargin(confidence=shells.confidence, mm=known))
    return MarginReport(stated=tuple(stated))


def with_margin(estimate: Estimate, cloud: SensorCloud, margins: ModelMargins | None) -> Estimate:
    """The estimate with its model's ``margins`` in its report; poor if it exceeds a limit within
    which they hold. ``cloud``: in which it was located."""
    if margins is not None and estimate.finding is None:
        if estimate.report.unseen is None:
            estimate = estimate.reporting(unseen=cloud_shares(estimate.organ_mesh, cloud)[1])
        known = margins_with(estimate.report, margins) or margins  # others: limits of clouds alone
        finding = exceeded(known.limits, figures(estimate.report, known))
        estimate = estimate.assessed(finding=finding)
    margin = stated_margin(estimate.report, margins, estimate.finding is None)
    return estimate.reporting(margin=margin)


class StatedRadius(msgspec.Struct, frozen=True):
    """A radius that holds with this confidence, mm."""

    confidence: float
    mm: float

    @property
    def words(self) -> str:
        return f"{100 * self.confidence:g} % margin {self.mm:.1f} mm"


def stated_radius(
    margin: MarginReport | None, name: str, confidence: float | None = None
) -> StatedRadius | None:
    """The radius of a part or of ``map``, with this or else the highest confidence, if stated."""
    for stated in reversed(() if margin is None else margin.stated):
        if confidence in (None, stated.confidence) and name in stated.mm:
            return StatedRadius(stated.confidence, stated.mm[name])
    return None


def margin_words(margin: MarginReport | None) -> str:
    """The tumors' margins, or why there are none."""
    if margin is None or not margin.stated:
        return f"no margin: {UNKNOWN if margin is None else margin.reason}"
    highest = margin.stated[-1]
    sizes = ", ".join(f"{name} {mm:.1f} mm" for name, mm in highest.mm.items() if is_tumor(name))
    return f"{100 * highest.confidence:g} % margin: {sizes}"


def keep_margins(folder: Path, margins: ModelMargins) -> Path:
    """Store them as the margins of the model in this folder. Raises StorageError."""
    digest = store.sha256_of(folder / store.MANIFEST)
    write_sealed(folder / NAME, msgspec.structs.replace(margins, model_sha256=digest))
    return folder / NAME


def described(margins: ModelMargins) -> list[str]:
    """Lines for the screen: radii, what they were calibrated on, and the limits."""
    lines = []
    for shells in margins.shells:
        for kind, radius in shells.radii.items():
            size = f"{radius.constant_mm:.1f} mm"
            if radius.used == "scaled":
                size = f"{radius.offset_mm:g} mm + largest deviation"
                if radius.bend_mm:
                    size += f" + {radius.bend_mm:g} mm x root of rarity"
                size = f"{radius.scaled:.2f} x ({size})"
            lines.append(f"{100 * shells.confidence:g} % margin of {_WHAT[kind]}: {size}")
    lines += [
        f"{', '.join(group.label)} (family, visible share, organ): {group.states} states, "
        f"{group.good} good, {group.accepted} with an answer: {group.tested} to test limits, "
        f"{group.calibrated} to find margins"
        for group in margins.groups
    ]
    lines += [
        f"{small} has too few of them: {large} counts instead"
        for small, large in margins.joined.items()
    ]
    limits = ", ".join(f"{name} {limit:.3g}" for name, limit in margins.limits.items())
    lines += [
        f"no answer where one of these is exceeded: {limits}",
        f"of all states {100 * margins.accepted:.0f} % have an answer, "
        f"{100 * margins.missed:.1f} % one that is outside the widest margin; of the worst group's "
        f"answers these are no more than {100 * margins.risk_bound:.1f} %, with 95 % confidence",
    ]
    for each in margins.others:
        lines += [f"with {evidence_words(each.evidence)} or more beside the cloud:"]
        lines += described(each)
    return lines
