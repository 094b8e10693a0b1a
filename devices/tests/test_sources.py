"""What every live source promises, whatever its kind.

To add a kind: a context manager that yields the open source while frames come, and its line in
``KINDS``.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import pytest

import needs
from clock import PATIENCE_S, until
from depth_files import write_frame_folder
from recording_objects import frame_number, record, update_number
from theatre_objects import small_theatre
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.values import Observation, Source, SourceEnded, SourceLost
from tumortrack_devices.sources.realsense import RealSenseSource, RealSenseSourceConfig
from tumortrack_devices.sources.recording import RecordingSourceConfig
from tumortrack_devices.sources.virtual import VirtualSource


@contextmanager
def virtual(_folder: Path) -> Iterator[Source]:
    yield VirtualSource(small_theatre(), fps=50)


@contextmanager
def realsense(_folder: Path) -> Iterator[Source]:
    needs.module("pyrealsense2", "make debian")
    from realsense_objects import Camera, Streaming

    camera = Camera()
    source = RealSenseSource(camera.device, RealSenseSourceConfig())
    with Streaming(camera):
        yield source


@contextmanager
def playback(folder: Path) -> Iterator[Source]:
    yield RealSenseSourceConfig(device=_recording(folder)).open()


@contextmanager
def playback_frame_by_frame(folder: Path) -> Iterator[Source]:
    yield RealSenseSourceConfig(device=_recording(folder), realtime=False).open()


@contextmanager
def ros2_images(_folder: Path) -> Iterator[Source]:
    with _ros2("image") as opened:
        yield opened


@contextmanager
def ros2_clouds(_folder: Path) -> Iterator[Source]:
    with _ros2("cloud") as opened:
        yield opened


@contextmanager
def _ros2(kind: str) -> Iterator[Source]:
    needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")
    from ros2_objects import own_graph, read_until, sending
    from tumortrack_devices.sources.ros import Ros2SourceConfig

    with own_graph(), sending(kind) as topic:
        source = Ros2SourceConfig(topic=topic).open()
        read_until(source)
        yield source


@contextmanager
def recorded_mcap(folder: Path) -> Iterator[Source]:
    path = record(folder / "r", [update_number(n) for n in range(8)])
    yield RecordingSourceConfig(path=path, rate=0).open()


@contextmanager
def recorded_files(folder: Path) -> Iterator[Source]:
    for n in range(8):
        write_frame_folder(folder / f"{n}", frame_number(n))
    yield RecordingSourceConfig(path=folder).open()


def _recording(folder: Path) -> str:
    needs.module("pyrealsense2", "make debian")
    from realsense_objects import record

    record(str(folder / "frames.db3"), frames=8)
    return str(folder / "frames.db3")


KINDS: dict[str, Callable[[Path], AbstractContextManager[Source]]] = {
    "virtual": virtual,
    "recorded_mcap": recorded_mcap,
    "recorded_files": recorded_files,
    "ros2_images": ros2_images,
    "ros2_clouds": ros2_clouds,
    "realsense": realsense,
    "realsense_playback": playback,
    "realsense_playback_frame_by_frame": playback_frame_by_frame,
}


@pytest.fixture(params=KINDS)
def source(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Source]:
    with KINDS[request.param](tmp_path) as opened:
        yield opened
        opened.close()


def frames_of(source: Source, count: int) -> list[Observation]:
    """So many frames, or as many as come until the end."""
    frames: list[Observation] = []
    with contextlib.suppress(SourceEnded):
        while len(frames) < count:
            frames.append(until(lambda: source.read(1.0), "a frame"))
    return frames


def test_frames_come_in_order_in_mm_and_read_only(source: Source):
    frames = frames_of(source, 5)
    assert len(frames) >= 1
    assert len(frames) + source.dropped >= 5  # the newest counts; a lossless one drops none
    stamps = [seen.stamp_ns for seen in frames]
    assert all(type(stamp) is int for stamp in stamps)
    assert (np.diff(stamps) > 0).all()
    assert (np.diff([seen.arrived_ns for seen in frames]) >= 0).all()
    for seen in frames:
        distance_mm, array = _distance(seen)
        assert array.dtype == np.float32
        assert not array.flags.writeable
        assert 50 < distance_mm < 1000
    assert type(source.dropped) is int
    assert source.dropped >= 0


def _distance(seen: Observation) -> tuple[float, np.ndarray]:
    if isinstance(seen.content, DepthFrame):
        return float(np.nanmedian(seen.content.depth_mm)), seen.content.depth_mm
    assert isinstance(seen.content, SensorCloud)
    return float(np.median(seen.content.points_mm[:, 2])), seen.content.points_mm


def test_arrival_is_this_moment_and_not_before_a_host_clocks_stamp(source: Source):
    begin_ns = time.time_ns()
    frames = frames_of(source, 5)
    end_ns = time.time_ns()
    for seen in frames[1:]:  # the first may have come before it was asked for
        assert begin_ns - PATIENCE_S * 1e9 <= seen.arrived_ns <= end_ns
    if source.host_clock:
        ages_s = [(seen.arrived_ns - seen.stamp_ns) * 1e-9 for seen in frames]
        assert min(ages_s) >= 0
        assert max(ages_s) < PATIENCE_S


def test_a_source_that_waits_loses_nothing(source: Source):
    if not source.lossless:
        pytest.skip("the newest frame counts here")
    everything = 0
    for _ in range(1000):
        try:
            everything += source.read(1.0) is not None
        except SourceEnded:
            break
        time.sleep(0.01)
    with pytest.raises(SourceEnded):
        source.read(0.1)
    assert everything >= 5
    assert source.dropped == 0


def test_closed_twice_it_gives_nothing_more(source: Source):
    frames_of(source, 1)
    source.close()
    source.close()
    for _ in range(2):
        with pytest.raises(SourceLost):
            source.read(1.0)


def test_closing_wakes_whoever_reads(source: Source):
    outcome: list[BaseException] = []
    reading = threading.Event()

    def read_on() -> None:
        try:
            while True:
                source.read(10 * PATIENCE_S)
                reading.set()
        except (SourceLost, SourceEnded) as error:
            outcome.append(error)
            reading.set()

    thread = threading.Thread(target=read_on, daemon=True)
    thread.start()
    assert reading.wait(PATIENCE_S)
    source.close()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert len(outcome) == 1
