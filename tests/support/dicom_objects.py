"""DICOM slices in every way of packing that is read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from imaging_objects import write_dicom

SYNTAXES = {  # by GDCM's names for them
    "uncompressed": "ExplicitVRLittleEndian",
    "big endian": "ExplicitVRBigEndian",
    "rle": "RLELossless",
    "jpeg lossless": "JPEGLosslessProcess14_1",
    "jpeg-ls": "JPEGLSLossless",
    "jpeg 2000": "JPEG2000Lossless",
}


def packed(path: Path, syntax: str) -> None:
    """Write a slice anew in another transfer syntax, by GDCM."""
    import gdcm

    reader, change, writer = (
        kind() for kind in (gdcm.ImageReader, gdcm.ImageChangeTransferSyntax, gdcm.ImageWriter)
    )
    reader.SetFileName(str(path))
    assert reader.Read()
    number = getattr(gdcm.TransferSyntax, SYNTAXES[syntax])
    change.SetTransferSyntax(gdcm.TransferSyntax(number))
    change.SetInput(reader.GetImage())
    assert change.Change()
    writer.SetFile(reader.GetFile())
    writer.SetImage(change.GetOutput())
    writer.SetFileName(str(path))
    assert writer.Write()


def write_slices(
    folder: Path,
    stored: np.ndarray,
    bits: int = 16,
    change: Callable[[Any], object] = lambda slice_: None,
) -> list[Path]:
    """Slices of these stored numbers (columns, rows, slices), signed or not as their type is, with
    HU = 0.5 stored - 1024.25; ``change`` is made to each before it is written."""
    import pydicom

    paths = write_dicom(folder, np.zeros(stored.shape), np.eye(4))
    size = 8 * stored.dtype.itemsize
    for k, path in enumerate(paths):
        data = pydicom.dcmread(path)
        data.BitsAllocated, data.BitsStored, data.HighBit = size, bits, bits - 1
        data.PixelRepresentation = int(stored.dtype.kind == "i")
        data.RescaleSlope, data.RescaleIntercept = "0.5", "-1024.25"
        data.PixelData = stored[:, :, k].T.tobytes()
        change(data)
        data.save_as(path)
    return paths
