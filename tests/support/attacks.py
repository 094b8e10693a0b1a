"""Hostile files and calls: each must end in one clear line, in bounded time and memory.

python tests/support/attacks.py FOLDER [NAME ...]    make them in FOLDER, run them, print a table

Each attack is a function that writes what it needs into an empty folder and returns the arguments
of a command; its docstring says what is wrong with them. What the command may do is in ``Outcome``.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SECONDS, MEGABYTES = 20.0, 1024
Made = list[object]
Attack = Callable[[Path, Path], Made]
ATTACKS: dict[str, Attack] = {}
WITHOUT_BASE = (  # how the names of attacks begin that need nothing but their own folder
    *("nifti_", "gzip_", "labels_", "nrrd_", "mha_", "volume_", "name_", "target_"),
    *("dicom_", "mesh_"),
)
FINISH: set[str] = set()  # may also end well, with a note or a verdict other than good


def attack(make: Attack) -> Attack:
    ATTACKS[make.__name__.strip("_")] = make
    return make


def may_finish(make: Attack) -> Attack:
    FINISH.add(make.__name__.strip("_"))
    return attack(make)


# Volumes --------------------------------------------------------------------------------------


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
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", compresslevel=1) as stream:
        stream.write(bytes(nifti_header((60, 60, 60))) + ball(60).tobytes("F"))
        for _ in range(2000):
            stream.write(bytes(1_000_000))
    return packed(folder, out.getvalue())


@attack
def _gzip_unpacks_to_4_gb(folder: Path, base: Path) -> Made:
    """4 MB of 64-bit zeros within all limits of shape."""
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", compresslevel=9) as stream:
        stream.write(bytes(nifti_header((1000, 1000, 500), 64, 64)))
        for _ in range(4000):
            stream.write(bytes(1_000_000))
    return packed(folder, out.getvalue())


@attack
def _gzip_extension_of_size_7(folder: Path, base: Path) -> Made:
    """An extension of the header too short for its own head, before 2 GB."""
    header = nifti_header((60, 60, 60))
    struct.pack_into("<f", header, 108, 1024.0)
    header[348] = 1
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", compresslevel=1) as stream:
        stream.write(bytes(header) + struct.pack("<ii", 7, 6))
        for _ in range(2000):
            stream.write(bytes(1_000_000))
    return packed(folder, out.getvalue())


@attack
def _gzip_bomb(folder: Path, base: Path) -> Made:
    """7 MB that unpack to 7 GB."""
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", compresslevel=9) as stream:
        stream.write(bytes(nifti_header((2000, 2000, 1800))))
        for _ in range(1800 * 4):
            stream.write(bytes(1_000_000))
    return packed(folder, out.getvalue())


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
def _source_name_of_300_bytes(folder: Path, base: Path) -> Made:
    return track(folder, base, "recording:" + "x" * 300)


@attack
def _target_below_a_file(folder: Path, base: Path) -> Made:
    made = volume(folder, lambda header: None)
    return [*made[:2], folder / "in.nii" / "out", "--labels"]


# DICOM ----------------------------------------------------------------------------------------


def dicom(folder: Path, change: Callable[[list[Any]], object]) -> Made:
    """`prepare` on a small series whose slices, in order, were changed."""
    import pydicom

    from tumortrack.core.types import Volume
    from tumortrack.phantom.dicom import write_dicom_series

    hu = np.where(ball() > 0, 100.0, -1000.0).astype(np.float32)
    hu[16:22, 16:22, 16:22] = 500
    series = folder / "series"
    write_dicom_series(Volume(hu, np.diag([2.0, 2.0, 2.0, 1.0])), series)
    paths = sorted(series.iterdir())
    slices = [(pydicom.dcmread(path), path) for path in paths]
    slices.sort(key=lambda pair: float(pair[0].ImagePositionPatient[2]))
    change(slices)
    for dataset, path in slices:
        if dataset is not None:
            dataset.save_as(path)
    return ["prepare", series, folder / "out"]


def _drop(slices: list[Any], which: range) -> None:
    for _, path in slices[which.start : which.stop]:
        path.unlink()
    del slices[which.start : which.stop]


@attack
def _dicom_slice_missing(folder: Path, base: Path) -> Made:
    return dicom(folder, lambda slices: _drop(slices, range(20, 21)))


@attack
def _dicom_position_nan_and_slices_missing(folder: Path, base: Path) -> Made:
    def change(slices: list[Any]) -> None:
        slices[3][0]["ImagePositionPatient"]._value = [0.0, 0.0, float("nan")]
        _drop(slices, range(15, 25))

    return dicom(folder, change)


def of_slice(tag: str, value: object, which: slice = slice(None)) -> Attack:
    def make(folder: Path, base: Path) -> Made:
        def change(slices: list[Any]) -> None:
            for dataset, _ in slices[which]:
                if value is None:
                    delattr(dataset, tag)
                else:
                    setattr(dataset, tag, value)

        return dicom(folder, change)

    return make


for name, tag, value, which in (
    ("dicom_negative_spacing", "PixelSpacing", [-2.0, 2.0], slice(None)),
    ("dicom_spacing_zero", "PixelSpacing", [0.0, 2.0], slice(None)),
    ("dicom_spacing_missing", "PixelSpacing", None, slice(None)),
    ("dicom_spacing_differs", "PixelSpacing", [1.0, 1.0], slice(5, 6)),
    ("dicom_slope_zero", "RescaleSlope", 0, slice(None)),
    ("dicom_slope_differs", "RescaleSlope", 2, slice(10, 20)),
    ("dicom_intercept_differs", "RescaleIntercept", 0, slice(10, 30)),
    ("dicom_orientation_missing", "ImageOrientationPatient", None, slice(4, 5)),
    ("dicom_orientation_zero", "ImageOrientationPatient", [0.0] * 6, slice(None)),
    ("dicom_orientation_turns", "ImageOrientationPatient", [0.0, 1, 0, 1, 0, 0], slice(9, 10)),
    ("dicom_position_missing", "ImagePositionPatient", None, slice(4, 5)),
    ("dicom_position_twice", "ImagePositionPatient", [0.0, 0.0, 20.0], slice(11, 12)),
    ("dicom_half_the_pixels", "PixelData", bytes(40 * 40), slice(7, 8)),
    ("dicom_no_pixels", "PixelData", None, slice(None)),
    ("dicom_claims_60000_rows", "Rows", 60000, slice(None)),
    ("dicom_rows_zero", "Rows", 0, slice(None)),
    ("dicom_three_samples", "SamplesPerPixel", 3, slice(None)),
    ("dicom_no_series", "SeriesInstanceUID", None, slice(None)),
):
    ATTACKS[name] = of_slice(tag, value, which)
FINISH.add("dicom_no_series")  # anonymised series lack it: read, with a note


@attack
def _dicom_slope_nan(folder: Path, base: Path) -> Made:
    def change(slices: list[Any]) -> None:
        for dataset, _ in slices:
            dataset["RescaleSlope"]._value = float("nan")

    return dicom(folder, change)


@attack
def _dicom_pixels_elsewhere(folder: Path, base: Path) -> Made:
    """Half a slice's pixels, and as many bytes of something else behind them."""

    def change(slices: list[Any]) -> None:
        slices[7][0].PixelData = bytes(40 * 40)
        slices[7][0].add_new((0x7FE1, 0x1010), "OB", bytes(40 * 40 * 4))

    return dicom(folder, change)


@attack
def _dicom_compressed_claims_much(folder: Path, base: Path) -> Made:
    """Small compressed slices that claim 30000 x 30000."""
    from pydicom.encaps import encapsulate
    from pydicom.uid import JPEG2000Lossless

    def change(slices: list[Any]) -> None:
        for dataset, _ in slices:
            dataset.file_meta.TransferSyntaxUID = JPEG2000Lossless
            dataset.PixelData = encapsulate([bytes(1000)])
            dataset["PixelData"].is_undefined_length = True
            dataset.Rows = dataset.Columns = 30000

    return dicom(folder, change)


@attack
def _dicom_elements_of_no_type(folder: Path, base: Path) -> Made:
    """An element whose type no reader knows: some take its length for gigabytes."""

    def change(slices: list[Any]) -> None:
        for n, (dataset, path) in enumerate(slices):
            dataset.save_as(path)
            path.write_bytes(path.read_bytes().replace(b"\x02\0UI\x1a\0", b"\x02\0UA\x1a\0"))
            slices[n] = (None, path)

    return dicom(folder, change)


@attack
def _dicom_cut_files(folder: Path, base: Path) -> Made:
    def change(slices: list[Any]) -> None:
        for n, (dataset, path) in enumerate(slices):
            if n % 2:
                path.write_bytes(path.read_bytes()[:400])
                slices[n] = (None, path)
            del dataset

    return dicom(folder, change)


@may_finish
def _dicom_latin1_names(folder: Path, base: Path) -> Made:
    """File names that are no UTF-8: read all the same, or refused."""

    def change(slices: list[Any]) -> None:
        for n, (dataset, path) in enumerate(slices):
            dataset.save_as(path)
            os.rename(
                os.fsencode(path), os.fsencode(path.parent) + f"/sch\xf6n{n}".encode("latin-1")
            )
        slices.clear()

    return dicom(folder, change)


# Meshes ---------------------------------------------------------------------------------------


def sphere(radius_mm: float, middle: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=3, radius=radius_mm)
    made.apply_translation(middle)
    return made


def meshes(folder: Path, **parts: Any) -> Made:
    (folder / "meshes").mkdir()
    for name, part in parts.items():
        if isinstance(part, bytes):
            (folder / "meshes" / name.replace("__", ".")).write_bytes(part)
        else:
            part.export(folder / "meshes" / f"{name}.stl")
    return ["prepare", folder / "meshes", folder / "out"]


@attack
def _mesh_claims_billions(folder: Path, base: Path) -> Made:
    return meshes(folder, kidney__stl=b"\0" * 80 + b"\xff" * 4 + b"\0" * 50)


@attack
def _mesh_open(folder: Path, base: Path) -> Made:
    half = sphere(30)
    half.update_faces(np.arange(len(half.faces)) < len(half.faces) // 2)
    return meshes(folder, kidney=half)


@attack
def _mesh_nan(folder: Path, base: Path) -> Made:
    broken = bytearray(sphere(30).export(file_type="stl"))
    struct.pack_into("<f", broken, 84 + 12, float("nan"))
    return meshes(folder, kidney__stl=bytes(broken))


@attack
def _mesh_vertices_at_1e30(folder: Path, base: Path) -> Made:
    far = sphere(30)
    far.vertices[0] = 1e30
    return meshes(folder, kidney=far)


@attack
def _mesh_without_faces(folder: Path, base: Path) -> Made:
    return meshes(folder, kidney__stl=b"\0" * 84)


@attack
def _mesh_faces_without_vertices(folder: Path, base: Path) -> Made:
    return meshes(folder, kidney__obj=b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999\n")


@attack
def _mesh_of_a_kilometre(folder: Path, base: Path) -> Made:
    return meshes(folder, kidney=sphere(1e6))


@attack
def _mesh_tumor_round_the_kidney(folder: Path, base: Path) -> Made:
    return meshes(folder, kidney=sphere(30), tumor_1=sphere(52))


@attack
def _mesh_tumor_elsewhere(folder: Path, base: Path) -> Made:
    return meshes(folder, kidney=sphere(30), tumor_1=sphere(8, (200.0, 0, 0)))


@attack
def _mesh_260_tumors(folder: Path, base: Path) -> Made:
    one = sphere(3, (20.0, 0, 0))
    return meshes(folder, kidney=sphere(30), **{f"tumor_{n}": one for n in range(1, 261)})


@may_finish
def _mesh_material_is_a_fifo(folder: Path, base: Path) -> Made:
    """Materials are not looked for."""
    made = meshes(
        folder, kidney__obj=b"mtllib pipe\n" + sphere(30).export(file_type="obj").encode()
    )
    os.mkfifo(folder / "meshes" / "pipe")
    return made


@may_finish
def _mesh_texture_is_a_fifo(folder: Path, base: Path) -> Made:
    content = sphere(30).export(file_type="ply", encoding="ascii")
    content = content.replace(b"ply\n", b"ply\ncomment TextureFile pipe\n", 1)
    made = meshes(folder, kidney__ply=content)
    os.mkfifo(folder / "meshes" / "pipe")
    return made


@attack
def _mesh_254_tumors_of_noise(folder: Path, base: Path) -> Made:
    """As many as are read, all in one place."""
    one = sphere(3, (20.0, 0, 0))
    return meshes(folder, kidney=sphere(30), **{f"tumor_{n}": one for n in range(1, 255)})


@attack
def _mesh_is_a_fifo(folder: Path, base: Path) -> Made:
    made = meshes(folder)
    os.mkfifo(folder / "meshes" / "kidney.stl")
    return made


@attack
def _mesh_ply_counts_below_zero(folder: Path, base: Path) -> Made:
    head = b"ply\nformat ascii 1.0\nelement vertex -5\nproperty float x\nproperty float y\n"
    return meshes(folder, kidney__ply=head + b"property float z\nend_header\n")


# Clouds ---------------------------------------------------------------------------------------


def ply(points: np.ndarray, head: str = "") -> bytes:
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{head}"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    ).encode() + points.astype("<f4").tobytes()


def locate(folder: Path, base: Path, content: np.ndarray | bytes, name: str = "in.ply") -> Made:
    (folder / name).write_bytes(content if isinstance(content, bytes) else ply(content))
    return ["locate", base / "model", folder / name, folder / "out", "--device", "cpu"]


def seen(base: Path) -> np.ndarray:
    """A right cloud of the model's organ."""
    from tumortrack.sense.files import read_cloud

    return np.array(read_cloud(base / "scenes" / "0000" / "cloud.ply")[0].points_mm)


def cloud_of(make: Callable[[np.ndarray, np.random.Generator], Any]) -> Attack:
    return lambda folder, base: locate(
        folder, base, np.asarray(make(seen(base), np.random.default_rng(0)))
    )


def _ball_surface(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return (points.mean(0) + 35 * direction)[direction[:, 2] < 0]


def _one_at_1e30(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    points[5] = 1e30
    return points


def _one_at_1e12(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    points[5, 0] = 1e12
    return points


def _flat(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(-60, 60, (5000, 2)), np.full(5000, 130.0)])


ATTACKS |= {
    "cloud_one_point_at_1e30": cloud_of(_one_at_1e30),
    "cloud_one_point_at_1e12": cloud_of(_one_at_1e12),
    "cloud_a_tenth_at_1e6": cloud_of(
        lambda points, rng: np.concatenate([points, points[::9] * 1e4])
    ),
    "cloud_on_a_line_with_strays": cloud_of(
        lambda points, rng: np.concatenate(
            [np.outer(rng.uniform(0, 100, 5000), [0.9, 0.1, 0]) + [0, 0, 130], points[:20]]
        )
    ),
    "cloud_in_the_other_byte_order": cloud_of(
        lambda points, rng: points.astype("<f4").byteswap().view("<f4")
    ),
    "cloud_empty": cloud_of(lambda points, rng: points[:0]),
    "cloud_five_points": cloud_of(lambda points, rng: points[:5]),
    "cloud_one_point_5000_times": cloud_of(lambda points, rng: np.repeat(points[:1], 5000, 0)),
    "cloud_all_nan": cloud_of(lambda points, rng: points * np.nan),
    "cloud_behind_the_camera": cloud_of(lambda points, rng: -points),
    "cloud_metres": cloud_of(lambda points, rng: points / 1000),
    "cloud_kilometres_away": cloud_of(lambda points, rng: points + [0, 0, 1e6]),
    "cloud_on_a_line": cloud_of(
        lambda points, rng: np.outer(rng.uniform(0, 100, 5000), [0.9, 0.1, 0]) + [0, 0, 130]
    ),
    "cloud_on_a_table": cloud_of(_flat),
    "cloud_of_a_ball": cloud_of(_ball_surface),
    "cloud_mirrored": cloud_of(lambda points, rng: points * [-1, 1, 1]),
    "cloud_seen_from_behind": cloud_of(
        lambda points, rng: (points - points.mean(0)) * [1, -1, -1] + points.mean(0)
    ),
    "cloud_of_noise": cloud_of(
        lambda points, rng: points.mean(0) + rng.uniform(-50, 50, (5000, 3))
    ),
    "cloud_stretched_twice": cloud_of(
        lambda points, rng: (points - points.mean(0)) * [2, 2, 1] + points.mean(0)
    ),
}
FINISH |= {
    "cloud_of_a_ball",
    "cloud_mirrored",
    "cloud_seen_from_behind",
    "cloud_of_noise",
    "cloud_stretched_twice",
    "cloud_one_point_at_1e30",  # dropped, with a note
    "cloud_one_point_at_1e12",
    "model_of_endless_points",  # of depth images only, which have fewer
}


for name, head in (
    ("ply_without_end", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n"),
    ("ply_of_a_billion", "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\n"),
    ("ply_of_words", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
     "property float z\nend_header\none two three\n"),
    ("ply_endless_header", "ply\ncomment " + "x" * 3_000_000),
    ("ply_count_is_a_word", "ply\nformat ascii 1.0\nelement vertex many\nend_header\n"),
    ("ply_count_of_400_digits", f"ply\nformat ascii 1.0\nelement vertex {'9' * 400}\nend_header\n"),
):  # fmt: skip
    ATTACKS[name] = lambda folder, base, h=head: locate(folder, base, h.encode())


def pcd(viewpoint: str = "0 0 0 1 0 0 0", count: int = 3) -> bytes:
    return (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH "
        f"{count}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {count}\nDATA binary\n"
    ).encode()


@attack
def _pcd_of_two_billion(folder: Path, base: Path) -> Made:
    return locate(folder, base, pcd(count=2**31), "in.pcd")


@attack
def _pcd_viewpoint_of_words(folder: Path, base: Path) -> Made:
    points = seen(base)
    content = pcd("a b c", len(points)) + points.astype("<f4").tobytes()
    return locate(folder, base, content, "in.pcd")


@attack
def _pcd_from_another_viewpoint(folder: Path, base: Path) -> Made:
    points = seen(base)
    content = pcd("100 0 0 0 1 0 0", len(points)) + points.astype("<f4").tobytes()
    return locate(folder, base, content, "in.pcd")


def npz(**arrays: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


@attack
def _npz_pickle(folder: Path, base: Path) -> Made:
    return locate(folder, base, npz(points_mm=np.array([{}], object)), "in.npz")


@attack
def _npz_bomb(folder: Path, base: Path) -> Made:
    """2 MB that unpack to 2.4 GB."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f4", "fortran_order": False, "shape": (200_000_000, 3)}
    )
    import zipfile

    with zipfile.ZipFile(folder / "in.npz", "w", zipfile.ZIP_DEFLATED) as archive:  # noqa: SIM117
        with archive.open("points_mm.npy", "w", force_zip64=True) as stream:
            stream.write(head.getvalue())
            for _ in range(2400):
                stream.write(bytes(1_000_000))
    return ["locate", base / "model", folder / "in.npz", folder / "out", "--device", "cpu"]


@attack
def _npz_without_points(folder: Path, base: Path) -> Made:
    return locate(folder, base, npz(other=np.zeros(3)), "in.npz")


@attack
def _cloud_is_a_fifo(folder: Path, base: Path) -> Made:
    os.mkfifo(folder / "in.ply")
    return ["locate", base / "model", folder / "in.ply", folder / "out"]


@attack
def _cloud_without_end(folder: Path, base: Path) -> Made:
    (folder / "in.ply").symlink_to("/dev/zero")
    return ["locate", base / "model", folder / "in.ply", folder / "out"]


# Depth images and intrinsics ------------------------------------------------------------------


def depth(folder: Path, base: Path, intrinsics: object = None, png: bytes | None = None) -> Made:
    scene = base / "scenes" / "0000"
    given = json.loads((scene / "intrinsics.json").read_text())
    if isinstance(intrinsics, dict):
        given |= intrinsics
    text = intrinsics if isinstance(intrinsics, str) else json.dumps(given)
    (folder / "intrinsics.json").write_text(text)
    (folder / "in.png").write_bytes((scene / "depth.png").read_bytes() if png is None else png)
    options = ["--intrinsics", folder / "intrinsics.json", "--device", "cpu"]
    return ["locate", base / "model", folder / "in.png", folder / "out", *options]


for name, change in (
    ("intrinsics_1e308", {"fx": 1e308}),
    ("intrinsics_nan", {"fx": float("nan")}),
    ("intrinsics_zero", {"fx": 0}),
    ("intrinsics_negative_width", {"width": -848}),
    ("intrinsics_words", {"fx": "wide"}),
    ("intrinsics_of_another_size", {"width": 640}),
    ("intrinsics_infinite_unit", {"depth_unit_mm": 1e300}),
    ("intrinsics_focal_length_tenfold", {"fx": 6000.0, "fy": 6000.0}),
    ("intrinsics_axis_far_away", {"cx": 1e6}),
    ("intrinsics_nested", "[" * 100_000),
    ("intrinsics_a_list", "[1, 2, 3]"),
):
    ATTACKS[name] = lambda folder, base, c=change: depth(folder, base, c)


@attack
def _intrinsics_are_a_fifo(folder: Path, base: Path) -> Made:
    made = depth(folder, base)
    (folder / "intrinsics.json").unlink()
    os.mkfifo(folder / "intrinsics.json")
    return made


@attack
def _intrinsics_without_end(folder: Path, base: Path) -> Made:
    made = depth(folder, base)
    (folder / "intrinsics.json").unlink()
    (folder / "intrinsics.json").symlink_to("/dev/zero")
    return made


@attack
def _map_is_a_fifo(folder: Path, base: Path) -> Made:
    os.mkfifo(folder / "map.csv")
    cloud = base / "scenes" / "0000" / "cloud.ply"
    return ["locate", base / "model", cloud, folder / "out", "--map", folder / "map.csv"]


def png_of(width: int, height: int, bits: int, data: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@attack
def _depth_of_8_bits(folder: Path, base: Path) -> Made:
    rows = bytes(849) * 480
    return depth(folder, base, png=png_of(848, 480, 8, zlib.compress(rows)))


@attack
def _depth_claims_gigapixels(folder: Path, base: Path) -> Made:
    return depth(folder, base, png=png_of(60000, 60000, 16, zlib.compress(bytes(10_000_000))))


@attack
def _depth_cut_short(folder: Path, base: Path) -> Made:
    whole = (base / "scenes" / "0000" / "depth.png").read_bytes()
    return depth(folder, base, png=whole[: len(whole) // 2])


@attack
def _depth_all_zero(folder: Path, base: Path) -> Made:
    rows = bytes(1 + 2 * 848) * 480
    return depth(folder, base, png=png_of(848, 480, 16, zlib.compress(rows)))


# Artifacts ------------------------------------------------------------------------------------


def resealed(folder: Path, source: Path, change: Callable[[Path], object]) -> Path:
    """A copy of an artifact whose files were changed and whose manifest says so."""
    import shutil

    from tumortrack.core import store

    copy = folder / "changed"
    shutil.copytree(source, copy)
    change(copy)
    manifest = json.loads((copy / store.MANIFEST).read_text())
    for name in manifest["files"]:
        manifest["files"][name] = store.sha256_of(copy / name)
    (copy / store.MANIFEST).write_text(json.dumps(manifest))
    return copy


def with_model(change: Callable[[Path], object]) -> Attack:
    def make(folder: Path, base: Path) -> Made:
        model = resealed(folder, base / "model", change)
        cloud = base / "scenes" / "0000" / "cloud.ply"
        return ["locate", model, cloud, folder / "out", "--device", "cpu"]

    return make


def weights(fill: float) -> Callable[[Path], object]:
    def change(model: Path) -> None:
        from safetensors.numpy import load_file, save_file

        path = model / "weights.safetensors"
        tensors = {name: np.full_like(value, fill) for name, value in load_file(path).items()}
        save_file(tensors, path)

    return change


def manifest(**changes: object) -> Callable[[Path], object]:
    def change(artifact: Path) -> None:
        path = artifact / "manifest.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


ATTACKS |= {
    "model_weights_nan": with_model(weights(np.nan)),
    "model_weights_1e30": with_model(weights(1e30)),
    "model_weights_1e5": with_model(weights(1e5)),
    "model_weights_minus_1e3": with_model(weights(-1e3)),
    "model_shape_1e30": with_model(lambda model: _spoil(model / "shape.safetensors", 1e30)),
    "model_shape_cut": with_model(lambda model: _cut(model / "shape.safetensors")),
    "model_parts_swapped": with_model(manifest(parts=["tumor_1", "kidney", "tumor_2"])),
    "model_of_endless_parts": with_model(manifest(parts=[f"tumor_{n}" for n in range(10**5)])),
    "model_box_nan": with_model(manifest(query_box_mm=[[float("nan")] * 3, [1.0] * 3])),
    "model_box_of_a_kilometre": with_model(manifest(query_box_mm=[[-1e6] * 3, [1e6] * 3])),
    "model_of_endless_steps": with_model(lambda model: _set(model, 10**12, "refine", "steps")),
    "model_of_endless_width": with_model(
        lambda model: _set(model, 3 * 10**4, "network", "decoder", "width")
    ),
    "model_of_endless_points": with_model(
        lambda model: _set(model, 10**10, "scene", "cloud", "n_points")
    ),
    "model_weights_header_of_2_60": with_model(
        lambda model: (model / "weights.safetensors").write_bytes(struct.pack("<Q", 2**60) + b"{}")
    ),
    "model_weights_empty": with_model(
        lambda model: (model / "weights.safetensors").write_bytes(b"")
    ),
    "model_shape_nan": with_model(lambda model: _spoil(model / "shape.safetensors", np.nan)),
    "model_of_schema_999": with_model(manifest(schema=999)),
    "model_config_null": with_model(manifest(config=None)),
    "model_is_a_case": lambda folder, base: [
        *("locate", base / "case", base / "scenes" / "0000" / "cloud.ply", folder / "out")
    ],
    "case_is_a_model": lambda folder, base: ["export", base / "model", folder / "out"],
}


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:5000])


def _set(model: Path, value: object, *keys: str) -> None:
    path = model / "manifest.json"
    whole = json.loads(path.read_text())
    inner = whole["config"]
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    path.write_text(json.dumps(whole))


def _spoil(path: Path, value: float) -> None:
    from safetensors.numpy import load_file, save_file

    tensors = load_file(path)
    for tensor in tensors.values():
        if tensor.dtype.kind == "f":
            tensor.reshape(-1)[:5] = value
    save_file(tensors, path)


@attack
def _model_names_a_file_outside(folder: Path, base: Path) -> Made:
    """A manifest whose list of files leaves the folder."""
    model = resealed(folder, base / "model", lambda copy: None)
    listed = json.loads((model / "manifest.json").read_text())
    listed["files"]["../../etc/passwd"] = "0" * 64
    (model / "manifest.json").write_text(json.dumps(listed))
    return ["locate", model, base / "scenes" / "0000" / "cloud.ply", folder / "out"]


@attack
def _model_manifest_nested(folder: Path, base: Path) -> Made:
    model = resealed(folder, base / "model", lambda copy: None)
    (model / "manifest.json").write_text("[" * 1_000_000)
    return ["locate", model, base / "scenes" / "0000" / "cloud.ply", folder / "out"]


@attack
def _model_calibration_edited(folder: Path, base: Path) -> Made:
    """A model that is said to be a million times as sure of itself."""
    model = resealed(folder, base / "model", lambda copy: None)
    path = model / "manifest.json"
    text = json.loads(path.read_text())

    def shrink(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                key: 1e-6 if key == "std_scale" else shrink(inner) for key, inner in value.items()
            }
        return value

    path.write_text(json.dumps(shrink(text)))
    return ["locate", model, base / "scenes" / "0000" / "cloud.ply", folder / "out"]


def motions(change: Callable[[dict[str, np.ndarray]], object]) -> Attack:
    def edit(plan: Path) -> None:
        from safetensors import safe_open
        from safetensors.numpy import load_file, save_file

        path = plan / "motions.safetensors"
        with safe_open(path, "np") as stream:
            said = stream.metadata()
        tensors = load_file(path)
        change(tensors)
        save_file(tensors, path, metadata=said)

    def make(folder: Path, base: Path) -> Made:
        plan = resealed(folder, base / "plan", edit)
        return ["resect", plan, "--speed", 20, "--report", folder / "report.json"]

    return make


def _put_joint(tensors: dict[str, np.ndarray], value: float) -> None:
    tensors["1.joints_rad"] = tensors["1.joints_rad"].copy()
    tensors["1.joints_rad"][10, 3] += value


def _scale_times(tensors: dict[str, np.ndarray], factor: float) -> None:
    for name in tensors:
        if name.endswith("times_s"):
            tensors[name] = tensors[name] * factor


ATTACKS |= {
    "motions_nan": motions(lambda tensors: _put_joint(tensors, np.nan)),
    "motions_off_by_3_rad": motions(lambda tensors: _put_joint(tensors, 3.0)),
    "motions_times_1e300": motions(lambda tensors: _scale_times(tensors, 1e300)),
    "motions_times_backwards": motions(lambda tensors: _scale_times(tensors, -1.0)),
    "motions_ten_times_too_fast": motions(lambda tensors: _scale_times(tensors, 0.1)),
    "motions_of_no_length": motions(
        lambda tensors: tensors.update({name: value[:0] for name, value in tensors.items()})
    ),
}


@attack
def _real_arm_without_live(folder: Path, base: Path) -> Made:
    """A stored plan that nothing looks at must move no real arm."""
    report = folder / "report.json"
    return ["resect", base / "plan", "ur:127.0.0.1?execute=true", "--report", report]


@attack
def _plan_of_another_schema(folder: Path, base: Path) -> Made:
    return ["resect", resealed(folder, base / "plan", manifest(schema=7))]


@attack
def _run_with_points_at_nan(folder: Path, base: Path) -> Made:
    def change(run: Path) -> None:
        content = (run / "occupancy.ply").read_bytes()
        start = content.index(b"end_header") + 11
        nan = struct.pack("<f", float("nan")) * 3
        (run / "occupancy.ply").write_bytes(content[:start] + nan + content[start + 12 :])

    return ["plan", resealed(folder, base / "run", change), folder / "out", "--no-arms"]


# Recordings -----------------------------------------------------------------------------------


def track(folder: Path, base: Path, source: str) -> Made:
    options = ["--device", "cpu", "--give-up", 3, "--report", folder / "report.json"]
    return ["track", base / "model", source, *options]


for name, file, content in (
    ("recording_mcap_of_garbage", "in.mcap", b"\x89MCAP0\r\n" + bytes(range(256)) * 400),
    ("recording_mcap_cut", "in.mcap", b"\x89MCAP0\r\n"),
    ("recording_db3_of_garbage", "in.db3", b"SQLite format 3\0" + bytes(range(256)) * 400),
    ("recording_bag_of_garbage", "in.bag", b"#ROSBAG V2.0\n" + bytes(range(256)) * 400),
    ("recording_empty", "in.mcap", b""),
):

    def _make(folder: Path, base: Path, file: str = file, content: bytes = content) -> Made:
        (folder / file).write_bytes(content)
        return track(folder, base, f"recording:{folder / file}")

    ATTACKS[name] = _make


@attack
def _recording_folder_of_nothing(folder: Path, base: Path) -> Made:
    (folder / "frames").mkdir()
    return track(folder, base, f"recording:{folder / 'frames'}")


# Running them ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What became of an attack. ``fault``: empty where all is as it must be."""

    name: str
    code: int
    seconds: float
    megabytes: float
    line: str
    fault: str


def make_base(folder: Path) -> None:
    """What attacks start from: a case of the phantom, a model, scenes, a run and a plan of it."""
    from stories import write_phantom_case

    write_phantom_case(folder / "case")
    here = {"case": folder / "case", "model": folder / "model", "scenes": folder / "scenes"}
    preset = ("--preset", "clinic", "--steps", 60, "--workers", 0, "--device", "cpu", "--seed", 0)
    for arguments in (
        ("train", here["case"], here["model"], *preset),
        ("simulate", here["case"], here["scenes"], "--scenes", 1),
        ("locate", here["model"], here["scenes"] / "0000" / "cloud.ply", folder / "run"),
        ("plan", folder / "run", folder / "plan", "--accept-poor", "--accept-budget"),
    ):
        code, output, *_ = run([str(argument) for argument in arguments], folder, 300)
        if code:
            raise SystemExit(f"{arguments[0]}: {output}")


def run(arguments: list[str], folder: Path, seconds: float) -> tuple[int, str, float, float]:
    """A command in a fork of this process: exit code (-9: it ran too long or took too much
    memory), what it said, seconds, and megabytes beyond what the fork began with."""
    with tempfile.TemporaryFile() as said:
        started = time.perf_counter()
        child = os.fork()
        if not child:
            _become(arguments, folder, said.fileno())
        before_mb, most_mb = _resident_mb(child), 0.0
        while True:
            done, status, _ = os.wait4(child, os.WNOHANG)
            took_s = time.perf_counter() - started
            if done:
                break
            most_mb = max(most_mb, _resident_mb(child) - before_mb)
            if took_s > seconds or most_mb > 4 * MEGABYTES:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.005)
        said.seek(0)
        output = said.read().decode(errors="replace")
    return os.waitstatus_to_exitcode(status), output, took_s, most_mb


def _become(arguments: list[str], folder: Path, output: int) -> None:
    code = 70
    try:
        from tumortrack.cli.main import run as command

        os.chdir(folder)
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = command(arguments)
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else 1
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _resident_mb(process: int) -> float:
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * 4096 / 2**20
    except (OSError, IndexError):  # it has just ended
        return 0.0


def outcome(name: str, folder: Path, base: Path) -> Outcome:
    """Make one attack in an empty folder, and run it."""
    folder.mkdir(parents=True)
    arguments = [
        os.fspath(one) if isinstance(one, Path) else str(one) for one in ATTACKS[name](folder, base)
    ]
    before = set(_below(folder))
    code, output, seconds, megabytes = run(arguments, folder, SECONDS)
    lines = [line for line in output.strip().splitlines() if line.startswith("tumortrack: ")]
    line = lines[-1] if lines else (output.strip().splitlines() or [""])[-1]
    left = [path for path in _below(folder) if path not in before]
    return Outcome(
        name,
        code,
        seconds,
        megabytes,
        line,
        _fault(name, code, output, lines, left, seconds, megabytes),
    )


def _below(folder: Path) -> list[str]:
    return [os.path.join(at, name) for at, _, names in os.walk(folder) for name in names]


def _fault(
    name: str,
    code: int,
    output: str,
    lines: list[str],
    left: list[str],
    seconds: float,
    megabytes: float,
) -> str:
    if code < 0:
        return f"killed ({signal.Signals(-code).name})"
    if "Traceback" in output:
        return "traceback"
    if seconds > SECONDS / 2:
        return "slow"
    if megabytes > MEGABYTES:
        return "memory"
    if code == 0:
        return "" if name in FINISH else "accepted"
    if len(lines) != 1 or code == 1:
        return "no clear line"
    return f"left {left[0]}" if [path for path in left if not path.endswith("report.json")] else ""


def main(folder: Path, names: list[str]) -> int:
    import warm

    for module in warm.PRELOADED:
        __import__(module)
    base, names = folder / "base", names or list(ATTACKS)
    if not base.exists() and not all(name.startswith(WITHOUT_BASE) for name in names):
        base.mkdir(parents=True)
        make_base(base)
    faults = 0
    with tempfile.TemporaryDirectory(dir=folder) as work:
        for name in names:
            done = outcome(name, Path(work, name), base)
            faults += bool(done.fault)
            print(
                f"{done.fault or 'ok':14} {name:40} {done.code:4} {done.seconds:6.2f} s "
                f"{done.megabytes:6.0f} MB  {done.line[:150]}",
                flush=True,
            )
    print(f"{len(names)} attacks, {faults} faults")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve(), sys.argv[2:]))
