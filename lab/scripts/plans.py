"""Does the whole instrument keep its distance, and what does that cost?

    make plans ARGS='OUT [CASE=SCENES ...] --kidneys 100'       (2 to 20 s a plan)

Plans with the motions of both arms for every tumor of which over 30 % lie outside the organ: on
what a case's model locates in a folder of scenes, which then cuts the true organ; and on random
kidneys as they are, each as it faces the camera. Poor answers and exceeded error budgets are
accepted: other tables ask for those. Rows are kept in OUT; the same command goes on.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import tyro

import tumortrack_resection
from tumortrack.cli.console import model_folder, say
from tumortrack.core.errors import InputError, NoEstimate, NoPlan
from tumortrack.core.geometry import rotation_onto
from tumortrack.core.types import Anatomy
from tumortrack.simulate.scene_folder import read_scene
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench.planning import on_its_stand
from tumortrack_lab.cut import Swept, cut
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import share_words, table_of
from tumortrack_lab.study.methods import code_sha256
from tumortrack_lab.study.tables import NOTHING
from tumortrack_lab.twin.apparatus import moved
from tumortrack_lab.world.kidneys import random_anatomy
from tumortrack_resection.arms.body import cell_urdf
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.arms.procedure import search_bases
from tumortrack_resection.check import checked, electrode_poses
from tumortrack_resection.drafts import exophytic_shares
from tumortrack_resection.located import STAND_MM, of_estimate, table_under
from tumortrack_resection.planning import below
from tumortrack_resection.values import Located, ResectionConfig, name_of

_LEAST_SHARE = 0.3  # of a tumor, outside the organ


@dataclass(frozen=True)
class Options:
    """Plan, check, cut."""

    out: tyro.conf.Positional[Path]
    """Where rows are kept."""
    cases: tyro.conf.Positional[tuple[str, ...]] = ()
    """CASE=SCENES: a folder that `prepare` wrote, and a folder of scenes of it."""
    kidneys: int = 100
    """Random kidneys, by their numbers from 0."""
    margins: tuple[float, ...] = (5.0, 9.0)
    """Of scenes, mm; random kidneys get the first alone."""
    document: Path | None = None
    """A page that shows the table, which goes beside it."""


class Subject(NamedTuple):
    """Something to plan on. ``true``: the organ as it is, table frame; None: as located."""

    group: str
    name: str
    located: Located
    true: Anatomy | None
    margins: tuple[float, ...]


def main(options: Options) -> None:
    """Make missing rows, then the table."""
    writer = scripts.begun("plans", options.document)
    options.out.mkdir(parents=True, exist_ok=True)
    rows, planner = [], code_sha256(Path(tumortrack_resection.__path__[0]).rglob("*.py"))
    for subject in _subjects(options):
        for label, share in exophytic_shares(subject.located, list(subject.located.tumors)).items():
            if share < _LEAST_SHARE:
                continue
            for margin_mm in subject.margins:
                name = f"{subject.group}-{subject.name}-{name_of(label)}-{margin_mm:g}.json"
                measure = partial(_plans, subject, label, margin_mm)
                rows += scripts.kept(options.out / name, {"planner": planner}, measure)
                say(f"{name}: {rows[-1].get('refused') or rows[-1]['least_mm']}")
    frame = pd.DataFrame(rows)
    frame.to_csv(options.out / "plans.csv", index=False)
    for (group, why), count in Counter(
        (row["group"], row["refused"][:70]) for row in rows if row.get("refused")
    ).items():
        say(f"{count} x {group}: {why}")
    shown = table(frame)
    print(table_of(shown))
    planned = frame.refused.isna().sum() if "refused" in frame else len(frame)
    share = share_words(int(planned), len(frame))
    writer.tables({"plans": shown}, sample=f"{len(frame)} plans", interval=f"possible {share}")


def _plans(subject: Subject, label: int, margin_mm: float) -> list[dict]:
    return [plan_one(subject, label, margin_mm)]


def _subjects(options: Options) -> Iterator[Subject]:
    for pair in options.cases:
        case, _, scenes = pair.partition("=")
        tracker = Tracker(load_model(model_folder(Path(case))))
        for folder in sorted(Path(scenes).iterdir()):
            try:
                scene = read_scene(folder)
                run = of_estimate(tracker.locate(scene.cloud))
            except (InputError, NoEstimate) as error:
                say(f"{folder}: {error}")
                continue
            table_from_camera = table_under(run.meshes, STAND_MM)
            true = moved(scene.reference, table_from_camera)
            located = run.moved(table_from_camera)
            yield Subject(_name(Path(case)), folder.name, located, true, options.margins)
    for number in range(options.kidneys):
        anatomy, facing = random_anatomy(number)
        turn = rotation_onto(np.array(facing), np.array([0.0, 0.0, 1.0]))
        located = on_its_stand(anatomy, turn)
        yield Subject("random", f"{number:03d}", located, None, options.margins[:1])


def _name(case: Path) -> str:
    """The folder's, or of one that is just called case its parent's."""
    return case.parent.name if case.name == "case" else case.name


def plan_one(subject: Subject, label: int, margin_mm: float) -> dict[str, Any]:
    """A row: why there is no plan, or the electrode's distances, what is lost, and what the motions
    do to the true organ."""
    located, config = subject.located, ResectionConfig(tumor=name_of(label), margin_mm=margin_mm)
    row: dict[str, Any] = {
        "group": subject.group, "name": subject.name, "tumor": name_of(label),
        "margin_mm": margin_mm,
    }  # fmt: skip
    start = time.perf_counter()
    try:
        cell, plan, motions, note = search_bases(
            located, config, below(located.organ, CellConfig())
        )
        plan = checked(plan, motions, cell_urdf(cell), located)
    except NoPlan as error:
        return {**row, "refused": str(error), "seconds": time.perf_counter() - start}
    row["seconds"] = time.perf_counter() - start
    ends, energised = electrode_poses(cell_urdf(cell), motions)
    true = subject.true
    if true is None:
        true = Anatomy(tuple(located.meshes.values()))
    done = asdict(cut(true, plan, Swept(ends[energised])))
    ml = plan.volumes_ml
    return {
        **row, "facets": len(plan.facets), "least_mm": plan.least_mm, "taken": list(plan.taken),
        "keep_mm": plan.keep_mm, "lost_ml": ml["healthy"] + ml["kerf"], "kerf_ml": ml["kerf"],
        "parenchyma_ml": ml["parenchyma"], "moved_bases": bool(note),
        "motions_s": motions.seconds, **{f"cut_{key}": value for key, value in done.items()},
    }  # fmt: skip


def table(frame: pd.DataFrame) -> pd.DataFrame:
    """By group and margin."""
    lines = []
    for (group, margin_mm), part in frame.groupby(["group", "margin_mm"], sort=False):
        made = part[part.refused.isna()] if "refused" in part else part
        own = [row.least_mm[row.tumor] for row in made.itertuples()]
        others = [
            mm for row in made.itertuples() for name, mm in row.least_mm.items()
            if name not in row.taken
        ]  # fmt: skip
        lines.append({
            "organs": group, "margin mm": f"{margin_mm:g}", "tumors": len(part),
            "plans": len(made), "least distance mm": _text(min(own, default=np.nan), 2),
            "to others mm": _text(min(others, default=np.nan), 2),
            "lost median ml": _text(made.lost_ml.median()),
            "of that in kerfs ml": _text(made.kerf_ml.median()),
            "truth: whole": int((made.cut_removed_share >= 0.999).sum()),
            "cut worst %": _text(100 * made.cut_cut_share.max()),
            "kept worst mm": _text(made.cut_margin_mm.min()),
            "lost median ml, measured": _text(made.cut_healthy_ml.median()),
            "seconds median, worst": f"{part.seconds.median():.1f}, {part.seconds.max():.0f}",
        })  # fmt: skip
    return pd.DataFrame(lines)


def _text(value: float, digits: int = 1) -> str:
    return NOTHING if np.isnan(value) else f"{value:.{digits}f}"


if __name__ == "__main__":
    scripts.run(main, Options)
