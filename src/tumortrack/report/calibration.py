"""Calibration of margins: scenes of known truth -> a line a state -> ``ModelMargins``.

The unit is the physical state: one scene of each counts. docs/trust.md says what is promised.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float
from msgspec.structs import replace

import tumortrack
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.models import conformal
from tumortrack.models.margins import (
    METHOD,
    Group,
    Kind,
    ModelMargins,
    Radius,
    Shells,
    exceeded,
    measured,
)
from tumortrack.report.calibration_table import Miss, Row
from tumortrack.report.metrics import outward_miss
from tumortrack.simulate.scene_folder import Scene, list_scenes
from tumortrack.tracking.quality import cloud_shares
from tumortrack.tracking.tracker import Tracker

_Turn = Literal["choose", "test", "calibrate"]
CONFIDENCES = (0.9, 0.95)
WIDEST_MM = 8.0  # what plans assume of estimates that say nothing of their error
SHARES = (1 / 3, 2 / 3)  # of visible surface, that part the groups
# Limits are tried at these quantiles of the figures of the states that they are chosen on.
_LEVELS = (0.8, 0.9, 0.95, 1.0)
_OFFSETS_MM = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
# What a state is for: choosing form and limits, testing limits, finding radii. Of each group's
# states, drawn by the seed, in turn.
_TURNS: tuple[_Turn, ...] = ("test", "calibrate", "choose", "test", "calibrate")
_GRID = 8  # voxels: the labelled volume is not looked at
_WORTH = 0.95  # of the constant radius: nothing less pays for one that varies


@dataclass(frozen=True)
class Listed:
    """A scene that counts: its folder, and family, visible share and organ."""

    folder: Path
    label: tuple[str, str, str]


def list_states(folders: Sequence[Path], seed: int) -> list[Listed]:
    """One scene of every state, drawn by the seed. Meta.json names ``family``, ``visible_share``
    and ``state``; scenes without are of the family of their deformation, of unknown share, and a
    state each. Left out is what shows no organ of the model's (``model_organ`` false).

    Raises:
        InputError: no scenes, or a share that is none.
    """
    scenes = [scene for folder in folders for scene in list_scenes(folder)]
    first: dict[tuple[str, ...], Listed] = {}
    for n in np.random.default_rng(seed).permutation(len(scenes)):
        path = scenes[n] / "meta.json"
        meta = store.read_json(path) if path.is_file() else {}
        if meta.get("model_organ") is False:
            continue  # something else in its place: nothing true can be said
        family = meta.get("family") or (meta.get("deformation") or {}).get("kind") or "unknown"
        organ, share = str(meta.get("case_sha256") or "unknown"), meta.get("visible_share")
        if not (share is None or (isinstance(share, int | float) and 0 <= share <= 1)):
            raise InputError(f"{path}: visible_share is {share!r}; allowed: 0 to 1.")
        words = "unknown" if share is None else _WORDS[int(np.searchsorted(SHARES, share))]
        one = Listed(scenes[n], (str(family), words, organ[:12]))
        state = str(meta.get("state") or scenes[n].resolve())
        first.setdefault((*one.label[::2], state), one)
    return sorted(first.values(), key=lambda one: str(one.folder))


_WORDS = ("under 1/3", "1/3 to 2/3", "over 2/3")


def row_of(tracker: Tracker, scene: Scene, listed: Listed, seed: int) -> Row:
    """One state's line: judged by the depth image, where there is one, as `locate` and `track` do.
    The tracker's model must have no margins of its own."""
    row = Row(
        scene=str(listed.folder.resolve()),
        sha256=store.sha256_of(listed.folder),
        label=listed.label,
    )
    try:
        estimate = tracker.locate(scene.cloud, _GRID, seed, scene.depth)
    except (NoEstimate, InputError) as error:
        return replace(row, doubt=str(error))
    if estimate.quality != "good":
        return replace(row, doubt=estimate.reason)
    parts: dict[str, Any] = estimate.report["parts"]
    if scene.depth is not None:  # which says nothing of what lies where the cloud has no points
        organ = estimate.meshes[scene.reference.names[0]]
        estimate.report["unseen"] = cloud_shares(organ, scene.cloud)[1]
    misses: dict[Kind, list[Miss]] = {}
    unsure = {name: part.get("surface_std_mm") for name, part in parts.items()}
    for n, (name, truth) in enumerate(
        zip(scene.reference.names, scene.reference.parts, strict=True)
    ):
        if name not in estimate.meshes:
            raise InputError(f"{listed.folder} has a {name}, which this model does not know.")
        miss = outward_miss(estimate.meshes[name], truth), unsure[name]
        misses.setdefault("tumor" if n else "kidney", []).append(miss)
    if estimate.motion is not None and scene.targets is not None:
        off_mm = estimate.motion.carry(scene.targets.points_ct) - scene.targets.points_mm
        largest = float(np.linalg.norm(off_mm, axis=1).max())
        misses["map"] = [(largest, unsure[scene.reference.names[0]])]
    found = {kind: tuple(some) for kind, some in misses.items()}
    return replace(row, measured=measured(estimate.report), misses=found)


def margins_of(
    rows: Sequence[Row],
    table_sha256: str,
    confidences: Sequence[float] = CONFIDENCES,
    widest_mm: float = WIDEST_MM,
    seed: int = 0,
) -> ModelMargins:
    """The margins that these states give; see docs/trust.md. Answers that miss by more than
    ``widest_mm`` are to be kept out by limits.

    Raises:
        InputError: a family with too few states, or limits that hold their risk nowhere; says how
            many there are and how many it takes.
    """
    highest = max(confidences)
    turns = _dealt([row.label for row in rows], seed)
    some: dict[_Turn, list[Row]] = {turn: [] for turn in get_args(_Turn)}
    for row, turn in zip(rows, turns, strict=True):
        some[turn].append(row)
    good = [row for row in some["choose"] if not row.doubt]
    if not good:
        raise InputError(
            f"no good estimate among {len(some['choose'])} states to choose limits on."
        )
    located = [row for row in rows if not row.doubt]
    kinds: list[Kind] = [kind for kind in get_args(Kind) if all(kind in r.misses for r in located)]
    rules = _rules(good)
    number = _tested(rules, some["test"], kinds[0], widest_mm, 1 - highest)
    accepted = {turn: [row for row in some[turn] if _accepted(row, rules[number])] for turn in some}
    forms = {kind: _form(accepted["choose"] or good, kind, highest) for kind in kinds}
    families, theirs = {row.label[0] for row in rows}, accepted["calibrate"]
    shells: list[Shells] = []
    joined: dict[str, str] = {}
    for confidence in sorted(confidences):
        radii = {}
        for kind in kinds:
            radii[kind], small = _radius(theirs, kind, forms[kind], confidence, families)
            joined |= small
        shells.append(Shells(confidence=confidence, radii=radii))
    each, tested = conformal.ERROR / len(rules), accepted["test"]
    last, least = shells[-1].radii[kinds[0]], conformal.least_tested(1 - highest, each, misses=1)
    groups = _grouped(tested, least)[0].values()
    bounds = [conformal.risk_bound(_misses(of, kinds[0], last), len(of), each) for of in groups]
    return ModelMargins(
        method=METHOD,
        tumortrack=tumortrack.__version__,
        model_sha256="",
        table_sha256=table_sha256,
        seed=seed,
        widest_mm=widest_mm,
        limits=rules[number],
        shells=tuple(shells),
        groups=tuple(_counts(rows, turns, rules[number])),
        joined=joined,
        risk_bound=max(bounds),
        accepted=len(tested) / len(some["test"]),
        missed=_misses(tested, kinds[0], last) / len(some["test"]),
    )


def _dealt(labels: Sequence[conformal.Label], seed: int) -> list[_Turn]:
    """What each state is for; drawn within its group."""
    turns: dict[int, _Turn] = {}
    seen = dict.fromkeys(labels, 0)
    for n in np.random.default_rng(seed).permutation(len(labels)):
        turns[n] = _TURNS[seen[labels[n]] % len(_TURNS)]
        seen[labels[n]] += 1
    return [turns[n] for n in range(len(labels))]


def _rules(good: Sequence[Row]) -> list[dict[str, float]]:
    """Limits, the strictest first; none that lets pass what is worse than all that was seen."""
    names = [name for name in good[0].measured if all(name in row.measured for row in good)]
    figures = {name: np.array([row.measured[name] for row in good]) for name in names}
    return [
        {name: float(np.quantile(some, level, method="higher")) for name, some in figures.items()}
        for level in _LEVELS
    ]


def _accepted(row: Row, limits: dict[str, float]) -> bool:
    return not row.doubt and not exceeded(limits, row.measured)


def _form(rows: Sequence[Row], kind: Kind, confidence: float) -> Radius:
    """The form with the smaller mean radius; constant where they are about equal. Its factors are
    provisional."""

    def factor(offset_mm: float | None) -> float:
        return float(np.quantile(_scores(rows, kind, offset_mm), confidence, method="higher"))

    constant = factor(None)
    deviations = [s for row in rows for _, s in row.misses[kind]]
    if None in deviations:
        return Radius(used="constant", constant_mm=constant)
    mean = float(np.mean([s for s in deviations if s is not None]))
    width, offset = min((factor(a) * (a + mean), a) for a in _OFFSETS_MM)
    used: Literal["scaled", "constant"] = "scaled" if width < _WORTH * constant else "constant"
    return Radius(used=used, constant_mm=constant, scaled=factor(offset), offset_mm=offset)


def _tested(
    rules: list[dict[str, float]], rows: Sequence[Row], kind: Kind, widest_mm: float, risk: float
) -> int:
    """The number of the loosest limits under which no more of the answers than the risk miss by
    more than ``widest_mm``, in any group."""
    each, tables = conformal.ERROR / len(rules), []
    least, families = conformal.least_tested(risk, each, misses=1), {row.label[0] for row in rows}
    for limits in rules:
        taken = [row for row in rows if _accepted(row, limits)]
        groups = _grouped(taken, least, families)[0]
        tables.append(
            {name: (_beyond(of, kind, widest_mm), len(of)) for name, of in groups.items()}
        )
    number = conformal.loosest_rule([list(table.values()) for table in tables], risk)
    if number is None:
        said = "; ".join(f"{m} of {n} of {name}" for name, (m, n) in tables[-1].items())
        none = conformal.least_tested(risk, each)
        raise InputError(
            f"no limits hold {100 * risk:.3g} %: of the answers in each group, {said} "
            f"miss by more than {widest_mm:g} mm. It takes {none} without such a one, {least} with "
            "one, and 2.5 times as many states in all. Give more scenes of each family, a wider "
            "--widest, or a lower --confidence."
        )
    return number


def _beyond(rows: Sequence[Row], kind: Kind, widest_mm: float) -> int:
    return sum(row.score(kind, None) > widest_mm for row in rows)


def _misses(rows: Sequence[Row], kind: Kind, radius: Radius) -> int:
    """How many have a tumor that is not within its radius."""
    radii = [[(miss, radius.at(s)) for miss, s in row.misses[kind]] for row in rows]
    return sum(any(at is None or miss > at for miss, at in some) for some in radii)


def _grouped(
    rows: Sequence[Row], least: int, families: Collection[str] = ()
) -> tuple[dict[str, list[Row]], dict[str, str]]:
    """The members of each group; which were too small to stand alone, and who speaks for them. One
    of the ``families`` without any member is a group of none."""
    labels = [row.label for row in rows]
    found = {
        ", ".join(label): [rows[n] for n in members]
        for label, members in conformal.groups_of(labels, least).items()
    }
    found |= {family: [] for family in families if family not in {label[0] for label in labels}}
    names = {", ".join(label): label for label in labels}
    joined = {}
    for name, label in names.items():
        if name not in found:
            whole = [", ".join(label[:n]) for n in (2, 1)]
            joined[name] = next(one for one in whole if one in found)
    return found, joined


def _radius(
    rows: Sequence[Row], kind: Kind, form: Radius, confidence: float, families: Collection[str]
) -> tuple[Radius, dict[str, str]]:
    """The form with the greatest of the groups' quantiles."""
    least = conformal.least_scores(confidence)
    groups, joined = _grouped(rows, least, families)
    few = [f"{len(of)} of {name}" for name, of in groups.items() if len(of) < least]
    if few:
        raise InputError(
            f"{100 * confidence:g} % needs {least} accepted states of each family to calibrate "
            f"with (2.5 times as many in all); there are {', '.join(few)}. Give more "
            "scenes, or a lower --confidence."
        )

    def greatest(offset_mm: float | None) -> float:
        return max(
            conformal.conformal_quantile(_scores(of, kind, offset_mm), confidence)
            for of in groups.values()
        )

    scaled = None if form.scaled is None else greatest(form.offset_mm)
    radius = Radius(
        used=form.used, constant_mm=greatest(None), scaled=scaled, offset_mm=form.offset_mm
    )
    return radius, joined


def _scores(rows: Sequence[Row], kind: Kind, offset: float | None) -> Float[np.ndarray, " n"]:
    return np.array([row.score(kind, offset) for row in rows])


def _counts(
    rows: Sequence[Row], turns: Sequence[_Turn], limits: dict[str, float]
) -> Iterator[Group]:
    for label in sorted({row.label for row in rows}):
        mine = [(row, turn) for row, turn in zip(rows, turns, strict=True) if row.label == label]
        taken = [turn for row, turn in mine if _accepted(row, limits)]
        yield Group(
            label=label,
            states=len(mine),
            good=sum(not row.doubt for row, _ in mine),
            accepted=len(taken),
            tested=taken.count("test"),
            calibrated=taken.count("calibrate"),
        )
