"""From a located run to the folder of a plan: cuts, their error budget, the arms' motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tumortrack.core import store
from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.types import Mesh
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.values import PublishedFrame
from tumortrack.tracking.options import options_from
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.budget import (
    MOVED_MM,
    ErrorBudget,
    checked_against,
    plan_within,
    planned_budget,
    tumor_points,
)
from tumortrack_resection.files import INVENTED, PlanFolder, write_plan
from tumortrack_resection.located import poor_estimate_notes, read_run, table_under
from tumortrack_resection.operation import OperationConfig
from tumortrack_resection.options import PlanOptions
from tumortrack_resection.values import Located, ResectionConfig, ResectionPlan


@dataclass(frozen=True, eq=False)
class Planning:
    """A plan, step by step: the cuts are there; ``checked``, ``with_motions`` and ``save`` follow.

    Attributes:
        content: of the plan's folder, so far.
        located: organ and tumors, in the plan's frame.
        cell: the requested workcell.
        bases_source: of the arms' bases in it, as ``PlanFolder.cell_source``.
        note: what was changed in it for the motions; empty: nothing.
    """

    content: PlanFolder
    located: Located
    run_folder: Path
    options: PlanOptions
    cell: CellConfig
    bases_source: str
    note: str = ""

    def checked(self) -> Planning:
        """With a note on the error budget. NoPlan: the margin doesn't cover the errors, and that
        was not accepted."""
        content, accept = self.content, self.options.accept_budget
        plan = checked_against(content.plan, content.budget, accept)
        return replace(self, content=replace(content, plan=plan))

    def with_motions(self) -> Planning:
        """With the motions of both arms. NoPlan: they can't carry it out."""
        from tumortrack_resection.arms.procedure import search_bases
        from tumortrack_resection.arms.trajectory import first_hit

        plan, organ = self.content.plan, self.located.organ
        placed, motions, note = search_bases(plan, _below(organ, self.cell), organ)
        if hit := first_hit(motions, placed.config, organ):
            raise NoPlan(f"the arms can't carry this out: {hit}. Place the organ otherwise.")
        source = INVENTED if note else self.bases_source
        content = replace(self.content, motions=motions, cell=placed.config, cell_source=source)
        return replace(self, content=content, note=note)

    def save(self, folder: Path, overwrite: bool = False) -> None:
        """Write the folder that `tumortrack plan` writes. Raises as ``files.write_plan``."""
        from tumortrack_resection.pictures import draw_plan

        cell = self.content.cell

        def pictures(aside: Path) -> None:
            draw_plan(self.content.plan, self.located, aside / "plan.png")
            if cell is not None:
                from tumortrack_resection.arms.body import cell_urdf

                store.write_atomically(aside / "cell.urdf", cell_urdf(cell).encode())

        digest = store.sha256_of(self.run_folder / store.MANIFEST)
        write_plan(folder, self.content, {"run": digest}, pictures, overwrite)


def begin_plan(run_folder: str | Path, **given: Any) -> Planning:
    """A plan of a run's folder, step by step, as `tumortrack plan` makes it.

    Args:
        given: as on the command line: ``method``, ``tumor``, ``margin``, ``sigmas``,
            ``confidence``, ``keep_away``, ``config``, ``frame``, ``stand``, ``cell``, ``arms``,
            ``moved``, ``accept_poor``, ``accept_budget``, ``patient``, ``side``.

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
    frames = _frames(run.meshes, options, cell.stand_mm)
    plan, config, budget, located = plan_cuts(
        run, config, frames, options.accept_poor, options.confidence,
        tool_error_mm=cell.tool_error_mm, moved_mm=options.moved,
    )  # fmt: skip
    model = store.read_json(run_folder / "report.json").get("model")
    has_bases = written.keys() >= {"cutter_base", "holder_base"}
    bases_source = store.sha256_of(options.cell) if options.cell and has_bases else INVENTED
    content = PlanFolder(
        plan, config, frames, located.meshes, budget, patient=run.patient,
        case_sha256=str(model.get("case_sha256") or "") if isinstance(model, dict) else "",
        frame_source=store.sha256_of(options.frame) if options.frame else INVENTED,
    )  # fmt: skip
    return Planning(content, located, run_folder, options, cell, bases_source)


def plan_cuts(
    run: Located,
    config: ResectionConfig,
    frames: PublishedFrame,
    accept_poor: bool,
    confidence: float | None,
    *,
    tool_error_mm: float | None = None,
    moved_mm: float = MOVED_MM,
) -> tuple[ResectionPlan, ResectionConfig, ErrorBudget, Located]:
    """The cuts, the configuration in the end (see ``budget.plan_within``), the budget, and the run
    in the plan's frame."""
    doubts = poor_estimate_notes(run.doubt, accept_poor)
    located = run.moved(frames.published_from_camera)

    def budget_of(plan: ResectionPlan) -> ErrorBudget:
        """With the camera's error at the tumor's far side."""
        off_mm = tumor_points(plan, located) - frames.published_from_camera[:3, 3]
        error_mm = frames.error_at(float(np.linalg.norm(off_mm, axis=1).max()))
        return planned_budget(plan, located, error_mm, tool_error_mm, moved_mm, confidence)

    plan, config, budget = plan_within(located, config, budget_of, confidence is not None)
    return replace(plan, notes=(*doubts, *plan.notes)), config, budget, located


def check_arms_installed() -> None:
    """Raises InputError: a library that motions need is missing."""
    needed = ("pinocchio", "coal", "toppra", "ruckig")
    if missing := [name for name in needed if find_spec(name) is None]:
        raise InputError(
            f"arms need {', '.join(missing)}: pip install 'tumortrack-resection[arms]'. toppra and "
            "ruckig have packages for x86-64 alone; elsewhere plan the cuts with --no-arms."
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


def _below(organ: Mesh, config: CellConfig) -> CellConfig:
    """With the table below the organ, if the cell's file does not place it."""
    if any(config.middle_mm):
        return config
    x, y = organ.box_mm.mean(0)[:2].tolist()
    middle_mm = (x, y, float(organ.box_mm[0, 2]) - config.stand_mm)
    return msgspec.structs.replace(config, middle_mm=middle_mm)
