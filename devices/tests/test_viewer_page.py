"""The viewer's page in a real browser, and the documentation's pictures of it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from browser import Browser, of_first_tumor
from clock import until
from live_objects import empty_update, small_setting, small_update
from reports import bounded, reporting
from stories import COMMAND, environment, live_resection
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.live.values import PublishedFrame, SinkContext, TrackingResult
from tumortrack_devices.sinks.viewer import ViewerSink, ViewerSinkConfig
from workcell_objects import Arms, virtual, workcell

TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
ROBOT = PublishedFrame("robot", rigid(TURN, np.array([400.0, -250.0, 90.0])))


class Feed(threading.Thread):
    """Publishes the update that it is given, ten times a second; None: nothing."""

    def __init__(self, sink: ViewerSink, update: TrackingResult) -> None:
        super().__init__(daemon=True)
        self.sink, self.update = sink, update
        self.ended = threading.Event()
        self.start()

    def run(self) -> None:
        sequence = 0
        while not self.ended.wait(0.1):
            if self.update is not None:
                sequence += 1
                self.sink.publish(replace(self.update, sequence=sequence))

    def end(self) -> None:
        self.ended.set()
        self.join()


def tumor(browser: Browser) -> int:
    """Pixels of the first tumor, where no banner is."""
    return int(of_first_tumor(browser.picture()[150:, :400]).sum())


def kidneyish(picture: np.ndarray) -> int:
    r, g, b = picture[:, :400].astype(int).transpose(2, 0, 1)
    return int(((r > 1.2 * g) & (r < 2.6 * g) & (g > b) & (g > 20)).sum())


def arm(browser: Browser) -> int:
    """Pixels that look like the cutter's arm, which is green, where no banner is."""
    r, g, b = browser.picture()[150:420, :400].astype(int).transpose(2, 0, 1)
    return int(((g > 60) & (g > 1.4 * r) & (g > 1.4 * b)).sum())


@pytest.fixture
def patient(monkeypatch):
    """A feed that a loaded machine holds up for seconds isn't stale yet."""
    monkeypatch.setattr("tumortrack_devices.sinks.viewer._STALE_S", 5.0)


@pytest.mark.slow
def test_page_in_a_browser(patient):
    tools = "probe", "grasper"
    setting = replace(small_setting(), published_frame=ROBOT, controller=Arms(), tools=tools)
    sink = ViewerSinkConfig(port=0).open(setting)
    shown = small_update(frames=ROBOT)
    hidden = replace(empty_update(reason="only 12 points lie in range"), published_frame=ROBOT)
    with closing(sink), Browser(780, 480) as browser:
        feed = Feed(sink, shown)
        try:
            browser.open(sink.url)
            until(lambda: "GOOD" in browser.text(), "the page")
            until(lambda: tumor(browser) > 700, "a tumor")
            until(lambda: kidneyish(browser.picture()) > 5000)
            until(lambda: "STALE" not in browser.text())

            feed.update = replace(
                shown, estimate=None, quality="none", reason="the organ is hidden"
            )
            until(lambda: "the organ is hidden" in browser.text(), "the reason")
            until(lambda: "NONE" in browser.text())
            until(lambda: "GOOD" not in browser.text())
            until(lambda: kidneyish(browser.picture()) < 200, "hiding")
            until(lambda: tumor(browser) == 0)

            feed.update = hidden
            browser.open("about:blank")
            browser.open(sink.url)  # a second visit sees the present state
            until(lambda: "only 12 points" in browser.text(), "the page again")
            feed.update = replace(shown, quality="poor", warning="it fits only to 3 mm")
            until(lambda: "it fits only to 3 mm" in browser.text(), "the warning")
            until(lambda: tumor(browser) > 700, "the tumor again")

            check_click(browser, setting)
            check_keys(browser, setting)
            check_arms(browser, feed, shown, setting)

            feed.update = None  # type: ignore[assignment]
            until(lambda: "nothing has come for" in browser.text(), "STALE")
            until(lambda: tumor(browser) == 0, "hiding")
            until(lambda: arm(browser) < 300)
            until(lambda: "nothing is known of them" in browser.text())
            feed.update = shown
            until(lambda: "GOOD" in browser.text(), "recovery")
            until(lambda: arm(browser) < 300)
            until(lambda: "has been silent" not in browser.text())
        finally:
            feed.end()
        sink.close()  # the page, alone now, says so itself
        until(lambda: "has been silent" in browser.text(), "the page's own watch")


def check_arms(browser: Browser, feed: Feed, shown: TrackingResult, setting: SinkContext) -> None:
    """Arms are seen whole, with and without an estimate; what they do is said; they are stopped."""
    until(lambda: arm(browser) < 300)
    feed.update = replace(shown, control=workcell())
    until(lambda: "ARMS: sweep 1" in browser.text(), "the arms' state")
    browser.click_text("arms")
    until(lambda: arm(browser) > 1000, "an arm")
    feed.update = replace(virtual(), published_frame=ROBOT)
    until(lambda: "PLAYBACK" in browser.text(), "what is shown")
    until(lambda: "not a live estimate" in browser.text())
    assert "NONE" not in browser.text()
    until(lambda: arm(browser) > 1000)
    browser.click_text("organ")
    until(lambda: arm(browser) < 300, "the view from the camera")
    browser.click_text("arms")
    until(lambda: arm(browser) > 1000, "the view of all")
    feed.update = replace(shown, control=workcell(halted="the tumor has moved by 6 mm"))
    until(lambda: "the tumor has moved by 6 mm" in browser.text(), "the halt")
    until(lambda: "sweep 1: HALTED" in browser.text())
    browser.click_text("Stop the arms for good")
    until(setting.controls.aborted.is_set, "the arms' end")
    until(lambda: "The arms were stopped for good" in browser.text(), "being told so")


def check_click(browser: Browser, setting: SinkContext) -> None:
    """A click on the scene gives the seen point under it, in the published frame."""
    rect = browser.box("canvas")
    browser.click_text("Point at the organ")
    until(lambda: "Now click" in browser.text(), "being asked to click")
    column, row = 40, -25  # pixels from the middle of the view
    browser.click(rect[0] + rect[2] / 2 + column, rect[1] + rect[3] / 2 + row)
    until(lambda: setting.controls.picked_mm is not None, "the click")
    assert setting.controls.picked_mm is not None
    camera_from_published = np.linalg.inv(setting.published_frame.published_from_camera)
    (picked,) = transform_points(camera_from_published, setting.controls.picked_mm[None])
    focal = rect[3] / 2 / np.tan(0.45)  # the view starts where the camera is, 0.9 rad high
    assert picked[2] > 100
    assert picked[:2] == pytest.approx(np.array([column, row]) * picked[2] / focal, abs=3)
    until(lambda: "Forget" in browser.text(), "the way back")
    browser.click_text("Forget")
    until(lambda: setting.controls.picked_mm is None, "forgetting")


def check_keys(browser: Browser, setting: SinkContext) -> None:
    """A key does what its button does: once however long it is held, and not while typing."""

    def told(*tools: str) -> None:
        touched = setting.controls.touched
        until(lambda: [*touched] == [*tools], f"{tools}, not {touched}")

    browser.press("2", times=3)
    told("grasper")
    browser.press("1")
    told("grasper", "probe")
    browser.call("Runtime.evaluate", expression="document.querySelector('[type=text]').focus()")
    browser.press("2")
    browser.click_text("probe (key 1)")
    told("grasper", "probe", "probe")


LONGEST = (
    "tumor_1 may as well lie 14.3 mm away: the points fit there too; another patient's organ, or "
    "another frame: the camera's axes are x right, y down, z forward; look from another side, "
    "nearer, and give the distance with --range NEAR FAR "
) + "/a/folder/whose/name/has/no/room/to/break" * 3


@pytest.mark.slow
def test_banner_and_panel_leave_room_for_each_other_at_every_size(patient):
    """On a phone, a laptop and a large screen, with a reason longer than any. What lies below the
    numbers does not jump."""
    shown = small_update()
    touch = {"name": "touch", "off_mm": 0.1, "information_gain": 0.2, "rejected": False}
    sure = bounded(shown.estimate, tumor_1=1.9, tumor_2=1.9)
    states = {
        "GOOD": replace(shown, estimate=reporting(sure, evidence=[touch])),
        "POOR": replace(shown, quality="poor", warning=LONGEST),
        "NONE": replace(shown, estimate=None, quality="none", reason=LONGEST),
    }
    sink = ViewerSinkConfig(port=0).open(small_setting())
    with closing(sink), Browser(390, 844) as browser:
        feed = Feed(sink, shown)
        try:
            browser.open(sink.url)
            for width, height, panel in (
                (390, 844, 390), (1440, 900, 360), (2560, 1440, 540), (3840, 2160, 720),
            ):  # fmt: skip
                browser.resize(width, height)
                heights = set()
                for word, feed.update in states.items():
                    until(partial(says, browser, word, "tumor 1"), f"{word} at {width}")
                    check_room(browser, width, height, panel)
                    heights.add(round(browser.box("#tumortrack-numbers")[3]))
                assert len(heights) == 1
                until(partial(says, browser, LONGEST), "the reason")
        finally:
            feed.end()


def says(browser: Browser, *words: str) -> bool:
    text = browser.text()
    return all(word in text for word in words)


def check_room(browser: Browser, width: int, height: int, panel_width: int) -> None:
    left, top, wide, high = browser.box(".tumortrack-over > div")
    foot = top + high
    assert min(left, top, width - left - wide, height - foot) >= 0
    panel = ".mantine-Paper-root:has(#tumortrack-numbers)" if width < 576 else "#tumortrack-numbers"
    at, above, its_width, its_height = browser.box(panel)
    if width < 576:
        assert its_height <= height / 3
        assert foot <= above
        row = "#tumortrack-numbers tr:last-child"
        until(lambda: sum(browser.box(row)[1::2]) <= height, "the last part's row in sight")
    else:
        assert left + wide <= at
    assert at + its_width <= width
    assert its_width == pytest.approx(panel_width, rel=0.15)  # numbers have a border round them


GIVEN = ("PICTURES", "DEMO", "PLAN")
PICTURES, DEMO, PLAN = (os.environ.get(f"TUMORTRACK_{name}") for name in GIVEN)


@pytest.mark.skipif(not (PICTURES and DEMO and PLAN), reason="TUMORTRACK_PICTURES and more not set")
@pytest.mark.parametrize("of", ["tracking", "resection"])
def test_pictures_for_the_documentation(of, tmp_path):
    """TUMORTRACK_PICTURES: where pictures go; TUMORTRACK_DEMO: what ``tumortrack demo`` left;
    TUMORTRACK_PLAN: what ``tumortrack plan`` made of its phantom. The command itself, on a case in
    motion; then its process is stopped, as a hung machine would be."""
    demo, plan = (Path(str(one)).resolve() for one in (DEMO, PLAN))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    case, viewer = demo / "case", f"viewer:{port}"
    track = [*COMMAND, "track", case, f"virtual:{case}", f"{viewer}?case={case}"]
    command = track if of == "tracking" else live_resection(demo, plan, viewer)
    with subprocess.Popen([*map(str, command)], env=environment(), cwd=tmp_path) as process:
        try:
            with Browser(1280, 800) as browser:
                until(lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0, "the viewer")
                browser.open(f"http://127.0.0.1:{port}")
                if of == "resection":
                    until(lambda: "ARMS: sweep 2" in browser.text(), "the second sweep", 200)
                    browser.click_text("organ")
                    time.sleep(3)
                    save(browser, "viewer_resection.png")
                    return
                until(lambda: "GOOD" in browser.text(), "an estimate")
                time.sleep(8)
                until(lambda: save_good(browser, "viewer.png"), "a picture of a good estimate")
                process.send_signal(signal.SIGSTOP)
                time.sleep(4)
                save(browser, "viewer_stale.png")
        finally:
            process.kill()


def save_good(browser: Browser, name: str) -> bool:
    """Whether the estimate is good, before and after the picture: a busy machine answers late."""
    if good := "GOOD" in browser.text():
        save(browser, name)
    return good and "GOOD" in browser.text()


def save(browser: Browser, name: str) -> None:
    Image.fromarray(browser.picture()).save(Path(str(PICTURES)) / name, optimize=True)
