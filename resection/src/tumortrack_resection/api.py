"""For scripts: where to cut a located tumor out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tumortrack.core.config import from_builtins
from tumortrack.core.estimate import Estimate
from tumortrack.live.values import PublishedFrame
from tumortrack_resection import located as places
from tumortrack_resection.budget import checked_against
from tumortrack_resection.planning import begin_plan as begin_plan
from tumortrack_resection.planning import plan_cuts
from tumortrack_resection.values import ResectionConfig, ResectionPlan


def plan_resection(
    located: str | Path | Estimate,
    *,
    picture: str | Path | None = None,
    stand_mm: float | None = None,
    accept_poor: bool = False,
    accept_budget: bool = False,
    **options: Any,
) -> ResectionPlan:
    """Where to cut a tumor out; nothing moves. `tumortrack plan` also plans the arms' motions.

    Args:
        located: a folder that `tumortrack locate` wrote, or an estimate; camera frame, mm. The
            camera is taken to look straight down on the table.
        picture: PNG file to draw the plan into.
        stand_mm: height of the organ's lowest point over the table.
        accept_poor: plan on a poor estimate; the plan's notes say so.
        accept_budget: plan though the margin does not cover the errors that are to be expected
            (docs/resection.md); the plan's notes say so.
        options: fields of ``ResectionConfig``: ``tumor``, ``method`` (``margin`` or
            ``published``), ``margin_mm`` and others.

    Returns:
        The plan: cuts, layers, grasp point; table frame, mm, z up.

    Raises:
        NoPlan: nothing to cut, or not as asked, or the margin is less than the errors; says why.
        InputError: a poor estimate; no such tumor, or an option that is not allowed.
    """
    config = from_builtins(options, ResectionConfig, "plan_resection")
    if isinstance(located, Estimate):
        run = places.of_estimate(located)
    else:
        run = places.read_run(Path(located))
    stand_mm = places.STAND_MM if stand_mm is None else stand_mm
    frames = PublishedFrame("table", places.table_under(run.meshes, stand_mm))
    cuts = plan_cuts(run, config, frames, accept_poor)
    plan = checked_against(cuts.plan, cuts.budgets_of(cuts.plan), accept_budget)
    if picture is not None:
        from tumortrack_resection.pictures import draw_plan

        draw_plan(plan, cuts.located, Path(picture))
    return plan
