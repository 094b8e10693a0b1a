"""Sequences of images with fields of each frame: MetaImage (.mha, .mhd) and NRRD, as PLUS, IGSIO
and 3D Slicer write them.

Formats: https://pluslib.readthedocs.io (Sequence file, Ultrasound image orientation),
https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BufferedIOBase
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from tumortrack.core.errors import InputError, readable
from tumortrack.core.grid import GZIP_BEST
from tumortrack.io.volume import NRRD_TYPES, nrrd_header

LARGEST_HEADER = 64 * 2**20  # bytes: 20,000 frames with 20 fields each
_MOST_FRAMES, _MOST_PIXELS = 100_000, 2**24
_MOST_BYTES = 4 * 2**30  # of all images, 14,000 of 640 x 480, which are unpacked one by one
_MOST_AT_ONCE = 2**30  # where frames are the fastest axis
_CHUNK = 2**20
_CODES = {
    "CHAR": "i1", "UCHAR": "u1", "SHORT": "i2", "USHORT": "u2", "INT": "i4", "UINT": "u4",
    "LONG": "i4", "ULONG": "u4", "FLOAT": "f4", "DOUBLE": "f8",
}  # fmt: skip
_OF_FRAME = re.compile(r"Seq_Frame(\d{1,9})_(\w+)")  # four digits; from frame 10,000 on five
_LAST = re.compile(rb"(?m)^ElementDataFile[ \t]*=[ \t]*(.*?)[ \t]*(\r?\n|\Z)")
_COLOURS = ("vector", "rgb-color", "rgba-color", "3-color", "4-color")
_FLIPS = {"MF": (1, 1), "UF": (1, -1), "MN": (-1, 1), "UN": (-1, -1)}  # of rows, of columns

Image = Shaped[np.ndarray, "h w *colours"]


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """A file's header. ``axes``: kind and size of each, the fastest first; frames are the first or
    the last. ``fields``: of the file and of all frames. ``data``: the file of the pixels, of which
    ``stored`` bytes follow ``start``."""

    path: Path
    axes: tuple[tuple[str, int], ...]
    dtype: np.dtype
    fields: dict[str, str]
    data: Path
    start: int
    stored: int
    compressed: bool

    @property
    def shape(self) -> tuple[int, ...]:
        """Of an image: rows, columns, and colours if there are several."""
        sizes = [size for kind, size in self.axes if kind == "domain"]
        colours = math.prod(size for kind, size in self.axes if kind == "colour")
        return (sizes[1], sizes[0], *([colours] if colours > 1 else []))

    @property
    def has_images(self) -> bool:
        """Not only poses: then it says 0 x 0, or 1 x 1."""
        return min(self.shape[:2]) > 1

    @property
    def orientation(self) -> str:
        """PLUS's letters: M or U, the marked or unmarked side of the probe, for the direction of
        rows; F or N, far or near, for that of columns. MF where it says none."""
        return self.fields.get("UltrasoundImageOrientation", "").upper() or "MF"

    @cached_property
    def frames(self) -> tuple[dict[str, str], ...]:
        """The fields of each frame."""
        frames = tuple(dict[str, str]() for _ in range(dict(self.axes)["frame"]))
        for name, value in self.fields.items():
            if (match := _OF_FRAME.fullmatch(name)) and int(match[1]) < len(frames):
                frames[int(match[1])][match[2]] = value
        return frames

    def images(self) -> Iterator[Image]:
        """One by one, as they lie in the file. Raises InputError: truncated, damaged."""
        size, count = math.prod(self.shape) * self.dtype.itemsize, len(self.frames)
        with readable(self.data, "is truncated or damaged"), self.data.open("rb") as stream:
            stream.seek(self.start)
            read = _unpacking(stream, self.stored) if self.compressed else stream.read
            if self.axes[0][0] == "frame":
                pixels = np.frombuffer(read(count * size), self.dtype)
                yield from np.moveaxis(pixels.reshape(*self.shape, count), -1, 0)
                return
            for _ in range(count):
                yield np.frombuffer(read(size), self.dtype).reshape(self.shape)
            if self.compressed and read(1):
                raise InputError(f"{self.data} holds more than its header says. Export it again.")


def as_mf(image: Image, orientation: str, where: Path) -> Image:
    """An image of this orientation as transforms from ``Image`` take it: MF. Raises InputError: it
    is none of PLUS's, or rows are its scan lines, as of radio-frequency data."""
    if (flips := _FLIPS.get(orientation[:2])) is None:
        raise InputError(
            f"{where}: UltrasoundImageOrientation is {orientation!r}; allowed: {', '.join(_FLIPS)}."
        )
    return image[:: flips[0], :: flips[1]]


def read_sequence(path: Path) -> ImageSequence:
    """The header of a .mha, .mhd or .nrrd file, checked before anything is unpacked. Raises
    InputError: missing, damaged, three-dimensional images, pixels outside its folder, too large."""
    if not path.is_file():
        raise InputError(f"{path} does not exist, or is a folder, a pipe or a device.")
    with readable(path, "has a header that is damaged or lacks a field"):
        return _checked(_nrrd(path) if path.suffix.lower() == ".nrrd" else _meta_image(path))


def _meta_image(path: Path) -> ImageSequence:
    with path.open("rb") as stream:
        head = stream.read(LARGEST_HEADER)
    if (last := _LAST.search(head)) is None or not head.startswith(b"ObjectType"):
        raise InputError(f"{path} is no MetaImage: it has no ElementDataFile. Export it again.")
    lines = (line.partition("=") for line in head[: last.start()].decode("latin-1").splitlines())
    fields = {name.strip(): value.strip() for name, _, value in lines}
    data, start = path, last.end()
    if (name := last[1].decode()) != "LOCAL":
        data, start = path.parent / name, 0
        inside = data.resolve().parent == path.parent.resolve()
        if Path(name).name != name or not inside or not data.is_file():
            raise InputError(
                f"{path}: ElementDataFile is {name[:80]!r}; allowed: LOCAL, or a file beside it."
            )
    compressed = fields.get("CompressedData", "False").lower() == "true"
    stored = data.stat().st_size - start
    if compressed and (said := int(fields.get("CompressedDataSize") or 0)):
        if said > stored:
            raise InputError(f"{data} is truncated: {stored} of {said} bytes (CompressedDataSize).")
        stored = said
    swapped = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", ""))
    code = _CODES[fields["ElementType"].removeprefix("MET_")]
    dtype = np.dtype((">" if swapped.lower() == "true" else "<") + code)
    sizes, kinds = fields["DimSize"].split(), fields.get("Kinds", "").lower().split()
    axes = _axes(path, sizes, kinds, int(fields.get("ElementNumberOfChannels") or 1))
    return ImageSequence(path, axes, dtype, fields, data, start, stored, compressed)


def _nrrd(path: Path) -> ImageSequence:
    fields, keys, start = nrrd_header(path, LARGEST_HEADER)
    encoding = fields.get("encoding", "").lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise InputError(f"{path}: encoding {encoding!r} is not read. Export as raw or gzip.")
    order = ">" if fields.get("endian", "").lower() == "big" else "<"
    dtype = np.dtype(order + NRRD_TYPES[fields["type"].lower()])
    axes = _axes(path, fields["sizes"].split(), fields.get("kinds", "").lower().split(), 1)
    stored = path.stat().st_size - start
    return ImageSequence(path, axes, dtype, keys, path, start, stored, encoding != "raw")


def _axes(
    path: Path, sizes: Sequence[str], kinds: Sequence[str], colours: int
) -> tuple[tuple[str, int], ...]:
    """Kinds become ``frame``, ``colour`` and ``domain``; without any the last is of frames, as for
    IGSIO. ``colours``: of MetaImage, which names no axis for them."""
    known = {**dict.fromkeys(("list", "time"), "frame"), **dict.fromkeys(_COLOURS, "colour")}
    named = [known.get(kind, "domain") for kind in kinds or ["domain"] * len(sizes)]
    if "frame" not in named:
        named[-1] = "frame"
    axes = [("colour", colours)] * (colours > 1) + [*zip(named, map(int, sizes), strict=True)]
    spatial = [size for kind, size in axes if kind == "domain"]
    order = [kind for kind, _ in axes if kind != "domain"]
    ends = axes[0][0], axes[-1][0]
    if len(order) > 1:
        right = order == ["colour", "frame"] and ends == ("colour", "frame")
    else:
        right = "frame" in ends
    flat = len(spatial) > 1 and all(size == 1 for size in spatial[2:])
    if not right or not flat or min(size for _, size in axes) < 0:
        raise InputError(
            f"{path}: its axes are {' x '.join(sizes)} {' '.join(kinds)}; allowed: width x "
            "height x frames, of flat images."
        )
    return tuple(axes)


def _checked(sequence: ImageSequence) -> ImageSequence:
    count, pixels = dict(sequence.axes)["frame"], math.prod(sequence.shape)
    needed, once = count * pixels * sequence.dtype.itemsize, sequence.axes[0][0] == "frame"
    most = _MOST_AT_ONCE if once else _MOST_BYTES
    if count > _MOST_FRAMES or pixels > _MOST_PIXELS or needed > most:
        raise InputError(
            f"{sequence.path} claims {count} images of {pixels} numbers, {needed} bytes; allowed: "
            f"{_MOST_FRAMES}, {_MOST_PIXELS} and {most}. Give a part of it."
        )
    unpacked = sequence.stored * (GZIP_BEST if sequence.compressed else 1)
    if sequence.has_images and needed > unpacked:
        raise InputError(f"{sequence.data} is shorter than its header says ({needed} bytes).")
    return sequence


def _unpacking(stream: BufferedIOBase, stored: int) -> Callable[[int], bytes]:
    """Reads the next so many bytes of a zlib or gzip stream of ``stored`` bytes, and never unpacks
    more than those; fewer only at its end, where its checksum is."""
    unpack, chunks = zlib.decompressobj(zlib.MAX_WBITS | 32), [_CHUNK] * (stored // _CHUNK)
    chunks.append(stored % _CHUNK)

    def read(count: int) -> bytes:
        found = list[bytes]()
        while count and not unpack.eof:
            given = unpack.unconsumed_tail or stream.read(chunks.pop(0) if chunks else 0)
            piece = unpack.decompress(given, count)
            if not given and not piece:
                raise EOFError("its compressed data end early")
            found.append(piece)
            count -= len(piece)
        return b"".join(found)

    return read
