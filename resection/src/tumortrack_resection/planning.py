"""From a located run to the folder of a plan: cuts, their error budget, the arms' motions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from tumortrack.core import store
from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.estimate import Estimate
from tumortrack.core.packages import to_install
from tumortrack.core.types import Mesh
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.values import PublishedFrame
from tumortrack.tracking.options import options_from
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.budget import MOVED_MM, ErrorBudget, checked_against, planned_budgets
from tumortrack_resection.drafts import Drafts
from tumortrack_resection.files import INVENTED, PlanFolder, check_structures, write_plan
from tumortrack_resection.located import (
    STAND_MM,
    of_estimate,
    poor_estimate_notes,
    read_run,
    table_under,
)
from tumortrack_resection.operation import OperationConfig
from tumortrack_resection.options import PlanOptions
from tumortrack_resection.values import WEAK_CASE, Located, ResectionConfig, ResectionPlan


@dataclass(frozen=True, eq=False)
class Planning:
    """A plan, step by step: the cuts are there; ``checked`` or ``with_motions``, and ``save``
    follow. ``cell``: the requested one; ``bases_source``: as ``PlanFolder.cell_source``;
    ``note``: what was changed in the cell for the motions."""

    content: PlanFolder
    run_folder: Path
    options: PlanOptions
    cell: CellConfig
    bases_source: str
    cuts: Cuts
    note: str = ""

    @property
    def located(self) -> Located:
        return self.cuts.located

    def checked(self) -> Planning:
        """Without motions, with a note on the error budget. NoPlan: the distances don't cover
        the errors, and that was not accepted."""
        budgets = self.cuts.budgets_of(self.content.plan)
        plan = checked_against(self.content.plan, budgets, self.options.accept_budget)
        return replace(self, content=replace(self.content, plan=plan, budgets=budgets))

    def with_motions(self) -> Planning:
        """And the plan that these carry out. NoPlan: the arms can't carry one out, or the check
        refuses it, or as ``checked``."""
        from tumortrack_resection.arms.body import cell_urdf
        from tumortrack_resection.arms.procedure import search_bases
        from tumortrack_resection.arms.trajectory import first_hit
        from tumortrack_resection.check import checked
        from tumortrack_resection.motions import ARMS

        organ, config = self.located.organ, self.content.config
        cell, drafts = below(organ, self.cell), self.cuts.drafts
        placed, plan, motions, note = search_bases(self.located, config, cell, drafts=drafts)
        if hit := first_hit(motions, placed, organ):
            raise NoPlan(f"the arms can't carry this out: {hit}. Place the organ otherwise.")
        plan = checked(plan, motions, cell_urdf(placed), self.located)
        plan = replace(plan, notes=(*self.cuts.heading, *plan.notes))
        as_given = all(placed.base(arm) == cell.base(arm) for arm in ARMS)
        source = self.bases_source if as_given else INVENTED
        content = replace(self.content, plan=plan, motions=motions, cell=placed, cell_source=source)
        return replace(self, content=content, note=note).checked()

    def save(self, folder: Path, overwrite: bool = False) -> None:
        """Write the folder that `tumortrack plan` writes. Raises as ``files.write_plan``."""
        from tumortrack_resection.pictures import draw_plan

        cell, motions = self.content.cell, self.content.motions

        def more(aside: Path) -> None:
            if cell is not None and motions is not None:
                from tumortrack_resection.arms.body import cell_urdf

                store.write_atomically(aside / "cell.urdf", cell_urdf(cell).encode())
            draw_plan(self.content.plan, self.located, aside / "plan.png", self.cell.tools)

        digest = store.sha256_of(self.run_folder / store.MANIFEST)
        write_plan(folder, self.content, {"run": digest}, more, overwrite)


def begin_plan(run_folder: str | Path, **given: Any) -> Planning:
    """A plan of a run's folder, step by step, as `tumortrack plan` makes it.

    Args:
        given: as on the command line: ``method``, ``tumor``, ``margin``, ``keep_away``, ``config``,
            ``frame``, ``stand``, ``cell``, ``arms``, ``moved``, ``accept_poor``,
            ``accept_budget``, ``patient``, ``side``.

    Raises:
        NoPlan: nothing to cut, or not as asked.
        InputError, ArtifactError: a file or an option cannot be used; a poor estimate; another
            patient than stated.
    """
    run_folder, options = Path(run_folder), options_from(PlanOptions, given, "begin_plan")
    config = options.resection_config()
    OperationConfig(moved_mm=options.moved)  # `resect` would refuse it, after the planning
    written = {} if options.cell is None else store.read_json(options.cell)
    cell = from_builtins(written, CellConfig, str(options.cell))
    if options.stand is not None:
        cell = msgspec.structs.replace(cell, stand_mm=options.stand)
    if options.arms:
        check_arms_installed()
    run = read_run(run_folder)
    run.patient.check_is(options.stated, str(run_folder))
    check_structures(run.structures)
    frames = _frames(run.meshes, options, cell.stand_mm)
    cuts = plan_cuts(run, config, frames, options.accept_poor, cell, options.moved)
    model = store.read_json(run_folder / "report.json").get("model")
    has_bases = written.keys() >= {"cutter_base", "holder_base"}
    bases_source = store.sha256_of(options.cell) if options.cell and has_bases else INVENTED
    content = PlanFolder(
        cuts.plan, config, frames, cuts.located.meshes,
        structures=dict(cuts.located.structures), patient=run.patient,
        case_sha256=str(model.get("case_sha256") or "") if isinstance(model, dict) else "",
        frame_source=store.sha256_of(options.frame) if options.frame else INVENTED,
    )  # fmt: skip
    return Planning(content, run_folder, options, cell, bases_source, cuts)


class Cuts(NamedTuple):
    """A plan without the arms; ``located``: the run in the plan's frame; ``budgets_of``: of this
    or another plan of it; ``heading``: notes that come before any such plan's own."""

    plan: ResectionPlan
    drafts: Drafts
    located: Located
    budgets_of: Callable[[ResectionPlan], tuple[ErrorBudget, ...]]
    heading: tuple[str, ...]


def plan_cuts(
    run: Located,
    config: ResectionConfig,
    frames: PublishedFrame,
    accept_poor: bool,
    cell: CellConfig | None = None,
    moved_mm: float = MOVED_MM,
) -> Cuts:
    """Where to cut a run, without the arms."""
    weak = (f"{WEAK_CASE}: {warning.message}." for warning in run.weak)
    heading = (*poor_estimate_notes(run.doubt, accept_poor), *weak)
    located = run.transformed(frames.published_from_camera)
    cell = below(located.organ, cell or CellConfig())

    def budgets_of(plan: ResectionPlan) -> tuple[ErrorBudget, ...]:
        """With the camera's error at the tumor's far side."""
        tumor = located.meshes[plan.tumor].vertices_mm
        off_mm = tumor - frames.published_from_camera[:3, 3]
        error_mm = frames.error_at(float(np.linalg.norm(off_mm, axis=1).max()))
        return planned_budgets(plan, located, error_mm, cell.tool_error_mm, moved_mm, cell.tools)

    drafts = Drafts(located, config, cell.tools)
    plan = drafts.best().plan()
    plan = replace(plan, notes=(*heading, *plan.notes))
    return Cuts(plan, drafts, located, budgets_of, heading)


def check_arms_installed() -> None:
    """Raises InputError."""
    needed = ("pinocchio", "coal", "toppra")
    if missing := [name for name in needed if find_spec(name) is None]:
        raise InputError(
            f"arms need {', '.join(missing)}: {to_install('tumortrack-resection[arms]')}. toppra "
            "has packages for x86-64 alone; elsewhere plan the cuts with --no-arms."
        )


def _frames(meshes: Mapping[str, Mesh], options: PlanOptions, stand_mm: float) -> PublishedFrame:
    """The calibration's frame, or that of a camera that looks straight down on the table."""
    if options.frame is None:
        return PublishedFrame("table", table_under(meshes, stand_mm))
    frames = read_frames(options.frame)
    if frames.published_from_camera[2, 2] >= 0:  # cuts are planned from above
        raise InputError(
            f"{options.frame}: the camera looks up in this frame (its z axis does not point up, "
            "against gravity), so 'above' would be behind the organ. Give a frame whose z "
            "points up."
        )
    if options.arms and options.cell is None:
        raise InputError(
            "--frame: where do the arms stand in that frame? Say it with --cell FILE "
            "(docs/resection.md), or plan the cuts alone with --no-arms."
        )
    return frames


def below(organ: Mesh, config: CellConfig) -> CellConfig:
    """With the table below the organ, if the cell's file does not place it."""
    if any(config.middle_mm):
        return config
    x, y = organ.box_mm.mean(0)[:2].tolist()
    middle_mm = (x, y, float(organ.box_mm[0, 2]) - config.stand_mm)
    return msgspec.structs.replace(config, middle_mm=middle_mm)


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
    run = of_estimate(located) if isinstance(located, Estimate) else read_run(Path(located))
    stand_mm = STAND_MM if stand_mm is None else stand_mm
    frames = PublishedFrame("table", table_under(run.meshes, stand_mm))
    cuts = plan_cuts(run, config, frames, accept_poor)
    plan = checked_against(cuts.plan, cuts.budgets_of(cuts.plan), accept_budget)
    if picture is not None:
        from tumortrack_resection.pictures import draw_plan

        draw_plan(plan, cuts.located, Path(picture))
    return plan
