"""Learn how far off parts may be, from random organs in all families of the wider world's physics.

    make bounds ARGS='OUT --kidneys 9'     (an hour on two cores)

Makes organs, their models and scenes in OUT, locates each scene with and without evidence, by its
cloud and its depth image, hidden and noisy, and fits ``assessment.bound`` to how far off the parts
are; writes it to ``--write``, with what came of its advice on further kidneys. Prints, or fills in
a document's blocks, what it is worth for organs, families of physics and kinds of evidence that
were left out. The same command goes on where it was stopped. No patient's anatomy is in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import tyro
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator
from scipy.optimize import minimize
from scipy.stats import spearmanr

from tumortrack.assessment.advice import advise
from tumortrack.assessment.bound import CONFIDENCE, POOR_MM, BoundModel, Quantile, figures
from tumortrack.assessment.fingerprint import fingerprint
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import FAR_MM, Estimate
from tumortrack.core.organ import is_tumor
from tumortrack.core.report import FAR_OFF
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.io.scene_folder import Scene, read_scene
from tumortrack.registration.model import RegistrationModel
from tumortrack.report import drawing
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import share_words, table_of
from tumortrack_benchmarks.judging import rigid_centers_mm
from tumortrack_benchmarks.physics.evidence import ALL_TRUE, ERRORS, EvidenceSource, hidden
from tumortrack_benchmarks.physics.scenes import random_scenes

_FIRST = {"prostate": 2000, "liver": 3000}  # numbers of organs
_LEAST_MM, _LOST_MM = 0.1, 30.0  # misses: less is noise; more are other minima, which fits refuse
_KNOTS = (0.02,)  # quantiles of a figure from which it counts; more fit no better what is left out
_SMOOTH = 0.05  # of the pinball's corner, so that its slope is one
_RIDGE = 1e-2  # pulls weights that tell nothing to 0
_VERTICES = 300  # of a part, where its miss is measured
# Two readers' kidneys differ by 0.5 mm rms (KiTS23). Scenes whose true organ differs from the case
# by more than this are of worse segmentations than the bounds are for.
READERS_MM = 0.75
_TICKS_MM = (2, 5, 10, 20, 50, 100)
_IN_A_BIN, _MOST_BINS = 40, 6  # answers of which a quantile is shown
_ANSWER = ["organ", "scene", "answer"]
_ABOUT = {
    *_ANSWER, "shape", "family", "segmentation_mm", "by", "evidence", "part", "largest_error_mm",
    "center_mm", "rigid_fit_mm", "finding", "bound_mm",
}  # fmt: skip
EVIDENCE: tuple[dict[str, int], ...] = (
    {"touch": 1}, {"touch": 4}, {"touch": 12}, {"touch": 40}, {"outline": 1}, {"outline": 2},
    {"landmark": 1}, {"landmark": 3}, {"landmark": 6}, {"held": 1}, {"touch": 12, "outline": 1},
    {"free": 3},
)  # fmt: skip
ALONE: tuple[dict[str, int], ...] = {"touch": 16}, {"touch": 48}, {"plane": 3}, {"plane": 12}
_ADVICE = ["kind", "foreseen_mm", "found_mm", "miss_before_mm", "miss_after_mm"]
_NO_CLOUD = SensorCloud(np.zeros((0, 3), np.float32))


@dataclass(frozen=True)
class Options:
    """Learn how far off parts may be."""

    out: tyro.conf.Positional[Path]
    """Folder of organs and scenes."""
    kidneys: int = 9
    """So many."""
    first: int = 1000
    """Number of the first."""
    others: int = 1
    """Livers, and as many prostates."""
    advice: int = 2
    """Further kidneys, on which advice is tested."""
    states: int = 40
    """Of each kidney; families take turns."""
    other_states: int = 24
    """Of each of the others."""
    write: Path | None = None
    """File for what was learned: src/tumortrack/assessment/bounds.json."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""


def main(options: Options) -> None:
    """Make what is missing, then fit."""
    writer = scripting.begun("bounds", options.document)
    organs = list(_organs(options))
    rows = pd.DataFrame(scripting.together(_rows, [(options.out, "bounds", *o) for o in organs]))
    rows = rows[rows.segmentation_mm <= READERS_MM]
    organs_out, kinds = bounded(rows, "organ"), ("family", "evidence", "shape")
    ways = [(organs_out, "family"), (organs_out, "shape")]
    ways += [(bounded(rows, kind), kind) for kind in kinds if rows[kind].nunique() > 1]
    tables = [left_out(*way).astype(object).fillna(scripting.NOTHING) for way in ways]
    if options.document is not None:
        draw(organs_out, writer.image("bounds"))
    print(*map(table_of, tables), sep="\n\n")
    named = [table.rename(columns={table.columns[0]: "of"}) for table in tables]
    written = {"bounds": pd.concat(named[:2]), "bounds-left-out": pd.concat(named[2:])}
    about = {"organs": len(organs)}
    if options.write is not None:
        store.write_json(options.write, to_builtins(learned(rows, about)))
    first = options.first + options.kidneys  # not known to what was learned
    further = [
        (options.out, "advice", "kidney", first + n, options.states) for n in range(options.advice)
    ]
    found = advice_found(pd.DataFrame(scripting.together(_rows, further)))
    print(table_of(found))
    written["bounds-advice"] = found
    if options.write is not None:
        ratios = dict(zip(found.kind, found["found / foreseen"], strict=True))
        store.write_json(options.write, to_builtins(learned(rows, about, ratios)))
    of_all = tables[0].iloc[-1]
    good = round(int(of_all["answers"]) * int(of_all["good %"]) / 100)
    over = share_words(int(of_all["center over 5 mm"]), good)
    sample = f"{len(rows)} parts in answers of {len(organs)} random organs"
    writer.tables(written, sample=sample, interval=f"over 5 mm {over} of good")


def _organs(options: Options) -> Iterator[tuple[str, int, int]]:
    """Shape, number and states."""
    for shape, first in {"kidney": options.first, **_FIRST}.items():
        kidney = shape == "kidney"
        count = options.kidneys if kidney else options.others
        states = options.states if kidney else options.other_states
        yield from ((shape, first + n, states) for n in range(count))


def _rows(out: Path, name: str, shape: str, number: int, states: int) -> list[dict[str, Any]]:
    """An organ's rows of bounds, or of what came of advice by the bounds that are in the package
    now; and before them its scenes."""
    folder, make = out / str(number), rows_of if name == "bounds" else advice_rows

    def measure() -> Iterator[dict[str, Any]]:
        scenes = random_scenes(folder, number, states, shape)
        tracker = scripting.tracker_of(folder / "case")
        for seed, scene in enumerate(scenes):
            for row in make(tracker, read_scene(scene), seed):
                yield {"shape": shape, "organ": number, "scene": scene.name, **row}

    return scripting.kept(folder / f"{name}.json", {"states": states}, measure)


class _Asked(NamedTuple):
    """What an answer is given: a scene, what judges it, and how many pieces of evidence."""

    scene: Scene
    full_view: DepthFrame | None
    evidence: Mapping[str, int]
    false_too: bool = False
    alone: bool = False  # without a cloud


def rows_of(tracker: Tracker, scene: Scene, seed: int) -> Iterator[dict[str, Any]]:
    """A row a part and answer: the largest miss of its points, its centre's, its figures, and the
    verdict so far. The scene is asked alone, by cloud and by image, then in pairs without and with
    evidence, of half of them a share hidden, noisy or both, and by touches or outlines without a
    cloud. Without an answer there is none."""
    model, rng = tracker.model, np.random.default_rng([seed, 53])
    assert isinstance(model, RegistrationModel)
    for number, asked in enumerate(_asked(scene, rng)):
        source = EvidenceSource.of(
            asked.scene, [seed, number], ERRORS if asked.false_too else ALL_TRUE
        )
        pieces = [piece.evidence for piece in source.drawn(asked.evidence)]
        cloud = _NO_CLOUD if asked.alone else asked.scene.cloud
        try:
            found = tracker.locate(cloud, grid=8, full_view=asked.full_view, evidence=pieces)
        except NoEstimate:
            continue
        rigid_mm = rigid_centers_mm(model, asked.scene) if number == 0 else {}
        kinds = "alone: " * asked.alone + ("+".join(sorted(asked.evidence)) or "none")
        for name, largest_mm, center_mm in _misses(found, scene, model):
            known = figures(found.report, name)
            if known is not None:
                yield {
                    "answer": number,
                    "family": scene.meta["family"],
                    "segmentation_mm": (scene.meta["segmentation"].get("rms_mm") or [0.0])[0],
                    "by": "cloud" if asked.full_view is None else "image",
                    "evidence": kinds,
                    "part": name,
                    "largest_error_mm": largest_mm,
                    "center_mm": center_mm,
                    "rigid_fit_mm": rigid_mm.get(name, np.nan),
                    "finding": None if found.finding is None else found.finding.kind,
                    **known,
                }


def _asked(scene: Scene, rng: np.random.Generator) -> Iterator[_Asked]:
    yield _Asked(scene, None, {})
    if scene.depth is not None:
        yield _Asked(scene, scene.depth, {})
    for _ in range(2):
        shown = hidden(scene, rng.uniform(0.2, 0.6), rng) if rng.uniform() < 0.5 else scene
        if rng.uniform() < 0.3:
            shown = _noisy(shown, rng.uniform(0.5, 2.0), rng)
        yield _Asked(shown, None, {})
        yield _Asked(shown, None, EVIDENCE[rng.integers(len(EVIDENCE))], rng.uniform() < 0.5)
    yield _Asked(scene, None, ALONE[rng.integers(len(ALONE))], alone=True)


def advice_rows(tracker: Tracker, scene: Scene, seed: int) -> Iterator[dict[str, Any]]:
    """Of a scene that is half hidden, what advice on its least sure tumor foresaw of the bound, and
    what came of it: a row for the best three touches, and for the best outline."""
    rng = np.random.default_rng([seed, 54])
    scene = hidden(scene, 0.5, rng)
    try:
        before = tracker.locate(scene.cloud, grid=8)
    except NoEstimate:
        return
    if before.finding is not None and before.finding.kind not in FAR_OFF:
        return  # then none is shown
    tumors, bounds = before.report.tumors, before.assessment.bounds
    part = max(tumors, key=lambda name: bounds[name].error_bound95_mm)
    advice = advise(before, part)
    assert isinstance(tracker.model, RegistrationModel)
    missed = {name: mm for name, mm, _ in _misses(before, scene, tracker.model)}
    for kind in ("touch", "outline"):
        source = EvidenceSource.of(scene, [seed, 54], ALL_TRUE)
        mine = [each for each in advice if each.kind == kind]
        if not mine:
            continue
        if kind == "touch":
            pieces = source.touches(*(np.array([getattr(each, field) for each in mine])
                                      for field in ("place_mm", "direction")))  # fmt: skip
        else:
            number = int(part.removeprefix("tumor_")) - 1
            outline = source.outline(number, np.array(mine[0].direction))
            pieces = [] if outline is None else [outline]
        then_mm = mine[-1].then_bound_mm
        try:
            after = tracker.locate(scene.cloud, grid=8, evidence=[each.evidence for each in pieces])
        except NoEstimate:
            continue
        assert then_mm is not None
        yield {
            "kind": kind,
            "foreseen_mm": bounds[part].error_bound95_mm - then_mm,
            "found_mm": bounds[part].error_bound95_mm
            - after.assessment.bounds[part].error_bound95_mm,
            "miss_before_mm": missed[part],
            "miss_after_mm": {n: mm for n, mm, _ in _misses(after, scene, tracker.model)}[part],
        }


def advice_found(rows: pd.DataFrame) -> pd.DataFrame:
    """By kind of evidence, how much the bound fell over what was foreseen where that was more than
    a third of a millimetre, and the misses before and after."""
    rows = rows.reindex(columns=_ADVICE)  # perhaps there was none
    kinds = rows[rows.foreseen_mm > 1 / 3].groupby("kind")
    means, medians = kinds[["foreseen_mm", "found_mm"]].mean(), kinds.median()
    return pd.DataFrame({
        "answers": kinds.size(),
        "foreseen, mm": means.foreseen_mm,
        "found": means.found_mm,
        "found / foreseen": means.found_mm / means.foreseen_mm,
        "miss before: median": medians.miss_before_mm,
        "and after": medians.miss_after_mm,
    }).round(2).reset_index()  # fmt: skip


def _noisy(scene: Scene, std_mm: float, rng: np.random.Generator) -> Scene:
    """Along each point's ray."""
    points = scene.cloud.points_mm
    away = 1 + rng.normal(0, std_mm, len(points)) / np.linalg.norm(points, axis=1)
    return replace(scene, cloud=SensorCloud((points * away[:, None]).astype(np.float32)))


def _misses(
    found: Estimate, scene: Scene, model: RegistrationModel
) -> Iterator[tuple[str, float, float]]:
    """Of each part, of all its points and of its centre, mm: at the surface extrapolated from the
    inner points, whose true places are known."""
    assert scene.targets is not None
    assert found.motion is not None
    targets = scene.targets
    off_mm = found.motion.forward(targets.points_ct) - targets.points_mm
    at = RBFInterpolator(targets.points_ct, off_mm, kernel="linear", degree=1)
    for label, part in enumerate(model.shape.anatomy_ct.parts, start=1):
        mine, name = targets.labels == label, model.parts[label - 1]
        if label == 1:
            mine = np.ones(len(mine), bool)
        if mine.any():
            vertices = part.vertices_mm[:: len(part.vertices_mm) // _VERTICES + 1]
            largest_mm = np.linalg.norm(at(vertices), axis=1).max()
            yield name, float(largest_mm), float(np.linalg.norm(off_mm[mine].mean(0)))


def learned(
    rows: pd.DataFrame, about: dict[str, Any], advice: Mapping[str, float] = MappingProxyType({})
) -> BoundModel:
    """Of tumors and organs; ``advice``: see ``BoundModel``."""
    tumor = rows.part.map(is_tumor)
    of_tumor, of_organ = (quantile_of(rows[mine]) for mine in (tumor, ~tumor))
    about = {**about, "answers": len(rows)}
    return BoundModel(fingerprint(), of_tumor, of_organ, dict(advice), about)


def quantile_of(rows: pd.DataFrame) -> Quantile:
    """The weights of the least pinball loss of the logarithm, then the constant that 95 % lie
    within, each family of physics counting alike: of answers that nothing else speaks
    against."""
    calm = rows[_acceptable(rows) & (rows.largest_error_mm < _LOST_MM)]
    names = [name for name in rows.columns if name not in _ABOUT]
    knots = [(name, float(k)) for name in names for k in np.unique(calm[name].quantile(_KNOTS))]
    values = np.column_stack([(calm[name] - knot).clip(lower=0) for name, knot in knots])
    logs = np.log(calm.largest_error_mm.clip(lower=_LEAST_MM).to_numpy())
    share = (1 / calm.groupby("family").largest_error_mm.transform("size")).to_numpy()
    share = share / share.sum()

    spread = values.std(0)

    def loss(unknowns: Float[np.ndarray, " w"]) -> tuple[float, Float[np.ndarray, " w"]]:
        over = (logs - unknowns[0] - values @ unknowns[1:]) / _SMOOTH
        steep = 1 / (1 + np.exp(-np.clip(over, -50, 50)))
        pinball = (CONFIDENCE - 1) * over + np.logaddexp(0, over)
        slope = -share * (CONFIDENCE - 1 + steep)
        ridge = _RIDGE * spread**2 * unknowns[1:]
        gradient = np.append(slope.sum(), values.T @ slope + 2 * ridge)
        return float(share @ pinball * _SMOOTH + ridge @ unknowns[1:]), gradient

    first = np.append(np.quantile(logs, CONFIDENCE), np.zeros(len(knots)))
    limits = [(None, None), *[(0.0, None)] * len(knots)]
    best = minimize(loss, first, jac=True, bounds=limits, method="L-BFGS-B").x
    left = logs - values @ best[1:]
    constant = _weighted_quantile(left, share)
    hinges: dict[str, list[tuple[float, float]]] = {}
    for (name, knot), weight in zip(knots, best[1:], strict=True):
        if weight > 1e-4:
            hinges.setdefault(name, []).append((round(knot, 4), round(float(weight), 4)))
    kept = {name: tuple(each) for name, each in hinges.items()}
    return Quantile(round(constant, 4), kept)


def _weighted_quantile(values: np.ndarray, share: np.ndarray) -> float:
    order = np.argsort(values)
    below = np.cumsum(share[order])
    rank = min(int(np.searchsorted(below, CONFIDENCE * (1 + 1 / len(values)))), len(values) - 1)
    return float(values[order][rank])


def bounded(rows: pd.DataFrame, part: str) -> pd.DataFrame:
    """Tumors with the ``bound_mm`` that was learned without their organ, their family of physics or
    their kind of evidence."""
    tumors = rows[rows.part.map(is_tumor)].assign(bound_mm=np.nan)
    for name in tumors[part].unique():
        mine = tumors[part] == name
        model = quantile_of(tumors[~mine])
        each = tumors[mine][[*model.hinges]].to_dict("records")
        tumors.loc[mine, "bound_mm"] = [model.bound_mm(known) for known in each]
    return tumors


def draw(tumors: pd.DataFrame, path: Path) -> None:
    """Whether bounds hold: for bounds of each size, the 95 % quantile of the largest misses, by
    family of physics and by kind of evidence."""
    figure = drawing.new_figure(8.0, 4.4, left=0.08, right=0.98, top=0.88, bottom=0.14)
    calm = tumors[_acceptable(tumors)]
    for axes, by in zip(figure.subplots(1, 2, sharey=True), ("family", "evidence"), strict=True):
        axes.plot(*[(1.5, 20)] * 2, color="0.6", linestyle="--")
        for number, (name, some) in enumerate([("all", calm), *calm.groupby(by)]):
            bins = max(min(len(some) // _IN_A_BIN, _MOST_BINS), 1)
            size = some.groupby(pd.qcut(some.bound_mm, bins, duplicates="drop"), observed=True)
            along = size.bound_mm.median(), size.largest_error_mm.quantile(CONFIDENCE)
            style = {"color": "0.1" if name == "all" else f"C{number % 10}", "markersize": 4}
            style["linewidth"] = 2.2 if name == "all" else 1.0
            axes.plot(*along, marker="o", label=name, **style)
        axes.set(xscale="log", yscale="log", xlabel=f"bound, mm, by {by}")
        axes.set_xticks(_TICKS_MM[:4], _TICKS_MM[:4])
        axes.set_yticks(_TICKS_MM, _TICKS_MM)
        axes.minorticks_off()
        axes.legend(fontsize=7, frameon=False)
        axes.grid(color="0.9")
    figure.axes[0].set_ylabel("95 % of the largest misses, mm")
    drawing.save(figure, path)


def left_out(tumors: pd.DataFrame, by: str) -> pd.DataFrame:
    """A line for each of ``by``, of what ``bounded`` made: what was learned from the others says of
    it. An answer is good if that holds for all its tumors."""
    near = _acceptable(tumors) & (tumors.bound_mm <= POOR_MM)
    good = near.groupby([tumors[name] for name in _ANSWER]).transform("all")
    lines = []
    for name, some in [*tumors.groupby(by), ("all", tumors)]:
        calm, mine = some[_acceptable(some)], some[good[some.index]]
        lines.append({
            by: name,
            "answers": len(some),
            "good %": round(100 * len(mine) / len(some)),
            "center of good, mm: median": round(mine.center_mm.median(), 1),
            "95 %": round(mine.center_mm.quantile(0.95), 1),
            "worst": round(mine.center_mm.max(), 1),
            "rigid fit: median": round(mine.rigid_fit_mm.median(), 1),
            "its 95 %": round(mine.rigid_fit_mm.quantile(0.95), 1),
            "center over 5 mm": int((mine.center_mm > FAR_MM).sum()),
            "within the bound %": round(100 * (calm.largest_error_mm <= calm.bound_mm).mean(), 1),
            "bound, median": round(calm.bound_mm.median(), 1),
            "rank correlation": round(spearmanr(calm.largest_error_mm, calm.bound_mm)[0], 2),
        })  # fmt: skip
    return pd.DataFrame(lines)


def _acceptable(rows: pd.DataFrame) -> pd.Series:
    """Whether nothing but what was learned speaks against an answer."""
    return rows.finding.isna() | rows.finding.isin(FAR_OFF)


if __name__ == "__main__":
    scripting.run(main, Options)
