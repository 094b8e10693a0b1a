"""Organs on the move: key frames and what lies between them, solved states gone through with jumps
and hands, what three cameras see against the truth, and followers whose errors are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from reports import report_of
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import surface_samples
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.report.drawing import ESTIMATED, TRUE
from tumortrack.report.metrics import distance_to_surface
from tumortrack.sense.camera import deproject
from tumortrack.sense.region import RegionConfig
from tumortrack.simulate.scene_folder import draw_targets, read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_devices.sources.recording import RecordingSourceConfig
from tumortrack_lab.peers.base import OneWay
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.world import following, pictures, tables
from tumortrack_lab.world.films import FilmConfig, read_film, write_film
from tumortrack_lab.world.paths import BEFORE_S, LoadPath, random_path
from tumortrack_lab.world.states import AWAY_S, FAR_MM, State, read_states, state_path, world_of
from world_objects import organ, world


@cache
def path(kind: str, seed: int) -> LoadPath:
    return random_path(organ(), kind, [seed])


def turn_of(moving, time_s: float) -> float:
    return float(np.rad2deg(Rotation.from_matrix(moving.pose(time_s)[:3, :3]).magnitude()))


def test_between_two_key_frames_an_organ_that_only_turns_stays_rigid() -> None:
    rest = organ().mesh.nodes_mm
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    keys = [rest, rest @ quarter.T + [10.0, 0.0, 0.0]]
    turning = LoadPath(organ(), np.array([0.0, 2.0]), keys, 0.0, [], {})
    moving = turning.of(organ().points_mm)
    assert turn_of(moving, 1.0) == pytest.approx(45.0)
    np.testing.assert_allclose(moving.at(0.0), organ().points_mm, atol=1e-9)
    assert np.abs(moving.bend(1.3)).max() < 1e-9
    middle = organ().mesh.lump(organ().mesh.volumes_mm3) @ rest / organ().mesh.volumes_mm3.sum()
    half = transform_points(moving.pose(1.0), middle[None])[0]
    np.testing.assert_allclose(half, (middle + quarter @ middle + [10.0, 0.0, 0.0]) / 2, atol=1e-9)


def test_motion_passes_through_its_key_frames_and_an_organ_at_rest_stays() -> None:
    pressed = path("press", 3)
    moving = pressed.of(organ().mesh.nodes_mm)
    for time_s, nodes in zip(pressed.times_s, pressed.keys_mm, strict=True):
        np.testing.assert_allclose(moving.at(time_s), nodes, atol=1e-6)
    for time_s in (0.0, BEFORE_S / 2, BEFORE_S):
        np.testing.assert_allclose(moving.at(time_s), pressed.keys_mm[0], atol=1e-6)


def test_a_press_bends_the_organ_and_its_release_lets_it_go_back() -> None:
    pressed = path("press", 3)
    assert pressed.about["material"]["friction"] == 0
    moving = pressed.of(organ().points_mm)
    bends = [np.linalg.norm(moving.bend(t), axis=1).max() for t in pressed.phases_s]
    assert bends[2] > 1.0
    assert bends[2] == pytest.approx(bends[3])  # held
    assert max(bends[0], bends[-1]) < 0.3 * bends[2]
    back = moving.at(pressed.phases_s[-1]) - moving.at(0.0)
    held = moving.at(pressed.phases_s[2]) - moving.at(0.0)
    assert np.linalg.norm(back, axis=1).mean() < 0.3 * np.linalg.norm(held, axis=1).mean()


def test_breath_moves_organ_and_bed_alike() -> None:
    breath = path("breathe", 0)
    load = breath.about["load"]
    full = breath.way(BEFORE_S + load["period_s"] / 2)
    middle = organ().middle_mm
    moved = np.linalg.norm(transform_points(full, middle[None])[0] - middle)
    assert load["moved_mm"] * 0.7 < moved < load["moved_mm"] + 6.0
    np.testing.assert_array_equal(full, breath.bed(BEFORE_S + load["period_s"] / 2))
    np.testing.assert_allclose(breath.way(BEFORE_S + load["period_s"]), np.eye(4), atol=1e-9)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sequences") / "push-000"
    config = FilmConfig(seed=3, fps=1.0, views=3)
    write_film(world(), config, "push", 0, folder)
    return read_film(folder)


def test_truth_is_the_best_rigid_pose_and_a_bend(film) -> None:
    organ_ct = film.rest.organ
    for number in (0, 3):
        true = film.truth(number).organ
        posed = transform_points(film.camera_from_ct[number], organ_ct.vertices_mm)
        left = np.linalg.norm(posed - true.vertices_mm, axis=1)
        assert left.max() == pytest.approx(film.bend_mm[number], abs=1e-3)
    assert film.bend_mm[0] < 0.5 < film.bend_mm.max()
    first = np.array(film.meta["first_from_bench"]) @ np.array(film.meta["bench_from_ct"])
    untouched = film.camera_from_ct[0] @ np.linalg.inv(first)  # settled by a little weight
    assert np.linalg.norm(transform_points(untouched, first[:3, 3][None]) - first[:3, 3]) < 10.0


def test_all_cameras_see_the_true_surface_where_their_poses_say(film) -> None:
    poses = film.first_from_camera(as_it_is=True)
    stated = film.first_from_camera()
    np.testing.assert_allclose(stated[0], np.eye(4), atol=1e-9)
    assert 0.05 < np.linalg.norm((stated - poses)[1:, :3, 3]) < 20.0
    surface = cKDTree(surface_samples(film.truth(0).organ, 1.0)[0])
    low, high = film.truth(0).organ.box_mm
    for frame, pose in zip(film.looks(0), poses, strict=True):
        seen = transform_points(pose, deproject(frame).astype(float))
        near = seen[((seen > low) & (seen < high)).all(1)]
        assert np.median(surface.query(near)[0]) < 1.5  # the bed is in the box as well
        assert len(near) > 500
    sides = Rotation.from_matrix(poses[1:, :3, :3]).magnitude()  # from the first one
    np.testing.assert_allclose(np.rad2deg(sides), 45.0)


def test_the_product_plays_what_a_camera_saw(film) -> None:
    source = RecordingSourceConfig(path=film.folder / "view_1", rate=0).open()
    first, second = source.read(1.0), source.read(1.0)
    source.close()
    assert second.stamp_ns - first.stamp_ns == 1_000_000_000
    np.testing.assert_array_equal(first.content.depth_mm, film.looks(0)[1].depth_mm)


def off_by(film, shift_mm: float, lost: set[int], doubted: set[int]):
    """A follower that knows the truth, and is wrong by as much as is asked."""
    numbers = iter(range(len(film.stamps_ns)))

    def locate(look: following.Look):
        assert len(look.frames) == 3
        n = next(numbers)
        if n in lost:
            raise NoEstimate("nothing is seen")
        rest = np.concatenate([*(p.vertices_mm for p in film.rest.parts), film.targets_ct])
        true = np.concatenate([film.vertices_mm[n], film.targets_mm[n]]) + [shift_mm, 0, 0]
        tree = cKDTree(rest)
        motion = OneWay(lambda points: true[tree.query(points)[1]].astype(float))
        quality = "poor" if n in doubted else "good"
        parts = {"tumor_1": {"center_std_mm": 0.5, "surface_std_mm": 0.7}}
        return SimpleNamespace(
            quality=quality, reason="", motion=motion, report=report_of(parts=parts)
        )

    return locate


def test_a_followers_errors_are_judged_as_large_as_they_are(film) -> None:
    locate = off_by(film, 4.0, {1}, {2, 3})
    sites = tumor_sites_of(film.rest)
    rows = pd.DataFrame(following.judge(locate, film, sites, RegionConfig()))
    assert len(rows) == len(film.stamps_ns)
    assert rows["quality"].tolist()[:4] == ["good", "none", "poor", "poor"]
    found = rows[rows["quality"] != "none"]
    np.testing.assert_allclose(found["center_mm"], 4.0, atol=1e-3)
    np.testing.assert_allclose(found["targets_mm"], 4.0, atol=1e-3)
    assert (found["hausdorff_mm"].dropna() > 3.0).all()
    assert found["hausdorff_mm"].notna().sum() > 1
    assert rows["center_mm"].isna().tolist() == (rows["quality"] == "none").tolist()
    assert (rows["rigid_center_mm"] < rows["bend_mm"] + 0.1).all()
    fits_mm = rows["rigid_fit_center_mm"].dropna()
    assert len(fits_mm) > len(rows) / 2
    assert 0 < fits_mm.median() < 5.0
    about = {"method": "track", "organ": "a", "sequence": "push-000", "kind": "push"}
    made = tables.tables(rows.assign(**about))
    (verdict,) = made["verdicts"].to_dict("records")
    assert (verdict["sequences"], verdict["frames"]) == (1, len(rows))
    assert verdict["good, %"] == pytest.approx(100 * (len(rows) - 3) / len(rows), abs=0.05)
    methods = ["best rigid pose", "rigid fit", "track"]
    assert list(made["errors"]["method"].unique()) == methods
    older = tables.tables(rows.assign(**about).drop(columns="rigid_fit_center_mm"))
    assert list(older["errors"]["method"].unique()) == ["best rigid pose", "track"]
    assert tables.longest_s([0.0, 1.0, 2.0, 3.0, 4.0], [True, False, True, True, False]) == 2.0


@pytest.fixture(scope="module")
def states(tmp_path_factory) -> tuple[Path, list[State]]:
    out = tmp_path_factory.mktemp("states")
    made = world(families=("plate",), segmentation=0.0, hidden=0.0)
    made.scene(0).write(out / "00000-plate-none")
    with pytest.raises(InputError, match="other inner points"):
        read_states(replace(made, targets=draw_targets(made.anatomy_ct, 7)), out)
    return out, read_states(world_of(made, out), out)


def test_a_state_is_gone_into_from_rest_and_what_lies_between_keeps_its_volume(states) -> None:
    out, (state,) = states
    scene, made = read_scene(out / "00000-plate-none"), world()
    to_bench = np.linalg.inv(np.array(scene.meta["camera_from_bench"]))
    path = state_path(organ(), [state], "random", [0])
    going = replace(path, times_s=np.array([0.0, 1.0]), shares=((state, 0.0), (state, 1.0)))
    moving, whole = going.of(made.points), made.organ.anatomy.organ
    np.testing.assert_allclose(moving.at(0.0), made.points, atol=1e-9)
    inner = transform_points(to_bench, scene.targets.points_mm)
    np.testing.assert_allclose(moving.at(1.0)[-len(inner) :], inner, atol=1e-3)
    assert np.abs(state.bend_mm).max() > 1.0
    volumes = [
        trimesh.Trimesh(moving.at(t)[: len(whole.vertices_mm)], whole.faces, process=False).volume
        for t in (0.0, 0.3, 0.5, 0.7, 1.0)
    ]
    np.testing.assert_allclose(volumes, volumes[0], rtol=0.03)


def test_states_of_another_organ_are_refused(states) -> None:
    other = world_of(world(), states[0])
    faces = other.organ.anatomy.organ.faces[::-1]
    turned = Anatomy(
        (Mesh(other.organ.anatomy.organ.vertices_mm, faces), *other.organ.anatomy.tumors)
    )
    with pytest.raises(InputError, match="same triangles"):
        read_states(replace(other, organ=replace(other.organ, anatomy=turned)), states[0])


def test_an_organ_jumps_keeps_its_state_and_lies_as_deep_as_before(states) -> None:
    path = state_path(organ(), states[1], "jump", [1])
    moving, points = path.of(world().points), len(organ().points_mm)
    rest = cKDTree(world().points).query(organ().points_mm)[1]
    before, lowest = moving.at(0.0)[rest], organ().points_mm[:, 2].min()
    assert {kind for _, kind in path.about["jumps"]} == {"elsewhere", "by a hand", "turned over"}
    for since_s, kind in path.about["jumps"]:
        if kind == "turned over":
            away = transform_points(path.way(since_s - AWAY_S / 2), before)
            np.testing.assert_allclose((away - before)[:, 0], FAR_MM)
        places = [path.way(t) for t in (since_s - AWAY_S - 0.01, since_s)]
        was, now = (transform_points(place, before) for place in places)
        assert np.linalg.norm(was - now, axis=1).mean() > 8.0
        laid = transform_points(places[1], organ().points_mm)
        assert laid[:, 2].min() == pytest.approx(lowest, abs=1e-6)
        sizes = [
            np.linalg.norm(one[: points // 2] - one[-(points // 2) :], axis=1) for one in (was, now)
        ]
        np.testing.assert_allclose(*sizes, atol=1e-6)


def test_a_hand_turns_the_organ_over_without_a_jump(states) -> None:
    path = state_path(organ(), states[1], "turn", [1])
    times = np.arange(0.0, path.seconds, 0.05)
    places = np.array([path.way(t)[:3, :3] for t in times])
    steps = Rotation.from_matrix(places[1:] @ places[:-1].transpose(0, 2, 1)).magnitude()
    whole = Rotation.from_matrix(places[-1]).magnitude()
    assert 60.0 <= np.rad2deg(whole) <= 180.0
    assert np.rad2deg(steps).max() < 15.0
    laid = [transform_points(path.way(t), organ().points_mm)[:, 2].min() for t in times]
    assert laid[0] == pytest.approx(laid[-1])
    assert max(laid) > laid[0] + 20.0


def test_what_comes_over_the_organ_hides_as_much_as_was_asked(states, tmp_path) -> None:
    config = FilmConfig(seed=1, fps=2.0)
    write_film(world(), config, "hidden", 0, tmp_path / "hidden-000", lambda: states[1])
    film = read_film(tmp_path / "hidden-000")
    covers = film.meta["covers"]
    assert len(covers) == 3
    for since_s, until_s, share in covers:
        stay = (film.seconds >= since_s) & (film.seconds <= until_s)
        assert stay.any()
        np.testing.assert_allclose(film.hidden_share[stay], share, atol=0.12)  # it breathes
    assert film.hidden_share[0] == film.hidden_share[-1] == 0.0


def known_rows(**changes) -> pd.DataFrame:
    """Two methods in ten frames of one sequence: right and good but for what is changed."""
    rows = []
    for method in ("track", "first-look"):
        for n in range(10):
            row = {"method": method, "organ": "a", "sequence": "jump-000", "kind": "jump"}
            row |= {"time_s": n / 5, "tumor": "tumor_1", "site": "endophytic", "bend_mm": 0.0}
            row |= {"quality": "good", "hidden_share": 0.0, "center_mm": 1.0, "targets_mm": 1.0}
            row |= {
                "rigid_center_mm": 0.0,
                "hausdorff_mm": 2.0,
                "jump": "elsewhere",
                "since_s": 0.4,
            }
            if n < 2:
                row |= {"jump": "none", "since_s": -np.inf}
            rows.append(row)
    frames = pd.DataFrame(rows)
    for name, (first, last, value) in changes.items():
        which = (frames["method"] == "track") & frames["time_s"].between(first / 5, last / 5)
        frames.loc[which, name] = value
    return frames


def found_of(rows: pd.DataFrame, table: str) -> list:
    """The table's first row."""
    made = tables.tables(rows)
    return made[table].iloc[0].tolist() if table in made else []


def test_frames_after_a_jump_are_counted_until_a_first_look_is_no_better() -> None:
    late = found_of(known_rows(center_mm=(2, 4, 6.0)), "jumps")
    assert late == ["elsewhere", 1, 8, 4, 4, 0, 3, 3, 0]
    assert found_of(known_rows(), "jumps") == ["elsewhere", 1, 8, 1, 1, 100, 0, 0, 0]
    doubted = known_rows(center_mm=(2, 4, 6.0), quality=(2, 4, "poor"))
    assert found_of(doubted, "jumps") == ["elsewhere", 1, 8, 4, 4, 0, 0, 0, 0]
    gone = tables.tables(known_rows(hidden_share=(5, 9, 1.0)))["jumps"].iloc[-1]
    assert gone[["jump", "frames", "good and over 3 mm: track"]].tolist() == ["organ gone", 5, 0]


def test_a_wrong_state_kept_for_over_a_second_is_named() -> None:
    def said(last: int, off_mm: float, table: str) -> list:
        rows = known_rows(center_mm=(2, last, off_mm))
        rows = rows[rows["method"] == "track"]
        return found_of(rows.assign(kind="random", sequence="random-000"), table)

    assert said(7, 4.0, "verdicts") == ["track", "random", 1, 10, 100, 0, 60.0, 1.2, 1, 0]
    assert said(7, 4.0, "kept") == ["track", "a", "random-000", 1.2, 0, 4.0, 0.0, 0]
    assert said(6, 9.0, "verdicts") == ["track", "random", 1, 10, 100, 0, 50.0, 1.0, 0, 0]
    assert not said(6, 9.0, "kept")


def test_errors_behind_a_hand_are_held_against_the_open_frames() -> None:
    rows = known_rows(hidden_share=(5, 9, 0.4), targets_mm=(5, 9, 1.5))
    made = tables.tables(rows.assign(kind="hidden", sequence="hidden-000"))["hidden"]
    track = made[made["method"] == "track"].iloc[0].tolist()
    assert track == ["track", 1, 1.0, 1.0, 1.5, 1.5, 1.5, 1.5, 1.5, 100, 0, 0, 5]


def test_a_press_is_shown_as_a_small_film(film, tmp_path) -> None:
    pictures.show(off_by(film, 4.0, {1}, set()), film, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as shown:
        assert shown.n_frames == (len(film.stamps_ns) + 1) // 2
        first = np.asarray(shown.convert("RGB")).reshape(-1, 3).astype(int)
    for colour_of in (TRUE, ESTIMATED):
        off = np.abs(first - 255 * np.array(colour_of)).max(1)
        assert (off < 40).sum() > 50


def test_touches_become_known_with_the_first_frame(film, monkeypatch) -> None:
    given = []

    class Recorder:
        def __init__(self, *_): ...

        def last_box_mm(self, _): ...

        def locate(self, cloud, seen, evidence):
            given.append(evidence)
            raise NoEstimate("nothing is seen")

    monkeypatch.setattr(following, "Follower", Recorder)
    tracker = Tracker.__new__(Tracker)
    tracker.model = None
    locate = following.METHODS["track-touched"](tracker, film)
    for number in range(2):
        with pytest.raises(NoEstimate):
            locate(following.Moment(film.looks(number), film.first_from_camera()))
    assert [len(known) for known in given] == [6, 0]
    places = np.array([touch.place_mm for touch in given[0]])
    assert distance_to_surface(places, film.truth(0).organ).max() < 8.0
