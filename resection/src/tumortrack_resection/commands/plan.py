"""`plan`: a run -> strokes, motions of two arms, pictures."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional, UseAppendAction

from tumortrack.cli.console import options_of, say, say_notes, warn
from tumortrack.core import store
from tumortrack_resection.options import PlanOptions

if TYPE_CHECKING:
    from tumortrack_resection.planning import Planning


@dataclass(frozen=True, kw_only=True)
class Plan(PlanOptions):
    """Plan how to cut a located tumor out, and how two arms do it.

    Attributes:
        run_folder: folder that `locate` wrote.
        plan: folder to write: plan.json, strokes.ply, plan.png, motions, the cell as URDF.
        overwrite: replace PLAN if it exists.
    """

    run_folder: Positional[Path]
    plan: Positional[Path]
    keep_away: UseAppendAction[tuple[str, ...]] = ()
    overwrite: bool = False

    def run(self) -> None:
        from tumortrack_resection.files import KIND
        from tumortrack_resection.planning import begin_plan

        store.check_place(self.plan, KIND, self.overwrite)
        planning = begin_plan(self.run_folder, **options_of(self, PlanOptions))
        say(str(planning.content.patient))
        start = time.perf_counter()
        planning = planning.with_motions() if self.arms else planning.checked()
        _say_plan(planning)
        if self.arms:
            motions = planning.content.motions
            assert motions is not None
            say(
                f"arms: {len(motions.stages)} stages, {motions.seconds:.0f} s; planned in "
                f"{time.perf_counter() - start:.1f} s."
            )
            say_notes([planning.note] if planning.note else [])
        planning.save(self.plan, self.overwrite)
        end = " Mind the warnings above." if planning.content.plan.warnings else ""
        frame_id = planning.content.frames.frame_id
        say(f"written to {self.plan} (frame {frame_id!r}, mm); look at plan.png there.{end}")


def _say_plan(planning: Planning) -> None:
    from tumortrack_resection.budget import foreseen_mm, kept_words, lost_words

    content, plan = planning.content, planning.content.plan
    for budget in content.budgets:
        for line in budget.table():
            say(line)
    warn(plan.warnings)
    ml = plan.volumes_ml
    say(
        f"{plan.tumor} ({ml['tumor']:.1f} ml, {plan.exophytic:.0%} outside the organ's "
        f"hull): {len(plan.cuts)} strokes in {plan.sweeps} sweeps, "
        f"{sum(cut.length_mm for cut in plan.cuts):.0f} mm."
    )
    least_mm = plan.least_mm or foreseen_mm(plan, planning.located, planning.cell.tools)
    say(f"{kept_words(plan, least_mm)}.")
    say(f"{ml['piece']:.1f} ml come away; {lost_words(plan)}.")
    say_notes(note for note in plan.notes if note not in plan.warnings)
