"""Readers: the same object lands at the same LPS points, whatever file it came in."""

import gzip

import numpy as np
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
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.imaging import nifti
from tumortrack.imaging.volume import (
    is_label_map,
    read_labels,
    read_raw,
    read_volume,
)

GRIDS = {
    "LPS": affine_lps("LPS", (0.9, 1.0, 0.8), np.eye(3)),
    "RAS": affine_lps("RAS", (0.9, 1.0, 0.8), np.eye(3)),
    "IPL": affine_lps("IPL", (1.0, 0.9, 0.9), np.eye(3)),
    "LAS, mirrored indices": affine_lps("LAS", (0.9, 1.0, 1.1), np.eye(3)),
    "oblique": affine_lps("LPS", (0.9, 1.0, 0.8), OBLIQUE),
    "oblique ASR": affine_lps("ASR", (0.9, 1.0, 0.8), OBLIQUE),
}
grids = pytest.mark.parametrize("affine", GRIDS.values(), ids=GRIDS.keys())


def check(path, affine, expected):
    raw = read_raw(path)
    assert np.abs(blob_centres(raw.array, raw.lps_from_index) - BLOBS_LPS).max() < 0.25
    volume = read_volume(path)
    assert np.allclose(volume.lps_from_index, affine, atol=1e-4)
    assert np.array_equal(volume.hu, expected)


@grids
@pytest.mark.parametrize("form", ["sform", "qform", "both"])
def test_nifti_is_never_mirrored(tmp_path, affine, form):
    array = blob_array(affine, SHAPE)
    write_nifti(tmp_path / "v.nii.gz", array, affine, form)
    check(tmp_path / "v.nii.gz", affine, array)


@grids
@pytest.mark.parametrize("compress", [False, True])
def test_nrrd_is_never_mirrored(tmp_path, affine, compress):
    array = blob_array(affine, SHAPE)
    write_nrrd(tmp_path / "v.nrrd", array, affine, compress)
    check(tmp_path / "v.nrrd", affine, array)


def test_nrrd_in_ras_lands_where_its_lps_twin_does(tmp_path):
    affine = GRIDS["oblique"]
    array = blob_array(affine, SHAPE)
    write_nrrd(tmp_path / "lps.nrrd", array, affine, False)
    content = (tmp_path / "lps.nrrd").read_bytes()
    head, data = content.split(b"\n\n", 1)
    ras = np.diag([-1, -1, 1, 1]) @ affine
    lines = []
    for line in head.decode().split("\n"):
        if line.startswith("space:"):
            line = "space: right-anterior-superior"
        if line.startswith("space directions:"):
            columns = (f"({a:.12g},{b:.12g},{c:.12g})" for a, b, c in ras[:3, :3].T)
            line = "space directions: " + " ".join(columns)
        if line.startswith("space origin:"):
            line = "space origin: ({:.12g},{:.12g},{:.12g})".format(*ras[:3, 3])
        lines.append(line)
    (tmp_path / "ras.nrrd").write_bytes("\n".join(lines).encode() + b"\n\n" + data)
    check(tmp_path / "ras.nrrd", affine, array)


@pytest.mark.parametrize("name", ["LPS", "oblique"])
def test_dicom_slices_in_shuffled_files_are_sorted(tmp_path, name):
    affine = GRIDS[name]
    array = blob_array(affine, SHAPE)
    write_dicom(tmp_path / "s", array, affine)
    check(tmp_path / "s", affine, array)


def test_sheared_slices_of_a_tilted_gantry_keep_their_place(tmp_path):
    affine = GRIDS["LPS"].copy()
    affine[1, 2] = 0.25  # each slice 0.25 mm further back
    array = blob_array(affine, SHAPE)
    write_dicom(tmp_path / "s", array, affine)
    check(tmp_path / "s", affine, array)


def test_dicom_gaps_doubles_and_strays_are_refused_with_their_place(tmp_path):
    import pydicom

    affine = GRIDS["LPS"]
    array = blob_array(affine, SHAPE)
    files = write_dicom(tmp_path / "gap", array, affine)
    files[12].unlink()
    at = affine[2, 3] + 11 * 0.8
    with pytest.raises(InputError, match=f"missing after position {at:.2f} mm"):
        read_volume(tmp_path / "gap")
    write_dicom(tmp_path / "twice", array, affine)
    copy = pydicom.dcmread(next((tmp_path / "twice").iterdir()))
    copy.SOPInstanceUID = "1.2.9"  # another image at the same place
    copy.save_as(tmp_path / "twice" / "copy")
    with pytest.raises(InputError, match="two slices lie at position"):
        read_volume(tmp_path / "twice")


def test_among_several_series_the_only_real_ct_is_taken_or_a_list_given(tmp_path):
    affine = GRIDS["LPS"]
    array = blob_array(affine, SHAPE)
    write_dicom(tmp_path, array, affine, uid="1.2.3")
    write_dicom(tmp_path, array[:, :, :4], affine, uid="1.2.4")  # a scout
    write_dicom(tmp_path, array + 1, affine, uid="1.2.5", modality="MR")
    (tmp_path / "readme.txt").write_text("not a slice")
    assert np.array_equal(read_volume(tmp_path).hu, array)
    assert np.array_equal(read_volume(tmp_path, "1.2.5").hu, array + 1)
    write_dicom(tmp_path, array + 2, affine, uid="1.2.6")
    with pytest.raises(InputError, match=r"--series(.|\n)*1\.2\.3, series 1\.2\.3, CT, 39 slices"):
        read_volume(tmp_path)
    with pytest.raises(InputError, match="--series"):
        read_volume(tmp_path, "9.9")


def test_truncated_dicom_pixels_are_an_input_error(tmp_path):
    affine = GRIDS["LPS"]
    files = write_dicom(tmp_path / "s", blob_array(affine, SHAPE), affine)
    files[7].write_bytes(files[7].read_bytes()[:-1500])
    with pytest.raises(InputError):
        read_volume(tmp_path / "s")


@grids
def test_labels_and_ct_survive_writing(tmp_path, affine):
    array = blob_array(affine, SHAPE)
    labels = (array // 100).astype(np.uint8)
    nifti.write_nifti(tmp_path / "l.nii.gz", labels, affine, lps=True)
    again = read_labels(tmp_path / "l.nii.gz")
    assert np.array_equal(again.labels, labels)
    assert np.allclose(again.lps_from_index, affine, atol=1e-4)
    for hu in (array, array + np.float32(0.25)):
        nifti.write_volume_nifti(tmp_path / "v.nii.gz", hu, affine)
        assert np.array_equal(read_volume(tmp_path / "v.nii.gz").hu, hu)


def test_camera_labels_keep_their_affine_verbatim(tmp_path):
    import nibabel

    affine = np.diag([0.5, 0.6, 0.7, 1.0])
    affine[:3, 3] = [-30, -20, 110]
    nifti.write_nifti(tmp_path / "l.nii.gz", np.ones((3, 4, 5), np.uint8), affine, lps=False)
    assert np.allclose(nibabel.load(tmp_path / "l.nii.gz").affine, affine, atol=1e-5)


SHEARED = np.eye(4) + np.eye(4, k=1) * [0, 0.2, 0.1, 12.0]


@pytest.mark.parametrize("number", [np.uint8, np.int16, np.float32, np.float64])
@pytest.mark.parametrize("affine", [*GRIDS.values(), SHEARED], ids=[*GRIDS, "sheared"])
def test_a_written_header_is_what_nibabel_reads_and_would_write(tmp_path, affine, number):
    import nibabel

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


def set_header(path, affine=None, code=1, units="mm", shape=(4, 5, 6)):
    """A NIfTI with one thing wrong in its header."""
    import nibabel

    affine = np.eye(4) if affine is None else affine
    image = nibabel.Nifti1Image(np.zeros(shape, np.int16), None)
    image.header["sform_code"] = code
    for n, row in enumerate("xyz"):
        image.header[f"srow_{row}"] = affine[n]
    image.header.set_xyzt_units(units)
    image._affine = None
    stream = path.open("wb")
    with stream:
        stream.write(image.header.binaryblock + b"\0" * 4 + np.zeros(shape, np.int16).tobytes())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"affine": np.full((4, 4), np.nan)}, "NaN"),
        ({"affine": np.diag([1.0, 0, 1, 1])}, "singular"),
        ({"affine": np.ones((4, 4))}, "singular"),
        ({"affine": np.diag([0.0007, 0.0007, 0.001, 1])}, "looks like metres"),
        ({"affine": np.diag([50.0, 1, 1, 1])}, "allowed are 0.05 to 10 mm"),
        ({"code": 0}, "no orientation"),
        ({"units": "meter"}, "states its unit as meter"),
        ({"shape": (4, 5, 6, 2)}, "4 axes"),
        ({"shape": (4, 5, 1)}, "flat image"),
    ],
)
def test_implausible_nifti_headers_are_refused(tmp_path, change, words):
    set_header(tmp_path / "v.nii", **change)
    with pytest.raises(InputError, match=words):
        read_volume(tmp_path / "v.nii")


def test_a_mended_header_is_not_told_by_nibabel_whose_log_stays_as_it_was(tmp_path, capfd):
    import nibabel

    image = nibabel.Nifti1Image(np.zeros((2, 3, 4), np.int16), np.diag([-2.0, -2, 3, 1]))
    nibabel.save(image, tmp_path / "ct.nii")
    raw = bytearray((tmp_path / "ct.nii").read_bytes())
    raw[80:84] = np.float32(-2).tobytes()  # pixdim[1], which has to be positive
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
    import nibabel

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
    header["scl_slope"], header["scl_inter"] = 2, np.nan  # a scale that is lost in part
    (tmp_path / "v.nii").write_bytes(header.binaryblock + content[348:])
    with pytest.raises(InputError, match="intercept"):
        read_volume(tmp_path / "v.nii")


def test_contradictory_orientations_are_refused(tmp_path):
    import nibabel

    image = nibabel.Nifti1Image(np.zeros((4, 5, 6), np.int16), None)
    image.set_sform(np.diag([1.0, 1, 1, 1]), code=1)
    image.set_qform(np.diag([-1.0, 1, 1, 1]), code=1)
    nibabel.save(image, tmp_path / "v.nii")
    with pytest.raises(InputError, match="disagree"):
        read_volume(tmp_path / "v.nii")


def test_huge_headers_are_refused_before_allocation(tmp_path):
    import nibabel

    header = nibabel.Nifti2Header()
    header.set_data_shape((100_000, 100_000, 100_000))
    header.set_data_dtype(np.uint8)
    header.set_sform(np.eye(4), code=1)
    header["vox_offset"], header["magic"] = 544, b"n+2"
    with gzip.open(tmp_path / "v.nii.gz", "wb") as stream:
        stream.write(header.binaryblock + b"\0" * 4)
    with pytest.raises(InputError, match="the limit is"):
        read_volume(tmp_path / "v.nii.gz")
    header.set_data_shape((1000, 1000, 1000))  # allowed, but not in so short a file
    with gzip.open(tmp_path / "v.nii.gz", "wb") as stream:
        stream.write(header.binaryblock + b"\0" * 4)
    with pytest.raises(InputError, match="shorter than its header says"):
        read_volume(tmp_path / "v.nii.gz")


NRRD = (
    "NRRD0004\ntype: short\ndimension: 3\nspace: left-posterior-superior\nsizes: 4 5 6\n"
    "space directions: (1,0,0) (0,1,0) (0,0,1)\nkinds: domain domain domain\nendian: little\n"
    "encoding: raw\nspace origin: (0,0,0)\n"
)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("encoding: raw\n", "encoding: raw\ndata file: /etc/passwd\n", "another file"),
        ("space: left-posterior-superior\n", "space dimension: 3\n", "no patient orientation"),
        ("sizes: 4 5 6", "sizes: 99999 99999 99999", "the limit is"),
        ("sizes: 4 5 6", "sizes: 400 500 600", "shorter than its header"),
        ("sizes: 4 5 6", "sizes: 4 5 6 2", "4 axes"),
        ("(0,0,1)", "(0,0,nan)", "NaN"),
        ("(0,0,1)", "(0,0.0,0)", "singular"),
        ("(1,0,0) (0,1,0) (0,0,1)", "(.001,0,0) (0,.001,0) (0,0,.001)", "looks like metres"),
        ("kinds:", 'space units: "m" "m" "m"\nkinds:', "millimetres are needed"),
        ("endian: little\n", "", "byte order"),
        ("type: short", "type: block", "damaged"),
    ],
)
def test_implausible_nrrd_headers_are_refused(tmp_path, old, new, words):
    path = tmp_path / "v.nrrd"
    path.write_bytes(NRRD.encode() + b"\n" + bytes(240))
    assert read_volume(path).hu.shape == (4, 5, 6)
    path.write_bytes(NRRD.replace(old, new).encode() + b"\n" + bytes(240))
    with pytest.raises(InputError, match=words):
        read_volume(path)


@pytest.mark.parametrize("name", ["v.nhdr", "v.mhd", "v.txt", "v.nii.gz"])
def test_other_and_empty_files_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError):
        read_volume(tmp_path / name)
    with pytest.raises(InputError, match="does not exist"):
        read_volume(tmp_path / f"missing_{name}")
    (tmp_path / name).write_bytes(b"ObjectType = Image\nElementDataFile = /etc/passwd\n")
    with pytest.raises(InputError):
        read_volume(tmp_path / name)
    words = "not read" if name == "v.mhd" else "no DICOM image"
    with pytest.raises(InputError, match=words):
        read_volume(tmp_path)


def test_label_maps_are_recognised_and_checked(tmp_path):
    affine = GRIDS["LPS"]
    array = blob_array(affine, SHAPE)
    write_nifti(tmp_path / "ct.nii", array, affine, "both")
    write_nifti(tmp_path / "float.nii", (array // 100).astype(float), affine, "both")
    write_nifti(tmp_path / "half.nii", array / 200, affine, "both")
    assert not is_label_map(read_raw(tmp_path / "ct.nii"))
    assert is_label_map(read_raw(tmp_path / "float.nii"))
    assert not is_label_map(read_raw(tmp_path / "half.nii"))
    assert set(np.unique(read_labels(tmp_path / "float.nii").labels)) == {0, 1, 3, 5, 7}
    with pytest.raises(InputError, match="fractions"):
        read_labels(tmp_path / "half.nii")
    with pytest.raises(InputError, match="from 0 to 700"):
        read_labels(tmp_path / "ct.nii")


def test_real_volumes_are_read(shared_data):
    ct = read_volume(shared_data / "totalsegmentator" / "example_ct.nii.gz")
    assert ct.hu.shape == (122, 101, 112)
    assert ct.hu.min() == -1207
    left, right = (
        read_labels(shared_data / "totalsegmentator" / f"kidney_{side}.nii.gz")
        for side in ("left", "right")
    )
    at = [(a.lps_from_index @ [*np.argwhere(a.labels).mean(0), 1])[0] for a in (left, right)]
    assert at[0] > at[1] + 80  # LPS: the left kidney has the larger x
    slices = read_volume(shared_data / "totalsegmentator" / "example_ct_dicom")
    assert slices.hu.shape == (512, 512, 20)
    assert np.allclose(spacing_mm(slices.lps_from_index), [0.9765625, 0.9765625, 2.0])
    assert slices.hu.min() == -1024


def test_a_multi_frame_object_beside_a_series_is_left_out_with_a_note(tmp_path):
    import pydicom

    array = np.arange(12 * 10 * 11, dtype=np.int16).reshape(12, 10, 11)
    paths = write_dicom(tmp_path / "dicom", array, np.eye(4))
    extra = pydicom.dcmread(paths[0])
    extra.NumberOfFrames = 2
    extra.PixelData = extra.PixelData * 2
    extra.save_as(tmp_path / "dicom" / "frames.dcm")
    raw = read_raw(tmp_path / "dicom")
    np.testing.assert_array_equal(raw.array, array)
    assert len(raw.notes) == 1
    assert "frames.dcm" in raw.notes[0]
    for path in paths:
        path.unlink()
    with pytest.raises(InputError, match="0 of them are CT"):  # two frames at one place
        read_raw(tmp_path / "dicom")
