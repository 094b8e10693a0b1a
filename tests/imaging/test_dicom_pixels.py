"""Pixels of DICOM slices are those that SimpleITK, another reader, finds in them."""

import numpy as np
import pydicom
import pytest
from pydicom.uid import ExplicitVRBigEndian

from imaging_objects import write_dicom
from tumortrack.core.errors import InputError
from tumortrack.imaging.dicom import find_series, read_dicom

gdcm = pytest.importorskip("gdcm")
SYNTAXES = {
    "JPEG lossless": gdcm.TransferSyntax.JPEGLosslessProcess14_1,
    "JPEG lossless, any predictor": gdcm.TransferSyntax.JPEGLosslessProcess14,
    "JPEG-LS": gdcm.TransferSyntax.JPEGLSLossless,
    "JPEG 2000": gdcm.TransferSyntax.JPEG2000Lossless,
    "RLE": gdcm.TransferSyntax.RLELossless,
}


@pytest.fixture(params=["signed", "unsigned, 12 of 16 bits"])
def folder(request, tmp_path):
    """Twelve noisy slices with a slope and an intercept."""
    signed, affine = request.param == "signed", np.diag([0.7, 0.7, 2.5, 1.0])
    hu = np.random.default_rng(3).integers(-1000, 1200, (40, 30, 12)).astype(np.float32)
    for path in write_dicom(tmp_path / "ct", hu, affine):
        tags = pydicom.dcmread(path)
        values = tags.pixel_array.astype(np.int64)
        tags.RescaleSlope, tags.RescaleIntercept = "0.5", "-1024"
        tags.PixelRepresentation = int(signed)
        tags.BitsStored, tags.HighBit = (16, 15) if signed else (12, 11)
        values = values if signed else np.clip(values + 1024, 0, 4095)
        tags.PixelData = values.astype(np.int16 if signed else np.uint16).tobytes()
        tags.save_as(path)
    return tmp_path / "ct"


def by_simpleitk(folder):
    import SimpleITK as sitk  # noqa: N813

    reader = sitk.ImageSeriesReader()
    reader.SetOutputPixelType(sitk.sitkFloat32)
    reader.SetFileNames([str(path) for path in find_series(folder).files])
    return sitk.GetArrayFromImage(reader.Execute()).transpose(2, 1, 0)


def compress(path, syntax):
    reader, change, writer = (
        gdcm.ImageReader(),
        gdcm.ImageChangeTransferSyntax(),
        gdcm.ImageWriter(),
    )
    reader.SetFileName(str(path))
    assert reader.Read()
    change.SetTransferSyntax(gdcm.TransferSyntax(syntax))
    change.SetInput(reader.GetImage())
    assert change.Change()
    writer.SetImage(change.GetOutput())
    writer.SetFile(reader.GetFile())
    writer.SetFileName(str(path))
    assert writer.Write()


def test_plain_pixels_agree(folder):
    found = read_dicom(folder).array
    assert found.dtype == np.float32
    assert len(np.unique(found)) > 1000
    np.testing.assert_array_equal(found, by_simpleitk(folder))


@pytest.mark.parametrize("syntax", SYNTAXES.values(), ids=SYNTAXES)
def test_compressed_pixels_are_the_plain_ones(folder, syntax):
    plain = read_dicom(folder).array
    for path in folder.iterdir():
        compress(path, syntax)
        assert pydicom.dcmread(path).file_meta.TransferSyntaxUID.is_compressed
    np.testing.assert_array_equal(read_dicom(folder).array, plain)
    np.testing.assert_array_equal(by_simpleitk(folder), plain)


def test_big_endian_pixels_agree(folder):
    plain = read_dicom(folder).array
    for path in folder.iterdir():
        tags = pydicom.dcmread(path)
        tags.PixelData = tags.pixel_array.astype(">u2").tobytes()
        tags.file_meta.TransferSyntaxUID = ExplicitVRBigEndian
        pydicom.dcmwrite(path, tags, implicit_vr=False, little_endian=False)
    np.testing.assert_array_equal(read_dicom(folder).array, plain)


@pytest.mark.parametrize("folder", ["unsigned, 12 of 16 bits"], indirect=True)
def test_bits_beyond_those_stored_are_no_part_of_a_number(folder):
    plain = read_dicom(folder).array
    first = find_series(folder).files[0]
    tags = pydicom.dcmread(first)
    tags.PixelData = (tags.pixel_array | 0xA000).tobytes()  # an overlay, as old scanners keep it
    tags.save_as(first)
    np.testing.assert_array_equal(read_dicom(folder).array, plain)


@pytest.mark.parametrize("syntax", SYNTAXES.values(), ids=SYNTAXES)
def test_damaged_compressed_pixels_end_in_one_line(folder, syntax):
    """Bytes of the compressed pixels are changed at random: an answer or an InputError."""
    first = find_series(folder).files[0]
    compress(first, syntax)
    content, rng = bytearray(first.read_bytes()), np.random.default_rng(1)
    start = len(content) - len(pydicom.dcmread(first).PixelData)
    said = []
    for _ in range(40):
        damaged = bytearray(content)
        for place in rng.integers(start, len(content), 12):
            damaged[place] = rng.integers(256)
        first.write_bytes(damaged)
        try:
            read_dicom(folder)
        except InputError as error:
            said.append(str(error))
    assert said
    assert not any("\n" in line for line in said)
