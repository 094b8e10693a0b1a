"""Simulated resections: plans made from a model's estimates, and from the truth, cut the true
organs of the wider world."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import asdict, replace
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

import tumortrack
import tumortrack_lab.cut
import tumortrack_resection
from tumortrack.core import store
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import InputError, NoEstimate, NoPlan
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, OccupancyCloud
from tumortrack.registration.estimate import QUERIES
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack.tracking.bound_factor import NAME
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.cut import VOXEL_MM, cut
from tumortrack_lab.peers.base import Fit, estimate_of
from tumortrack_lab.study.document import table_of
from tumortrack_lab.study.methods import Method, StudyCase, code_sha256
from tumortrack_lab.study.tables import NOTHING, ordered
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.twin.apparatus import moved
from tumortrack_resection.budget import planned_budgets
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.located import of_estimate
from tumortrack_resection.values import MARGIN_MM, Located, ResectionConfig, ResectionPlan

TRUTH = "truth"
_FINE = 256  # voxels along the true organ: its points' labels err by 0.2 mm
WHOLE = 0.999  # of a tumor: what is missing is a voxel's rounding
_NUMBERS = ["removed_share", "cut_share", "left_ml", "margin_mm"]
_NUMBERS += ["healthy_ml", "kerf_ml", "kerf_area_mm2"]
_RESULTS = ["detached", *_NUMBERS, "hurt"]
_NUMBER = re.compile(r"\d+(\.\d+)?")


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


def tracked(folder: Path) -> Method:
    """A model and its bounds' factor, if it has one, judged by all that the camera saw, as `locate`
    does it."""
    tracker = cache(lambda: Tracker(load_model(folder)))
    paths = [path for name in (store.MANIFEST, NAME) if (path := folder / name).exists()]
    identity = {path.name: store.sha256_of(path) for path in paths}
    identity |= {"tumortrack": tumortrack.__version__, "fingerprint": fingerprint()}
    return Method("model", identity, lambda s, n: tracker().locate(s.cloud, n, 0, s.depth))


def truth() -> Method:
    """Answers with the truth: the bound of every planner."""

    def locate(scene: Scene, grid: int) -> Estimate:
        still = Fit(lambda points: points)
        return scattered(
            estimate_of(still, scene.reference, scene.cloud.stamp_ns, max(grid, _FINE))
        )

    return Method(TRUTH, {"tumortrack": tumortrack.__version__}, locate)


def scattered(estimate: Estimate) -> Estimate:
    """With a cloud like the tracker's: as many random points in the organ's box."""
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


def cutting() -> dict[str, Any]:
    """What measurements of planned cuts also depend on."""
    planning = Path(tumortrack_resection.__file__).parent.glob("*.py")
    code = code_sha256([*planning, Path(tumortrack_lab.cut.__file__)])
    planners = [to_builtins(planner) for planner in PLANNERS]
    return {"cutting": {"planners": planners, "voxel_mm": VOXEL_MM, "code_sha256": code}}


def cut_one(
    case: StudyCase, method: Method, variant: str, view: str, grid: int
) -> list[dict[str, Any]]:
    """One scene: a row for each exophytic tumor and planner: ``refused`` and why, or what the cut
    did (``CutResult``); ``good``: the estimate, if there is one. Raises InputError: a scene that
    does not say where the table is."""
    scene = read_scene(case.scene(variant, view))
    if "camera_from_bench" not in scene.meta:
        raise InputError(
            f"{variant}-{view} does not say where its table is; make it with make world."
        )
    table_from_camera = np.linalg.inv(np.array(scene.meta["camera_from_bench"], float))
    true = moved(scene.reference, table_from_camera)
    tumors = [
        name for name, site in tumor_sites_of(case.anatomy_ct).items() if site.kind == "exophytic"
    ]
    try:
        estimate = method.locate(scene, grid)
    except (NoEstimate, InputError) as error:
        refused = {"refused": str(error)}
        return [{"tumor": name, "planner": p.name, **refused} for name in tumors for p in PLANNERS]
    located = of_estimate(estimate).moved(table_from_camera)
    about = {"good": estimate.quality == "good"}
    return [
        {"tumor": name, "planner": p.name, **about, **effects(true, p.tried(located, name))}
        for name in tumors
        for p in PLANNERS
        if not p.with_errors or name in located.bounds_mm  # others know no bound
    ]


def effects(true: Anatomy, plan: ResectionPlan | str) -> dict[str, Any]:
    """Columns of a row: what a plan cuts, or why there is none."""
    if isinstance(plan, str):
        return {"refused": plan}
    result = cut(true, plan)
    more = {"hurt": list(result.hurt), "left_ml": result.left_ml, "promised_ml": plan.volumes_ml}
    return {**asdict(result), **more}


def tidy_plans(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """One row for each plan, made or ``refused``: the truth's last, planners in their order."""
    columns = ["case", "method", "planner", "refused", "promised_ml", *_RESULTS]
    frame = pd.DataFrame(rows).reindex(columns=columns)
    frame = frame.astype(dict.fromkeys(_NUMBERS, float))
    planners = pd.Categorical(frame.planner, [planner.name for planner in PLANNERS])
    methods = sorted(frame.method.unique(), key=lambda name: name == TRUTH)
    frame = frame.assign(planner=planners, method=pd.Categorical(frame.method, methods))
    return ordered(frame, ["case"])


def tables_of(rows: list[dict[str, Any]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """What the cuts did, of all cases together and of each; and why there was no plan, where there
    was none."""
    frame = tidy_plans(rows)
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


def summary(cuts: pd.DataFrame) -> str:
    """All cases, in Markdown."""
    shown = ["located by", "planner", "plans", "whole", "margin kept median mm", "worst mm"]
    shown += ["as asked %", "cut into it", "into another tumor", "healthy tissue mean ml"]
    shown += ["kerf area mean cm2"]
    return table_of(cuts.loc[cuts.case == "all", shown])


def _cut(plans: pd.DataFrame, planner: str) -> dict[str, Any]:
    """Numbers are of the plans that were made, shares removed rounded down, shares cut up; margins
    are those of the energised electrode, over its whole length, to the true tumor."""
    made = plans[plans.refused.isna()]
    free, removed = made[made.detached.astype(bool)], 100 * made.removed_share
    least_mm = {p.name: p.margin_mm for p in PLANNERS}[planner] - VOXEL_MM
    parenchyma_ml = free.promised_ml.map(itemgetter("parenchyma")).astype(float)
    return {
        "asked": len(plans), "plans": len(made), "free": len(free),
        "whole": (made.removed_share >= WHOLE).sum(),
        "removed median %": _text(removed.median(), down=True),
        "removed worst %": _text(removed.min(), down=True),
        "cut worst %": _text(100 * made.cut_share.max(), up=True),
        "left worst ml": _text(made.left_ml.max(), digits=2),
        "margin kept median mm": _text(made.margin_mm.median()),
        "worst mm": _text(made.margin_mm.min()),
        "as asked %": _share_words((made.margin_mm >= least_mm).sum(), len(made)),
        "cut into it": (made.margin_mm <= 0).sum(), "into another tumor": made.hurt.map(bool).sum(),
        "healthy tissue mean ml": _text(free.healthy_ml.mean()),
        "healthy tissue mean %": _text(100 * (free.healthy_ml / parenchyma_ml).mean(), 0),
        "of that in kerfs mean ml": _text(free.kerf_ml.mean()),
        "kerf area mean cm2": _text(free.kerf_area_mm2.mean() / 100),
    }  # fmt: skip


def _text(value: float, digits: int = 1, down: bool = False, up: bool = False) -> str:
    if math.isnan(value):
        return NOTHING
    if down or up:
        whole = round(value * 10**digits, 6)
        value = (math.floor(whole) if down else math.ceil(whole)) / 10**digits
    return f"{value + 0.0:.{digits}f}"


def _share_words(hits: int, cases: int) -> str:
    """A share in %, with Clopper and Pearson's interval of 95 %."""
    if not cases:
        return "-"
    low, high = binomtest(hits, cases).proportion_ci(0.95, "exact")
    return f"{100 * hits / cases:.1f} ({100 * low:.1f} to {100 * high:.1f})"
