"""The organ at rest: surfaces, signed distances to them, elastic body, and how its surface errs.

Noise belongs to single points. The surface that they are compared with errs too, by segmentation
and by what the elastic body is not: by a field correlated over centimetres, which points, touches
and outlines share. It is marginalised: of a smooth misfit so much may be the model's. Source: model
discrepancy as a Gaussian process, Kennedy and O'Hagan 2001 (doi 10.1111/1467-9868.00294).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import triangles_of
from tumortrack.core.mesh_kernels import farthest
from tumortrack.core.mesh_query import signed_distances
from tumortrack.core.organ import KIDNEY, Organ, check_name
from tumortrack.core.process import parallel_for
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.native import F32, U8, kernel
from tumortrack.organ.body import ElasticBody

_STEPS = 40  # of a distance field, along the part's longest side
_FINEST_MM, _COARSEST_MM = 0.5, 2.0
_REACH = 10  # steps around a part; farther out the distance is that of the nearest border
_AT_ONCE = 4096  # points per thread
_BODY, _STRUCTURE, _VERTICES = "body.", "structure.", "vertices_mm"
# Two readers' kidneys differ by 0.5 mm rms, correlated over centimetres (KiTS23).
_ERROR_MM, _LENGTH_MM = 0.5, 20.0
_APART = 0.85  # lengths between neighbouring nodes, at most
_MOST_NODES = 256  # of a large organ: they then lie farther apart
FLAP_MODES = 6
_RIDGE = 1e-3  # of the variance: keeps the correlations invertible


class DistanceField(NamedTuple):
    """Signed distances (mm, negative inside) to one closed surface on a lattice of the CT frame."""

    values_mm: Float32[np.ndarray, "i j k"]
    origin_mm: Float32[np.ndarray, " 3"]
    spacing_mm: float


DISTANCES = (F32["x", "y", "z"].any_value, F32[3], float)  # finite, and too large to look each time
# Gives points inside a label, and lowers each point's margin to its distance from the surface.
_mark = kernel("mark", DISTANCES, int, F32["n", 3], U8["n"].out, F32["n"].out)


def distance_of(mesh: Mesh) -> DistanceField:
    """Distances to a closed surface, right to 0.1 mm near it."""
    lower, upper = mesh.box_mm
    step = float(np.clip((upper - lower).max() / _STEPS, _FINEST_MM, _COARSEST_MM))
    origin = lower - _REACH * step
    shape = np.ceil((upper - lower) / step).astype(int) + 2 * _REACH + 1
    values = signed_distances(mesh, origin, step, tuple(shape.tolist()))
    return DistanceField(values, origin.astype(np.float32), step)


_kept_distance_of = lru_cache(maxsize=32)(distance_of)  # of structures, which few touch


def distances_of(anatomy_ct: Anatomy) -> tuple[DistanceField, ...]:
    """One field per part; a second or two."""
    return tuple(map(distance_of, anatomy_ct.parts))


def long_axis_mm(organ: Mesh) -> Float64[np.ndarray, " 3"]:
    """The longest principal direction of a surface's vertices, as long as the organ; either way."""
    spread = organ.vertices_mm - organ.vertices_mm.mean(0)
    axis = np.linalg.svd(spread, full_matrices=False)[2][0]
    return axis * np.ptp(spread @ axis)


@dataclass(frozen=True, eq=False)
class ModelError:
    """Nodes on an organ's surface (CT, mm) of the field by which it errs, and the precision of
    their values."""

    nodes_ct: Float64[np.ndarray, "k 3"]
    precision: Float64[np.ndarray, "k k"]

    @classmethod
    def from_organ(cls, organ: Mesh) -> ModelError:
        """Of an organ in the CT."""
        area_mm2 = np.linalg.norm(triangles_of(organ.vertices_mm, organ.faces)[1], axis=1).sum() / 2
        count = int(area_mm2 / (_APART * _LENGTH_MM) ** 2) + 1
        vertices = organ.vertices_mm
        chosen = np.empty((1, min(count, _MOST_NODES, len(vertices))), np.int64)
        farthest(np.ascontiguousarray(vertices.T[None], np.float32), np.zeros(1, np.int64), chosen)
        nodes_ct = vertices[chosen[0]]
        ridge = _RIDGE * _ERROR_MM**2 * np.eye(len(nodes_ct))
        return cls(nodes_ct, np.linalg.inv(error_covariance_mm2(nodes_ct) + ridge))

    def nearest(self, points_ct: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
        """The number of the node that each point has its error of."""
        nodes = self.nodes_ct
        return ((nodes**2).sum(1) / 2 - points_ct @ nodes.T).argmin(1)

    def equations(
        self,
        node: Int64[np.ndarray, " n"],
        rows: Float[np.ndarray, "n q"],
        weights: Float64[np.ndarray, " n"],
        scale: float = 1.0,
    ) -> tuple[Float64[np.ndarray, "k k"], Float64[np.ndarray, "k q"]]:
        """Of the field, if it is so many times as large, in a Gauss-Newton step: its own curvature,
        and that with ``rows``, each of the node that errs with it."""
        count = len(self.nodes_ct)
        order = np.argsort(node, kind="stable")
        used, first = np.unique(node[order], return_index=True)
        across = np.zeros((count, rows.shape[1]))
        across[used] = np.add.reduceat((rows * weights[:, None])[order], first)
        own = self.precision / scale**2 + np.diag(np.bincount(node, weights, count))
        return own, across


def error_covariance_mm2(points_ct: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n n"]:
    """Of the model's error at points on the surface."""
    squares = ((points_ct[:, None] - points_ct[None]) ** 2).sum(2)
    return _ERROR_MM**2 * np.exp(-squares / (2 * _LENGTH_MM**2))


class Flap(NamedTuple):
    """Of an organ that was cut (CT, mm): places all over it, and of its surface with their normals,
    as long as the areas that they stand for."""

    cells_ct: Float64[np.ndarray, "k 3"]
    surface_ct: Float64[np.ndarray, "s 3"]
    normals_mm2: Float64[np.ndarray, "s 3"]


@dataclass(frozen=True, eq=False)
class CutOrgan:
    """What was cut (``registration.flap``): places of it in the CT, mm, and how wide; the flaps, by
    their tumors' names; the organ before."""

    points_ct: Float64[np.ndarray, "n 3"]
    kerf_mm: float
    flaps: dict[str, Flap]
    intact: RestShape

    @cached_property
    def places(self) -> cKDTree:
        """Of the cut."""
        return cKDTree(self.points_ct)

    @cached_property
    def cells(self) -> cKDTree:
        """Of all flaps."""
        return cKDTree(np.concatenate([flap.cells_ct for flap in self.flaps.values()]))


@dataclass(frozen=True, eq=False)
class RestShape:
    """The organ at rest (CT frame, LPS mm): ``distances`` has one field per part."""

    anatomy_ct: Anatomy
    body: ElasticBody
    distances: tuple[DistanceField, ...]
    cut: CutOrgan | None = None

    @property
    def flap_modes(self) -> int:
        """How many of the body's modes, the last ones, are flaps'."""
        return 0 if self.cut is None else FLAP_MODES * len(self.cut.flaps)

    @cached_property
    def compliant(self) -> RestShape:
        """The same organ with the body's compliance among its modes."""
        return replace(self, body=self.body.compliant)

    @cached_property
    def model_error(self) -> ModelError:
        """Of the organ's surface."""
        return ModelError.from_organ(self.anatomy_ct.organ)

    @cached_property
    def long_axis_mm(self) -> Float64[np.ndarray, " 3"]:
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
                _mark(field, label, points_ct[part], labels[part], margin_mm[part])

        parallel_for(mark_part, len(points_ct), _AT_ONCE)
        return labels, margin_mm

    def distances_mm(self, points_ct: Float64[np.ndarray, "n 3"], surface: int) -> np.ndarray:
        """Of points to a surface (see ``field``), negative inside; right near it."""
        points, inside = points_ct.astype(np.float32), np.zeros(len(points_ct), np.uint8)
        away_mm = np.full(len(points), np.finfo(np.float32).max, np.float32)
        _mark(self.field(surface), 1, points, inside, away_mm)
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
        cls, arrays: dict[str, np.ndarray], n_parts: int, organ_kind: Organ = KIDNEY
    ) -> RestShape:
        """The inverse of ``to_arrays``; InputError for an array that is missing or misshapen."""
        parts, fields, structures = [], [], {}
        try:
            for n in range(n_parts):
                parts.append(Mesh(arrays[f"{n}.{_VERTICES}"], arrays[f"{n}.faces"]))
                given = [arrays[f"{n}.{name}"] for name in DistanceField._fields]
                values = np.ascontiguousarray(given[0], np.float32)
                if values.ndim != 3 or min(values.shape) < 2 or not np.isfinite(values).all():
                    raise InputError(
                        f"the organ's distances {values.shape} are no lattice of finite numbers, "
                        "two at least along each axis; make the model again."
                    )
                origin = np.asarray(given[1], np.float32)
                fields.append(DistanceField(values, origin, float(given[2])))
            for key in arrays:
                if key.startswith(_STRUCTURE) and key.endswith(f".{_VERTICES}"):
                    name = key.removeprefix(_STRUCTURE).removesuffix(f".{_VERTICES}")
                    check_name(name, "a structure", "--structure")
                    structures[name] = Mesh(arrays[key], arrays[f"{_STRUCTURE}{name}.faces"])
        except KeyError as error:
            raise InputError(f"the organ's shape lacks {error}; make the model again.") from error
        of_body = {k.removeprefix(_BODY): v for k, v in arrays.items() if k.startswith(_BODY)}
        anatomy_ct = Anatomy(tuple(parts), organ_kind, structures)
        return cls(anatomy_ct, ElasticBody.from_arrays(of_body), tuple(fields))
