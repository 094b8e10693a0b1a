"""One camera, several that stand still, or one that moves: the frames that go together, and where
each camera was."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import Affine
from tumortrack.live.poses import CameraPoses
from tumortrack.live.values import Observation, View
from tumortrack.live.workers import SourceWorker

# Frames so far apart go together: free-running cameras of 30 Hz are up to 17 ms apart, and an organ
# that is pushed at 50 mm/s moves by 1 mm, one standard deviation of where a camera stands
# (``sense.noise.CAMERA_STD``).
TOGETHER_NS = 20_000_000
_OPENING_S = 2.0  # for the first frame beside the first, and for one that is read from a disk


class Cameras:
    """Reads as one ``SourceWorker``: the frames of the camera that leads, which is the first one
    until it is silent, then another.

    Args:
        workers: of the sources.
        places: where the cameras stand, published frame; or of the only camera where it moves.
        stale_s: a camera whose frames are older does not lead, if another one can.
    """

    def __init__(
        self,
        workers: Sequence[SourceWorker],
        places: Sequence[Affine] | CameraPoses,
        stale_s: float = math.inf,
    ) -> None:
        self.workers, self._places, self._stale_s = tuple(workers), places, stale_s
        self._lead = 0
        self._ahead: dict[int, Observation] = {}  # taken, and later than what it was to go with
        self._last_ns: dict[int, int] = {}  # stamp of each camera's last frame
        self._troubles: dict[int, str] = {}

    @property
    def trouble(self) -> str:
        return "; ".join(filter(None, (worker.trouble for worker in self.workers)))

    @property
    def ended(self) -> bool:
        return all(worker.ended for worker in self.workers)

    @property
    def dropped(self) -> int:
        return sum(worker.dropped for worker in self.workers)

    @property
    def opened(self) -> int:
        return sum(worker.opened for worker in self.workers)

    @property
    def defects(self) -> list[str]:
        return [defect for worker in self.workers for defect in worker.defects]

    @property
    def latency_from(self) -> str:
        return self.workers[self._lead].latency_from

    def born_ns(self, seen: Observation) -> int:
        return self.workers[self._lead].born_ns(seen)

    def take(self, timeout_s: float) -> Observation | TumortrackError | None:
        """As ``SourceWorker.take``; raises what stopped any of them. Where the camera that leads
        has no frame in time, or a faulty or stale one, another one leads."""
        for failure in (worker.failure for worker in self.workers):
            if failure is not None:
                raise failure
        spare: tuple[int, Observation | TumortrackError | None] = self._lead, None
        for n in sorted(range(len(self.workers)), key=lambda n: n != self._lead):
            got = self._next(n, timeout_s if n == self._lead else 0.0)
            if isinstance(got, Observation) and not self._stale(n, got):
                self._lead = n
                return got
            spare = (n, got) if spare[1] is None else spare
        self._lead = spare[0]
        return spare[1]

    def _stale(self, n: int, seen: Observation) -> bool:
        age_s = (time.time_ns() - self.workers[n].born_ns(seen)) * 1e-9
        if age_s > self._stale_s:
            self._troubles[n] = f"its frame is stale: {age_s:.2f} s old"
        return age_s > self._stale_s

    def close(self) -> None:
        """Stop reading, and forget where a camera is."""
        for worker in self.workers:
            worker.close()
        if isinstance(self._places, CameraPoses):
            self._places.close()

    def views(self, seen: Observation) -> tuple[list[View], dict[int, str]]:
        """What all cameras saw together with a frame just taken, that one first; and by the
        others' numbers, why there is nothing. Raises NoEstimate: where the camera was is not
        known."""
        if isinstance(self._places, CameraPoses):
            return [View(1, seen, self._places.at(seen))], {}
        views, absent = [View(self._lead + 1, seen, self._places[self._lead])], {}
        for n, place in enumerate(self._places):
            if n == self._lead:
                continue
            got = self._beside(n, seen.stamp_ns)
            if isinstance(got, Observation):
                views.append(View(n + 1, got, place))
            else:
                absent[n + 1] = got
        return views, absent

    def _next(self, n: int, timeout_s: float) -> Observation | TumortrackError | None:
        got = self._ahead.pop(n, None) or self.workers[n].take(timeout_s)
        if isinstance(got, Observation):
            self._last_ns[n] = got.stamp_ns
        if got is not None:
            self._troubles[n] = "" if isinstance(got, Observation) else str(got)
        return got

    def _beside(self, n: int, stamp_ns: int) -> Observation | str:
        """A camera's frame of about that stamp, or why there is none. It may still be on its way,
        for as long as it may be apart."""
        worker = self.workers[n]
        patient = n not in self._last_ns and n not in self._troubles
        patient = patient or worker.latency_from == "taking"
        until_s = time.monotonic() + (_OPENING_S if patient else TOGETHER_NS * 1e-9)
        while True:
            got = self._next(n, max(until_s - time.monotonic(), 0.0))
            if got is None:
                self._troubles.setdefault(n, "")
                break
            if isinstance(got, Observation):
                later_ns = got.stamp_ns - stamp_ns
                if later_ns > TOGETHER_NS:
                    self._ahead[n] = got
                    return f"its frame is {later_ns * 1e-9:.2f} s later"
                if later_ns >= -TOGETHER_NS:
                    return got
        if (last_ns := self._last_ns.get(n)) is None:
            return self._troubles[n] or worker.trouble or "no frame"
        silent = f"its last frame is {(stamp_ns - last_ns) * 1e-9:.2f} s older"
        return self._troubles[n] or worker.trouble or silent
