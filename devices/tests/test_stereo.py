"""Depth from two pictures, against rendered truth; its noise, which simulation uses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import msgspec
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from scipy.special import ndtr

from clock import PATIENCE_S
from depth_objects import SMALL, pixels
from refused import refused
from stereo_objects import endoscope, over_a_table, placed_before
from tumortrack import api
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import DepthFrame
from tumortrack.io.case import load_case
from tumortrack.live.spec import SOURCES
from tumortrack.live.values import Source, SourceEnded, SourceLost
from tumortrack.simulation.noise import (
    CLEAN,
    D405_NOISE,
    STEREO_NOISE,
    NoiseConfig,
    add_noise,
    stereo_noise,
)
from tumortrack.tracking import presets
from tumortrack.tracking.tracker import Tracker, region_for
from tumortrack_devices.stereo import StereoRig, read_calibration


@pytest.fixture(scope="module")
def seen(phantom_case) -> SimpleNamespace:
    """The phantom before an endoscope: what the pair shows, and what is true."""
    case, calibration = load_case(phantom_case), endoscope()
    left_from_ct = placed_before(case.anatomy.organ, case.up_lps, 105.0, 20.0)
    scene = over_a_table(case.anatomy.organ, left_from_ct)
    rig = StereoRig(calibration)
    way = np.eye(4)
    way[:3, :3] = rig.rectified_from_left
    left, right = rig.rectified(*scene.pictures(calibration))
    true_mm = scene.depth(rig.intrinsics, way).depth_mm
    organ_mm = scene.depth_of(0, rig.intrinsics, way).depth_mm
    return SimpleNamespace(
        **{"case": case, "rig": rig, "left": left, "right": right, "true_mm": true_mm},
        frame=rig.depth(left, right, 7),
        on=organ_mm <= true_mm,
        rectified_from_ct=way @ left_from_ct,
    )


def test_depth_is_true_to_a_fraction_of_a_pixel(seen):
    rig, frame = seen.rig, seen.frame
    assert rig.baseline_mm == pytest.approx(np.linalg.norm(endoscope().T))
    assert frame.stamp_ns == 7
    found = seen.on & np.isfinite(frame.depth_mm)
    assert found.sum() > 0.97 * seen.on.sum()
    per_mm = rig.intrinsics.fx * rig.baseline_mm
    off_px = (per_mm / frame.depth_mm - per_mm / seen.true_mm)[found]
    assert abs(np.median(off_px)) < 0.1
    assert np.median(np.abs(off_px)) < 0.25
    assert (np.abs(off_px) > 2).mean() < 0.02
    # What docs/method.md says of the noise: 0.2 to 0.35 px, shared by neighbours.
    inner = distance_transform_edt(seen.on) > 12
    noise = np.where(inner, per_mm / frame.depth_mm - per_mm / seen.true_mm, np.nan)
    noise -= np.nanmean(noise)
    assert 0.15 < np.nanstd(noise) < 0.4
    shared = np.nanmean(noise[:, 5:] * noise[:, :-5]) / np.nanvar(noise)
    assert shared > 0.6


def test_the_nearer_surface_spreads_as_the_noise_model_says(seen):
    spread_px = 4.5  # docs/method.md, at this focal length
    distance = distance_transform_edt(~seen.on)
    fat = seen.frame.depth_mm < seen.true_mm - 8
    for k in (2, 4, 6):
        there = (distance >= k - 1) & (distance < k + 1)
        assert fat[there].mean() == pytest.approx(2 * ndtr(-k / spread_px), abs=0.12)


def test_pictures_of_another_size_are_refused(seen, unchecked):
    with refused(InputError, "640 x 480"):
        seen.rig.rectified(seen.left[1:], seen.right)


@pytest.mark.slow
def test_the_organ_is_located_by_it(seen, elastic_model):
    """The model learnt for seconds, and for a D405; only the unevenness to expect is stereo's."""
    model = api.load_model(elastic_model, "cpu")
    scene = msgspec.structs.replace(model.config.scene, noise=STEREO_NOISE)
    model = replace(model, config=msgspec.structs.replace(model.config, scene=scene))
    assert region_for(model).noise_mm == STEREO_NOISE.axial_mm
    organ = api.find_organ(seen.frame, model=model)
    estimate = Tracker(model).locate(organ, grid=16, full_view=seen.frame)
    for name, part in zip(model.parts, seen.case.anatomy.parts, strict=True):
        true_mm = transform_points(seen.rectified_from_ct, part.vertices_mm).mean(0)
        assert np.linalg.norm(estimate.meshes[name].vertices_mm.mean(0) - true_mm) < 3.0, name


@pytest.mark.parametrize("suffix", ["yaml", "json", "plain.json"])
def test_a_calibration_of_opencv_s_is_read(tmp_path, suffix):
    file, calibration = tmp_path / f"stereo.{suffix}", endoscope()
    if suffix == "plain.json":
        file.write_bytes(msgspec.json.encode(calibration))
    else:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
        storage.write("width", calibration.width)
        storage.write("height", calibration.height)
        storage.write("E", np.eye(3))  # what else cv2.stereoCalibrate gives
        for name in ("K1", "D1", "K2", "D2", "R", "T"):
            value = np.array(getattr(calibration, name))
            storage.write(name, value.reshape(len(value), -1))
        storage.release()
    assert read_calibration(file) == calibration


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        '<?xml version="1.0"?><opencv_storage></opencv_storage>',
        "%YAML:1.0\n---\nwidth: 640\n",
        '{"K1": 3}',
        '{"K1": {"a": 1}}',
        '{"D1": [1, [2, 3]]}',
        '{"K1": ' + "[" * 100_000,
        "%YAML:1.0\n---\nK1: !!opencv-matrix\n   rows: 30000\n   cols: 30000\n   dt: d\n"
        "   data: [ 1. ]\n",
    ],
)
def test_a_file_that_is_no_calibration_is_refused(tmp_path, text):
    (file := tmp_path / "stereo.yaml").write_text(text)
    with refused(InputError, file):
        read_calibration(file)


@pytest.mark.parametrize(
    "changed",
    [
        {"T": (-0.0044, 0.0, 0.0)},  # metres
        {"T": (-4.4, 0.0, 0.0), "unit": "m"},  # mm
        {"T": (4.4, 0.0, 0.0)},  # exchanged
        {"T": (0.0, -4.4, 0.0)},  # above each other
        {"R": ((1.0, 0, 0), (0, 0, -1.0), (0, 1.0, 0))},
        {"R": ((2.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))},
        {"K1": ((5.0, 0, 320), (0, 5.0, 240), (0, 0, 1.0))},
        {"D1": (0.1, 0.2)},
    ],
)
def test_a_pair_that_cannot_be_is_refused(changed):
    (name,) = changed.keys() - {"unit"}
    with refused(InputError, *({name} - {"D1"})):
        StereoRig(msgspec.structs.replace(endoscope(), **changed))


def test_things_too_near_to_be_matched_are_refused():
    with refused(InputError, "near_mm=2 "):
        StereoRig(endoscope(), near_mm=2.0)


def test_noise_follows_from_baseline_focal_length_and_matches():
    """A disparity of z f b errs by s, so depth errs by z^2 s / (f b)."""
    noise = stereo_noise(500.0, 5.0, 0.2)
    assert noise.axial_mm == pytest.approx(150.0**2 * 0.2 / 2500)
    depth_mm = np.full((SMALL.height, SMALL.width), 100.0)
    alone = NoiseConfig(axial_mm=noise.axial_mm, correlated_share=0.5)
    seen = add_noise(DepthFrame(depth_mm, SMALL), alone, np.random.default_rng(0)).depth_mm
    assert np.std(seen) == pytest.approx(100.0**2 * 0.2 / 2500, rel=0.03)


def test_a_nearer_surface_spreads_over_an_edge_and_a_slope_does_not():
    u, _ = pixels(SMALL)
    noise = NoiseConfig(fatten_px=3.0)
    frame = DepthFrame(np.where(u < 200, 120.0, 160.0), SMALL)
    fat = np.mean(
        [add_noise(frame, noise, np.random.default_rng(n)).depth_mm == 120.0 for n in range(20)],
        axis=(0, 1),
    )
    assert (fat[:200] == 1).all()
    for k in (1, 3, 6):  # pixels beyond the edge
        assert fat[199 + k] == pytest.approx(2 * ndtr(-(k - 0.5) / 3.0), abs=0.08)
    slope = DepthFrame(100.0 + 1.5 * u, SMALL)
    np.testing.assert_array_equal(
        add_noise(slope, noise, np.random.default_rng(0)).depth_mm, slope.depth_mm
    )


def test_what_the_right_camera_does_not_see_is_lost():
    """Disparities of 1200 px mm are 12 px on a wall 100 mm away and 6 px at 200 mm: the nearer one
    hides the columns to its left, those that it reaches by half a pixel and more; and the leftmost
    6 lie outside the right picture."""
    u, _ = pixels(SMALL)
    frame = DepthFrame(np.where((u >= 200) & (u < 300), 100.0, 200.0), SMALL)
    noise = NoiseConfig(shadow_px_mm=1200.0)
    lost = np.isnan(add_noise(frame, noise, np.random.default_rng(0)).depth_mm)
    assert (lost == lost[0]).all()
    np.testing.assert_array_equal(lost[0].nonzero()[0], [*range(6), *range(195, 200)])


def test_a_preset_s_scenes_can_be_those_of_stereo(phantom_case):
    anatomy = load_case(phantom_case).anatomy
    elastic = presets.elastic(anatomy)
    assert presets.seen_by(elastic, "d405") == elastic
    stereo = presets.seen_by(elastic, "stereo")
    assert stereo.scene.noise == STEREO_NOISE != D405_NOISE
    assert msgspec.structs.replace(stereo.scene, noise=D405_NOISE) == elastic.scene
    clean = msgspec.structs.replace(elastic.scene, noise=CLEAN)
    with pytest.raises(InputError):
        presets.seen_by(msgspec.structs.replace(elastic, scene=clean), "stereo")


NARROW = endoscope(320, 240, 260.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three pairs of a wall with a random texture, 6, 7 and 8 pixels apart, of straight lenses."""
    folder = tmp_path_factory.mktemp("stereo")
    matrix = ((260.0, 0, 160), (0, 260.0, 120), (0, 0, 1))
    straight = msgspec.structs.replace(
        NARROW, K1=matrix, K2=matrix, D1=(0.0,) * 5, D2=(0.0,) * 5,
        R=((1, 0, 0), (0, 1, 0), (0, 0, 1)), T=(-4.0, 0.0, 0.0),
    )  # fmt: skip
    (folder / "stereo.json").write_bytes(msgspec.json.encode(straight))
    fine = np.random.default_rng(0).normal(128, 60, (240, 340, 3))
    wall = np.clip(cv2.GaussianBlur(fine, (0, 0), 1.2) * 2 - 128, 0, 255).astype(np.uint8)
    for n in range(3):
        cv2.imwrite(str(folder / f"left_{n:04d}.png"), wall[:, :320])
        cv2.imwrite(str(folder / f"right_{n:04d}.png"), wall[:, 6 + n : 326 + n])
    return folder


def spec(folder, left="left_%04d.png", right="right_%04d.png", more=""):
    return f"stereo:{folder / left},{folder / right}?calibration={folder / 'stereo.json'}{more}"


def test_every_pair_becomes_a_depth_image_with_the_left_picture(folder):
    source = SOURCES.parse(spec(folder, more="&fps=10&far_mm=1000")).open()
    assert isinstance(source, Source)
    assert source.lossless
    assert not source.host_clock
    for n in range(3):
        seen = source.read(PATIENCE_S)
        assert seen.stamp_ns == n * 100_000_000
        depth_mm = seen.content.depth_mm
        inner = depth_mm[20:-20, 60:-20]
        assert np.isfinite(inner).mean() > 0.9
        assert np.nanmedian(inner) == pytest.approx(260 * 4 / (6 + n), rel=0.01)
        blue_first = cv2.imread(str(folder / f"left_{n:04d}.png"))
        off = np.abs(seen.picture[..., ::-1].astype(int) - blue_first)
        assert np.median(off[20:-20, 20:-20]) <= 2  # red first, in the depth image's pixels
    for _ in range(2):
        with refused(SourceEnded, 3):
            source.read(PATIENCE_S)
    source.close()
    source.close()
    with pytest.raises(SourceLost):
        source.read(0)


@pytest.mark.parametrize(
    "text",
    [
        "left.avi?calibration=x",
        "0,left.avi?calibration=x",
        "0,1",
        "0,1?calibration=x&near_mm=400&far_mm=50",
        "0,1?calibration=x&block_px=8",
        "0,1?calibration=x&block_px=1",
    ],
)
def test_what_can_be_no_pair_is_refused(text):
    with pytest.raises(InputError):
        SOURCES.parse(f"stereo:{text}")


def test_what_is_not_there_is_said_by_us_alone(folder, capfd):
    with refused(InputError, "nowhere.avi"):
        SOURCES.parse(spec(folder, left="nowhere.avi")).open()
    with refused(SourceLost, "/dev/video97"):
        SOURCES.parse(f"stereo:97,98?calibration={folder / 'stereo.json'}").open()
    with refused(InputError, "/nowhere/stereo.json"):
        SOURCES.parse("stereo:97,98?calibration=/nowhere/stereo.json").open()
    assert capfd.readouterr() == ("", "")
