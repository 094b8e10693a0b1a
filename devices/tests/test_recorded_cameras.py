"""Recordings of several cameras, and of one that moves, are played as they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from camera_objects import ASIDE, BASE, Led, Tape, played
from live_objects import small_setting
from tumortrack.core.geometry import HERE
from tumortrack.live.cameras import camera_setup
from tumortrack.live.poses import FilePoses
from tumortrack.live.values import (
    PublishedFrame,
)
from tumortrack_devices.sinks.recording import RecordingSinkConfig
from tumortrack_devices.sources.recording import RecordingSourceConfig


def test_a_recording_of_a_moving_camera_keeps_its_poses(tmp_path):
    published = PublishedFrame("base", HERE, calibrated=True, moves=True)
    told, _ = played([Tape(0, 33, 66, 99)], Led(), published)
    context = replace(small_setting(), published_frame=published)
    sink = RecordingSinkConfig(path=tmp_path / "run").open(context)
    for one in told:
        sink.publish(one)
    sink.close()
    source = RecordingSourceConfig(path=tmp_path / "run", rate=0).open()
    again, _ = played([source], FilePoses(tmp_path / "run" / "poses.csv"), published)
    assert len(again) == 4
    for one, other in zip(told, again, strict=True):
        assert other.stamp_ns == one.stamp_ns
        np.testing.assert_allclose(
            other.published_frame.published_from_camera,
            one.published_frame.published_from_camera,
            atol=1e-5,
        )


def test_a_recording_of_several_cameras_is_played_as_several(tmp_path):
    places = (BASE, BASE @ ASIDE)
    told, _ = played([Tape(0, 33, 66), Tape(5, 38, 71, of=5.0)], places)
    context = replace(small_setting(), published_frame=told[0].published_frame, cameras=places)
    sink = RecordingSinkConfig(path=tmp_path / "run").open(context)
    for one in told:
        sink.publish(one)
    sink.close()
    topics = [f"/camera{n}/depth/image_rect" for n in ("", "_2")]
    texts = [f"recording:{tmp_path / 'run'}?rate=0&topic={topic}" for topic in topics]
    setup = camera_setup(texts, tmp_path / "run" / "poses.json", "", None)
    assert setup.published.frame_id == "base"
    np.testing.assert_allclose(setup.still, places, atol=1e-9)
    again, _ = played([one.open() for one in setup.sources.values()], setup.still)
    assert [one.cameras for one in again] == ["cameras 1, 2"] * 3
    for one, other in zip(told, again, strict=True):
        for mine, its in zip(one.views, other.views, strict=True):
            assert mine.seen.stamp_ns == its.seen.stamp_ns
            np.testing.assert_allclose(
                its.seen.content.depth_mm, mine.seen.content.depth_mm, atol=0.06
            )
