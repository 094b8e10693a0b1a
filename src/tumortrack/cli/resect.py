"""`resect`: the motions of a plan, virtually, seen by sinks or filmed."""

from __future__ import annotations

import itertools
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from tumortrack.cli import track
from tumortrack.cli.console import Device, progress_bar, say
from tumortrack.cli.plan import check_arms_installed
from tumortrack.core import store
from tumortrack.core.errors import Aborted, InputError

if TYPE_CHECKING:
    from concurrent.futures import Future

    import numpy as np
    from jaxtyping import Float64

    from tumortrack.live.values import RigidShape, TrackingResult, Workcell
    from tumortrack.plan import operation as operations
    from tumortrack.plan.arms.cell import ArmCell
    from tumortrack.plan.files import PlanFolder
    from tumortrack.plan.values import Located

_FPS = 30.0  # of an execution that no camera drives
_NOTHING = "virtual execution of a stored plan: nothing is tracked"
_FILM_FRAMES, _FILM_STEP_S = 120, 0.1


@dataclass(frozen=True, kw_only=True)
class Resect:
    """Carry a plan out with virtual arms, seen by sinks as those of `track`.

    Attributes:
        plan: folder that `plan` wrote.
        sinks: where arms, cuts and estimates go; see `track`. ur:ADDRESS is a real arm, and only
            says what it would do unless told execute=true.
        live: MODEL SOURCE: follow the organ meanwhile, as `track` does. Arms stand while there is
            no good estimate, and it is planned anew where the tumor has moved.
        range: of depths, as in `track`.
        box: as in `track`.
        whole: as in `track`.
        intrinsics: as in `track`.
        speed: of the arms' time; 2 is twice as fast.
        moved: the tumor has moved if its surface has by so many mm (root mean square).
        film: write an animated GIF of the stored plan instead.
        report: file for states, halts and what else there was (default: runs/resect-TIME.json).
        device: auto takes CUDA where it is.
    """

    plan: Positional[Path]
    sinks: Positional[tuple[str, ...]] = ()
    live: tuple[Path, str] | None = None
    range: tuple[float, float] | None = None
    box: tuple[float, float, float, float, float, float] | None = None
    whole: bool = False
    intrinsics: Path | None = None
    speed: float = 1.0
    moved: float = 2.0
    film: Path | None = None
    report: Path | None = None
    device: Device = "auto"

    def run(self) -> None:
        from tumortrack import api
        from tumortrack.core.config import from_builtins
        from tumortrack.live.sinks.ur import UrSinkConfig
        from tumortrack.plan.arms.config import CellConfig
        from tumortrack.plan.files import read_plan
        from tumortrack.plan.operation import OperationConfig

        check_arms_installed()
        stored = read_plan(self.plan)
        if stored.motions is None or stored.cell is None:
            raise InputError(f"{self.plan} was planned with --no-arms; plan again without it.")
        sinks = api.named_sinks(self.sinks).values()  # wrong: said before all that takes long
        if self.speed > 1 and any(isinstance(s, UrSinkConfig) and s.execute for s in sinks):
            raise InputError(f"--speed {self.speed:g} with real arms; allowed: up to 1.")
        config = OperationConfig(speed=self.speed, moved_mm=self.moved)
        cell_config = from_builtins(stored.cell, CellConfig, str(self.plan))

        from tumortrack.plan.arms.cell import ArmCell

        cell = ArmCell(cell_config, stored.meshes.get("kidney"))
        if self.film is not None:
            if self.live is not None or self.sinks:
                raise InputError("--film shows the stored plan; give it without sinks and --live.")
            _write_film(stored, cell, self.film)
        elif self.live is not None:
            self._follow(stored, cell, config, *self.live)
        else:
            self._execute(stored, cell, config)

    def _follow(
        self,
        stored: PlanFolder,
        cell: ArmCell,
        config: operations.OperationConfig,
        model: Path,
        source: str,
    ) -> None:
        """Beside the live loop: every estimate is looked at, and planned on where the tumor
        moved."""
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        import msgspec

        from tumortrack.core.config import to_builtins
        from tumortrack.live.values import PublishedFrame
        from tumortrack.plan.arms import procedure
        from tumortrack.plan.located import located

        manifest = store.read_json(model / store.MANIFEST) if model.is_dir() else {}
        case = manifest.get("provenance", {}).get("case_sha256", "")
        if stored.case_sha256 and case and case != stored.case_sha256:
            raise InputError(  # it would find another patient's tumor
                f"{model} was trained for another case than the one that was planned on. Give a "
                "model of that case, or plan on what this model locates."
            )

        def locate(result: TrackingResult, unsure: bool = False) -> Located:
            estimate = result.estimate
            assert estimate is not None
            motion = estimate.motion if unsure else None
            return located(estimate.cloud, estimate.meshes, motion, stored.table_from_camera)

        again = msgspec.structs.replace(stored.config, tumor=stored.plan.tumor)
        # In a process of its own: planning for a second must not hold up a frame.
        with ProcessPoolExecutor(
            1, get_context("spawn"), procedure.begin_worker, (again, cell.config)
        ) as planner:

            def replan(
                result: TrackingResult,
                joints_rad: Float64[np.ndarray, " 12"],
                progress: operations.ResectionProgress,
            ) -> Future[operations.Planned]:
                seen = locate(result, unsure=stored.config.sigmas > 0)
                return planner.submit(procedure.replan, seen, joints_rad, progress)

            say("starting the replanning worker ...")
            # The worker does not hear of Ctrl-C: that is the live loop's affair.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            begun = planner.submit(procedure.warm_up)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            begun.result()
            operation = _operation(stored, cell, config, locate=locate, replan=replan)
            frames = PublishedFrame(stored.frame_id, stored.table_from_camera)
            track.Track(
                model=model, source=source, sinks=self.sinks, range=self.range, box=self.box,
                whole=self.whole, intrinsics=self.intrinsics, report=self.report,
                device=self.device,
            ).run(track.Arms(operation, frames, {"plan_config": to_builtins(config)}))  # fmt: skip
        _say_end(operation)

    def _execute(
        self, stored: PlanFolder, cell: ArmCell, config: operations.OperationConfig
    ) -> None:
        """Without a camera: the stored motions in real time."""
        from tumortrack import api
        from tumortrack.live.values import Controls, PublishedFrame, SinkContext, TrackingResult

        assert stored.motions is not None
        operation = _operation(stored, cell, config)
        operation.still_life = _organ_shapes(stored)
        report = track.report_path(self.report, "resect")
        frames = PublishedFrame(stored.frame_id, stored.table_from_camera)
        controls = Controls()
        context = SinkContext(tuple(stored.meshes), frames, None, controls, arms=True)
        stop = track.stopping(lambda: operation.abort(track.STOPPED))
        with stop, api.open_sinks(api.named_sinks(self.sinks), context) as sinks:
            say(f"{stored.motions.seconds / config.speed:.0f} s in frame {frames.frame_id!r}; "
                "Ctrl-C stops the arms.")  # fmt: skip
            errors: dict[str, str] = {}
            shown, started = "", time.monotonic()
            for sequence in itertools.count():
                if controls.aborted.is_set():
                    operation.abort("stopped by the viewer, or a real arm gave up")
                now_ns = time.time_ns()
                result = operation.act(
                    TrackingResult(sequence, now_ns, reason=_NOTHING, published_frame=frames)
                )
                for sink in sinks:
                    sink.put(result)
                track.say_failures(sinks, errors)
                assert result.workcell is not None
                text = result.workcell.state
                text += f": {result.workcell.halted}" if result.workcell.halted else ""
                if text != shown:
                    say(shown := text)
                if operation.ended:
                    break
                time.sleep(max(0.0, started + (sequence + 1) / _FPS - time.monotonic()))
        content = {
            "plan": {"tumor": stored.plan.tumor, "method": stored.plan.method},
            "frame": stored.frame_id,
            "resection": operation.summary(),
            "sinks": {sink.name: sink.summary() for sink in sinks},
        }
        store.write_json(report, content)
        say(f"written to {report}.")
        _say_end(operation)
        track.check_closed(sinks)


def _operation(
    stored: PlanFolder, cell: ArmCell, config: operations.OperationConfig, **live: Any
) -> operations.Operation:
    from tumortrack.plan.operation import Operation, Planned

    assert stored.motions is not None
    if stored.plan.tumor not in stored.meshes:
        raise InputError(
            f"the plan lacks {stored.plan.tumor}.ply: it was made on a run without surfaces. "
            "Plan on one that `locate` wrote."
        )
    planned = Planned(stored.plan, stored.meshes, stored.motions)
    return Operation(planned, config, cell.shapes, **live)


def _organ_shapes(stored: PlanFolder) -> tuple[RigidShape, ...]:
    """Kidney and tumors as they were planned on, no surface drawn twice."""
    import numpy as np

    from tumortrack.core.colours import part_colour
    from tumortrack.core.types import Anatomy, Mesh
    from tumortrack.live.values import RigidShape
    from tumortrack.live.viewer.surfaces import bare_faces

    names = sorted(stored.meshes)  # kidney before tumors
    meshes = [stored.meshes[name] for name in names]
    meshes[0] = Mesh(meshes[0].vertices_mm, bare_faces(Anatomy(tuple(meshes))))
    opacity, still = [0.35] + [1.0] * len(names), np.eye(4)
    return tuple(
        RigidShape(f"planned/{name}", mesh, still, part_colour(n + 1), opacity[n])
        for n, (name, mesh) in enumerate(zip(names, meshes, strict=True))
    )


def _say_end(operation: operations.Operation) -> None:
    found = operation.summary()
    if found["state"] == "done":
        say("done: both arms are home.")
        return
    if found["halted"] == track.STOPPED:
        raise KeyboardInterrupt
    raise Aborted(f"the resection was {found['state']}: {found['halted']}.")


def _write_film(stored: PlanFolder, cell: ArmCell, path: Path) -> None:
    """An animated GIF of about twelve seconds."""
    from tumortrack.live.values import TrackingResult
    from tumortrack.plan.files import as_located
    from tumortrack.plan.operation import OperationConfig
    from tumortrack.report.film import FPS, film, moments_s

    assert stored.motions is not None
    times_s = moments_s(stored.motions, _FILM_FRAMES)
    operation = _operation(stored, cell, OperationConfig())

    def frames() -> Iterator[Workcell]:
        now_s = 0.0
        for time_s in times_s.tolist():
            frame = operation.act(TrackingResult(0, 0, reason=_NOTHING), now_s)
            while now_s < time_s:  # heard it of the time less often, the arms would halt
                now_s = min(now_s + _FILM_STEP_S, time_s)
                frame = operation.act(TrackingResult(0, 0, reason=_NOTHING), now_s)
            assert frame.workcell is not None
            yield frame.workcell

    with progress_bar("drawing", len(times_s)) as advance:
        film(frames(), as_located(stored), path, progress=advance)
    say(f"written to {path}: {stored.motions.seconds:.0f} s in {len(times_s) / FPS:.0f}.")
