"""Recordings of an experiment: states, pictures and poses come back, with the files beside them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from live_objects import STAMP_NS, small_frame
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.live.recording.mcap import STRING, McapBag, camera_messages
from tumortrack.live.ros.messages import Messages, Outgoing
from tumortrack.live.values import Observation
from tumortrack_experiment.record.attachments import attach, attachments_of
from tumortrack_experiment.record.read import IMAGE, STATE, WHOLE, read_recorded

FILES = {"kit.json": b'{"beads": 4}', "calibration.json": bytes(range(256)) * 300}


def seen_number(n: int, colour: bool) -> Observation:
    frame = small_frame(STAMP_NS + n * 10_000_000)
    frame = replace(frame, depth_mm=frame.depth_mm + np.float32(n))
    shape = (*frame.depth_mm.shape, 3) if colour else frame.depth_mm.shape
    picture = np.random.default_rng(n).integers(0, 256, shape).astype(np.uint8)
    return Observation(frame, STAMP_NS + n, picture=picture)


def pose_number(n: int) -> np.ndarray:
    return rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, -20, n]))


def written(folder: Path, colour: bool = True) -> Path:
    messages = Messages()
    bag = McapBag(folder / "recording", messages, "")
    for n in range(8):
        seen = seen_number(n, colour)
        out = camera_messages(seen, pose_number(n), "base", messages)
        if n in (0, 5):
            state = messages.make(STRING, data="D1" if n else "rest")
            out.append(Outgoing(STATE, STRING, state))
        bag.write(seen.arrived_ns, sorted(out, key=lambda one: one.suffix == IMAGE))
    bag.close()
    (folder / "recording" / WHOLE).rename(folder / WHOLE)
    attach(folder / WHOLE, FILES)
    return folder


@pytest.mark.parametrize("colour", [True, False])
def test_states_come_back_with_pictures_poses_and_files(tmp_path, colour):
    recorded = read_recorded(written(tmp_path, colour))
    assert recorded.states == ("rest", "D1")
    assert recorded.attachments == FILES
    for state, numbers in (("rest", range(5)), ("D1", range(5, 8))):
        moments = list(recorded.moments(state))
        assert len(moments) == len(numbers)
        for moment, n in zip(moments, numbers, strict=True):
            sent = seen_number(n, colour)
            assert moment.depth.stamp_ns == sent.stamp_ns
            np.testing.assert_allclose(moment.depth.depth_mm, sent.content.depth_mm, rtol=2e-7)
            np.testing.assert_array_equal(moment.picture, sent.picture)
            np.testing.assert_allclose(moment.fixed_from_camera, pose_number(n), atol=1e-12)
    steady = recorded.steady_depth("D1").depth_mm
    np.testing.assert_allclose(steady, seen_number(6, colour).content.depth_mm, rtol=2e-7)
    with pytest.raises(InputError, match=r"no finished state 'D2'\. It has: rest, D1"):
        next(recorded.moments("D2"))


def test_attachments_leave_the_messages_as_they_were(tmp_path):
    with Reader(written(tmp_path) / WHOLE) as reader:
        assert reader.message_count == 8 * 5 + 2
        assert sum(1 for _ in reader.messages()) == reader.message_count
    whole = (tmp_path / WHOLE).read_bytes()
    damaged = whole.replace(FILES["kit.json"], b'{"beads": 5}')
    (tmp_path / WHOLE).write_bytes(damaged)
    with pytest.raises(InputError, match="checksum"):
        attachments_of(tmp_path / WHOLE)
    (tmp_path / WHOLE).write_bytes(whole[:-9])
    with pytest.raises(InputError, match="no finished MCAP"):
        attachments_of(tmp_path / WHOLE)
