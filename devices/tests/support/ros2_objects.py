"""Frames sent over ROS 2 from within a test, on a graph that does not leave this machine."""

from __future__ import annotations

import json
import os
import queue
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from unittest import mock

import clients
from clock import PATIENCE_S, until
from live_objects import PARTS, small_anatomy, small_frame
from tumortrack.core.errors import InputError
from tumortrack.core.types import SensorCloud
from tumortrack.live.values import Observation, Sink, Source, TrackingResult
from tumortrack_devices.ros.bus import Bus, open_bus
from tumortrack_devices.ros.sensors import messages_seen

IDENTITY = Path(__file__).parent
PATHS = (IDENTITY.parents[2] / "tests" / "support", os.environ.get("PYTHONPATH", ""))
N_TOPICS = 3 + len(PARTS)
# Each of a run's workers has domains of its own; which, is drawn, for another run may be under way.
# Ports of domains beyond 100 reach into the ephemeral ones.
_WORKERS = 8
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % _WORKERS
DOMAIN = str(1 + _WORKER + _WORKERS * secrets.randbelow(100 // _WORKERS))


@contextmanager
def own_graph() -> Iterator[None]:
    """ROS's environment for tests: the other programs of this machine are not heard."""
    environment = {"ROS_DOMAIN_ID": DOMAIN, "ROS_LOCALHOST_ONLY": "1"}
    with mock.patch.dict(os.environ, environment):
        os.environ.pop("CYCLONEDDS_URI", None)
        yield


class Frames:
    """Sends frames on topics under ``place``."""

    def __init__(self, bus: Bus, place: str) -> None:
        self._bus, self._messages, self.place = bus, bus.messages, place
        self._publishers: dict = {}

    def send(self, seen: Observation, leave_out: tuple[str, ...] = ()) -> None:
        """The image last: what belongs to it is there by then."""
        for suffix, kind, message in reversed(messages_seen(seen, self._messages)):
            if suffix in leave_out:
                continue
            if suffix not in self._publishers:
                self._publishers[suffix] = self._bus.publisher(f"{self.place}/{suffix}", kind)
            self._publishers[suffix](self._messages.to_bytes(message))


@contextmanager
def sending(kind: str, hz: float = 50) -> Iterator[str]:
    """Small frames (``image``) or clouds, stamped as they are sent; yields their topic."""
    place = f"/camera_{secrets.token_hex(4)}"
    over = threading.Event()

    def send() -> None:
        bus = open_bus("dds")
        frames = Frames(bus, place)
        while not over.wait(1 / hz):
            now_ns = time.time_ns()
            cloud = SensorCloud(small_anatomy().organ.vertices_mm, now_ns)
            frames.send(Observation(small_frame(now_ns) if kind == "image" else cloud, now_ns))
        bus.close()

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield f"{place}/{'depth/image_rect' if kind == 'image' else 'points'}"
    finally:
        over.set()
        thread.join()


def read_until(source: Source) -> Observation:
    """Its next whole frame, of a publisher that may still be starting: what belongs to an image
    comes on topics of its own."""

    def frame() -> Observation | None:
        with suppress(InputError):
            return source.read(0.2)
        return None

    return until(frame, "a frame")


class Other:
    """Another process; what it says is read at once, so that it never waits for us."""

    def __init__(self, *command: object, environment: dict[str, str] | None = None) -> None:
        self._process = subprocess.Popen(
            [str(part) for part in command],
            stdout=subprocess.PIPE,
            text=True,
            cwd=IDENTITY,
            env=environment or {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, PATHS))},
            start_new_session=True,
        )
        self._said: queue.Queue[str] = queue.Queue()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        for line in self._process.stdout:
            self._said.put(line)

    def line(self, timeout_s: float = PATIENCE_S) -> str:
        return self._said.get(timeout=timeout_s)

    def lines_until(self, good: Callable[[dict], bool]) -> list[dict]:
        """What it said (JSON), up to the first line that is good."""
        lines = [json.loads(self.line())]
        while not good(lines[-1]):
            lines.append(json.loads(self.line()))
        return lines

    def topics_until(self, good: Callable[[dict[str, dict]], bool]) -> dict[str, dict]:
        """The last message of each topic, once they are good together. Topics race."""
        last: dict[str, dict] = {}

        def heard(message: dict) -> bool:
            last[message.get("topic", "")] = message
            return len(last) >= N_TOPICS and good(last)

        self.lines_until(heard)
        return last

    def running(self) -> bool:
        return self._process.poll() is None

    def ended(self) -> int:
        """Its exit code."""
        return self._process.wait(PATIENCE_S)

    def signal(self, number: int) -> None:
        os.killpg(self._process.pid, number)

    def end(self) -> None:
        """Asked first: Fast DDS's shared memory outlives who is killed."""
        with suppress(ProcessLookupError):  # it has ended by itself
            self.signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(10)
            self.signal(signal.SIGKILL)
        self._process.wait()
        self._thread.join()


@contextmanager
def process(*command: object, environment: dict[str, str] | None = None) -> Iterator[Other]:
    other = Other(*command, environment=environment)
    try:
        yield other
    finally:
        other.end()


# Who is at the other end: our own code over Cyclone DDS, or through a real rclpy, which speaks by
# Fast DDS; or a node as ROS's users write one.
OURS, THROUGH_RCLPY, RCLPY = "ours", "ours through rclpy", "rclpy"


@contextmanager
def peer(*arguments: object, by: str = OURS) -> Iterator[Other]:
    script = "rclpy_peer.py" if by == RCLPY else "ros2_peer.py"
    environment = None if by == OURS else clients.environment("ros-jazzy-rclpy")
    with process(sys.executable, IDENTITY / script, *arguments, environment=environment) as other:
        yield other


@contextmanager
def published_again(sink: Sink, update: TrackingResult) -> Iterator[None]:
    """Ten times a second, for a listener that may not be matched yet."""
    done = threading.Event()

    def again() -> None:
        while not done.is_set():
            sink.publish(update)
            done.wait(0.1)

    thread = threading.Thread(target=again)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
