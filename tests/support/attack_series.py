"""Hostile input: DICOM series and meshes."""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from attack_registry import ATTACKS, FINISH, Attack, Made, attack, must_finish
from attack_volumes import ball


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
    ("dicom_orientation_of_four_numbers", "ImageOrientationPatient", [1.0, 0, 0, 1], slice(None)),
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
def _dicom_deflated_bomb(folder: Path, base: Path) -> Made:
    """A slice of 2 MB, deflated as a whole, that unpacks to 2 GB in front of its pixels."""
    import pydicom
    from pydicom.uid import DeflatedExplicitVRLittleEndian

    made = dicom(folder, lambda slices: None)
    path = sorted((folder / "series").iterdir())[3]
    dataset = pydicom.dcmread(path)
    dataset.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    del dataset.PixelData
    dataset.save_as(path)
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = struct.pack("<HH2sHI", 0x0009, 0x0010, b"UN", 0, 2_000_000_000)
    bomb = pack.compress(head) + b"".join(pack.compress(bytes(1_000_000)) for _ in range(2000))
    content = path.read_bytes()
    start = 132 + 12 + struct.unpack_from("<I", content, 140)[0]  # behind the file's meta group
    path.write_bytes(content[:start] + bomb + pack.flush())
    return made


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
def _dicom_garbage_behind_the_pixels(folder: Path, base: Path) -> Made:
    """An element of no type behind the pixels: GDCM makes room for 1.4 GB, as it reads its type."""
    made = dicom(folder, lambda slices: None)
    path = sorted((folder / "series").iterdir())[3]
    path.write_bytes(path.read_bytes() + struct.pack("<HH4s", 0x5945, 0x18, b"P\0DS") + bytes(90))
    return made


@attack
def _dicom_cut_files(folder: Path, base: Path) -> Made:
    def change(slices: list[Any]) -> None:
        for n, (dataset, path) in enumerate(slices):
            if n % 2:
                path.write_bytes(path.read_bytes()[:400])
                slices[n] = (None, path)
            del dataset

    return dicom(folder, change)


@must_finish
def _dicom_latin1_names(folder: Path, base: Path) -> Made:
    """File names that are no UTF-8."""

    def change(slices: list[Any]) -> None:
        for n, (dataset, path) in enumerate(slices):
            dataset.save_as(path)
            os.rename(
                os.fsencode(path), os.fsencode(path.parent) + f"/sch\xf6n{n}".encode("latin-1")
            )
        slices.clear()

    return dicom(folder, change)


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


@must_finish
def _mesh_material_is_a_fifo(folder: Path, base: Path) -> Made:
    """Materials are not looked for."""
    made = meshes(
        folder, kidney__obj=b"mtllib pipe\n" + sphere(30).export(file_type="obj").encode()
    )
    os.mkfifo(folder / "meshes" / "pipe")
    return made


@must_finish
def _mesh_texture_is_a_fifo(folder: Path, base: Path) -> Made:
    content = sphere(30).export(file_type="ply")
    content = content.replace(b"1.0\n", b"1.0\ncomment TextureFile pipe\n", 1)
    made = meshes(folder, kidney__ply=content)
    os.mkfifo(folder / "meshes" / "pipe")
    return made


@must_finish
def _mesh_stl_normals_are_words(folder: Path, base: Path) -> Made:
    content = sphere(30).export(file_type="stl_ascii").encode()
    return meshes(folder, kidney__stl=re.sub(rb"normal .*", b"normal up up up", content))


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
