"""An organ under a tool's pull, in the virtual source."""

from __future__ import annotations

import numpy as np
import pytest

from elastic_objects import UP, organ
from theatre_objects import COARSE
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.geometry import transform_points
from tumortrack_devices.player import ScenePlayer, ScenePlayerConfig
from tumortrack_devices.pulled import PulledStates
from tumortrack_devices.sources.virtual import VirtualSource

STILL = {"breath_mm": 0.0, "swell": 0.0, "sway_mm": 0.0, "sway_degrees": 0.0, "push_mm": 0.0}
PULLS_MM = np.array([0.0, 2.0, 4.0])


def vertices():
    return np.concatenate([part.vertices_mm for part in organ().parts])


def states(count=None):
    """Everything goes along x by 0, 1, 4 mm, and the second vertex alone along y."""
    moved = np.zeros((3, count or len(vertices()), 3))
    moved[:, :, 0] = np.array([0.0, 1.0, 4.0])[:, None]
    moved[:, 1, 1] = PULLS_MM
    return PulledStates("c" * 64, PULLS_MM, moved)


def test_states_come_back_from_their_file_and_lie_between_each_other(tmp_path):
    made = states()
    made.write(tmp_path / "pulled.safetensors")
    read = PulledStates.read(tmp_path / "pulled.safetensors")
    assert read.case_sha256 == made.case_sha256
    for pull_mm, moved_mm in zip(PULLS_MM.tolist(), made.moved_mm, strict=True):
        np.testing.assert_allclose(read.at(pull_mm), moved_mm, atol=1e-12)
    assert read.at(1.0)[1, 1] == pytest.approx(1.0)  # linear stays linear
    assert 0 < read.at(1.0)[0, 0] < 1 < read.at(3.0)[0, 0] < 4
    np.testing.assert_array_equal(read.at(60.0), read.at(4.0))  # as at the lift
    np.testing.assert_array_equal(read.at(-1.0), read.at(0.0))


def test_what_holds_no_states_is_refused(tmp_path):
    path = tmp_path / "pulled.safetensors"
    with pytest.raises(ArtifactError, match="make them with: make pull"):
        PulledStates.read(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ArtifactError, match="make them with: make pull"):
        PulledStates.read(path)
    PulledStates("c" * 64, PULLS_MM[::-1].copy(), np.zeros((3, 4, 3))).write(path)
    with pytest.raises(ArtifactError, match="do not rise from 0"):
        PulledStates.read(path)


def test_the_room_shows_the_pull_of_the_moment():
    config = ScenePlayerConfig(body=COARSE, **STILL)
    room, bare = (ScenePlayer(organ(), UP, config, 3, pulled) for pulled in (states(), None))
    source = VirtualSource(room, 10.0)
    still = source.at(1.0, 7).truth.organ.vertices_mm
    np.testing.assert_array_equal(still, bare.truth(bare.state_at(1.0), 4.0).organ.vertices_mm)
    source.pull_mm = lambda: 4.0
    pulled = source.at(1.0, 7)
    ct_from_camera = np.linalg.inv(room.state_at(1.0).camera_from_room)
    both = still, pulled.truth.organ.vertices_mm
    here, there = (transform_points(ct_from_camera, vertices_mm) for vertices_mm in both)
    np.testing.assert_allclose((there - here)[0], [4.0, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose((there - here)[1], [4.0, 4.0, 0.0], atol=1e-3)
    unpulled = VirtualSource(bare, 10.0).at(1.0, 7).content.depth_mm
    assert np.nanmax(np.abs(pulled.content.depth_mm - unpulled)) > 1.0  # and the camera sees it
    with pytest.raises(InputError, match="of another case"):
        ScenePlayer(organ(), UP, config, 3, states(5))
