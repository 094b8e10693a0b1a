"""Clouds, depth images and intrinsics from and to files. Every failure is an InputError.

Metres are converted here. Sizes that a header claims are checked against the file and a limit
before anything is allocated; nothing here loads pickles.
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32

from tumortrack.core.camera import plausible
from tumortrack.core.cloud import seen_points
from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError, readable
from tumortrack.core.geometry import Affine, read_rigid
from tumortrack.core.packages import to_install
from tumortrack.core.store import read_file, read_json
from tumortrack.core.types import DepthError, DepthFrame, Intrinsics, SensorCloud
from tumortrack.core.units import depths_mm
from tumortrack.io.ply import parse_ply_properties

_CLOUD_SHAPES = "n x 3, n x 6 or (of floats) h x w x 3"
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy")  # an array may be either
DEPTH_UNIT_MM = 0.1  # the D405's default
_LEFT_KEY, MOST_LEFT_MM = "depth_left_mm", 20.0
CALIBRATED_MM = 1.0  # where a calibration does not state what it leaves (assumed)
LARGEST_FILE = 256 * 2**20  # bytes, also of what a compressed file unpacks to
_PINHOLE_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
_OTHER_KEYS = {"cx": "ppx", "cy": "ppy"}
_DISTORTION_KEYS = (
    *("coeffs", "distortion", "distortion_coefficients", "dist_coeffs", "D"),
    *("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"),
)


class PosesFile(Config, frozen=True, kw_only=True):
    """Camera poses of several views, in their order: 4 x 4 rows that carry points from the camera's
    optical frame into one fixed frame, called ``frame_id``; ``unit``: of the translations."""

    fixed_from_camera: tuple[tuple[tuple[float, float, float, float], ...], ...]
    unit: Literal["mm", "m"]
    frame_id: str


class DepthCorrection(Config, frozen=True, kw_only=True):
    """True depth = ``scale`` x measured depth + ``offset_mm``, as `calibrate camera` finds it."""

    scale: float = 1.0
    offset_mm: float = 0.0

    def __post_init__(self) -> None:
        self.check_between("depth correction:", scale=(0.8, 1.25), offset_mm=(-20.0, 20.0))

    def corrected(self, depth_mm: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        """NaN where the corrected depth is not in front of the camera."""
        if self == DepthCorrection():
            return depth_mm
        true_mm = depth_mm * np.float32(self.scale) + np.float32(self.offset_mm)
        return np.where(true_mm > 0, true_mm, np.float32(np.nan))


def read_poses(path: Path, count: int) -> tuple[str, tuple[Affine, ...]]:
    """``frame_id`` and ``fixed_from_camera`` (mm) of ``count`` views from JSON (``PosesFile``).
    Raises InputError: missing file, unknown key, wrong number of views, no rigid transform."""
    file = from_builtins(read_json(path), PosesFile, str(path))
    if (poses := len(file.fixed_from_camera)) != count:
        raise InputError(f"{path} has {poses} poses for {count} views; it must have one for each.")
    return file.frame_id, tuple(
        read_rigid(rows, file.unit, f"{path}: fixed_from_camera, view {n}")
        for n, rows in enumerate(file.fixed_from_camera, start=1)
    )


def read_cloud(path: Path, unit: Literal["mm", "m"] = "mm") -> tuple[SensorCloud, tuple[str, ...]]:
    """A cloud in the camera frame from .ply, .pcd (all three encodings), .npz or .npy, without what
    ``cloud.seen_points`` drops, and its notes. Whether it can be an organ in mm is left to
    ``cloud.check_cloud``. Raises InputError: missing, too large, damaged, of another kind, or
    without any point."""
    suffix = path.suffix.lower()
    if path.is_dir():
        raise InputError(f"{path} is a folder. Give a cloud in it, such as {path / 'cloud.ply'}.")
    if suffix not in _CLOUDS:
        raise InputError(
            f"{path} is of no kind that is read. Allowed: clouds as {', '.join(CLOUD_SUFFIXES)}, "
            f"depth images as {', '.join(DEPTH_SUFFIXES)}: save an .exr as a TIFF of floats, a "
            ".vtk as .ply."
        )
    if unit not in ("mm", "m"):
        raise InputError(f"unit {unit!r} is not understood. Allowed: mm, m.")
    raw = _CLOUDS[suffix](read_file(path, LARGEST_FILE, "Thin it first."), str(path), unit)
    columns, mm_per_unit = raw.shape[-1], 1000.0 if unit == "m" else 1.0
    # Beyond float32 becomes infinite, and is dropped like NaN, signalling or not.
    with np.errstate(over="ignore", invalid="ignore"):
        points_mm = (raw[..., :3].reshape(-1, 3) * mm_per_unit).astype(np.float32)
    kept, notes = seen_points(points_mm, str(path))
    if len(kept) == 0:
        raise InputError(f"{path} holds no point with a return ({len(points_mm)} without).")
    taken = f"took the first 3 of {columns} columns as x, y and z"
    return SensorCloud(kept), (taken, *notes) if columns > 3 else notes


def _pcd_points(content: bytes, name: str, unit: str) -> np.ndarray:
    try:
        from pypcd4 import PointCloud
    except ImportError as error:
        raise InputError(f"a .pcd cloud needs pypcd4: {to_install('tumortrack[pcd]')}.") from error

    _check_pcd_size(content, name)
    with readable(name, "cannot be read as PCD with x, y and z"):
        cloud = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(content)))
        table = np.atleast_1d(cloud.pc_data)
        points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    if len(points) != (claimed := cloud.metadata.points):
        raise InputError(f"{name} claims {claimed} points but holds {len(points)}: it is damaged.")
    return points


def _check_pcd_size(content: bytes, name: str) -> None:
    """Check the claimed size before pypcd4 allocates it, and the viewpoint."""
    header, separator, body = content[: 64 * 1024].partition(b"\nDATA ")
    fields = {line.split()[0]: line.split()[1:] for line in header.splitlines() if line.split()}
    try:
        points = int(fields[b"POINTS"][0])
        sizes = [int(size) for size in fields[b"SIZE"]]
        counts = [int(count) for count in fields.get(b"COUNT", [b"1"] * len(sizes))]
        claimed = points * sum(size * n for size, n in zip(sizes, counts, strict=True))
        start = len(header) + len(separator) + body.index(b"\n") + 1
        x, y, z, _, *turn = map(float, fields.get(b"VIEWPOINT", b"0 0 0 1 0 0 0".split()))
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"{name} is no PCD file (its header lacks or garbles a line).") from error
    if any((x, y, z, *turn)) or len(turn) != 3:
        raise InputError(
            f"{name} has a VIEWPOINT, so its frame is uncertain. Export it in the camera frame."
        )
    if body.startswith(b"binary_compressed"):
        packed, unpacked = struct.unpack_from("<II", content[start : start + 8].ljust(8, b"\0"))
        too_large = unpacked > LARGEST_FILE or packed > len(content) - start - 8
        too_large |= claimed > unpacked
    elif body.startswith(b"binary"):
        too_large = claimed > len(content) - start
    else:  # ascii: at least a digit and a blank for each number
        too_large = 2 * points * sum(counts) > len(content) - start + 1
    if too_large or points < 0 or claimed > LARGEST_FILE or sum(counts) > 1000:
        raise InputError(f"{name} claims {points} points but has no room for them; it is damaged.")


def _npz_points(content: bytes, name: str, unit: str) -> np.ndarray:
    """``points_mm``, else ``points``, else the only array that ``_is_cloud``."""
    with readable(name, "cannot be read as .npz"):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _check_npz_size(archive, name)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            preferred = [key for key in ("points_mm", "points") if key in arrays.files]
            read = {key: arrays[key] for key in preferred[:1] or arrays.files}
    clouds = [key for key, array in read.items() if _is_cloud(array)]
    if len(clouds) != 1:
        shapes = ", ".join(f"{key} {array.shape}" for key, array in read.items()) or "nothing"
        raise InputError(
            f"{name} must hold points_mm, points, or exactly one {_CLOUD_SHAPES}: it has {shapes}."
        )
    if unit == "m" and clouds == ["points_mm"]:
        raise InputError(f"{name}: 'points_mm' is in mm by its name; leave out --unit m.")
    return read[clouds[0]]


def _check_npz_size(archive: zipfile.ZipFile, name: str) -> None:
    """Check each array's claimed shape against its bytes: numpy allocates what a header claims."""
    if sum(member.file_size for member in archive.infolist()) > LARGEST_FILE:
        raise InputError(f"{name} unpacks to more than 256 MiB; thin the cloud first.")
    for member in archive.infolist():
        with archive.open(member) as stream:
            _check_npy_size(stream, member.file_size, f"{name}: {member.filename}")


def _check_npy_size(stream: Any, size: int, name: str) -> None:
    npy = np.lib.format
    version, _ = npy.read_magic(stream)
    read_header = npy.read_array_header_1_0 if version == 1 else npy.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    if math.prod((dtype.itemsize, *shape)) > size or min(shape, default=0) < 0:
        raise InputError(f"{name} claims more than the file holds.")


def _npy(content: bytes, name: str) -> np.ndarray:
    """An array of numbers, in this machine's byte order."""
    with readable(name, "cannot be read as .npy"):
        _check_npy_size(io.BytesIO(content), len(content), name)
        array = np.load(io.BytesIO(content), allow_pickle=False)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} is an array of {array.dtype}; it must be one of numbers.")
    return array.astype(array.dtype.newbyteorder("="))


def _npy_points(content: bytes, name: str, unit: str) -> np.ndarray:
    array = _npy(content, name)
    if not _is_cloud(array):
        raise InputError(
            f"{name} is an array {array.shape}; a cloud is {_CLOUD_SHAPES}. A depth image takes "
            "--intrinsics FILE.json."
        )
    return array


def _is_cloud(array: np.ndarray) -> bool:
    """Whole numbers of an image's shape are a picture in colour."""
    numbers = "fiu" if array.ndim == 2 else "f"
    return array.ndim in (2, 3) and array.shape[-1] in (3, 6) and array.dtype.kind in numbers


# From content, name and unit to numbers in the file's unit, of which x, y, z are the first.
_CLOUDS: dict[str, Callable[[bytes, str, str], np.ndarray]] = {
    ".ply": lambda content, name, _: parse_ply_properties(content, name),
    ".pcd": _pcd_points,
    ".npz": _npz_points,
    ".npy": _npy_points,
}
CLOUD_SUFFIXES = tuple(_CLOUDS)


class _Camera(NamedTuple):
    """A camera's file: the mm of a step of depth are None where it does not say."""

    intrinsics: Intrinsics
    correction: DepthCorrection
    unit_mm: float | None


def read_intrinsics(path: Path) -> Intrinsics:
    """A pinhole camera from JSON: width, height, fx, fy, cx (or ppx), cy (or ppy), in pixels.
    Raises InputError: missing, not JSON, a key missing or no number, or lens distortion."""
    return _camera(path).intrinsics


def read_camera(path: Path | None) -> tuple[Intrinsics | None, DepthCorrection]:
    """A camera as ``read_intrinsics`` reads it, and the file's depth correction, if any."""
    return (None, DepthCorrection()) if path is None else _camera(path)[:2]


def _camera(path: Path) -> _Camera:
    data = read_json(path)
    data = {key: data[other] for key, other in _OTHER_KEYS.items() if other in data} | data
    for key in _DISTORTION_KEYS:
        values = data.get(key, 0)
        if any(values if isinstance(values, list) else [values]):
            raise InputError(
                f"{path}: {key!r} states lens distortion. Give the rectified depth and its camera."
            )

    def number(key: str, default: float | None = None) -> float:
        try:
            value = float(data.get(key, default))  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            value = math.nan
        if not math.isfinite(value):
            raise InputError(
                f"{path}: {key!r} is {str(data.get(key))[:60]}; it must be a finite number. A "
                "camera has width, height, fx, fy, cx (or ppx), cy (or ppy), in pixels."
            )
        return value

    width, height, fx, fy, cx, cy = map(number, _PINHOLE_KEYS)
    if not (width.is_integer() and height.is_integer()):
        raise InputError(f"{path}: width {width:g} and height {height:g} must be whole numbers.")
    error = None  # nobody has calibrated it
    if data.keys() & {_LEFT_KEY, "depth_scale", "depth_offset_mm"}:
        error = DepthError(number(_LEFT_KEY, CALIBRATED_MM))
        if not 0 <= error.offset_mm <= MOST_LEFT_MM:
            raise InputError(
                f"{path}: {_LEFT_KEY} is {error.offset_mm}; allowed: 0 to {MOST_LEFT_MM:g} mm."
            )
    scale, offset_mm = number("depth_scale", 1.0), number("depth_offset_mm", 0.0)
    try:
        correction = DepthCorrection(scale=scale, offset_mm=offset_mm)
        camera = Intrinsics(int(width), int(height), fx, fy, cx, cy, error)
    except InputError as fault:
        raise InputError(f"{path}: {fault} The mm of one step are depth_unit_mm.") from fault
    unit_mm = number("depth_unit_mm") if "depth_unit_mm" in data else None
    return _Camera(plausible(camera, str(path)), correction, unit_mm)


def intrinsics_json(intrinsics: Intrinsics) -> dict[str, Any]:
    """Content of intrinsics.json beside a depth.png: the pinhole, the mm per step of depth, and a
    depth error that is the same at every depth."""
    values = {key: getattr(intrinsics, key) for key in _PINHOLE_KEYS}
    stated: dict[str, Any] = {**values, "depth_unit_mm": DEPTH_UNIT_MM}
    if intrinsics.depth_error is not None and not intrinsics.depth_error.scale:
        stated[_LEFT_KEY] = intrinsics.depth_error.offset_mm
    return stated


def read_depth_png(path: Path, intrinsics_path: Path) -> DepthFrame:
    """A depth image with the unit of its intrinsics file; see ``read_depth``."""
    return read_depth(path, intrinsics_path)[0]


def read_depth(
    path: Path, intrinsics_path: Path, unit_mm: float | None = None
) -> tuple[DepthFrame, float]:
    """A depth image (16-bit PNG or TIFF, a TIFF of floats, or .npy) and its unit, mm per step:
    ``unit_mm``, else depth_unit_mm of the intrinsics file, else 0.1 for whole numbers and 1000
    (metres) for floats. The file's depth correction is applied. Whether the unit can be right is
    left to ``cloud.check_depth_unit``. Raises InputError: no such image, of another size than the
    intrinsics, or no valid unit."""
    intrinsics, correction, stated_mm = _camera(intrinsics_path)
    steps, mode = _image(path, (intrinsics.width, intrinsics.height))
    if not mode.startswith(("I", "F")):
        raise InputError(f"{path} has pixels of the kind {mode}; allowed: 16-bit grey, or floats.")
    if unit_mm is None:
        default_mm = DEPTH_UNIT_MM if mode.startswith("I") else 1000.0
        unit_mm = default_mm if stated_mm is None else stated_mm
    if not 0 < unit_mm <= 1000:
        raise InputError(f"depth_unit_mm is {unit_mm}; it must lie in 0..1000 mm per step.")
    depth_mm = correction.corrected(depths_mm(steps, unit_mm))
    return DepthFrame(depth_mm, intrinsics), unit_mm


def read_mask(path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """True where an image (PNG, TIFF or BMP) is not 0, whatever its transparency. Raises
    InputError: no such image, or not of this width and height."""
    values, _ = _image(path, size)
    return np.not_equal(values, 0).reshape(*values.shape[:2], -1).any(axis=2)


def _image(path: Path, size: tuple[int, int]) -> tuple[np.ndarray, str]:
    """An image's values without its transparency, and its Pillow mode."""
    if path.suffix.lower() == ".npy":
        array = _npy(read_file(path, LARGEST_FILE), str(path))
        if array.shape != (size[1], size[0]):
            raise InputError(
                f"{path} is an array {array.shape}; it must be {size[1]} x {size[0]}, its camera's."
            )
        return array, "F" if array.dtype.kind == "f" else "I"
    with readable(path, "is no 16-bit PNG or TIFF, or TIFF of 32-bit floats, that can be read"):
        image = open_picture(path, LARGEST_FILE)
        if image.size == size:  # known from the header, before anything is decoded
            opaque = image.convert("RGB") if image.mode in ("RGBA", "LA", "PA") else image
            return np.asarray(opaque), image.mode
    given, stated = (f"{width} x {height}" for width, height in (image.size, size))
    raise InputError(f"{path} is {given}; it must be {stated}, as its intrinsics say.")


def open_picture(path: Path, largest_file: int) -> Any:
    """A Pillow image, of which the header alone is decoded. Raises InputError: missing, too large,
    or several images."""
    from PIL import Image

    content = io.BytesIO(read_file(path, largest_file))
    image = Image.open(content, formats=["PNG", "TIFF", "BMP"])
    if (count := getattr(image, "n_frames", 1)) > 1:
        raise InputError(f"{path} holds {count} images. Save the one that is meant.")
    return image


def depth_png(frame: DepthFrame, compress_level: int = 6) -> bytes:
    """The depth as a 16-bit PNG in steps of 0.1 mm; NaN becomes 0. ``compress_level`` 1 takes a
    sixth of the time, for a fifth more bytes. Raises InputError: a depth that does not fit."""
    from PIL import Image

    steps = np.rint(frame.depth_mm.astype(np.float64) / DEPTH_UNIT_MM)
    returned = np.isfinite(steps)
    if not ((steps[returned] >= 1) & (steps[returned] < 65535)).all():
        raise InputError(
            f"a depth lies outside {DEPTH_UNIT_MM:g}..{65534 * DEPTH_UNIT_MM:g} mm; crop the frame."
        )
    stream = io.BytesIO()
    image = Image.fromarray(np.where(returned, steps, 0).astype(np.uint16))
    image.save(stream, format="PNG", compress_level=compress_level)
    return stream.getvalue()
