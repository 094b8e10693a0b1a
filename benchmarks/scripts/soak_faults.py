"""Faults at random times: in a camera whose scene is simulated, and in sinks."""

from __future__ import annotations

import resource
import shutil
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tumortrack.core.types import DepthFrame
from tumortrack.live.values import Observation, Sink, SinkContext, SourceLost, TrackingResult
from tumortrack_devices.player import ScenePlayer
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.sensors import depth_of, messages_seen
from tumortrack_devices.sinks.recording import RecordingSinkConfig
from tumortrack_devices.sources.virtual import VirtualSource

# What must be reported of each, as a regular expression.
SOURCE_FAULTS = {
    "frames late": "the frame is stale|no frame for",
    "frozen": "frozen: the same image",
    "truncated": r"holds \d+ bytes; it is damaged",
    "all holes": "only 0 points",
    "swapped in order": "stamp went back",
    "another organ's": "sees through|no organ|not look like|fits the points worse|unsure|not found"
    "|may as well lie",
    "intrinsics changed": "intrinsics changed",
    "source gone": "no frame for|unplugged",
}
SINK_FAULTS = {
    "sink slow": "slow: at one result",
    "sink dead": "the peer is gone",
    "disk full": "cannot write",
}
FAULTS = SOURCE_FAULTS | SINK_FAULTS
_TAPE_S = 20.0  # an hour of depth images would be 40 GB: older tapes are deleted


@dataclass(eq=False)
class Fault:
    """One injected fault. ``begun_s``: when it took effect (``time.monotonic``); NaN: not yet."""

    kind: str
    planned_s: float  # since the first frame
    lasts_s: float
    victim: str = ""  # which sink
    begun_s: float = np.nan
    other: float = 0.0  # in 0..1, of its own randomness

    def begin(self) -> None:
        if np.isnan(self.begun_s):
            self.begun_s = time.monotonic()


class Schedule:
    """Rounds of all kinds in random order, with pauses between them, from a seed."""

    def __init__(
        self, seed: int, seconds: float, stale_s: float, sinks: list[str], kinds: list[str]
    ) -> None:
        rng = np.random.default_rng([seed, 0x50A])
        self.stale_s, self.faults = stale_s, list[Fault]()
        self._origin_s = np.inf
        at_s = 4.0
        while True:
            for kind in rng.permutation(kinds).tolist():
                lasts_s = stale_s * float(rng.uniform(3.0, 6.0))
                if at_s + lasts_s + 3.0 > seconds:
                    return
                victim = "recording" if kind == "disk full" else str(rng.choice(sinks))
                victim = victim if kind in SINK_FAULTS else ""
                other = float(rng.random())
                self.faults.append(Fault(kind, at_s, lasts_s, victim, other=other))
                at_s += lasts_s + float(rng.uniform(2.0, 6.0))

    def start(self) -> None:
        """The first frame is here."""
        self._origin_s = min(self._origin_s, time.monotonic())

    def ended_s(self, fault: Fault) -> float:
        """When it ended, by ``time.monotonic``."""
        return self._origin_s + fault.planned_s + fault.lasts_s

    def now(self) -> Fault | None:
        """The present fault."""
        since_s = time.monotonic() - self._origin_s
        for fault in self.faults:
            if fault.planned_s <= since_s < fault.planned_s + fault.lasts_s:
                return fault
        return None


@dataclass(frozen=True, eq=False)
class Staged(Observation):
    """An observation with what the loop cannot know: when its image was taken (``time.time_ns``),
    and its fault."""

    exposed_ns: int = 0
    fault: str = ""


class FaultyCamera:
    """A virtual source with scheduled faults in its frames and its connection. ``truth`` stays that
    of the true organ at the stamp's time."""

    host_clock, lossless, on_demand = True, False, False  # it stalls as a camera does
    dropped = 0

    def __init__(
        self, player: ScenePlayer, others: list[ScenePlayer], fps: float, schedule: Schedule
    ) -> None:
        self._real = VirtualSource(player, fps)
        self._others = [VirtualSource(other, fps) for other in others]
        self._schedule, self._period_s = schedule, 1 / fps
        self._messages = Messages()
        self._begin_s = self._next_s = np.nan
        self._waiting: deque[Staged] = deque()  # late, or the second of two exchanged
        self._last: Staged | None = None

    def open(self) -> FaultyCamera:
        fault = self._schedule.now()
        if fault is not None and fault.kind == "source gone":
            raise SourceLost("the camera is unplugged")
        self._next_s = time.monotonic()
        return self

    def close(self) -> None:
        self._waiting.clear()

    def read(self, timeout_s: float) -> Observation | None:
        if np.isnan(self._begin_s):
            self._begin_s = time.monotonic()
            self._schedule.start()
        time.sleep(max(min(self._next_s - time.monotonic(), timeout_s), 0.0))
        if time.monotonic() < self._next_s:
            return None
        late_s = time.monotonic() - self._next_s
        self._next_s += self._period_s * (1 + late_s // self._period_s)
        fault = self._schedule.now()
        if fault is None or fault.kind not in SOURCE_FAULTS:
            self._waiting.clear()
            self._last = self._staged(self._real)
            return self._last
        fault.begin()
        return self._faulty(fault)

    def _staged(self, camera: VirtualSource) -> Staged:
        stamp_ns, t_s = time.time_ns(), time.monotonic() - self._begin_s
        frame = camera.at(t_s, stamp_ns)
        return Staged(frame.content, frame.arrived_ns, truth=frame.truth, exposed_ns=stamp_ns)

    def _faulty(self, fault: Fault) -> Observation | None:
        if fault.kind == "source gone":
            raise SourceLost("the camera is unplugged")
        true = replace(self._staged(self._real), fault=fault.kind)
        if fault.kind == "frames late":
            self._waiting.append(true)
            due_ns = time.time_ns() - int(1.4e9 * self._schedule.stale_s)
            return self._waiting.popleft() if self._waiting[0].stamp_ns < due_ns else None
        if fault.kind == "swapped in order":  # nothing, the newer of two, the older
            self._waiting.append(true)
            if len(self._waiting) < 3:
                return None if len(self._waiting) == 1 else true
            older = self._waiting[0]
            self._waiting.clear()
            return older
        if fault.kind == "truncated":
            image, info = (out.message for out in messages_seen(true, self._messages))
            image.data = image.data[: int(fault.other * len(image.data))]
            return replace(true, content=depth_of(image, info))  # refuses
        return self._altered(fault, true)

    def _altered(self, fault: Fault, true: Staged) -> Staged:
        """Another image, or other intrinsics, under the true stamp."""
        frame, last = true.content, self._last
        assert isinstance(frame, DepthFrame)
        if fault.kind == "frozen" and last is not None:
            old = replace(last.content, stamp_ns=frame.stamp_ns)
            return replace(true, content=old, exposed_ns=last.exposed_ns)
        if fault.kind == "all holes":
            holes = np.full_like(frame.depth_mm, np.nan)
            return replace(true, content=frame.with_depth(holes))
        if fault.kind == "another organ's":
            other = self._staged(self._others[int(fault.other * len(self._others))])
            return replace(true, content=replace(other.content, stamp_ns=frame.stamp_ns))
        camera, share = frame.intrinsics, fault.other
        changed = replace(camera, fx=camera.fx * (0.8 + 0.15 * share), fy=camera.fy * 0.8)
        if share < 0.5:  # another crop
            changed = replace(camera, cx=camera.cx + 10 + 40 * share)
        return replace(true, content=replace(frame, intrinsics=changed))


class FaultySink:
    """A sink that is slow or dead at scheduled times."""

    def __init__(self, name: str, inner: Sink, schedule: Schedule) -> None:
        self._name, self._inner, self._schedule = name, inner, schedule
        self._closed = threading.Event()

    def publish(self, result: TrackingResult) -> None:
        fault = self._schedule.now()
        if fault is not None and fault.victim == self._name and fault.kind != "disk full":
            fault.begin()
            if fault.kind == "sink dead":
                raise ConnectionResetError("the peer is gone")
            self._closed.wait(fault.lasts_s / 2)
        self._inner.publish(result)

    def close(self) -> None:
        self._closed.set()
        self._inner.close()


class Tapes:
    """The recorder: a new tape every 20 s, on a disk that is full at scheduled times.

    No file of this process may grow then (RLIMIT_FSIZE, which unlike a small disk needs no rights).
    ``refused``: the tapes that were cut off, each with its fault and its length by then, s.
    """

    def __init__(self, folder: Path, context: SinkContext, schedule: Schedule) -> None:
        self._folder, self._context, self._schedule = folder, context, schedule
        self._number, self._full = 0, False
        self._tape = self._open()
        self.refused: list[tuple[Path, Fault, float]] = []

    def publish(self, result: TrackingResult) -> None:
        fault = self._schedule.now()
        full = fault is not None and fault.kind == "disk full"
        if full and not self._full and fault is not None:
            size = sum(path.stat().st_size for path in self._place.iterdir())
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, _hard()))
            fault.begin()
            ran_s = time.monotonic() - self._opened_s
            self.refused.append((self._place, fault, ran_s))
        elif not full and (self._full or time.monotonic() - self._opened_s > _TAPE_S):
            resource.setrlimit(resource.RLIMIT_FSIZE, (_hard(), _hard()))
            self._tape.close()
            if not self._full:
                shutil.rmtree(self._place)
            self._tape = self._open()
        self._full = full
        self._tape.publish(result)

    def close(self) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (_hard(), _hard()))
        self._tape.close()

    def _open(self) -> Sink:
        self._number, self._opened_s = self._number + 1, time.monotonic()
        self._place = self._folder / f"tape{self._number}"
        return RecordingSinkConfig(path=self._place).open(self._context)


def _hard() -> int:
    return resource.getrlimit(resource.RLIMIT_FSIZE)[1]
