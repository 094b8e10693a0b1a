"""The scenes that the package brings: their truth against what was done, and against the image."""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
import pytest
from scipy.spatial import cKDTree

import tumortrack as tt
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.render import render_depth
from tumortrack.core.rigid_fit import fit_over_volume, matched_vertices
from tumortrack.io.scene_folder import Scene, read_scene
from tumortrack.simulation.datasets import FILE

MOST_BYTES = 5_000_000
KEPT_MM = 0.00052  # half a step of the kept places, and rounding
# The camera's constant error is 0.2 pixels of disparity, one standard deviation: 2.4 mm at the
# 220 mm of the farthest scene for two of them. White noise is less by far.
BIAS_MM, NOISE_MM = 2.4, 1.5


@cache
def scenes() -> dict[str, Scene]:
    return tt.datasets.phantom_scenes()


def test_there_are_ten_in_at_most_5_mb():
    assert len(scenes()) == tt.datasets.SCENES == 10
    assert all(scene.meta["words"] for scene in scenes().values())
    file = resources.files("tumortrack.simulation").joinpath(FILE)
    assert len(file.read_bytes()) <= MOST_BYTES


@pytest.mark.parametrize("count", [0, 11])
def test_a_count_that_there_is_not_is_refused(count):
    with pytest.raises(InputError):
        tt.datasets.phantom_scenes(count)
    assert list(tt.datasets.phantom_scenes(2)) == ["1-rest", "2-pressed-4-mm"]


def test_at_rest_it_lies_as_in_the_ct():
    scene = scenes()["1-rest"]
    carried = transform_points(np.array(scene.meta["camera_from_ct"]), scene.targets.points_ct)
    np.testing.assert_allclose(scene.targets.points_mm, carried, atol=KEPT_MM)


@pytest.mark.parametrize(
    "name",
    ["1-rest", "2-pressed-4-mm", "4-pressed-12-mm", "5-cut", "6-sunk", "7-poked", "8-pulled"],
)
def test_a_state_is_no_rigid_motion_unless_at_rest(name):
    """Deformed by far more than the places are rounded."""
    rest, now = scenes()["1-rest"].reference.organ, scenes()[name].reference.organ
    pose, _ = fit_over_volume(rest, now)
    off_mm = np.abs(transform_points(pose, rest.vertices_mm) - now.vertices_mm).max()
    assert off_mm < 2 * KEPT_MM if name == "1-rest" else off_mm > 2.0


@pytest.mark.parametrize("number", range(10))
def test_the_image_shows_the_true_surface_within_its_noise(number):
    scene = list(scenes().values())[number]
    organ, camera = scene.reference.organ, scene.depth.intrinsics
    true = render_depth(organ.vertices_mm, organ.faces, camera).depth_mm
    x, y, z = scene.cloud.points_mm.T
    pixels = np.rint([y / z * camera.fy + camera.cy, x / z * camera.fx + camera.cx]).astype(int)
    off_mm = (scene.depth.depth_mm - true)[tuple(pixels)]
    assert np.isfinite(off_mm).mean() > 0.9  # matching windows widen the outline by a pixel
    bias_mm = np.nanmedian(off_mm)
    assert abs(bias_mm) < BIAS_MM
    assert np.nanpercentile(np.abs(off_mm - bias_mm), 95) < NOISE_MM


def test_the_touches_lie_on_the_surface_where_the_camera_sees_nothing():
    hidden, touched = scenes()["9-hidden"], scenes()["10-hidden-touched"]
    assert not hidden.evidence
    np.testing.assert_array_equal(hidden.cloud.points_mm, touched.cloud.points_mm)
    assert touched.meta["false_touches"] == 0
    assert len(touched.evidence) == 6
    surface, seen = touched.reference.organ.spread_mm(), touched.cloud.points_mm
    for touch in touched.evidence:
        off_mm, _ = cKDTree(surface).query(touch.place_mm)
        assert off_mm < 4 * np.hypot(touch.std_mm, touch.shared_std_mm)
        assert cKDTree(seen).query(touch.place_mm)[0] > 4.0


def test_a_scene_folder_keeps_the_evidence(tmp_path):
    scene = scenes()["10-hidden-touched"]
    scene.write(tmp_path / "scene")
    kept = read_scene(tmp_path / "scene")
    assert kept.evidence == scene.evidence
    assert kept.meta["words"] == scene.meta["words"]
    np.testing.assert_array_equal(kept.depth.depth_mm, scene.depth.depth_mm)
    pairs = zip(scene.reference.parts, kept.reference.parts, strict=True)
    for part, read in pairs:  # no two vertices became one, or triangles would be lost
        np.testing.assert_allclose(matched_vertices(part, read), part.vertices_mm, atol=KEPT_MM)
