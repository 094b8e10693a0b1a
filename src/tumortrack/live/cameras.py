"""One camera, several that stand still, or one that moves: where they are, and which of their
frames go together."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.geometry import IDENTITY, Affine
from tumortrack.io.depth_files import read_poses
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.poses import CameraPoses
from tumortrack.live.spec import POSES, SOURCES
from tumortrack.live.values import CameraView, Observation, PublishedFrame, SourceConfig
from tumortrack.live.workers import SourceWorker

# Frames so far apart go together: free-running cameras of 30 Hz are up to 17 ms apart, and an organ
# that is pushed at 50 mm/s moves by 1 mm, one standard deviation of where a camera stands
# (``simulation.noise.CAMERA_STD``).
TOGETHER_NS = 20_000_000
_FIRST_S = 2.0  # for a camera's first frame
_READ_S = 60.0  # for one that is made or read on demand: it comes, or the source ends


@dataclass(frozen=True, eq=False)
class CameraSetup:
    """``published``: the frame of results; ``sources`` by what they are called; where the cameras
    are in that frame: ``still``, or the poses of one that moves."""

    published: PublishedFrame
    sources: dict[str, SourceConfig]
    still: tuple[Affine, ...] = ()
    poses: CameraPoses | None = None


def camera_setup(
    sources: Sequence[str | SourceConfig], poses: Path | None, moving: str, frame: Path | None
) -> CameraSetup:
    """As the options of `track` say it. Raises InputError: they do not go together."""
    configs = dict(map(_named, sources))
    several = len(sources) > 1
    if len(configs) < len(sources) or several != (poses is not None) or (several and moving):
        raise InputError(
            "--views needs --poses FILE, each source once, and no --moving; --poses needs --views."
        )
    published = read_frames(frame, moves=bool(moving)) if frame else None
    if moving:
        where: CameraPoses = POSES.parse(moving).open()
        if published is not None:
            where.tool_from_camera = published.published_from_camera
        name = published.frame_id if published is not None else where.frame_id
        if not name or where.frame_id not in ("", name):
            where.close()
            raise InputError(
                f"--moving {moving}: --frame FILE with tool_from_camera and frame_id must be of "
                f"the frame of these poses{where.frame_id and f', {where.frame_id!r}'}."
            )
        frame_now = published or PublishedFrame(name, calibrated=True, moves=True)
        return CameraSetup(replace(frame_now, published_from_camera=IDENTITY), configs, poses=where)
    if poses is None:
        return CameraSetup(published or PublishedFrame(), configs)
    frame_id, places = read_poses(poses, len(sources))
    published = published or PublishedFrame(frame_id, places[0], calibrated=True)
    published_from_fixed = published.published_from_camera @ np.linalg.inv(places[0])
    still = published.published_from_camera, *(published_from_fixed @ one for one in places[1:])
    return CameraSetup(published, configs, still)


def _named(source: str | SourceConfig) -> tuple[str, SourceConfig]:
    if isinstance(source, SourceConfig):
        return "the source", source
    return source, SOURCES.parse(source)


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
        if len(self.workers) == 1:
            return self.workers[0].trouble
        troubles = [(n, worker.trouble) for n, worker in enumerate(self.workers, start=1)]
        return "; ".join(f"camera {n}: {trouble}" for n, trouble in troubles if trouble)

    @property
    def ended(self) -> bool:
        return all(worker.ended for worker in self.workers)

    @property
    def dropped(self) -> int:
        return sum(worker.dropped for worker in self.workers)

    @property
    def ready_s(self) -> float:
        return min((ready_s for worker in self.workers if (ready_s := worker.ready_s)), default=0.0)

    @property
    def on_demand(self) -> bool:
        return all(worker.on_demand for worker in self.workers)

    @property
    def latency_from(self) -> str:
        return self.workers[self._lead].latency_from

    def capture_ns(self, seen: Observation) -> int:
        return self.workers[self._lead].capture_ns(seen)

    def take(self, timeout_s: float) -> Observation | TumortrackError | None:
        """As ``SourceWorker.take``; raises what stopped any of them. Where the camera that leads
        has no frame in time, or a faulty or stale one, another one leads."""
        for failure in (worker.failure for worker in self.workers):
            if failure is not None:
                raise failure
        spare: tuple[int, Observation | TumortrackError | None] = self._lead, None
        for n in sorted(range(len(self.workers)), key=lambda n: n != self._lead):
            got = self._next(n, timeout_s if n == self._lead else 0.0)
            if isinstance(got, Observation):
                age_s = (time.time_ns() - self.workers[n].capture_ns(got)) * 1e-9
                if age_s <= self._stale_s:
                    self._lead = n
                    return got
                self._troubles[n] = f"its frame is stale: {age_s:.2f} s old"
            spare = (n, got) if spare[1] is None else spare
        self._lead, got = spare
        return got

    def close(self) -> None:
        for worker in self.workers:
            worker.close()
        if isinstance(self._places, CameraPoses):
            self._places.close()

    def views(self, seen: Observation) -> tuple[list[CameraView], dict[int, str]]:
        """What all cameras saw together with a frame just taken, that one first; and by the others'
        numbers, why there is nothing. Raises NoEstimate: where the camera was is not known."""
        if isinstance(self._places, CameraPoses):
            return [CameraView(1, seen, self._places.at(seen))], {}
        views, absent = [CameraView(self._lead + 1, seen, self._places[self._lead])], {}
        for n, place in enumerate(self._places):
            if n != self._lead:
                got = self._simultaneous(n, seen.stamp_ns)
                if isinstance(got, Observation):
                    views.append(CameraView(n + 1, got, place))
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

    def _simultaneous(self, n: int, stamp_ns: int) -> Observation | str:
        """A camera's frame of about that stamp, or why there is none. It may still be on its way,
        for as long as it may be apart."""
        worker = self.workers[n]
        first, waits_s = n not in self._troubles, TOGETHER_NS * 1e-9
        if first or worker.latency_from == "taking":
            waits_s = _READ_S if worker.on_demand else _FIRST_S
        until_s = time.monotonic() + waits_s
        self._troubles.setdefault(n, "")
        while (got := self._next(n, max(until_s - time.monotonic(), 0.0))) is not None:
            if isinstance(got, Observation):
                later_ns = got.stamp_ns - stamp_ns
                if later_ns > TOGETHER_NS:
                    self._ahead[n] = got
                    return f"its frame is {later_ns * 1e-9:.2f} s later"
                if later_ns >= -TOGETHER_NS:
                    return got
        older_s = (stamp_ns - self._last_ns.get(n, stamp_ns)) * 1e-9
        silent = f"its last frame is {older_s:.2f} s older" if older_s else "no frame"
        return self._troubles[n] or worker.trouble or silent
