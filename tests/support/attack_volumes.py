"""Hostile input: NIfTI, NRRD and MetaImage volumes, and names of files."""

from __future__ import annotations

import gzip
import io
import os
import struct
import zlib
from collections.abc import Callable

import numpy as np

from attack import Make, Room, attacks

NAN = float("nan")


def ball(size: int = 40) -> np.ndarray:
    index = np.indices((size,) * 3) - size / 2
    return ((index**2).sum(0) < (0.4 * size) ** 2).astype(np.uint8)


def nifti_header(shape: tuple[int, ...], code: int = 2, bits: int = 8) -> bytearray:
    """A plain NIfTI-1 header with 1 mm voxels, LPS-free: an identity sform."""
    header = bytearray(352)
    struct.pack_into("<i", header, 0, 348)
    dims = [len(shape), *shape] + [1] * (7 - len(shape))
    struct.pack_into("<8h", header, 40, *[min(d, 32767) for d in dims])
    struct.pack_into("<hh", header, 70, code, bits)
    struct.pack_into("<8f", header, 76, 1, *[1.0] * 7)
    struct.pack_into("<f", header, 108, 352.0)
    struct.pack_into("<f", header, 112, 1.0)  # slope
    header[123] = 2  # mm
    struct.pack_into("<hh", header, 252, 1, 1)
    struct.pack_into("<4f", header, 280, 1, 0, 0, 0)
    struct.pack_into("<4f", header, 296, 0, 1, 0, 0)
    struct.pack_into("<4f", header, 312, 0, 0, 1, 0)
    header[344:348] = b"n+1\0"
    return header


def file(content: Callable[[], bytes], name: str = "in.nii.gz", *options: object) -> Make:
    return lambda room: ["prepare", room.file(name, content()), room.out, "--labels", *options]


def header(form: str, offset: int, *values: object) -> Make:
    """A ball whose header was changed."""

    def content() -> bytes:
        changed = nifti_header((60, 60, 60))
        struct.pack_into(form, changed, offset, *values)
        return bytes(changed) + ball(60).tobytes("F")

    return file(content, "in.nii")


def zipped(head: bytes, megabytes: int, level: int = 1) -> bytes:
    """gzip of a head and zeros behind it."""
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", compresslevel=level) as stream:
        stream.write(head)
        for _ in range(megabytes):
            stream.write(bytes(1_000_000))
    return out.getvalue()


def labels(make: Callable[[], np.ndarray], *options: object) -> Make:
    def content() -> bytes:
        array = make()
        return gzip.compress(bytes(nifti_header(array.shape)) + array.tobytes("F"), 1)

    return file(content, "in.nii.gz", *options)


def _cut_short() -> bytes:
    whole = gzip.compress(bytes(nifti_header((40, 40, 40))) + ball().tobytes("F"))
    return whole[: len(whole) // 2]


def _of_other_content() -> bytes:
    """Voxels zeroed and the checksum of what was there before: only reading to the end tells."""
    voxels = ball(60)
    head = bytes(nifti_header((60, 60, 60)))
    whole = head + voxels.tobytes("F")
    voxels[:, :, 55:] = 0
    voxels[10:13, 30, 30] = 0
    stream = gzip.compress(head + voxels.tobytes("F"))
    return stream[:-8] + struct.pack("<II", zlib.crc32(whole), len(whole))


def _extended(offset: float, size: int, zeros_mb: int) -> bytes:
    """An extension of the header of such a size, before the data at such an offset."""
    changed = nifti_header((60, 60, 60))
    struct.pack_into("<f", changed, 108, offset)
    changed[348] = 1
    return zipped(bytes(changed) + struct.pack("<ii", size, 6), zeros_mb)


def _big_endian() -> bytes:
    """With the scale that nibabel leaves in headers whose scale it has applied."""
    import nibabel

    native = nibabel.Nifti1Header(bytes(nifti_header((60, 60, 60), 4, 16)[:348]))
    native["scl_slope"] = native["scl_inter"] = np.nan
    content = native.as_byteswapped(">").binaryblock + bytes(4)
    return gzip.compress(content + ball(60).astype(">i2").tobytes("F"))


def _noise(size: int, labels: tuple[int, int], margin: int) -> np.ndarray:
    noise = np.random.default_rng(0).integers(*labels, (size,) * 3, dtype=np.uint8)
    return np.pad(noise, margin)


def _2000_tumors() -> np.ndarray:
    """Cubes of half a ml on a lattice beside the kidney."""
    array = np.zeros((200, 200, 200), np.uint8)
    array[:60, :60, :60] = ball(60)
    tumor = np.zeros((12, 12, 12), np.uint8)
    tumor[:8, :8, :8] = 2
    array[:192, :192, 80:176] = np.tile(tumor, (16, 16, 8))
    return array


def _sparse_dots() -> np.ndarray:
    """A kidney, and every eighth voxel about it a piece of its own."""
    array = np.zeros((256, 256, 256), np.uint8)
    array[1::2, 1::2, 1::2] = 2
    array[100:160, 100:160, 100:160] = ball(60)
    return array


def _tumor_round_the_organ() -> np.ndarray:
    array = 2 * ball(60)
    array[28:32, 28:32, 28:32] = 1
    return array


def _fractions() -> bytes:
    values = (ball() * 0.5).astype("<f4").tobytes("F")
    return gzip.compress(bytes(nifti_header((40, 40, 40), 16, 32)) + values)


SPACE = (
    "space: left-posterior-superior\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"
    "space origin: (0,0,0)\n"
)


def nrrd(sizes: str, more: str, data: bytes = b"", dimension: int = 3, space: str = SPACE) -> bytes:
    head = f"type: uint8\ndimension: {dimension}\nsizes: {sizes}\n{space}{more}"
    return f"NRRD0004\n{head}\n\n".encode() + data


def nrrd_file(*arguments: object, **more: object) -> Make:
    return file(lambda: nrrd(*arguments, **more), "in.nrrd")  # type: ignore[arg-type]


def _detached_data(room: Room) -> list[object]:
    room.file("secret.raw", ball().tobytes("F"))
    return nrrd_file("40 40 40", "encoding: raw\ndata file: secret.raw")(room)


def _target(*names: str) -> Make:
    """A right volume, and a folder that cannot be made."""
    return lambda room: [*header("<B", 123, 2)(room)[:2], room.folder.joinpath(*names), "--labels"]


def _names_in_latin1(room: Room) -> list[object]:
    """Names that are no UTF-8, of input and target: used as they are, or refused."""
    _, volume, _, labels = header("<B", 123, 2)(room)
    other = room.folder / os.fsdecode(b"sch\xf6n.nii")
    os.rename(str(volume), other)
    return ["prepare", other, room.folder / os.fsdecode(b"f\xfcr"), labels]


ATTACKS = attacks(
    refused={
        "nifti_nan_affine": header("<f", 280, NAN),
        "nifti_infinite_origin": header("<f", 292, float("inf")),
        "nifti_singular_affine": header("<4f", 312, 0, 0, 0, 0),
        "nifti_sform_half_of_qform": header("<4f", 280, 0.5, 0, 0, 0),
        "nifti_negative_dimension": header("<h", 42, -40),
        "nifti_claims_more_than_it_holds": header("<3h", 42, 4000, 4000, 4000),
        "nifti_complex_numbers": header("<hh", 70, 32, 64),
        "nifti_unknown_numbers": header("<hh", 70, 77, 8),
        "nifti_data_far_behind": header("<f", 108, 1e30),
        "nifti_data_in_the_header": header("<f", 108, -4.0),
        "nifti_nan_slope": header("<f", 112, NAN),
        "nifti_five_dimensions": header("<8h", 40, 5, 60, 60, 60, 2, 2, 1, 1),
        "nifti_a_plane": header("<8h", 40, 2, 60, 60, 1, 1, 1, 1, 1),
        "nifti_header_of_another_size": header("<i", 0, 2**31 - 1),
        "nifti_metres": header("<B", 123, 1),
        "nifti_kilometre_voxels": header("<4f", 280, 1e6, 0, 0, 0),
        "gzip_cut_short": file(_cut_short),
        "gzip_of_other_content": file(_of_other_content),
        # A whole volume, and 2 GB behind it.
        "gzip_goes_on": file(
            lambda: zipped(bytes(nifti_header((60, 60, 60))) + ball(60).tobytes("F"), 2000)
        ),
        # 4 MB of 64-bit zeros within all limits of shape.
        "gzip_unpacks_to_4_gb": file(
            lambda: zipped(bytes(nifti_header((1000, 1000, 500), 64, 64)), 4000, 9)
        ),
        # Too short for its own head, before 2 GB.
        "gzip_extension_of_size_7": file(lambda: _extended(1024.0, 7, 2000)),
        # 7 MB that unpack to 7 GB.
        "gzip_bomb": file(lambda: zipped(bytes(nifti_header((2000, 2000, 1800))), 1800 * 4, 9)),
        # It claims 2 GB.
        "gzip_header_extension": file(lambda: _extended(2.0e9, 1_999_999_632, 5)),
        "labels_of_noise": labels(lambda: _noise(128, (0, 3), 4)),  # thousands of pieces
        "labels_of_255_noises": labels(lambda: _noise(130, (1, 256), 8)),  # as many tumors
        "labels_of_2000_tumors": labels(_2000_tumors),
        "labels_of_sparse_dots": labels(_sparse_dots, "--min-tumor-ml", 0),
        "labels_of_fractions": file(_fractions),
        # The organ fills the volume: there is no surface in it.
        "labels_all_one": labels(lambda: np.ones((60, 60, 60), np.uint8)),
        "labels_all_zero": labels(lambda: np.zeros((60, 60, 60), np.uint8)),
        "labels_tumor_round_the_organ": labels(_tumor_round_the_organ),
        "nrrd_two_dimensions_three_sizes": nrrd_file(
            "40 40 40", "encoding: raw", ball().tobytes("F"), dimension=2
        ),
        "nrrd_gzip_of_other_content": nrrd_file(
            "60 60 60", "encoding: gzip", gzip.compress(ball(60).tobytes("F"))[:-8] + bytes(8)
        ),
        "nrrd_detached_data": _detached_data,
        "nrrd_claims_terabytes": nrrd_file("30000 30000 30000", "encoding: raw"),
        "nrrd_nan_directions": nrrd_file(
            *("40 40 40", "encoding: raw", ball().tobytes("F")), space=SPACE.replace("(1", "(nan")
        ),
        "nrrd_unknown_encoding": nrrd_file("4 4 4", "encoding: zstd"),
        "mha_names_another_file": file(
            lambda: (
                b"ObjectType = Image\nNDims = 3\nBinaryData = True\nDimSize = 40 40 40\n"
                b"ElementType = MET_UCHAR\nElementDataFile = /etc/passwd\n"
            ),
            "in.mha",
        ),
        "volume_is_a_fifo": lambda room: ["prepare", room.fifo("in.nii.gz"), room.out],
        "volume_without_end": lambda room: ["prepare", room.endless("in.nii"), room.out],
        "volume_is_text": file(lambda: b"no volume at all", "in.nii"),
        "volume_is_empty": file(lambda: b""),
        "volume_is_missing": lambda room: ["prepare", room.folder / "nothing.nii.gz", room.out],
        "name_of_300_bytes": lambda room: ["prepare", room.folder / ("x" * 300 + ".nii"), room.out],
        "target_of_300_bytes": _target("x" * 300),
        "target_below_a_file": _target("in.nii", "out"),
    },
    either={"name_in_latin1": _names_in_latin1},
    read={"nifti_big_endian": file(_big_endian)},
)
