"""The virtual CT scanner."""

import msgspec
import numpy as np
import pytest
from scipy import ndimage

from phantom_objects import FIRST, QUICK_SCAN, VOXEL, first_labels
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.core.types import LabelVolume
from tumortrack.phantom.scanner import ScannerParameters, scan
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


def test_partial_volume_rim_has_the_width_of_the_blur():
    """A flat wall's 16 to 84 % rise is two sigmas of the blur, whatever the direction."""
    from scipy.special import ndtri

    wall = np.zeros((80, 50, 50), np.uint8)
    wall[20:60, 5:-5, 5:-5] = 1
    source = LabelVolume(wall, np.diag([0.5, 0.5, 0.5, 1.0]))
    parameters = ScannerParameters(
        spacing_mm=(0.4, 0.5, 0.6), psf_sigma_mm=0.9, noise_hu=0.0, table_thickness_mm=0.0
    )
    ct = scan(source, parameters, 0)
    at = np.linspace(-3, 3, 61)
    points = np.stack([9.75 + at, np.full(61, 12.0), np.full(61, 12.0)], 1)
    share = (read_at(ct, points, order=1) + 1000) / 1040
    rising = (share > 0.05) & (share < 0.95)
    slope, offset = np.polyfit(at[rising], ndtri(share[rising]), 1)
    assert 1 / slope == pytest.approx(np.hypot(0.9, 0.4 / 12**0.5), rel=0.08)
    assert -offset / slope == pytest.approx(0, abs=0.05)  # the wall stays where it was


def test_the_block_is_blurred_by_the_voxel_too():
    """A tilted grid meets the block's face at every phase: the rise is that of the full blur."""
    from scipy.special import ndtri

    source = LabelVolume(np.ones((20, 20, 60)), np.eye(4))
    parameters = ScannerParameters(
        spacing_mm=(1.5, 0.5, 0.5), psf_sigma_mm=0.3, noise_hu=0.0, tilt_deg=(0.0, 0.0, 10.0)
    )
    ct = scan(source, parameters, 0)
    points = lps_of(ct, np.indices(ct.hu.shape).reshape(3, -1).T)
    face = -1 - parameters.block_gap_mm  # the label map's box begins one empty voxel before 0
    near = (np.abs(points - [face, 8, 25]) < [4, 6, 10]).all(1)
    at, share = points[near, 0] - face, (ct.hu.ravel()[near] + 1000) / 1340
    rising = (share > 0.05) & (share < 0.95)
    slope, offset = np.polyfit(at[rising], ndtri(share[rising]), 1)
    cosine, sine = np.cos(np.deg2rad(10)), np.sin(np.deg2rad(10))
    blur = np.sqrt(0.3**2 + ((1.5 * cosine) ** 2 + (0.5 * sine) ** 2) / 12)
    assert -1 / slope == pytest.approx(blur, rel=0.03)
    assert -offset / slope == pytest.approx(0, abs=0.03)


def test_table_and_block_are_there_and_apart_from_the_phantom(ct, labels):
    parts, count = ndimage.label(ct.hu > -300)
    sizes = np.bincount(parts.ravel())[1:] * spacing_mm(ct.lps_from_index).prod() / 1000
    large = np.flatnonzero(sizes > 1) + 1
    assert count >= 3
    assert len(large) == 3
    objects = {}
    for n in large:
        mask = parts == n
        name = {40: "phantom", 340: "block", -80: "table"}[
            min((40, 340, -80), key=lambda hu, m=mask: abs(np.median(ct.hu[m]) - hu))
        ]
        objects[name] = lps_of(ct, np.argwhere(mask))
    body_low, body_high = (objects["phantom"].min(0), objects["phantom"].max(0))
    assert objects["table"].min(0)[1] > body_high[1] + 2  # posterior of the phantom
    assert np.all(np.ptp(objects["table"], axis=0)[[0, 2]] > (body_high - body_low)[[0, 2]])
    assert objects["block"].max(0)[0] < body_low[0] - 8  # on the patient's right
    assert np.allclose(np.ptp(objects["block"], axis=0), (21, 21, 39), atol=2.5)


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
    with pytest.raises(InputError, match="empty"):
        scan(LabelVolume(np.zeros((4, 4, 4)), np.eye(4)), ScannerParameters(), 0)
    big = LabelVolume(labels.labels, labels.lps_from_index @ np.diag([9.0, 9, 9, 1]))
    with pytest.raises(InputError, match="400 million"):
        scan(big, ScannerParameters(), 0)


@pytest.mark.slow
def test_a_patients_label_map_can_be_scanned(shared_data):
    import nibabel

    image = nibabel.load(shared_data / "kits19" / "case_00002" / "segmentation.nii.gz")
    labels = LabelVolume(
        np.asarray(image.dataobj).astype(np.uint8), np.diag([-1.0, -1, 1, 1]) @ image.affine
    )
    ct = scan(labels, ScannerParameters(spacing_mm=(1.5, 1.5, 1.5)), seed=0)
    assert ct.hu.size < 0.5 * labels.labels.size  # cropped round the organ
    inside = ndimage.binary_erosion(labels.labels == 2, iterations=4)
    tumor = lps_of(labels, np.argwhere(inside))
    assert len(tumor) > 1000
    assert np.median(read_at(ct, tumor, 1)) == pytest.approx(570, abs=3)
