"""Poses and drags: laws and known answers."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from render_objects import anatomy, sphere
from tumortrack.core.geometry import direction_lps, transform_points
from tumortrack.simulation.deform.base import View
from tumortrack.simulation.deform.drag import CONFIGURATIONS, DragConfig, Drags
from tumortrack.simulation.scene import PoseConfig, sample_pose

ANATOMY = anatomy()
ORGAN = ANATOMY.organ
ANTERIOR = (0.0, -1.0, 0.0)
DRAWS = 1500


def poses(config, up=ANTERIOR, nearest=(110.0, 125.0), draws=DRAWS, organ=ORGAN):
    rng = np.random.default_rng(1)
    return np.stack([sample_pose(config, organ, up, nearest, rng) for _ in range(draws)])


# pose


@pytest.mark.parametrize("up", [ANTERIOR, (0.0, 0.0, 1.0), direction_lps("1,-2,0.5")])
def test_limited_poses_face_the_camera_within_their_tilt(up):
    turns = poses(PoseConfig(tilt_deg=15.0), up, draws=400, organ=sphere(30, (0, 0, 0), 1))
    x, y, z = (turns[:, :3, :3] @ np.array(up)).T
    tilt_y, tilt_x = np.degrees(np.arcsin(-x)), np.degrees(np.arctan2(y, -z))
    for tilt in (tilt_x, tilt_y):
        assert np.abs(tilt).max() <= 15 + 1e-9
        assert kstest(tilt, "uniform", (-15, 30)).pvalue > 1e-3
    across = np.cross(up, (0.6, 0.0, 0.8))
    spun = turns[:, :3, :3] @ (across / np.linalg.norm(across))
    angle = np.degrees(np.arctan2(spun[:, 1], spun[:, 0]))
    assert kstest(angle, "uniform", (-180, 360)).pvalue > 1e-3


def test_full_poses_are_every_rotation_alike():
    turns = poses(PoseConfig(rotations="full"), organ=sphere(30, (0, 0, 0), 1))[:, :3, :3]
    for axis in np.eye(3):
        x, y, z = (turns @ axis).T
        assert kstest(z, "uniform", (-1, 2)).pvalue > 1e-3  # Archimedes: uniform on the sphere
        assert kstest(np.arctan2(y, x), "uniform", (-np.pi, 2 * np.pi)).pvalue > 1e-3
    angle = Rotation.from_matrix(turns).magnitude()
    # The rotation angle of the uniform distribution has the density (1 - cos) / pi.
    assert kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 1e-3


@pytest.mark.parametrize("rotations", ["full", "limited"])
def test_poses_are_rigid_and_honour_distance_and_offset(rotations):
    config = PoseConfig(rotations=rotations, sideways_mm=12.0)
    turns = poses(config, nearest=(90.0, 130.0), draws=300)
    np.testing.assert_allclose(np.linalg.det(turns[:, :3, :3]), 1)
    placed = [transform_points(turn, ORGAN.vertices_mm) for turn in turns]
    nearest = np.array([p[:, 2].min() for p in placed])
    assert kstest(nearest, "uniform", (90, 40)).pvalue > 1e-3
    centre = np.array([(p.min(0) + p.max(0)) / 2 for p in placed])[:, :2]
    assert np.abs(centre).max() <= 12 + 1e-6
    assert kstest(centre.ravel(), "uniform", (-12, 24)).pvalue > 1e-3


# drag


def in_front(points_ct):
    return points_ct[:, 1] < -10


VIEW = View(ANATOMY, in_front)


def slow_drags(drags, points):
    out = points.astype(float)
    for center, shift, sigma in zip(
        drags.centres_ct, drags.shifts_mm, drags.sigmas_mm, strict=True
    ):
        square = ((out - center) ** 2).sum(1, keepdims=True)
        out = out + np.exp(-square / (2 * sigma.astype(float) ** 2)) * shift
    return out


def test_configurations_are_the_papers_table(shared_data):
    papers = sorted((Path(shared_data).parent / "paper").glob("*.txt"))
    if not papers:
        pytest.skip("the paper's text is not beside the data")
    text = papers[0].read_text()
    table = text[text.index("tab:compare_deformations}\n") :].split("\\end{table}")[0]
    for number, row in enumerate(re.findall(r"^(\d) & (.*?)\\hline", table, re.M | re.S), start=1):
        assert int(row[0]) == number
        triples = re.findall(r"\(([\d.]+), ([\d.]+), (\d+)\)", row[1])
        steps = tuple((float(d), float(s), int(n)) for d, s, n in triples)
        assert steps == CONFIGURATIONS[number]
    assert number == len(CONFIGURATIONS) == 6


@pytest.mark.parametrize("number", CONFIGURATIONS)
def test_drags_agree_with_plain_numpy(number):
    drags = DragConfig(steps=CONFIGURATIONS[number]).sample(VIEW, np.random.default_rng(number))
    points = np.random.default_rng(0).uniform(-60, 60, (3000, 3))
    moved = drags.apply(points)
    assert moved.dtype == np.float32
    np.testing.assert_allclose(moved, slow_drags(drags, points), atol=5e-4)  # cut below 6e-6
    assert np.abs(moved - points).max() > 1


@pytest.mark.parametrize("falloff", ["sigma", "variance"])
def test_drags_start_at_visible_vertices_and_keep_to_their_steps(falloff):
    config = DragConfig(steps=CONFIGURATIONS[3], falloff=falloff)
    visible = ORGAN.vertices_mm[in_front(ORGAN.vertices_mm)]
    steps = [(d, s) for d, s, times in CONFIGURATIONS[3] for _ in range(times)]
    limit, spread = np.array(steps).T
    shares, directions, starts = [], [], []
    for seed in range(60):
        drags = config.sample(VIEW, np.random.default_rng(seed))
        np.testing.assert_allclose(
            drags.sigmas_mm, spread if falloff == "sigma" else np.sqrt(spread), rtol=1e-6
        )
        shift = np.linalg.norm(drags.shifts_mm, axis=1)
        shares.extend(shift / limit)
        directions.extend(drags.shifts_mm / shift[:, None])
        starts.append(drags.centres_ct[0])
        for k in (0, 1, 9, 17):  # where a visible vertex lies after the drags before
            earlier = Drags(drags.centres_ct[:k], drags.shifts_mm[:k], drags.sigmas_mm[:k])
            gap = np.linalg.norm(earlier.apply(visible) - drags.centres_ct[k], axis=1)
            assert gap.min() < 1e-4
    assert max(shares) <= 1 + 1e-6
    assert kstest(shares, "uniform").pvalue > 1e-3
    assert kstest(np.array(directions)[:, 2], "uniform", (-1, 2)).pvalue > 1e-3
    assert len(np.unique(starts, axis=0)) > 50


def test_one_drag_moves_its_centre_by_its_shift_and_falls_off_as_a_gaussian():
    given = [(10, 20, 30)], [(3.0, -4.0, 1.0)], [6.0]  # centre, shift, sigma
    drag = Drags(*(np.array(each, np.float32) for each in given))
    distance = np.array([0, 3, 6, 12, 18, 24, 60])
    points = np.array([10.0, 20, 30]) + distance[:, None] * np.array([0.6, 0, 0.8])
    moved = drag.apply(points) - points
    np.testing.assert_allclose(moved[0], [3, -4, 1], atol=1e-5)
    expected = np.exp(-(distance**2) / (2 * 6.0**2))
    np.testing.assert_allclose(moved @ [3, -4, 1] / 26, expected, atol=2e-6)
    assert (moved[-1] == 0).all()
    assert expected[2] == pytest.approx(0.60653, abs=1e-5)  # exp(-1/2) at one sigma
