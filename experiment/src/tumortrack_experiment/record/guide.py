"""Takes the user through the states: shows what the camera sees, and says what is wrong."""

from __future__ import annotations

import select
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

from tumortrack.cli.console import say
from tumortrack.core.cloud import CloudConfig
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import Affine
from tumortrack.core.types import DepthFrame, Intrinsics
from tumortrack.io.depth_files import DepthCorrection
from tumortrack.live.cameras import CameraSetup
from tumortrack.live.values import Observation, SourceLost
from tumortrack.live.views import FrameCheck
from tumortrack.live.workers import OPENING_S, SourceWorker
from tumortrack.segmentation import RegionConfig
from tumortrack_experiment.kit_file import Kit
from tumortrack_experiment.record.folder import RecordingFolder
from tumortrack_experiment.record.quality import DepthMeter

_TICK_S = 0.1  # a look at the keyboard at least so often
_LINE_S = 0.2  # between two changes of the line
_LONGEST_S = 1.0  # between two frames: a longer pause is no time of the recording
_GIVE_UP_S = 60.0  # without a frame, where nobody is asked
_FROZEN_S = 0.25  # the same image bit for bit, as `track` has it
_AGAIN, _QUIT = "r", "q"


@dataclass(frozen=True)
class GuideConfig:
    """How long each state is recorded, s, and between which depths, mm, frames are good. ``yes``:
    nobody is asked; each state begins after ``countdown`` seconds."""

    seconds: float
    range: tuple[float, float]
    yes: bool
    countdown: float


@dataclass(eq=False)
class Guide:
    """Records from one open source."""

    options: GuideConfig
    folder: RecordingFolder
    worker: SourceWorker
    setup: CameraSetup
    kit: Kit | None
    intrinsics: Intrinsics | None
    correction: DepthCorrection

    def __post_init__(self) -> None:
        known = self.setup.published.table_in_camera or self.folder.about.get("table_in_camera")
        self._known = known and tuple(known)
        self._check = self._new_check()
        # Frames dropped before this state, frames refused in it; the last usable one, the line.
        self._before = self._unusable = 0
        self._heard_s, self._shown_s, self._trouble = time.monotonic(), 0.0, ""

    def record(self, states: list[str]) -> None:
        """One after the other. Raises SourceLost: no frame for a minute; InputError: the source is
        at its end, or gives no depth images; StorageError: the disk refuses."""
        every = self.folder.about["states"]
        for state in states:
            say(f"state {every.index(state) + 1} of {len(every)}: {state}")
            for part in self.kit.parts if self.kit else ():
                if part.state == state:
                    say(f"  set up {part.name}: {part.purpose}")
            answer = _AGAIN
            while answer == _AGAIN:
                answer = self._wait() or self._take(state)
            if answer == _QUIT:
                return

    def _wait(self) -> str:
        """Show what is seen, until it is to be recorded; or the user ends it."""
        asks, meter = not self.options.yes, DepthMeter(self.options.range)
        begin_s, self._before = time.monotonic(), self.worker.dropped
        if asks:
            say(f"  Enter records {self.options.seconds:g} s; {_QUIT} and Enter ends")
        for seen, _ in self._frames(patient=asks):
            if seen is not None:
                meter.add(seen)
            left_s = max(self.options.countdown - (time.monotonic() - begin_s), 0.0)
            self._line("" if asks else f"in {left_s:.0f} s: ", meter)
            if asks and select.select([sys.stdin], [], [], 0)[0]:
                said = sys.stdin.readline()
                return _QUIT if said.strip().lower() == _QUIT or not said else ""
            if not asks and meter.frames and not left_s:
                break
        return ""

    def _take(self, state: str) -> str:
        """Record a state; what the user says of it."""
        self.folder.begin(state)
        meter, left_s, doubts = (
            DepthMeter(self.options.range),
            self.options.seconds,
            dict[str, bool](),
        )
        self._before, self._unusable, last_ns, longest_s = self.worker.dropped, 0, 0, 0.0
        for seen, where in self._frames():
            if seen is not None:
                self.folder.add(seen, where)
                meter.add(seen)
                doubts[self._doubt(seen)] = True
                passed_s = max(seen.stamp_ns - (last_ns or seen.stamp_ns), 0) * 1e-9
                last_ns, longest_s = seen.stamp_ns, max(longest_s, passed_s)
                left_s -= min(passed_s, _LONGEST_S)
            self._line(f"recording {state}, {max(left_s, 0):.1f} s: ", meter)
            if left_s <= 0:
                break
        self._line("", None)
        quality = meter.quality(self.worker.dropped - self._before, whole=True)
        doubts[f"the source was silent for {longest_s:.1f} s"] = longest_s > _LONGEST_S
        doubts[f"{self._unusable} frames were refused: {self._trouble}"] = self._unusable > 0
        wrong = [*quality.warnings(self.options.range), *(text for text in doubts if doubts[text])]
        say(f"  {state}: {quality.frames} frames, {quality.line()}")
        for text in filter(None, wrong):
            say(f"  warning: {text}")
        if quality.light is None and state == self.folder.about["states"][0]:
            say("  note: no picture comes with the depth images (realsense?picture=true)")
        table = self._check.watch and self._check.watch.table_in_camera
        if not table and not self._known and not self.setup.poses:
            say("  note: no table was found in this, so camera motion cannot be detected")
        answer = "" if self.options.yes else self._ask()
        if answer not in (_AGAIN, _QUIT):
            self._known = self._known or table
            taken = {"quality": to_builtins(quality), "warnings": list(filter(None, wrong))}
            corrected = self.correction != DepthCorrection()
            self.folder.keep(taken, table_in_camera=self._known, corrected=corrected)
        return answer

    def _ask(self) -> str:
        try:
            ask = f"  Enter keeps it; {_AGAIN} records it again; {_QUIT} ends without it: "
            return input(ask).strip().lower()
        except EOFError:
            return _QUIT

    def _new_check(self) -> FrameCheck:
        """The table is watched as one of a calibration: from the first state on."""
        near_mm, far_mm = self.options.range
        region = RegionConfig(crop=CloudConfig(near_mm=near_mm, far_mm=far_mm))
        published = replace(self.setup.published, calibrated=True, table_in_camera=self._known)
        return FrameCheck(published, region, _FROZEN_S)

    def _doubt(self, seen: Observation) -> str:
        """That camera or table moved, or the camera is frozen or another one; or nothing."""
        try:
            self._check.check_new(seen.content)
            self._check.check(seen)
        except NoEstimate as error:
            self._check = self._new_check()
            said, _, lies = str(error).split(". ")[0].partition(": the table lies ")
            return f"the camera or the table has moved: the table lies {lies}" if lies else said
        return ""

    def _frames(self, patient: bool = False) -> Iterator[tuple[Observation | None, Affine | None]]:
        """Frame after frame, and where the camera was; no frame where none came for a moment.
        ``patient``: however long none comes."""
        self._heard_s = time.monotonic()
        while True:
            got = self.worker.take(_TICK_S)
            try:
                if isinstance(got, Observation):
                    placed = self._placed(got)
                    self._heard_s = time.monotonic()
                    yield placed
                    continue
            except NoEstimate as error:  # where the camera was is unknown
                got = error
            if got is not None:
                self._trouble, self._unusable = str(got), self._unusable + 1
            elif self.worker.ended:
                raise InputError("the source is at its end, and states are missing.")
            elif self.worker.on_demand:
                self._heard_s = time.monotonic()
            limit_s = _GIVE_UP_S if (ready_s := self.worker.ready_s) else OPENING_S
            if not patient and time.monotonic() - max(self._heard_s, ready_s) > limit_s:
                raise SourceLost(f"no frame for {limit_s:g} s. {self._why()}")
            yield None, None

    def _why(self) -> str:
        return self.worker.trouble or self._trouble or "no frame comes"

    def _placed(self, seen: Observation) -> tuple[Observation, Affine | None]:
        content, given, published = seen.content, self.intrinsics, self.setup.published
        if not isinstance(content, DepthFrame):
            raise InputError("the source gives clouds; a recording needs depth images.")
        if given is not None:
            has = content.depth_mm.shape
            if has != (given.height, given.width):
                raise InputError(f"--intrinsics is of another size than the images, {has}.")
            depth_mm = self.correction.corrected(content.depth_mm)
            true = DepthFrame(depth_mm, given, content.stamp_ns)
            seen = replace(seen, content=true)
        if self.setup.poses is not None:
            return seen, self.setup.poses.at(seen)
        return seen, published.published_from_camera if published.calibrated else None

    def _line(self, what: str, meter: DepthMeter | None) -> None:
        """One line that changes, on a terminal; without a meter it is taken away."""
        if not sys.stdout.isatty() or (meter and time.monotonic() - self._shown_s < _LINE_S):
            return
        self._shown_s, text = time.monotonic(), ""
        silent = time.monotonic() - self._heard_s > _LONGEST_S
        if meter is not None and meter.frames and not silent:
            quality = meter.quality(self.worker.dropped - self._before)
            wrong = quality.warnings(self.options.range)[:1]
            text = "".join([f"  {what}", *(f"! {one} ! " for one in wrong), quality.line()])
        elif meter is not None:
            text = f"  {what}{self._why()}"
        sys.stdout.write(f"\r{text[: shutil.get_terminal_size().columns - 1]}\x1b[K")
        sys.stdout.flush()
