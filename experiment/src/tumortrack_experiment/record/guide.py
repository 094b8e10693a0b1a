"""Takes the user through the states: shows what the camera sees, and says what is wrong."""

from __future__ import annotations

import select
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tumortrack.cli.console import say
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import Affine
from tumortrack.core.types import DepthFrame, Intrinsics
from tumortrack.live.cameras import CameraSetup
from tumortrack.live.values import Observation, SourceLost
from tumortrack.live.workers import SourceWorker
from tumortrack.sense.cloud import CloudConfig
from tumortrack.sense.files import DepthCorrection
from tumortrack.sense.region.picture import RegionConfig
from tumortrack.sense.region.watch import TableWatch
from tumortrack_experiment.kit_file import Kit
from tumortrack_experiment.record.folder import RecordingFolder
from tumortrack_experiment.record.quality import DepthMeter

if TYPE_CHECKING:
    from tumortrack_experiment.record.command import Record

_TICK_S = 0.1  # a look at the keyboard at least so often
_LINE_S = 0.2  # between two changes of the line
_LONGEST_S = 1.0  # between two frames: a longer pause is no time of the recording
_GIVE_UP_S = 60.0  # without a frame, where nobody is asked
_AGAIN, _QUIT = "r", "q"


@dataclass(eq=False)
class Guide:
    """Records from one open source, by the options of `record`."""

    options: Record
    folder: RecordingFolder
    worker: SourceWorker
    setup: CameraSetup
    kit: Kit | None
    intrinsics: Intrinsics | None
    correction: DepthCorrection

    def __post_init__(self) -> None:
        known = self.setup.published.table_in_camera or self.folder.about.get("table_in_camera")
        self._known = known and tuple(known)
        near_mm, far_mm = self.options.range
        self._region = RegionConfig(crop=CloudConfig(near_mm=near_mm, far_mm=far_mm))
        self._watch = TableWatch(self._region, self._known)
        self._before = self._unusable = 0  # frames dropped before this state; and refused in it
        self._shown_s, self._trouble = 0.0, ""

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
        meter, left_s, last_ns, longest_s, moved = DepthMeter(self.options.range), 0.0, 0, 0.0, ""
        left_s, self._before, self._unusable = self.options.seconds, self.worker.dropped, 0
        for seen, where in self._frames():
            if seen is not None:
                self.folder.add(seen, where)
                meter.add(seen)
                moved = moved or self._moved(seen)
                passed_s = max(seen.stamp_ns - (last_ns or seen.stamp_ns), 0) * 1e-9
                last_ns, longest_s = seen.stamp_ns, max(longest_s, passed_s)
                left_s -= min(passed_s, _LONGEST_S)
            self._line(f"recording {state}, {max(left_s, 0):.1f} s: ", meter)
            if left_s <= 0:
                break
        self._line("", None)
        quality = meter.quality(self.worker.dropped - self._before, whole=True)
        said = {
            moved: bool(moved),
            f"the source was silent for {longest_s:.1f} s": longest_s > _LONGEST_S,
            f"{self._unusable} frames were refused: {self._trouble}": self._unusable > 0,
        }
        wrong = [*quality.warnings(self.options.range), *(text for text in said if said[text])]
        say(f"  {state}: {quality.frames} frames, {quality.line()}")
        for text in wrong:
            say(f"  warning: {text}")
        if quality.light is None and state == self.folder.about["states"][0]:
            say("  note: no picture comes with the depth images (realsense?picture=true)")
        if not (moved or self._watch.table_in_camera or self.setup.poses):
            say("  note: no table was found in this, so nobody notices if the camera moves")
        answer = self._answer()
        if answer not in (_AGAIN, _QUIT):
            self._known = self._known or self._watch.table_in_camera
            taken = {"quality": to_builtins(quality), "warnings": wrong}
            self.folder.keep(taken, table_in_camera=self._known)
        return answer

    def _answer(self) -> str:
        if self.options.yes:
            return ""
        try:
            ask = f"  Enter keeps it; {_AGAIN} records it again; {_QUIT} ends without it: "
            return input(ask).strip().lower()
        except EOFError:
            return _QUIT

    def _moved(self, seen: Observation) -> str:
        """That the camera has moved since the first state; or nothing."""
        try:
            if self.setup.poses is None:
                self._watch.check(seen.content)
        except NoEstimate as error:
            self._watch = TableWatch(self._region, self._known)
            lies = str(error).partition(": ")[2].split(". ")[0]
            return f"the camera or the table has moved since the first state: {lies}"
        return ""

    def _frames(self, patient: bool = False) -> Iterator[tuple[Observation | None, Affine | None]]:
        """Frame after frame, and where the camera was; no frame where none came for a moment.
        ``patient``: however long none comes."""
        heard_s = time.monotonic()
        while True:
            got = self.worker.take(_TICK_S)
            if isinstance(got, Observation):
                heard_s = time.monotonic()
                try:
                    yield self._placed(got)
                    continue
                except NoEstimate as error:  # where the camera was is unknown
                    got = error
            if got is not None:
                self._trouble, self._unusable = str(got), self._unusable + 1
            elif self.worker.ended:
                raise InputError("the source is at its end, and states are missing.")
            if not patient and time.monotonic() - heard_s > _GIVE_UP_S:
                why = self._trouble or self.worker.trouble
                raise SourceLost(f"no frame for {_GIVE_UP_S:g} s. {why}")
            yield None, None

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
        if meter is not None and meter.frames:
            quality = meter.quality(self.worker.dropped - self._before)
            wrong = quality.warnings(self.options.range)[:1]
            text = "".join([f"  {what}", *(f"! {one} ! " for one in wrong), quality.line()])
        elif meter is not None:
            text = f"  {what}{self.worker.trouble or self._trouble or 'waiting for a frame'}"
        sys.stdout.write(f"\r{text[: shutil.get_terminal_size().columns - 1]}\x1b[K")
        sys.stdout.flush()
