"""Volumes, clouds, images and meshes as bytes, to be damaged."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import trimesh

SPACE = (
    "space: left-posterior-superior\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"
    "space origin: (0,0,0)\n"
)


def ball(size: int = 40) -> np.ndarray:
    index = np.indices((size,) * 3) - size / 2
    return ((index**2).sum(0) < (0.4 * size) ** 2).astype(np.uint8)


def nifti_header(shape: tuple[int, ...], code: int = 2, bits: int = 8) -> bytearray:
    """Of NIfTI-1, with voxels of 1 mm along the axes."""
    header = bytearray(352)
    struct.pack_into("<i", header, 0, 348)
    struct.pack_into("<8h", header, 40, len(shape), *shape, *[1] * (7 - len(shape)))
    struct.pack_into("<hh", header, 70, code, bits)
    struct.pack_into("<8f", header, 76, 1, *[1.0] * 7)
    struct.pack_into("<ff", header, 108, 352.0, 1.0)  # where the data begin; slope
    header[123] = 2  # mm
    struct.pack_into("<hh", header, 252, 1, 1)
    struct.pack_into("<12f", header, 280, *np.eye(4)[:3].ravel())
    header[344:348] = b"n+1\0"
    return header


def nrrd(sizes: str, more: str, data: bytes = b"") -> bytes:
    head = f"type: uint8\ndimension: 3\nsizes: {sizes}\n{SPACE}{more}"
    return f"NRRD0004\n{head}\n\n".encode() + data


def sphere(
    radius_mm: float, middle: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> trimesh.Trimesh:
    made = trimesh.creation.icosphere(subdivisions=3, radius=radius_mm)
    made.apply_translation(middle)
    return made


def ply(points: np.ndarray) -> bytes:
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    ).encode() + points.astype("<f4").tobytes()


def pcd(viewpoint: str = "0 0 0 1 0 0 0", count: int = 3) -> bytes:
    return (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH "
        f"{count}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {count}\nDATA binary\n"
    ).encode()


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def png(width: int, height: int, bits: int, pixels: bytes) -> bytes:
    """Grey, of packed rows."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        size, checksum = struct.pack(">I", len(body)), struct.pack(">I", zlib.crc32(kind + body))
        return size + kind + body + checksum

    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    data = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + data
