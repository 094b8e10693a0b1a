"""The pixels of DICOM slices, decoded by pydicom, with GDCM for every kind of JPEG.

Decoders trust the header of a compressed picture, pad what is missing and allocate whatever is
claimed. So the header is compared with the slice's tags before a decoder sees it.
"""

from __future__ import annotations

import re
import struct
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Integer

from tumortrack.core.errors import readable

if TYPE_CHECKING:
    from pydicom import Dataset

_TAGS = (  # that decoding needs
    *("SamplesPerPixel", "PhotometricInterpretation", "Rows", "Columns", "BitsAllocated"),
    *("NumberOfFrames", "BitsStored", "HighBit", "PixelRepresentation", "PixelData"),
)
_DAMAGED = "the compressed picture is cut short, damaged or of another kind"
_START, _END = b"\xff\xd8", b"\xff\xd9"
_J2K_START = b"\xff\x4f\xff\x51"
_SCAN = 0xDA  # the segment that the coded numbers follow
_SEGMENTS = {0xC4, 0xDB, 0xDD, 0xFE, *range(0xE0, 0xF0)}  # tables, restarts, comments, applications
_LS_SEGMENTS = {*_SEGMENTS - {0xC4, 0xDB}, 0xF8}


class _Picture(NamedTuple):
    """The header of a compressed picture."""

    rows: int
    columns: int
    samples: int
    bits: int


def read_pixels(
    files: tuple[Path, ...],
    shape: tuple[int, int, int],
    scale: tuple[float, float],
    frames: tuple[int, ...],
) -> Float[np.ndarray, "columns rows slices"]:
    """The stored numbers of the files' ``frames``, one for each slice, times ``scale[0]`` plus
    ``scale[1]``, float32; tags on padding and display are not applied. ``shape``: columns, rows,
    slices. Raises InputError: pixels that cannot be decoded, or are not of this shape."""
    columns, rows, _ = shape
    values = np.empty((len(files), rows, columns), np.float32)
    with warnings.catch_warnings():
        # pydicom's warnings are harmless or checked here, but for excess pixels.
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", "The decoded RLE segment contains")
        tags, last = None, None
        for file, frame, out in zip(files, frames, values, strict=True):
            with readable(file, "has pixels that cannot be decoded"):
                tags, last = tags if file == last and tags else _tags(file), file
                stored = _stored(tags, frame)
                if stored.shape != out.shape:
                    raise ValueError(f"they are {stored.shape}, the other slices' {out.shape}")
            out[...] = stored * scale[0] + scale[1]  # in double precision
    return values.transpose(2, 1, 0)


def _tags(file: Path) -> Dataset:
    import pydicom

    tags = pydicom.dcmread(file, specific_tags=list(_TAGS), force=True)
    if "TransferSyntaxUID" not in tags.file_meta:  # without preamble, and so never compressed
        implicit = tags.original_encoding[0]
        uids = pydicom.uid.ImplicitVRLittleEndian, pydicom.uid.ExplicitVRLittleEndian
        tags.file_meta.TransferSyntaxUID = uids[0] if implicit else uids[1]
    return tags


def _stored(tags: Dataset, index: int) -> Integer[np.ndarray, "rows columns"]:
    """The stored numbers of a slice, or any exception."""
    from pydicom.encaps import get_frame
    from pydicom.pixels.decoders.base import get_decoder
    from pydicom.uid import JPEG2000TransferSyntaxes, RLELossless

    tags.setdefault("SamplesPerPixel", 1)
    tags.setdefault("PhotometricInterpretation", "MONOCHROME2")
    photometric = tags.PhotometricInterpretation
    if photometric != "MONOCHROME2":  # some readers invert MONOCHROME1 and others do not
        raise ValueError(f"PhotometricInterpretation {photometric!s:.20} is not MONOCHROME2")
    high_bit, bits = tags.get("HighBit"), tags.BitsStored
    if high_bit not in (None, bits - 1):
        raise ValueError(f"HighBit {high_bit} does not fit BitsStored {bits}")
    syntax = tags.file_meta.TransferSyntaxUID
    plugin = "pydicom"
    if syntax.is_encapsulated and syntax != RLELossless:
        import gdcm

        gdcm.Trace.WarningOff()  # it prints what pydicom raises as exceptions anyway
        gdcm.Trace.ErrorOff()
        plugin = "gdcm"
        count = int(tags.get("NumberOfFrames") or 1)
        frame = get_frame(tags.PixelData, index, number_of_frames=count)
        is_j2k = syntax in JPEG2000TransferSyntaxes
        _check_picture(_j2k_header(frame) if is_j2k else _jpeg_header(frame, syntax), tags)
    return get_decoder(syntax).as_array(tags, index=index, raw=True, decoding_plugin=plugin)[0]


def _check_picture(picture: _Picture, tags: Dataset) -> None:
    stated = (tags.Rows, tags.Columns, tags.SamplesPerPixel)
    if picture[:3] != stated:
        raise ValueError(f"the compressed picture is {picture[:3]}, the tags say {stated}")
    if not 2 <= picture.bits <= tags.BitsAllocated:
        raise ValueError(f"the compressed picture has {picture.bits} bits a pixel")


def _jpeg_header(frame: bytes, syntax: str) -> _Picture:
    """The header of a JPEG or JPEG-LS picture (ISO/IEC 10918-1, B.2; 14495-1, C.2).

    Raises ValueError or struct.error: it is not exactly one frame with one scan, from the first
    byte to the last. GDCM ends the process on some of those."""
    from pydicom.uid import JPEGLossless, JPEGLosslessSV1, JPEGLSTransferSyntaxes

    is_ls = syntax in JPEGLSTransferSyntaxes
    lossless = syntax in (JPEGLossless, JPEGLosslessSV1)
    kinds = {0xF7} if is_ls else {0xC3} if lossless else {0xC0, 0xC1}
    others = _LS_SEGMENTS if is_ls else _SEGMENTS
    _check_ends(frame, _START)
    at, frames, marker = len(_START), [], 0
    while marker != _SCAN:
        fill, marker, length = struct.unpack_from(">BBH", frame, at)
        if fill != 0xFF or length < 2 or marker not in {_SCAN, *kinds, *others}:
            raise ValueError(_DAMAGED)
        if marker in kinds:
            bits, rows, columns, samples, name = struct.unpack_from(">BHHBB", frame, at + 4)
            frames.append((length, name, _Picture(rows, columns, samples, bits)))
        at += 2 + length
    # The first marker among the coded numbers must be the end: a coded byte 0xFF is followed by
    # one that no marker has.
    marker_bytes = re.compile(rb"\xff[\x80-\xff]" if is_ls else rb"\xff[^\x00\xd0-\xd7]")
    end = marker_bytes.search(frame, at)
    whole = end is not None and not frame[end.start() + len(_END) :].strip(b"\0")
    if len(frames) != 1 or frames[0][0] != 11 or not whole:
        raise ValueError(_DAMAGED)
    _, name, picture = frames[0]
    if length != 8 or frame[at - 6 : at - 4] != bytes([1, name]):
        raise ValueError(_DAMAGED)
    return picture


def _j2k_header(frame: bytes) -> _Picture:
    """The header of a JPEG 2000 codestream (ISO/IEC 15444-1, A.5.1), likewise."""
    _check_ends(frame, _J2K_START)
    right, lower, left, upper, *_, samples = struct.unpack_from(">8IH", frame, 8)
    bits, across, down = struct.unpack_from(">3B", frame, 42)
    if (across, down) != (1, 1):
        raise ValueError("the compressed picture leaves out pixels")
    return _Picture(lower - upper, right - left, samples, (bits & 0x7F) + 1)


def _check_ends(frame: bytes, start: bytes) -> None:
    if not frame.startswith(start) or not frame.rstrip(b"\0").endswith(_END):
        raise ValueError(_DAMAGED)
