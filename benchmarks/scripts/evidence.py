"""Measure what evidence beside the cloud brings: touches, outlines, landmarks, a held tumor.

    make evidence ARGS='OUT --kidneys 4'     (about 10 minutes on two cores)

Makes random kidneys, their models and scenes in OUT, as `make bounds` does, draws evidence of each
scene from its truth with the errors of tools, calibrations and hands, and locates it with and
without. Prints tables, or fills in a document's block. The same command goes on where it was
stopped; after a change of the method everything is measured again. No patient's anatomy is in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

import tumortrack_benchmarks.physics.evidence
from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import perpendicular, triangles_of
from tumortrack.core.report import NextEvidence
from tumortrack.core.types import Anatomy
from tumortrack.io.scene_folder import Scene, read_scene
from tumortrack.registration.model import RegistrationModel
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.judging import rigid_centers_mm
from tumortrack_benchmarks.physics.evidence import ALL_TRUE, EvidenceSource, Piece, hidden, mirrored
from tumortrack_benchmarks.physics.scenes import random_scenes
from tumortrack_benchmarks.scripting import NOTHING, KidneyOptions, cell

# Of errors, in the document.
_SHOWN = ["kind", "good %", "median, mm", "95 %", "worst", "rigid fit: median", "its 95 %, mm"]
_KINDS = (
    "none", "3 touches, chosen", "6 touches, chosen", "12 touches, chosen", "12 touches, random",
    "1 outline", "12 touches, chosen, and 1 outline", "held tumor", "40 % hidden: none",
    "40 % hidden: 6 touches, chosen",
)  # fmt: skip
_COARSE = 16  # of the volume, which is not used
_AT_A_TIME = 3  # touches, then it is located again
_COUNTS = (3, 6, 12)
_HIDDEN_SHARE = 0.4
WRONG = ("none", "3 touches, chosen", "6 touches, chosen", "3 landmarks")
Pieces = Sequence[Piece]
Row = dict[str, Any]


@dataclass(frozen=True)
class Options(KidneyOptions):
    """Measure what evidence brings."""

    states: int = 24
    """Of each; families take turns."""


def main(options: Options) -> None:
    """Make what is missing, then measure."""
    writer, numbers = scripting.begun("evidence", options.document), options.numbers
    pairs = zip(numbers, [*numbers[1:], *numbers[:1]], strict=True)  # with another one's model
    made = [(options.out, *pair, options.states) for pair in pairs]
    scripting.together(_made, [(options.out, n, options.states) for n in options.numbers])
    rows = scripting.together(_measured, made)
    frame = pd.DataFrame(rows)
    own = frame[frame.organ == "own"]
    families = {("random kidneys", name): errors(some) for name, some in own.groupby("family")}
    each = pd.concat(families, names=["organs", "family"]).reset_index(["organs", "family"])
    tables = {
        "evidence-kidneys-errors": errors(frame),
        "evidence-kidneys-advice": foresight(frame),
        "evidence-kidneys-verdicts": verdicts(frame),
        "evidence-families": each,
    }
    for name, table in tables.items():
        print(name, table_of(table), sep="\n\n", end="\n\n")
    short = tables["evidence-kidneys-errors"]
    short = short.loc[short.kind.isin(_KINDS), _SHOWN]
    scenes = len(own[["kidney", "scene"]].drop_duplicates())
    sample = f"{options.kidneys} organs, {scenes} scenes"
    writer.tables({"evidence": short, **tables}, sample=sample)


def _made(out: Path, number: int, states: int) -> list[Row]:
    """A kidney's scenes, its case and its model."""
    random_scenes(out / str(number), number, states)
    scripting.tracker_of(out / str(number) / "case")
    return []


def _measured(out: Path, number: int, other: int, states: int) -> list[Row]:
    """An organ's rows, with its own model and another's: of one version of the method and of how
    evidence is drawn."""
    scenes = random_scenes(out / str(number), number, states)
    code = scripting.code_sha256(
        [Path(tumortrack_benchmarks.physics.evidence.__file__), Path(__file__)]
    )

    def measure() -> Iterator[Row]:
        own, foreign = (scripting.tracker_of(out / str(n) / "case") for n in (number, other))
        for n, path in enumerate(scenes):
            scene = read_scene(path)
            about = {"kidney": number, "scene": path.name, "family": scene.meta["family"]}
            for row in own_rows(own, scene, (number, n)):
                yield {**about, "organ": "own", **row}
            for row in wrong_rows(own, foreign, scene, (number, n)):
                yield {**about, **row}

    about = {"code": code, "other": other, "scenes": len(scenes)}
    return scripting.kept(out / str(number) / "evidence.json", about, measure)


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
            return self.tracker.locate(
                scene.cloud, grid=_COARSE, full_view=scene.depth, evidence=known
            )
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
    model = tracker.model
    assert isinstance(model, RegistrationModel)
    rigid_mm, hidden_mm = (rigid_centers_mm(model, asker.scene) for asker in (whole, shaded))
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
        out = [told.rejected for told in estimate.report.evidence]
        about["false_out"] = sum(o for o, p in zip(out, pieces, strict=True) if p.false)
        about["true_out"] = sum(o for o, p in zip(out, pieces, strict=True) if not p.false)
    for tumor, off in _off_mm(asker.scene, estimate).items():
        rigid = rigid_mm[tumor]
        yield {
            **about,
            "tumor": tumor,
            "largest_error_mm": float(np.linalg.norm(off)),
            "rigid_mm": rigid,
        }


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
        away_mm = estimate.motion.forward(targets.points_ct[mine]) - targets.points_mm[mine]
        off[name] = away_mm.mean(0)
    return off


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


def errors(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each kind of evidence; of held tumors themselves, also of the pulled ones alone,
    beside what they are without."""
    own = rows[rows.organ == "own"]
    held, some = own.kind.str.startswith("held"), [own[~own.kind.str.startswith("held")]]
    for name, mine in (("", own), ("pulled, ", own[own.family == "pull"])):
        theirs = mine[(mine.tumor == mine.held) & (held[mine.index] | (mine.kind == "none"))]
        beside = theirs.kind.replace("none", "none, of the held tumor")
        some.append(theirs.assign(kind=name + beside))
    groups = pd.concat(some).groupby("kind", sort=False)
    return pd.DataFrame([_errors(name, group) for name, group in groups])


def _errors(name: str, some: pd.DataFrame) -> dict[str, Any]:
    answers = some[some.quality != "none"]
    scenes = answers.drop_duplicates(["kidney", "scene", "kind"])
    good = answers[answers.quality == "good"]
    miss, false = answers.largest_error_mm, scenes.false.sum()
    true = scenes.pieces.sum() - false
    return {
        "kind": name,
        "tumors": len(some),
        "answers %": _percent(len(answers), len(some)),
        "good %": _percent(len(good), len(some)),
        "poor by evidence left out %": _percent((some.finding == "evidence").sum(), len(some)),
        "median, mm": cell(miss.median()),
        "95 %": cell(miss.quantile(0.95)),
        "worst": cell(miss.max()),
        "of good: median": cell(good.largest_error_mm.median()),
        "its 95 %": cell(good.largest_error_mm.quantile(0.95)),
        "rigid fit: median": cell(answers.rigid_mm.median()),
        "its 95 %, mm": cell(answers.rigid_mm.quantile(0.95)),
        "false left out %": _percent(scenes.false_out.sum(), false),
        "true left out %": _percent(scenes.true_out.sum(), true),
    }


def foresight(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each three touches that were advised: deviations foreseen, errors found (root mean
    square), both along the axis that was least sure, and the found share of the foreseen gain."""
    columns = ["std_mm", "then_std_mm", "off_before_mm", "off_after_mm"]
    told = rows.reindex(columns=[*dict.fromkeys([*rows, *columns])])  # perhaps nothing was advised
    told = told[told.then_std_mm.notna()].drop_duplicates(["kidney", "scene", "kind"])
    gain = (told.off_before_mm - told.off_after_mm) / (told.std_mm - told.then_std_mm)
    kinds = told.assign(gain=gain).groupby("kind", sort=False)
    squares = (told[columns] ** 2).groupby(told.kind, sort=False).mean() ** 0.5
    squares.columns = ["foreseen before, mm", "and after", "found before, mm", "found after"]
    found = squares.assign(**{
        "found before, median": kinds.off_before_mm.median(),
        "after, median": kinds.off_after_mm.median(),
        "found/foreseen gain: median": kinds.gain.median(),
    }).map(partial(cell, digits=2))  # fmt: skip
    found.insert(0, "advised", kinds.size())
    ends = {f"{100 * q:.0f} %": kinds.gain.quantile(q).map(cell) for q in (0.1, 0.9)}
    return found.assign(**ends).rename_axis("with").reset_index()


def verdicts(rows: pd.DataFrame) -> pd.DataFrame:
    """How often the own organ, its mirror image and another one are called good, by evidence."""
    scenes = rows[rows.kind.isin(WRONG)].drop_duplicates(["kidney", "scene", "organ", "kind"])
    lines = []
    for organ, some in scenes.groupby("organ", sort=False):
        line = {"organ": organ, "scenes": int((some.kind == WRONG[0]).sum())}
        for kind in WRONG:
            mine = some[some.kind == kind].quality
            line[f"good %: {kind}"] = _percent((mine == "good").sum(), len(mine))
        lines.append(line)
    return pd.DataFrame(lines)


def _percent(count: float, of: float) -> str:
    return f"{100 * count / of:.0f}" if of else NOTHING


if __name__ == "__main__":
    scripting.run(main, Options)
