"""A stored plan is checked, then carried out beside the live loop, played back, or filmed."""

from __future__ import annotations

import itertools
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from tumortrack import api
from tumortrack.core import store
from tumortrack.core.colours import part_colour
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import ArtifactError, InputError, NoPlan
from tumortrack.core.organ import KIDNEY, Organ, organ_first, organ_name
from tumortrack.core.patient import Patient
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.io.model_folder import patient_of
from tumortrack.live.cameras import CameraSetup
from tumortrack.live.session import Session, check_report, named_sinks, open_sinks
from tumortrack.live.spec import SOURCES
from tumortrack.live.values import (
    Controls,
    RigidShape,
    SinkConfig,
    SinkContext,
    Source,
    SourceConfig,
    TrackingResult,
)
from tumortrack.live.workers import SinkWorker
from tumortrack.tracking.options import CameraOptions, model_folder, options_from
from tumortrack_devices.sources.virtual import VirtualSourceConfig
from tumortrack_devices.viewer.scene import bare_faces
from tumortrack_resection.budget import LiveBudget, tightest
from tumortrack_resection.check import checked, electrode_line
from tumortrack_resection.files import INVENTED, PlanFolder, read_plan
from tumortrack_resection.grip import Grip, held_std_mm
from tumortrack_resection.located import of_estimate
from tumortrack_resection.motions import Joints, Motions
from tumortrack_resection.operation import (
    Following,
    Operation,
    OperationConfig,
    Planned,
    ResectionProgress,
)
from tumortrack_resection.options import ResectOptions
from tumortrack_resection.planning import check_arms_installed
from tumortrack_resection.swept import Swept
from tumortrack_resection.ur_sink import UrSinkConfig
from tumortrack_resection.values import POOR_ESTIMATE, Located, ResectionPlan

if TYPE_CHECKING:
    from tumortrack_resection.arms.cell import ArmCell
    from tumortrack_resection.arms.config import CellConfig

_FPS = 30.0  # of a playback
_PLAYBACK = "PLAYBACK of a stored plan: nothing is tracked"
_LIVE_SOURCES = ("realsense", "ros2")  # that show the present


class _Live(NamedTuple):
    """The option ``live``. ``case_sha256`` and ``patient``: of the model, as far as known."""

    model: Path
    case_sha256: str
    patient: Patient
    source_text: str
    source: SourceConfig

    @property
    def source_kind(self) -> str:
        return str(self.source.__struct_config__.tag)


class _Pulled(SourceConfig, frozen=True, kw_only=True, tag="pulled"):
    """A virtual source whose organ the holder pulls."""

    virtual: VirtualSourceConfig
    pull_mm: Callable[[], float]

    def patient(self) -> Patient:
        return self.virtual.patient()

    def open(self) -> Source:
        source = self.virtual.open()
        source.pull_mm = self.pull_mm
        return source


class ResectionSession:
    """A stored plan with everything that carrying it out needs; made by ``begin_resection``,
    which has checked it. ``following`` carries it out once, ``opened`` and ``play`` play it
    back. ``arms``: the sinks of real arms; those that execute are ``moving``, the others
    ``dry``. ``sinks``: of a playback."""

    def __init__(
        self, stored: PlanFolder, motions: Motions, cell: ArmCell, live: _Live | None,
        sinks: Sequence[str | SinkConfig], config: OperationConfig, options: ResectOptions,
    ) -> None:  # fmt: skip
        self.stored, self.motions, self._cell, self._live = stored, motions, cell, live
        self._given_sinks, self._config, self._options = sinks, config, options
        self.seconds = motions.seconds / config.speed
        self.arms = _real_arms(sinks)
        self.moving = [arm for arm in self.arms if arm.execute]
        self.dry = [arm for arm in self.arms if not arm.execute]
        self.sinks: list[SinkWorker] = []
        self.operation = self._operation(stored.plan, config)
        self._confirmed = False

    def confirm(self) -> None:
        """A person at the terminal types the address of each arm that will move; valid for one
        ``following``, which asks by itself otherwise. No argument replaces this, so that no
        script moves an arm unattended. InputError: something else is typed."""
        for arm in self.moving:
            import termios  # not on Windows, where no terminal would be found before

            termios.tcflush(sys.stdin, termios.TCIFLUSH)  # discard what was typed too early
            print(
                f"The {arm.arm} at {arm.host} is about to move: as soon as an estimate is good, "
                f"and again after every pause. It cuts in {self.stored.patient}: is that who lies "
                "here? Nobody in its reach, a hand at the emergency stop?",
                flush=True,
            )
            try:
                typed = input("Type its address to let it begin: ")
            except EOFError:
                typed = ""
            if typed.strip() != arm.host:
                raise InputError(f"{arm.host} was not confirmed; nothing was connected.")
        self._confirmed = True

    @contextmanager
    def following(self) -> Iterator[Session]:
        """A live session that compares every estimate with the plan, and replans where the tumor
        has moved. InputError: no ``live`` source was given, or its model can't know what is cut."""
        from tumortrack_resection.arms import procedure
        from tumortrack_resection.arms.body import cell_urdf
        from tumortrack_resection.arms.cell import ArmsReach, tip_places

        stored, live, cell, frames = self.stored, self._live, self._cell, self.stored.frames
        if live is None:
            raise InputError("live: which model and source are to be followed?")
        if not self._confirmed:
            self.confirm()
        self._confirmed = False

        def locate(result: TrackingResult) -> Located:
            assert result.estimate is not None
            return of_estimate(result.estimate).transformed(frames.published_from_camera)

        config = msgspec.structs.replace(stored.config, tumor=stored.plan.tumor)
        # In a process of its own: planning takes a second, and must not delay a frame.
        with ProcessPoolExecutor(
            1,
            get_context("spawn"),
            procedure.begin_worker,
            (config, cell.config, cell_urdf(cell.config)),
        ) as planner:

            def replan(
                result: TrackingResult, joints_rad: Joints, progress: ResectionProgress,
                plan: ResectionPlan,
            ) -> Future[Planned]:  # fmt: skip
                return planner.submit(procedure.replan, locate(result), joints_rad, progress, plan)

            # The worker ignores Ctrl-C, which the live loop handles.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            warming_up = planner.submit(procedure.warm_up)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            warming_up.result()
            late_s = max((arm.lookahead_s for arm in self.arms), default=0.0)
            budget = LiveBudget(stored.budgets, late_s)
            reach, tip_mm = partial(ArmsReach, cell.config), tip_places(cell.config)
            grip = Grip(tip_mm, held_std_mm(stored.budgets[0]))
            line_mm = electrode_line(cell_urdf(cell.config))
            swept = Swept(line_mm, cell.config.tools.radius_mm, stored.budgets[0])
            real = bool(self.arms)
            following = Following(locate, replan, budget, grip, reach, tip_mm, real, swept)
            self.operation = self._operation(stored.plan, self._config, following)
            source = live.source
            if isinstance(source, VirtualSourceConfig) and source.pulled is not None:
                source = _Pulled(virtual=source, pull_mm=lambda: grip.pulled_mm)
            setup = CameraSetup(frames, {live.source_text: source})
            names = ("report", *(field.name for field in fields(CameraOptions)))
            options = {name: getattr(self._options, name) for name in names}
            session = api.session(
                live.model, live.source_text, self._given_sinks, self.operation, setup, **options
            )
            if session.tracker.anatomy_ct is None:  # what is cut would stay unknown
                raise InputError(
                    f"live: {live.model} knows no motion, so nothing of cuts. Give the case itself."
                )
            session.about["plan_config"] = to_builtins(self._config)
            yield session

    @contextmanager
    def opened(self) -> Iterator[None]:
        """For a playback: sinks at work; the report is written when they have flushed.
        InputError: real arms would move, which need the live loop."""
        if self.moving:
            raise InputError("real arms move only beside the live loop, not in a playback.")
        stored, operation, report = self.stored, self.operation, self._options.report
        operation.static_shapes = _organ_shapes(stored)
        if report is not None:
            check_report(report)
        self._controls = Controls()
        context = SinkContext(
            tuple(stored.meshes), stored.frames, None, self._controls, operation, stored.patient
        )
        with open_sinks(named_sinks(self._given_sinks), context) as self.sinks:
            yield
        if report is not None:
            plan = stored.plan
            content = {
                "patient": to_builtins(stored.patient),
                "plan": {"tumor": plan.tumor, "method": plan.method, "warnings": plan.warnings},
                "frame": stored.frames.frame_id,
                **operation.summary(),
                "sinks": {sink.name: sink.summary() for sink in self.sinks},
            }
            store.write_json(report, content)

    def play(self, on_result: Callable[[TrackingResult], None]) -> None:
        """The stored motions in real time, without a camera, while ``opened``. ``on_result`` is
        called with every result, after the sinks have got it."""
        frames, started_s = self.stored.frames, time.monotonic()
        for sequence in itertools.count():
            if self._controls.aborted.is_set():
                self.operation.stop("aborted")
            untracked = TrackingResult(
                sequence, time.time_ns(), reason=_PLAYBACK, published_frame=frames, playback=True
            )
            result = self.operation.act(untracked)
            for sink in self.sinks:
                sink.put(result)
            on_result(result)
            if self.operation.ended:
                return
            time.sleep(max(0.0, started_s + (sequence + 1) / _FPS - time.monotonic()))

    def stop(self) -> None:
        """The user stops the arms for good."""
        self.operation.stop("interrupted")

    def film(self, path: Path, progress: Callable[[int, int], None] = lambda n, of: None) -> float:
        """Write the stored plan as an animated GIF, see ``film.film``; returns its length in s.
        ``progress``: called with the frames drawn, and of how many."""
        from tumortrack_resection.film import film

        plan, located = self.stored.plan, self.stored.located
        return film(plan, located, self.motions, self._cell.shapes, path, progress)

    def _operation(
        self, plan: ResectionPlan, config: OperationConfig, *live: Following
    ) -> Operation:
        return Operation(
            Planned(plan, self.stored.meshes, self.motions), config, self._cell.shapes, *live
        )


def begin_resection(
    plan: str | Path, sinks: Sequence[str | SinkConfig] = (), **given: Any
) -> ResectionSession:
    """A stored plan, checked and ready to be carried out, as `tumortrack resect` does.

    Args:
        plan: folder that `tumortrack plan` wrote.
        sinks: as on the command line (``"viewer"``, ...), or their configurations. A real arm
            needs all that the command needs, and a person who confirms it at the terminal.
        given: as on the command line: ``live``, ``speed``, ``moved``, ``report``
            (default: none is written), ``range``, ``box``, ``whole``, ``intrinsics``, ``device``,
            ``patient``, ``side``.

    Raises:
        InputError: an option or sink cannot be used; a model of another patient or case; something
            is missing that real arms need to move.
        ArtifactError: no plan, or one whose motions are not as planned.
    """
    options = options_from(ResectOptions, given, "begin_resection")
    plan, sinks = Path(plan), tuple(sinks)
    check_arms_installed()
    stored = read_plan(plan)
    stored.patient.check_is(options.stated, str(plan))
    motions = stored.motions
    if motions is None or stored.cell is None:
        raise InputError(f"{plan} was planned with --no-arms; plan again without it.")
    organ = organ_name(stored.meshes)
    if organ is None or stored.plan.tumor not in stored.meshes:
        lacking = stored.plan.tumor if organ else "the organ"
        raise ArtifactError(f"{plan} lacks {lacking}'s surface. Plan again.")
    moving = [arm for arm in _real_arms(sinks) if arm.execute]  # reports wrong sinks early
    moved_mm = stored.budgets[0].motion_mm if options.moved is None else options.moved
    config = OperationConfig(speed=options.speed, moved_mm=moved_mm)
    live = None if options.live is None else _live_of(*options.live, stored)
    cell, stored = _checked(plan, motions, stored.cell, stored)
    if moving:
        _check_real(stored, moving, live, config, options.stated)
    return ResectionSession(stored, motions, cell, live, sinks, config, options)


def _real_arms(sinks: Sequence[str | SinkConfig]) -> list[UrSinkConfig]:
    """Raises InputError: as ``named_sinks``, or a sink is opened already, unchecked."""
    configs = named_sinks(sinks).values()
    if not all(isinstance(config, SinkConfig) for config in configs):
        raise InputError("give sinks as on the command line, or their configurations.")
    return [config for config in configs if isinstance(config, UrSinkConfig)]


def _check_real(
    stored: PlanFolder,
    arms: Sequence[UrSinkConfig],
    live: _Live | None,
    config: OperationConfig,
    stated: Patient,
) -> None:
    """Raises InputError that lists what is missing for real arms to move."""
    budget, kind = tightest(stored.budgets), Organ(name=organ_name(stored.meshes) or KIDNEY.name)
    assumed = {name for each in stored.budgets for name in each.assumed}
    needs = {
        "--live MODEL SOURCE, so that they stop where the tumor moves": live,
        "a plan that says which case it was made on (locate and plan again)": stored.case_sha256,
        "--patient ID and --side, as you know them": kind.identified(stated),
        f"a plan that says whose organ it is (this one's: {stored.patient})": (
            kind.identified(stored.patient)
        ),
        "a plan made on a good estimate (this one's was poor)": (
            not any(note.startswith(POOR_ESTIMATE) for note in stored.plan.notes)
        ),
        "a plan made with --frame FILE (this one's frame is invented)": (
            stored.frame_source != INVENTED
        ),
        "a plan made with --cell FILE that gives both bases, and keeps to them": (
            stored.cell_source != INVENTED
        ),
        f"--speed up to 1, not {config.speed:g}": config.speed <= 1,
        "a plan of the method margin (the published one cuts the tumor)": (
            stored.plan.method == "margin"
        ),
        "a plan whose distances cover its errors (plan again with a wider margin)": (
            budget.left_mm >= 0
        ),
        "a plan on an estimate that knows how far off its tumors may be (preset elastic, good)": (
            "tracking" not in assumed
        ),
        "a plan with the calibration's error (error_mm in the --frame file)": (
            "hand-eye" not in assumed
        ),
        "a plan with the tools' error (tool_error_mm in the --cell file)": ("tool" not in assumed),
        f"--moved as planned with, not {config.moved_mm:g}": config.moved_mm <= budget.motion_mm,
        "each arm once, at an address of its own": (
            len(arms) == len({arm.arm for arm in arms}) == len({arm.host for arm in arms})
        ),
        "a person at a terminal who confirms it": sys.stdin.isatty(),
    }
    if live is not None:
        model = live.model
        is_recording = bool(Path(getattr(live.source, "device", "")).suffix)
        sources = f"{', '.join(_LIVE_SOURCES)}; not {live.source_text}"
        needs |= {
            f"a source that shows the present ({sources})": (
                live.source_kind in _LIVE_SOURCES and not is_recording
            ),
            f"a model that says which case it is of ({model} does not)": live.case_sha256,
            f"a model that says whose organ it is (not {model})": kind.identified(live.patient),
            "a plan made with --frame FILE that has camera_frame_id, as this source has": (
                stored.frames.camera_frame_id or live.source_kind != "ros2"
            ),
        }
    if lacking := [what for what, met in needs.items() if not met]:
        names = " and ".join(arm.host for arm in arms)
        raise InputError(f"the arm at {names} may not move. It needs: {'; '.join(lacking)}.")


def _checked(
    path: Path, motions: Motions, cell: CellConfig, stored: PlanFolder
) -> tuple[ArmCell, PlanFolder]:
    """The workcell, and the plan with the distances that were found now. Raises ArtifactError:
    the motions hit something in it, or a tool comes nearer to a tumor than it may."""
    from tumortrack_resection.arms.body import cell_urdf
    from tumortrack_resection.arms.cell import ArmCell
    from tumortrack_resection.arms.trajectory import first_hit

    located, urdf, file = stored.located, cell_urdf(cell), path / "cell.urdf"
    if not file.is_file() or file.read_text() != urdf:
        raise ArtifactError(f"{file} is not of the plan's cell. Plan again.")
    if hit := first_hit(motions, cell, located.organ):
        raise ArtifactError(f"{path}: its motions are not as planned: {hit}. Plan again.")
    try:
        found = checked(stored.plan, motions, urdf, located)
    except NoPlan as fault:
        raise ArtifactError(f"{path}: its motions are not as planned: {fault}") from fault
    plan = replace(stored.plan, clearances=found.clearances)
    budgets = tuple(
        msgspec.structs.replace(budget, margin_mm=plan.least_mm[budget.part])
        for budget in stored.budgets
    )
    return ArmCell(cell, located.organ), replace(stored, plan=plan, budgets=budgets)


def _live_of(model: Path, source: str, stored: PlanFolder) -> _Live:
    """InputError: the model is of another patient or case than the plan."""
    folder = model_folder(Path(model))
    manifest = store.read_json(folder / store.MANIFEST) if folder.is_dir() else {}
    case = str(manifest.get("provenance", {}).get("case_sha256") or "")
    patient = patient_of(manifest, model)
    if patient.differs(stored.patient):  # it would find another tumor, or none
        raise InputError(f"{model} is of {patient}, the plan of {stored.patient}.")
    if stored.case_sha256 and case and case != stored.case_sha256:  # likewise
        raise InputError(
            f"{model} is of another case than the one that was planned on. Give a model "
            "of that case, or plan on what this model locates."
        )
    return _Live(Path(model), case, patient, source, SOURCES.parse(source))


def _organ_shapes(stored: PlanFolder) -> tuple[RigidShape, ...]:
    """Organ and tumors as planned on; a surface that two parts share is drawn once."""
    names = organ_first(stored.meshes)
    meshes = [stored.meshes[name] for name in names]
    meshes[0] = Mesh(meshes[0].vertices_mm, bare_faces(Anatomy(tuple(meshes))))
    opacity, still = [0.35] + [1.0] * len(names), np.eye(4)
    return tuple(
        RigidShape(f"planned/{name}", mesh, still, part_colour(n + 1), opacity[n], still=True)
        for n, (name, mesh) in enumerate(zip(names, meshes, strict=True))
    )
