"""`resect`: the motions of a plan, virtually, seen by sinks or filmed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli import track
from tumortrack.cli.console import model_folder, options_of, progress_of, say, warn
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack_resection.halt import Aborted
from tumortrack_resection.options import ResectOptions
from tumortrack_resection.workcell import stage_words

if TYPE_CHECKING:
    from tumortrack.live.values import TrackingResult
    from tumortrack_resection.session import ResectionSession


@dataclass(frozen=True, kw_only=True)
class Resect(ResectOptions):
    """Carry a plan out with virtual arms, shown by the same sinks as `track`.

    Attributes:
        plan: folder that `plan` wrote.
        sinks: where arms, cuts and estimates go; see `track`. ur:ADDRESS is a real arm, and only
            says what it would do unless told execute=true; docs/resection.md has what that needs.
        film: write an animated GIF of the stored plan instead.
    """

    plan: Positional[Path]
    sinks: Positional[tuple[str, ...]] = ()
    film: Path | None = None

    def run(self) -> None:
        from tumortrack_resection.session import begin_resection

        if self.film is not None:
            if self.live is not None or self.sinks:
                raise InputError(
                    "--film shows the stored plan: give it without sinks and --live. A run is "
                    "recorded by the sink recording:FOLDER, and filmed by film:FILE.gif."
                )
            store.check_place(self.film, "", None)
            say(f"A film of {self.plan}, within a minute or two: checks motions, then draws.")
        if self.live is not None:
            model_folder(self.live[0])
        report = self.report or track.default_report("resect")
        options = options_of(replace(self, report=report), ResectOptions)
        resection = begin_resection(self.plan, self.sinks, **options)
        if self.film is not None:
            _film(resection, self.film)
            return
        resection.confirm()
        dry_run = _dry_run_lines(resection)
        for line in dry_run:
            say(line)
        try:
            say(str(resection.stored.patient))
            warn(resection.stored.plan.warnings)
            if self.live is None:
                _play(resection)
                say(f"written to {report}.")
            else:
                _follow(resection)
            _say_end(resection)
        finally:
            for line in dry_run:
                say(line)


def _play(resection: ResectionSession) -> None:
    shown, errors = "", dict[str, str]()

    def show(result: TrackingResult) -> None:
        nonlocal shown
        track.say_failures(resection.sinks, errors)
        cell = result.control
        assert cell is not None
        text = stage_words(cell.state, bool(resection.arms))
        text += f": {cell.stopped}" if cell.stopped else ""
        if text != shown:
            say(shown := text)

    with track.stopping(resection.stop), resection.opened():
        track.say_opened(resection.sinks)
        frame_id = resection.stored.frames.frame_id
        say(f"{resection.seconds:.0f} s in frame {frame_id!r}; Ctrl-C stops the arms.")
        resection.play(show)


def _follow(resection: ResectionSession) -> None:
    say("starting the replanning worker ...")
    with resection.following() as run:
        track.follow(run)


def _film(resection: ResectionSession, path: Path) -> None:
    warn(resection.stored.plan.warnings)
    with progress_of("frame", "drawing ...") as show:
        length_s = resection.film(path, show)
    motion_s = resection.motions.seconds
    say(f"written to {path}: {motion_s:.0f} s of motion, shown in {length_s:.0f} s.")


def _say_end(resection: ResectionSession) -> None:
    from tumortrack.live.session import check_closed

    halt, state = resection.operation.halt, resection.operation.summary()["resection"]["state"]
    if state != "done":
        if halt is not None and halt.kind == "interrupted":
            raise KeyboardInterrupt
        raise Aborted(f"the resection was {state}: {halt.message if halt else ''}.")
    if resection.moving:
        say("done: all motions were sent; see where the arms stand.")
    else:
        say(f"done: {'nothing moved' if resection.arms else 'both virtual arms are home'}.")
    check_closed(resection.sinks)


def _dry_run_lines(resection: ResectionSession) -> list[str]:
    """Which arms are not connected: the first and the last words of a run."""
    if resection.dry and not resection.moving:
        return ["DRY RUN: no arm is connected"]
    return [f"DRY RUN of the {arm.arm} at {arm.host}: it is not connected" for arm in resection.dry]
