"""The built-in phantom: its geometry, the virtual CT scanner, and its files."""

import itertools

import msgspec
import numpy as np
import pytest
from scipy import ndimage

from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm, transform_points
from tumortrack.core.types import LabelVolume, Volume
from tumortrack.phantom.dicom import write_dicom_series, write_nifti
from tumortrack.phantom.digital import (
    PhantomParameters,
    TumorParameters,
    organ_mask,
    phantom_labels,
    second_phantom,
)
from tumortrack.phantom.sampling import placements, random_phantom
from tumortrack.phantom.scanner import ScannerParameters, scan

VOXEL = 1.0
FIRST = PhantomParameters()
QUICK_SCAN = ScannerParameters(spacing_mm=(1.0, 1.1, 1.3), tilt_deg=(12.0, -8.0, 20.0))


@pytest.fixture(scope="module")
def labels():
    return phantom_labels(FIRST, VOXEL)


@pytest.fixture(scope="module")
def ct(labels):
    return scan(labels, ScannerParameters(spacing_mm=(0.8, 0.8, 1.0)), seed=3)


@pytest.fixture(scope="module")
def oblique(labels):
    return scan(labels, QUICK_SCAN, seed=3)


def box_mm(mask, lps_from_index):
    index = np.argwhere(mask)
    return (index.max(0) - index.min(0) + 1) * spacing_mm(lps_from_index)


def read_at(volume, points_lps_mm, order=0):
    """Values of a volume at points given in LPS."""
    values = volume.hu if isinstance(volume, Volume) else volume.labels
    index = transform_points(np.linalg.inv(volume.lps_from_index), points_lps_mm)
    return ndimage.map_coordinates(
        values.astype(float), index.T, order=order, mode="constant", cval=np.nan
    )


def lps_of(volume, index):
    return transform_points(volume.lps_from_index, np.asarray(index, float))


# ---------------------------------------------------------------- geometry


def test_the_organ_fills_the_stated_box():
    for parameters in (FIRST, second_phantom()):
        axes = (np.arange(-70.0, 70, 1.0),) * 3
        organ = organ_mask(parameters, axes)
        assert np.abs(box_mm(organ, np.eye(4)) - parameters.size_mm).max() <= 1.5
        assert ndimage.label(organ)[1] == 1
        edge = np.argwhere(organ)[:, 0]
        assert abs(axes[0][[edge.min(), edge.max()]].mean()) <= 1  # centred


def test_labels_are_ordered_by_size_and_the_diameters_are_as_stated(labels):
    volumes = np.bincount(labels.labels.ravel())[2:] * VOXEL**3
    assert np.allclose((6 / np.pi * volumes) ** (1 / 3), [38, 32], atol=0.4)
    for n, diameter in ((2, 38), (3, 32)):
        tumor = labels.labels == n
        assert ndimage.label(tumor)[1] == 1
        assert np.abs(box_mm(tumor, labels.lps_from_index) - diameter).max() <= 2 * VOXEL


def test_a_tumor_is_lobulated_yet_its_diameters_agree():
    ball = TumorParameters(diameter_mm=38.0, center_mm=(-3.0, 1.0, 17.0), lobulation=0.0)
    lobed = msgspec.structs.replace(ball, lobulation=0.1)
    masks = [
        phantom_labels(PhantomParameters(tumors=(t,)), VOXEL).labels == 2 for t in (ball, lobed)
    ]
    overlap = (masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum()
    assert 0.8 < overlap < 0.97


def test_endophytic_is_covered_and_exophytic_half_outside(labels):
    # By labels alone: what is outside the organ's own surface is measured on a tumor-free phantom.
    bare = phantom_labels(msgspec.structs.replace(FIRST, tumors=()), VOXEL)
    points = lps_of(labels, np.argwhere(labels.labels == 3))
    outside = np.nan_to_num(read_at(bare, points)) == 0
    assert 0.4 < outside.mean() < 0.6
    deep = ndimage.distance_transform_edt(labels.labels > 0, sampling=VOXEL)
    assert deep[labels.labels == 2].min() >= 2
    endophytic, exophytic = placements(FIRST)
    assert endophytic.outside_share == 0
    assert endophytic.cover_mm >= 2
    assert exophytic.outside_share == pytest.approx(outside.mean(), abs=0.02)
    assert exophytic.cover_mm <= 1


def test_tumors_stay_apart(labels):
    for parameters in (FIRST, second_phantom()):
        tumors = phantom_labels(parameters, 1.5)
        for n in range(2, tumors.labels.max() + 1):
            others = (tumors.labels > 1) & (tumors.labels != n)
            gap = ndimage.distance_transform_edt(~others, sampling=1.5)
            assert gap[tumors.labels == n].min() >= 3


def test_the_exophytic_tumor_faces_an_anterior_camera(labels):
    first_seen = (labels.labels > 0).argmax(axis=1)  # along +y: from anterior to posterior
    seen = np.take_along_axis(labels.labels, first_seen[:, None], 1)[:, 0]
    columns = (labels.labels == 3).any(axis=1)
    assert (seen[columns] == 3).mean() > 0.9
    assert not (seen == 2).any()


@pytest.mark.parametrize(("side", "medial"), [("right", 1), ("left", -1)])
def test_the_hilum_is_medial(side, medial):
    bare = phantom_labels(PhantomParameters(tumors=(), side=side), VOXEL)
    # Dents are what a ball of 15 mm cannot reach from outside: closing fills them.
    organ = np.pad(bare.labels > 0, 18)
    near = ndimage.distance_transform_edt(~organ) < 15
    closed = ndimage.distance_transform_edt(near) >= 15
    dent = np.argwhere(closed & ~ndimage.binary_dilation(organ)) - 18
    assert len(dent) > 500
    offset = lps_of(bare, dent)[:, 0] - FIRST.center_lps_mm[0]
    assert (np.sign(offset) == medial).mean() > 0.95


def test_left_is_the_mirror_image_of_right(labels):
    left = phantom_labels(msgspec.structs.replace(FIRST, side="left"), VOXEL)
    points = lps_of(labels, np.argwhere(labels.labels))
    points[:, 0] = 2 * FIRST.center_lps_mm[0] - points[:, 0]
    assert np.array_equal(read_at(left, points), labels.labels[labels.labels > 0])


def test_no_mirror_image_or_half_turn_passes_for_the_organ():
    axes = (np.arange(-60.0, 60.5, 1.5),) * 3
    organ = organ_mask(FIRST, axes)
    for flips in itertools.product((False, True), repeat=3):
        turned = np.flip(organ, [axis for axis in range(3) if flips[axis]])
        overlap = (organ & turned).sum() / (organ | turned).sum()
        assert (overlap == 1) == (not any(flips))
        assert overlap < 0.96 or not any(flips)


def test_every_parameter_is_read():
    changed = {
        "size_mm": (64.0, 50.0, 110.0),
        "bend_mm": 6.0,
        "taper": 0.02,
        "hilum_depth_mm": 8.0,
        "lump_mm": 0.0,
        "shape_seed": 5,
        "tumors": FIRST.tumors[:1],
        "side": "left",
        "center_lps_mm": (0.0, 0.0, 0.0),
    }
    assert set(changed) == set(FIRST.__struct_fields__)
    before = phantom_labels(FIRST, 2.0)
    for key, value in changed.items():
        after = phantom_labels(msgspec.structs.replace(FIRST, **{key: value}), 2.0)
        same = np.array_equal(before.labels, after.labels)
        assert not (same and np.array_equal(before.lps_from_index, after.lps_from_index)), key


def test_parameters_survive_json():
    data = msgspec.json.decode(msgspec.json.encode(to_builtins(second_phantom())))
    assert from_builtins(data, PhantomParameters, "test") == second_phantom()
    with pytest.raises(InputError, match="unknown field"):
        from_builtins({**data, "colour": 3}, PhantomParameters, "test")


def test_refusals():
    near = (TumorParameters(diameter_mm=30.0, center_mm=(0.0, 0.0, 0.0)),) * 2
    with pytest.raises(InputError, match=r"3\.0 mm or more apart"):
        PhantomParameters(tumors=near)
    far = (TumorParameters(diameter_mm=10.0, center_mm=(90.0, 0.0, 0.0)),)
    with pytest.raises(InputError, match="wholly outside"):
        phantom_labels(PhantomParameters(tumors=far), 2.0)
    with pytest.raises(InputError, match=r"0\.2 to 4"):
        phantom_labels(FIRST, 20.0)
    with pytest.raises(InputError, match="20 to 250"):
        PhantomParameters(size_mm=(0.06, 0.05, 0.11))
    with pytest.raises(InputError, match="psf_sigma_mm"):
        ScannerParameters(psf_sigma_mm=float("nan"))
    with pytest.raises(InputError, match="50 million"):
        phantom_labels(PhantomParameters(size_mm=(200.0, 200.0, 200.0)), 0.3)
    with pytest.raises(InputError, match="-200 to 200"):
        TumorParameters(diameter_mm=30.0, center_mm=(0.0, float("nan"), 0.0))
    with pytest.raises(InputError, match="block_size_mm"):
        ScannerParameters(block_size_mm=(-1.0, 2.0, 3.0))
    with pytest.raises(InputError, match="tilt_deg"):
        ScannerParameters(tilt_deg=(float("nan"), 0.0, 0.0))
    with pytest.raises(InputError, match="spacing"):
        ScannerParameters(spacing_mm=(0.0, 1.0, 1.0))


@pytest.mark.parametrize("seed", range(6))
def test_random_phantoms_are_valid_and_replay(seed):
    parameters = random_phantom(seed)
    assert parameters == random_phantom(seed)
    endophytic, *exophytic = placements(parameters, 1.5)
    assert endophytic.outside_share == 0
    assert endophytic.cover_mm >= 2
    assert len(exophytic) >= 1
    assert all(0.3 < tumor.outside_share < 0.7 for tumor in exophytic)
    made = phantom_labels(parameters, 2.0)
    assert ndimage.label(made.labels > 1)[1] == len(parameters.tumors) == made.labels.max() - 1


# ---------------------------------------------------------------- scanner


def scanned_labels(ct, labels):
    """The label of each CT voxel centre, and how far it lies from any boundary (mm)."""
    index = np.indices(ct.hu.shape).reshape(3, -1).T
    at = np.nan_to_num(read_at(labels, lps_of(ct, index))).reshape(ct.hu.shape)
    spacing = spacing_mm(ct.lps_from_index)
    deep = np.zeros(at.shape)
    for n in range(4):
        deep = np.maximum(deep, ndimage.distance_transform_edt(at == n, sampling=spacing))
    return at, deep


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


def test_table_and_block_are_there_and_apart_from_the_phantom(ct, labels):
    parts, count = ndimage.label(ct.hu > -300)
    sizes = np.bincount(parts.ravel())[1:] * spacing_mm(ct.lps_from_index).prod() / 1000
    large = np.flatnonzero(sizes > 1) + 1
    assert count >= 3
    assert len(large) == 3
    found = {}
    for n in large:
        mask = parts == n
        name = {40: "phantom", 340: "block", -80: "table"}[
            min((40, 340, -80), key=lambda hu, m=mask: abs(np.median(ct.hu[m]) - hu))
        ]
        found[name] = lps_of(ct, np.argwhere(mask))
    body_low, body_high = (found["phantom"].min(0), found["phantom"].max(0))
    assert found["table"].min(0)[1] > body_high[1] + 2  # posterior of the phantom
    assert np.all(np.ptp(found["table"], axis=0)[[0, 2]] > (body_high - body_low)[[0, 2]])
    assert found["block"].max(0)[0] < body_low[0] - 8  # on the patient's right
    assert np.allclose(np.ptp(found["block"], axis=0), (21, 21, 39), atol=2.5)


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


# ---------------------------------------------------------------- files


@pytest.fixture(scope="module")
def series(oblique, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dicom") / "series"
    write_dicom_series(oblique, folder, seed=4)
    return folder


def by_simpleitk(image):
    import SimpleITK as sitk  # noqa: N813

    directions = np.array(image.GetDirection()).reshape(3, 3)
    affine = np.eye(4)
    affine[:3, :3] = directions * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return Volume(sitk.GetArrayFromImage(image).transpose(2, 1, 0), affine)


def read_series(folder):
    import SimpleITK as sitk  # noqa: N813

    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    return by_simpleitk(reader.Execute())


def test_dicom_series_reads_back_exactly(series, oblique):
    back = read_series(series)
    assert np.abs(back.lps_from_index - oblique.lps_from_index).max() < 1e-3
    corner = lps_of(back, [np.array(back.hu.shape) - 1])
    assert np.abs(corner - lps_of(oblique, [np.array(oblique.hu.shape) - 1])).max() < 1e-3
    assert np.array_equal(back.hu, oblique.hu)


def test_dicom_headers(series, oblique):
    import pydicom

    slices = [pydicom.dcmread(path) for path in sorted(series.iterdir())]
    assert len(slices) == oblique.hu.shape[2]
    order = [s.InstanceNumber for s in slices]
    assert order != sorted(order)
    assert sorted(order) == list(range(1, len(slices) + 1))
    assert len({s.SOPInstanceUID for s in slices}) == len(slices)
    assert len({s.SeriesInstanceUID for s in slices}) == 1
    one = slices[0]
    assert one.SOPClassUID.name == "CT Image Storage"
    assert (one.Modality, one.PatientPosition) == ("CT", "HFS")
    assert str(one.PatientName) == "PHANTOM^TUMORTRACK"
    assert (one.KVP, one.XRayTubeCurrentInuA) == (90, 13600)
    assert all(np.isclose(one.PixelSpacing, (1.1, 1.0)))  # between rows first


def test_dicom_is_deterministic_by_seed(series, oblique, tmp_path):
    import pydicom

    write_dicom_series(oblique, tmp_path / "same", seed=4)
    write_dicom_series(oblique, tmp_path / "other", seed=5)
    name = "CT00000.dcm"
    assert (tmp_path / "same" / name).read_bytes() == (series / name).read_bytes()
    uids = [pydicom.dcmread(f / name).SeriesInstanceUID for f in (series, tmp_path / "other")]
    assert uids[0] != uids[1]


def test_nifti_and_dicom_agree_in_the_patient(series, oblique, labels, tmp_path):
    import nibabel

    write_nifti(oblique, tmp_path / "ct.nii.gz")
    image = nibabel.load(tmp_path / "ct.nii.gz")
    dicom = read_series(series)
    index = np.random.default_rng(1).integers(1, np.array(oblique.hu.shape) - 1, (500, 3))
    ras = nibabel.affines.apply_affine(image.affine, index)
    hu = np.asarray(image.dataobj)[tuple(index.T)]
    assert np.array_equal(hu, read_at(dicom, ras * [-1, -1, 1]))
    # Not mirrored: the exophytic tumor lies right, anterior and inferior of the endophytic one.
    write_nifti(labels, tmp_path / "labels.nii")
    stored = nibabel.load(tmp_path / "labels.nii")
    centers = [
        nibabel.affines.apply_affine(stored.affine, np.argwhere(stored.get_fdata() == n).mean(0))
        for n in (2, 3)
    ]
    assert np.allclose(centers[1] - centers[0], (14, 16.5, -39), atol=0.5)  # RAS
    assert stored.get_data_dtype() == np.uint8


def test_nifti_is_read_alike_by_simpleitk(oblique, tmp_path):
    import SimpleITK as sitk  # noqa: N813

    write_nifti(oblique, tmp_path / "ct.nii.gz")
    back = by_simpleitk(sitk.ReadImage(str(tmp_path / "ct.nii.gz")))
    assert np.abs(back.lps_from_index - oblique.lps_from_index).max() < 1e-4
    assert np.array_equal(back.hu, oblique.hu)


def test_files_refuse_what_they_cannot_hold(oblique, tmp_path):
    hot = Volume(np.full((3, 3, 3), 7e4), np.eye(4))
    with pytest.raises(InputError, match="DICOM"):
        write_dicom_series(hot, tmp_path / "hot")
    holes = Volume(np.full((3, 3, 3), np.nan), np.eye(4))
    for write, name in ((write_dicom_series, "a"), (write_nifti, "a.nii")):
        with pytest.raises(InputError, match="finite"):
            write(holes, tmp_path / name)
    sheared = np.eye(4)
    sheared[0, 1] = 0.2
    with pytest.raises(InputError, match="perpendicular"):
        write_dicom_series(Volume(np.zeros((3, 3, 3)), sheared), tmp_path / "b")
    with pytest.raises(InputError, match="nii"):
        write_nifti(oblique, tmp_path / "ct.img")
    with pytest.raises(InputError, match="exists"):
        write_dicom_series(oblique, tmp_path)
    assert list(tmp_path.iterdir()) == []
