"""`resect`: the motions of a plan, virtually, seen by sinks or filmed."""

from __future__ import annotations

import itertools
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from tumortrack.cli import track
from tumortrack.cli.console import model_folder, options_of, progress_of, say, warn
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import Aborted, ArtifactError, InputError
from tumortrack.core.halt import Halt
from tumortrack.core.organ import KIDNEY, Organ, organ_first, organ_name
from tumortrack.core.patient import Patient
from tumortrack.tracking.options import CameraOptions

if TYPE_CHECKING:
    from concurrent.futures import Future

    import numpy as np
    from jaxtyping import Float64

    from tumortrack.core.types import Mesh
    from tumortrack.live.values import RigidShape, SourceConfig, TrackingResult, Workcell
    from tumortrack_resection import operation as operations
    from tumortrack_resection.arms.cell import ArmCell
    from tumortrack_resection.arms.config import CellConfig
    from tumortrack_resection.files import PlanFolder
    from tumortrack_resection.motions import Motions
    from tumortrack_resection.ur_sink import UrSinkConfig
    from tumortrack_resection.values import Located

_FPS = 30.0  # of an execution that no camera drives
_NOTHING = "PLAYBACK of a stored plan: nothing is tracked"
_FILM_FRAMES, _FILM_STEP_S = 120, 0.1
_DRY_RUN = "DRY RUN: no arm is connected"
_LIVE = ("realsense", "ros2")  # sources that show the present


@dataclass(frozen=True, kw_only=True)
class Resect(CameraOptions):
    """Carry a plan out with virtual arms, shown by the same sinks as `track`.

    Attributes:
        plan: folder that `plan` wrote.
        sinks: where arms, cuts and estimates go; see `track`. ur:ADDRESS is a real arm, and only
            says what it would do unless told execute=true; docs/resection.md has what that needs.
        live: MODEL SOURCE: follow the organ meanwhile, as `track` does. The arms halt while there
            is no good estimate, and the plan is made anew once the tumor has moved.
        replan_cut: plan anew even after the first sweep has begun, though the model knows only the
            intact organ; otherwise the arms halt instead.
        speed: of the arms; 2 is twice as fast as planned.
        moved: the tumor counts as moved once its surface is so many mm from where it was planned
            (root mean square; default: what the plan allows for).
        film: write an animated GIF of the stored plan instead.
        report: file for states, halts and the budget of errors (default: runs/resect-TIME.json).
    """

    plan: Positional[Path]
    sinks: Positional[tuple[str, ...]] = ()
    live: tuple[Path, str] | None = None
    replan_cut: bool = False
    speed: float = 1.0
    moved: float | None = None
    film: Path | None = None
    report: Path | None = None

    def run(self) -> None:
        from tumortrack.live.session import named_sinks
        from tumortrack_resection.files import read_plan
        from tumortrack_resection.operation import OperationConfig
        from tumortrack_resection.planning import check_arms_installed
        from tumortrack_resection.ur_sink import UrSinkConfig

        check_arms_installed()
        if self.film is not None:
            say(f"A film of {self.plan}, usually within a minute: tests its motions, then draws.")
        stored = read_plan(self.plan)
        stored.patient.check_is(self.stated, str(self.plan))
        if stored.motions is None or stored.cell is None:
            raise InputError(f"{self.plan} was planned with --no-arms; plan again without it.")
        organ = organ_name(stored.meshes)
        if organ is None or stored.plan.tumor not in stored.meshes:
            lacking = stored.plan.tumor if organ else "the organ"
            raise ArtifactError(f"{self.plan} lacks {lacking}'s surface. Plan again.")
        sinks = named_sinks(self.sinks).values()  # reports wrong ones before all that takes long
        moved_mm = self._moved_mm(stored)
        config = OperationConfig(speed=self.speed, moved_mm=moved_mm, replan_cut=self.replan_cut)
        arms = [sink for sink in sinks if isinstance(sink, UrSinkConfig)]
        moving = [arm for arm in arms if arm.execute]
        live = None if self.live is None else _live_of(*self.live, stored)
        if moving:
            self._check_real(stored, moving, live)
        cell = _checked_cell(self.plan, stored.motions, stored.cell, stored.meshes[organ])
        procedure = _Procedure(self, stored, stored.motions, cell, config, arms)
        if self.film is not None:
            if self.live is not None or self.sinks:
                raise InputError("--film shows the stored plan; give it without sinks and --live.")
            warn(stored.plan.warnings)
            store.check_place(self.film, "", None)
            procedure.film(self.film)
            return
        _confirm(moving, stored.patient)
        with _dry_run([arm for arm in arms if not arm.execute], moving):
            say(str(stored.patient))
            warn(stored.plan.warnings)
            if live is None:
                procedure.execute()
            else:
                procedure.follow(live)

    def _check_real(
        self, stored: PlanFolder, arms: Sequence[UrSinkConfig], live: _Live | None
    ) -> None:
        """Raises InputError that lists what is missing for real arms to move."""
        from tumortrack_resection.files import INVENTED
        from tumortrack_resection.values import POOR_ESTIMATE

        model, source = self.live or ("", "")
        budget, moved_mm = stored.budget, self._moved_mm(stored)
        assumed = budget.assumed
        kind = Organ(name=organ_name(stored.meshes) or KIDNEY.name)
        needs = {
            "--live MODEL SOURCE, so that they stop where the tumor moves": live,
            f"a source that shows the present ({', '.join(_LIVE)}; not {source})": (
                live is None or live.shows_the_present
            ),
            f"a model that says which case it is of ({model} does not)": (
                live is None or live.case
            ),
            "a plan that says which case it was made on (locate and plan again)": (
                stored.case_sha256
            ),
            "--patient ID and --side, as you know them": kind.identified(self.stated),
            f"a plan that says whose organ it is (this one's: {stored.patient})": (
                kind.identified(stored.patient)
            ),
            f"a model that says whose organ it is (not {model})": live is None
            or kind.identified(live.whose),
            "a plan made on a good estimate (this one's was poor)": (
                not any(note.startswith(POOR_ESTIMATE) for note in stored.plan.notes)
            ),
            "a plan made with --frame FILE (this one's frame is invented)": (
                stored.frame_source != INVENTED
            ),
            "a plan made with --frame FILE that has camera_frame_id, as this source has": (
                live is None or stored.frames.camera_frame_id or live.kind != "ros2"
            ),
            "a plan made with --cell FILE that gives both bases, and keeps to them": (
                stored.cell_source != INVENTED
            ),
            f"--speed up to 1, not {self.speed:g}": self.speed <= 1,
            "a plan whose margin covers its errors (plan again with a wider one)": (
                budget.left_mm >= 0
            ),
            "a plan by a model that says how unsure it is (preset clinic)": (
                "tracking" not in assumed
            ),
            "a plan with the calibration's error (error_mm in the --frame file)": (
                "hand-eye" not in assumed
            ),
            "a plan with the tools' error (tool_error_mm in the --cell file)": (
                "tool" not in assumed
            ),
            f"--moved as planned with, not {moved_mm:g}": moved_mm <= budget.motion_mm,
            "each arm once, at an address of its own": (
                len(arms) == len({arm.arm for arm in arms}) == len({arm.host for arm in arms})
            ),
            "a person at a terminal who confirms it": sys.stdin.isatty(),
        }
        if lacking := [what for what, met in needs.items() if not met]:
            names = " and ".join(arm.host for arm in arms)
            raise InputError(f"the arm at {names} may not move. It needs: {'; '.join(lacking)}.")

    def _moved_mm(self, stored: PlanFolder) -> float:
        return stored.budget.motion_mm if self.moved is None else self.moved


@dataclass(frozen=True, eq=False)
class _Procedure:
    """Carries a stored plan out. ``arms``: real ones, connected or not."""

    asked: Resect
    stored: PlanFolder
    motions: Motions
    cell: ArmCell
    config: operations.OperationConfig
    arms: Sequence[UrSinkConfig]

    def follow(self, live: _Live) -> None:
        """With the live loop: every estimate is compared with the plan, which is made anew where
        the tumor has moved."""
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        import msgspec

        from tumortrack.live.cameras import CameraSetup
        from tumortrack.live.session import Arms
        from tumortrack_resection.arms import procedure
        from tumortrack_resection.arms.cell import tip_places
        from tumortrack_resection.live_budget import LiveBudget
        from tumortrack_resection.located import of_estimate

        stored, asked, frames = self.stored, self.asked, self.stored.frames

        def locate(result: TrackingResult, unsure: bool = False) -> Located:
            assert result.estimate is not None
            return of_estimate(result.estimate, unsure).moved(frames.published_from_camera)

        again = msgspec.structs.replace(stored.config, tumor=stored.plan.tumor)
        # In a process of its own: planning takes a second, and must not delay a frame.
        with ProcessPoolExecutor(
            1, get_context("spawn"), procedure.begin_worker, (again, self.cell.config)
        ) as planner:

            def replan(
                result: TrackingResult,
                joints_rad: Float64[np.ndarray, " 12"],
                progress: operations.ResectionProgress,
            ) -> Future[operations.Planned]:
                seen = locate(result, unsure=stored.config.sigmas > 0)
                return planner.submit(procedure.replan, seen, joints_rad, progress)

            say("starting the replanning worker ...")
            # The worker ignores Ctrl-C, which the live loop handles.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            begun = planner.submit(procedure.warm_up)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            begun.result()
            late_s = max((arm.lookahead_s for arm in self.arms), default=0.0)
            budget = LiveBudget(stored.budget, late_s)
            operation = self._operation(locate=locate, replan=replan, budget=budget)
            setup = CameraSetup(frames, {live.named: live.source})
            about = {"plan_config": to_builtins(self.config)}
            track.Track(
                model=live.model,
                source=live.named,
                sinks=asked.sinks,
                report=asked.report,
                **options_of(asked, CameraOptions),
            ).run(Arms(operation, setup, about, tip_places(self.cell.config), bool(self.arms)))
        self._say_end(operation)

    def execute(self) -> None:
        """Without a camera: play the stored motions in real time."""
        from tumortrack.live import session
        from tumortrack.live.values import Controls, SinkContext, TrackingResult

        stored, frames, controls = self.stored, self.stored.frames, Controls()
        operation = self._operation()
        operation.still_life = _organ_shapes(stored)
        report = self.asked.report or track.default_report("resect")
        session.check_report(report)
        context = SinkContext(tuple(stored.meshes), frames, None, controls, True, stored.patient)
        stop = track.stopping(lambda: operation.abort(Halt("interrupted")))
        with stop, session.open_sinks(session.named_sinks(self.asked.sinks), context) as sinks:
            track.say_opened(sinks)
            seconds = self.motions.seconds / self.config.speed
            say(f"{seconds:.0f} s in frame {frames.frame_id!r}; Ctrl-C stops the arms.")
            errors: dict[str, str] = {}
            shown, started = "", time.monotonic()
            for sequence in itertools.count():
                if controls.aborted.is_set():
                    operation.abort(Halt("aborted"))
                now_ns = time.time_ns()
                nothing = TrackingResult(
                    sequence, now_ns, reason=_NOTHING, published_frame=frames, playback=True
                )
                result = operation.act(nothing)
                for sink in sinks:
                    sink.put(result)
                track.say_failures(sinks, errors)
                assert result.workcell is not None
                text = track.stage_words(result.workcell.state, bool(self.arms))
                text += f": {result.workcell.halted}" if result.workcell.halted else ""
                if text != shown:
                    say(shown := text)
                if operation.ended:
                    break
                time.sleep(max(0.0, started + (sequence + 1) / _FPS - time.monotonic()))
        content = {
            "patient": to_builtins(stored.patient),
            "plan": {name: getattr(stored.plan, name) for name in ("tumor", "method", "warnings")},
            "frame": frames.frame_id,
            "resection": operation.summary(),
            "sinks": {sink.name: sink.summary() for sink in sinks},
        }
        store.write_json(report, content)
        say(f"written to {report}.")
        self._say_end(operation)
        session.check_closed(sinks)

    def film(self, path: Path) -> None:
        """An animated GIF of about twelve seconds."""
        from tumortrack.live.values import TrackingResult
        from tumortrack_resection.files import as_located
        from tumortrack_resection.film import FPS, film, moments_s
        from tumortrack_resection.operation import OperationConfig

        times_s = moments_s(self.motions, _FILM_FRAMES)
        plain = replace(self.stored, plan=replace(self.stored.plan, notes=()))  # the film has them
        operation = replace(self, stored=plain, config=OperationConfig())._operation()
        nothing = TrackingResult(0, 0, reason=_NOTHING)

        def frames() -> Iterator[Workcell]:
            now_s = 0.0
            for time_s in times_s.tolist():
                cell = operation.act(nothing, now_s).workcell
                while now_s < time_s:  # in steps: after a longer pause the arms would halt
                    now_s = min(now_s + _FILM_STEP_S, time_s)
                    cell = operation.act(nothing, now_s).workcell
                assert cell is not None
                yield cell

        number = itertools.count(1)
        with progress_of("frame", "choosing views and colours ...") as show:

            def advance() -> None:
                show(next(number), len(times_s))

            film(frames(), as_located(self.stored), path, progress=advance, plan=self.stored.plan)
        length_s = len(times_s) / FPS
        say(
            f"written to {path}: {self.motions.seconds:.0f} s of motion, shown in {length_s:.0f} s."
        )

    def _operation(self, **live: Any) -> operations.Operation:
        from tumortrack_resection.operation import Operation, Planned

        planned = Planned(self.stored.plan, self.stored.meshes, self.motions)
        return Operation(planned, self.config, self.cell.shapes, **live)

    def _say_end(self, operation: operations.Operation) -> None:
        summary = operation.summary()
        if summary["state"] != "done":
            if operation.halt is not None and operation.halt.kind == "interrupted":
                raise KeyboardInterrupt
            raise Aborted(f"the resection was {summary['state']}: {summary['halted']}.")
        if any(arm.execute for arm in self.arms):
            say("done: all motions were sent; see where the arms stand.")
        else:
            say(f"done: {'nothing moved' if self.arms else 'both virtual arms are home'}.")


def _checked_cell(path: Path, motions: Motions, cell: CellConfig, organ: Mesh) -> ArmCell:
    """Raises ArtifactError: the motions hit something in it, so they are not those planned."""
    from tumortrack_resection.arms.cell import ArmCell
    from tumortrack_resection.arms.trajectory import first_hit

    if hit := first_hit(motions, cell, organ):
        raise ArtifactError(f"{path}: its motions are not as planned: {hit}. Plan again.")
    return ArmCell(cell, organ)


@dataclass(frozen=True, eq=False)
class _Live:
    """What --live says: the model's folder, the digest of its case (empty: unknown), its patient;
    the source, and its text."""

    model: Path
    case: str
    whose: Patient
    named: str
    source: SourceConfig

    @property
    def kind(self) -> str:
        return str(self.source.__struct_config__.tag)

    @property
    def shows_the_present(self) -> bool:
        """Not a virtual source, nor a recording."""
        return self.kind in _LIVE and not Path(getattr(self.source, "device", "")).suffix


def _live_of(model: Path, source: str, stored: PlanFolder) -> _Live:
    """InputError: the model is of another patient or case than the plan."""
    from tumortrack.live.spec import SOURCES
    from tumortrack.models.folder import patient_of

    folder = model_folder(model)
    manifest = store.read_json(folder / store.MANIFEST) if folder.is_dir() else {}
    case = str(manifest.get("provenance", {}).get("case_sha256") or "")
    whose = patient_of(manifest, model)
    if whose.differs(stored.patient):  # it would find another tumor, or none
        raise InputError(f"{model} is of {whose}, the plan of {stored.patient}.")
    if stored.case_sha256 and case and case != stored.case_sha256:  # likewise
        raise InputError(
            f"{model} is of another case than the one that was planned on. Give a model "
            "of that case, or plan on what this model locates."
        )
    return _Live(model, case, whose, source, SOURCES.parse(source))


def _confirm(arms: Sequence[UrSinkConfig], patient: Patient) -> None:
    """A person at the terminal types each arm's address; InputError: something else is typed."""
    for arm in arms:
        import termios  # not on Windows, where no terminal would be found above

        termios.tcflush(sys.stdin, termios.TCIFLUSH)  # discard what was typed before the question
        say(
            f"The {arm.arm} at {arm.host} is about to move: as soon as an estimate is good, and "
            f"again after every pause. It cuts in {patient}: is that who lies here? "
            "Nobody in its reach, a hand at the emergency stop?"
        )
        try:
            typed = input("Type its address to let it begin: ")
        except EOFError:
            typed = ""
        if typed.strip() != arm.host:
            raise InputError(f"{arm.host} was not confirmed; nothing was connected.")


@contextmanager
def _dry_run(dry: Sequence[UrSinkConfig], moving: Sequence[UrSinkConfig]) -> Iterator[None]:
    """Say first and last which arms are not connected."""
    lines = [_DRY_RUN] if dry and not moving else []
    if moving:
        lines = [f"DRY RUN of the {arm.arm} at {arm.host}: it is not connected" for arm in dry]
    for line in lines:
        say(line)
    try:
        yield
    finally:
        for line in lines:
            say(line)


def _organ_shapes(stored: PlanFolder) -> tuple[RigidShape, ...]:
    """Organ and tumors as planned on; a surface that two parts share is drawn once."""
    import numpy as np

    from tumortrack.core.colours import part_colour
    from tumortrack.core.types import Anatomy, Mesh
    from tumortrack.live.values import RigidShape
    from tumortrack_devices.viewer.scene import bare_faces

    names = organ_first(stored.meshes)
    meshes = [stored.meshes[name] for name in names]
    meshes[0] = Mesh(meshes[0].vertices_mm, bare_faces(Anatomy(tuple(meshes))))
    opacity, still = [0.35] + [1.0] * len(names), np.eye(4)
    return tuple(
        RigidShape(f"planned/{name}", mesh, still, part_colour(n + 1), opacity[n])
        for n, (name, mesh) in enumerate(zip(names, meshes, strict=True))
    )
