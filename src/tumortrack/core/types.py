"""The pipeline's values: frozen, with read-only arrays and annotated shapes.

Frames: ``lps`` is the patient's (DICOM), ``camera`` is OpenCV's (x right, y down, z forward).
Labels: 0 outside, 1 organ, 2, 3, ... tumors; a tumor wins where parts overlap.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from jaxtyping import Float, Float32, Float64, Int32, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spread_over
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.renamed import Renamed

OUTSIDE, ORGAN, FIRST_TUMOR = 0, 1, 2


def _freeze(value: object, name: str, dtype: npt.DTypeLike, shape: tuple[int | None, ...]) -> None:
    """Convert a field to a read-only array and check its shape (None: any length)."""
    given, field = np.asarray(getattr(value, name)), f"{type(value).__name__}.{name}"
    if given.dtype == dtype and not given.flags.writeable and _is_alone(given):
        array = given  # already frozen by another value, or bytes of a file
    else:
        array = given.astype(dtype)  # a copy, so that the caller's stays writable
    if array.dtype.kind in "iu" and array.dtype != given.dtype and (array != given).any():
        raise InputError(
            f"{field} has numbers that are no {array.dtype}; give whole "
            f"numbers in {np.iinfo(array.dtype).min}..{np.iinfo(array.dtype).max}."
        )
    pairs = zip(shape, array.shape, strict=False)
    if array.ndim != len(shape) or any(want not in (None, have) for want, have in pairs):
        wanted = " x ".join("n" if s is None else str(s) for s in shape)
        raise InputError(f"{field} has shape {array.shape}; it must be {wanted}.")
    array.flags.writeable = False
    object.__setattr__(value, name, array)


def _is_alone(array: np.ndarray) -> bool:
    """Whether a read-only array shows what no other one can write."""
    base = array.base
    while isinstance(base, np.ndarray):
        base = base.base
    return array.flags.owndata or isinstance(base, bytes)


def _freeze_grid(value: object, values: str, dtype: npt.DTypeLike, name: str) -> None:
    """The same for values on a voxel grid and its affine."""
    _freeze(value, values, dtype, (None, None, None))
    _freeze(value, name, np.float64, (4, 4))
    affine = getattr(value, name)
    if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < 1e-9:
        raise InputError(
            f"{type(value).__name__}.{name} is singular or has NaN; it must be an invertible "
            "4 x 4 transform from array index to millimetres. Export the volume again."
        )


@dataclass(frozen=True, eq=False)
class Volume:
    """A CT volume. ``hu``: Hounsfield units, axes (i, j, k); ``lps_from_index``: index -> mm."""

    hu: Float32[np.ndarray, "i j k"]
    lps_from_index: Float64[np.ndarray, "4 4"]

    def __post_init__(self) -> None:
        _freeze_grid(self, "hu", np.float32, "lps_from_index")


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """Labels on a voxel grid of the patient, axes (i, j, k)."""

    labels: UInt8[np.ndarray, "i j k"]
    lps_from_index: Float64[np.ndarray, "4 4"]

    def __post_init__(self) -> None:
        _freeze_grid(self, "labels", np.uint8, "lps_from_index")


@dataclass(frozen=True, eq=False)
class CameraLabels:
    """Labels on a voxel grid in the camera frame, axes (i, j, k)."""

    labels: UInt8[np.ndarray, "i j k"]
    camera_from_index: Float64[np.ndarray, "4 4"]

    def __post_init__(self) -> None:
        _freeze_grid(self, "labels", np.uint8, "camera_from_index")


@dataclass(frozen=True, eq=False)
class Mesh(Renamed):
    """A triangle surface; the variable that holds it names the frame. Faces turn outward."""

    vertices_mm: Float64[np.ndarray, "v 3"]
    faces: Int32[np.ndarray, "f 3"]

    def __post_init__(self) -> None:
        _freeze(self, "vertices_mm", np.float64, (None, 3))
        _freeze(self, "faces", np.int32, (None, 3))
        if not np.isfinite(self.vertices_mm).all():
            raise InputError("the mesh has NaN or infinite vertices. Export it again.")
        faces = self.faces
        if len(faces) and not (faces.min() >= 0 and faces.max() < len(self.vertices_mm)):
            raise InputError("the mesh has faces that name vertices it does not have.")

    @cached_property
    def volume_mm3(self) -> float:
        """Signed volume (divergence theorem): positive where faces turn outward."""
        from tumortrack.core.mesh_kernels import signed_volume

        return float(signed_volume(self.vertices_mm, self.faces))

    @property
    def volume_ml(self) -> float:
        return self.volume_mm3 / 1000

    @cached_property
    def box_mm(self) -> Float64[np.ndarray, "2 3"]:
        """Axis-aligned bounding box: lower and upper corner."""
        axes = np.ascontiguousarray(self.vertices_mm.T)  # ten times faster than along axis 0
        return np.stack([axes.min(1), axes.max(1)])

    @property
    def longest_mm(self) -> float:
        """The longest side of the box."""
        return float(np.ptp(self.box_mm, axis=0).max())

    def spread_mm(self, longest_mm: float = 2.0) -> Float64[np.ndarray, "n 3"]:
        """Points all over the surface, see ``spread_over``. By default one is at most 1.2 mm
        away, so that a distance of 5 mm to the surface is at most 0.1 mm too long."""
        return spread_over(self.vertices_mm, self.faces, longest_mm)

    @cached_property
    def closed(self) -> bool:
        """Whether it has an inside: an even number of triangles meet at each edge."""
        edges = np.sort(np.concatenate([self.faces[:, [n, (n + 1) % 3]] for n in range(3)]), axis=1)
        return not (np.unique(edges, axis=0, return_counts=True)[1] % 2).any()

    def with_vertices(self, vertices_mm: Float[np.ndarray, "v 3"]) -> Mesh:
        """The same triangles with other vertices (a deformation or a change of frame)."""
        return Mesh(vertices_mm, self.faces)


@dataclass(frozen=True, eq=False)
class Anatomy(Renamed):
    """Closed surfaces: ``parts[0]`` is the union of organ and tumors, and so the visible surface;
    ``parts[n]`` is the tumor labelled n + 1. ``structures``: further surfaces that move with the
    organ, closed or open."""

    parts: tuple[Mesh, ...]
    organ_kind: Organ = KIDNEY
    structures: Mapping[str, Mesh] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.parts) < 1:
            raise InputError("an anatomy needs at least the organ's surface.")

    @property
    def names(self) -> tuple[str, ...]:
        """See ``part_names``; mesh files have these names, too."""
        return part_names(len(self.parts), self.organ_kind.name)

    @cached_property
    def closed(self) -> Mapping[str, Mesh]:
        """By name: the parts, then those structures that are closed. What can be touched."""
        parts = dict(zip(self.names, self.parts, strict=True))
        return parts | {name: mesh for name, mesh in self.structures.items() if mesh.closed}

    def with_parts(self, parts: Iterable[Mesh]) -> Anatomy:
        """The same organ with other surfaces, and no structures."""
        return Anatomy(tuple(parts), self.organ_kind)

    @property
    def organ(self) -> Mesh:
        return self.parts[0]

    @property
    def tumors(self) -> tuple[Mesh, ...]:
        return self.parts[1:]


def part_names(n_parts: int, organ: str) -> tuple[str, ...]:
    """Names of the parts with label 1, 2, 3, ...: the organ's, tumor_1, tumor_2, ..."""
    return (organ, *(f"tumor_{n}" for n in range(1, n_parts)))


class DepthError(NamedTuple):
    """How far off a camera's depths are at most, the same for all: mm, and a share of the depth.
    Each unit errs by its own, uniformly to either side."""

    offset_mm: float = 0.0
    scale: float = 0.0

    def share(self, depth_mm: float) -> float:
        """Standard deviation at a depth, as a share of it."""
        return float(np.hypot(self.offset_mm / depth_mm, self.scale)) / 3**0.5


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera without distortion; pixel centres at whole numbers. Lengths in pixels.
    ``depth_error``: of its depths; None: nobody has stated it."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    depth_error: DepthError | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        six = [float(getattr(self, f.name)) for f in fields(self) if f.compare]
        if not np.isfinite(six).all() or min(self.fx, self.fy) <= 0:
            raise InputError(f"intrinsics {six} are not usable; fx and fy must be positive pixels.")
        if not (0 < self.width <= 8192 and 0 < self.height <= 8192):
            raise InputError("intrinsics: width and height must lie in 1..8192 pixels.")


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """A depth image: distance along z in mm, NaN where the sensor had no return."""

    depth_mm: Float32[np.ndarray, "h w"]
    intrinsics: Intrinsics
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        _freeze(self, "depth_mm", np.float32, (self.intrinsics.height, self.intrinsics.width))

    @property
    def depth_error(self) -> DepthError | None:
        return self.intrinsics.depth_error

    def with_depth(self, depth_mm: Float32[np.ndarray, "h w"]) -> DepthFrame:
        """The same frame with another depth, which is not copied but becomes read-only."""
        depth_mm.flags.writeable = False
        return DepthFrame(depth_mm, self.intrinsics, self.stamp_ns)


class PointNoise(NamedTuple):
    """Standard deviations, mm, along the line of sight: of what was measured; of a point, of which
    neighbours' white noise may be averaged away; of the mean of all points of a view, as what
    neighbours share does not average out; and of a shift of all points, along any axis."""

    measured_mm: float = 0.0
    point_mm: float = 0.0
    mean_mm: float = 0.0
    shift_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class SensorCloud:
    """Points seen by the sensor, camera frame, mm, float32, all finite. ``noise``: of the points,
    as measured; None: not yet. ``candidates_mm``: points beside them that may be the organ's too,
    as dense as they are. ``depth_error``: of the camera; None: nobody has stated it. ``others``:
    what else in the image may be the organ instead, the most likely first."""

    points_mm: Float32[np.ndarray, "n 3"]
    stamp_ns: int = 0
    noise: PointNoise | None = None
    candidates_mm: Float32[np.ndarray, "c 3"] = field(
        default_factory=lambda: np.zeros((0, 3), np.float32)
    )
    depth_error: DepthError | None = None
    others: tuple[SensorCloud, ...] = ()

    def __post_init__(self) -> None:
        _freeze(self, "points_mm", np.float32, (None, 3))
        _freeze(self, "candidates_mm", np.float32, (None, 3))
        if not np.isfinite(self.points_mm).all():
            raise InputError(
                "the cloud has NaN or infinite points; remove them first (no return is no point)."
            )


@dataclass(frozen=True, eq=False)
class View(Renamed):
    """The organ seen by another camera or from another place: its points, ``cloud``, and all that
    it saw (``full_view``), in that camera's frame; ``camera_from_view`` leads to the first
    camera's."""

    cloud: SensorCloud
    full_view: DepthFrame | SensorCloud
    camera_from_view: Float64[np.ndarray, "4 4"]

    def __post_init__(self) -> None:
        _freeze(self, "camera_from_view", np.float64, (4, 4))

    @property
    def of_no_camera(self) -> bool:
        """Whether there is nothing, or but what was touched or outlined: no camera saw it."""
        return isinstance(self.full_view, SensorCloud) and not len(self.full_view.points_mm)


@dataclass(frozen=True, eq=False)
class OccupancyCloud:
    """An estimate as points inside the organ, with label >= 1 and its probability, camera frame."""

    points_mm: Float32[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    probability: Float32[np.ndarray, " n"]
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        _freeze(self, "points_mm", np.float32, (None, 3))
        _freeze(self, "labels", np.uint8, (len(self.points_mm),))
        _freeze(self, "probability", np.float32, (len(self.points_mm),))
        if not np.isfinite(self.points_mm).all():
            raise InputError("the estimate has NaN or infinite points; locate again.")
