"""The virtual source: laws of its moving world, and its pace."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clock import Clock
from elastic_objects import UP, organ
from refused import refused
from render_objects import ray_hits
from theatre_objects import COARSE, small_theatre
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import LabelVolume, Mesh
from tumortrack.io.case import Case, save_case
from tumortrack.live.spec import SOURCES
from tumortrack.organ.body import BodyConfig
from tumortrack.simulation.noise import CLEAN
from tumortrack.simulation.sensors import simulated
from tumortrack_devices.player import SHAFT_MM, ScenePlayer, ScenePlayerConfig, rod
from tumortrack_devices.pulled import PulledStates
from tumortrack_devices.sources.virtual import VirtualSource, VirtualSourceConfig

HELD_S = (3.0, 9.0, 15.0)  # a push is at its deepest
ROUND_S = 18.0  # all places were pushed once
STILL = {"breath_mm": 0.0, "swell": 0.0, "sway_mm": 0.0, "sway_degrees": 0.0}


def test_seed_and_time_are_all_that_a_frame_depends_on():
    theatre = small_theatre()
    again = ScenePlayer(organ(), UP, ScenePlayerConfig(body=COARSE), 3)
    for t_s in (7.3, 0.0, 2.9):
        one, other = theatre.state_at(t_s), again.state_at(t_s)
        for field in fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
        frames = [
            room.frame(state, room.truth(state), 5).depth_mm
            for room, state in ((theatre, one), (again, other), (theatre, one))
        ]
        np.testing.assert_array_equal(frames[0], frames[1])
        np.testing.assert_array_equal(frames[0], frames[2])
    elsewhere = small_theatre(4).state_at(2.9)
    assert np.abs(elsewhere.camera_from_room - theatre.state_at(2.9).camera_from_room).max() > 0.01


def test_organ_and_tumor_keep_their_volume():
    theatre = small_theatre()
    at_rest = [part.volume_mm3 for part in theatre.anatomy_ct.parts]
    ratios = np.array(
        [
            [part.volume_mm3 for part in theatre.truth(theatre.state_at(t_s)).parts]
            for t_s in np.arange(0, ROUND_S, 0.5)
        ]
    ) / np.array(at_rest)
    assert np.abs(ratios - 1).max() < 0.03
    assert ratios[:, 0].max() > 1.004  # but it swells a little as it breathes in


def test_pushes_deform_the_organ_by_some_millimetres_and_it_comes_back():
    theatre = small_theatre(**STILL)
    rest = theatre.truth(theatre.state_at(0)).organ.vertices_mm
    np.testing.assert_allclose(
        theatre.truth(theatre.state_at(ROUND_S)).organ.vertices_mm, rest, atol=1e-6
    )
    for t_s in HELD_S:
        instant = theatre.state_at(t_s)
        pushed = theatre.truth(instant).organ.vertices_mm
        bent = np.linalg.norm(pushed - _rigidly_onto(rest, pushed), axis=1)
        assert 2 < bent.max() < 12
        tip = (instant.camera_from_room @ instant.room_from_rod)[:3, 3]
        near = np.linalg.norm(pushed - tip, axis=1) < 6
        assert bent[near].min() > 1.5 * np.median(bent)  # most where the instrument is


def _rigidly_onto(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    turn, _ = Rotation.align_vectors(target - target.mean(0), points - points.mean(0))
    return turn.apply(points - points.mean(0)) + target.mean(0)


def test_the_instrument_touches_what_it_pushes_and_nothing_else():
    theatre = small_theatre(**STILL)
    for held_s in HELD_S:
        begin_s = held_s - 3.0
        away, touching, held = (_gap_mm(theatre, begin_s + after_s) for after_s in (0.3, 1.2, 3.0))
        assert away > 20
        assert abs(touching) < 0.5
        assert abs(held) < 0.5
    depths = [theatre.state_at(t_s).depth_mm for t_s in np.arange(0, 6, 0.1)]
    assert max(depths) == theatre.config.push_mm
    assert min(depths) == 0


def _gap_mm(theatre: ScenePlayer, t_s: float) -> float:
    """From the instrument's tip to the organ's surface, by a fine sampling of it."""
    instant = theatre.state_at(t_s)
    tip = (instant.camera_from_room @ instant.room_from_rod)[:3, 3]
    organ_mm = theatre.truth(instant).organ
    corners = organ_mm.vertices_mm[organ_mm.faces]
    weights = np.random.default_rng(0).dirichlet(np.ones(3), 50)
    return float(np.linalg.norm(weights @ corners - tip, axis=2).min())


def test_breathing_goes_down_the_body_and_back():
    theatre = small_theatre(push_mm=0.0, swell=0.0, sway_mm=0.0, sway_degrees=0.0)
    places = [_in_room(theatre, t_s) for t_s in (0.0, 2.0, 4.0)]
    way = places[1] - places[0]
    np.testing.assert_allclose(way, [[0, 0, -6.0]], atol=1e-3)  # inferior in LPS is -z
    np.testing.assert_allclose(places[2], places[0], atol=1e-6)


def _in_room(theatre: ScenePlayer, t_s: float) -> np.ndarray:
    instant = theatre.state_at(t_s)
    center = theatre.anatomy_ct.organ.vertices_mm.mean(0)[None]
    before = theatre.forward(instant, center)
    return transform_points(np.linalg.inv(instant.camera_from_room), before)


def test_nothing_jumps_between_frames():
    theatre = small_theatre()
    places = [
        theatre.forward(theatre.state_at(t_s), theatre.anatomy_ct.organ.vertices_mm[::20])
        for t_s in np.arange(0, ROUND_S + 1, 1 / 30)
    ]
    steps_mm = [np.linalg.norm(b - a, axis=1).max() for a, b in pairwise(places)]
    assert max(steps_mm) < 1.0
    assert np.abs(np.diff(steps_mm)).max() < 0.2  # nor does the speed
    assert np.ptp(np.array(places)[:, :, 2], axis=0).min() > 1.5  # and all moves


@pytest.mark.slow
def test_depth_is_what_rays_find_of_organ_table_and_instrument():
    theatre = small_theatre(width=160, height=90, noise=CLEAN)
    for t_s in HELD_S:
        instant = theatre.state_at(t_s)
        truth = theatre.truth(instant)
        frame = theatre.frame(instant, truth, 17)
        assert frame.stamp_ns == 17
        expected_mm = _by_rays(theatre, instant.camera_from_room, truth.organ, t_s)
        off = np.abs(frame.depth_mm.ravel()[::_EVERY] - expected_mm.min(0))
        assert np.mean(off < 0.05) > 0.99  # but for a few at silhouettes
        seen = np.bincount(expected_mm.argmin(0), minlength=3)
        assert (seen > [100, 200, 10]).all()  # each is in the picture


_EVERY = 7


def _by_rays(
    theatre: ScenePlayer, camera_from_room: np.ndarray, organ_camera: Mesh, t_s: float
) -> np.ndarray:
    """Depth (3, r) of organ, table and instrument in every seventh pixel."""
    lens = theatre.intrinsics
    row, column = np.divmod(np.arange(lens.width * lens.height)[::_EVERY], lens.width)
    rays = np.stack(
        [(column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy, np.ones(len(row))], axis=1
    )
    shaft = rod(SHAFT_MM, 200.0)
    camera_from_rod = camera_from_room @ theatre.state_at(t_s).room_from_rod
    shaft = shaft.with_vertices(transform_points(camera_from_rod, shaft.vertices_mm))
    hits = [
        np.concatenate(
            [ray_hits(np.zeros(3), part, mesh).min(1) for part in np.array_split(rays, 10)]
        )
        for mesh in (organ_camera, shaft)
    ]
    at_rest = organ().organ.vertices_mm
    lowest = at_rest[np.argmin(at_rest @ np.array(UP))]
    normal = camera_from_room[:3, :3] @ np.array(UP)
    under = transform_points(camera_from_room, lowest[None])[0]
    return np.stack([hits[0], (normal @ under) / (rays @ normal), hits[1]])


def test_a_drape_rises_about_the_organ_and_hides_its_sides():
    bare, draped = (small_theatre(noise=CLEAN, drape=drape, push_mm=0.0) for drape in (False, True))
    instant = bare.state_at(1.0)
    truth = bare.truth(instant)
    before, after = (room.frame(instant, truth, 0).depth_mm for room in (bare, draped))
    nearer = before - after
    assert (nearer > -1e-3).all()
    assert np.mean(nearer > 3) > 0.1
    middle = np.nanargmin(before)
    assert nearer.flat[middle] == 0


def test_parts_can_be_left_out():
    bare = small_theatre(table=False, push_mm=0.0, **STILL)
    instant = bare.state_at(2.7)
    np.testing.assert_array_equal(instant.camera_from_room, bare.state_at(0).camera_from_room)
    np.testing.assert_array_equal(instant.velocity, 0)
    truth = bare.truth(instant)
    depth_mm = bare.frame(instant, truth, 0).depth_mm
    assert np.isnan(depth_mm).mean() > 0.5
    assert truth.organ.vertices_mm[:, 2].min() == pytest.approx(118.0, abs=1e-3)


def test_rooms_and_times_that_cannot_be_are_refused():
    for wrong in ({"distance_mm": 10.0}, {"distance_mm": 500.0}, {"width": 100}):
        with pytest.raises(InputError):
            ScenePlayerConfig(**wrong)
    few = BodyConfig(cells=100, modes=8, responses=20, patches=20)
    with refused(InputError, 20):
        ScenePlayer(organ(), UP, ScenePlayerConfig(body=few, places=20), 3)
    with refused(InputError, -0.1):
        small_theatre().state_at(-0.1)


def test_frames_missed_are_counted(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("tumortrack_devices.sources.virtual.time", clock)
    source = clock.of(VirtualSource(small_theatre(), fps=50))
    assert source.read(1.0) is not None
    clock.sleep(0.31)  # frame 15 is due, 1 to 14 were
    assert source.read(1.0) is not None
    assert source.dropped == 14


def test_another_camera_looks_from_farther_and_keeps_its_frozen_noise():
    camera = simulated("l515", unit=1)
    room = small_theatre(table=False, push_mm=0.0, noise=camera, **STILL)
    exact = small_theatre(table=False, push_mm=0.0, distance_mm=265.0, noise=CLEAN, **STILL)
    errors = []
    for t_s in (1.0, 2.0):
        instant, exactly = room.state_at(t_s), exact.state_at(t_s)
        truth = room.truth(instant)
        assert truth.organ.vertices_mm[:, 2].min() > camera.nearest_mm + 10
        clean = exact.frame(exactly, exact.truth(exactly), 0)
        errors.append(room.frame(instant, truth, 0).depth_mm - clean.depth_mm)
    temporal, frozen = camera.noise_mm(280.0)
    both = (np.abs(errors) < 4 * np.hypot(temporal, frozen)).all(0)  # no mixed pixels of edges
    shared = np.mean(errors[0][both] * errors[1][both])
    assert frozen**2 > 4 * temporal**2
    assert shared == pytest.approx(frozen**2, rel=0.2)


def test_the_command_lines_text_opens_a_case(tmp_path):
    labels = LabelVolume(np.zeros((2, 2, 2), np.uint8), np.eye(4))
    save_case(Case(organ(), labels, UP), tmp_path)
    text = f"virtual:{tmp_path}?fps=25&instrument=false&noise=false&camera_motion=false&seed=2"
    config = SOURCES.parse(text)
    source = config.open()
    seen = source.read(1.0)
    source.close()
    assert seen is not None
    assert source.player.config.push_mm == 0
    assert source.player.config.noise == CLEAN
    np.testing.assert_allclose(
        seen.content.depth_mm[np.isfinite(seen.content.depth_mm)].min(),
        seen.truth.organ.vertices_mm[:, 2].min(),
        atol=0.5,
    )
    other = SOURCES.parse(f"virtual:{tmp_path}?sensor=azure-kinect&tissue=true&seed=2").player()
    assert other.config.noise == simulated("azure-kinect", tissue=True, unit=2)
    for wrong in ({"fps": 0.0}, {"seed": -1}):
        with pytest.raises(InputError):
            VirtualSourceConfig(case=tmp_path, **wrong)


QUIET = {"breath_mm": 0.0, "swell": 0.0, "sway_mm": 0.0, "sway_degrees": 0.0, "push_mm": 0.0}
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
    backwards = PulledStates("c" * 64, PULLS_MM[::-1].copy(), np.zeros((3, 4, 3)))
    for made in (lambda: None, lambda: path.write_bytes(b"nothing"), lambda: backwards.write(path)):
        made()
        with refused(ArtifactError, path):
            PulledStates.read(path)


def test_the_room_shows_the_pull_of_the_moment():
    config = ScenePlayerConfig(body=COARSE, **QUIET)
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
    with pytest.raises(InputError):
        ScenePlayer(organ(), UP, config, 3, states(5))
