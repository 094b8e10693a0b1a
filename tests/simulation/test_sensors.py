"""Simulated cameras have the noise that is stated of them, frozen where it is frozen."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from msgspec.structs import replace

from noise_objects import seen
from refused import refused
from stories import succeeded, tumortrack
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame, Intrinsics
from tumortrack.io.scene_folder import read_scene
from tumortrack.segmentation.measured_noise import depth_step_mm
from tumortrack.simulation.noise import D405_NOISE, STEREO_NOISE, add_noise
from tumortrack.simulation.sensors import FIGURES, depth_error_of, simulated
from tumortrack.tracking.options import LocateOptions, SimulatedSensor, SimulateOptions

FLIGHT = [name for name in FIGURES if "flying_share" in FIGURES[name]]


def flat(distance_mm: float, width: int = 848) -> DepthFrame:
    depth_mm = np.full((width // 2, width), distance_mm, np.float32)
    half = width / 2
    return DepthFrame(depth_mm, Intrinsics(width, width // 2, half, half, half, half / 2))


def frame_of(config, frame: DepthFrame, seed: int = 0) -> np.ndarray:
    return add_noise(frame, config, np.random.default_rng(seed)).depth_mm.astype(float)


def without_steps(name: str, **options):
    return replace(simulated(name, **options), step_px=0.0, step_mm=0.0)


def step_mm(config, depth_mm: float) -> float:
    """The coarser of both, at a depth."""
    stored = config.step_px * depth_mm**2 / (config.focal_px * config.baseline_mm or np.inf)
    return max(stored, config.step_mm)


def test_options_offer_what_the_table_has():
    assert set(get_args(SimulatedSensor)) == {"d405", "stereo", *FIGURES}


@pytest.mark.parametrize("width", [848, 424])
@pytest.mark.parametrize("name", FIGURES)
def test_noise_is_correlated_over_its_own_pixels(name, width):
    """Two frames of a unit differ by random noise alone; all its lengths scale with the image."""
    config = replace(without_steps(name), fill=1.0, edge_slope=0.0)
    true = flat(max(300.0, config.nearest_mm + 10), width)
    random = np.subtract(*(frame_of(config, true, seed) for seed in (1, 2)))
    assert np.std(random) == pytest.approx(
        2**0.5 * config.noise_mm(true.depth_mm[0, 0])[0], rel=0.1
    )
    length_px = config.temporal_length_px * width / config.native_px
    for lag in {1, max(1, round(length_px))}:
        found = np.mean(random[:, lag:] * random[:, :-lag]) / np.var(random)
        expected = (1 - config.white_share) * np.exp(-((lag / length_px) ** 2))
        if length_px >= 1:
            assert found == pytest.approx(expected, abs=0.06)
        else:  # shorter than a pixel of this image
            assert abs(found) < expected + 0.02


@pytest.mark.parametrize("name", FIGURES)
def test_the_frozen_part_is_the_units_and_time_does_not_average_it(name):
    config = replace(without_steps(name), fill=1.0, edge_slope=0.0)
    true = flat(max(300.0, config.nearest_mm + 10))
    one, again, other = (
        frame_of(replace(config, unit=unit), true, seed) - true.depth_mm
        for unit, seed in ((3, 1), (3, 2), (4, 3))
    )
    temporal, frozen = config.noise_mm(float(true.depth_mm[0, 0]))
    shared = np.mean(one * again)
    assert shared == pytest.approx(frozen**2, abs=0.1 * (frozen**2 + temporal**2))
    assert np.mean(one * other) == pytest.approx(0, abs=0.1 * (frozen**2 + temporal**2))


def test_depths_are_stored_in_steps():
    distances = {"azure-kinect": 300, "l515": 300, "flexx2": 150}
    for name, distance_mm in distances.items():
        config = simulated(name)
        stored = add_noise(flat(distance_mm), config, np.random.default_rng(0)).depth_mm
        assert depth_step_mm(stored) == pytest.approx(config.step_mm)
    # Disparities of 1/32 px, then tenths of a millimetre.
    config = simulated("d405-measured")
    fb = config.focal_px * config.baseline_mm
    stored = np.unique(frame_of(config, seen(848, 300.0)))
    possible = np.round(fb / (np.arange(1, 32 * 100) / 32), 1)
    nearest = np.abs(possible - stored[np.isfinite(stored), None]).min(1)
    np.testing.assert_allclose(nearest, 0, atol=1e-4)
    assert step_mm(config, 300.0) == pytest.approx(300**2 / 32 / fb)
    assert depth_step_mm(frame_of(simulated("zed"), flat(150.0))) == 0


@pytest.mark.parametrize("name", FIGURES)
def test_a_units_bias_lies_in_its_range_and_a_calibrated_one_has_none(name):
    config = simulated(name)
    assert simulated(name, unit=5).bias == (0, 0, 0)
    drawn = np.array([simulated(name, unit=n, uncalibrated=True).bias for n in range(200)])
    limits = np.array([config.scale, config.offset_mm, config.warp_mm])
    assert (np.abs(drawn) <= limits).all()
    assert (np.abs(drawn).max(0) >= 0.9 * limits).all()
    assert simulated(name, unit=7, uncalibrated=True).bias == tuple(drawn[7])
    true = flat(max(150.0, config.nearest_mm + 10))
    of_one = without_steps(name, unit=7, uncalibrated=True)
    # The unit has the same frozen noise with and without its bias, and the frame the same noise.
    moved = frame_of(of_one, true) - frame_of(replace(of_one, calibrated=True), true)
    scale, offset_mm, warp_mm = of_one.bias
    away = np.abs(moved - scale * true.depth_mm - offset_mm)
    assert np.nanmax(away) <= abs(warp_mm) + 1e-3


@pytest.mark.parametrize("name", FLIGHT)
def test_tissue_is_seen_too_deep_by_time_of_flight(name):
    low_mm, high_mm = simulated(name).tissue_mm
    units = [simulated(name, unit=n, tissue=True).bias for n in range(50)]
    assert all(scale == 0 and low_mm <= deep_mm <= high_mm for scale, deep_mm, _ in units)
    true = flat(300.0)
    config = without_steps(name, unit=1, tissue=True)
    deeper = frame_of(config, true) - frame_of(replace(config, tissue=False), true)
    assert np.nanmean(deeper) == pytest.approx(config.bias[1], abs=1e-3)


def test_tissue_is_noisier_and_full_of_holes_by_stereo():
    for name in ("d405-measured", "d435"):
        dry, wet = simulated(name), simulated(name, tissue=True)
        np.testing.assert_allclose(wet.noise_mm(200.0), 2 * np.array(dry.noise_mm(200.0)))
        for config, fill in ((dry, dry.fill), (wet, 0.88)):
            lost = [np.isnan(frame_of(config, flat(200.0), seed)) for seed in range(5)]
            assert 1 - np.mean(lost) == pytest.approx(fill, abs=0.015)


def test_stereo_loses_edges_by_the_published_law():
    """Depths that rise by a factor e in one radian over 29.4 are seen half as often."""
    config = simulated("d405-measured")
    width, focal_px = 24, 400.0
    for slope, part in ((29.4, 2.0), (1e-6, 1.0), (58.8, 1 + 2**0.99)):
        along = 100 * np.exp(slope * np.arange(width) / focal_px)
        frame = DepthFrame(
            np.tile(along, (400, 1)).astype(np.float32),
            Intrinsics(width, 400, focal_px, focal_px, 12.0, 200.0),
        )
        valid = [np.isfinite(frame_of(config, frame, seed))[:, 1:-1] for seed in range(10)]
        assert np.mean(valid) == pytest.approx(config.fill / part, abs=0.03)


def test_time_of_flight_mixes_edges_and_a_dense_matcher_bridges_them():
    u = np.arange(848)
    near, far = flat(300.0), flat(360.0)
    edge = near.with_depth(np.where(u < 400, near.depth_mm, far.depth_mm))
    config = replace(without_steps("azure-kinect"), temporal_mm=(), frozen_mm=())
    mixed = (frame_of(config, edge) - 300) > 0.01
    reach = round(config.edge_px * 848 / config.native_px)
    assert mixed[:, 400 - reach : 400].mean() == pytest.approx(config.flying_share, abs=0.05)
    assert not mixed[:, : 400 - reach].any()
    ended = near.with_depth(np.where(u < 400, near.depth_mm, np.float32(np.nan)))
    for name in ("zed", "endoscope"):
        config = replace(without_steps(name), temporal_px=0.0, frozen_px=0.0)
        reach = round(config.bridge_px * 848 / config.native_px)
        row = frame_of(config, edge)[100]
        assert (np.diff(row) >= -1e-3).all()
        assert ((row > 301) & (row < 359)).sum() >= reach
        beyond = frame_of(config, ended)[100]
        assert np.isfinite(beyond).sum() == 400 + reach
        np.testing.assert_allclose(beyond[: 400 + reach], 300, atol=1e-3)


@pytest.mark.parametrize("name", FIGURES)
def test_nothing_is_seen_nearer_than_it_sees(name):
    nearest_mm = simulated(name).nearest_mm
    found = frame_of(simulated(name), seen(424, max(nearest_mm - 5, 20.0)))
    assert np.nanmin(found) >= max(nearest_mm, 1)
    pose = SimulateOptions(sensor=name).scene_config().pose
    assert pose.nearest_mm[0] > nearest_mm


def test_older_sensors_are_what_they_were():
    """Models are calibrated on them."""
    assert simulated("d405") is D405_NOISE
    assert simulated("stereo") is STEREO_NOISE
    config = SimulateOptions().scene_config()
    assert config.pose.nearest_mm == (110, 125)
    assert (config.cloud.near_mm, config.cloud.far_mm) == (110, 150)


@pytest.mark.parametrize("name", ["d405", "stereo"])
def test_they_have_no_units(name):
    for option in ({"uncalibrated": True}, {"tissue": True}):
        with refused(InputError, name):
            simulated(name, **option)
    with refused(InputError, "kinect2"):
        simulated("kinect2")


def test_simulate_writes_scenes_of_another_camera(phantom_case, tmp_path):
    scenes = tmp_path / "scenes"
    asked = ("simulate", phantom_case, scenes, "--scenes", 1, "--seed", 3, "--sensor", "d435")
    succeeded(tumortrack(*asked, "--uncalibrated"))
    scene = read_scene(scenes / "0000")
    depth_mm = scene.depth.depth_mm
    known = depth_mm[np.isfinite(depth_mm)]
    assert known.min() >= simulated("d435").nearest_mm
    np.testing.assert_allclose(known, np.rint(known), atol=1e-3)
    noise = scene.meta["config"]["noise"]
    assert (noise["unit"], noise["calibrated"]) == (3, False)
    assert noise["temporal_px"] == FIGURES["d435"]["temporal_px"][0]


def test_a_cameras_error_is_stated_in_mm_or_by_its_kind():
    assert LocateOptions().stated_error is None
    assert LocateOptions(depth_error="0.5").stated_error == (0.5, 0.0)
    assert depth_error_of("0.5") == (0.5, 0.0)
    assert depth_error_of("d405-measured") == (5.0, 0.02)
    assert depth_error_of("azure-kinect") == (25.0, 0.001)  # 10, and 15 of tissue
    for wrong in ("-1", "30", "nan", "d999"):
        with refused(InputError, wrong):
            depth_error_of(wrong)


def test_only_a_calibrated_camera_is_stated_to_be_right():
    assert D405_NOISE.depth_error == (0.0, 0.0)
    assert simulated("d435").depth_error == (0.0, 0.0)
    assert simulated("d435", uncalibrated=True).depth_error is None
    assert simulated("azure-kinect", tissue=True).depth_error is None
