"""Hostile input: NIfTI, NRRD and MetaImage volumes, and names of files."""

from __future__ import annotations

import gzip
import io
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from attack_registry import ATTACKS, Made, attack, may_finish, must_finish


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


def volume(folder: Path, change: Callable[[bytearray], None], data: bytes | None = None) -> Made:
    """`prepare` on a NIfTI ball whose header was changed."""
    header = nifti_header((60, 60, 60))
    change(header)
    (folder / "in.nii").write_bytes(
        bytes(header) + (ball(60).tobytes("F") if data is None else data)
    )
    return ["prepare", folder / "in.nii", folder / "out", "--labels"]


def put(form: str, offset: int, *values: object) -> Callable[[bytearray], None]:
    return lambda header: struct.pack_into(form, header, offset, *values)


@must_finish
def _nifti_big_endian(folder: Path, base: Path) -> Made:
    """With the scale that nibabel leaves in headers whose scale it has applied."""
    import nibabel

    header = nibabel.Nifti1Header(bytes(nifti_header((60, 60, 60), 4, 16)[:348]))
    header["scl_slope"] = header["scl_inter"] = np.nan
    content = header.as_byteswapped(">").binaryblock + bytes(4)
    return packed(folder, gzip.compress(content + ball(60).astype(">i2").tobytes("F")))


for name, form, offset, values in (
    ("nifti_nan_affine", "<f", 280, (float("nan"),)),
    ("nifti_infinite_origin", "<f", 292, (float("inf"),)),
    ("nifti_singular_affine", "<4f", 312, (0, 0, 0, 0)),
    ("nifti_sform_half_of_qform", "<4f", 280, (0.5, 0, 0, 0)),
    ("nifti_negative_dimension", "<h", 42, (-40,)),
    ("nifti_claims_more_than_it_holds", "<3h", 42, (4000, 4000, 4000)),
    ("nifti_complex_numbers", "<hh", 70, (32, 64)),
    ("nifti_unknown_numbers", "<hh", 70, (77, 8)),
    ("nifti_data_far_behind", "<f", 108, (1e30,)),
    ("nifti_data_in_the_header", "<f", 108, (-4.0,)),
    ("nifti_nan_slope", "<f", 112, (float("nan"),)),
    ("nifti_five_dimensions", "<8h", 40, (5, 60, 60, 60, 2, 2, 1, 1)),
    ("nifti_a_plane", "<8h", 40, (2, 60, 60, 1, 1, 1, 1, 1)),
    ("nifti_header_of_another_size", "<i", 0, (2**31 - 1,)),
    ("nifti_metres", "<B", 123, (1,)),
    ("nifti_kilometre_voxels", "<4f", 280, (1e6, 0, 0, 0)),
):
    ATTACKS[name] = lambda folder, base, f=form, o=offset, v=values: volume(folder, put(f, o, *v))


def zipped(head: bytes, megabytes: int, level: int = 1) -> bytes:
    """gzip of a head and zeros behind it."""
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", compresslevel=level) as stream:
        stream.write(head)
        for _ in range(megabytes):
            stream.write(bytes(1_000_000))
    return out.getvalue()


def packed(folder: Path, content: bytes, name: str = "in.nii.gz") -> Made:
    (folder / name).write_bytes(content)
    return ["prepare", folder / name, folder / "out", "--labels"]


@attack
def _gzip_cut_short(folder: Path, base: Path) -> Made:
    whole = gzip.compress(bytes(nifti_header((40, 40, 40))) + ball().tobytes("F"))
    return packed(folder, whole[: len(whole) // 2])


@attack
def _gzip_of_other_content(folder: Path, base: Path) -> Made:
    """Voxels zeroed and the checksum of what was there before: only reading to the end tells."""
    voxels = ball(60)
    head = bytes(nifti_header((60, 60, 60)))
    whole = head + voxels.tobytes("F")
    voxels[:, :, 55:] = 0
    voxels[10:13, 30, 30] = 0
    changed = head + voxels.tobytes("F")
    stream = gzip.compress(changed)
    return packed(folder, stream[:-8] + struct.pack("<II", zlib.crc32(whole), len(whole)))


@attack
def _gzip_goes_on(folder: Path, base: Path) -> Made:
    """A whole volume, and 2 GB behind it."""
    whole = bytes(nifti_header((60, 60, 60))) + ball(60).tobytes("F")
    return packed(folder, zipped(whole, 2000))


@attack
def _gzip_unpacks_to_4_gb(folder: Path, base: Path) -> Made:
    """4 MB of 64-bit zeros within all limits of shape."""
    return packed(folder, zipped(bytes(nifti_header((1000, 1000, 500), 64, 64)), 4000, 9))


@attack
def _gzip_extension_of_size_7(folder: Path, base: Path) -> Made:
    """An extension of the header too short for its own head, before 2 GB."""
    header = nifti_header((60, 60, 60))
    struct.pack_into("<f", header, 108, 1024.0)
    header[348] = 1
    return packed(folder, zipped(bytes(header) + struct.pack("<ii", 7, 6), 2000))


@attack
def _gzip_bomb(folder: Path, base: Path) -> Made:
    """7 MB that unpack to 7 GB."""
    return packed(folder, zipped(bytes(nifti_header((2000, 2000, 1800))), 1800 * 4, 9))


@attack
def _gzip_header_extension(folder: Path, base: Path) -> Made:
    """An extension of the header that claims 2 GB."""
    header = nifti_header((40, 40, 40))
    struct.pack_into("<f", header, 108, 2.0e9)
    header[348] = 1
    extension = struct.pack("<ii", 1_999_999_632, 6)
    return packed(folder, gzip.compress(bytes(header) + extension + bytes(5_000_000)))


@attack
def _labels_of_noise(folder: Path, base: Path) -> Made:
    """Thousands of pieces."""
    noise = np.random.default_rng(0).integers(0, 3, (128, 128, 128), dtype=np.uint8)
    labels = np.pad(noise, 4)
    return packed(folder, gzip.compress(bytes(nifti_header(labels.shape)) + labels.tobytes("F")))


@attack
def _labels_of_255_noises(folder: Path, base: Path) -> Made:
    """Every voxel another tumor."""
    noise = np.random.default_rng(0).integers(1, 256, (130, 130, 130), dtype=np.uint8)
    labels = np.pad(noise, 8)
    return packed(folder, gzip.compress(bytes(nifti_header(labels.shape)) + labels.tobytes("F"), 1))


@attack
def _labels_of_2000_tumors(folder: Path, base: Path) -> Made:
    """Cubes of half a ml on a lattice beside the kidney."""
    labels = np.zeros((200, 200, 200), np.uint8)
    labels[:60, :60, :60] = ball(60)
    one = np.zeros((12, 12, 12), np.uint8)
    one[:8, :8, :8] = 2
    labels[:192, :192, 80:176] = np.tile(one, (16, 16, 8))
    return packed(folder, gzip.compress(bytes(nifti_header(labels.shape)) + labels.tobytes("F"), 1))


@attack
def _labels_of_sparse_dots(folder: Path, base: Path) -> Made:
    """A kidney, and every eighth voxel about it a piece of its own."""
    labels = np.zeros((256, 256, 256), np.uint8)
    labels[1::2, 1::2, 1::2] = 2
    labels[100:160, 100:160, 100:160] = 0
    labels[100:160, 100:160, 100:160] = ball(60)
    made = packed(folder, gzip.compress(bytes(nifti_header(labels.shape)) + labels.tobytes("F"), 1))
    return [*made, "--min-tumor-ml", 0]


@attack
def _labels_of_fractions(folder: Path, base: Path) -> Made:
    header = nifti_header((40, 40, 40), 16, 32)
    return packed(folder, gzip.compress(bytes(header) + (ball() * 0.5).astype("<f4").tobytes("F")))


@attack
def _labels_all_one(folder: Path, base: Path) -> Made:
    """The organ fills the volume: there is no surface in it."""
    return volume(folder, lambda header: None, np.ones(60**3, np.uint8).tobytes())


@attack
def _labels_all_zero(folder: Path, base: Path) -> Made:
    return volume(folder, lambda header: None, bytes(60**3))


@attack
def _labels_tumor_round_the_organ(folder: Path, base: Path) -> Made:
    """The tumor encloses the kidney."""
    labels = 2 * ball(60)
    labels[28:32, 28:32, 28:32] = 1
    return volume(folder, lambda header: None, labels.tobytes("F"))


def nrrd(folder: Path, lines: str, data: bytes = b"") -> Made:
    (folder / "in.nrrd").write_bytes(f"NRRD0004\n{lines}\n\n".encode() + data)
    return ["prepare", folder / "in.nrrd", folder / "out", "--labels"]


_SPACE = (
    "space: left-posterior-superior\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: "
    "(0,0,0)\n"
)


@attack
def _nrrd_two_dimensions_three_sizes(folder: Path, base: Path) -> Made:
    head = f"type: uint8\ndimension: 2\nsizes: 40 40 40\n{_SPACE}encoding: raw"
    return nrrd(folder, head, ball().tobytes("F"))


@attack
def _nrrd_gzip_of_other_content(folder: Path, base: Path) -> Made:
    head = f"type: uint8\ndimension: 3\nsizes: 60 60 60\n{_SPACE}encoding: gzip"
    stream = gzip.compress(ball(60).tobytes("F"))
    return nrrd(folder, head, stream[:-8] + b"\0" * 8)


@attack
def _nrrd_detached_data(folder: Path, base: Path) -> Made:
    (folder / "secret.raw").write_bytes(ball().tobytes("F"))
    head = f"type: uint8\ndimension: 3\nsizes: 40 40 40\n{_SPACE}encoding: raw"
    return nrrd(folder, head + "\ndata file: secret.raw")


@attack
def _nrrd_claims_terabytes(folder: Path, base: Path) -> Made:
    return nrrd(
        folder, f"type: uint8\ndimension: 3\nsizes: 30000 30000 30000\n{_SPACE}encoding: raw"
    )


@attack
def _nrrd_nan_directions(folder: Path, base: Path) -> Made:
    head = "type: uint8\ndimension: 3\nsizes: 40 40 40\nspace: left-posterior-superior\n"
    head += "space directions: (nan,0,0) (0,1,0) (0,0,1)\nspace origin: (0,0,0)\nencoding: raw"
    return nrrd(folder, head, ball().tobytes("F"))


@attack
def _nrrd_unknown_encoding(folder: Path, base: Path) -> Made:
    return nrrd(folder, f"type: uint8\ndimension: 3\nsizes: 4 4 4\n{_SPACE}encoding: zstd")


@attack
def _mha_names_another_file(folder: Path, base: Path) -> Made:
    (folder / "in.mha").write_text(
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nDimSize = 40 40 40\n"
        "ElementType = MET_UCHAR\nElementDataFile = /etc/passwd\n"
    )
    return ["prepare", folder / "in.mha", folder / "out", "--labels"]


@attack
def _volume_is_a_fifo(folder: Path, base: Path) -> Made:
    os.mkfifo(folder / "in.nii.gz")
    return ["prepare", folder / "in.nii.gz", folder / "out"]


@attack
def _volume_without_end(folder: Path, base: Path) -> Made:
    (folder / "in.nii").symlink_to("/dev/zero")
    return ["prepare", folder / "in.nii", folder / "out"]


@attack
def _volume_is_text(folder: Path, base: Path) -> Made:
    return packed(folder, b"no volume at all", "in.nii")


@attack
def _volume_is_empty(folder: Path, base: Path) -> Made:
    return packed(folder, b"")


@attack
def _volume_is_missing(folder: Path, base: Path) -> Made:
    return ["prepare", folder / "nothing.nii.gz", folder / "out"]


@attack
def _name_of_300_bytes(folder: Path, base: Path) -> Made:
    return ["prepare", folder / ("x" * 300 + ".nii"), folder / "out"]


@attack
def _target_of_300_bytes(folder: Path, base: Path) -> Made:
    made = volume(folder, lambda header: None)
    return [*made[:2], folder / ("x" * 300), "--labels"]


@may_finish
def _name_in_latin1(folder: Path, base: Path) -> Made:
    """Names that are no UTF-8, of input and target: used as they are, or refused."""
    made = volume(folder, lambda header: None)
    other = folder / os.fsdecode(b"sch\xf6n.nii")
    Path(str(made[1])).rename(other)
    return ["prepare", other, folder / os.fsdecode(b"f\xfcr"), "--labels"]


@attack
def _model_name_of_300_bytes(folder: Path, base: Path) -> Made:
    return ["locate", "x" * 300, base / "scenes" / "0000" / "cloud.ply", folder / "out"]


@attack
def _cloud_name_of_300_bytes(folder: Path, base: Path) -> Made:
    return ["locate", base / "model", "x" * 300 + ".ply", folder / "out"]


@attack
def _target_below_a_file(folder: Path, base: Path) -> Made:
    made = volume(folder, lambda header: None)
    return [*made[:2], folder / "in.nii" / "out", "--labels"]
