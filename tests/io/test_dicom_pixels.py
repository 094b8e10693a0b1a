"""The pixels of DICOM slices, beside SimpleITK's reader; and what no reader could know."""

import numpy as np
import pydicom
import pytest
from pydicom.encaps import encapsulate, get_frame

from dicom_objects import SYNTAXES, packed, write_slices
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.io.dicom import read_dicom

COMPRESSED = ("rle", "jpeg lossless", "jpeg-ls", "jpeg 2000")


def numbers(kind, bits):
    """All the values that so many bits can hold at random places, and a smooth part; the lowest and
    the highest first."""
    lowest = -(2 ** (bits - 1)) if np.dtype(kind).kind == "i" else 0
    highest = lowest + 2**bits - 1
    out = np.random.default_rng(0).integers(lowest, highest + 1, (24, 20, 11))
    out[12:] = np.clip(np.arange(12)[:, None, None] * 3 + np.arange(20)[:, None], lowest, highest)
    out[0, 0], out[1, 0] = lowest, highest
    return out.astype(kind)


def by_simpleitk(paths):
    import SimpleITK as sitk  # noqa: N813

    reader = sitk.ImageSeriesReader()
    reader.SetOutputPixelType(sitk.sitkFloat32)
    reader.SetFileNames([str(path) for path in paths])
    return sitk.GetArrayFromImage(reader.Execute()).transpose(2, 1, 0)


@pytest.mark.parametrize("syntax", SYNTAXES)
@pytest.mark.parametrize(
    ("kind", "bits"),
    [("<u2", 16), ("<i2", 16), ("<u2", 12), ("<i2", 12), ("<u2", 10), ("u1", 8), ("i1", 8)],
)
def test_every_packing_gives_the_numbers_that_simpleitk_reads(syntax, kind, bits, tmp_path):
    stored = numbers(kind, bits)
    paths = write_slices(tmp_path, stored, bits)
    for path in paths:
        packed(path, syntax)
    read = read_dicom(tmp_path).array
    assert read.dtype == np.float32
    assert np.array_equal(read, (stored * 0.5 - 1024.25).astype(np.float32))
    assert np.array_equal(read, by_simpleitk(paths))


def test_bits_above_those_stored_are_no_part_of_the_number(tmp_path):
    """Overlays of old scanners, or a sign that was not carried on."""
    stored = numbers("<i2", 12)
    paths = write_slices(tmp_path, stored ^ np.int16(0x5000), 12)
    read = read_dicom(tmp_path).array
    assert np.array_equal(read, (stored * 0.5 - 1024.25).astype(np.float32))
    assert np.array_equal(read, by_simpleitk(paths))


def test_padding_and_long_values_are_left_as_they_are(tmp_path, capfd, recwarn):
    def change(data):
        data.add_new("PixelPaddingValue", "SS", -200)
        data.PixelData += bytes(2500)  # room for two more frames

    paths = write_slices(tmp_path, numbers("<i2", 16), change=change)
    assert np.array_equal(read_dicom(tmp_path).array, by_simpleitk(paths))
    assert not recwarn.list
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("tag", "value"),
    [
        ("PhotometricInterpretation", "MONOCHROME1"),  # inverted by GDCM and not by others
        ("PhotometricInterpretation", "YBR_FULL"),
        ("HighBit", 13),  # ignored by both
    ],
)
def test_what_the_tags_leave_open_is_refused(tmp_path, tag, value):
    write_slices(tmp_path, numbers("<u2", 12), 12, lambda data: setattr(data, tag, value))
    with refused(InputError, f"{tag} {value}"):
        read_dicom(tmp_path)


@pytest.mark.parametrize("syntax", COMPRESSED)
def test_a_picture_that_is_cut_or_of_another_size_is_refused(syntax, tmp_path, capfd, recwarn):
    """With the length that its elements claim made true: a decoder fills up what is missing."""
    paths = write_slices(tmp_path, numbers("<u2", 12), 12)
    for path in paths:
        packed(path, syntax)
    whole = paths[4].read_bytes()
    data = pydicom.dcmread(paths[4])
    frame = get_frame(data.PixelData, 0, number_of_frames=1)
    data.PixelData = encapsulate([frame[: len(frame) * 3 // 4]])
    data.save_as(paths[4])
    with refused(InputError, paths[4].name) as error:
        read_dicom(tmp_path)
    assert len(str(error.value).splitlines()) == 1
    assert not recwarn.list
    assert capfd.readouterr().err == ""
    paths[4].write_bytes(whole)
    for path in paths:
        data = pydicom.dcmread(path)
        data.Rows, data.Columns = data.Columns, data.Rows - 4
        data.save_as(path)
    with pytest.raises(InputError):
        read_dicom(tmp_path)
