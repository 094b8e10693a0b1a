"""Recordings of a tracked probe as files: MetaImage by SimpleITK, NRRD by hand."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import SimpleITK as sitk  # noqa: N813  # as everybody does

Frames = Sequence[Mapping[str, str]]


def words(matrix: np.ndarray) -> str:
    return " ".join(map(repr, np.asarray(matrix, float).ravel().tolist()))


def stamped(
    poses: Mapping[str, np.ndarray], rate_hz: float = 20.0, start_s: float = 10.0
) -> Frames:
    """Fields of frames, by the names of their transforms (m, 4, 4)."""
    count = len(next(iter(poses.values())))
    return [
        {
            "Timestamp": repr(start_s + n / rate_hz),
            **{f"{name}Transform": words(each[n]) for name, each in poses.items()},
            **{f"{name}TransformStatus": "OK" for name in poses},
        }
        for n in range(count)
    ]


def keys_of(frames: Frames) -> dict[str, str]:
    return {
        f"Seq_Frame{n:04d}_{key}": value for n, f in enumerate(frames) for key, value in f.items()
    }


def write_meta_image(
    path: Path,
    images: np.ndarray,
    frames: Frames,
    fields: Mapping[str, str] = {},  # never written to
    compressed: bool = True,
) -> Path:
    """Images (n, rows, columns), (n, 1, rows, columns) or, in colour, (n, rows, columns, 3)."""
    image = sitk.GetImageFromArray(images, isVector=images.ndim == 4 and images.shape[-1] == 3)
    for name, value in {**fields, **keys_of(frames)}.items():
        image.SetMetaData(name, value)
    sitk.WriteImage(image, str(path), compressed)
    return path


def write_nrrd(
    path: Path,
    array: np.ndarray,
    kinds: str,
    keys: Mapping[str, str],
    encoding: str = "gzip",
    fields: str = "",
) -> Path:
    """``array``: its last axis is the fastest."""
    code = {"uint8": "uint8", "uint16": "uint16", "int16": "int16"}[array.dtype.name]
    endian = "big" if array.dtype.byteorder == ">" else "little"
    head = (
        f"NRRD0005\n# by hand\ntype: {code}\ndimension: {array.ndim}\n{fields}"
        f"sizes: {' '.join(map(str, array.shape[::-1]))}\nkinds: {kinds}\nendian: {endian}\n"
        f"encoding: {encoding}\n" + "".join(f"{name}:={value}\n" for name, value in keys.items())
    )
    data = array.tobytes()
    path.write_bytes(f"{head}\n".encode() + (gzip.compress(data) if encoding == "gzip" else data))
    return path
