"""Camera, cloud and sensor noise: laws and known answers."""

import math

import numpy as np
import pytest

from depth_objects import SMALL, dome, pixels, wall
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.types import DepthFrame, Intrinsics, SensorCloud
from tumortrack.sense.camera import d405, deproject, project
from tumortrack.sense.cloud import (
    CloudConfig,
    check_cloud,
    cloud_from_depth,
    crop_cloud,
    thin_cloud,
)
from tumortrack.sense.clutter import ClutterConfig, add_clutter
from tumortrack.sense.kernels import seen_pixels
from tumortrack.sense.noise import CLEAN, D405_NOISE, NoiseConfig, add_noise
from tumortrack.sense.units import Unit, likely_unit


def rows(points):
    return {tuple(point) for point in points.tolist()}


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


def test_d405_of_a_cropped_mode_is_refused():
    with pytest.raises(InputError, match="848 x 480"):
        d405(640, 480)


def test_deproject_is_the_pinhole_formula_at_one_pixel():
    depth = np.full((240, 424), np.nan)
    depth[20, 30] = 130
    camera = Intrinsics(424, 240, 200, 210, 100, 110)
    expected = [[(30 - 100) / 200 * 130, (20 - 110) / 210 * 130, 130]]
    np.testing.assert_allclose(deproject(DepthFrame(depth, camera)), expected, rtol=1e-6)


def test_project_undoes_deproject():
    frame = dome()
    uv, depth_mm = project(deproject(frame), SMALL)
    v, u = np.nonzero(np.isfinite(frame.depth_mm))
    np.testing.assert_allclose(uv, np.stack([u, v], 1), atol=1e-4)
    np.testing.assert_array_equal(depth_mm, frame.depth_mm[v, u])


def test_points_behind_the_camera_have_no_pixel():
    uv, depth_mm = project(np.array([[1.0, 2, -100], [0, 0, 100]]), SMALL)
    assert np.isnan(uv[0]).all()
    assert depth_mm[0] == -100
    np.testing.assert_allclose(uv[1], [SMALL.cx, SMALL.cy])


# cloud


def test_cloud_is_unique_points_of_the_frame_in_range():
    frame = dome()
    config = CloudConfig(near_mm=125, far_mm=140)
    cloud = cloud_from_depth(frame, config, np.random.default_rng(1))
    everything = rows(deproject(frame))
    assert cloud.stamp_ns == 7
    assert cloud.points_mm.shape == (1000, 3)
    assert len(rows(cloud.points_mm)) == 1000
    assert rows(cloud.points_mm) <= everything
    assert (cloud.points_mm[:, 2] > 125).all()
    assert (cloud.points_mm[:, 2] < 140).all()


def test_cloud_replays_from_its_seed_and_differs_with_another():
    first, again, other = (
        cloud_from_depth(dome(), CloudConfig(), np.random.default_rng(s)).points_mm
        for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_what_lies_out_of_range_changes_nothing():
    frame = dome()
    background = np.where(np.isnan(frame.depth_mm), 200, frame.depth_mm)
    background[:50] = np.where(background[:50] == 200, 90, background[:50])
    alone, within = (
        cloud_from_depth(f, CloudConfig(), np.random.default_rng(4)).points_mm
        for f in (frame, DepthFrame(background, SMALL))
    )
    np.testing.assert_array_equal(alone, within)


def test_every_point_in_range_is_drawn_equally_often():
    frame = dome()
    rng = np.random.default_rng(0)
    config = CloudConfig(n_points=4000)
    drawn = [project(cloud_from_depth(frame, config, rng).points_mm, SMALL)[0] for _ in range(40)]
    column = np.rint(np.concatenate(drawn)[:, 0])
    share = (column < SMALL.cx).mean()  # the dome is symmetric
    assert abs(share - 0.5) < 0.01


def test_few_points_are_all_taken_and_199_are_refused():
    depth = np.full((240, 424), np.nan)
    depth.flat[:300] = 130
    depth.flat[300:400] = 160
    frame = DepthFrame(depth, SMALL)
    cloud = cloud_from_depth(frame, CloudConfig(), np.random.default_rng(0))
    assert rows(cloud.points_mm) == rows(deproject(frame)[:300])
    depth.flat[199:300] = np.nan
    with pytest.raises(NoEstimate, match=r"only 199 points .* 130.0 to 160.0 mm.* 200"):
        cloud_from_depth(DepthFrame(depth, SMALL), CloudConfig(), np.random.default_rng(0))


def test_a_frame_without_return_says_so():
    with pytest.raises(NoEstimate, match="no return at all"):
        cloud_from_depth(wall(np.nan), CloudConfig(), np.random.default_rng(0))


def test_range_ends_are_open():
    with pytest.raises(NoEstimate, match="only 0 points"):
        cloud_from_depth(wall(150), CloudConfig(), np.random.default_rng(0))
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
    with pytest.raises(NoEstimate, match="120"):
        crop_cloud(cloud, 10, 20)
    with pytest.raises(InputError, match="empty"):
        crop_cloud(cloud, 20, 10)


@pytest.mark.parametrize(
    "bad", [{"near_mm": 150.0, "far_mm": 110.0}, {"n_points": 10}, {"far_mm": math.inf}]
)
def test_impossible_cloud_configurations_are_refused(bad):
    with pytest.raises(InputError):
        CloudConfig(**bad)


def test_check_cloud_accepts_organs_near_and_far_and_explains_units():
    points = deproject(dome())[:2000]
    check_cloud(SensorCloud(points))
    check_cloud(SensorCloud(points + np.float32([0, 0, 400])))
    with pytest.raises(InputError, match="metres: give --unit m"):
        check_cloud(SensorCloud(points / 1000))
    with pytest.raises(InputError, match=r"inches: multiply it by 25\.4"):
        check_cloud(SensorCloud((points - np.float32([0, 0, 20])) / np.float32(25.4)))
    with pytest.raises(InputError, match="leave out --unit m"):
        check_cloud(SensorCloud(points * 1000))
    with pytest.raises(NoEstimate, match="199"):
        check_cloud(SensorCloud(points[:199]))
    check_cloud(SensorCloud(points[:200]))
    with pytest.raises(NoEstimate, match="before the camera"):
        check_cloud(SensorCloud(points * np.float32([1, -1, -1])))


@pytest.mark.parametrize("unit", list(Unit))
def test_the_unit_of_depths_out_of_range_is_named(unit):
    frame = dome()
    away = DepthFrame(frame.depth_mm / np.float32(unit.value), SMALL)
    assert likely_unit(away.depth_mm, (110, 150)) is unit
    assert likely_unit(frame.depth_mm, (110, 150)) is None
    assert likely_unit(frame.depth_mm * 3, (110, 150)) is None
    assert likely_unit(wall(np.nan).depth_mm, (110, 150)) is None
    with pytest.raises(NoEstimate, match=rf"needed: times {unit.value:g} they would"):
        cloud_from_depth(away, CloudConfig(), np.random.default_rng(0))
    cloud = SensorCloud(deproject(dome()) / np.float32(unit.value))
    with pytest.raises(NoEstimate, match=f"needed: {unit.of_cloud}"):
        crop_cloud(cloud, 110, 150)


def test_depths_out_of_range_in_any_unit_ask_for_another_place_or_range():
    with pytest.raises(NoEstimate, match="needed: move the camera"):
        cloud_from_depth(wall(300), CloudConfig(), np.random.default_rng(0))


# noise


def noisy(frame, seed=0, **parts):
    return add_noise(frame, NoiseConfig(**parts), np.random.default_rng(seed)).depth_mm


def test_all_parts_off_changes_nothing():
    frame = dome()
    assert add_noise(frame, CLEAN, np.random.default_rng(0)) is frame


def test_noise_replays_bit_for_bit_and_keeps_camera_and_stamp():
    first, again, other = (
        add_noise(dome(), D405_NOISE, np.random.default_rng(s)) for s in (5, 5, 6)
    )
    assert (first.intrinsics, first.stamp_ns) == (SMALL, 7)
    assert first.depth_mm.tobytes() == again.depth_mm.tobytes()
    assert first.depth_mm.tobytes() != other.depth_mm.tobytes()


def test_seen_pixels_are_those_with_a_return():
    depth_mm = dome().depth_mm.copy()
    depth_mm[3, -1] = depth_mm[-1, 0] = 77.0
    pixels, starts = seen_pixels(depth_mm)
    np.testing.assert_array_equal(pixels, np.flatnonzero(np.isfinite(depth_mm)))
    np.testing.assert_array_equal(np.diff(starts), np.isfinite(depth_mm).sum(1))


def test_false_points_lie_in_the_pixels_that_were_drawn_among_the_empty_ones():
    frame = dome()
    config = NoiseConfig(scatter_share=0.1)
    out_mm = noisy(frame, scatter_share=0.1)
    seed = int(np.random.default_rng(0).integers(2**62))
    rng = np.random.default_rng((seed, 0))
    empty = np.flatnonzero(np.isnan(frame.depth_mm))
    count = rng.poisson(config.scatter_share * np.isfinite(frame.depth_mm).sum())
    drawn = empty[rng.integers(len(empty), size=count)]
    false_points = np.isfinite(out_mm) & np.isnan(frame.depth_mm)
    np.testing.assert_array_equal(np.flatnonzero(false_points), np.unique(drawn))


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


@pytest.mark.parametrize("correlated_share", [0.0, 0.5, 1.0])
def test_axial_noise_grows_with_the_square_of_depth(correlated_share):
    for z in (75.0, 150.0, 300.0):
        error = np.concatenate(
            [
                noisy(wall(z), s, axial_mm=0.2, correlated_share=correlated_share).ravel() - z
                for s in range(4)
            ]
        )
        assert error.std() == pytest.approx(0.2 * (z / 150) ** 2, rel=0.03)
        assert abs(error.mean()) < 0.05 * error.std()


def test_axial_noise_is_normal():
    error = (noisy(wall(150.0), axial_mm=0.2) - 150).ravel() / 0.2
    for level, share in ((1, 0.3173), (2, 0.0455), (3, 0.0027)):
        assert (np.abs(error) > level).mean() == pytest.approx(share, rel=0.15)


def test_correlated_share_is_the_neighbours_correlation():
    def correlation(share, apart):
        e = np.stack(
            [
                noisy(wall(150.0), s, axial_mm=0.2, correlated_share=share, correlation_px=5)
                for s in range(6)
            ]
        )
        e = e - 150
        return float((e[:, :, apart:] * e[:, :, :-apart]).mean() / e.var())

    assert abs(correlation(0.0, 1)) < 0.01
    near, far = correlation(0.5, 1), correlation(0.5, 12)
    assert 0.4 < near < 0.5  # the whole share, but for the falloff over one pixel
    assert abs(far) < 0.03


def test_holes_take_their_share_in_blobs():
    lost = np.stack([np.isnan(noisy(wall(130.0), s, hole_share=0.05)) for s in range(20)])
    assert lost.mean() == pytest.approx(0.05, rel=0.1)
    beside = (lost[:, :, 1:] & lost[:, :, :-1]).mean() / lost.mean()
    assert beside > 0.6  # a scattered 5 % would have 0.05


def test_flying_pixels_lie_behind_edges_only():
    depth = np.full((240, 424), 140.0)
    depth[:, :200] = 120.0
    frame = DepthFrame(depth, SMALL)
    moved = noisy(frame, flying_share=0.4, edge_px=2, edge_mm=3.0) - frame.depth_mm
    rows_, columns = np.nonzero(moved)
    assert set(columns.tolist()) == {198, 199}
    assert len(rows_) == pytest.approx(0.4 * 2 * 240, rel=0.25)
    assert moved.min() >= 0
    assert 8 < moved.max() <= 10  # flying_mm, less than the step of 20


def test_a_view_cut_by_the_image_border_has_no_edge_there():
    assert (noisy(wall(130.0), flying_share=1.0) == np.float32(130)).all()


def test_flying_pixels_at_a_silhouette():
    frame = dome()
    moved = noisy(frame, flying_share=1.0) - frame.depth_mm
    count = np.count_nonzero(moved[np.isfinite(moved)])
    perimeter = 2 * math.pi * math.sqrt(((0.45 * SMALL.fx) ** 2 + (0.25 * SMALL.fy) ** 2) / 2)
    assert perimeter < count < 4 * perimeter


@pytest.mark.parametrize(("tilt", "lost"), [(60, 0.0), (70, 0.0), (80, 0.5)])
def test_grazing_surfaces_are_lost_by_their_angle(tilt, lost):
    """A plane through (0, 0, 130): seen by the central rays at ``tilt`` degrees."""
    u, v = pixels(SMALL)
    x = (u - SMALL.cx) / SMALL.fx
    depth = 130 / (1 - x * math.tan(math.radians(tilt)))
    middle = (np.abs(u - SMALL.cx) < 4) & (np.abs(v - SMALL.cy) < 60)
    frame = DepthFrame(np.where(middle, depth, np.nan), SMALL)
    left = noisy(frame, grazing_share=0.5, grazing_degrees=75.0)
    inner = np.isfinite(frame.depth_mm)
    assert np.isnan(left[inner]).mean() == pytest.approx(lost, abs=0.06)


def test_distortion_is_slow_and_bounded():
    peaks = []
    for seed in range(30):
        error = noisy(wall(130.0), seed, distortion_mm=1.0) - 130
        peaks.append(np.abs(error).max())
        steepest = max(np.abs(np.diff(error, axis=0)).max(), np.abs(np.diff(error, axis=1)).max())
        assert steepest < 0.06
    assert max(peaks) <= 1.0001
    assert max(peaks) > 0.8
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


def test_scattered_points_follow_the_organ_away() -> None:
    frame = dome()
    away = DepthFrame(frame.depth_mm + 200, SMALL)
    near, far = (noisy(f, scatter_share=0.05) for f in (frame, away))
    np.testing.assert_allclose(far, near + 200, atol=1e-3)


# clutter


CLUTTER = ClutterConfig(scenes=1.0, largest_share=0.08)


def test_clutter_fills_empty_pixels_behind_nothing_up_to_its_share():
    frame = dome()
    seen = np.isfinite(frame.depth_mm)
    shares, spans = [], []
    for seed in range(60):
        image = add_clutter(frame, CLUTTER, np.random.default_rng(seed)).depth_mm
        np.testing.assert_array_equal(image[seen], frame.depth_mm[seen])
        added = image[~seen & np.isfinite(image)]
        shares.append(len(added) / (len(added) + seen.sum()))
        if len(added) > 50:
            spans.append(np.percentile(added, [0, 50, 100]))
    assert max(shares) <= 0.081
    assert max(shares) > 0.06
    assert np.mean(shares) == pytest.approx(0.04, abs=0.012)
    near, middle, far = np.array(spans).T
    assert near.min() < 120 < 145 < far.max()
    assert 0.2 < (middle > 145).mean() < 0.9  # mostly behind the organ in many, beside it in some


def test_clutter_looks_alike_from_near_and_far():
    frame = dome()
    twice = DepthFrame(frame.depth_mm * 2, SMALL)
    for seed in range(12):
        near, far = (
            add_clutter(f, CLUTTER, np.random.default_rng(seed)).depth_mm for f in (frame, twice)
        )
        np.testing.assert_allclose(far, near * 2, rtol=1e-5)


def test_clutter_leaves_the_generator_as_it_was_and_replays():
    frame, share = dome(), ClutterConfig(scenes=0.5, largest_share=0.08)
    rng, other = np.random.default_rng(3), np.random.default_rng(3)
    images = [add_clutter(frame, share, np.random.default_rng(s)).depth_mm for s in range(100)]
    again = [add_clutter(frame, share, np.random.default_rng(s)).depth_mm for s in range(100)]
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(images, again, strict=True))
    spoiled = sum(not np.array_equal(i, frame.depth_mm, equal_nan=True) for i in images)
    assert 35 < spoiled < 65
    add_clutter(frame, CLUTTER, rng)
    assert rng.random() == other.random()
    assert add_clutter(frame, ClutterConfig(), rng) is frame
    empty = wall(np.nan)
    assert add_clutter(empty, CLUTTER, rng) is empty
    for bad in ({"scenes": 1.1}, {"largest_share": 0.6}, {"scenes": math.nan}):
        with pytest.raises(InputError, match="clutter"):
            ClutterConfig(**bad)


def test_quantum_rounds_to_whole_units():
    frame = dome()
    result = noisy(frame, quantum_mm=0.1)
    seen = np.isfinite(frame.depth_mm)
    steps = result[seen].astype(float) / 0.1
    np.testing.assert_allclose(steps, np.rint(steps), atol=2e-4)
    assert np.abs(result - frame.depth_mm)[seen].max() <= 0.0501


def test_noise_configuration_round_trip_and_limits():
    assert from_builtins(to_builtins(D405_NOISE), NoiseConfig, "here") == D405_NOISE
    for bad in (
        {"axial_mm": -1.0},
        {"hole_share": 1.5},
        {"edge_px": 0},
        {"grazing_degrees": 90.0},
        {"scatter_mm": -1.0},
        {"distortion_mm": math.nan},
    ):
        with pytest.raises(InputError, match="noise"):
            NoiseConfig(**bad)
