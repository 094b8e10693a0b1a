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

from attack import Make, Room, attacks
from attack_volumes import ball

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
        from tumortrack.phantom.dicom import write_dicom_series

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
        return ["prepare", series, room.out]

    return make


def tag(name: str, value: object, which: slice = EVERY) -> Make:
    """A tag of such slices is missing (None) or has another value."""

    def change(slices: list[Any]) -> None:
        for dataset in slices[which]:
            if value is None:
                delattr(dataset, name)
            elif value != value:  # NaN: pydicom takes none
                dataset[name]._value = value
            else:
                setattr(dataset, name, value)

    return dicom(change)


def _drop(slices: list[Any], which: slice) -> None:
    del slices[which]


def _position_nan_and_slices_missing(slices: list[Any]) -> None:
    slices[3]["ImagePositionPatient"]._value = [0.0, 0.0, float("nan")]
    del slices[15:25]


def _pixels_elsewhere(slices: list[Any]) -> None:
    """Half a slice's pixels, and as many bytes of something else behind them."""
    slices[7].PixelData = bytes(40 * 40)
    slices[7].add_new((0x7FE1, 0x1010), "OB", bytes(40 * 40 * 4))


def _compressed_claims_much(slices: list[Any]) -> None:
    """Small compressed slices that claim 30000 x 30000."""
    from pydicom.encaps import encapsulate
    from pydicom.uid import JPEG2000Lossless

    for dataset in slices:
        dataset.file_meta.TransferSyntaxUID = JPEG2000Lossless
        dataset.PixelData = encapsulate([bytes(1000)])
        dataset["PixelData"].is_undefined_length = True
        dataset.Rows = dataset.Columns = 30000


def _deflated_bomb(paths: list[Path]) -> None:
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


def _elements_of_no_type(paths: list[Path]) -> None:
    """An element whose type no reader knows: some take its length for gigabytes."""
    for path in paths:
        path.write_bytes(path.read_bytes().replace(b"\x02\0UI\x1a\0", b"\x02\0UA\x1a\0"))


def _garbage_behind_the_pixels(paths: list[Path]) -> None:
    """An element of no type behind the pixels: GDCM makes room for 1.4 GB, as it reads its type."""
    garbage = struct.pack("<HH4s", 0x5945, 0x18, b"P\0DS") + bytes(90)
    paths[3].write_bytes(paths[3].read_bytes() + garbage)


def _cut(paths: list[Path]) -> None:
    for path in paths[1::2]:
        path.write_bytes(path.read_bytes()[:400])


def _latin1_names(paths: list[Path]) -> None:
    for n, path in enumerate(paths):
        path.rename(path.with_name(os.fsdecode(f"sch\xf6n{n}".encode("latin-1"))))


def sphere(radius_mm: float, middle: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=3, radius=radius_mm)
    made.apply_translation(middle)
    return made


def meshes(parts: Callable[[], dict[str, Any]], fifo: str = "") -> Make:
    """`prepare` on a folder of meshes: files' contents, or meshes written as STL."""

    def make(room: Room) -> list[object]:
        (room.folder / "meshes").mkdir()
        for name, part in parts().items():
            if isinstance(part, bytes):
                room.file(f"meshes/{name}", part)
            else:
                part.export(room.folder / "meshes" / f"{name}.stl")
        if fifo:
            room.fifo(f"meshes/{fifo}")
        return ["prepare", room.folder / "meshes", room.out]

    return make


def _half() -> Any:
    half = sphere(30)
    half.update_faces(np.arange(len(half.faces)) < len(half.faces) // 2)
    return half


def _nan() -> bytes:
    broken = bytearray(sphere(30).export(file_type="stl"))
    struct.pack_into("<f", broken, 84 + 12, float("nan"))
    return bytes(broken)


def _far() -> Any:
    far = sphere(30)
    far.vertices[0] = 1e30
    return far


def _with_tumors(count: int) -> dict[str, Any]:
    """All in one place."""
    tumor = sphere(3, (20.0, 0, 0))
    return {"kidney": sphere(30), **{f"tumor_{n}": tumor for n in range(1, count + 1)}}


def _with_texture() -> bytes:
    content: bytes = sphere(30).export(file_type="ply")
    return content.replace(b"1.0\n", b"1.0\ncomment TextureFile pipe\n", 1)


def _normals_of_words() -> bytes:
    content = sphere(30).export(file_type="stl_ascii").encode()
    return re.sub(rb"normal .*", b"normal up up up", content)


_BELOW_ZERO = (
    b"ply\nformat ascii 1.0\nelement vertex -5\nproperty float x\nproperty float y\n"
    b"property float z\nend_header\n"
)
_FEW_VERTICES = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999\n"

ATTACKS = attacks(
    refused={
        "dicom_slice_missing": dicom(lambda slices: _drop(slices, slice(20, 21))),
        "dicom_position_nan_and_slices_missing": dicom(_position_nan_and_slices_missing),
        "dicom_negative_spacing": tag("PixelSpacing", [-2.0, 2.0]),
        "dicom_spacing_zero": tag("PixelSpacing", [0.0, 2.0]),
        "dicom_spacing_missing": tag("PixelSpacing", None),
        "dicom_spacing_differs": tag("PixelSpacing", [1.0, 1.0], slice(5, 6)),
        "dicom_slope_zero": tag("RescaleSlope", 0),
        "dicom_slope_differs": tag("RescaleSlope", 2, slice(10, 20)),
        "dicom_slope_nan": tag("RescaleSlope", float("nan")),
        "dicom_intercept_differs": tag("RescaleIntercept", 0, slice(10, 30)),
        "dicom_orientation_missing": tag("ImageOrientationPatient", None, slice(4, 5)),
        "dicom_orientation_zero": tag("ImageOrientationPatient", [0.0] * 6),
        "dicom_orientation_of_four_numbers": tag("ImageOrientationPatient", [1.0, 0, 0, 1]),
        "dicom_orientation_turns": tag(
            "ImageOrientationPatient", [0.0, 1, 0, 1, 0, 0], slice(9, 10)
        ),
        "dicom_position_missing": tag("ImagePositionPatient", None, slice(4, 5)),
        "dicom_position_twice": tag("ImagePositionPatient", [0.0, 0.0, 20.0], slice(11, 12)),
        "dicom_half_the_pixels": tag("PixelData", bytes(40 * 40), slice(7, 8)),
        "dicom_no_pixels": tag("PixelData", None),
        "dicom_claims_60000_rows": tag("Rows", 60000),
        "dicom_rows_zero": tag("Rows", 0),
        "dicom_three_samples": tag("SamplesPerPixel", 3),
        "dicom_pixels_elsewhere": dicom(_pixels_elsewhere),
        "dicom_compressed_claims_much": dicom(_compressed_claims_much),
        "dicom_deflated_bomb": dicom(of_files=_deflated_bomb),
        "dicom_elements_of_no_type": dicom(of_files=_elements_of_no_type),
        "dicom_garbage_behind_the_pixels": dicom(of_files=_garbage_behind_the_pixels),
        "dicom_cut_files": dicom(of_files=_cut),
        "mesh_claims_billions": meshes(lambda: {"kidney.stl": bytes(80) + b"\xff" * 4 + bytes(50)}),
        "mesh_open": meshes(lambda: {"kidney": _half()}),
        "mesh_nan": meshes(lambda: {"kidney.stl": _nan()}),
        "mesh_vertices_at_1e30": meshes(lambda: {"kidney": _far()}),
        "mesh_without_faces": meshes(lambda: {"kidney.stl": bytes(84)}),
        "mesh_faces_without_vertices": meshes(lambda: {"kidney.obj": _FEW_VERTICES}),
        "mesh_of_a_kilometre": meshes(lambda: {"kidney": sphere(1e6)}),
        "mesh_tumor_round_the_kidney": meshes(
            lambda: {"kidney": sphere(30), "tumor_1": sphere(52)}
        ),
        "mesh_tumor_elsewhere": meshes(
            lambda: {"kidney": sphere(30), "tumor_1": sphere(8, (200.0, 0, 0))}
        ),
        "mesh_260_tumors": meshes(lambda: _with_tumors(260)),
        "mesh_254_tumors_of_noise": meshes(lambda: _with_tumors(254)),  # as many as are read
        "mesh_is_a_fifo": meshes(dict, fifo="kidney.stl"),
        "mesh_ply_counts_below_zero": meshes(lambda: {"kidney.ply": _BELOW_ZERO}),
    },
    either={
        # Anonymised series lack it: read, with a note.
        "dicom_no_series": tag("SeriesInstanceUID", None),
    },
    read={
        "dicom_latin1_names": dicom(of_files=_latin1_names),
        # Materials and textures are not looked for.
        "mesh_material_is_a_fifo": meshes(
            lambda: {"kidney.obj": b"mtllib pipe\n" + sphere(30).export(file_type="obj").encode()},
            fifo="pipe",
        ),
        "mesh_texture_is_a_fifo": meshes(lambda: {"kidney.ply": _with_texture()}, fifo="pipe"),
        "mesh_stl_normals_are_words": meshes(lambda: {"kidney.stl": _normals_of_words()}),
    },
)
