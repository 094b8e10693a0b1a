"""`tumortrack resect`: the motions of a plan, virtually, seen by sinks or filmed."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tumortrack.cli.console import progress_bar, say
from tumortrack.cli.live import STOPPED
from tumortrack.core import store
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import Aborted, InputError, StorageError

if TYPE_CHECKING:
    from jaxtyping import Float64

    from tumortrack.live.sink_worker import SinkWorker
    from tumortrack.live.values import RigidShape, TrackingResult, Workcell
    from tumortrack.plan.arms.cell import ArmCell
    from tumortrack.plan.files import PlanFolder
    from tumortrack.plan.operation import Operation, OperationConfig, Planned, ResectionProgress
    from tumortrack.plan.values import Located

    Sinks = tuple[str, ...]

_FPS = 30.0  # of an execution that no camera drives
_NOTHING = "virtual execution of a stored plan: nothing is tracked"
_FILM_FPS, _FILM_FRAMES = 10, 120
_FILM_STEP_S = 0.1


@dataclass(frozen=True)
class ResectOptions:
    live: tuple[Path, str] | None = None
    range_mm: tuple[float, float] | None = None
    box_mm: tuple[float, float, float, float, float, float] | None = None
    whole: bool = False
    intrinsics: Path | None = None
    speed: float = 1.0
    moved_mm: float = 2.0
    film: Path | None = None
    report: Path | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"


def resect(plan_folder: Path, sinks: tuple[str, ...], options: ResectOptions) -> None:
    """`tumortrack resect`: a plan's motions, virtually, shown by sinks or filmed."""
    from tumortrack.cli.live import parse_sinks
    from tumortrack.cli.planning import check_arms_installed
    from tumortrack.live.sinks.ur import UrSinkConfig
    from tumortrack.plan.arms.config import CellConfig
    from tumortrack.plan.files import read_plan
    from tumortrack.plan.operation import OperationConfig

    check_arms_installed()
    stored = read_plan(plan_folder)
    if stored.motions is None or stored.cell is None:
        raise InputError(f"{plan_folder} was planned with --no-arms; plan again without it.")
    # A wrong one is said before anything heavy is loaded.
    if options.speed > 1 and any(
        isinstance(s, UrSinkConfig) and s.execute for s in parse_sinks(sinks)
    ):
        raise InputError(f"--speed {options.speed:g} with real arms; allowed: up to 1.")
    config = OperationConfig(speed=options.speed, moved_mm=options.moved_mm)
    where = str(plan_folder)
    from tumortrack.plan.arms.cell import ArmCell

    cell = ArmCell(from_builtins(stored.cell, CellConfig, where), stored.meshes.get("kidney"))
    if options.film is not None:
        if options.live is not None or sinks:
            raise InputError("--film shows the stored plan; give it without sinks and --live.")
        _film(stored, cell, options.film)
    elif options.live is not None:
        _live(stored, cell, config, sinks, options)
    else:
        _virtual(stored, cell, config, sinks, options)


def _operation(
    stored: PlanFolder, cell: ArmCell, config: OperationConfig, **live: Any
) -> Operation:
    from tumortrack.plan.operation import Operation, Planned

    assert stored.motions is not None
    if stored.plan.tumor not in stored.meshes:
        raise InputError(
            f"the plan lacks {stored.plan.tumor}.ply: it was made on a run without surfaces. "
            "Plan on one that `locate` wrote."
        )
    planned = Planned(stored.plan, stored.meshes, stored.motions)
    return Operation(planned, config, cell.shapes, **live)


def _live(
    stored: PlanFolder, cell: ArmCell, config: OperationConfig, sinks: Sinks, options: ResectOptions
) -> None:
    """Beside the live loop: every estimate is looked at, and planned on where the tumor moved."""
    from concurrent.futures import Future, ProcessPoolExecutor
    from multiprocessing import get_context

    import msgspec

    from tumortrack.cli.live import Arms, TrackOptions, track
    from tumortrack.live.values import PublishedFrame
    from tumortrack.plan import replanning
    from tumortrack.plan.located import located

    assert options.live is not None
    model, source = options.live
    _check_case(stored, model)

    def locate(update: TrackingResult, unsure: bool = False) -> Located:
        estimate = update.estimate
        assert estimate is not None
        motion = estimate.motion if unsure else None
        return located(estimate.cloud, estimate.meshes, motion, stored.table_from_camera)

    again = msgspec.structs.replace(stored.config, tumor=stored.plan.tumor)
    # In a process of its own: planning for a second must not hold up a frame.
    with ProcessPoolExecutor(
        1, get_context("spawn"), replanning.initialize, (again, cell.config)
    ) as planner:

        def replan(
            update: TrackingResult,
            joints_rad: Float64[np.ndarray, " 12"],
            progress: ResectionProgress,
        ) -> Future[Planned]:
            seen = locate(update, unsure=stored.config.sigmas > 0)
            return planner.submit(replanning.replan, seen, joints_rad, progress)

        say("making ready to plan anew ...")
        # The process that begins here does not hear of Ctrl-C: that is the live loop's affair.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        begun = planner.submit(replanning.warm_up)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        begun.result()
        operation = _operation(stored, cell, config, locate=locate, replan=replan)
        frames = PublishedFrame(stored.frame_id, stored.table_from_camera)
        arms = Arms(operation, frames, {"plan_config": to_builtins(config)})
        following = TrackOptions(
            range_mm=options.range_mm,
            box_mm=options.box_mm,
            whole=options.whole,
            intrinsics=options.intrinsics,
            report=options.report,
            device=options.device,
        )
        track(model, source, sinks, following, arms)
    _tell_end(operation)


def _check_case(stored: PlanFolder, model: Path) -> None:
    """Another patient's model would find another patient's tumor."""
    manifest = store.read_json(model / store.MANIFEST) if model.is_dir() else {}
    case = manifest.get("provenance", {}).get("case_sha256", "")
    if stored.case_sha256 and case and case != stored.case_sha256:
        raise InputError(
            f"{model} was trained for another case than the one that was planned on. Give a model "
            "of that case, or plan on what this model locates."
        )


def _virtual(
    stored: PlanFolder, cell: ArmCell, config: OperationConfig, sinks: Sinks, options: ResectOptions
) -> None:
    """Without a camera: the stored motions in real time."""
    from tumortrack.cli.live import open_sinks, parse_sinks, place_of_report, stopping
    from tumortrack.live.values import Controls, PublishedFrame, SinkContext, TrackingResult

    assert stored.motions is not None
    operation = _operation(stored, cell, config)
    operation.still_life = _organ_shapes(stored)
    report = place_of_report(options.report, "resect")
    frames = PublishedFrame(stored.frame_id, stored.table_from_camera)
    controls = Controls()
    context = SinkContext(tuple(stored.meshes), frames, None, controls, arms=True)
    sink_workers: list[SinkWorker] = []
    with ExitStack() as stack:
        stack.enter_context(stopping(lambda: operation.abort(STOPPED)))
        sink_workers = open_sinks(sinks, parse_sinks(sinks), context, stack)
        say(f"{stored.motions.seconds / config.speed:.0f} s in frame {frames.frame_id!r}; "
            "Ctrl-C stops the arms.")  # fmt: skip
        errors: dict[str, str] = {}
        said, sequence, next_s = "", 0, time.monotonic()
        while True:
            if controls.aborted.is_set():
                operation.abort("stopped by the viewer, or a real arm gave up")
            update = operation.act(
                TrackingResult(sequence, time.time_ns(), reason=_NOTHING, published_frame=frames)
            )
            for worker in sink_workers:
                worker.put(update)
                if worker.failing and errors.get(worker.name) != worker.error:
                    errors[worker.name] = worker.error
                    say(f"sink {worker.name}: {worker.error}")
            said = _say_state(update.workcell, said)
            if operation.ended:
                break
            sequence += 1
            next_s += 1 / _FPS
            time.sleep(max(0.0, next_s - time.monotonic()))
    _write_report(
        report, stored, operation, {worker.name: worker.summary() for worker in sink_workers}
    )
    say(f"written to {report}.")
    _tell_end(operation)
    if lost := [worker for worker in sink_workers if worker.unclosed]:
        raise StorageError(f"sink {lost[0].name} did not end well: {lost[0].error}.")


def _organ_shapes(stored: PlanFolder) -> tuple[RigidShape, ...]:
    """Kidney and tumors as they were planned on, no surface drawn twice."""
    from tumortrack.core.colours import part_colour
    from tumortrack.core.types import Anatomy, Mesh
    from tumortrack.live.values import RigidShape
    from tumortrack.live.viewer.surfaces import bare_faces

    names = sorted(stored.meshes)  # kidney before tumors
    meshes = [stored.meshes[name] for name in names]
    meshes[0] = Mesh(meshes[0].vertices_mm, bare_faces(Anatomy(tuple(meshes))))
    return tuple(
        RigidShape(
            f"planned/{name}", mesh, np.eye(4), part_colour(label), 1.0 if label > 1 else 0.35
        )
        for label, (name, mesh) in enumerate(zip(names, meshes, strict=True), start=1)
    )


def _say_state(cell: Workcell | None, said: str) -> str:
    assert cell is not None
    state = cell.state + (f": {cell.halted}" if cell.halted else "")
    if state != said:
        say(state)
    return state


def _write_report(path: Path, stored: PlanFolder, operation: Operation, sinks: dict) -> None:
    content = {
        "plan": {"tumor": stored.plan.tumor, "method": stored.plan.method},
        "frame": stored.frame_id,
        "resection": operation.summary(),
        "sinks": sinks,
    }
    store.write_json(path, content)


def _tell_end(operation: Operation) -> None:
    found = operation.summary()
    if found["state"] == "done":
        say("done: both arms are home.")
        return
    if found["halted"] == STOPPED:
        raise KeyboardInterrupt
    raise Aborted(f"the resection was {found['state']}: {found['halted']}.")


def _film(stored: PlanFolder, cell: ArmCell, path: Path) -> None:
    """An animated GIF of about twelve seconds."""
    from tumortrack.plan.files import as_located
    from tumortrack.report.film import film, moments_s

    assert stored.motions is not None
    times_s = moments_s(stored.motions, _FILM_FRAMES)
    with progress_bar("drawing", len(times_s)) as advance:
        film(
            _frames(stored, cell, times_s),
            as_located(stored),
            path,
            _FILM_FPS,
            progress=lambda *_: advance(),
        )
    n = len(times_s) / _FILM_FPS
    say(f"written to {path}: {stored.motions.seconds:.0f} s in {n:.0f}.")


def _frames(
    stored: PlanFolder, cell: ArmCell, times_s: Float64[np.ndarray, " n"]
) -> Iterator[Workcell]:
    """What is seen at these times; told of the time less often, the arms would halt."""
    from tumortrack.live.values import TrackingResult
    from tumortrack.plan.operation import OperationConfig

    operation = _operation(stored, cell, OperationConfig())
    now_s = 0.0
    for time_s in times_s.tolist():
        frame = operation.act(TrackingResult(0, 0, reason=_NOTHING), now_s)
        while now_s < time_s:
            now_s = min(now_s + _FILM_STEP_S, time_s)
            frame = operation.act(TrackingResult(0, 0, reason=_NOTHING), now_s)
        assert frame.workcell is not None
        yield frame.workcell
