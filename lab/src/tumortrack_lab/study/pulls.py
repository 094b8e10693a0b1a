"""Does a plan cut out a tumor that the holder pulls at? The true organ of the wider world is pulled
by finite elements; it is located, planned on and cut without the pull, with it, and with the place
of what the holder holds as evidence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float64

from tumortrack.core.errors import InputError, NoEstimate, NoPlan, TumortrackError
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Evidence, Held
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.cut import VOXEL_MM
from tumortrack_lab.study.resection import PLANNERS, WHOLE, effects
from tumortrack_lab.study.tables import ordered
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.world import pulled, segmentation
from tumortrack_lab.world.families import Deformed
from tumortrack_lab.world.scenes import World
from tumortrack_lab.world.views import Generator, View, look, organ_cloud
from tumortrack_resection.located import of_estimate
from tumortrack_resection.values import Located, ResectionPlan

PULLS_MM = (4.0, 8.0)
_STD_MM = 1.0  # of where the arms see their tip, each axis, the same before and during the pull
_HIDDEN_MM = 2.0  # beside the cup no point is the organ's
_NONE, _STALE, _SEEN, _HELD = "no pull", "pull, planned before", "pull", "pull, held"
_HOW = (_NONE, _STALE, _SEEN, _HELD)


def pull_one(tracker: Tracker, world: World, number: int, grid: int = 160) -> list[dict[str, Any]]:
    """One organ at rest, one tumor, random: a row for each pull, way to follow it and planner.
    Raises NoEstimate, NoPlan: there is none to grip by; TumortrackError: no equilibrium."""
    rng = np.random.default_rng([world.config.seed, number, 0x9B11])
    kinds = segmentation.KINDS
    kind = kinds[0] if rng.uniform() > world.config.segmentation else rng.choice(kinds[1:])
    true, _ = segmentation.perturbed(world.organ.anatomy, kind, world.slices_axis, rng)
    sites = tumor_sites_of(world.anatomy_ct)
    names = [name for name, site in sites.items() if site.kind == "exophytic"]
    if not names:
        raise InputError("no tumor of this case can be gripped: none reaches the surface.")
    tumor = str(rng.choice(names))
    organ = pulled.Held.random(world.organ, rng)
    hidden = rng.uniform(0.05, world.config.most_hidden) * (rng.uniform() < world.config.hidden)
    seed = int(rng.integers(1 << 31))
    error_mm = rng.normal(0, _STD_MM, 3)
    up = np.array([0.0, 0.0, 1.0])

    def seen(state: Deformed, cup_mm: np.ndarray | None) -> tuple[Anatomy, View, SensorCloud]:
        """The same camera each time."""
        again: Generator = np.random.default_rng(seed)
        truth = true.of(part.moved(state.carry(part.vertices_mm)) for part in true.parts)
        view = look(state, truth.organ, hidden, again)
        cloud = organ_cloud(view, truth.organ, again)[0]
        return truth, view, cloud if cup_mm is None else _beside(cup_mm, view, cloud)

    def located(view: View, cloud: SensorCloud, *held: Evidence) -> tuple[Estimate, Located]:
        estimate = tracker.locate(cloud, grid, seen=view.frame, evidence=held)
        return estimate, of_estimate(estimate).moved(np.linalg.inv(view.camera_from_bench))

    (rest,) = organ.pulled(world.organ.points_mm[0], up, [0.0])
    truth, view, cloud = seen(rest, None)
    estimate, before = located(view, cloud)
    plans = {planner.name: planner.tried(before, tumor) for planner in PLANNERS}
    grasps = [plan.grasp_mm for plan in plans.values() if isinstance(plan, ResectionPlan)]
    if not grasps or estimate.motion is None:
        raise NoPlan(f"nothing to grip: {next(iter(plans.values()))}")
    surface = world.organ.points_mm
    grip_mm = surface[np.linalg.norm(surface - grasps[0], axis=1).argmin()]
    about = {
        "number": number,
        "tumor": tumor,
        "grip_off_mm": float(np.linalg.norm(grip_mm - grasps[0])),
    }
    rows = [
        {**about, "pull_mm": 0.0, "how": _NONE, **_found(estimate, before, truth, tumor), **row}
        for row in _cuts(truth, plans)
    ]
    tip_mm = transform_points(view.camera_from_bench, grip_mm[None])
    point_ct = estimate.motion.back(tip_mm + error_mm)
    assert point_ct is not None
    std_mm = estimate.motion.std_mm(point_ct)
    assert std_mm is not None
    for pull_mm, state in zip(PULLS_MM, organ.pulled(grip_mm, up, PULLS_MM), strict=True):
        cup_mm = grip_mm + pull_mm * up
        truth, view, cloud = seen(state, cup_mm)
        place_mm = transform_points(view.camera_from_bench, cup_mm[None])[0] + error_mm
        held = Held(
            point_ct=tuple(point_ct[0]), point_std_mm=float(std_mm[0]),
            place_mm=tuple(place_mm), std_mm=_STD_MM,
        )  # fmt: skip
        pull = {**about, "pull_mm": pull_mm}
        stale = _found(estimate, before, truth, tumor)
        rows += [{**pull, "how": _STALE, **stale, **row} for row in _cuts(truth, plans)]
        for how, evidence in ((_SEEN, ()), (_HELD, (held,))):
            try:
                now, there = located(view, cloud, *evidence)
            except NoEstimate as failure:
                refused = {"refused": f"no estimate: {failure}"}
                rows += [{**pull, "how": how, "planner": p.name, **refused} for p in PLANNERS]
                continue
            anew = {planner.name: planner.tried(there, tumor) for planner in PLANNERS}
            found = _found(now, there, truth, tumor)
            rows += [{**pull, "how": how, **found, **row} for row in _cuts(truth, anew)]
    return rows


def _beside(cup_mm: np.ndarray, view: View, cloud: SensorCloud) -> SensorCloud:
    """Without what the cup hides, which is taken for no tissue."""
    eye_mm = np.linalg.inv(view.camera_from_bench)[:3, 3]
    points = transform_points(np.linalg.inv(view.camera_from_bench), cloud.points_mm.astype(float))
    rays = points - eye_mm
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hidden = np.zeros(len(points), bool)
    for height_mm in np.linspace(0, pulled.CUP_LENGTH_MM, 5):
        off = cup_mm + [0.0, 0.0, height_mm] - eye_mm
        across = np.linalg.norm(off - (rays @ off)[:, None] * rays, axis=1)
        hidden |= across < pulled.CUP_MM + _HIDDEN_MM
    return replace(cloud, points_mm=cloud.points_mm[~hidden])


def _cuts(truth: Anatomy, plans: dict[str, ResectionPlan | str]) -> list[dict[str, Any]]:
    return [{"planner": name, **effects(truth, plan)} for name, plan in plans.items()]


def _found(estimate: Estimate, there: Located, truth: Anatomy, tumor: str) -> dict[str, Any]:
    """How far the located tumor lies from the true one (frame of the bench)."""
    true = truth.parts[truth.names.index(tumor)]
    off: Float64[np.ndarray, " 3"] = there.meshes[tumor].box_mm.mean(0) - true.box_mm.mean(0)
    left_out = any(each.left_out for each in estimate.report.evidence)
    return {
        "off_mm": float(np.linalg.norm(off)), "good": estimate.quality == "good",
        "left_out": left_out,
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """What the cuts did, by pull, way to follow it and planner."""
    frame = ordered(pd.DataFrame(rows).reindex(columns=_COLUMNS), ["planner"])
    frame = frame.assign(how=pd.Categorical(frame.how, _HOW))
    lines = []
    by = frame.groupby(["pull_mm", "how", "planner"], observed=True)
    for (pull_mm, how, planner), plans in by:
        made = plans[plans.removed_share.notna()]
        margins = made.margin_mm.astype(float)
        asked_mm = {p.name: p.margin_mm for p in PLANNERS}[planner] - VOXEL_MM
        lines.append({
            "pull mm": f"{pull_mm:g}", "followed by": how, "planner": planner,
            "tumor off median mm": f"{plans.off_mm.median():.1f}",
            "95 % mm": f"{plans.off_mm.quantile(0.95):.1f}",
            "called good": int(plans.good.eq(True).sum()),
            "left out": int(plans.left_out.eq(True).sum()),
            "asked": len(plans), "plans": len(made),
            "whole": int((made.removed_share >= WHOLE).sum()),
            "cut worst %": f"{100 * made.cut_share.max():.1f}",
            "margin kept median mm": f"{margins.median():.1f}", "worst mm": f"{margins.min():.1f}",
            "as asked": int((margins >= asked_mm).sum()), "cut into it": int((margins <= 0).sum()),
            "healthy tissue mean ml": f"{made.healthy_ml.mean():.1f}",
            "kerf area mean cm2": f"{made.kerf_area_mm2.mean() / 100:.1f}",
        })  # fmt: skip
    return pd.DataFrame(lines)


_COLUMNS = [
    "case", "number", "tumor", "pull_mm", "how", "planner", "refused", "off_mm", "good",
    "left_out", "removed_share", "cut_share", "left_ml", "margin_mm", "healthy_ml", "kerf_area_mm2",
]  # fmt: skip


def tried(tracker: Tracker, world: World, number: int) -> tuple[list[dict[str, Any]], str]:
    """The rows, or why there are none."""
    try:
        return pull_one(tracker, world, number), ""
    except TumortrackError as error:
        return [], f"{type(error).__name__}: {error}"
