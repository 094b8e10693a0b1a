"""The virtual CT scanner."""

import msgspec
import numpy as np
import pytest
from scipy import ndimage
from scipy.special import ndtri

from phantom_objects import FIRST, QUICK_SCAN, VOXEL, first_labels
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.core.types import LabelVolume
from tumortrack.simulation.phantom.scanner import ScannerParameters, scan
from volume_points import lps_of, read_at


@pytest.fixture(scope="module")
def labels():
    return first_labels()


@pytest.fixture(scope="module")
def ct(labels):
    return scan(labels, ScannerParameters(spacing_mm=(0.8, 0.8, 1.0)), seed=3)


@pytest.fixture(scope="module")
def oblique(labels):
    return scan(labels, QUICK_SCAN, seed=3)


def scanned_labels(ct, labels):
    """The label of each CT voxel centre, and how far it lies from any boundary (mm)."""
    index = np.indices(ct.hu.shape).reshape(3, -1).T
    at = np.nan_to_num(read_at(labels, lps_of(ct, index))).reshape(ct.hu.shape)
    spacing = spacing_mm(ct.lps_from_index)
    deep = np.zeros(at.shape)
    for n in range(4):
        deep = np.maximum(deep, ndimage.distance_transform_edt(at == n, sampling=spacing))
    return at, deep


@pytest.mark.slow
@pytest.mark.parametrize("which", ["ct", "oblique"])
def test_hu_and_noise_of_each_class(which, labels, request):
    volume = request.getfixturevalue(which)
    at, deep = scanned_labels(volume, labels)
    for n, hu in ((1, 40), (2, 570), (3, 570)):
        inside = volume.hu[(at == n) & (deep > 4)]
        assert len(inside) > 1000
        assert inside.mean() == pytest.approx(hu, abs=1)
        assert inside.std() == pytest.approx(14, rel=0.05)
    assert np.percentile(volume.hu, 10) == pytest.approx(-1000, abs=25)
    assert volume.hu.min() >= -1024
    assert volume.hu.max() <= 3071
    assert np.array_equal(volume.hu, np.rint(volume.hu))


def test_noise_is_a_little_correlated(labels):
    quiet = ScannerParameters(spacing_mm=(1.0, 1.0, 1.5), noise_hu=0.0)
    noisy = msgspec.structs.replace(quiet, noise_hu=14.0)
    white = msgspec.structs.replace(noisy, noise_correlation_voxels=0.0)
    clear = scan(labels, quiet, 1).hu
    safe = clear > -900  # where the scanner's floor of -1024 clips nothing
    pair = safe[1:] & safe[:-1]
    shares = []
    for parameters in (noisy, white):
        noise = scan(labels, parameters, 1).hu - clear
        assert noise[safe].std() == pytest.approx(14, rel=0.02)
        shares.append(np.corrcoef(noise[1:][pair], noise[:-1][pair])[0, 1])
    # White noise through a Gaussian of 0.7 voxels: exp(-1 / (4 * 0.7^2)) = 0.60 next door.
    assert shares[0] == pytest.approx(0.60, abs=0.04)
    assert abs(shares[1]) < 0.02


def test_the_same_seed_gives_the_same_scan(labels):
    parameters = ScannerParameters(spacing_mm=(2.0, 2.0, 2.0))
    one, same, other = (scan(labels, parameters, seed).hu for seed in (5, 5, 6))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def rise(share, at):
    """Where a blurred edge lies, and the standard deviation of its blur."""
    rising = (share > 0.05) & (share < 0.95)
    slope, offset = np.polyfit(at[rising], ndtri(share[rising]), 1)
    return -offset / slope, 1 / slope


def test_partial_volume_rim_has_the_width_of_the_blur():
    """A flat wall's 16 to 84 % rise is two sigmas of the blur, whatever the direction."""
    wall = np.zeros((80, 50, 50), np.uint8)
    wall[20:60, 5:-5, 5:-5] = 1
    parameters = ScannerParameters(
        spacing_mm=(0.4, 0.5, 0.6), psf_sigma_mm=0.9, noise_hu=0.0, table_thickness_mm=0.0
    )
    ct = scan(LabelVolume(wall, np.diag([0.5, 0.5, 0.5, 1.0])), parameters, 0)
    at = np.linspace(-3, 3, 61)
    points = np.stack([9.75 + at, np.full(61, 12.0), np.full(61, 12.0)], 1)
    place, sigma = rise((read_at(ct, points, order=1) + 1000) / 1040, at)
    assert sigma == pytest.approx(np.hypot(0.9, 0.4 / 12**0.5), rel=0.08)
    assert place == pytest.approx(0, abs=0.05)  # the wall stays where it was


def test_the_block_is_blurred_by_the_voxel_too():
    """A tilted grid meets the block's face at every phase: the rise is that of the full blur."""
    parameters = ScannerParameters(
        spacing_mm=(1.5, 0.5, 0.5), psf_sigma_mm=0.3, noise_hu=0.0, tilt_deg=(0.0, 0.0, 10.0)
    )
    ct = scan(LabelVolume(np.ones((20, 20, 60)), np.eye(4)), parameters, 0)
    points = lps_of(ct, np.indices(ct.hu.shape).reshape(3, -1).T)
    face = -1 - parameters.block_gap_mm  # the label map's box begins one empty voxel before 0
    near = (np.abs(points - [face, 8, 25]) < [4, 6, 10]).all(1)
    place, sigma = rise((ct.hu.ravel()[near] + 1000) / 1340, points[near, 0] - face)
    cosine, sine = np.cos(np.deg2rad(10)), np.sin(np.deg2rad(10))
    blur = np.sqrt(0.3**2 + ((1.5 * cosine) ** 2 + (0.5 * sine) ** 2) / 12)
    assert -sigma == pytest.approx(blur, rel=0.03)
    assert place == pytest.approx(0, abs=0.03)


def test_table_and_block_are_there_and_apart_from_the_phantom(ct):
    parts, _ = ndimage.label(ct.hu > -300)
    sizes = np.bincount(parts.ravel())[1:] * spacing_mm(ct.lps_from_index).prod() / 1000
    masks = [parts == n for n in np.flatnonzero(sizes > 1) + 1]
    masks.sort(key=lambda mask: np.median(ct.hu[mask]))  # -80, 40 and 340 HU
    table, body, block = (lps_of(ct, np.argwhere(mask)) for mask in masks)
    assert table.min(0)[1] > body.max(0)[1] + 2  # posterior of the phantom
    assert np.all(np.ptp(table, axis=0)[[0, 2]] > np.ptp(body, axis=0)[[0, 2]])
    assert block.max(0)[0] < body.min(0)[0] - 8  # on the patient's right
    assert np.allclose(np.ptp(block, axis=0), (21, 21, 39), atol=2.5)


def test_objects_can_be_left_out(labels):
    parameters = ScannerParameters(
        spacing_mm=(1.5, 1.5, 1.5), table_thickness_mm=0.0, block_size_mm=(0.0, 0.0, 0.0)
    )
    assert ndimage.label(scan(labels, parameters, 0).hu > -300)[1] == 1


def test_every_scanner_parameter_is_read(labels):
    plain = ScannerParameters(spacing_mm=(3.0, 3.0, 3.0))
    before = scan(labels, plain, 0)
    for key in plain.__struct_fields__:
        value = getattr(plain, key)
        value = tuple(v * 1.2 + 1 for v in value) if isinstance(value, tuple) else value * 1.2 + 1
        after = scan(labels, msgspec.structs.replace(plain, **{key: value}), 0)
        same = before.hu.shape == after.hu.shape and np.array_equal(before.hu, after.hu)
        assert not same, key


def test_an_oblique_scan_shows_the_same_body(ct, oblique):
    assert not np.allclose(np.abs(oblique.lps_from_index[:3, :3]).max(0), QUICK_SCAN.spacing_mm)
    assert np.allclose(spacing_mm(oblique.lps_from_index), QUICK_SCAN.spacing_mm)
    points = np.random.default_rng(0).uniform(-32, 32, (5000, 3)) + FIRST.center_lps_mm
    difference = read_at(ct, points, 1) - read_at(oblique, points, 1)
    assert np.isfinite(difference).all()
    assert np.median(np.abs(difference)) < 25  # noise of two scans
    assert np.mean(np.abs(difference) > 150) < 0.02  # rims of another spacing


def test_a_label_map_in_any_index_order_gives_the_same_scan(labels):
    """As KiTS stores them: slice axis first, axes running backwards, left-handed."""
    turned = np.zeros((4, 4))
    n = np.array(labels.labels.shape)
    array = labels.labels.transpose(2, 1, 0)[::-1]
    turned[2, 0], turned[1, 1], turned[0, 2], turned[3, 3] = -VOXEL, VOXEL, VOXEL, 1
    turned[:3, 3] = labels.lps_from_index[:3, 3] + [0, 0, VOXEL * (n[2] - 1)]
    parameters = ScannerParameters(spacing_mm=(1.2, 1.2, 1.2), noise_hu=0.0)
    one, other = (scan(v, parameters, 0) for v in (labels, LabelVolume(array, turned)))
    assert np.allclose(one.lps_from_index, other.lps_from_index)
    assert np.abs(one.hu - other.hu).max() <= 1


def test_scanner_refuses_nothing_and_too_much(labels):
    big = LabelVolume(labels.labels, labels.lps_from_index @ np.diag([9.0, 9, 9, 1]))
    for volume in (LabelVolume(np.zeros((4, 4, 4)), np.eye(4)), big):
        with pytest.raises(InputError):
            scan(volume, ScannerParameters(), 0)
    for wrong in (
        {"psf_sigma_mm": np.nan}, {"block_size_mm": (-1.0, 2.0, 3.0)},
        {"tilt_deg": (np.nan, 0.0, 0.0)}, {"spacing_mm": (0.0, 1.0, 1.0)},
    ):  # fmt: skip
        with refused(InputError, str(*wrong)):
            ScannerParameters(**wrong)
