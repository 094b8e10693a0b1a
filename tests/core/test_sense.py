"""Camera, cloud and sensor noise: laws and known answers."""

import math

import numpy as np
import pytest

from depth_objects import SMALL, dome, pixels, wall
from refused import refused
from tumortrack.core.camera import d405, deproject, project
from tumortrack.core.cloud import CloudConfig, check_cloud, cloud_from_depth, crop_cloud, thin_cloud
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.types import DepthFrame, Intrinsics, SensorCloud
from tumortrack.core.units import Unit, likely_unit
from tumortrack.simulation.clutter import ClutterConfig, add_clutter
from tumortrack.simulation.noise import CLEAN, D405_NOISE, NoiseConfig, add_noise


def rows(points):
    return {tuple(point) for point in points.tolist()}


def drawn(frame, config=CloudConfig(), seed=0):  # noqa: B008
    return cloud_from_depth(frame, config, np.random.default_rng(seed))


# camera


@pytest.mark.parametrize("size", [(848, 480), (424, 240), (1280, 720)])
def test_d405_sees_87_by_58_degrees(size):
    camera = d405(*size)
    for length, focal, centre, degrees in (
        (camera.width, camera.fx, camera.cx, 87),
        (camera.height, camera.fy, camera.cy, 58),
    ):
        left, right = (-0.5 - centre) / focal, (length - 0.5 - centre) / focal
        assert left == pytest.approx(-right)
        assert math.degrees(math.atan(right) - math.atan(left)) == pytest.approx(degrees)
    with pytest.raises(InputError):
        d405(640, 480)  # cropped


def test_deproject_is_the_pinhole_formula_and_project_undoes_it():
    depth = np.full((240, 424), np.nan)
    depth[20, 30] = 130
    camera = Intrinsics(424, 240, 200, 210, 100, 110)
    expected = [[(30 - 100) / 200 * 130, (20 - 110) / 210 * 130, 130]]
    np.testing.assert_allclose(deproject(DepthFrame(depth, camera)), expected, rtol=1e-6)
    frame = dome()
    uv, depth_mm = project(deproject(frame), SMALL)
    v, u = np.nonzero(np.isfinite(frame.depth_mm))
    np.testing.assert_allclose(uv, np.stack([u, v], 1), atol=1e-4)
    np.testing.assert_array_equal(depth_mm, frame.depth_mm[v, u])
    behind, depth_mm = project(np.array([[1.0, 2, -100]]), SMALL)
    assert np.isnan(behind).all()
    assert depth_mm[0] == -100


# cloud


def test_cloud_is_unique_points_of_the_frame_in_range_that_replay():
    frame, config = dome(), CloudConfig(near_mm=125, far_mm=140)
    cloud = drawn(frame, config, 1)
    assert cloud.stamp_ns == 7
    assert len(rows(cloud.points_mm)) == len(cloud.points_mm) == 1000
    assert rows(cloud.points_mm) <= rows(deproject(frame))
    assert (cloud.points_mm[:, 2] > 125).all()
    assert (cloud.points_mm[:, 2] < 140).all()
    np.testing.assert_array_equal(cloud.points_mm, drawn(frame, config, 1).points_mm)
    assert (cloud.points_mm != drawn(frame, config, 2).points_mm).any()


def test_what_lies_out_of_range_changes_nothing():
    frame = dome()
    background = np.where(np.isnan(frame.depth_mm), 200, frame.depth_mm)
    background[:50] = np.where(background[:50] == 200, 90, background[:50])
    within = drawn(DepthFrame(background, SMALL))
    np.testing.assert_array_equal(drawn(frame).points_mm, within.points_mm)


def test_few_points_are_all_taken_and_199_are_refused_and_ends_are_open():
    depth = np.full((240, 424), np.nan)
    depth.flat[:300] = 130
    depth.flat[300:400] = 160
    frame = DepthFrame(depth, SMALL)
    assert rows(drawn(frame).points_mm) == rows(deproject(frame)[:300])
    depth.flat[199:300] = np.nan
    for few in (DepthFrame(depth, SMALL), wall(np.nan), wall(150), wall(300)):
        with pytest.raises(NoEstimate) as refused:
            drawn(few)
        assert refused.value.finding.kind == "few_in_range"
        assert refused.value.finding.values["points"] in (0, 199)
    assert len(crop_cloud(SensorCloud(deproject(wall(149.9))), 110, 150).points_mm) == 424 * 240


def test_crop_keeps_order_and_thin_draws_unique_points():
    cloud = SensorCloud(deproject(dome()), stamp_ns=3)
    z = cloud.points_mm[:, 2]
    cropped = crop_cloud(cloud, 125, 135)
    np.testing.assert_array_equal(cropped.points_mm, cloud.points_mm[(z > 125) & (z < 135)])
    thinned = thin_cloud(cloud, 500, np.random.default_rng(0))
    assert thinned.stamp_ns == cropped.stamp_ns == 3
    assert len(rows(thinned.points_mm) & rows(cloud.points_mm)) == 500
    everything = thin_cloud(thinned, 1000, np.random.default_rng(0))
    assert rows(everything.points_mm) == rows(thinned.points_mm)
    with pytest.raises(NoEstimate):
        crop_cloud(cloud, 10, 20)
    with pytest.raises(InputError):
        crop_cloud(cloud, 20, 10)


@pytest.mark.parametrize(
    "bad", [{"near_mm": 150.0, "far_mm": 110.0}, {"n_points": 10}, {"far_mm": math.inf}]
)
def test_impossible_cloud_configurations_are_refused(bad):
    with pytest.raises(InputError):
        CloudConfig(**bad)


def test_check_cloud_accepts_organs_near_and_far_and_names_units():
    points = deproject(dome())[:2000]
    for good in (points, points + np.float32([0, 0, 400]), points[:200]):
        check_cloud(SensorCloud(good))
    inches = (points - np.float32([0, 0, 20])) / np.float32(25.4)
    for named, wrong in (("m", points / 1000), ("25.4", inches), ("--unit m", points * 1000)):
        with refused(InputError, named):
            check_cloud(SensorCloud(wrong))
    for kind, wrong in (("sparse", points[:199]), ("behind_camera", points * [1, -1, -1])):
        with pytest.raises(NoEstimate) as error:
            check_cloud(SensorCloud(wrong))
        assert error.value.finding.kind == kind


@pytest.mark.parametrize("unit", list(Unit))
def test_the_unit_of_depths_out_of_range_is_named(unit):
    frame = dome()
    away = DepthFrame(frame.depth_mm / np.float32(unit.value), SMALL)
    assert likely_unit(away.depth_mm, (110, 150)) is unit
    for none in (frame.depth_mm, frame.depth_mm * 3, wall(np.nan).depth_mm):
        assert likely_unit(none, (110, 150)) is None
    cloud = SensorCloud(deproject(dome()) / np.float32(unit.value))
    for advice, ask in (
        (unit.of_depth, lambda: drawn(away)),
        (unit.of_cloud, lambda: crop_cloud(cloud, 110, 150)),
    ):
        with pytest.raises(NoEstimate) as refused:
            ask()
        assert refused.value.finding.values["advice"] == advice


# noise


def noisy(frame, seed=0, **parts):
    return add_noise(frame, NoiseConfig(**parts), np.random.default_rng(seed)).depth_mm


def test_the_generator_advances_alike_whatever_is_on():
    ends = []
    for config in (CLEAN, D405_NOISE):
        rng = np.random.default_rng(3)
        add_noise(dome(), config, rng)
        ends.append(rng.random())
    assert ends[0] == ends[1]


def test_switching_one_part_off_leaves_the_others_as_they_were():
    frame = dome()
    both = noisy(frame, axial_mm=0.2, hole_share=0.1)
    only_axial = noisy(frame, axial_mm=0.2)
    kept = np.isfinite(both)
    assert kept.sum() < np.isfinite(only_axial).sum()
    np.testing.assert_array_equal(both[kept], only_axial[kept])


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_axial_noise_is_normal_and_grows_with_the_square_of_depth(share):
    for z in (75.0, 150.0, 300.0):
        error = np.concatenate(
            [noisy(wall(z), s, axial_mm=0.2, correlated_share=share).ravel() - z for s in range(4)]
        )
        std = 0.2 * (z / 150) ** 2
        assert error.std() == pytest.approx(std, rel=0.03)
        assert abs(error.mean()) < 0.05 * error.std()
        if share == 0:
            for level, beyond in ((1, 0.3173), (2, 0.0455), (3, 0.0027)):
                assert (np.abs(error) > level * std).mean() == pytest.approx(beyond, rel=0.15)


def test_correlated_share_is_the_neighbours_correlation():
    def correlation(share, apart):
        parts = {"axial_mm": 0.2, "correlated_share": share, "correlation_px": 5}
        e = np.stack([noisy(wall(150.0), s, **parts) for s in range(6)]) - 150
        return float((e[:, :, apart:] * e[:, :, :-apart]).mean() / e.var())

    assert abs(correlation(0.0, 1)) < 0.01
    assert 0.4 < correlation(0.5, 1) < 0.5  # the whole share, but for the falloff over one pixel
    assert abs(correlation(0.5, 12)) < 0.03


def test_holes_take_their_share_in_blobs():
    lost = np.stack([np.isnan(noisy(wall(130.0), s, hole_share=0.05)) for s in range(20)])
    assert lost.mean() == pytest.approx(0.05, rel=0.1)
    beside = (lost[:, :, 1:] & lost[:, :, :-1]).mean() / lost.mean()
    assert beside > 0.6  # a scattered 5 % would have 0.05


def test_flying_pixels_lie_behind_edges_only_and_the_image_border_is_none():
    depth = np.full((240, 424), 140.0)
    depth[:, :200] = 120.0
    frame = DepthFrame(depth, SMALL)
    moved = noisy(frame, flying_share=0.4, edge_px=2, edge_mm=3.0) - frame.depth_mm
    rows_, columns = np.nonzero(moved)
    assert set(columns.tolist()) == {198, 199}
    assert len(rows_) == pytest.approx(0.4 * 2 * 240, rel=0.25)
    assert moved.min() >= 0
    assert 8 < moved.max() <= 10  # flying_mm, less than the step of 20
    assert (noisy(wall(130.0), flying_share=1.0) == np.float32(130)).all()


@pytest.mark.parametrize(("tilt", "lost"), [(60, 0.0), (70, 0.0), (80, 0.5)])
def test_grazing_surfaces_are_lost_by_their_angle(tilt, lost):
    """A plane through (0, 0, 130): seen by the central rays at ``tilt`` degrees."""
    u, v = pixels(SMALL)
    x = (u - SMALL.cx) / SMALL.fx
    depth = 130 / (1 - x * math.tan(math.radians(tilt)))
    middle = (np.abs(u - SMALL.cx) < 4) & (np.abs(v - SMALL.cy) < 60)
    frame = DepthFrame(np.where(middle, depth, np.nan), SMALL)
    left = noisy(frame, grazing_share=0.5, grazing_degrees=75.0)
    assert np.isnan(left[np.isfinite(frame.depth_mm)]).mean() == pytest.approx(lost, abs=0.06)


def test_distortion_is_slow_and_bounded():
    errors = np.stack([noisy(wall(130.0), s, distortion_mm=1.0) - 130 for s in range(30)])
    assert max(np.abs(np.diff(errors, axis=axis)).max() for axis in (1, 2)) < 0.06
    peaks = np.abs(errors).max((1, 2))
    assert 0.8 < max(peaks) <= 1.0001
    assert np.mean(peaks) == pytest.approx(0.5, abs=0.2)


def test_scattered_points_fill_empty_pixels_only():
    frame = dome()
    seen = np.isfinite(frame.depth_mm)
    result = noisy(frame, scatter_share=0.05, scatter_mm=15.0)
    np.testing.assert_array_equal(result[seen], frame.depth_mm[seen])
    false = result[~seen & np.isfinite(result)]
    assert len(false) == pytest.approx(0.05 * seen.sum(), rel=0.15)
    low, high = np.nanmin(frame.depth_mm) - 15, np.nanmax(frame.depth_mm) + 15
    assert low <= false.min() < low + 1
    assert high - 1 < false.max() <= high
    assert false.mean() == pytest.approx((low + high) / 2, abs=2)
    assert np.isfinite(noisy(wall(130.0), scatter_share=0.05)).all()
    assert np.isnan(noisy(wall(np.nan), scatter_share=0.05)).all()


@pytest.mark.parametrize(
    "bad",
    [
        *({"axial_mm": -1.0}, {"hole_share": 1.5}, {"edge_px": 0}, {"grazing_degrees": 90.0}),
        *({"scatter_mm": -1.0}, {"distortion_mm": math.nan}),
    ],
)
def test_noise_that_cannot_be_is_refused_by_name(bad):
    with refused(InputError, next(iter(bad))):
        NoiseConfig(**bad)


# clutter


CLUTTER = ClutterConfig(scenes=1.0, largest_share=0.08)


def cluttered(frame, seed, config=CLUTTER):
    return add_clutter(frame, config, np.random.default_rng(seed)).depth_mm


def test_clutter_fills_empty_pixels_up_to_its_share_from_near_as_from_far():
    frame = dome()
    seen = np.isfinite(frame.depth_mm)
    shares, spans = [], []
    for seed in range(60):
        image = cluttered(frame, seed)
        np.testing.assert_array_equal(image[seen], frame.depth_mm[seen])
        added = image[~seen & np.isfinite(image)]
        shares.append(len(added) / (len(added) + seen.sum()))
        if len(added) > 50:
            spans.append(np.percentile(added, [0, 50, 100]))
    assert 0.06 < max(shares) <= 0.081
    assert np.mean(shares) == pytest.approx(0.04, abs=0.012)
    near, middle, far = np.array(spans).T
    assert near.min() < 120 < 145 < far.max()
    assert 0.2 < (middle > 145).mean() < 0.9  # mostly behind the organ in many, beside it in some
    twice = DepthFrame(frame.depth_mm * 2, SMALL)
    for seed in range(12):
        np.testing.assert_allclose(cluttered(twice, seed), cluttered(frame, seed) * 2, rtol=1e-5)


def test_clutter_replays_leaves_the_generator_as_it_was_and_spoils_its_share_of_images():
    frame, half = dome(), ClutterConfig(scenes=0.5, largest_share=0.08)
    spoiled = 0
    for seed in range(100):
        image = cluttered(frame, seed, half)
        np.testing.assert_array_equal(image, cluttered(frame, seed, half))
        spoiled += not np.array_equal(image, frame.depth_mm, equal_nan=True)
    assert 35 < spoiled < 65
    rng, other = np.random.default_rng(3), np.random.default_rng(3)
    add_clutter(frame, CLUTTER, rng)
    assert rng.random() == other.random()
    for unseen, config in ((frame, ClutterConfig()), (wall(np.nan), CLUTTER)):
        assert add_clutter(unseen, config, rng) is unseen
    for bad in ({"scenes": 1.1}, {"largest_share": 0.6}, {"scenes": math.nan}):
        with pytest.raises(InputError):
            ClutterConfig(**bad)
