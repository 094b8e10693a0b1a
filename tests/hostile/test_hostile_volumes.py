"""Hostile input of `prepare`: NIfTI, NRRD and MetaImage volumes, DICOM series, meshes, names."""

from __future__ import annotations

import gzip
import io
import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pydicom.dataelem import DataElement

from hostile import NAN, Make, Room, attacks, check
from raw_files import ball, nifti_header, nrrd, sphere


@pytest.fixture
def room(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Room(tmp_path, tmp_path)


def file(content: Callable[[], bytes], name: str = "in.nii.gz", *options: object) -> Make:
    return lambda room: [
        "prepare",
        room.file(name, content()),
        "--out",
        room.out,
        "--labels",
        *options,
    ]


def header(form: str, offset: int, *values: object) -> Make:
    """A ball whose header was changed."""

    def content() -> bytes:
        changed = nifti_header((60, 60, 60))
        struct.pack_into(form, changed, offset, *values)
        return bytes(changed) + ball(60).tobytes("F")

    return file(content, "in.nii")


def zipped(head: bytes, megabytes: int) -> bytes:
    """gzip of a head and zeros behind it."""
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", compresslevel=9) as stream:
        stream.write(head)
        for _ in range(megabytes):
            stream.write(bytes(1_000_000))
    return out.getvalue()


def labels(make: Callable[[], np.ndarray], *options: object) -> Make:
    def content() -> bytes:
        array = make()
        return gzip.compress(bytes(nifti_header(array.shape)) + array.tobytes("F"), 1)

    return file(content, "in.nii.gz", *options)


def of_other_content() -> bytes:
    """Voxels zeroed and the checksum of what was there before: only reading to the end tells."""
    head, voxels = bytes(nifti_header((60, 60, 60))), ball(60)
    whole = head + voxels.tobytes("F")
    voxels[10:13, 30, 30] = 0
    stream = gzip.compress(head + voxels.tobytes("F"))
    return stream[:-8] + struct.pack("<II", zlib.crc32(whole), len(whole))


def extended(offset: float, size: int, zeros_mb: int) -> bytes:
    """An extension of the header of such a size, before the data at such an offset."""
    changed = nifti_header((60, 60, 60))
    struct.pack_into("<f", changed, 108, offset)
    changed[348] = 1
    return zipped(bytes(changed) + struct.pack("<ii", size, 6), zeros_mb)


def big_endian() -> bytes:
    """With the scale that nibabel leaves in headers whose scale it has applied."""
    import nibabel

    native = nibabel.Nifti1Header(bytes(nifti_header((60, 60, 60), 4, 16)[:348]))
    native["scl_slope"] = native["scl_inter"] = np.nan
    content = native.as_byteswapped(">").binaryblock + bytes(4)
    return gzip.compress(content + ball(60).astype(">i2").tobytes("F"))


def noise(size: int, values: tuple[int, int], margin: int) -> np.ndarray:
    made = np.random.default_rng(0).integers(*values, (size,) * 3, dtype=np.uint8)
    return np.pad(made, margin)


def many_tumors() -> np.ndarray:
    """2000 cubes of half a ml on a lattice beside the kidney."""
    array = np.zeros((200, 200, 200), np.uint8)
    array[:60, :60, :60] = ball(60)
    tumor = np.zeros((12, 12, 12), np.uint8)
    tumor[:8, :8, :8] = 2
    array[:192, :192, 80:176] = np.tile(tumor, (16, 16, 8))
    return array


def sparse_dots() -> np.ndarray:
    """A kidney, and every eighth voxel about it a piece of its own."""
    array = np.zeros((256, 256, 256), np.uint8)
    array[1::2, 1::2, 1::2] = 2
    array[100:160, 100:160, 100:160] = ball(60)
    return array


def tumor_round_the_organ() -> np.ndarray:
    array = 2 * ball(60)
    array[28:32, 28:32, 28:32] = 1
    return array


def nrrd_file(sizes: str, more: str) -> Make:
    return file(lambda: nrrd(sizes, more), "in.nrrd")


def detached_data(room: Room) -> list[object]:
    room.file("secret.raw", ball().tobytes("F"))
    return nrrd_file("40 40 40", "encoding: raw\ndata file: secret.raw")(room)


def target(*names: str) -> Make:
    """A right volume, and a folder that cannot be made."""
    return lambda room: [*header("<B", 123, 2)(room)[:3], room.folder.joinpath(*names), "--labels"]


def names_in_latin1(room: Room) -> list[object]:
    """Names that are no UTF-8, of input and target: used as they are, or refused."""
    _, volume, _, _, option = header("<B", 123, 2)(room)
    other = room.folder / os.fsdecode(b"sch\xf6n.nii")
    os.rename(str(volume), other)
    return ["prepare", other, "--out", room.folder / os.fsdecode(b"f\xfcr"), option]


METAIMAGE = (
    b"ObjectType = Image\nNDims = 3\nBinaryData = True\nDimSize = 40 40 40\n"
    b"ElementType = MET_UCHAR\nElementDataFile = /etc/passwd\n"
)


@attacks(
    refused={
        "nifti_negative_dimension": header("<h", 42, -40),
        "nifti_claims_more_than_it_holds": header("<3h", 42, 4000, 4000, 4000),
        "nifti_complex_numbers": header("<hh", 70, 32, 64),
        "nifti_data_far_behind": header("<f", 108, 1e30),
        "nifti_data_in_the_header": header("<f", 108, -4.0),
        "nifti_five_dimensions": header("<8h", 40, 5, 60, 60, 60, 2, 2, 1, 1),
        "nifti_a_plane": header("<8h", 40, 2, 60, 60, 1, 1, 1, 1, 1),
        "nifti_header_of_another_size": header("<i", 0, 2**31 - 1),
        "gzip_of_other_content": file(of_other_content),
        # A whole volume, and 2 GB behind it.
        "bomb_goes_on": file(
            lambda: zipped(bytes(nifti_header((60, 60, 60))) + ball(60).tobytes("F"), 2000)
        ),
        # 4 MB of 64-bit zeros within all limits of shape.
        "bomb_of_4_gb": file(lambda: zipped(bytes(nifti_header((1000, 1000, 500), 64, 64)), 4000)),
        # Too short for its own head, before 2 GB; and one that claims 2 GB.
        "bomb_extension_of_size_7": file(lambda: extended(1024.0, 7, 2000)),
        "bomb_header_extension": file(lambda: extended(2.0e9, 1_999_999_632, 5)),
        "labels_of_noise": labels(lambda: noise(128, (0, 3), 4)),  # thousands of pieces
        "labels_of_255_noises": labels(lambda: noise(130, (1, 256), 8)),  # as many tumors
        "labels_of_2000_tumors": labels(many_tumors),
        "labels_of_sparse_dots": labels(sparse_dots, "--min-tumor-ml", 0),
        # The organ fills the volume: there is no surface in it.
        "labels_all_one": labels(lambda: np.ones((60, 60, 60), np.uint8)),
        "labels_tumor_round_the_organ": labels(tumor_round_the_organ),
        "nrrd_detached_data": detached_data,
        "nrrd_claims_terabytes": nrrd_file("30000 30000 30000", "encoding: raw"),
        "mha_names_another_file": file(lambda: METAIMAGE, "in.mha"),
        "volume_is_a_fifo": lambda room: ["prepare", room.fifo("in.nii.gz"), "--out", room.out],
        "volume_without_end": lambda room: ["prepare", room.endless("in.nii"), "--out", room.out],
        "name_of_300_bytes": lambda room: [
            "prepare",
            room.folder / ("x" * 300 + ".nii"),
            "--out",
            room.out,
        ],
        "target_of_300_bytes": target("x" * 300),
        "target_below_a_file": target("in.nii", "out"),
    },
    either={"name_in_latin1": names_in_latin1},
    read={"nifti_big_endian": file(big_endian)},
    long=("bomb", "labels_of", "name_in", "nifti_big"),
)
def test_volumes(make, end, room):
    check(make, end, room)


EVERY = slice(None)


def dicom(
    of_slices: Callable[[list[Any]], object] = lambda slices: None,
    of_files: Callable[[list[Path]], object] = lambda paths: None,
) -> Make:
    """`prepare` on a small series whose slices, in order, were changed; slices that are taken from
    the list are not written."""

    def make(room: Room) -> list[object]:
        import pydicom

        from tumortrack.core.types import Volume
        from tumortrack.simulation.phantom.dicom import write_dicom_series

        hu = np.where(ball() > 0, 100.0, -1000.0).astype(np.float32)
        hu[16:22, 16:22, 16:22] = 500
        series = room.folder / "series"
        write_dicom_series(Volume(hu, np.diag([2.0, 2.0, 2.0, 1.0])), series)
        slices = [pydicom.dcmread(path) for path in series.iterdir()]
        slices.sort(key=lambda dataset: float(dataset.ImagePositionPatient[2]))
        paths = [Path(dataset.filename) for dataset in slices]
        of_slices(slices)
        for path in paths:
            path.unlink()
        for dataset in slices:
            dataset.save_as(dataset.filename)
        of_files([path for path in paths if path.exists()])
        return ["prepare", series, "--out", room.out]

    return make


def tag(name: str, value: object, which: slice = EVERY) -> Make:
    """A tag of such slices is missing (None) or has another value."""

    def change(slices: list[Any]) -> None:
        for dataset in slices[which]:
            if value is None:
                delattr(dataset, name)
            elif value != value:  # NaN: pydicom takes none that it would have to convert
                tag, vr = dataset[name].tag, dataset[name].VR
                dataset[name] = DataElement(tag, vr, value, already_converted=True)
            else:
                setattr(dataset, name, value)

    return dicom(change)


def missing_slice(slices: list[Any]) -> None:
    del slices[20]


def compressed_claims_much(slices: list[Any]) -> None:
    """Small compressed slices that claim 30000 x 30000."""
    from pydicom.encaps import encapsulate
    from pydicom.uid import JPEG2000Lossless

    for dataset in slices:
        dataset.file_meta.TransferSyntaxUID = JPEG2000Lossless
        dataset.PixelData = encapsulate([bytes(1000)])
        dataset["PixelData"].is_undefined_length = True
        dataset.Rows = dataset.Columns = 30000


def deflated_bomb(paths: list[Path]) -> None:
    """A slice of 2 MB, deflated as a whole, that unpacks to 2 GB in front of its pixels."""
    import pydicom
    from pydicom.uid import DeflatedExplicitVRLittleEndian

    dataset = pydicom.dcmread(paths[3])
    dataset.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    del dataset.PixelData
    dataset.save_as(paths[3])
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = struct.pack("<HH2sHI", 0x0009, 0x0010, b"UN", 0, 2_000_000_000)
    bomb = pack.compress(head) + b"".join(pack.compress(bytes(1_000_000)) for _ in range(2000))
    content = paths[3].read_bytes()
    start = 132 + 12 + struct.unpack_from("<I", content, 140)[0]  # behind the file's meta group
    paths[3].write_bytes(content[:start] + bomb + pack.flush())


def elements_of_no_type(paths: list[Path]) -> None:
    """An element whose type no reader knows: some take its length for gigabytes."""
    for path in paths:
        path.write_bytes(path.read_bytes().replace(b"\x02\0UI\x1a\0", b"\x02\0UA\x1a\0"))


def garbage_behind_the_pixels(paths: list[Path]) -> None:
    """An element of no type behind the pixels: GDCM makes room for 1.4 GB, as it reads its type."""
    garbage = struct.pack("<HH4s", 0x5945, 0x18, b"P\0DS") + bytes(90)
    paths[3].write_bytes(paths[3].read_bytes() + garbage)


def cut(paths: list[Path]) -> None:
    for path in paths[1::2]:
        path.write_bytes(path.read_bytes()[:400])


def latin1_names(paths: list[Path]) -> None:
    for n, path in enumerate(paths):
        path.rename(path.with_name(os.fsdecode(f"sch\xf6n{n}".encode("latin-1"))))


@attacks(
    refused={
        "slice_missing": dicom(missing_slice),
        "negative_spacing": tag("PixelSpacing", [-2.0, 2.0]),
        "spacing_zero": tag("PixelSpacing", [0.0, 2.0]),
        "spacing_missing": tag("PixelSpacing", None),
        "spacing_differs": tag("PixelSpacing", [1.0, 1.0], slice(5, 6)),
        "slope_zero": tag("RescaleSlope", 0),
        "slope_differs": tag("RescaleSlope", 2, slice(10, 20)),
        "slope_nan": tag("RescaleSlope", NAN),
        "intercept_differs": tag("RescaleIntercept", 0, slice(10, 30)),
        "orientation_missing": tag("ImageOrientationPatient", None, slice(4, 5)),
        "orientation_zero": tag("ImageOrientationPatient", [0.0] * 6),
        "orientation_of_four_numbers": tag("ImageOrientationPatient", [1.0, 0, 0, 1]),
        "orientation_turns": tag("ImageOrientationPatient", [0.0, 1, 0, 1, 0, 0], slice(9, 10)),
        "position_missing": tag("ImagePositionPatient", None, slice(4, 5)),
        "position_twice": tag("ImagePositionPatient", [0.0, 0.0, 20.0], slice(11, 12)),
        "half_the_pixels": tag("PixelData", bytes(40 * 40), slice(7, 8)),
        "no_pixels": tag("PixelData", None),
        "claims_60000_rows": tag("Rows", 60000),
        "rows_zero": tag("Rows", 0),
        "three_samples": tag("SamplesPerPixel", 3),
        "compressed_claims_much": dicom(compressed_claims_much),
        "deflated_bomb": dicom(of_files=deflated_bomb),
        "elements_of_no_type": dicom(of_files=elements_of_no_type),
        "garbage_behind_the_pixels": dicom(of_files=garbage_behind_the_pixels),
        "cut_files": dicom(of_files=cut),
    },
    either={"no_series": tag("SeriesInstanceUID", None)},  # anonymised series lack it
    read={"latin1_names": dicom(of_files=latin1_names)},
    long=("deflated", "no_series", "latin1"),
)
def test_dicom(make, end, room):
    check(make, end, room)


def meshes(parts: Callable[[], dict[str, Any]], fifo: str = "") -> Make:
    """`prepare` on a folder of meshes: files' contents, or meshes written as STL."""

    def make(room: Room) -> list[object]:
        folder = room.folder / "meshes"
        folder.mkdir()
        for name, part in parts().items():
            if isinstance(part, bytes):
                room.file(f"meshes/{name}", part)
            else:
                part.export(folder / f"{name}.stl")
        if fifo:
            room.fifo(f"meshes/{fifo}")
        return ["prepare", folder, "--out", room.out]

    return make


def half() -> trimesh.Trimesh:
    made = sphere(30)
    made.update_faces(np.arange(len(made.faces)) < len(made.faces) // 2)
    return made


def of_nan() -> bytes:
    broken = bytearray(sphere(30).export(file_type="stl"))
    struct.pack_into("<f", broken, 84 + 12, NAN)
    return bytes(broken)


def far() -> trimesh.Trimesh:
    made = sphere(30)
    made.vertices[0] = 1e30
    return made


def with_tumors(count: int) -> dict[str, Any]:
    """All in one place."""
    tumor = sphere(3, (20.0, 0, 0))
    return {"kidney": sphere(30), **{f"tumor_{n}": tumor for n in range(1, count + 1)}}


def with_texture() -> bytes:
    content: bytes = sphere(30).export(file_type="ply")
    return content.replace(b"1.0\n", b"1.0\ncomment TextureFile pipe\n", 1)


def normals_of_words() -> bytes:
    content = sphere(30).export(file_type="stl_ascii").encode()
    return re.sub(rb"normal .*", b"normal up up up", content)


BELOW_ZERO = (
    b"ply\nformat ascii 1.0\nelement vertex -5\nproperty float x\nproperty float y\n"
    b"property float z\nend_header\n"
)
FEW_VERTICES = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999\n"


@attacks(
    refused={
        "claims_billions": meshes(lambda: {"kidney.stl": bytes(80) + b"\xff" * 4 + bytes(50)}),
        "open": meshes(lambda: {"kidney": half()}),
        "nan": meshes(lambda: {"kidney.stl": of_nan()}),
        "vertices_at_1e30": meshes(lambda: {"kidney": far()}),
        "without_faces": meshes(lambda: {"kidney.stl": bytes(84)}),
        "faces_without_vertices": meshes(lambda: {"kidney.obj": FEW_VERTICES}),
        "of_a_kilometre": meshes(lambda: {"kidney": sphere(1e6)}),
        "tumor_round_the_kidney": meshes(lambda: {"kidney": sphere(30), "tumor_1": sphere(52)}),
        "tumor_elsewhere": meshes(
            lambda: {"kidney": sphere(30), "tumor_1": sphere(8, (200.0, 0, 0))}
        ),
        "of_260_tumors": meshes(lambda: with_tumors(260)),
        "of_254_tumors": meshes(lambda: with_tumors(254)),  # as many as are read
        "is_a_fifo": meshes(dict, fifo="kidney.stl"),
        "counts_below_zero": meshes(lambda: {"kidney.ply": BELOW_ZERO}),
    },
    read={  # materials and textures are not looked for
        "material_is_a_fifo": meshes(
            lambda: {"kidney.obj": b"mtllib pipe\n" + sphere(30).export(file_type="obj").encode()},
            fifo="pipe",
        ),
        "texture_is_a_fifo": meshes(lambda: {"kidney.ply": with_texture()}, fifo="pipe"),
        "normals_are_words": meshes(lambda: {"kidney.stl": normals_of_words()}),
    },
    long=("of_2", "material", "texture", "normals"),
)
def test_meshes(make, end, room):
    check(make, end, room)
