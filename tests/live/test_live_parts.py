"""The live loop's parts by themselves: text to configuration, times, stamps, threads, frames."""

from __future__ import annotations

import json
import threading
import time
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clock import PATIENCE_S, until
from live_objects import empty_update, small_frame, small_update
from tumortrack.core.errors import InputError, NoEstimate, StorageError
from tumortrack.core.report import Point
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.loop import check_age
from tumortrack.live.meter import Histogram
from tumortrack.live.spec import Registry
from tumortrack.live.values import Observation, PublishedFrame, SinkConfig, SourceEnded, SourceLost
from tumortrack.live.workers import SinkWorker, SourceWorker, StampOrder

SECOND = 1_000_000_000


class Camera(SinkConfig, frozen=True, kw_only=True, tag="camera"):
    target: ClassVar[str] = "topic"
    topic: str
    fps: float = 30.0
    noise: bool = True
    type: Literal["auto", "cloud"] = "auto"
    every: Annotated[int, msgspec.Meta(ge=1, le=9)] | None = None


class Needle(SinkConfig, frozen=True, kw_only=True, tag="needle"):
    tip: Point = (0.0, 0.0, 80.5)
    point: Point | None = None


class Window(SinkConfig, frozen=True, kw_only=True, tag="window"):
    target: ClassVar[str] = "port"
    port: int = 8080


class Plain(SinkConfig, frozen=True, kw_only=True, tag="plain"):
    pass


KINDS = Registry(
    "sink",
    "tumortrack.nothing",
    SinkConfig,
    {
        "camera": f"{__name__}:Camera",
        "window": f"{__name__}:Window",
        "plain": f"{__name__}:Plain",
        "needle": f"{__name__}:Needle",
    },
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("camera:/a/b", Camera(topic="/a/b")),
        (
            "camera:/a?fps=12.5&noise=false&type=cloud",
            Camera(topic="/a", fps=12.5, noise=False, type="cloud"),
        ),
        ("camera:C:/folder:with colons", Camera(topic="C:/folder:with colons")),
        ("window", Window()),
        ("window:9000", Window(port=9000)),
        ("camera:/a+b%20c", Camera(topic="/a+b%20c")),
        ("window?port=9000", Window(port=9000)),
        ("plain", Plain()),
        ("needle?tip=1,-2.5,3", Needle(tip=(1.0, -2.5, 3.0))),
        ("needle?point=1,2,3", Needle(point=(1.0, 2.0, 3.0))),
    ],
)
def test_text_becomes_configuration(text, expected):
    assert KINDS.parse(text) == expected


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("screen", "Allowed: camera, needle, plain, window"),
        ("needle?tip=1,2", "tip is '1,2'; allowed: X,Y,Z. Write needle[?tip=0,0,80.5&point=]."),
        ("camera", "lacks its topic. Write camera:TOPIC[?fps=30.0&noise=true&type=auto&every=]."),
        ("camera:/a?rate=3", "'rate' is no option. Write camera:TOPIC"),
        ("camera:/a?fps=fast", "': fps is 'fast'; allowed: a number. Write camera:TOPIC"),
        ("camera:/a?noise=2", "': noise is '2'; allowed: true or false. Write"),
        ("camera:/a?type=mesh", "': type is 'mesh'; allowed: auto, cloud. Write"),
        ("camera:/a?every=0", "': every is '0'; allowed: a whole number from 1 to 9, null. Write"),
        ("camera:/a?every=abc", "': every is 'abc'; allowed: a whole number from 1 to 9, null."),
        ("camera:/a?topic=/b", "'/a' has no place there"),
        ("camera:/a?fps=1&fps=2", "'fps' is given twice"),
        ("window:http", "Write window[:port]"),
        ("plain:x", "'x' has no place there"),
    ],
)
def test_wrong_text_is_answered_with_what_there_is(text, said):
    with pytest.raises(InputError) as error:
        KINDS.parse(text)
    assert said in str(error.value)
    assert text in str(error.value)


def test_percentiles_are_right_to_one_per_cent():
    times = np.random.default_rng(0).lognormal(3, 1, 20_000)
    histogram = Histogram()
    for one in times:
        histogram.add(float(one))
    for share in (50.0, 95.0, 99.0, 99.9):
        assert histogram.percentile(share) == pytest.approx(np.percentile(times, share), rel=0.012)
    assert histogram.summary()["max"] == pytest.approx(times.max(), abs=1e-3)
    assert len(histogram) == 20_000
    assert Histogram().summary() == {"count": 0}


def _seen(stamp_ns, arrived_ns=None):
    return Observation(small_frame(stamp_ns), stamp_ns if arrived_ns is None else arrived_ns)


def test_a_stale_frame_and_one_from_the_future_are_refused():
    with pytest.raises(NoEstimate, match=r"stale: 0\.60 s old, if the clocks of camera"):
        check_age(0.6, 0.5)
    with pytest.raises(NoEstimate, match=r"stale: 0\.60 s old$"):
        check_age(0.6, 0.5, other_clock=False)
    with pytest.raises(NoEstimate, match=r"2\.00 s in the future"):
        check_age(-2.0, 0.5)
    check_age(0.4, 0.5)


def test_a_clock_that_was_set_back_is_believed_when_it_goes_on():
    order = StampOrder()
    for stamp in (100, 101, 102):
        order.check(stamp * SECOND)
    with pytest.raises(NoEstimate, match=r"went back by 92\.000 s"):
        order.check(10 * SECOND)
    order.check(103 * SECOND)  # one stray: the old clock goes on
    for stamp in (20, 21):
        with pytest.raises(NoEstimate, match="went back"):
            order.check(stamp * SECOND)
    order.check(22 * SECOND)
    order.check(23 * SECOND)
    with pytest.raises(NoEstimate, match="went back"):
        order.check(23 * SECOND)  # the same frame again
    with pytest.raises(NoEstimate, match="must be 0 or more"):
        order.check(-5)


@pytest.mark.parametrize(
    ("waits", "host_clock", "counts_from"),
    [(False, True, "stamp"), (False, False, "arrival"), (True, False, "taking")],
)
def test_ages_count_from_where_the_source_allows(waits, host_clock, counts_from):
    script = Script([_seen(7, arrived_ns=9)], waits=waits)
    script.host_clock = host_clock
    reader = SourceWorker(lambda: script)
    begin_ns = time.time_ns()
    born_ns = reader.born_ns(reader.take(PATIENCE_S))
    assert reader.latency_from == counts_from
    if waits:
        assert begin_ns <= born_ns <= time.time_ns()
    else:
        assert born_ns == (7 if host_clock else 9)
    reader.close()


class Script:
    """A source that does what it is told: gives items, raises errors, waits at the end."""

    host_clock = on_demand = False
    dropped = 0

    def __init__(self, items, waits=False):
        self._items, self.lossless, self.closed = list(items), waits, 0
        self.over = threading.Event()  # all was read, and handed on

    def read(self, timeout_s):
        if not self._items:
            self.over.set()
            time.sleep(timeout_s)
            return None
        item = self._items.pop(0)
        if isinstance(item, BaseException):
            raise item
        return item

    def close(self):
        self.closed += 1


def test_the_newest_frame_wins_and_the_others_are_counted():
    frames = [_seen(n) for n in range(1, 6)]
    reader = SourceWorker(lambda: Script(frames))
    until(lambda: reader.dropped == 4)
    assert reader.take(PATIENCE_S).stamp_ns == 5
    assert reader.take(0.05) is None
    reader.close()


def test_exchanged_frames_are_noticed_by_a_loop_that_is_too_busy_to_see_both():
    script = Script([_seen(n) for n in (2, 1, 4, 3)])
    reader = SourceWorker(lambda: script)
    assert script.over.wait(PATIENCE_S)
    assert reader.dropped == 1  # 2, for 4
    assert "went back" in str(reader.take(PATIENCE_S))
    assert reader.take(PATIENCE_S).stamp_ns == 4  # not 3, which came last
    assert reader.take(0.05) is None
    reader.close()


def test_a_source_that_waits_loses_nothing():
    frames = [_seen(n) for n in range(1, 6)]
    reader = SourceWorker(lambda: Script([*frames, SourceEnded("end")], waits=True))
    taken = [reader.take(PATIENCE_S).stamp_ns for _ in frames]
    assert taken == [1, 2, 3, 4, 5]
    assert reader.take(PATIENCE_S) is None
    assert reader.ended
    assert reader.dropped == 0
    reader.close()


def test_a_source_has_not_ended_while_its_last_frame_waits():
    reader = SourceWorker(lambda: Script([_seen(1), SourceEnded("end")], waits=True))
    reader._thread.join()
    assert not reader.ended
    assert reader.take(PATIENCE_S).stamp_ns == 1
    assert reader.ended
    reader.close()


def test_a_lost_source_is_opened_again():
    scripts = [Script([_seen(1), SourceLost("unplugged")], waits=True), Script([_seen(2)])]
    opened = []

    def open_next():
        if len(opened) == 1:
            opened.append("missing")
            raise SourceLost("still unplugged")
        opened.append("there")
        return scripts.pop(0)

    first = scripts[0]
    reader = SourceWorker(open_next)
    assert reader.take(PATIENCE_S).stamp_ns == 1
    until(lambda: "unplugged" in reader.trouble)
    assert first.closed == 1
    assert reader.take(PATIENCE_S).stamp_ns == 2
    assert reader.trouble == ""
    assert reader.opened == 2
    reader.close()


def test_a_source_that_can_never_work_ends_the_loop():
    def refuse():
        raise InputError("no such folder")

    reader = SourceWorker(refuse)
    until(lambda: reader.failure is not None)
    with pytest.raises(InputError, match="no such folder"):
        reader.take(PATIENCE_S)
    reader.close()


def test_what_breaks_at_reopening_is_no_end():
    """A camera that is plugged in again fails in ways of its own while it comes up."""
    opened = []

    def open_next():
        opened.append(len(opened))
        if len(opened) == 2:
            raise RuntimeError("failed to set power state")
        if len(opened) == 3:
            raise InputError("no 848x480@30 at USB 2")
        return Script([_seen(len(opened)), SourceLost("unplugged")], waits=True)

    reader = SourceWorker(open_next)
    assert reader.take(PATIENCE_S).stamp_ns == 1
    assert reader.take(PATIENCE_S).stamp_ns == 4
    assert reader.failure is None
    assert len(reader.defects) == 1
    assert "power state" in reader.defects[0]
    reader.close()


def test_garbage_is_handed_on_and_reading_goes_on():
    reader = SourceWorker(
        lambda: Script([InputError("a message of no image"), _seen(3)], waits=True)
    )
    assert "no image" in str(reader.take(PATIENCE_S))
    assert reader.take(PATIENCE_S).stamp_ns == 3
    reader.close()


class Notes:
    """A sink that remembers, and can be slow or broken."""

    def __init__(self, gate=None, broken=False):
        self.got, self.closed, self.gate, self.broken = [], False, gate, broken

    def publish(self, update):
        if self.gate is not None:
            self.gate.wait(PATIENCE_S)
        if self.broken:
            raise StorageError("the disk is full")
        self.got.append(update.sequence)

    def close(self):
        self.closed = True


def test_a_slow_sink_gets_the_newest_and_holds_up_nobody(monkeypatch):
    monkeypatch.setattr("tumortrack.live.workers._SILENT_S", PATIENCE_S)  # however slow we are
    gate = threading.Event()
    sink = Notes(gate)
    outlet = SinkWorker("slow", sink, waiting=1)
    for n in range(50):
        outlet.put(small_update(n))
    assert not sink.got  # it has not even taken the first
    gate.set()
    outlet.close()
    assert sink.closed
    assert sink.got[-1] == 49
    assert outlet.dropped == 50 - len(sink.got)
    assert outlet.summary()["latency_ms"]["count"] == len(sink.got)


def test_a_sink_that_may_be_behind_loses_nothing():
    sink = Notes()
    outlet = SinkWorker("recording", sink, waiting=64)
    for n in range(64):
        outlet.put(small_update(n))
    outlet.close()
    assert sink.got == list(range(64))


def test_a_sink_that_shows_is_told_when_the_loop_hangs(monkeypatch):
    monkeypatch.setattr("tumortrack.live.workers._SILENT_S", 0.2)

    class Shown(Notes):
        def publish(self, update):
            self.got.append(update)

    shown, kept = Shown(), Shown()
    outlets = [SinkWorker("viewer", shown, 1), SinkWorker("recording", kept, 30)]
    for outlet in outlets:
        outlet.put(small_update(7))
    until(lambda: len(shown.got) == 2)
    time.sleep(0.5)
    for outlet in outlets:
        outlet.close()
    assert [u.estimate is not None for u in shown.got] == [True, False]  # and once only
    assert "said nothing" in shown.got[1].reason
    assert [u.sequence for u in kept.got] == [7]  # what was said, and no more


def test_a_sink_that_fails_at_its_end_is_known():
    class Cut(Notes):
        def close(self):
            raise StorageError("no index")

    outlet = SinkWorker("recording", Cut(), 5)
    outlet.close()
    assert outlet.unclosed
    assert outlet.error == "no index"


def test_a_broken_sink_is_said_and_recovers():
    sink = Notes(broken=True)
    outlet = SinkWorker("disk", sink, waiting=8)
    outlet.put(empty_update())
    until(lambda: outlet.failing)
    assert outlet.error == "the disk is full"
    sink.broken = False
    outlet.put(empty_update(5))
    until(lambda: not outlet.failing)
    outlet.close()
    assert (outlet.errors, outlet.delivered) == (1, 1)
    assert outlet.summary()["last_error"] == "the disk is full"


def _write(path, **content):
    path.write_text(json.dumps(content))
    return path


def test_the_robots_frame_follows_from_any_of_three_files(tmp_path):
    robot_from_camera = np.eye(4)
    robot_from_camera[:3, :3] = Rotation.from_euler("xyz", [20, -35, 70], degrees=True).as_matrix()
    robot_from_camera[:3, 3] = [410.0, -55.0, 620.0]
    camera_from_marker = np.eye(4)
    camera_from_marker[:3, :3] = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    camera_from_marker[:3, 3] = [10, 20, 300]
    metres = robot_from_camera.copy()
    metres[:3, 3] /= 1000
    files = [
        {"unit": "mm", "camera_from_robot": np.linalg.inv(robot_from_camera).tolist()},
        {"unit": "m", "robot_from_camera": metres.tolist()},
        {
            "unit": "mm",
            "camera_from_marker": camera_from_marker.tolist(),
            "robot_from_marker": (robot_from_camera @ camera_from_marker).tolist(),
        },
    ]
    for n, content in enumerate(files):
        # A matrix inverse leaves 1e-17 in the last row; files have it exact.
        for rows in content.values():
            if isinstance(rows, list):
                rows[3] = [0, 0, 0, 1]
        frames = read_frames(_write(tmp_path / f"{n}.json", frame_id="base_link", **content))
        assert frames.frame_id == "base_link"
        np.testing.assert_allclose(frames.published_from_camera, robot_from_camera, atol=1e-9)


def test_estimates_are_published_in_the_robots_frame():
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    turn[:3, 3] = [1, 2, 3]
    update = small_update(frames=PublishedFrame("base_link", turn))
    camera = update.estimate.cloud.points_mm
    expected = np.stack([camera[:, 2] + 1, camera[:, 1] + 2, -camera[:, 0] + 3], 1)
    np.testing.assert_allclose(update.transformed.points_mm, expected, atol=1e-4)
    mesh, moved = update.estimate.meshes["tumor_1"], update.transformed.meshes["tumor_1"]
    assert moved.volume_mm3 == pytest.approx(mesh.volume_mm3)
    assert moved.vertices_mm[0, 0] == pytest.approx(mesh.vertices_mm[0, 2] + 1)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"unit": "mm"}, "camera_from_robot"),
        ({"unit": "inch", "camera_from_robot": np.eye(4).tolist()}, "unit"),
        ({"unit": "mm", "camera_from_robot": np.diag([1, 1, -1, 1.0]).tolist()}, "right-handed"),
        ({"unit": "mm", "camera_from_robot": (2 * np.eye(4)).tolist()}, "orthonormal"),
        ({"unit": "mm", "camera_from_robot": np.eye(4)[:3].tolist()}, "3 rows"),
        ({"unit": "mm", "camera_from_robot": np.eye(4).T[::-1].tolist()}, "no rigid transform"),
        ({"unit": "mm", "camera_from_marker": np.eye(4).tolist()}, "it has camera_from_marker"),
        ({"unit": "mm", "camera_from_base": np.eye(4).tolist()}, "camera_from_base"),
    ],
)
def test_a_wrong_calibration_is_refused(tmp_path, content, said):
    with pytest.raises(InputError, match=said):
        read_frames(_write(tmp_path / "hand_eye.json", frame_id="base_link", **content))
