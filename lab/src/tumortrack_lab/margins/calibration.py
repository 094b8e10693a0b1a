"""Calibration of margins: scenes of known truth -> one row per state -> ``ModelMargins``.

The unit is the physical state: one scene of each counts. docs/trust.md says what is promised.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from jaxtyping import Float
from msgspec.structs import replace

import tumortrack
from tumortrack.assessment.verdict import cloud_shares
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.report.metrics import outward_miss
from tumortrack.simulate.scene_folder import Scene, list_scenes
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.margins import (
    Group,
    Kind,
    ModelMargins,
    Radius,
    Shells,
    exceeded,
    given_evidence,
    measured,
    sized,
)
from tumortrack_lab.margins import conformal
from tumortrack_lab.margins.table import Miss, Row
from tumortrack_lab.world.evidence import EvidenceSource

if TYPE_CHECKING:
    from tumortrack.tracking.tracker import Tracker

_Turn = Literal["choose", "test", "calibrate"]
CONFIDENCES = (0.9, 0.95)
WIDEST_MM = 8.0  # as plans assume for estimates without a stated error
SHARES = (1 / 3, 2 / 3)  # of visible surface: bounds between groups
# Candidate limits are these quantiles (of the size, of every other figure) of the states they are
# chosen on, in two sequences. The first can exclude poor fits; the second limits the size
# alone, which excludes much at little loss.
_LEVELS = {
    "all": ((0.8, 0.8), (0.9, 0.9), (0.95, 0.95), (1.0, 1.0)),
    "size": ((0.8, 1.0), (0.9, 1.0), (0.95, 1.0)),
}
_ERROR = conformal.ERROR / len(_LEVELS)
_OFFSETS_MM = (0.1, 0.5, 1.0, 2.0, 4.0, 8.0)
_BENDS_MM = (0.0, 2.0, 4.0, 8.0, 16.0)
# What a state is used for: choosing form and limits, testing limits, computing radii. The states
# of each group take these turns, in an order drawn by the seed.
_TURNS: tuple[_Turn, ...] = ("test", "calibrate", "choose", "test", "calibrate")
_SIZE = "size_mm"
_MOST = {"touch": 100, "outline": 10, "landmark": 20, "held": 4}  # pieces that are drawn
_GRID = 8  # voxels: the labelled volume is not used
_ALONE = 2  # times the scores that a quantile needs: the maximum of a few says little
_WORTH = 0.95  # of the constant radius's mean: a varying one must be smaller than this


@dataclass(frozen=True)
class Listed:
    """The scene that stands for a state; ``label``: family, visible share, organ."""

    folder: Path
    label: tuple[str, str, str]


def list_states(folders: Sequence[Path], seed: int) -> list[Listed]:
    """One scene of every state, drawn by the seed. meta.json names ``family``, ``visible_share``
    and ``state``; without them a scene belongs to the family of its deformation, to an unknown
    share, and is a state of its own. Scenes of another organ (``model_organ`` false) are left out.
    Raises InputError: no scenes, or a share outside 0 to 1."""
    scenes = [scene for folder in folders for scene in list_scenes(folder)]
    first: dict[tuple[str, ...], Listed] = {}
    for n in np.random.default_rng(seed).permutation(len(scenes)):
        path = scenes[n] / "meta.json"
        meta = store.read_json(path) if path.is_file() else {}
        if meta.get("model_organ") is False:
            continue  # another organ: no estimate of it can be right
        family = meta.get("family") or (meta.get("deformation") or {}).get("kind") or "unknown"
        organ, share = str(meta.get("case_sha256") or "unknown"), meta.get("visible_share")
        if not (share is None or (isinstance(share, int | float) and 0 <= share <= 1)):
            raise InputError(f"{path}: visible_share is {share!r}; allowed: 0 to 1.")
        words = "unknown" if share is None else _WORDS[int(np.searchsorted(SHARES, share))]
        scene = Listed(scenes[n], (str(family), words, organ[:12]))
        state = str(meta.get("state") or scenes[n].resolve())
        first.setdefault((*scene.label[::2], state), scene)
    return sorted(first.values(), key=lambda scene: str(scene.folder))


_WORDS = ("under 1/3", "1/3 to 2/3", "over 2/3")


def evidence_of(name: str) -> dict[str, int]:
    """Kinds and numbers by a name: ``touch12+outline1``. Raises InputError."""
    found = [re.fullmatch(r"([a-z]+)(\d+)", each) for each in name.split("+")]
    numbers = {each[1]: int(each[2]) for each in found if each}
    right = len(numbers) == len(found) and numbers.keys() <= set(_MOST)
    if not right or not all(1 <= count <= _MOST[kind] for kind, count in numbers.items()):
        allowed = ", ".join(f"{kind}1 to {kind}{most}" for kind, most in _MOST.items())
        raise InputError(
            f"--evidence {name} is not allowed. Allowed: {allowed}, or several of these joined by "
            "+, each kind once; outlines are counted for each tumor."
        )
    return dict(sorted(numbers.items()))


def row_of(
    tracker: Tracker,
    scene: Scene,
    listed: Listed,
    seed: int,
    evidence: Mapping[str, int] = MappingProxyType({}),
) -> Row:
    """Locate one state, judged by its depth image, if any, as `locate` and `track` do. The
    tracker's model must have no margins of its own. ``evidence``: how many pieces of each kind are
    drawn beside the cloud, with all errors of ``EvidenceErrors``."""
    row = Row(
        scene=str(listed.folder.resolve()),
        sha256=store.sha256_of(listed.folder),
        label=listed.label,
    )
    source = EvidenceSource.of(scene, (seed, int(row.sha256[:8], 16)))
    drawn = [piece.evidence for piece in source.drawn(evidence)]
    try:
        estimate = tracker.locate(scene.cloud, _GRID, seed, scene.depth, evidence=drawn)
    except (NoEstimate, InputError) as error:
        return replace(row, doubt=str(error))
    if estimate.quality != "good":
        return replace(row, doubt=estimate.reason)
    if given_evidence(estimate.report) != evidence:
        return replace(row, doubt="evidence could not be drawn")
    if scene.depth is not None:  # judging by an image leaves ``unseen`` open
        organ = estimate.meshes[scene.reference.names[0]]
        estimate = estimate.reporting(unseen=cloud_shares(organ, scene.cloud)[1])
    misses: dict[Kind, list[Miss]] = {}
    unsure = {name: part.surface_std_mm for name, part in estimate.report.parts.items()}
    for n, (name, truth) in enumerate(
        zip(scene.reference.names, scene.reference.parts, strict=True)
    ):
        if name not in estimate.meshes:
            raise InputError(f"{listed.folder} has a {name}, which this model does not know.")
        miss = outward_miss(estimate.meshes[name], truth), unsure[name]
        misses.setdefault("tumor" if n else "organ", []).append(miss)
    if estimate.motion is not None and scene.targets is not None:
        off_mm = estimate.motion.carry(scene.targets.points_ct) - scene.targets.points_mm
        largest = float(np.linalg.norm(off_mm, axis=1).max())
        misses["map"] = [(largest, unsure[scene.reference.names[0]])]
    by_kind = {kind: tuple(each) for kind, each in misses.items()}
    return replace(row, measured=measured(estimate.report), misses=by_kind)


def margins_of(
    rows: Sequence[Row],
    table_sha256: str,
    confidences: Sequence[float] = CONFIDENCES,
    widest_mm: float = WIDEST_MM,
    seed: int = 0,
) -> ModelMargins:
    """The margins that these states give; see docs/trust.md. Limits are to keep out answers that
    miss by more than ``widest_mm``. Raises InputError: too few states, or no limits that hold their
    risk; says how many states there are and how many it takes."""
    highest = max(confidences)
    turns = _dealt([row.label for row in rows], seed)
    good = [
        row for row, turn in zip(rows, turns, strict=True) if turn == "choose" and not row.doubt
    ]
    if not good:
        raise InputError(
            f"no good estimate among the {turns.count('choose')} of {len(rows)} scenes that limits "
            "are chosen on. Give more scenes, or a model that is trained longer."
        )
    located = [row for row in rows if not row.doubt]
    kinds: list[Kind] = [kind for kind in get_args(Kind) if all(kind in r.misses for r in located)]
    forms = {kind: _form(good, kind) for kind in kinds}
    rows = [_sized(row, forms[kinds[0]]) for row in rows]
    by_turn: dict[_Turn, list[Row]] = {turn: [] for turn in get_args(_Turn)}
    for row, turn in zip(rows, turns, strict=True):
        by_turn[turn].append(row)
    rules = _rules([row for row in by_turn["choose"] if not row.doubt])
    limits = _tested(rules, by_turn["test"], kinds[0], widest_mm, 1 - highest)
    accepted = {turn: [row for row in by_turn[turn] if _accepted(row, limits)] for turn in by_turn}
    least = conformal.least_scores(highest)  # fewer than testing limits needs
    groups, joined = _grouped(accepted["calibrate"], _ALONE * least)
    shells: list[Shells] = []
    for confidence in sorted(confidences):
        radii = {kind: _radius(groups, kind, forms[kind], confidence) for kind in kinds}
        shells.append(Shells(confidence=confidence, radii=radii))
    tested, last = accepted["test"], shells[-1].radii[kinds[0]]
    least = conformal.least_tested(1 - highest, _ERROR, misses=1)
    parts = _grouped(tested, least)[0].values()
    bounds = [conformal.risk_bound(_misses(of, kinds[0], last), len(of)) for of in parts]
    return ModelMargins(
        fingerprint=fingerprint(),
        tumortrack=tumortrack.__version__,
        model_sha256="",
        table_sha256=table_sha256,
        seed=seed,
        widest_mm=widest_mm,
        limits=limits,
        shells=tuple(shells),
        groups=tuple(_counts(rows, turns, limits)),
        joined=joined,
        risk_bound=max(bounds),
        accepted=len(tested) / len(by_turn["test"]),
        missed=_misses(tested, kinds[0], last) / len(by_turn["test"]),
    )


def least_states(confidence: float, misses: int = 0) -> int:
    """How many states, all with a good estimate, it takes to show that margins hold with this
    confidence if so many of the tested ones miss them."""
    tested = conformal.least_tested(1 - confidence, _ERROR, misses=misses)
    return math.ceil(tested * len(_TURNS) / _TURNS.count("test"))


def _dealt(labels: Sequence[conformal.Label], seed: int) -> list[_Turn]:
    """What each state is used for, drawn within its group."""
    turns: dict[int, _Turn] = {}
    dealt = dict.fromkeys(labels, 0)
    for n in np.random.default_rng(seed).permutation(len(labels)):
        turns[n] = _TURNS[dealt[labels[n]] % len(_TURNS)]
        dealt[labels[n]] += 1
    return [turns[n] for n in range(len(labels))]


def _rules(good: Sequence[Row]) -> list[list[dict[str, float]]]:
    """Sequences of limits, the strictest first; the loosest is the worst value in ``good``."""
    names = [name for name in good[0].measured if all(name in row.measured for row in good)]
    values = {name: np.array([row.measured[name] for row in good]) for name in names}
    return [
        [
            {
                name: float(np.quantile(of, size if name == _SIZE else other, method="higher"))
                for name, of in values.items()
            }
            for size, other in levels
        ]
        for levels in _LEVELS.values()
    ]


def answered(row: Row, margins: ModelMargins) -> bool:
    """Whether the estimate states a margin: no check failed and no limit is exceeded."""
    return _accepted(_sized(row, margins.shells[-1].radii["tumor"]), margins.limits)


def _sized(row: Row, form: Radius) -> Row:
    """The row with the size of its tumors among its figures."""
    if row.doubt:
        return row
    deviations = [s for _, s in row.misses["tumor"]]
    return replace(row, measured=sized(row.measured, deviations, form))


def _accepted(row: Row, limits: dict[str, float]) -> bool:
    return not row.doubt and not exceeded(limits, row.measured)


def _form(rows: Sequence[Row], kind: Kind) -> Radius:
    """The form of largest likelihood, if misses are exponentially distributed in the size; constant
    if that is about as likely. Its factors are computed later."""
    constant = Radius(used="constant", constant_mm=1.0)
    deviations = [(s, row.measured) for row in rows for _, s in row.misses[kind]]
    if any(s is None for s, _ in deviations):
        return constant
    bends = _BENDS_MM if all("rarity" in row.measured for row in rows) else (0.0,)
    forms = []
    for offset_mm, bend_mm in product(_OFFSETS_MM, bends):
        form = replace(constant, scaled=1.0, offset_mm=offset_mm, bend_mm=bend_mm)
        sizes = [form.size_mm(s or 0.0, figures) for s, figures in deviations]
        mean = float(_scores(rows, kind, form).mean() * np.exp(np.log(sizes).mean()))
        forms.append((mean, form))
    mean, form = min(forms, key=itemgetter(0))
    worth = mean < _WORTH * float(_scores(rows, kind, None).mean())
    return replace(form, used="scaled") if worth else form


def _tested(
    sequences: list[list[dict[str, float]]],
    rows: Sequence[Row],
    kind: Kind,
    widest_mm: float,
    risk: float,
) -> dict[str, float]:
    """Of the limits under which the share of answers that miss by more than ``widest_mm`` stays
    within the risk in every group, those with the most answers."""
    least, held = conformal.least_tested(risk, _ERROR, misses=1), []
    for rules in sequences:
        answers = [[row for row in rows if _accepted(row, limits)] for limits in rules]
        tables = [
            {
                name: (sum(row.score(kind) > widest_mm for row in of), len(of))
                for name, of in _grouped(taken, least)[0].items()
            }
            for taken in answers
        ]
        number = conformal.loosest_rule([[*table.values()] for table in tables], risk, _ERROR)
        if number is not None:
            held.append((len(answers[number]), rules[number]))
    if not held:
        counts = "; ".join(f"{name}: {m} of {n}" for name, (m, n) in tables[0].items())
        raise InputError(
            f"no limits hold {100 * risk:.3g} %. Tested answers that miss by more than "
            f"{widest_mm:g} mm: {counts}. If none does, about {least_states(1 - risk)} scenes are "
            f"needed, and {least_states(1 - risk, misses=1)} if one does. Give more scenes, a "
            "wider --widest, or a lower --confidence."
        )
    return max(held, key=itemgetter(0))[1]


def _misses(rows: Sequence[Row], kind: Kind, radius: Radius) -> int:
    """How many have a tumor outside its radius."""
    return sum(not row.within(kind, radius) for row in rows)


def _grouped(rows: Sequence[Row], least: int) -> tuple[dict[str, list[Row]], dict[str, str]]:
    """The members of each group; and for groups that were too small, the one they joined."""
    labels = [row.label for row in rows]
    groups = conformal.groups_of(labels, least)
    members = {_name(label): [rows[n] for n in numbers] for label, numbers in groups.items()}
    joined = {}
    for label in set(labels) - groups.keys():
        larger = next(label[:n] for n in (2, 1, 0) if label[:n] in groups)
        joined[_name(label)] = _name(larger)
    return members, joined


def _name(label: conformal.Label) -> str:
    return ", ".join(label) or "all states"


def _radius(groups: dict[str, list[Row]], kind: Kind, form: Radius, confidence: float) -> Radius:
    """The form, its factor the greatest of the groups' quantiles."""

    def greatest(form: Radius | None) -> float:
        scores = [_scores(of, kind, form) for of in groups.values()]
        return max(conformal.conformal_quantile(each, confidence) for each in scores)

    scaled = None if form.scaled is None else greatest(form)
    return replace(form, constant_mm=greatest(None), scaled=scaled)


def _scores(rows: Sequence[Row], kind: Kind, form: Radius | None) -> Float[np.ndarray, " n"]:
    return np.array([row.score(kind, form) for row in rows])


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
