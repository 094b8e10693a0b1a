"""`tumortrack plan`: a run -> strokes, motions of two arms, pictures."""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import InputError, NoPlan

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float64

    from tumortrack.core.types import Mesh
    from tumortrack.plan.arms.config import CellConfig
    from tumortrack.plan.config import ResectionConfig
    from tumortrack.plan.located import LocatedRun
    from tumortrack.plan.values import Located, ResectionPlan


@dataclass(frozen=True)
class PlanOptions:
    frame: Path | None = None
    stand_mm: float | None = None
    cell: Path | None = None
    arms: bool = True
    overwrite: bool = False


def choices(file: Path | None, given: dict) -> ResectionConfig:
    """What the file says, and over that what was given on the command line."""
    from tumortrack.plan.config import ResectionConfig

    written = {} if file is None else store.read_json(file)
    return from_builtins({**written, **given}, ResectionConfig, str(file or "options"))


def check_arms_installed() -> None:
    """Raises InputError where a library that motions need is missing."""
    needed = ("pinocchio", "coal", "toppra", "ruckig", "ur_analytic_ik")
    if missing := [name for name in needed if find_spec(name) is None]:
        raise InputError(f"arms need {', '.join(missing)}: pip install 'tumortrack[arms]'.")


def plan(run_folder: Path, folder: Path, config: ResectionConfig, options: PlanOptions) -> None:
    """`tumortrack plan`: a run -> strokes, motions, pictures."""
    from tumortrack.plan.files import KIND, PlanFolder, write_plan
    from tumortrack.plan.located import read_run
    from tumortrack.plan.resection import plan_resection
    from tumortrack.report.plan_pictures import draw_plan

    store.check_place(folder, KIND, options.overwrite)
    cell_config = _cell_config(options)
    if options.arms:
        check_arms_installed()
    run = read_run(run_folder)
    frame_id, table_from_camera = _frame(run, options, cell_config.stand_mm)
    located = run.located(table_from_camera)
    if options.arms:
        cell_config = _below(organ_of(located), cell_config)
    resection = plan_resection(located, config)
    _tell(resection)
    motions, cell_used = None, None
    if options.arms:
        from tumortrack.plan.arms.procedure import search_bases

        start = time.perf_counter()
        placed, motions, moved = search_bases(resection, cell_config, organ_of(located))
        cell_used = to_builtins(placed.config)
        say(
            f"arms: {len(motions.stages)} stages, {motions.seconds:.0f} s; planned in "
            f"{time.perf_counter() - start:.1f} s."
        )
        if moved:
            say(f"note: {moved}")
    content = PlanFolder(
        resection,
        config,
        table_from_camera,
        frame_id,
        located.meshes,
        cell_used,
        motions,
        _case_of(run_folder),
    )

    def pictures(aside: Path) -> None:
        draw_plan(resection, located, aside / "plan.png")
        if options.arms:
            from tumortrack.plan.arms.urdf import cell_urdf

            store.write_atomically(aside / "cell.urdf", cell_urdf(placed.config).encode())

    digest = store.sha256_of(run_folder / store.MANIFEST)
    write_plan(folder, content, {"run": digest}, pictures, options.overwrite)
    say(f"written to {folder} (frame {frame_id!r}, mm); look at {folder / 'plan.png'}.")


def _cell_config(options: PlanOptions) -> CellConfig:
    from tumortrack.plan.arms.config import CellConfig

    config = CellConfig()
    if options.cell is not None:
        config = from_builtins(store.read_json(options.cell), CellConfig, str(options.cell))
    if options.stand_mm is not None:
        config = msgspec.structs.replace(config, stand_mm=options.stand_mm)
    return config


def organ_of(located: Located) -> Mesh:
    """The organ's surface, which arms must not touch.

    Raises:
        NoPlan: the run has none.
    """
    if "kidney" not in located.meshes:
        raise NoPlan("the run has no kidney.ply, so arms can't keep clear of it; give --no-arms.")
    return located.meshes["kidney"]


def _frame(
    run: LocatedRun, options: PlanOptions, stand_mm: float
) -> tuple[str, Float64[np.ndarray, "4 4"]]:
    """Frame id and ``table_from_camera``: of the calibration, or of a camera that looks down."""
    from tumortrack.live.calibration_file import read_frames
    from tumortrack.plan.located import table_below

    if options.frame is None:
        kidney = run.meshes.get("kidney")
        points_mm = run.cloud.points_mm if kidney is None else kidney.vertices_mm
        return "table", table_below(points_mm, stand_mm)
    frames = read_frames(options.frame)
    _check_up(options.frame, frames.published_from_camera)
    if options.arms and options.cell is None:
        raise InputError(
            "--frame: where do the arms stand in that frame? Say it with --cell FILE "
            "(docs/resection.md), or plan the cuts alone with --no-arms."
        )
    return frames.frame_id, frames.published_from_camera


def _below(organ: Mesh, config: CellConfig) -> CellConfig:
    """The table below the organ, unless the cell's file says where it is."""
    if any(config.middle_mm):
        return config
    x, y = organ.box_mm.mean(0)[:2].tolist()
    middle_mm = (x, y, float(organ.box_mm[0, 2]) - config.stand_mm)
    return msgspec.structs.replace(config, middle_mm=middle_mm)


def _check_up(file: Path, table_from_camera: Float64[np.ndarray, "4 4"]) -> None:
    """Cuts are planned from above: the camera must look down in the frame that is given."""
    if table_from_camera[2, 2] >= 0:
        raise InputError(
            f"{file}: the camera looks up in this frame (its z axis does not point up, against "
            "gravity), so 'above' would be behind the organ. Give a frame whose z points up."
        )


def _case_of(run_folder: Path) -> str:
    model = store.read_json(run_folder / "report.json").get("model")
    return str(model.get("case_sha256", "")) if isinstance(model, dict) else ""


def _tell(resection: ResectionPlan) -> None:
    volumes = resection.volumes_ml
    say(
        f"{resection.tumor} ({volumes['tumor']:.1f} ml, {resection.exophytic:.0%} outside the "
        f"organ's hull): {len(resection.cuts)} strokes in {resection.sweeps} sweeps, "
        f"{sum(cut.length_mm for cut in resection.cuts):.0f} mm."
    )
    say(
        f"margin {resection.margin_mm:g} mm; {volumes['piece']:.1f} ml come away, of that "
        f"{volumes['healthy']:.1f} ml healthy tissue "
        f"({volumes['healthy'] / volumes['parenchyma']:.0%} of the organ's)."
    )
    for note in resection.notes:
        say(f"note: {note}")
