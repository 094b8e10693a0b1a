"""Takes the user through the states: shows what the camera sees, records, and says what is wrong."""

from __future__ import annotations

import select
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

from tumortrack.cli.console import say
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import Affine
from tumortrack.core.types import DepthFrame, Intrinsics
from tumortrack.live.cameras import CameraSetup
from tumortrack.live.values import Observation, SourceLost
from tumortrack.live.workers import SourceWorker
from tumortrack.sense.region.picture import RegionConfig
from tumortrack.sense.region.watch import TableWatch
from tumortrack_experiment.record.folder import RecordingFolder
from tumortrack_experiment.record.quality import DepthMeter, DepthQuality

_TICK_S = 0.1  # a look at the keyboard at least so often
_LINE_S = 0.2  # between two changes of the line
_LONGEST_NS = 1_000_000_000  # between two frames: a longer pause is none of the recording's time
_GIVE_UP_S = 60.0  # without a frame, where nobody waits before the screen
_AGAIN, _QUIT = "r", "q"


@dataclass(eq=False)
class Guide:
    """``parts``: by state, what is to be set up; ``countdown_s``: instead of asking; None: ask."""

    folder: RecordingFolder
    worker: SourceWorker
    setup: CameraSetup
    region: RegionConfig
    seconds: float
    range_mm: tuple[float, float]
    parts: dict[str, str]
    countdown_s: float | None = None
    intrinsics: Intrinsics | None = None

    def __post_init__(self) -> None:
        published = self.setup.published
        self._placed = published.calibrated or self.setup.poses is not None
        known = published.table_in_camera or self.folder.about.get("table_in_camera")
        self._known = known and tuple(known)
        self._watch = TableWatch(self.region, self._known)
        self._dropped, self._shown_s, self._trouble, self._unusable = 0, 0.0, "", 0

    def record(self) -> None:
        """All states that are missing. Raises SourceLost: no frame for a minute; InputError: the
        source is at its end, or gives no depth images; StorageError: the disk refuses."""
        states = self.folder.about["states"]
        for state in self.folder.missing:
            say(f"state {states.index(state) + 1} of {len(states)}: {state}{self._setup_of(state)}")
            answer = _AGAIN
            while answer == _AGAIN:
                if self._wait() == _QUIT:
                    return
                answer = self._take(state)
            if answer == _QUIT:
                return

    def _setup_of(self, state: str) -> str:
        return f"; set up: {self.parts[state]}" if self.parts.get(state) else ""

    def _wait(self) -> str:
        """Until the user says something, or the countdown is over; what was said."""
        meter, begin_s = DepthMeter(self.range_mm), time.monotonic()
        self._dropped = self.worker.dropped
        if self.countdown_s is None:
            say(
                f"  Enter records {self.seconds:g} s; {_QUIT} and Enter ends, and can be gone on with"
            )
        for seen, _ in self._frames(patient=self.countdown_s is None):
            if seen is not None:
                meter.add(seen)
            left_s = (self.countdown_s or 0) - (time.monotonic() - begin_s)
            self._line(meter, "" if self.countdown_s is None else f"in {max(left_s, 0):.0f} s")
            if self.countdown_s is None:
                if select.select([sys.stdin], [], [], 0)[0]:
                    return (sys.stdin.readline() or _QUIT).strip().lower()
            elif left_s <= 0 and meter.frames:
                break
        return ""

    def _take(self, state: str) -> str:
        """Record a state; what the user says of it."""
        self.folder.begin(state)
        meter, moved, stamps_ns, left_s = DepthMeter(self.range_mm), "", [], self.seconds
        self._dropped, self._unusable = self.worker.dropped, 0
        for seen, where in self._frames():
            if seen is not None:
                self.folder.add(seen, where)
                meter.add(seen)
                moved = moved or self._moved(seen)
                stamps_ns.append(seen.stamp_ns)
                gaps_ns = [min(max(b - a, 0), _LONGEST_NS) for a, b in pairwise(stamps_ns[-2:])]
                left_s -= sum(gaps_ns) * 1e-9
            self._line(meter, f"recording {state}, {max(left_s, 0):.1f} s left")
            if left_s <= 0:
                break
        quality = meter.whole(self.worker.dropped - self._dropped)
        wrong = [*quality.warnings(self.range_mm), *([moved] if moved else [])]
        longest_s = max((b - a for a, b in pairwise(stamps_ns)), default=0) * 1e-9
        if longest_s * 1e9 > _LONGEST_NS:
            wrong.append(f"the source was silent for {longest_s:.1f} s")
        if self._unusable:
            wrong.append(f"{self._unusable} frames could not be used: {self._trouble}")
        return self._settled(state, quality, wrong)

    def _settled(self, state: str, quality: DepthQuality, wrong: list[str]) -> str:
        self._line(None, "")
        say(f"  {state}: {quality.frames} frames, {quality.line()}")
        for text in wrong:
            say(f"  warning: {text}")
        if self._watch.table_in_camera is None and self.setup.poses is None:
            say("  note: no table is seen, so nobody notices if the camera moves between states")
        answer = ""
        if self.countdown_s is None:
            ask = f"  Enter keeps it; {_AGAIN} records it again; {_QUIT} ends without it: "
            try:
                answer = input(ask).strip().lower()
            except EOFError:
                answer = _QUIT
        if answer not in (_AGAIN, _QUIT):
            said = {"quality": to_builtins(quality), "warnings": wrong}
            self._known = self._known or self._watch.table_in_camera
            self.folder.keep(said, table_in_camera=self._known)
        return answer

    def _moved(self, seen: Observation) -> str:
        """What says that the camera has moved since the first state; or nothing."""
        if self.setup.poses is not None:
            return ""
        try:
            self._watch.check(seen.content)
        except NoEstimate as error:
            self._watch = TableWatch(self.region, self._known)
            text = str(error).split(". ")[0]
            return text.replace("the start", "the first state")
        return ""

    def _frames(self, patient: bool = False) -> Iterator[tuple[Observation | None, Affine | None]]:
        """Frame after frame, and where the camera was; no frame where none came for a moment.
        ``patient``: for as long as it takes."""
        heard_s = time.monotonic()
        while True:
            got = self.worker.take(_TICK_S)
            if isinstance(got, Observation):
                heard_s = time.monotonic()
                try:
                    yield self._placed_frame(got)
                    continue
                except NoEstimate as error:
                    got = error
            if got is None and self.worker.ended:
                raise InputError(
                    "the source is at its end, and states are missing. Give a longer one."
                )
            if got is not None:
                self._trouble, self._unusable = str(got), self._unusable + 1
            if not patient and time.monotonic() - heard_s > _GIVE_UP_S:
                why = self._trouble or self.worker.trouble
                raise SourceLost(f"no frame for {_GIVE_UP_S:g} s. {why}")
            yield None, None

    def _placed_frame(self, seen: Observation) -> tuple[Observation, Affine | None]:
        content, given = seen.content, self.intrinsics
        if not isinstance(content, DepthFrame):
            raise InputError("the source gives clouds; a recording needs depth images.")
        if given is not None:
            has = content.intrinsics
            if (has.width, has.height) != (given.width, given.height):
                raise InputError(
                    f"the depth images are {has.width} x {has.height}, and --intrinsics is for "
                    f"{given.width} x {given.height}; calibrate for the size that is streamed."
                )
            seen = replace(seen, content=replace(content, intrinsics=given))
        if self.setup.poses is not None:
            return seen, self.setup.poses.at(seen)
        return seen, self.setup.published.published_from_camera if self._placed else None

    def _line(self, meter: DepthMeter | None, what: str) -> None:
        """One line that changes, on a terminal; without a meter it is taken away."""
        if not sys.stdout.isatty() or (meter and time.monotonic() - self._shown_s < _LINE_S):
            return
        self._shown_s, text = time.monotonic(), ""
        if meter is not None:
            words = [what] if what else []
            if meter.frames:
                quality = meter.now(self.worker.dropped - self._dropped)
                wrong = quality.warnings(self.range_mm)
                words += [*(f"! {one} !" for one in wrong[:1]), quality.line()]
            else:
                words.append(self.worker.trouble or self._trouble or "waiting for a frame")
            text = "  " + ": ".join(words)
        columns = shutil.get_terminal_size().columns - 1
        sys.stdout.write(f"\r{text[:columns]}\x1b[K")
        sys.stdout.flush()
