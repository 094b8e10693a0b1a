"""How often a model calls the estimate of another kidney good: other organs, and mirrored ones.

    make foreign ARGS='--case NAME=FOLDER ... --opposite NAME=FOLDER ...'     (about an hour)

Writes a block of docs/results.md. Every organ gets a `clinic` model; every model sees scenes of its
own organ, of that organ mirrored left to right, of the organs nearest in volume, and of the same
patient's other kidney. Nothing hides the organ, and its points are given: what is asked is whether
shape alone tells it. Each estimate is judged three times: by a depth image in which the organ lies
on a bare table, by one that shows nothing behind it (as tissue at the organ's height), and by the
cloud alone. Models and rows are kept under --out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from tumortrack import api
from tumortrack.cli.console import say
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.types import Anatomy, DepthFrame, Mesh
from tumortrack.imaging.case import load_case
from tumortrack.models.folder import is_finished
from tumortrack.phantom.digital import PhantomParameters
from tumortrack.phantom.kidneys import random_anatomy
from tumortrack.sense.noise import D405_NOISE
from tumortrack.sense.render import render_depth
from tumortrack.simulate.deform import ElasticConfig, RestConfig
from tumortrack.simulate.scene import SceneConfig
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.quality import judged
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.presets import clinic
from tumortrack.training.train import TrainingRun, train
from tumortrack_lab.study import trainings
from tumortrack_lab.study.document import ReportWriter, table
from tumortrack_lab.study.methods import named_folders, phantom_case

BLOCK = "foreign"
MIRROR = np.array([-1.0, 1.0, 1.0])  # LPS: left to right
STATES = {"undeformed": RestConfig(), "deformed": ElasticConfig()}
KINDS = {
    "own": "its own organ",
    "mirrored": "its organ, mirrored",
    "opposite": "the patient's other kidney",
    "foreign": "another's kidney",
}
VERDICTS = ("refused", "poor", "good")
VIEWS = {"table": "on a table", "nothing": "nothing seen behind", "cloud": "cloud alone"}
WORST = 4  # of each view, in the last table


@dataclass(frozen=True, kw_only=True)
class Options(trainings.KeptOptions):
    """Train models, show them other organs, and count what they call good."""

    case: tuple[str, ...] = ()
    """More organs than phantom and random ones, each NAME=FOLDER (of `tumortrack prepare`)."""
    opposite: tuple[str, ...] = ()
    """The other kidney of a --case, by the same NAME."""
    models: tuple[int, ...] = (1, 2, 3, 4)
    """Seeds of random kidneys that get a model."""
    others: tuple[int, ...] = (5, 6, 7, 8)
    """Seeds of random kidneys that are only seen."""
    steps: int = 1000
    """Of each training."""
    own: int = 6
    """Scenes of a model's own organ, and of the patient's other kidney; half of them deformed."""
    mirrored: int = 12
    """Scenes of it mirrored."""
    foreign: int = 6
    """Other organs that a model sees, each undeformed and deformed."""
    seed: int = 0
    """Of trainings and scenes."""
    out: Path = Path("runs/foreign")
    document: Path = Path("docs/results.md")


@dataclass(frozen=True, eq=False)
class Organ:
    """``anatomy``: CT frame, mm; ``patient``: organs of one patient share it."""

    name: str
    patient: str
    anatomy: Anatomy
    up_lps: tuple[float, float, float]

    @property
    def ml(self) -> float:
        return self.anatomy.organ.volume_mm3 / 1000

    def mirrored(self) -> Organ:
        parts = (
            Mesh(part.vertices_mm * MIRROR, part.faces[:, ::-1]) for part in self.anatomy.parts
        )
        x, y, z = self.up_lps
        return Organ(f"{self.name}, mirrored", self.patient, Anatomy(tuple(parts)), (-x, y, z))


def main(options: Options) -> None:
    """Every model, then the block."""
    writer = options.begin(BLOCK, BLOCK)
    folders = {"phantom": phantom_case(options.out / "phantom", PhantomParameters())}
    folders |= named_folders(options.case, folders)
    opposite = named_folders(options.opposite, ())
    if unknown := opposite.keys() - folders.keys():
        raise InputError(f"--opposite {unknown.pop()} is the other kidney of no --case.")
    own = [_of_case(name, name, folder) for name, folder in folders.items()]
    own += map(_random, options.models)
    seen = [_of_case(f"{name}, other kidney", name, folder) for name, folder in opposite.items()]
    seen += map(_random, options.others)
    scenes = cache(partial(_scene_maker, seed=options.seed))
    rows = []
    for organ in own:
        others = [one for one in own + seen if one.patient != organ.patient]
        others = sorted(others, key=lambda one: abs(one.ml - organ.ml))[: options.foreign]
        about = {
            "organs": [organ.name, *(one.name for one in others)],
            "volumes_ml": [round(one.ml, 3) for one in (organ, *others)],
            "counts": [options.steps, options.own, options.mirrored, options.seed],
            "views": list(VIEWS),
        }
        pairs = partial(_pairs, organ, others, seen, options, scenes)
        measure = partial(_measured, organ, pairs, options)
        rows += trainings.kept(options.out / f"{organ.name}.json", about, measure)
    _write(pd.DataFrame(rows), {one.name: one.ml for one in own}, options, writer)


def _of_case(name: str, patient: str, folder: Path) -> Organ:
    case = load_case(folder)
    return Organ(name, patient, case.anatomy, case.up_lps)


def _random(seed: int) -> Organ:
    return Organ(f"random {seed}", f"random {seed}", *random_anatomy(seed))


def _scene_maker(organ: Organ, state: str, seed: int) -> Callable[[int], Scene]:
    # Not the scenes, nor the elastic states, that a training has seen: see api.scene_maker.
    config = SceneConfig(deform=(STATES[state],), noise=D405_NOISE)
    return cache(api.scene_maker(organ, config, seed))


def _pairs(
    organ: Organ, others: list[Organ], seen: list[Organ], options: Options, scenes: Callable
) -> Iterator[tuple[str, str, str, Scene]]:
    """Kind, whose organ, state and scene."""
    opposite = [one for one in seen if one.patient == organ.patient]
    wanted = [("own", organ, options.own), ("mirrored", organ.mirrored(), options.mirrored)]
    wanted += [("opposite", one, options.own) for one in opposite]
    wanted += [("foreign", one, 2) for one in others]
    for kind, one, count in wanted:
        for number in range(count):
            state = tuple(STATES)[number % 2]
            yield kind, one.name, state, scenes(one, state)(number // 2)


def _measured(
    organ: Organ, pairs: Callable[[], Iterator[tuple[str, str, str, Scene]]], options: Options
) -> list[dict]:
    """A row a pair."""
    folder = options.out / "models" / organ.name.replace(" ", "_")
    if not is_finished(folder):
        say(f"{organ.name}: training")
        train(_run(organ, options), folder, lambda status: None)
    tracker, rows = Tracker(api.load_model(folder, "cpu")), []
    for kind, whose, state, scene in pairs():
        row = {"model": organ.name, "kind": kind, "organ": whose, "state": state}
        rows.append({**row, **_verdicts(tracker, scene, kind)})
        say(f"{organ.name}: {rows[-1]}")
    return rows


def _run(organ: Organ, options: Options) -> TrainingRun:
    return TrainingRun(
        organ.anatomy, organ.up_lps, organ.name, clinic(organ.anatomy), options.seed,
        steps=options.steps, device="cpu", workers=0,
    )  # fmt: skip


def _verdicts(tracker: Tracker, scene: Scene, kind: str) -> dict:
    """What is said by each view, and how far off the tumors are."""
    seen = {"table": on_table(scene), "nothing": scene.depth, "cloud": scene.cloud}
    try:
        estimate = tracker.follow(scene.cloud)
    except NoEstimate as error:  # whatever is seen
        return dict.fromkeys(seen, "refused") | {"reason": str(error)}
    row = _errors(estimate, scene, kind)
    row["cost"] = estimate.report["fit_cost"]["now"] / estimate.report["fit_cost"]["usual"]
    for view, content in seen.items():
        try:
            row[view] = judged(estimate, content).quality
        except NoEstimate:
            row[view] = "refused"
    return row


def on_table(scene: Scene) -> DepthFrame:
    """The scene's depth image with a level table at the organ's lowest point, where the organ does
    not hide it."""
    frame, organ = scene.depth, scene.reference.organ
    beside = ~np.isfinite(render_depth(organ.vertices_mm, organ.faces, frame.intrinsics).depth_mm)
    depth_mm = frame.depth_mm.copy()
    depth_mm[beside & ~np.isfinite(depth_mm)] = organ.box_mm[1, 2]
    return frame.with_depth(depth_mm)


def _errors(estimate: Estimate, scene: Scene, kind: str) -> dict:
    """mm: ``tumor_mm``, how far the middle of a tumor of the estimate's is from that of the same
    tumor, or of another's organ from its nearest one; the largest. ``target_mm``: mean error of
    inner points, of which only the organ itself and its mirror image have the same."""
    true, same, off_mm = scene.reference.tumors, kind in ("own", "mirrored"), []
    found = [mesh for name, mesh in estimate.meshes.items() if name != "kidney"]
    for number, mesh in enumerate(found if true else ()):
        places = [one.box_mm.mean(0) for one in ([true[number]] if same else true)]
        off_mm.append(min(np.linalg.norm(mesh.box_mm.mean(0) - place) for place in places))
    errors = {"tumor_mm": float(max(off_mm))} if off_mm else {}
    if same:
        points_ct = scene.targets.points_ct * (MIRROR if kind == "mirrored" else 1)
        there = estimate.motion.carry(points_ct) - scene.targets.points_mm
        errors["target_mm"] = float(np.linalg.norm(there, axis=1).mean())
    return errors


def _write(
    rows: pd.DataFrame, volumes_ml: dict[str, float], options: Options, writer: ReportWriter
) -> None:
    """The block: verdicts by kind and state, by model, and the worst that was called good."""
    both = pd.concat([rows, rows.assign(state="all")])
    head = ["what the camera sees", "state", "view", "pairs", *VERDICTS, "good, % (95 % interval)"]
    body = [
        [KINDS[kind], state, words, str(len(some))]
        + [str((some[view] == verdict).sum()) for verdict in VERDICTS]
        + [_share(some[view] == "good")]
        for kind in KINDS
        for state in (*STATES, "all")
        for view, words in VIEWS.items()
        if len(some := both[(both.kind == kind) & (both.state == state)])
    ]
    each = [
        [name, f"{volumes_ml[name]:.0f}", *(_counts(mine[mine.kind == kind]) for kind in KINDS)]
        for name, mine in rows.groupby("model", sort=False)
    ]
    passed = (rows[[*VIEWS]] == "good").any(axis=1)
    wrong = rows[(rows.kind != "own") & passed]
    by_error = wrong.sort_values("tumor_mm", ascending=False, na_position="last")
    worst = pd.concat([by_error[by_error[view] == "good"].head(WORST) for view in VIEWS])
    worst = worst[~worst.index.duplicated()]
    furthest = [
        [
            one.model, one.organ, one.state,
            ", ".join(words for view, words in VIEWS.items() if getattr(one, view) == "good"),
            _mm(one.tumor_mm), _mm(one.target_mm), f"{one.cost:.2f}",
        ]
        for one in worst.itertuples()
    ]  # fmt: skip
    worst_head = ["model", "what the camera saw", "state", "called good", "tumor off, mm"]
    parts = [
        table(head, body, 3),
        f"Called good, by model ({', '.join(VIEWS.values())}; of all):",
        table(["model", "ml", *KINDS.values()], each),
        f"Of the {len(wrong)} that any view called good and that are not the organ, the "
        f"{WORST} worst of each view:",
        table([*worst_head, "points off, mm", "cost / usual"], furthest, 4),
        f"`{writer.command}`: models of {options.steps:,} steps of the preset clinic each, seed "
        f"{options.seed}; D405 noise. Intervals are Wilson's. Tumor off: between the middles of "
        "the estimated tumor and the same one, or of another's organ its nearest; points off: mean "
        "over inner points, which the mirror image has too. Cost: of the fit, over that above "
        "which it is poor.",
    ]
    writer.write({BLOCK: "\n\n".join(parts)})


def _share(good: pd.Series) -> str:
    """Percent, with the interval."""
    low, high = binomtest(int(good.sum()), len(good)).proportion_ci(method="wilson")
    return f"{100 * good.mean():.0f} ({100 * low:.0f} to {100 * high:.0f})"


def _counts(rows: pd.DataFrame) -> str:
    good = "/".join(str((rows[view] == "good").sum()) for view in VIEWS)
    return f"{good} of {len(rows)}" if len(rows) else "–"


def _mm(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.1f}"


if __name__ == "__main__":
    trainings.run(main, Options)
