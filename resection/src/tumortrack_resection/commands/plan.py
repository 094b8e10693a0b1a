"""`plan`: a run -> strokes, motions of two arms, pictures."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional, UseAppendAction

from tumortrack.cli.console import say, say_notes, warn
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.tracking.options import PatientOptions

if TYPE_CHECKING:
    from tumortrack.core.types import Mesh
    from tumortrack.live.values import PublishedFrame
    from tumortrack_resection.arms.config import CellConfig
    from tumortrack_resection.budget import ErrorBudget
    from tumortrack_resection.values import Located, ResectionConfig, ResectionPlan

_BASES = ("cutter_base", "holder_base")


@dataclass(frozen=True, kw_only=True)
class Plan(PatientOptions):
    """Plan how to cut a located tumor out, and how two arms do it.

    Attributes:
        run_folder: folder that `locate` wrote.
        plan: folder to write: plan.json, strokes.ply, plan.png, motions, the cell as URDF.
        method: margin (default) keeps the margin in all directions; published is the paper's
            planner.
        tumor: which one (tumor_1, ...; default: the one that lies farthest out of the organ).
        margin: least distance between tumor and cut in mm (default 5, the paper's; ordinary
            estimates need about 10, docs/resection.md).
        sigmas: add this many standard deviations of the estimate's own uncertainty to the margin
            (default 0).
        confidence: the margin is of healthy tissue, beyond all errors, with the tumor's place as
            sure as this: 0.95, say (`tumortrack margins`; docs/trust.md).
        keep_away: STRUCTURE=MM, again for every structure: refuse a plan whose cuts come nearer
            to it.
        config: JSON file with these and all other choices of the planner (docs/resection.md).
        frame: JSON file that says where the camera is; the plan is then in the robot's frame, whose
            z must point up. Without it, the camera is taken to look straight down.
        stand: height of the organ's lowest point over the table in mm, where no frame is given.
        cell: JSON file with arms, tools, table and their places (docs/resection.md).
        arms: also plan the motions of both arms.
        moved: how far, in mm, the tumor may move before the arms halt; the margin has to cover it
            (docs/resection.md).
        accept_poor: plan on an estimate that `locate` called poor; the plan says so everywhere.
        accept_budget: plan even though the margin does not cover the errors; the plan says so
            everywhere.
        overwrite: replace PLAN if it exists.
    """

    run_folder: Positional[Path]
    plan: Positional[Path]
    method: Literal["margin", "published"] | None = None
    tumor: str | None = None
    margin: float | None = None
    sigmas: float | None = None
    confidence: float | None = None
    keep_away: UseAppendAction[tuple[str, ...]] = ()
    config: Path | None = None
    frame: Path | None = None
    stand: float | None = None
    cell: Path | None = None
    arms: bool = True
    moved: float = 2.0
    accept_poor: bool = False
    accept_budget: bool = False
    overwrite: bool = False

    def run(self) -> None:
        from tumortrack_resection.budget import checked_against, plan_within
        from tumortrack_resection.files import INVENTED, KIND, PlanFolder, write_plan
        from tumortrack_resection.located import notes_of_doubt, read_run
        from tumortrack_resection.operation import OperationConfig
        from tumortrack_resection.pictures import draw_plan

        config = self._resection_config()
        OperationConfig(moved_mm=self.moved)  # what is allowed is said now, not by `resect`
        store.check_place(self.plan, KIND, self.overwrite)
        cell_config, bases_source = self._cell()
        if self.arms:
            check_arms_installed()
        run = read_run(self.run_folder)
        run.patient.check_is(self.stated, str(self.run_folder))
        say(str(run.patient))
        doubts = notes_of_doubt(run.doubt, self.accept_poor)
        frames = self._frame(run, cell_config.stand_mm)
        located = run.moved(frames.published_from_camera)
        budget_of = partial(self._budget, located=located, frames=frames, cell=cell_config)
        resection, config, budget = plan_within(
            located, config, budget_of, self.confidence is not None
        )
        resection = replace(resection, notes=(*doubts, *resection.notes))
        for line in budget.table():
            say(line)
        resection = checked_against(resection, budget, self.accept_budget)
        _say_plan(resection, located)
        motions, cell_used, cell_source = None, None, INVENTED
        if self.arms:
            from tumortrack_resection.arms.procedure import search_bases
            from tumortrack_resection.arms.trajectory import first_hit

            start, organ = time.perf_counter(), located.organ
            placed, motions, moved = search_bases(resection, _below(organ, cell_config), organ)
            if hit := first_hit(motions, placed.config, organ):
                raise NoPlan(f"the arms can't carry this out: {hit}. Place the organ otherwise.")
            cell_used = placed.config
            cell_source = INVENTED if moved else bases_source
            say(
                f"arms: {len(motions.stages)} stages, {motions.seconds:.0f} s; planned in "
                f"{time.perf_counter() - start:.1f} s."
            )
            if moved:
                say(f"note: {moved}")
        model = store.read_json(self.run_folder / "report.json").get("model")
        content = PlanFolder(
            resection, config, frames, located.meshes, budget, cell_used, motions,
            str(model.get("case_sha256") or "") if isinstance(model, dict) else "",
            store.sha256_of(self.frame) if self.frame else INVENTED, cell_source, run.patient,
        )  # fmt: skip

        def pictures(aside: Path) -> None:
            draw_plan(resection, located, aside / "plan.png")
            if self.arms:
                from tumortrack_resection.arms.body import cell_urdf

                store.write_atomically(aside / "cell.urdf", cell_urdf(placed.config).encode())

        digest = store.sha256_of(self.run_folder / store.MANIFEST)
        write_plan(self.plan, content, {"run": digest}, pictures, self.overwrite)
        end = " Mind the warnings above." if resection.warnings else ""
        say(f"written to {self.plan} (frame {frames.frame_id!r}, mm); look at plan.png there.{end}")

    def _resection_config(self) -> ResectionConfig:
        """What the file says, and over that what was given on the command line."""
        from tumortrack.core.config import from_builtins
        from tumortrack_resection.values import ResectionConfig

        written = {} if self.config is None else store.read_json(self.config)
        names = {"method": "method", "tumor": "tumor", "margin": "margin_mm", "sigmas": "sigmas"}
        options = {key: getattr(self, name) for name, key in names.items()}
        given = {key: value for key, value in options.items() if value is not None}
        if self.keep_away:
            given["keep_away"] = dict(map(_structure_mm, self.keep_away))
        return from_builtins({**written, **given}, ResectionConfig, str(self.config or "options"))

    def _budget(
        self,
        resection: ResectionPlan,
        located: Located,
        frames: PublishedFrame,
        cell: CellConfig,
    ) -> ErrorBudget:
        """What the margin has to cover; the camera's place at the tumor's far side."""
        import numpy as np

        from tumortrack_resection.budget import planned_budget, tumor_points

        off_mm = tumor_points(resection, located) - frames.published_from_camera[:3, 3]
        error_mm = frames.error_at(float(np.linalg.norm(off_mm, axis=1).max()))
        tool_mm, sure = cell.tool_error_mm, self.confidence
        return planned_budget(resection, located, error_mm, tool_mm, self.moved, sure)

    def _cell(self) -> tuple[CellConfig, str]:
        """Arms, tools and table, and where the arms' places come from, as ``PlanFolder`` holds it:
        a file that leaves them out gives none."""
        from msgspec.structs import replace

        from tumortrack.core.config import from_builtins
        from tumortrack_resection.arms.config import CellConfig
        from tumortrack_resection.files import INVENTED

        written = {} if self.cell is None else store.read_json(self.cell)
        config = from_builtins(written, CellConfig, str(self.cell))
        given = written.keys() >= {*_BASES}
        source = store.sha256_of(self.cell) if self.cell and given else INVENTED
        return config if self.stand is None else replace(config, stand_mm=self.stand), source

    def _frame(self, run: Located, stand_mm: float) -> PublishedFrame:
        """The table's frame: of the calibration, or of a camera that looks down."""
        from tumortrack.live.calibration_file import read_frames
        from tumortrack.live.values import PublishedFrame
        from tumortrack_resection.located import table_under

        if self.frame is None:
            return PublishedFrame("table", table_under(run.meshes, stand_mm))
        frames = read_frames(self.frame)
        if frames.published_from_camera[2, 2] >= 0:  # cuts are planned from above
            raise InputError(
                f"{self.frame}: the camera looks up in this frame (its z axis does not point up, "
                "against gravity), so 'above' would be behind the organ. Give a frame whose z "
                "points up."
            )
        if self.arms and self.cell is None:
            raise InputError(
                "--frame: where do the arms stand in that frame? Say it with --cell FILE "
                "(docs/resection.md), or plan the cuts alone with --no-arms."
            )
        return frames


def check_arms_installed() -> None:
    """Raises InputError where a library that motions need is missing."""
    needed = ("pinocchio", "coal", "toppra", "ruckig")
    if missing := [name for name in needed if find_spec(name) is None]:
        raise InputError(
            f"arms need {', '.join(missing)}: pip install 'tumortrack-resection[arms]'. toppra and "
            "ruckig have packages for x86-64 alone; elsewhere plan the cuts with --no-arms."
        )


def _structure_mm(option: str) -> tuple[str, float]:
    """Of STRUCTURE=MM; InputError for anything else."""
    name, _, text = option.partition("=")
    try:
        return name, float(text)
    except ValueError as error:
        raise InputError(f"--keep-away {option!r} is not STRUCTURE=MM, artery=3 say.") from error


def _below(organ: Mesh, config: CellConfig) -> CellConfig:
    """The table below the organ, unless the cell's file says where it is."""
    from msgspec.structs import replace

    if any(config.middle_mm):
        return config
    x, y = organ.box_mm.mean(0)[:2].tolist()
    middle_mm = (x, y, float(organ.box_mm[0, 2]) - config.stand_mm)
    return replace(config, middle_mm=middle_mm)


def _say_plan(resection: ResectionPlan, located: Located) -> None:
    from tumortrack_resection.budget import kept_words

    warn(resection.warnings)
    ml = resection.volumes_ml
    say(
        f"{resection.tumor} ({ml['tumor']:.1f} ml, {resection.exophytic:.0%} outside the organ's "
        f"hull): {len(resection.cuts)} strokes in {resection.sweeps} sweeps, "
        f"{sum(cut.length_mm for cut in resection.cuts):.0f} mm."
    )
    say(
        f"{kept_words(resection, located)}; {ml['piece']:.1f} ml come away, of that "
        f"{ml['healthy']:.1f} ml healthy tissue ({ml['healthy'] / ml['parenchyma']:.0%} of the "
        "organ's)."
    )
    say_notes(note for note in resection.notes if note not in resection.warnings)
