"""What a warp model knows of the organ at rest: surfaces, signed distances, elastic body."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.process import parallel_for
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import contains, surface_distance

_STEPS = 40  # of a distance field, along the part's longest side
_FINEST_MM, _COARSEST_MM = 0.5, 2.0
_REACH = 10  # steps about a part; farther out the distance is that of the nearest border
_AT_ONCE = 4096  # points: a thread's part
_BODY = "body."


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Signed distance to one closed surface (mm, negative inside) on a lattice, CT frame."""

    origin_mm: Float32[np.ndarray, " 3"]
    spacing_mm: float
    values_mm: Float32[np.ndarray, "i j k"]

    def at(self, points_ct: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """The distance of points, by trilinear interpolation."""
        return self.with_slope(points_ct)[0]

    def with_slope(
        self, points_ct: Float32[np.ndarray, "n 3"]
    ) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, "n 3"]]:
        """Distance and its slope, which points outwards."""
        spacing = np.float32(self.spacing_mm)
        return _distance(self.values_mm, self.origin_mm, spacing, points_ct)


def distance_of(mesh: Mesh) -> DistanceField:
    """Distances to a closed surface, right to a tenth of a millimetre near it."""
    lower, upper = mesh.box_mm
    step = float(np.clip((upper - lower).max() / _STEPS, _FINEST_MM, _COARSEST_MM))
    origin = lower - _REACH * step
    shape = np.ceil((upper - lower) / step).astype(int) + 2 * _REACH + 1
    nodes = origin + step * np.indices(tuple(shape)).reshape(3, -1).T
    distance = surface_distance(mesh, nodes).astype(np.float32)
    near = ((nodes > lower) & (nodes < upper)).all(1)
    inside = np.zeros(len(nodes), bool)
    inside[near] = contains(mesh, nodes[near])
    values = np.where(inside, -distance, distance).reshape(tuple(shape))
    return DistanceField(origin.astype(np.float32), step, values)


@dataclass(frozen=True, eq=False)
class RestShape:
    """The organ at rest (CT frame, LPS mm): ``distances`` has one field per part."""

    anatomy_ct: Anatomy
    body: ElasticBody
    distances: tuple[DistanceField, ...]

    @cached_property
    def long_axis(self) -> Float64[np.ndarray, " 3"]:
        """The organ's longest principal direction, towards its slimmer, farther reaching end."""
        return long_axis_of(self.anatomy_ct.organ)

    def labels_at(
        self, points_ct: Float32[np.ndarray, "n 3"]
    ) -> tuple[UInt8[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
        """Label of each point, and its distance (mm) to the nearest surface that bounds it."""
        labels = np.zeros(len(points_ct), np.uint8)
        far = np.finfo(np.float32).max  # fast math knows no infinity
        margin_mm = np.full(len(points_ct), far, np.float32)

        def mark(part: slice) -> None:
            some = points_ct[part], labels[part], margin_mm[part]
            for label, field in enumerate(self.distances, start=1):
                lattice = field.values_mm, field.origin_mm, np.float32(field.spacing_mm)
                _mark(*lattice, np.uint8(label), *some)

        parallel_for(mark, len(points_ct), _AT_ONCE)
        return labels, margin_mm

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Everything as named arrays, for a file."""
        arrays = {f"{_BODY}{name}": value for name, value in self.body.to_arrays().items()}
        for n, (part, field) in enumerate(zip(self.anatomy_ct.parts, self.distances, strict=True)):
            arrays |= {
                f"{n}.vertices_mm": part.vertices_mm,
                f"{n}.faces": part.faces,
                f"{n}.origin_mm": field.origin_mm,
                f"{n}.spacing_mm": np.array(field.spacing_mm),
                f"{n}.values_mm": field.values_mm,
            }
        return arrays

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], n_parts: int) -> RestShape:
        """The inverse of ``to_arrays``.

        Raises:
            InputError: an array is missing or of a wrong shape.
        """
        try:
            body = {k.removeprefix(_BODY): v for k, v in arrays.items() if k.startswith(_BODY)}
            parts, fields = [], []
            for n in range(n_parts):
                parts.append(Mesh(arrays[f"{n}.vertices_mm"], arrays[f"{n}.faces"]))
                fields.append(
                    DistanceField(
                        np.asarray(arrays[f"{n}.origin_mm"], np.float32),
                        float(arrays[f"{n}.spacing_mm"]),
                        np.ascontiguousarray(arrays[f"{n}.values_mm"], np.float32),
                    )
                )
        except KeyError as error:
            raise InputError(f"the organ's shape lacks {error}; train the model again.") from error
        return cls(Anatomy(tuple(parts)), ElasticBody.from_arrays(body), tuple(fields))


def long_axis_of(organ: Mesh) -> Float64[np.ndarray, " 3"]:
    """The longest principal direction of a surface's vertices, in which their third moment is
    positive: a rule that means the same in every patient, however the CT's axes lie."""
    spread = organ.vertices_mm - organ.vertices_mm.mean(0)
    axis = np.linalg.svd(spread, full_matrices=False)[2][0]
    return axis if ((spread @ axis) ** 3).sum() >= 0 else -axis


def shape_of(anatomy_ct: Anatomy, body: ElasticBody) -> RestShape:
    """The shape of an anatomy with its body; seconds."""
    return RestShape(anatomy_ct, body, tuple(distance_of(part) for part in anatomy_ct.parts))


@numba.njit(cache=True, fastmath=True, nogil=True)
def _mark(values, origin, spacing, label, points, labels, margin):  # type: ignore[no-untyped-def]
    """Give points inside the label, and every point the distance if it is the least so far."""
    for p in range(len(points)):
        distance = distance_at(values, origin, spacing, points[p, 0], points[p, 1], points[p, 2])[0]
        if distance < 0:
            labels[p] = label
        margin[p] = min(margin[p], abs(distance))


@numba.njit(cache=True, fastmath=True, nogil=True)
def _distance(values, origin, spacing, points):  # type: ignore[no-untyped-def]
    n = len(points)
    out, slope = np.empty(n, np.float32), np.empty((n, 3), np.float32)
    for p in range(n):
        out[p], slope[p, 0], slope[p, 1], slope[p, 2] = distance_at(
            values, origin, spacing, points[p, 0], points[p, 1], points[p, 2]
        )
    return out, slope


@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def distance_at(values, origin, spacing, x, y, z):  # type: ignore[no-untyped-def]
    """Distance and its slope along x, y, z at one place (mm), by trilinear interpolation."""
    zero, one, most = np.float32(0), np.float32(1), np.float32(1.001)
    per_cell = one / spacing
    x = min(max((x - origin[0]) * per_cell, zero), np.float32(values.shape[0]) - most)
    y = min(max((y - origin[1]) * per_cell, zero), np.float32(values.shape[1]) - most)
    z = min(max((z - origin[2]) * per_cell, zero), np.float32(values.shape[2]) - most)
    i, j, k = int(x), int(y), int(z)
    a, b, c = np.float32(x - i), np.float32(y - j), np.float32(z - k)
    v000, v001 = values[i, j, k], values[i, j, k + 1]
    v010, v011 = values[i, j + 1, k], values[i, j + 1, k + 1]
    v100, v101 = values[i + 1, j, k], values[i + 1, j, k + 1]
    v110, v111 = values[i + 1, j + 1, k], values[i + 1, j + 1, k + 1]
    l00, l01 = v000 + (v001 - v000) * c, v010 + (v011 - v010) * c
    l10, l11 = v100 + (v101 - v100) * c, v110 + (v111 - v110) * c
    f0, f1 = l00 + (l01 - l00) * b, l10 + (l11 - l10) * b
    by_y = (l01 - l00) * (one - a) + (l11 - l10) * a
    d0 = (v001 - v000) * (one - b) + (v011 - v010) * b
    d1 = (v101 - v100) * (one - b) + (v111 - v110) * b
    by_z = d0 * (one - a) + d1 * a
    return f0 + (f1 - f0) * a, (f1 - f0) * per_cell, by_y * per_cell, by_z * per_cell
