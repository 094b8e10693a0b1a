"""Scenes of a wider world, to calibrate and test bounds on; and simulated resections in them.

    make stress ARGS='CASE OUT --count 320'     (about 4 s a scene)

Writes scene folders into OUT (``physics.scenes.stress_scenes``), which `tumortrack evaluate` and
`tumortrack margins` read. The same command goes on where it was stopped.
`--plans MODEL` also plans, on what the model locates and on the truth, and cuts the true organs
(4 s a scene); tables of several organs: the same for each, and the last with `--beside` the others.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tyro
from scipy.stats import binomtest

import tumortrack as tt
import tumortrack_benchmarks.physics.cut
import tumortrack_resection
from tumortrack.assessment.bound_factor import NAME
from tumortrack.cli.console import model_folder, say
from tumortrack.core import store
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate, NoPlan
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import surface_samples
from tumortrack.core.types import Anatomy, OccupancyCloud
from tumortrack.io.scene_folder import Scene, read_scene
from tumortrack.registration.estimate import QUERIES
from tumortrack.registration.frame import estimate_of
from tumortrack.report.metrics import distance_to_surface
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.physics.cut import VOXEL_MM, cut
from tumortrack_benchmarks.physics.organ import transformed
from tumortrack_benchmarks.physics.scenes import StressConfig, stress_scenes
from tumortrack_benchmarks.scripting import cell
from tumortrack_resection.budget import planned_budgets
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.located import of_estimate
from tumortrack_resection.values import MARGIN_MM, Located, ResectionConfig, ResectionPlan

_EXPOSED_MM, _EXOPHYTIC_SHARE = 0.5, 0.05  # of a tumor's surface, so close to the organ's
_GRID, _FINE = 160, 256  # voxels along the organ; the truth's labels err by 0.2 mm
_WHOLE = 0.999  # of a tumor: what is missing is a voxel's rounding
_NUMBERS = ["removed_share", "cut_share", "left_ml", "margin_mm"]
_NUMBERS += ["healthy_ml", "kerf_ml", "kerf_area_mm2"]
_RESULTS = ["detached", *_NUMBERS, "hurt"]
_NUMBER = re.compile(r"\d+(\.\d+)?")
Locate = Callable[[Scene], Estimate]


@dataclass(frozen=True)
class Options:
    """Make a world's scenes, and cut tumors out of them."""

    case: tyro.conf.Positional[Path]
    """Folder that `tumortrack prepare` wrote."""
    out: tyro.conf.Positional[Path]
    """Folder of the scenes."""
    count: int = 320
    """States that are tried; families take turns."""
    seed: int = 0
    """Of everything."""
    plans: Path | None = None
    """Plan on the estimates of this model (a case has one), and cut."""
    beside: tuple[Path, ...] = ()
    """Other organs' scenes that were cut already: they join the tables."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""


def main(options: Options) -> None:
    """Make missing scenes, then plan and cut."""
    writer = scripting.begun("stress", options.document)
    config = StressConfig(seed=options.seed)
    scenes = stress_scenes(options.case, options.out, config, options.count, say)
    if options.plans is not None:
        made = [path.name for path in scenes]
        cuts, refused, sample = _planned(options, options.plans, made)
        print(sample, table_of(cuts), table_of(refused), sep="\n\n")
        writer.tables({"stress-plans": cuts, "stress-refused": refused}, sample=sample)


def _planned(
    options: Options, model: Path, made: list[str]
) -> tuple[pd.DataFrame, pd.DataFrame, str]:
    """Plans are kept in the scenes' folder, a file a scene and method."""
    tumors, rows = exophytic(tt.load_case(options.case).anatomy), []
    tracker, folder = scripting.tracker_of(model), model_folder(model)
    paths = [path for name in (store.MANIFEST, NAME) if (path := folder / name).exists()]
    code = [*Path(tumortrack_resection.__file__).parent.glob("*.py"), Path(__file__)]
    about = {
        "model": [store.sha256_of(path) for path in paths],
        "code": scripting.code_sha256([*code, Path(tumortrack_benchmarks.physics.cut.__file__)]),
    }
    methods: dict[str, Locate] = {
        "model": lambda scene: tracker.locate(scene.cloud, grid=_GRID, full_view=scene.depth),
        "truth": truth,
    }
    for name, (method, locate) in product(made, methods.items()):
        scene, place = options.out / name, options.out / "plans" / name / f"{method}.json"
        measure = partial(cut_one, scene, tumors, locate)
        found = scripting.kept(place, {**about, "scene": store.sha256_of(scene)}, measure)
        rows += [{"case": options.out.name, "scene": name, "method": method, **r} for r in found]
        say(f"planned {name} ({method})")
    for other in options.beside:
        if not (files := sorted((other / "plans").rglob("*.json"))):
            raise InputError(f"{other} has no plans; the same command with --plans makes them.")
        for path in files:
            of = {"case": other.name, "scene": path.parent.name, "method": path.stem}
            rows += [{**of, **row} for row in store.read_json(path)["rows"]]
    seen = {(row["case"], row["scene"]) for row in rows}
    good = {(row["case"], row["scene"]) for row in rows if row.get("good")}
    for row in rows:
        is_good = (row["case"], row["scene"]) in good
        row["case"] = "a good answer" if is_good else "a poor answer, or none"
    return *tables_of(rows), f"{len(seen)} scenes, {len(good)} with a good answer"


def exophytic(anatomy: Anatomy) -> list[str]:
    """The tumors that reach the organ's surface."""
    found = []
    for name, tumor in zip(anatomy.names[1:], anatomy.tumors, strict=True):
        points, area = surface_samples(tumor)
        near = distance_to_surface(points, anatomy.organ) < _EXPOSED_MM
        if area[near].sum() >= _EXOPHYTIC_SHARE * area.sum():
            found.append(name)
    return found


class Planner(Config, frozen=True):
    """One way to plan: at a margin, or ``with_errors`` at as much more as the errors sum up to that
    a plan has to cover."""

    with_errors: bool = False
    margin_mm: float = 5.0  # the paper's

    @property
    def name(self) -> str:
        return f"{self.margin_mm:g} mm{' + errors' if self.with_errors else ''}"

    def tried(self, located: Located, tumor: str) -> ResectionPlan | str:
        """A plan, or why there is none."""
        try:
            plan = plan_resection(located, ResectionConfig(tumor=tumor, margin_mm=self.margin_mm))
            if not self.with_errors:
                return plan
            wider_mm = self.margin_mm + planned_budgets(plan, located)[0].sum_mm
            config = ResectionConfig(tumor=tumor, margin_mm=min(wider_mm, MARGIN_MM[1]))
            return plan_resection(located, config)
        except (NoPlan, InputError) as error:
            return str(error)


PLANNERS = (Planner(), Planner(with_errors=True))


def truth(scene: Scene) -> Estimate:
    """The bound of every planner: the true surfaces, with a cloud like the tracker's, as many
    random points in the organ's box."""
    parts = dict(zip(scene.reference.names, scene.reference.parts, strict=True))
    return scattered(estimate_of(parts, _FINE, scene.cloud.stamp_ns))


def scattered(estimate: Estimate) -> Estimate:
    assert estimate.volume is not None
    labels, camera_from_index = estimate.volume.labels, estimate.volume.camera_from_index
    low, high = estimate.meshes[estimate.organ.name].box_mm
    points_mm = np.random.default_rng(0).uniform(low, high, (QUERIES, 3))
    index = np.rint(transform_points(np.linalg.inv(camera_from_index), points_mm)).astype(int)
    point_labels = labels[tuple(np.clip(index, 0, np.array(labels.shape) - 1).T)]
    inside = point_labels > 0
    cloud = OccupancyCloud(
        points_mm[inside], point_labels[inside], np.ones(inside.sum()), estimate.cloud.stamp_ns
    )
    return replace(estimate, cloud=cloud)


def cut_one(scene_folder: Path, tumors: list[str], locate: Locate) -> Iterator[dict[str, Any]]:
    """One scene: a row for each tumor and planner: ``refused`` and why, or what the cut did
    (``CutResult``); ``good``: the estimate, if there is one."""
    scene = read_scene(scene_folder)
    table_from_camera = np.linalg.inv(np.array(scene.meta["camera_from_bench"], float))
    true = transformed(scene.reference, table_from_camera)
    try:
        estimate = locate(scene)
    except (NoEstimate, InputError) as error:
        for tumor, planner in product(tumors, PLANNERS):
            yield {"tumor": tumor, "planner": planner.name, "refused": str(error)}
        return
    located = of_estimate(estimate).transformed(table_from_camera)
    for tumor, planner in product(tumors, PLANNERS):
        if not planner.with_errors or tumor in located.bounds_mm:  # others know no bound
            row = {"tumor": tumor, "planner": planner.name, "good": estimate.quality == "good"}
            plan = planner.tried(located, tumor)
            if isinstance(plan, str):
                yield {**row, "refused": plan}
                continue
            done = cut(true, plan)
            more = {"hurt": [*done.hurt], "left_ml": done.left_ml, "promised_ml": plan.volumes_ml}
            yield {**row, **asdict(done), **more}


def tables_of(rows: list[dict[str, Any]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """What the cuts did, of all cases together and of each; and why there was no plan, where there
    was none."""
    columns = ["case", "method", "planner", "refused", "promised_ml", *_RESULTS]
    frame = pd.DataFrame(rows).reindex(columns=columns)
    frame = frame.astype(dict.fromkeys(_NUMBERS, float))
    planners = pd.Categorical(frame.planner, [planner.name for planner in PLANNERS])
    frame = frame.assign(planner=planners)
    parts: list[tuple[str, ...]] = [("all", "method", "planner")]
    parts += [("", "case", "method", "planner")] if frame.case.nunique() > 1 else []
    cuts = [
        {
            "case": every or name[0],
            "located by": name[-2],
            "planner": name[-1],
            **_cut(plans, name[-1]),
        }
        for every, *keys in parts
        for name, plans in frame.groupby(keys, observed=True)
    ]
    refused = Counter(
        (method, planner, _NUMBER.sub("N", reason.partition(": ")[0]))
        for (method, planner), plans in frame.groupby(["method", "planner"], observed=True)
        for reason in plans.refused.dropna()
    )
    whys = [(*why, count) for why, count in refused.items()]
    return pd.DataFrame(cuts), pd.DataFrame(whys, columns=["located by", "planner", "why", "plans"])


def _cut(plans: pd.DataFrame, planner: str) -> dict[str, Any]:
    """Numbers are of the plans that were made, shares removed rounded down, shares cut up; margins
    are those of the energised electrode, over its whole length, to the true tumor."""
    made = plans[plans.refused.isna()]
    free, removed = made[made.detached.astype(bool)], 100 * made.removed_share
    least_mm = {p.name: p.margin_mm for p in PLANNERS}[planner] - VOXEL_MM
    parenchyma_ml = free.promised_ml.map(itemgetter("parenchyma")).astype(float)
    return {
        "asked": len(plans), "plans": len(made), "free": len(free),
        "whole": (made.removed_share >= _WHOLE).sum(),
        "removed median %": _cell(removed.median(), down=True),
        "removed worst %": _cell(removed.min(), down=True),
        "cut worst %": _cell(100 * made.cut_share.max(), up=True),
        "left worst ml": _cell(made.left_ml.max(), digits=2),
        "margin kept median mm": _cell(made.margin_mm.median()),
        "worst mm": _cell(made.margin_mm.min()),
        "as asked %": _share((made.margin_mm >= least_mm).sum(), len(made)),
        "cut into it": (made.margin_mm <= 0).sum(), "into another tumor": made.hurt.map(bool).sum(),
        "healthy tissue mean ml": _cell(free.healthy_ml.mean()),
        "healthy tissue mean %": _cell(100 * (free.healthy_ml / parenchyma_ml).mean(), 0),
        "of that in kerfs mean ml": _cell(free.kerf_ml.mean()),
        "kerf area mean cm2": _cell(free.kerf_area_mm2.mean() / 100),
    }  # fmt: skip


def _cell(value: float, digits: int = 1, down: bool = False, up: bool = False) -> str:
    if math.isnan(value):
        return cell(value)
    if down or up:
        whole = round(value * 10**digits, 6)
        value = (math.floor(whole) if down else math.ceil(whole)) / 10**digits
    return f"{value + 0.0:.{digits}f}"


def _share(hits: int, cases: int) -> str:
    """A share in %, with Clopper and Pearson's interval of 95 %."""
    if not cases:
        return "-"
    low, high = binomtest(hits, cases).proportion_ci(0.95, "exact")
    return f"{100 * hits / cases:.1f} ({100 * low:.1f} to {100 * high:.1f})"


if __name__ == "__main__":
    scripting.run(main, Options)
