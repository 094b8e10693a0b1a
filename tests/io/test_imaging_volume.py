"""Readers: the same object lands at the same LPS points, whatever file it came in."""

import gzip
from contextlib import nullcontext

import nibabel
import numpy as np
import pydicom
import pytest

from imaging_objects import (
    BLOBS_LPS,
    OBLIQUE,
    SHAPE,
    affine_lps,
    blob_array,
    blob_centres,
    write_dicom,
    write_nifti,
    write_nrrd,
)
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.io import nifti
from tumortrack.io.volume import is_label_map, read_labels, read_raw, read_volume

GRIDS = {
    "LPS": affine_lps("LPS", (0.9, 1.0, 0.8), np.eye(3)),
    "RAS": affine_lps("RAS", (0.9, 1.0, 0.8), np.eye(3)),
    "IPL": affine_lps("IPL", (1.0, 0.9, 0.9), np.eye(3)),
    "LAS, mirrored indices": affine_lps("LAS", (0.9, 1.0, 1.1), np.eye(3)),
    "oblique": affine_lps("LPS", (0.9, 1.0, 0.8), OBLIQUE),
    "oblique ASR": affine_lps("ASR", (0.9, 1.0, 0.8), OBLIQUE),
}
LPS = GRIDS["LPS"]
GANTRY = LPS + 0.25 * np.eye(4)[[3, 2, 3, 3]] * [[0], [1], [0], [0]]  # slices 0.25 mm further back
grids = pytest.mark.parametrize("affine", GRIDS.values(), ids=GRIDS.keys())


def check(path, affine):
    raw, expected = read_raw(path), blob_array(affine, SHAPE)
    assert np.abs(blob_centres(raw.array, raw.lps_from_index) - BLOBS_LPS).max() < 0.25
    volume = read_volume(path)
    assert np.allclose(volume.lps_from_index, affine, atol=1e-4)
    assert np.array_equal(volume.hu, expected)


@grids
def test_no_volume_file_is_mirrored(tmp_path, affine):
    array = blob_array(affine, SHAPE)
    for form in ("sform", "qform", "both"):
        write_nifti(tmp_path / f"{form}.nii.gz", array, affine, form)
    for compress in (False, True):
        write_nrrd(tmp_path / f"{compress}.nrrd", array, affine, compress)
    nifti.write_volume_nifti(tmp_path / "own.nii.gz", array, affine)
    for path in tmp_path.iterdir():
        check(path, affine)


@pytest.mark.parametrize("affine", [LPS, GRIDS["oblique"], GANTRY])
def test_dicom_slices_in_shuffled_files_are_sorted(tmp_path, affine):
    write_dicom(tmp_path / "s", blob_array(affine, SHAPE), affine)
    check(tmp_path / "s", affine)


def test_dicom_gaps_doubles_strays_and_cut_pixels_are_refused(tmp_path):
    array = blob_array(LPS, SHAPE)
    write_dicom(tmp_path / "gap", array, LPS)[12].unlink()
    with refused(InputError, f"{LPS[2, 3] + 11 * 0.8:.2f} mm"):
        read_volume(tmp_path / "gap")
    copy = pydicom.dcmread(write_dicom(tmp_path / "twice", array, LPS)[3])
    copy.SOPInstanceUID = "1.2.9"  # another image at the same place
    copy.save_as(tmp_path / "twice" / "copy")
    with refused(InputError, f"{LPS[2, 3] + 3 * 0.8:.2f} mm"):
        read_volume(tmp_path / "twice")
    files = write_dicom(tmp_path / "cut", array, LPS)
    files[7].write_bytes(files[7].read_bytes()[:-1500])
    with refused(InputError, files[7].name):
        read_volume(tmp_path / "cut")


def test_among_several_series_the_only_real_ct_is_taken_or_a_list_given(tmp_path):
    array = blob_array(LPS, SHAPE)
    write_dicom(tmp_path, array, LPS, uid="1.2.3")
    write_dicom(tmp_path, array[:, :, :4], LPS, uid="1.2.4")  # a scout
    write_dicom(tmp_path, array + 1, LPS, uid="1.2.5", modality="MR")
    (tmp_path / "readme.txt").write_text("not a slice")
    assert np.array_equal(read_volume(tmp_path).hu, array)
    assert np.array_equal(read_volume(tmp_path, "1.2.5").hu, array + 1)
    write_dicom(tmp_path, array + 2, LPS, uid="1.2.6")
    with refused(InputError, "--series", "1.2.3", "1.2.6", "CT", "39 slices"):
        read_volume(tmp_path)
    with refused(InputError, "--series"):
        read_volume(tmp_path, "9.9")


@grids
def test_labels_and_fractions_survive_writing(tmp_path, affine):
    array = blob_array(affine, SHAPE)
    nifti.write_nifti(tmp_path / "l.nii.gz", (array // 100).astype(np.uint8), affine, lps=True)
    again = read_labels(tmp_path / "l.nii.gz")
    assert np.array_equal(again.labels, array // 100)
    assert np.allclose(again.lps_from_index, affine, atol=1e-4)
    nifti.write_volume_nifti(tmp_path / "v.nii.gz", array + np.float32(0.25), affine)
    assert np.array_equal(read_volume(tmp_path / "v.nii.gz").hu, array + 0.25)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({}, None),  # as it is, it is read
        ({"affine": np.full((4, 4), np.nan)}, ()),
        ({"affine": np.diag([1.0, 0, 1, 1])}, ()),
        ({"affine": np.ones((4, 4))}, ()),
        ({"affine": np.diag([0.0007, 0.0007, 0.001, 1])}, ["0.0007 x 0.0007 x 0.001"]),
        ({"affine": np.diag([50.0, 1, 1, 1])}, ["0.05 to 10 mm"]),
        ({"code": 0}, ("sform", "qform")),
        ({"units": "meter"}, ["meter"]),
        ({"shape": (4, 5, 6, 2)}, ["4 axes"]),
        ({"shape": (4, 5, 1)}, ["4 x 5 x 1"]),
        ({"qform": np.diag([-1.0, 1, 1, 1])}, ("sform", "qform")),
        ({"slope": (2, np.nan)}, ()),
    ],
)
def test_implausible_nifti_headers_are_refused(tmp_path, change, named):
    header = nibabel.Nifti1Header()
    header.set_data_shape(change.get("shape", (4, 5, 6)))
    header["vox_offset"], header["magic"] = 352, b"n+1"
    header["sform_code"] = change.get("code", 1)
    for row, values in zip("xyz", change.get("affine", np.eye(4)), strict=False):
        header[f"srow_{row}"] = values
    header.set_xyzt_units(change.get("units", "mm"))
    if "qform" in change:
        header.set_qform(change["qform"], code=1)
    header["scl_slope"], header["scl_inter"] = change.get("slope", (1, 0))
    (tmp_path / "v.nii").write_bytes(header.binaryblock + bytes(4 * 4 * 5 * 6 * 2))
    with nullcontext() if named is None else refused(InputError, "v.nii", *named):
        read_volume(tmp_path / "v.nii")


def test_a_mended_header_is_not_told_by_nibabel_whose_log_stays_as_it_was(tmp_path, capfd):
    nifti.write_nifti(tmp_path / "ct.nii", np.zeros((2, 3, 4), np.int16), np.eye(4), lps=True)
    raw = bytearray((tmp_path / "ct.nii").read_bytes())
    raw[80:84] = np.float32(-2).tobytes()  # pixdim[1], which has to be positive
    raw[252:254] = bytes(2)  # the sform alone
    (tmp_path / "ct.nii").write_bytes(raw)
    before = nibabel.imageglobals.logger.level
    assert nifti.read_nifti(tmp_path / "ct.nii").array.shape == (2, 3, 4)
    assert nibabel.imageglobals.logger.level == before
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("unscaled", [(1.0, 0.0), (0.0, 0.0), (np.nan, np.nan)])
@pytest.mark.parametrize("order", "<>")
def test_either_byte_order_is_read_and_no_scale_means_the_numbers_as_they_are(
    tmp_path, order, unscaled
):
    voxels = np.arange(-30, 90, dtype=order + "i2").reshape(4, 5, 6)
    header = nibabel.Nifti1Header(endianness=order)
    header.set_data_shape(voxels.shape)
    header.set_data_dtype(voxels.dtype)
    header.set_sform(np.eye(4), code=1)
    header["vox_offset"], header["magic"] = 352, b"n+1"
    header["scl_slope"], header["scl_inter"] = unscaled
    content = header.binaryblock + bytes(4) + voxels.tobytes(order="F")
    (tmp_path / "v.nii.gz").write_bytes(gzip.compress(content))
    np.testing.assert_array_equal(read_volume(tmp_path / "v.nii.gz").hu, voxels)


@pytest.mark.parametrize(("side", "named"), [(100_000, "8 GiB"), (1000, 10**9)])
def test_huge_headers_are_refused_before_allocation(tmp_path, side, named):
    header = nibabel.Nifti2Header()
    header.set_data_shape((side, side, side))
    header.set_data_dtype(np.uint8)
    header.set_sform(np.eye(4), code=1)
    header["vox_offset"], header["magic"] = 544, b"n+2"
    (tmp_path / "v.nii.gz").write_bytes(gzip.compress(header.binaryblock + b"\0" * 4))
    with refused(InputError, "v.nii.gz", named):
        read_volume(tmp_path / "v.nii.gz")


NRRD = (
    "NRRD0004\ntype: short\ndimension: 3\nspace: left-posterior-superior\nsizes: 4 5 6\n"
    "space directions: (1,0,0) (0,1,0) (0,0,1)\nkinds: domain domain domain\nendian: little\n"
    "encoding: raw\nspace origin: (3,0,0)\n"
)


@pytest.mark.parametrize(
    ("old", "new", "named"),  # as it is, it is read: below
    [
        ("encoding: raw\n", "encoding: raw\ndata file: /etc/passwd\n", ()),
        ("space: left-posterior-superior\n", "space dimension: 3\n", ["None"]),
        ("sizes: 4 5 6", "sizes: 99999 99999 99999", ["8 GiB"]),
        ("sizes: 4 5 6", "sizes: 400 500 600", [400 * 500 * 600 * 2]),
        ("sizes: 4 5 6", "sizes: 4 5 6 2", ["4 axes"]),
        ("(0,0,1)", "(0,0,nan)", ()),
        ("(0,0,1)", "(0,0.0,0)", ()),
        ("(1,0,0) (0,1,0) (0,0,1)", "(.001,0,0) (0,.001,0) (0,0,.001)", ["0.001 x 0.001 x 0.001"]),
        ("kinds:", 'space units: "m" "m" "m"\nkinds:', ["'m'"]),
        ("endian: little\n", "", ()),
        ("type: short", "type: block", ()),
    ],
)
def test_implausible_nrrd_headers_are_refused(tmp_path, old, new, named):
    (tmp_path / "v.nrrd").write_bytes(NRRD.replace(old, new).encode() + b"\n" + bytes(240))
    with refused(InputError, "v.nrrd", *named):
        read_volume(tmp_path / "v.nrrd")


def test_nrrd_in_ras_lands_where_its_lps_twin_does(tmp_path):
    ras = NRRD.replace("left-posterior", "right-anterior").replace("(3,0,0)", "(-3,0,0)")
    ras = ras.replace("(1,0,0) (0,1,0)", "(-1,0,0) (0,-1,0)")
    for text in (NRRD, ras):
        (tmp_path / "v.nrrd").write_bytes(text.encode() + b"\n" + bytes(240))
        at = read_raw(tmp_path / "v.nrrd").lps_from_index
        np.testing.assert_array_equal(at, np.eye(4) + 3 * np.eye(4, k=3))


@pytest.mark.parametrize("name", ["v.nhdr", "v.mhd", "v.txt", "v.nii.gz"])
def test_other_and_empty_files_are_refused(tmp_path, name):
    for content in (None, b"", b"ObjectType = Image\nElementDataFile = /etc/passwd\n"):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with refused(InputError, name):
            read_volume(tmp_path / name)
    with pytest.raises(InputError):
        read_volume(tmp_path)


def test_label_maps_are_recognised_and_checked(tmp_path):
    array = blob_array(LPS, SHAPE)
    for name, numbers in {"ct": array, "float": array / 100, "half": array / 200}.items():
        write_nifti(tmp_path / f"{name}.nii", numbers, LPS, "both")
        assert is_label_map(read_raw(tmp_path / f"{name}.nii")) == (name == "float")
    assert set(np.unique(read_labels(tmp_path / "float.nii").labels)) == {0, 1, 3, 5, 7}
    for name in ("half", "ct"):
        with refused(InputError, f"{name}.nii"):
            read_labels(tmp_path / f"{name}.nii")


def test_real_volumes_are_read(shared_data):
    ct = read_volume(shared_data / "totalsegmentator" / "example_ct.nii.gz")
    assert ct.hu.shape == (122, 101, 112)
    assert ct.hu.min() == -1207
    slices = read_volume(shared_data / "totalsegmentator" / "example_ct_dicom")
    assert slices.hu.shape == (512, 512, 20)
    assert np.allclose(spacing_mm(slices.lps_from_index), [0.9765625, 0.9765625, 2.0])
    assert slices.hu.min() == -1024


def test_a_multi_frame_object_beside_a_series_is_left_out_with_a_note(tmp_path):
    array = np.arange(12 * 10 * 11, dtype=np.int16).reshape(12, 10, 11)
    paths = write_dicom(tmp_path, array, np.eye(4))
    extra = pydicom.dcmread(paths[0])
    extra.NumberOfFrames, extra.PixelData = 2, extra.PixelData * 2
    extra.save_as(tmp_path / "frames.dcm")
    raw = read_raw(tmp_path)
    np.testing.assert_array_equal(raw.array, array)
    assert len(raw.notes) == 1
    assert "frames.dcm" in raw.notes[0]
    for path in paths:
        path.unlink()
    with pytest.raises(InputError):  # two frames at one place
        read_raw(tmp_path)


SHEARED = np.eye(4) + np.eye(4, k=1) * [0, 0.2, 0.1, 12.0]


@pytest.mark.parametrize("number", [np.uint8, np.int16, np.float32, np.float64])
@pytest.mark.parametrize("affine", [*GRIDS.values(), SHEARED], ids=[*GRIDS, "sheared"])
def test_a_written_header_is_what_nibabel_reads_and_would_write(tmp_path, affine, number):
    array = blob_array(affine, SHAPE).astype(number)
    nifti.write_nifti(tmp_path / "v.nii", array, affine, lps=False)
    found = nibabel.load(tmp_path / "v.nii")
    assert np.array_equal(np.asarray(found.dataobj), array)
    assert found.get_data_dtype() == number
    theirs = nibabel.Nifti1Image(array, affine)
    theirs.header.set_xyzt_units("mm")
    theirs.set_sform(affine, code="scanner")
    theirs.set_qform(affine, code=int(found.header["qform_code"]))
    fields = ["dim", "bitpix", "xyzt_units", "sform_code", "srow_x", "srow_y", "srow_z"]
    quaternion = ["quatern_b", "quatern_c", "quatern_d", "qoffset_x", "qoffset_y", "qoffset_z"]
    orthogonal = affine is not SHEARED  # only such a grid has a quaternion
    assert (found.header["qform_code"] == 1) == orthogonal
    for field in fields + quaternion * orthogonal:
        np.testing.assert_allclose(found.header[field], theirs.header[field], atol=2e-6)
    np.testing.assert_allclose(found.header["pixdim"][:4], theirs.header["pixdim"][:4], rtol=1e-6)
