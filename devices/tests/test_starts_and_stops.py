"""Sources, sinks and tools that are opened and closed again and again leave nothing behind."""

from __future__ import annotations

import os
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import needs
from clock import until
from live_objects import small_setting
from rtde_arm import RtdeArm
from stereo_objects import endoscope
from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import rigid
from tumortrack.live.spec import POSES, SINKS, SOURCES, TOOLS
from tumortrack.live.values import PublishedFrame

SPECS = {"source": SOURCES, "sink": SINKS, "tool": TOOLS, "poses": POSES}
TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
CONTEXT = replace(
    small_setting(),
    published_frame=PublishedFrame("base", rigid(TURN, np.ones(3)), calibrated=True),
)
TIMES, FIRST = 5, 2  # libraries keep what their first uses made


def held() -> tuple[Counter[str], int]:
    """Kinds of what is open in this process, and its threads."""
    links = []
    for number in os.listdir("/proc/self/fd"):
        try:
            links.append(os.readlink(f"/proc/self/fd/{number}").partition(":")[0])
        except FileNotFoundError:  # that of the listing itself
            continue
    return Counter(links), len(os.listdir("/proc/self/task"))


def nothing_more(before: tuple[Counter[str], int]) -> bool:
    files, threads = held()
    return not files - before[0] and threads <= before[1]


@pytest.fixture
def arm() -> Iterator[RtdeArm]:
    made = RtdeArm()
    yield made
    made.close()


@pytest.fixture
def pair(tmp_path: Path) -> str:
    """Two pictures of a stereo endoscope."""
    (tmp_path / "stereo.json").write_bytes(msgspec.json.encode(endoscope(320, 240, 260.0)))
    for side in ("left", "right"):
        Image.new("RGB", (320, 240)).save(tmp_path / f"{side}_0000.png")
    sides = ",".join(str(tmp_path / f"{side}_%04d.png") for side in ("left", "right"))
    return f"{sides}?calibration={tmp_path / 'stereo.json'}"


def opener(kind: str, spec: str) -> Callable[[], object]:
    parsed = SPECS[kind].parse(spec)
    given = {"source": (), "poses": (), "sink": (CONTEXT,), "tool": (CONTEXT, "probe")}[kind]
    return lambda: parsed.open(*given)


def again_and_again(once: Callable[[], None]) -> None:
    for _ in range(FIRST):
        once()
    before = held()
    for _ in range(TIMES):
        once()
    until(lambda: nothing_more(before), f"{before} again, not {held()}")
    assert threading.active_count() <= before[1]


@pytest.mark.parametrize(
    ("kind", "spec"),
    [
        ("source", "stereo:{pair}"),
        ("source", "ros2:/camera/depth/image_rect"),
        ("sink", "viewer:0"),
        ("sink", "openigtlink:0"),
        ("sink", "ros2:/tumortrack"),
        ("sink", "recording:{folder}/{number}"),
        ("tool", "ros2:tip?contact=/touch"),
        ("tool", "openigtlink:{port}"),
        ("tool", "openigtlink:127.0.0.1:1"),
        ("tool", "ur:{arm}"),
        ("poses", "ros2:base_link"),
        ("poses", "ur:{arm}"),
    ],
)
def test_what_opens_closes_whole(kind, spec, pair, arm, tmp_path):
    numbers = count()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    fixed = {"pair": pair, "folder": tmp_path, "arm": arm.host, "port": port}

    def once() -> None:
        words = {**fixed, "number": next(numbers)}
        opener(kind, spec.format(**words))().close()  # type: ignore[attr-defined]

    again_and_again(once)


@pytest.mark.parametrize(
    ("kind", "spec"),
    [
        ("source", "stereo:97,98?calibration={calibration}"),
        ("source", "realsense:nobody"),
        ("tool", "ur:127.0.0.1"),
        ("poses", "ur:127.0.0.1"),
    ],
)
def test_what_does_not_open_ends_in_the_same_error_each_time(kind, spec, pair):
    if spec.startswith("realsense"):
        needs.module("pyrealsense2", "make debian")
    said = []

    def once() -> None:
        with pytest.raises(TumortrackError) as error:
            opener(kind, spec.format(calibration=pair.partition("=")[2]))()
        said.append(str(error.value))

    again_and_again(once)
    assert len(set(said)) == 1
