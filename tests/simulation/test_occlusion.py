"""What hides the organ in training, and cameras out of calibration: shares, places, replay."""

import math

import numpy as np
import pytest

from depth_objects import SMALL, dome, wall
from refused import refused
from render_objects import anatomy
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.depth_kernels import seen_pixels
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame
from tumortrack.simulation.clutter import ClutterConfig
from tumortrack.simulation.noise import D405_NOISE, CalibrationConfig, miscalibrate
from tumortrack.simulation.occlusion import OcclusionConfig, occlude, order_shaft, take_first
from tumortrack.simulation.scene import SceneConfig, SceneRecipe, Simulator

HIDING = OcclusionConfig(scenes=1.0, largest_share=0.6)
ANATOMY = anatomy(3)
UP = (0.0, -1.0, 0.0)


def hidden(seed, config=HIDING, frame=None):
    """Depths before and after, and which pixels lost the organ."""
    frame = frame or dome()
    before, after = frame.depth_mm, occlude(frame, config, np.random.default_rng(seed)).depth_mm
    lost = np.isfinite(before) & ~(after == before)
    return before, after, lost


def test_what_is_hidden_has_no_return_and_the_rest_is_as_it_was():
    shares = []
    for seed in range(200):
        before, after, lost = hidden(seed)
        assert np.isnan(after[lost]).all()
        np.testing.assert_array_equal(after[~lost], before[~lost])
        shares.append(lost.sum() / np.isfinite(before).sum())
    assert max(shares) <= 0.6
    assert max(shares) > 0.55
    assert np.percentile(shares, 25) < 0.2
    # Uniform up to 0.6 has the mean 0.3; shafts alone hide less than drawn.
    assert 0.2 < np.mean(shares) < 0.3


def test_the_first_in_order_are_taken_up_to_a_count():
    order, taken = np.random.default_rng(0).random(20_000, np.float32), np.zeros(20_000, bool)
    taken[:100] = True
    got = take_first(order, taken, 7000)
    assert got == taken[100:].sum()
    assert 7000 - 40 <= got <= 7000  # short of it by less than one of 1024 bins
    assert order[100:][taken[100:]].max() <= order[100:][~taken[100:]].min()
    few = np.full(50, np.inf, np.float32)
    few[:3] = 1.0
    assert take_first(few, np.zeros(50, bool), 10) == 3
    assert take_first(few, np.zeros(50, bool), 2) == 0  # equal ones go together
    assert take_first(np.full(5, np.inf, np.float32), np.zeros(5, bool), 2) == 0


@pytest.mark.parametrize("seed", range(6))
def test_a_shaft_is_as_wide_as_asked_and_ends_at_its_tip(seed):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi)
    towards = np.array([np.cos(angle), np.sin(angle)])
    rows, columns = np.divmod(seen_pixels(dome().depth_mm).pixels, dome().intrinsics.width)
    tip = np.array([SMALL.cx, SMALL.cy])
    order = order_shaft(columns, rows, tip, towards, 7.0, 0.0)
    inside = np.isfinite(order)
    offset = np.stack([columns, rows], axis=1) - tip
    along, across = offset @ towards, np.abs(offset @ [-towards[1], towards[0]])
    assert (across[inside] < 7).all()
    assert (along[inside] > -7).all()
    assert inside[(along > 0) & (across < 6.99)].all()
    assert not inside[(along < 0) & (np.hypot(along, across) > 7.01)].any()
    np.testing.assert_allclose(order[inside], -along[inside], atol=1e-4)  # outermost first


def test_what_is_left_in_lies_before_the_organ():
    config = OcclusionConfig(scenes=1.0, largest_share=0.6, left_in=0.3, nearer_mm=(5.0, 40.0))
    shares, gaps = [], []
    for seed in range(120):
        before, after, lost = hidden(seed, config)
        left = lost & np.isfinite(after)
        shares.append(left.sum() / max(lost.sum(), 1))
        gap = (before - after)[left]
        assert (gap >= 5 - 1e-3).all()
        assert (gap <= 40 + 1e-3).all()
        gaps.extend(gap[:1])
    assert 0.2 < max(shares) <= 0.301
    assert min(gaps) < 12
    assert max(gaps) > 33
    near = DepthFrame(dome().depth_mm - 115, SMALL)  # 5 mm from the camera: nothing fits between
    _, after, _ = hidden(3, config, near)
    assert np.nanmin(after) > 1


def test_occlusion_draws_nothing_when_off_and_leaves_the_generator_alone():
    frame, rng, other = dome(), np.random.default_rng(3), np.random.default_rng(3)
    for off in (OcclusionConfig(), OcclusionConfig(scenes=0.5), OcclusionConfig(largest_share=0.5)):
        assert occlude(frame, off, rng) is frame
    assert miscalibrate(frame, CalibrationConfig(), rng) is frame
    assert rng.spawn(1)[0].random() == other.spawn(1)[0].random()
    occlude(frame, HIDING, rng)
    assert rng.random() == other.random()
    empty = wall(np.nan)
    assert occlude(empty, HIDING, rng) is empty
    half = OcclusionConfig(scenes=0.5, largest_share=0.6)
    assert 30 < sum(hidden(seed, half)[2].any() for seed in range(100)) < 70
    for seed in (1, 2):
        np.testing.assert_array_equal(hidden(seed)[1], hidden(seed)[1])
    assert not np.array_equal(hidden(1)[2], hidden(2)[2])


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        *((OcclusionConfig, {"scenes": 1.1}), (OcclusionConfig, {"largest_share": 0.95})),
        *((OcclusionConfig, {"left_in": math.nan}), (OcclusionConfig, {"shaft_mm": (0.0, 3.0)})),
        *((OcclusionConfig, {"nearer_mm": (9.0, 5.0)}), (CalibrationConfig, {"offset_mm": -1.0})),
        *((CalibrationConfig, {"scale": 0.5}), (CalibrationConfig, {"offset_mm": math.inf})),
        *((SceneConfig, {"cloud_points": (100, 500)}), (SceneConfig, {"cloud_points": (900, 500)})),
    ],
)
def test_what_cannot_be_is_refused_by_name(kind, wrong):
    with refused(InputError, next(iter(wrong))):
        kind(**wrong)


def test_a_camera_out_of_calibration_errs_alike_everywhere():
    frame = dome()
    seen = np.isfinite(frame.depth_mm)
    z = frame.depth_mm[seen].astype(float)
    offsets, factors = [], []
    for seed in range(300):
        config = CalibrationConfig(offset_mm=2.0, scale=0.01)
        out = miscalibrate(frame, config, np.random.default_rng(seed)).depth_mm
        assert np.array_equal(np.isfinite(out), seen)
        factor, offset = np.polyfit(z, out[seen].astype(float), 1)
        np.testing.assert_allclose(factor * z + offset, out[seen], atol=1e-4)
        offsets.append(offset)
        factors.append(factor - 1)
    assert np.abs(offsets).max() == pytest.approx(2.0, abs=0.05)
    assert np.abs(factors).max() == pytest.approx(0.01, abs=3e-4)
    assert np.mean(offsets) == pytest.approx(0, abs=0.2)
    assert np.std(offsets) == pytest.approx(2 / math.sqrt(3), abs=0.12)
    assert abs(np.corrcoef(offsets, factors)[0, 1]) < 0.2


# --- in scenes ---


def recipe(index):
    return SceneRecipe(5, "train", index)


def test_everything_at_once_replays():
    config = SceneConfig(
        clutter=ClutterConfig(scenes=1.0, largest_share=0.05),
        occlusion=OcclusionConfig(scenes=1.0, largest_share=0.6, left_in=0.2),
        calibration=CalibrationConfig(offset_mm=2.0),
        noise=D405_NOISE,
        free_range=1.0,
        free_nearest_mm=(80.0, 300.0),
        cloud_points=(500, 5000),
    )
    assert from_builtins(to_builtins(config), SceneConfig, "here") == config
    one, two = (Simulator(ANATOMY, UP, config) for _ in range(2))
    for index in (2, 0, 1):
        first, second = one.render(recipe(index)), two.render(recipe(index))
        np.testing.assert_array_equal(first.cloud.points_mm, second.cloud.points_mm)
        assert 200 <= len(first.cloud.points_mm) <= 5000
