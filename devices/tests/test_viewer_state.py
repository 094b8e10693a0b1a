"""What a screen shows is one state: number, verdict, background and surfaces of one frame."""

from __future__ import annotations

import threading
import time
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from browser import Browser, of_first_tumor
from clock import PATIENCE_S, until
from live_objects import small_setting, small_update
from tumortrack.core import colours
from tumortrack.core.estimate import Quality
from tumortrack.live.values import TrackingResult
from tumortrack_devices.sinks.viewer import ViewerSink, ViewerSinkConfig
from viewer_page import page

_SHOTS = 20


def _seen(number: int, aside_mm: float, quality: Quality) -> TrackingResult:
    """A result whose surfaces lie to one side."""
    update = small_update(number)
    assert update.estimate is not None
    meshes = {
        name: mesh.with_vertices(mesh.vertices_mm + [aside_mm, 0, 0])
        for name, mesh in update.estimate.meshes.items()
    }
    warning = "it fits badly" if quality == "poor" else ""
    estimate = replace(update.estimate, meshes=meshes)
    return replace(update, estimate=estimate, quality=quality, warning=warning)


def _hidden(number: int, why: str) -> TrackingResult:
    return replace(small_update(number), estimate=None, quality="none", reason=why)


# Each differs from its neighbours in every part of the screen; (surfaces, red background) beside.
STATES = (
    (_seen(1001, -20, "good"), ("left", False)),
    (_hidden(1002, "the organ is hidden"), ("none", True)),
    (_seen(1003, 6, "poor"), ("right", False)),
    (_seen(1004, -20, "poor"), ("left", False)),
    (_hidden(1005, "too few points"), ("none", True)),
    (_seen(1006, 6, "good"), ("right", False)),
)


def _parts(picture: np.ndarray) -> tuple[str, bool]:
    """Where the first tumor is drawn, and whether the page is framed in red."""
    columns = np.nonzero(of_first_tumor(picture[150:700, 20:400]))[1]
    side = "left" if len(columns) and columns.mean() < 240 else "right"
    red = np.abs(picture[400:500, 2:10].astype(int) - colours.NONE).max() < 12
    return side if len(columns) > 100 else "none", bool(red)


@pytest.mark.slow
def test_all_parts_of_the_screen_are_of_one_frame_under_load():
    """Screenshots of a page that gets six different states in turn, in a browser that is slowed
    down four times and beside a thread that takes half of Python's time."""
    sink = ViewerSinkConfig(port=0, hz=60).open(small_setting())
    ended = threading.Event()

    def burn() -> None:
        while not ended.is_set():
            sum(range(10_000))

    def feed() -> None:
        turn = 0
        while not ended.wait(0.12):
            sink.publish(STATES[turn % len(STATES)][0])
            turn += 1

    threads = [threading.Thread(target=work, daemon=True) for work in (burn, feed)]
    try:
        with Browser(780, 800) as browser:
            browser.open(f"http://127.0.0.1:{sink.port}")
            until(lambda: "WAITING" in browser.text(), "the page")
            numbers = [_number_of(browser, sink, *state) for state in STATES]
            browser.call("Emulation.setCPUThrottlingRate", rate=4)
            for thread in threads:
                thread.start()
            shots: list[np.ndarray] = []

            def seen() -> bool:
                shot = browser.picture()
                # A page that has waited too long, on a slow machine, is framed or covered.
                if np.abs(shot[400, 5].astype(int) - colours.STALE).max() > 2:
                    shots.append(shot)
                which = {_best(shot, numbers) for shot in shots}
                return len(shots) >= _SHOTS and len(which) >= 4

            until(seen, "four of the states", 5 * PATIENCE_S)
    finally:
        ended.set()
        for thread in threads:
            if thread.is_alive():
                thread.join()
        sink.close()
    for shot in shots:
        assert _parts(shot) == STATES[_best(shot, numbers)][1]


def test_a_change_arrives_whole_from_a_sender_that_is_held_up():
    """As when Python collects garbage in a large program."""
    sink = ViewerSinkConfig(port=0, hz=60).open(small_setting())
    surfaces, numbers = [], []
    with closing(sink), page(sink) as visitor:
        for turn in range(6):
            sink.server.get_event_loop().call_soon_threadsafe(time.sleep, 0.3)
            sink.publish(STATES[turn][0])
        while f"no. {STATES[5][0].sequence}" not in str(numbers[-1:]):
            messages = visitor.heard()
            surfaces.append(any(one.get("name") == "/estimate/kidney" for one in messages))
            numbers.append([one for one in messages if "tumortrack-stage" in str(one)])
    assert any(surfaces)
    assert all(said for shown, said in zip(surfaces, numbers, strict=True) if shown)


Place = tuple[slice, slice]


def _number_of(
    browser: Browser, sink: ViewerSink, state: TrackingResult, parts: tuple[str, bool]
) -> tuple[Place, np.ndarray]:
    """How the panel's box with the frame's number looks, and where it is."""
    seen: list[tuple[tuple[float, ...], np.ndarray]] = []

    ended = threading.Event()

    def feed() -> None:  # else, on a slow machine, the page tells of silence before it is seen
        while not ended.wait(0.1):
            sink.publish(state)

    def shown() -> bool:
        number = f"no. {state.sequence}"
        before = number in browser.text()
        seen.append((browser.box("#tumortrack-flag .tumortrack-box"), browser.picture()))
        return before and number in browser.text() and _parts(seen[-1][1]) == parts

    thread = threading.Thread(target=feed, daemon=True)
    thread.start()
    try:
        until(shown, f"state {state.sequence}")
    finally:
        ended.set()
        thread.join()
    left, top, width, height = map(round, seen[-1][0])
    place = slice(top, top + height), slice(left, left + width)
    return place, seen[-1][1][place]


def _best(shot: np.ndarray, numbers: list[tuple[Place, np.ndarray]]) -> int:
    """Which state's box the shot has."""
    apart = [np.abs(shot[place].astype(int) - box).mean() for place, box in numbers]
    assert min(apart) < 0.05, f"the panel's box looks like none of the states': {apart}"
    return int(np.argmin(apart))
