"""Organs on the move: key frames and what lies between them, what three cameras see against the
truth, and followers whose errors are known beforehand."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import OneWay
from tumortrack.core.geometry import transform_points
from tumortrack.live.sources.recording import RecordingSourceConfig
from tumortrack.report.metrics import surface_samples
from tumortrack.sense.camera import deproject, project
from tumortrack_lab.peers.base import kabsch
from tumortrack_lab.world import colour, following
from tumortrack_lab.world.films import FilmConfig, read_film, write_film
from tumortrack_lab.world.paths import BEFORE_S, LoadPath, random_path
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


def test_a_turned_organ_lies_on_its_other_side_and_breath_moves_organ_and_bed_alike() -> None:
    turned = path("turn", 0)
    moving, end_s = turned.of(organ().points_mm), turned.phases_s[-1]
    there = transform_points(turned.way(end_s), moving.at(end_s))
    pose = kabsch(organ().points_mm, there, np.ones(len(there)))
    degrees = np.rad2deg(Rotation.from_matrix(pose[:3, :3]).magnitude())
    assert degrees == pytest.approx(abs(turned.about["load"]["degrees"]), abs=5.0)
    np.testing.assert_array_equal(turned.way(0.0), np.eye(4))
    breath = path("breathe", 0)
    load = breath.about["load"]
    full = breath.way(BEFORE_S + load["period_s"] / 2)
    middle = organ().middle_mm
    moved = np.linalg.norm(transform_points(full, middle[None])[0] - middle)
    assert load["moved_mm"] * 0.7 < moved < load["moved_mm"] + 6.0
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


def test_what_is_painted_moves_with_the_tissue(film) -> None:
    colour.paint(film)
    before, after = 0, int(np.argmax(film.bend_mm))
    shades = []
    for number in (before, after):
        picture = film.folder / "colour_0" / f"{film.stamps_ns[number]}.jpg"
        pixels = np.asarray(Image.open(picture)).astype(float) + 1
        frame, points = film.looks(number)[0], film.truth(number).organ.vertices_mm
        pixel, depth = project(points, frame.intrinsics)
        column, row = np.rint(pixel).astype(int).T
        seen = np.abs(frame.depth_mm[row, column] - depth) < 2.0
        shades.append(np.where(seen, np.log(pixels[row, column, 1]), np.nan))
    both = np.isfinite(shades).all(0)
    assert both.sum() > 100
    near = cKDTree(points[both]).query(points[both], 15)[1]  # lamps light what is near alike
    veins = [green[both] - green[both][near].mean(1) for green in shades]
    assert np.corrcoef(veins)[0, 1] > 0.2  # 240 places: by chance 0.06
    moved = np.linalg.norm(film.vertices_mm[after] - film.vertices_mm[before], axis=1)
    assert moved.max() > 5.0


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
        return SimpleNamespace(quality=quality, reason="", motion=motion, report={"parts": parts})

    return locate


def test_a_followers_errors_are_judged_as_large_as_they_are(film) -> None:
    rows = pd.DataFrame(following.judge(off_by(film, 4.0, {1}, {2, 3}), film))
    assert len(rows) == len(film.stamps_ns)
    assert rows["quality"].tolist()[:4] == ["good", "none", "poor", "poor"]
    found = rows[rows["quality"] != "none"]
    np.testing.assert_allclose(found["center_mm"], 4.0, atol=1e-3)
    np.testing.assert_allclose(found["targets_mm"], 4.0, atol=1e-3)
    assert (found["hausdorff_mm"].dropna() > 3.0).all()
    assert found["hausdorff_mm"].notna().sum() > 1
    assert rows["center_mm"].isna().tolist() == (rows["quality"] == "none").tolist()
    assert (rows["rigid_center_mm"] < rows["bend_mm"] + 0.1).all()
    about = {"method": "track", "organ": "a", "sequence": "push-000", "kind": "push"}
    text = following.summary(rows.assign(**about))
    good = 100 * (len(rows) - 3) / len(rows)
    assert f"| track | push | {len(rows)} | {good:.0f} |" in text
    assert "4.0 [4.0]" in text
    assert following.longest_s([0.0, 1.0, 2.0, 3.0, 4.0], [True, False, True, True, False]) == 2.0
