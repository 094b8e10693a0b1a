"""What evidence beside the cloud brings: errors of tumors' centres and verdicts, with pieces drawn
from scenes' truth (``tumortrack_lab.world.evidence``)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import perpendicular, transform_points, triangles_of
from tumortrack.core.report import NextEvidence
from tumortrack.core.types import Anatomy
from tumortrack.registration.model import RegistrationModel
from tumortrack.report.rivals import best_rigid_pose, rigid_fit
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.world.evidence import ALL_TRUE, EvidenceSource, Piece, hidden, mirrored

_COARSE = 16  # of the volume, which is not used
_AT_A_TIME = 3  # touches, then it is located again
_COUNTS = (3, 6, 12)
_HIDDEN_SHARE = 0.4
WRONG = ("none", "3 touches, chosen", "6 touches, chosen", "3 landmarks")
Pieces = Sequence[Piece]
Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Asker:
    """Locates one scene with evidence; ``seed``: of all that is drawn."""

    tracker: Tracker
    scene: Scene
    seed: tuple[int, ...]

    def source(self, kind: int, false: bool = False) -> EvidenceSource:
        """For one kind of evidence; all kinds share the scene's hand-eye error."""
        source = EvidenceSource.of(self.scene, self.seed)
        errors = source.errors if false else ALL_TRUE
        return replace(source, errors=errors, rng=np.random.default_rng([*self.seed, 2, kind]))

    def located(self, pieces: Pieces) -> Estimate | None:
        known, scene = [piece.evidence for piece in pieces], self.scene
        try:
            return self.tracker.locate(scene.cloud, _COARSE, 0, scene.depth, evidence=known)
        except NoEstimate:
            return None

    def chosen(
        self, estimate: Estimate | None, source: EvidenceSource, most: int
    ) -> Iterator[tuple[int, Pieces, Estimate | None, Estimate | None]]:
        """Touched as advised, three at a time: how many, all pieces, the estimate before the last
        three and with them. Without advice it is touched at random."""
        pieces = list[Piece]()
        for count in range(_AT_A_TIME, most + 1, _AT_A_TIME):
            before = estimate
            pieces += _advised(before, source)
            estimate = self.located(pieces)
            yield count, tuple(pieces), before, estimate


def _advised(estimate: Estimate | None, source: EvidenceSource) -> list[Piece]:
    advised = _advised_touches(estimate)
    if not advised:
        return source.touches_at_random(_AT_A_TIME, None)
    assert estimate is not None
    aims = np.array([touch.place_mm for touch in advised])
    centres, outward = triangles_of(estimate.organ_mesh.vertices_mm, estimate.organ_mesh.faces)
    return source.touches(aims, outward[cKDTree(centres).query(aims)[1]])


def _advised_touches(estimate: Estimate | None) -> list[NextEvidence]:
    told = () if estimate is None else estimate.assessment.next_evidence
    return [each for each in told if each.kind == "touch"]


def own_rows(tracker: Tracker, scene: Scene, seed: tuple[int, ...]) -> Iterator[Row]:
    """A row for each kind of evidence and tumor: its centre's error, that of a rigid fit from the
    best rigid pose to the same cloud, the verdict, and how many pieces were left out. Held is the
    tumor that a rigid fit is most wrong about: the pulled one, where one is pulled."""
    whole = _Asker(tracker, scene, seed)
    shaded = replace(whole, scene=hidden(scene, _HIDDEN_SHARE, np.random.default_rng([*seed, 3])))
    rigid_mm, hidden_mm = _rigid_mm(whole), _rigid_mm(shaded)
    held = max(rigid_mm, key=rigid_mm.__getitem__)
    all_kinds = _kinds(whole, scene.reference.names.index(held) - 1)
    for asker, kinds, rigid in (
        (whole, all_kinds, rigid_mm), (shaded, _hidden_kinds(shaded), hidden_mm)
    ):  # fmt: skip
        for kind, pieces, estimate, more in kinds:
            yield from _rows(asker, kind, pieces, estimate, rigid, {"held": held, **more})


Answer = tuple[str, Pieces, Estimate | None, Row]


def _kinds(asker: _Asker, held: int) -> Iterator[Answer]:
    """``held``: the tumor that a tool holds."""
    none = asker.located(())
    yield "none", (), none, {}
    touched: Pieces = ()
    for count, touched, before, after in asker.chosen(none, asker.source(0), _COUNTS[-1]):
        told = _foreseen(asker.scene, before, after)
        yield f"{count} touches, chosen", touched, after, told
    source = asker.source(1)
    anywhere = source.touches_at_random(_COUNTS[-1], None)
    behind = source.touches_at_random(_COUNTS[-1], source.unseen)
    one, two = _outlines(asker.source(2))
    fixed: dict[str, Pieces] = {
        **{f"{n} touches, random": anywhere[:n] for n in _COUNTS},
        **{f"{n} touches, unseen side": behind[:n] for n in _COUNTS},
        "1 outline": one,
        "2 outlines": (*one, *two),
        "12 touches, chosen, and 1 outline": (*touched, *one),
        "3 landmarks": asker.source(3).landmarks(3),
        "6 landmarks": asker.source(3).landmarks(6),
        "held tumor": (asker.source(4).held(held),),
        "12 touches, random, 5 % false": asker.source(1, True).touches_at_random(12, None),
        "held tumor, 5 % slipped": (asker.source(5, True).held(held),),
    }
    for kind, pieces in fixed.items():
        yield kind, pieces, asker.located(pieces), {}
    for count, pieces, _, estimate in asker.chosen(none, asker.source(6, True), _COUNTS[-1]):
        if count in _COUNTS:
            yield f"{count} touches, chosen, 5 % false", pieces, estimate, {}


def _hidden_kinds(asker: _Asker) -> Iterator[Answer]:
    none = asker.located(())
    yield "40 % hidden: none", (), none, {}
    for count, pieces, _, estimate in asker.chosen(none, asker.source(7), 6):
        yield f"40 % hidden: {count} touches, chosen", pieces, estimate, {}


def _outlines(source: EvidenceSource) -> tuple[list[Piece], list[Piece]]:
    """Of each tumor two, in planes at a right angle."""
    pairs = list[tuple[Piece | None, Piece | None]]()
    for tumor in range(len(source.scene.reference.tumors)):
        normal = source.normal()
        pairs.append((source.outline(tumor, normal), source.outline(tumor, perpendicular(normal))))
    first, second = ([piece for piece in which if piece] for which in zip(*pairs, strict=True))
    return first, second


def _rows(
    asker: _Asker, kind: str, pieces: Pieces, estimate: Estimate | None, rigid_mm: Row, more: Row
) -> Iterator[Row]:
    about = {
        "kind": kind,
        **_verdict(estimate),
        "pieces": len(pieces),
        "false": sum(piece.false for piece in pieces),
        **more,
    }
    if estimate is not None and pieces:
        out = [told.left_out for told in estimate.report.evidence]
        about["false_out"] = sum(o for o, p in zip(out, pieces, strict=True) if p.false)
        about["true_out"] = sum(o for o, p in zip(out, pieces, strict=True) if not p.false)
    for tumor, off in _off_mm(asker.scene, estimate).items():
        rigid = rigid_mm[tumor]
        yield {**about, "tumor": tumor, "miss_mm": float(np.linalg.norm(off)), "rigid_mm": rigid}


def _off_mm(scene: Scene, estimate: Estimate | None) -> dict[str, np.ndarray]:
    """By tumor: its centre's error; NaN without an estimate."""
    targets, off = scene.targets, {}
    assert targets is not None
    for label, name in enumerate(scene.reference.names[1:], start=2):
        mine = targets.labels == label
        if not mine.any():
            continue
        if estimate is None:
            off[name] = np.full(3, np.nan)
            continue
        assert estimate.motion is not None
        away_mm = estimate.motion.carry(targets.points_ct[mine]) - targets.points_mm[mine]
        off[name] = away_mm.mean(0)
    return off


def _rigid_mm(asker: _Asker) -> Row:
    model, targets = asker.tracker.model, asker.scene.targets
    assert isinstance(model, RegistrationModel)
    assert targets is not None
    start, _ = best_rigid_pose(model.shape.anatomy_ct, asker.scene)
    fitted = rigid_fit(model.shape.distances[0], asker.scene.cloud, start)
    away_mm = transform_points(fitted, targets.points_ct) - targets.points_mm
    names = enumerate(asker.scene.reference.names[1:], start=2)
    off = {name: away_mm[targets.labels == label] for label, name in names}
    return {name: float(np.linalg.norm(o.mean(0))) for name, o in off.items() if len(o)}


def _foreseen(scene: Scene, before: Estimate | None, after: Estimate | None) -> Row:
    """Of the tumor that advice was for, along its least sure axis: foreseen deviations before and
    with all three touches, and errors."""
    if before is None or after is None or not (advised := _advised_touches(before)):
        return {}
    first, last = advised[0], advised[-1]
    axes, off = before.report.parts[first.part].center_axes, _off_mm(scene, before)
    if axes is None or first.part not in off:
        return {}
    then = _off_mm(scene, after)[first.part]
    return {
        "std_mm": first.std_mm,
        "then_std_mm": last.then_std_mm,
        "off_before_mm": float(abs(off[first.part] @ axes[0])),
        "off_after_mm": float(abs(then @ axes[0])),
    }


def wrong_rows(
    tracker: Tracker, other: Tracker, scene: Scene, seed: tuple[int, ...]
) -> Iterator[Row]:
    """Verdicts for the mirrored organ, and for this one with another organ's model: a row a kind of
    evidence. Landmarks are clicked where the wrong organ has the like point: mirrored, or at the
    same share of its box's sides."""
    here, there = tracker.anatomy_ct, other.anatomy_ct
    assert here is not None
    assert there is not None
    assert scene.targets is not None
    like = replace(scene.targets, points_ct=_like(scene.targets.points_ct, here, there))
    foreign = replace(scene, targets=like)
    pairs = {"mirrored": (tracker, mirrored(scene)), "foreign": (other, foreign)}
    for organ, (asked, shown) in pairs.items():
        asker = _Asker(asked, shown, seed)
        none = asker.located(())
        touched = asker.chosen(none, asker.source(0), 6)
        answers = [none, *(after for *_, after in touched)]
        answers.append(asker.located(asker.source(3).landmarks(3)))
        for kind, estimate in zip(WRONG, answers, strict=True):
            yield {"organ": organ, "kind": kind, **_verdict(estimate)}


def _verdict(estimate: Estimate | None) -> Row:
    if estimate is None:
        return {"quality": "none", "finding": None}
    finding = None if estimate.finding is None else estimate.finding.kind
    return {"quality": estimate.quality, "finding": finding}


def _like(points_ct: np.ndarray, here: Anatomy, there: Anatomy) -> np.ndarray:
    (low, high), (other_low, other_high) = here.organ.box_mm, there.organ.box_mm
    return other_low + (points_ct - low) / (high - low) * (other_high - other_low)


def all_rows(
    trackers: tuple[Tracker, Tracker], scenes: Iterable[tuple[str, Scene]], number: int
) -> Iterator[Row]:
    """Rows of all scenes (by name) with a kidney's own model and another's."""
    tracker, other = trackers
    assert tracker.anatomy_ct is not None
    sites = {name: site.kind for name, site in tumor_sites_of(tracker.anatomy_ct).items()}
    for n, (name, scene) in enumerate(scenes):
        about = {"kidney": number, "scene": name, "family": scene.meta.get("family", name)}
        for row in own_rows(tracker, scene, (number, n)):
            yield {**about, "organ": "own", "site": sites[row["tumor"]], **row}
        for row in wrong_rows(tracker, other, scene, (number, n)):
            yield {**about, **row}
