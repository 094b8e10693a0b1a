"""The organ at rest: surfaces, signed distances to them, elastic body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import signed_distances
from tumortrack.core.organ import KIDNEY, Organ, check_name
from tumortrack.core.process import parallel_for
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.registration.kernels import DistanceField, mark
from tumortrack.registration.model_error import ModelError
from tumortrack.simulate.elastic.body import ElasticBody

_STEPS = 40  # of a distance field, along the part's longest side
_FINEST_MM, _COARSEST_MM = 0.5, 2.0
_REACH = 10  # steps around a part; farther out the distance is that of the nearest border
_AT_ONCE = 4096  # points per thread
_BODY, _STRUCTURE, _VERTICES = "body.", "structure.", "vertices_mm"


def distance_of(mesh: Mesh) -> DistanceField:
    """Distances to a closed surface, right to 0.1 mm near it."""
    lower, upper = mesh.box_mm
    step = float(np.clip((upper - lower).max() / _STEPS, _FINEST_MM, _COARSEST_MM))
    origin = lower - _REACH * step
    shape = np.ceil((upper - lower) / step).astype(int) + 2 * _REACH + 1
    values = signed_distances(mesh, origin, step, tuple(shape.tolist()))
    return DistanceField(values, origin.astype(np.float32), step)


_kept_distance_of = lru_cache(maxsize=32)(distance_of)  # of structures, which few touch


@dataclass(frozen=True, eq=False)
class RestShape:
    """The organ at rest (CT frame, LPS mm): ``distances`` has one field per part."""

    anatomy_ct: Anatomy
    body: ElasticBody
    distances: tuple[DistanceField, ...]

    @cached_property
    def compliant(self) -> RestShape:
        """The same organ with the body's compliance among its modes."""
        return replace(self, body=self.body.compliant)

    @cached_property
    def model_error(self) -> ModelError:
        """Of the organ's surface."""
        return ModelError.of(self.anatomy_ct.organ)

    @cached_property
    def long_axis_mm(self) -> Float64[np.ndarray, " 3"]:
        """The organ's longest principal direction, as long as the organ."""
        return long_axis_mm(self.anatomy_ct.organ)

    @cached_property
    def middles_ct(self) -> Float64[np.ndarray, "parts 3"]:
        """Of each part's box."""
        return np.array([part.box_mm.mean(0) for part in self.anatomy_ct.parts])

    def field(self, surface: int) -> DistanceField:
        """Distances to a part, or to a structure: by its number in ``Anatomy.closed``."""
        if surface < len(self.distances):
            return self.distances[surface]
        return _kept_distance_of(list(self.anatomy_ct.closed.values())[surface])

    def labels_at(
        self, points_ct: Float32[np.ndarray, "n 3"]
    ) -> tuple[UInt8[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
        """Label of each point, and its distance (mm) to the nearest surface that bounds it."""
        labels = np.zeros(len(points_ct), np.uint8)
        margin_mm = np.full(len(points_ct), np.finfo(np.float32).max, np.float32)

        def mark_part(part: slice) -> None:
            for label, field in enumerate(self.distances, start=1):
                mark(field, label, points_ct[part], labels[part], margin_mm[part])

        parallel_for(mark_part, len(points_ct), _AT_ONCE)
        return labels, margin_mm

    def distances_mm(self, points_ct: Float64[np.ndarray, "n 3"], surface: int) -> np.ndarray:
        """Of points to a surface (see ``field``), negative inside; right near it."""
        points, inside = points_ct.astype(np.float32), np.zeros(len(points_ct), np.uint8)
        away_mm = np.full(len(points), np.finfo(np.float32).max, np.float32)
        mark(self.field(surface), 1, points, inside, away_mm)
        return np.where(inside, -away_mm, away_mm).astype(float)

    def to_arrays(self) -> dict[str, np.ndarray]:
        arrays = {f"{_BODY}{name}": value for name, value in self.body.to_arrays().items()}
        for n, (part, field) in enumerate(zip(self.anatomy_ct.parts, self.distances, strict=True)):
            named = {"vertices_mm": part.vertices_mm, "faces": part.faces, **field._asdict()}
            arrays |= {f"{n}.{name}": np.asarray(value) for name, value in named.items()}
        for name, mesh in self.anatomy_ct.structures.items():
            arrays[f"{_STRUCTURE}{name}.{_VERTICES}"] = mesh.vertices_mm
            arrays[f"{_STRUCTURE}{name}.faces"] = mesh.faces
        return arrays

    @classmethod
    def from_arrays(
        cls, arrays: dict[str, np.ndarray], n_parts: int, kind: Organ = KIDNEY
    ) -> RestShape:
        """The inverse of ``to_arrays``; InputError for an array that is missing or misshapen."""
        try:
            body = {k.removeprefix(_BODY): v for k, v in arrays.items() if k.startswith(_BODY)}
            parts, fields = [], []
            for n in range(n_parts):
                part = (
                    arrays[f"{n}.{name}"]
                    for name in ("vertices_mm", "faces", *DistanceField._fields)
                )
                vertices, faces, values, origin, spacing = part
                parts.append(Mesh(vertices, faces))
                values = np.ascontiguousarray(values, np.float32)
                if values.ndim != 3 or min(values.shape) < 2 or not np.isfinite(values).all():
                    raise InputError(
                        f"the organ's distances {values.shape} are no lattice of finite numbers, "
                        "two at least along each axis; make the model again."
                    )
                fields.append(DistanceField(values, np.asarray(origin, np.float32), float(spacing)))
            ends = f".{_VERTICES}"
            structures = {}
            for key in arrays:
                if key.startswith(_STRUCTURE) and key.endswith(ends):
                    name = key.removeprefix(_STRUCTURE).removesuffix(ends)
                    check_name(name, "a structure", "--structure")
                    faces = arrays[f"{_STRUCTURE}{name}.faces"]
                    structures[name] = Mesh(arrays[key], faces)
        except KeyError as error:
            raise InputError(f"the organ's shape lacks {error}; make the model again.") from error
        anatomy_ct = Anatomy(tuple(parts), kind, structures)
        return cls(anatomy_ct, ElasticBody.from_arrays(body), tuple(fields))


def long_axis_mm(organ: Mesh) -> Float64[np.ndarray, " 3"]:
    """The longest principal direction of a surface's vertices, as long as the organ; either way."""
    spread = organ.vertices_mm - organ.vertices_mm.mean(0)
    axis = np.linalg.svd(spread, full_matrices=False)[2][0]
    return axis * np.ptp(spread @ axis)


def distances_of(anatomy_ct: Anatomy) -> tuple[DistanceField, ...]:
    """One field per part; a second or two."""
    return tuple(map(distance_of, anatomy_ct.parts))
