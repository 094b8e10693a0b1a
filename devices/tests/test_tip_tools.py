"""Tools with a tip: contacts, what is held, shafts, errors; from a table, an arm, a network."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import needs
from clock import PATIENCE_S, Clock, until
from live_objects import STAMP_NS, small_anatomy, small_estimate, small_frame, small_setting
from refused import refused
from rtde_arm import RtdeArm
from tumortrack.core.assessment import NOT_JUDGED
from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Cut, FreeSpace, Grasp, Landmark, Outline, Touch
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.io.csv_tables import COLUMNS, CONTACT
from tumortrack.live.poses import pose_row
from tumortrack.live.tools import Tools
from tumortrack.live.values import CameraView, Observation, PublishedFrame
from tumortrack_devices.igtl import message as igtl
from tumortrack_devices.igtl.message import Message, pack
from tumortrack_devices.tools.file import FileToolConfig
from tumortrack_devices.tools.openigtlink import OpenIgtLinkToolConfig
from tumortrack_devices.tools.ur import UrToolConfig

MS = 1_000_000
PEERS = Path(__file__).parent / "support"
BASE_FROM_CAMERA = rigid(np.diag([1.0, -1, -1]), np.array([400.0, 0, 500]))
BASE = PublishedFrame("base", BASE_FROM_CAMERA, calibrated=True)


def setting(published=BASE):
    return replace(small_setting(), anatomy_ct=small_anatomy(), published_frame=published)


def view(stamp_ns, published_from_camera=BASE_FROM_CAMERA):
    seen = Observation(small_frame(stamp_ns), stamp_ns)
    return CameraView(1, seen, published_from_camera)


def facing(camera_mm, turn=None):
    """Base from a tool whose origin is at this place before the camera."""
    place = transform_points(BASE_FROM_CAMERA, np.array([camera_mm], float))[0]
    return rigid(np.eye(3) if turn is None else turn, place)


def table(path, poses, contacts, step_ms=10):
    rows = [
        f"{pose_row(STAMP_NS + n * step_ms * MS, 'base', pose).strip()},{int(contact)}"
        for n, (pose, contact) in enumerate(zip(poses, contacts, strict=True))
    ]
    path.write_text("\n".join([COLUMNS + CONTACT, *rows]) + "\n")
    return path


def still(camera_mm, contacts, path, **options):
    """A tool that stands there, with a state of contact every 10 ms."""
    file = table(path / "tool.csv", [facing(camera_mm)] * len(contacts), contacts)
    return FileToolConfig(path=file, **options).open(setting(), "probe")


def frames(tool, times_ms, estimate=None):
    """What it gives in frames at these times; where the organ is found, it is told so."""
    given = []
    for time_ms in times_ms:
        now = view(STAMP_NS + time_ms * MS)
        given.append(list(tool.evidence(now)))
        if estimate is not None:
            tool.located(now, estimate)
    return given


@pytest.mark.parametrize(
    ("contacts", "touches"),
    [
        ("0" * 60, 0),
        ("0" * 5 + "1" * 20 + "0" * 35, 1),
        ("0" * 5 + "1" * 3 + "0" * 52, 1),  # shorter than what the mean is taken over
        ("0" * 5 + "1" * 5 + "00" + "1" * 10 + "0" * 38, 1),  # it bounces
        ("0" * 5 + "1" * 5 + "0" * 20 + "1" * 10 + "0" * 20, 2),
        ("1" * 60, 1),
    ],
)
def test_a_contact_is_one_touch(contacts, touches, tmp_path):
    tool = still((3, 4, 120), [c == "1" for c in contacts], tmp_path, tip_mm=1.5, part="tumor_1")
    given = [
        piece for frame in frames(tool, range(0, 600, 33), small_estimate()) for piece in frame
    ]
    assert len(given) == tool.counts["touch"] == touches
    for piece in given:
        assert isinstance(piece, Touch)
        assert (piece.part, piece.tip_mm, piece.tool, piece.std_mm) == ("tumor_1", 1.5, "probe", 1)
        np.testing.assert_allclose(piece.place_mm, (3, 4, 120), atol=1e-6)
        assert contacts[(piece.stamp_ns - STAMP_NS) // (10 * MS)] == "1"


def test_a_touch_is_the_mean_of_its_first_tenth_of_a_second(tmp_path):
    poses = [facing((0.1 * n, 0, 120)) for n in range(40)]  # 10 mm/s
    path = table(tmp_path / "t.csv", poses, [10 <= n < 35 for n in range(40)])
    tool = FileToolConfig(path=path).open(setting(), "probe")
    assert frames(tool, [150]) == [[]]  # not yet known
    ((touch,),) = frames(tool, [240])
    np.testing.assert_allclose(touch.place_mm, (1.5, 0, 120), atol=1e-6)  # from 1 to 2 mm
    assert touch.stamp_ns == STAMP_NS + 100 * MS


def test_a_touch_waits_for_the_organ_but_not_for_long(tmp_path):
    tool = still((0, 0, 120), [n < 20 for n in range(150)], tmp_path)
    first, second = frames(tool, [300, 340])  # the organ is not found: it is given again
    assert first == second != []
    assert frames(tool, [1200]) == [[]]
    assert tool.counts == {"touch": 1, "dropped": 1}


def test_a_sweep_touches_every_three_millimetres(tmp_path):
    poses = [facing((0.5 * n, 0, 120)) for n in range(60)]  # 50 mm/s
    path = table(tmp_path / "t.csv", poses, [True] * 60)
    tool = FileToolConfig(path=path, sweep=True).open(setting(), "probe")
    given = [p for frame in frames(tool, range(0, 600, 33), small_estimate()) for p in frame]
    xs = np.array([piece.place_mm[0] for piece in given])
    assert xs[0] == pytest.approx(2.5)  # the mean over 5 mm
    # A pose every 20 ms, 1 mm: the first ones at least 3 mm on.
    np.testing.assert_allclose(np.diff(xs)[1:], 3.0, atol=1e-6)
    assert xs[-1] > 24


def test_the_tip_and_the_shaft_follow_the_tools_axes(tmp_path):
    turn = Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix()  # z of the tool along x of the base
    path = table(tmp_path / "t.csv", [facing((0, 0, 120), turn)] * 30, [True] * 30)
    options = {"tip": (0.0, 0.0, 80.0), "shaft_mm": 20.0, "tip_mm": 4.0}
    tool = FileToolConfig(path=path, **options).open(setting(), "probe")
    free, touch = sorted(frames(tool, [200])[0], key=lambda piece: piece.name)
    np.testing.assert_allclose(touch.place_mm, (80, 0, 120), atol=1e-6)
    assert isinstance(free, FreeSpace)
    assert free.tip_mm == 4
    np.testing.assert_allclose(free.places_mm, [(x, 0, 120) for x in (75, 70, 65, 60)], atol=1e-6)
    bare = FileToolConfig(path=path, shaft_mm=10.0).open(setting(), "probe")
    free = frames(bare, [50])[0][0]  # from an origin that is the tip: along -z
    np.testing.assert_allclose(free.places_mm, [(-5, 0, 120), (-10, 0, 120)], atol=1e-6)


def test_a_tools_pieces_share_the_calibrations_error(tmp_path):
    path = table(tmp_path / "t.csv", [facing((0, 0, 150))] * 30, [True] * 30)
    published = replace(BASE, error_mm=2.0, error_deg=0.5)
    tool = FileToolConfig(path=path, std_mm=0.5).open(setting(published), "probe")
    ((touch,),) = frames(tool, [200])
    expected = 2.0 + 150 * np.radians(0.5)
    assert (touch.std_mm, touch.tool) == (0.5, "probe")
    assert touch.shared_std_mm == pytest.approx(expected, abs=1e-6)
    assert expected > 3.3


class Shifted:
    """A motion: the CT lies 100 mm nearer than the organ, and 2 mm are not known."""

    def __init__(self, shift_mm):
        self.shift_mm = np.array(shift_mm, float)

    def forward(self, points):
        return points + self.shift_mm

    def inverse(self, points):
        return points - self.shift_mm

    def std_mm(self, points):
        return np.full(len(points), 2.0)

    largest_std_mm = covariance_mm2 = std_mm


def found(shift_mm, finding=None):
    return replace(small_estimate(), motion=Shifted(shift_mm)).assessed(finding=finding)


def test_what_is_held_is_the_point_of_the_ct_that_was_taken_until_it_is_let_go(tmp_path):
    poses = [facing((0.2 * n, 0, 106)) for n in range(80)]  # it pulls with 20 mm/s
    path = table(tmp_path / "t.csv", poses, [10 <= n < 50 for n in range(80)])
    published = replace(BASE, error_mm=2.0, error_deg=0.5)
    tool = FileToolConfig(path=path, holds=True).open(setting(published), "grasper")
    times = range(0, 700, 40)
    given = dict(zip(times, frames(tool, times, found((0, 0, 100))), strict=True))
    # In the frame at 120 ms it was told what it has; from the next one on it says so.
    assert [time for time, pieces in given.items() if pieces] == list(range(160, 500, 40))
    for time_ms, (held,) in ((t, p) for t, p in given.items() if p):
        assert isinstance(held, Grasp)
        np.testing.assert_allclose(held.point_ct, (0.2 * 12, 0, 6), atol=1e-6)
        np.testing.assert_allclose(held.place_mm, (0.02 * time_ms, 0, 106), atol=1e-6)
        assert (held.point_std_mm, held.std_mm, held.tool) == (2, 1, "grasper")
        assert held.shared_std_mm == 0  # the point was taken through the same calibration


def test_what_is_held_is_not_taken_from_a_doubtful_estimate(tmp_path):
    tool = still((0, 0, 106), [True] * 60, tmp_path, holds=True)
    assert not any(frames(tool, range(0, 300, 40), found((0, 0, 0), NOT_JUDGED)))
    assert any(frames(tool, range(300, 500, 40), found((0, 0, 0))))


def test_jaws_that_close_on_nothing_hold_nothing(tmp_path):
    tool = still((0, 0, 90), [True] * 60, tmp_path, holds=True)
    assert not any(frames(tool, range(0, 300, 40), found((0, 0, 0))))
    assert "1 cm" in tool.trouble


def test_a_landmark_is_touched_and_a_click_is_a_touch(tmp_path):
    point = (1.0, 2.0, 3.0)
    tool = still((0, 0, 120), [False] * 60, tmp_path, point=point)
    assert frames(tool, [40], small_estimate()) == [[]]
    tool.touched()
    ((landmark,),) = frames(tool, [80], small_estimate())
    assert isinstance(landmark, Landmark)
    assert landmark.point_ct == point
    np.testing.assert_allclose(landmark.place_mm, (0, 0, 120), atol=1e-6)
    assert frames(tool, [120], small_estimate()) == [[]]
    holder = still((0, 0, 106), [False] * 60, tmp_path, holds=True)
    holder.touched()
    given = frames(holder, [40, 80, 120], found((0, 0, 0)))
    assert [len(pieces) for pieces in given] == [0, 1, 1]
    holder.touched()
    assert frames(holder, [160], found((0, 0, 0))) == [[]]


def hook(path, length_mm=12.0, contacts=None, count=60, **options):
    """Its electrode lies along -z from its tip, and moves along x by 1 mm in 10 ms."""
    poses = [facing((n, 0, 120), np.diag([1.0, -1, -1])) for n in range(count)]
    contacts = [10 <= n < 40 for n in range(count)] if contacts is None else contacts
    file = table(path / "hook.csv", poses, contacts)
    return FileToolConfig(path=file, electrode_mm=length_mm, **options).open(setting(), "hook")


def test_what_the_whole_electrode_sweeps_while_it_is_energised_is_cut(tmp_path):
    tool = hook(tmp_path, kerf_mm=2.0)
    frames_ms = range(0, 600, 33)
    given = frames(tool, frames_ms)  # whether or not the organ is found
    pieces = [piece for frame in given for piece in frame]
    assert {type(piece) for piece in pieces} == {Cut}
    assert len(pieces) == tool.counts["cut"]
    assert {(piece.kerf_mm, piece.tool) for piece in pieces} == {(2.0, "hook")}
    for now_ms, frame in zip(frames_ms, given, strict=True):
        for piece in frame:
            assert 0 <= STAMP_NS + now_ms * MS - piece.stamp_ns < 33 * MS + 20 * MS
    places = np.concatenate([piece.places_mm for piece in pieces])
    # A rectangle, from when it was energised to when no more, but for one step of time.
    sheet = np.stack(np.meshgrid(np.arange(10, 38.5, 0.5), np.arange(0, 12.5, 0.5)), -1)
    sheet = np.insert(sheet.reshape(-1, 2), 1, 0.0, axis=1) * [1, 1, -1] + [0, 0, 120]
    near_mm = np.linalg.norm(sheet[:, None] - places, axis=2).min(1)
    assert near_mm.max() <= 1.5 / 2**0.5 + 1e-6
    low, high = places.min(0), places.max(0)
    np.testing.assert_allclose([low[0], *low[1:], *high[1:]], [10, 0, 108, 0, 120], atol=1e-6)
    assert high[0] <= 40


def test_what_was_cut_while_no_camera_saw_the_organ_is_told_when_it_was(tmp_path):
    tool = hook(tmp_path, contacts=[True] * 300, count=300)
    pieces = frames(tool, [2900])[0]
    stamps_ms = [(piece.stamp_ns - STAMP_NS) / MS for piece in pieces]
    assert all(0 < b - a <= 520 for a, b in pairwise(stamps_ms))
    assert stamps_ms[0] <= 520
    assert stamps_ms[-1] > 2870
    for piece, until_ms in zip(pieces, stamps_ms, strict=True):
        assert max(x for x, _, _ in piece.places_mm) == pytest.approx(until_ms / 10)


def test_an_electrode_that_is_energised_nobody_knows_where_tells_it(tmp_path):
    tool = hook(tmp_path, contacts=[True] * 60)
    assert frames(tool, [500])[0]
    assert not tool.context.controls.cut.is_set()
    frames(tool, [660])  # the last pose is of 590 ms
    assert not tool.context.controls.cut.is_set()
    assert frames(tool, [800]) == [[]]
    assert tool.context.controls.cut.is_set()
    off = hook(tmp_path, contacts=[False] * 60)
    frames(off, [500, 800])
    assert not off.context.controls.cut.is_set()


def test_a_cutter_by_hand_and_its_shaft(tmp_path):
    """Where it cuts there may be tissue."""
    tool = hook(tmp_path, contacts=[False] * 60, shaft_mm=30.0)
    ((free,),) = frames(tool, [100])
    np.testing.assert_allclose([z for _, _, z in free.places_mm], [103, 98, 93], atol=1e-6)
    tool.touched()
    assert {piece.name for piece in frames(tool, [140, 180])[1]} == {"cut", "free_space"}
    tool.touched()
    frames(tool, [220])
    assert [piece.name for piece in frames(tool, [300])[0]] == ["free_space"]


@pytest.mark.parametrize("other", [{"holds": True}, {"sweep": True}, {"shaft_mm": 12.0}])
def test_a_cutter_is_nothing_else(other, tmp_path):
    with refused(InputError):
        FileToolConfig(path=tmp_path, electrode_mm=12.0, **other)
    with refused(InputError):
        UrToolConfig(host="arm", electrode_mm=12.0)  # what it feels says nothing of current


def test_of_a_moving_camera_the_pose_in_that_frame_counts(tmp_path):
    tool = still((3, 4, 120), [True] * 30, tmp_path)
    moved = BASE_FROM_CAMERA @ rigid(np.eye(3), np.array([10.0, 0, 0]))
    (touch,) = tool.evidence(view(STAMP_NS + 200 * MS, moved))
    np.testing.assert_allclose(touch.place_mm, (-7, 4, 120), atol=1e-6)


def test_a_tool_whose_poses_end_gives_nothing_and_says_so_once(tmp_path):
    path = table(tmp_path / "t.csv", [facing((0, 0, 120))] * 10, [True] * 10)
    notes = []
    configs = {"probe": FileToolConfig(path=path, shaft_mm=20.0)}
    tools = Tools(configs, setting(), notes)
    assert len(tools.evidence(view(STAMP_NS + 100 * MS))) == 2  # the pose 10 ms before
    for time_ms in (200, 300, 400):
        assert [
            p for p in tools.evidence(view(STAMP_NS + time_ms * MS)) if p.name == "free_space"
        ] == []
    assert len(notes) == 1
    assert tools.summary() == {
        "probe": {"touch": 1, "free_space": 1, "trouble": [notes[0].removeprefix("tool probe: ")]}
    }


@pytest.mark.parametrize(
    ("options", "published", "named"),
    [
        ({"tip_mm": 99.0}, BASE, ["tip_mm", 99]),
        ({"shaft_mm": 2.0}, BASE, ["shaft_mm", 2]),
        ({"holds": True, "sweep": True}, BASE, ["holds, sweep"]),
        ({"part": "spleen"}, BASE, ["spleen", "kidney, tumor_1"]),
        ({}, PublishedFrame(), ["'base'", "'camera'", "frame=FILE"]),
    ],
)
def test_what_cannot_be_is_refused(options, published, named, tmp_path):
    path = table(tmp_path / "t.csv", [facing((0, 0, 120))] * 3, [False] * 3)
    with refused(InputError, *named):
        FileToolConfig(path=path, **options).open(setting(published), "probe")


def test_a_table_without_contacts_serves_for_a_shaft_alone(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(f"{COLUMNS}\n{pose_row(STAMP_NS, 'base', facing((0, 0, 120)))}")
    with refused(InputError, path):
        FileToolConfig(path=path).open(setting(), "probe")
    tool = FileToolConfig(path=path, shaft_mm=10.0).open(setting(), "probe")
    assert [piece.name for piece in tool.evidence(view(STAMP_NS))] == ["free_space"]


# OpenIGTLink


def sent(sock, kind, device, content, **metadata):
    sock.sendall(pack(Message(kind, device, time.time_ns(), content, metadata)))


def string(text):
    return b"\0\3" + len(text).to_bytes(2, "big") + text.encode()


@pytest.fixture
def tracker():
    """A server as PlusServer is one, for one client; ``link()`` takes it in."""
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(PATIENCE_S)
    opened = [server]

    def link():
        sock, _ = server.accept()
        opened.append(sock)
        return sock

    yield server.getsockname()[1], link
    for one in reversed(opened):
        one.close()


def test_a_tracked_pointer_touches_over_openigtlink():
    """A server of pyigtl's, of whose tool's name 20 characters travel."""
    name = "StylusToReferenceOfTheTable"
    pose = facing((5, 6, 130))
    with subprocess.Popen(
        [sys.executable, PEERS / "igtl_peer.py", name, json.dumps(pose.tolist())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as server:
        port = int(server.stdout.readline())

        options = {"name": name, "tip": (0.0, 0.0, 10.0), "tip_mm": 1.0}
        config = OpenIgtLinkToolConfig(address=f"127.0.0.1:{port}", **options)
        tool, begin_ns = config.open(setting(), "pointer"), time.time_ns()
        try:
            until(lambda: tool.link.receivers)

            def touched():  # again, where a busy machine lost poses for over a tenth of a second
                server.stdin.write("touch\n")
                server.stdin.flush()
                server.stdout.readline()
                now = view(time.time_ns())
                pieces = tool.evidence(now)
                tool.located(now, small_estimate())
                return pieces

            touch = until(touched, "evidence")[0]
            assert isinstance(touch, Touch)
            # The base's z points towards the camera.
            np.testing.assert_allclose(touch.place_mm, (5, 6, 120), atol=1e-3)
            assert begin_ns < touch.stamp_ns < time.time_ns()
        finally:
            tool.close()
            server.kill()


def test_damaged_messages_are_named_and_the_next_ones_are_heard(tracker):
    port, link = tracker
    config = OpenIgtLinkToolConfig(address=f"127.0.0.1:{port}", name="Stylus")
    notes = []
    tools = Tools({"pointer": config}, setting(), notes)

    def named(words):
        def told():
            tools.evidence(view(time.time_ns()))
            return any(words in note for note in notes)

        until(told, f"{words!r}, not {notes}")

    try:
        sock = link()
        whole = pack(Message("TRANSFORM", "Stylus", 1, igtl.pack_transform(np.eye(4))))
        sock.sendall(whole[:-1] + bytes([whole[-1] ^ 1]))
        named("checksum")
        sent(sock, "TRANSFORM", "Stylus", igtl.pack_transform(2 * np.eye(4)))
        named("rigid")
        sent(sock, "TRANSFORM", "Stylus", bytes(7))
        named("48 bytes")
        sent(sock, "STRING", "contact", string("perhaps"))
        named("'perhaps'")
        sent(sock, "STRING", "contact", b"\0\3\0\5ab")
        named("STRING")
        sent(sock, "POINT", "F", b"ab")
        named("136 bytes")
        sent(sock, "POLYDATA", "kidney", bytes([255] * 40))
        named("POLYDATA")
        sock.sendall(whole[:42] + (2**40).to_bytes(8, "big") + whole[50:])
        named("1099511627776")
        again = link()  # it comes back
        for _ in range(3):
            sent(again, "TRANSFORM", "Stylus", igtl.pack_transform(facing((0, 0, 120))))
        sent(again, "STRING", "contact", string("1"))

        def touched():
            sent(again, "TRANSFORM", "Stylus", igtl.pack_transform(facing((0, 0, 120))))
            return tools.evidence(view(time.time_ns()))

        assert [piece.name for piece in until(touched, "a touch")] == ["touch"]
    finally:
        tools.close()


def test_what_is_drawn_in_slicer_counts_once_it_rests(monkeypatch):
    """Slicer, here pyigtl, connects to us; its axes are RAS."""
    import pyigtl

    clock = Clock()
    monkeypatch.setattr("tumortrack_devices.tools.openigtlink.time", clock)
    tool = OpenIgtLinkToolConfig(address="0", std_mm=2.0).open(setting(PublishedFrame()), "slicer")
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", tool.link.port)
    try:
        until(lambda: tool.link.receivers)

        def points(places, labels, device):
            client.send_message(pyigtl.PointMessage(places, labels, device_name=device))

        places = np.array([(1.0, 2, 130), (3, 4, 131), (5, 6, 132)])
        labels, ras = ["tumor_1", "spot", "tumor_2"], places * [-1, -1, 1]

        def evidence():
            now = view(clock.time_ns(), np.eye(4))
            pieces = tool.evidence(now)
            tool.located(now, small_estimate())
            return pieces

        def rested():
            """What has rested by now, half a second after all that was sent was heard."""
            points(ras[:1] + 5, ["F-1"], "F")

            def said():
                assert evidence() == []  # nothing has rested yet
                return "'F-1'" in tool.trouble  # which is no part

            until(said, "the unknown name")
            clock.sleep(0.5)
            return evidence()

        for step in (9.0, 6.0, 3.0, 0.0):  # dragged by the mouse
            points(ras + [step, 0, 0], labels, "kidney")
        given = rested()
        assert [piece.part for piece in given] == ["tumor_1", "kidney", "tumor_2"]
        np.testing.assert_allclose([p.place_mm for p in given], places, atol=1e-5)
        assert {piece.std_mm for piece in given} == {2.0}
        points(ras, labels, "kidney")  # said again: nothing new
        angles = np.linspace(0, 2 * np.pi, 2000)
        ring = np.stack([20 * np.cos(angles), 20 * np.sin(angles), np.full(2000, 120.0)], axis=1)
        surface = pyigtl.PolyDataMessage(points=ring * [-1, -1, 1], device_name="tumor_2")
        client.send_message(surface)
        (outline,) = rested()
        assert isinstance(outline, Outline)
        assert outline.part == "tumor_2"
        assert 30 <= len(outline.places_mm) <= 100
        off_mm = np.linalg.norm(np.array(outline.places_mm)[:, :2], axis=1)
        np.testing.assert_allclose(off_mm, 20, atol=1e-4)
    finally:
        client.stop()
        tool.close()


def test_a_pointer_needs_the_calibration_that_drawings_do_not():
    config = OpenIgtLinkToolConfig(address="127.0.0.1:18944", name="Stylus")
    with refused(InputError, "frame=FILE"):
        config.open(setting(PublishedFrame()), "pointer")


# An arm


@pytest.fixture
def arm():
    made = RtdeArm()
    yield made
    made.close()


def felt(tool, arm, push_n):
    """What an arm gives after a third of a second with this force."""
    arm.say(f"push {push_n}")
    time.sleep(0.3)
    now = view(time.time_ns())
    pieces = tool.evidence(now)
    tool.located(now, small_estimate())
    return pieces


def touched(tool, arm):  # again, where a busy machine lost poses for over a tenth of a second
    return [*felt(tool, arm, 0.0), *felt(tool, arm, 4.0)]


def test_an_arm_feels_that_it_touches(arm):
    tool = UrToolConfig(host=arm.host, tip=(0.0, 0.0, 20.0)).open(setting(), "arm")
    try:
        assert felt(tool, arm, 0.0) == []
        assert felt(tool, arm, 1.9) == []  # less than the threshold
        touch = until(lambda: touched(tool, arm), "a touch")[0]
        np.testing.assert_allclose(touch.place_mm, (0, 0, -20), atol=1e-6)  # base z is -z
        until(lambda: felt(tool, arm, 0.0) == [], "the release")
        assert until(lambda: touched(tool, arm), "another touch")
    finally:
        tool.close()


@pytest.mark.parametrize(("ends", "begins"), [("silence", "speak"), ("cut", "mend")])
def test_an_arm_that_was_lost_is_named_and_touches_again(arm, ends, begins):
    tool = UrToolConfig(host=arm.host, tip=(0.0, 0.0, 20.0)).open(setting(), "arm")
    try:
        until(lambda: touched(tool, arm) and not tool.trouble, "a touch")
        arm.say(ends)
        until(lambda: not felt(tool, arm, 0.0) and arm.host in tool.trouble, "the trouble")
        arm.say(begins)
        until(lambda: touched(tool, arm) and not tool.trouble, "a touch after the pause")
    finally:
        tool.close()
    assert "ur poses" not in [thread.name for thread in threading.enumerate()]


def test_a_tool_of_tf_touches_as_its_topic_says():
    needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")
    from ros2_objects import own_graph, peer
    from ros2_peer import tool_pose
    from tumortrack_devices.ros.bus import open_bus
    from tumortrack_devices.tools.ros import Ros2ToolConfig

    published = PublishedFrame("base_link", np.eye(4), calibrated=True)
    with own_graph(), peer("tf", 100, 600) as sender:
        sender.line()
        options = {"tip": (0.0, 0.0, 100.0), "std_mm": 0.7, "shaft_mm": 20.0}
        config = Ros2ToolConfig(frame="tool0", contact="/probe/contact", via="dds", **options)
        tool = config.open(setting(published), "probe")
        bus = open_bus("dds")
        button = bus.publisher("/probe/contact", "std_msgs/msg/Bool")

        def at(now_ns):
            return tool.evidence(view(now_ns, np.eye(4)))

        def pressing(state):
            message = bus.messages.make("std_msgs/msg/Bool", data=state)
            button(bus.messages.to_bytes(message))

        try:
            frees = until(lambda: at(time.time_ns() - 30 * MS), "the shaft")
            assert [piece.name for piece in frees] == ["free_space"]

            def touched():
                pressing(True)
                return [p for p in at(time.time_ns() - 30 * MS) if isinstance(p, Touch)]

            (touch,) = until(touched, "a touch")
            pose = tool_pose(touch.stamp_ns + 50 * MS)
            expected = 1000 * pose[:3, 3] + pose[:3, :3] @ [0, 0, 100]
            # Of the poses that have come in a tenth of a second, at 31 mm/s.
            np.testing.assert_allclose(touch.place_mm, expected, atol=10)
            assert touch.std_mm == 0.7
        finally:
            tool.close()
            bus.close()
