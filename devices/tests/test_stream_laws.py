"""Laws of what comes as a stream, from bags, ROS messages and OpenIGTLink: what stands for no depth
or no time, how rows are laid out, what lies beside what is read."""

from __future__ import annotations

import io
import logging
import socket
import struct
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer

from clock import Clock, until
from depth_files import write_depth_png, write_intrinsics
from live_objects import CAMERA, STAMP_NS, small_anatomy, small_setting
from recording_objects import PERIOD_NS, frame_number, play
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import rigid
from tumortrack.core.types import SensorCloud
from tumortrack.live.values import Observation, PublishedFrame
from tumortrack_devices.igtl import message as igtl
from tumortrack_devices.igtl.message import Message, pack
from tumortrack_devices.recording.bags import bag_contents
from tumortrack_devices.ros import sensors
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.sources.recording import RecordingSourceConfig
from tumortrack_devices.tools.openigtlink import OpenIgtLinkToolConfig

MESSAGES = Messages()
MS = 1_000_000


def sent(content, stamp_ns=STAMP_NS):
    """Its messages by the last part of their topics."""
    seen = Observation(replace(content, stamp_ns=stamp_ns), 0)
    return {out.suffix: out.message for out in sensors.messages_seen(seen, MESSAGES)}


def packed(frame, stamp_ns=STAMP_NS):
    """As image_transport's compressedDepth of 16 bits, whole mm."""
    stream = io.BytesIO()
    steps = np.nan_to_num(frame.depth_mm).round().astype(np.uint16)
    Image.fromarray(steps).save(stream, "PNG")
    data = np.frombuffer(struct.pack("<i2f", 0, 0, 0) + stream.getvalue(), np.uint8)
    header = MESSAGES.header(stamp_ns, "camera")
    kind = {"format": "16UC1; compressedDepth png", "data": data}
    return MESSAGES.make(sensors.COMPRESSED, header=header, **kind)


def bag(path, rows):
    """Of (time, topic, message)."""
    writer = Writer(path, version=8, storage_plugin=StoragePlugin.MCAP)
    with writer:
        known = {}
        for time_ns, topic, message in rows:
            if topic not in known:
                kind = message.__msgtype__
                known[topic] = writer.add_connection(topic, kind, typestore=MESSAGES.store)
            writer.write(known[topic], time_ns, MESSAGES.to_bytes(message))
    return path


@pytest.mark.parametrize("row_step", ["of a row", "of all", 0])
def test_an_organised_cloud_is_read_whatever_its_row_step_where_its_bytes_fit(row_step):
    points = np.arange(36.0, dtype=np.float32).reshape(12, 3) + 100
    (message,) = sent(SensorCloud(points)).values()
    message.height, message.width = 3, 4
    message.row_step = {"of a row": 48, "of all": len(message.data)}.get(row_step, 0)
    np.testing.assert_allclose(sensors.cloud_of(message).points_mm, points, rtol=1e-6)
    message.data = message.data[:-1]
    if row_step == "of all":
        with pytest.raises(InputError):
            sensors.cloud_of(message)


SENTINELS = {
    "16UC1": [0, 65535],
    "32FC1": [0.0, -1.0, np.nan, np.inf, np.finfo(np.float32).max, 65.535],
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("encoding", SENTINELS)
def test_what_stands_for_no_depth_counts_as_none(encoding):
    out = sent(frame_number(0))
    image, info = out["depth/image_rect"], out["depth/camera_info"]
    kind = sensors.DEPTHS[encoding]
    pixels = np.full((image.height, image.width), 130 if kind == "u2" else 0.13, "<" + kind)
    pixels[0] = np.resize(SENTINELS[encoding], image.width)
    image.encoding, image.step = encoding, pixels.strides[0]
    image.data = pixels.reshape(-1).view(np.uint8)
    depth_mm = sensors.depth_of(image, info).depth_mm
    assert np.isnan(depth_mm[0]).all()
    np.testing.assert_allclose(depth_mm[1:], 130)


def test_a_bag_without_stamps_has_its_own_times_and_says_so(tmp_path, caplog):
    frames, rows = [frame_number(n) for n in range(3)], []
    for n, frame in enumerate(frames):
        out = sent(frame, 0)
        rows += [(frame.stamp_ns, f"/camera/{k}", out[k]) for k in sorted(out)]
        assert frame.stamp_ns == STAMP_NS + n * PERIOD_NS
    with caplog.at_level(logging.WARNING, "tumortrack"):
        got = play(bag(tmp_path / "b", rows))
    assert [seen.stamp_ns for seen in got] == [frame.stamp_ns for frame in frames]
    for seen, frame in zip(got, frames, strict=True):
        np.testing.assert_allclose(seen.content.depth_mm, frame.depth_mm, rtol=1e-6)
    assert len(caplog.records) == 1  # once, not for each frame


@pytest.mark.parametrize("beside", ["nothing", "raw", "colours"])
def test_a_recorded_compressed_depth_is_decoded_as_it_is_live(beside, tmp_path):
    frame = frame_number(0)
    whole = replace(frame, depth_mm=np.round(frame.depth_mm))
    info, topic = sent(frame)["depth/camera_info"], "/cam/depth/image_raw"
    rows = [(1, "/cam/depth/camera_info", info), (2, f"{topic}/compressedDepth", packed(whole))]
    if beside == "raw":
        rows.append((3, topic, sent(whole)["depth/image_rect"]))
    if beside == "colours":
        jpeg = {"format": "jpeg", "data": np.zeros(9, np.uint8)}
        header = MESSAGES.header(STAMP_NS, "camera")
        picture = MESSAGES.make(sensors.COMPRESSED, header=header, **jpeg)
        rows.append((3, "/cam/color/compressed", picture))
    path = bag(tmp_path / "b", rows)
    (seen,) = play(path)
    np.testing.assert_allclose(seen.content.depth_mm, whole.depth_mm, rtol=1e-6)
    assert bag_contents(path)[0].get(f"{topic}/compressedDepth") == 1
    assert "/cam/color/compressed" not in bag_contents(path)[0]


@pytest.mark.parametrize("profile", ["ros1", ""])
def test_an_mcap_of_another_profile_is_named_as_such(profile, tmp_path):
    library, head = b"\4\0\0\0mcap", len(profile).to_bytes(4, "little") + profile.encode()
    record = b"\1" + (len(head) + len(library)).to_bytes(8, "little") + head + library
    path, magic = tmp_path / "f.mcap", b"\x89MCAP0\r\n"
    path.write_bytes(magic + record + b"\2" + (20).to_bytes(8, "little") + bytes(20) + magic)
    with pytest.raises(InputError) as told:
        RecordingSourceConfig(path=path).open()
    assert "damaged" not in str(told.value)
    assert repr(profile) in str(told.value) or not profile


def test_frames_are_played_as_people_number_them(tmp_path):
    write_intrinsics(tmp_path / "intrinsics.json", CAMERA)
    for n in range(1, 12):
        write_depth_png(tmp_path / f"frame_{n}.png", frame_number(n))
    for n, seen in enumerate(play(tmp_path), start=1):
        np.testing.assert_allclose(seen.content.depth_mm, frame_number(n).depth_mm, atol=0.051)


@pytest.mark.parametrize("unit_ns", [1, 1000, 10**6])
def test_times_in_names_are_in_ns_us_or_ms_and_other_pictures_are_no_frames(unit_ns, tmp_path):
    write_intrinsics(tmp_path / "intrinsics.json", CAMERA)
    stamps = [(STAMP_NS + n * 200_000_000) // unit_ns * unit_ns for n in range(4)]
    for n, stamp_ns in enumerate(stamps):
        write_depth_png(tmp_path / f"{stamp_ns // unit_ns}.png", frame_number(n))
    for name in ("mask.png", "color_1.png", "RGB.png"):
        write_depth_png(tmp_path / name, frame_number(9))
    assert [seen.stamp_ns for seen in play(tmp_path)] == stamps


# Own stamps count where the clocks agree; how far the first stamp lies behind, and what counts.
CLOCKS = {
    "agree": ("auto", 20, "sender"),
    "ahead": ("auto", -3000, "arrival"),
    "behind": ("auto", 3000, "arrival"),
    "told that they agree": ("sender", 3000, "sender"),
    "told that they differ": ("arrival", 20, "arrival"),
    "no stamp": ("auto", STAMP_NS // MS, "arrival"),
}


@pytest.fixture
def pointer(monkeypatch):
    """Opens a tool as a server, and a sender to it; the tool lives by ``clock``."""
    clock, opened = Clock(), []
    clock.sleep(STAMP_NS * 1e-9 - clock.monotonic())
    monkeypatch.setattr("tumortrack_devices.tools.openigtlink.time", clock)
    published = PublishedFrame("base", np.eye(4), calibrated=True)
    context = replace(small_setting(), anatomy_ct=small_anatomy(), published_frame=published)

    def make(**options):
        config = OpenIgtLinkToolConfig(address="0", space="lps", name="Stylus", **options)
        tool = config.open(context, "pointer")
        opened.extend((sock := socket.create_connection(("127.0.0.1", tool.link.port)), tool))
        until(lambda: tool.link.receivers, "connection")
        return tool, sock

    yield SimpleNamespace(make=make, clock=clock)
    for one in opened:
        one.close()


def posed(device, stamp_ns, kind="TRANSFORM"):
    """A place 7 mm along x."""
    place = igtl.pack_transform(rigid(np.eye(3), np.array([7.0, 0.0, 0.0])))
    return pack(Message(kind, device, stamp_ns, place))


def place_at(tool, stamp_ns):
    with suppress(NoEstimate):
        return tool.pose(stamp_ns)[0, 3]
    return None


@pytest.mark.parametrize("case", CLOCKS)
def test_poses_have_the_time_of_the_clock_that_is_stated(case, pointer):
    option, late_ms, counts = CLOCKS[case]
    tool, sock = pointer.make(clock=option)
    now_ns = pointer.clock.time_ns()
    stamp_ns = 0 if case == "no stamp" else now_ns - late_ms * MS
    sock.sendall(posed("Stylus", stamp_ns))
    when_ns = stamp_ns if counts == "sender" else now_ns
    until(lambda: place_at(tool, when_ns) == 7.0, "the pose")
    tool.refresh(now_ns)
    assert bool(tool.trouble) == (case in ("ahead", "behind"))


def trouble(tool):
    tool.trouble = ""
    tool.refresh(STAMP_NS)
    return tool.trouble


DAMAGED = (one := posed("Stylus", 0))[:50] + b"\1" * 8 + one[58:]


def test_a_mistyped_device_and_an_unread_type_are_told_apart_from_silence(pointer):
    told = []
    for kind, device in (("", ""), ("TRANSFORM", "Stilus"), ("QTDATA", "Stylus")):
        tool, sock = pointer.make()
        if kind:
            sock.sendall(posed(device, STAMP_NS, kind) + DAMAGED)
            until(lambda tool=tool: trouble(tool), "what came after it")
        trouble(tool)
        pointer.clock.sleep(6)
        told.append(trouble(tool))
    assert len({*told, ""}) == 4
    assert "'Stilus'" in told[1]
    assert "QTDATA" in told[2]
    sock.sendall(posed("Stylus", 0))
    until(lambda: not trouble(tool), "the pose")


@pytest.mark.parametrize(
    "beside", ["checksum off", "an image of 6 MB", "a checksum that is wrong", "a lost pose"]
)
def test_what_lies_beside_poses_does_not_end_the_connection(beside, pointer):
    tool, sock = pointer.make()
    one = posed("Stylus", 0)
    if beside == "a checksum that is wrong":
        sock.sendall(DAMAGED)
        until(lambda: trouble(tool), "the fault")
        assert place_at(tool, pointer.clock.time_ns()) is None
    elif beside == "a lost pose":
        nowhere, lost = igtl.pack_transform(np.eye(4)), {"TransformStatus": "MISSING"}
        sock.sendall(pack(Message("TRANSFORM", "Stylus", 0, nowhere, lost)))
    elif beside == "an image of 6 MB":
        head = struct.pack("> H 12s 20s Q Q Q", 1, b"IMAGE", b"Image", 0, 6_000_000, 1)
        sock.sendall(head + bytes(6_000_000))
    else:
        one = one[:50] + bytes(8) + one[58:]
    sock.sendall(one)
    until(lambda: place_at(tool, pointer.clock.time_ns()) == 7.0, "the pose")
