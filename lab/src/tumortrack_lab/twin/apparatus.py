"""The apparatus of the paper's experiment as physics, with one case on it.

Bench frame, mm: z up, towards the camera; the support is the plane z = 0, on which the organ
stands as in its CT; its long axis lies along x, its middle at x = y = 0. Packing between support
and organ fits the underside, as the body's own bed does: on a bare plane an organ that stands on
its pole would first of all collapse, which says nothing of plates and instruments.

The CT shows the organ at rest under its weight in that bed. Only what is added deforms it: loads,
and weight that softened tissue no longer bears.

Nothing here is shared with the deformations that networks are trained on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float64

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, rotation_onto, transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.raster import label_grid
from tumortrack.report.metrics import surface_samples
from tumortrack_lab.tets import TetMesh, embed, tetrahedralise
from tumortrack_lab.twin.contact import Contact, Obstacles, Support
from tumortrack_lab.twin.equilibrium import Convergence, EquilibriumProblem, Hold, settle
from tumortrack_lab.twin.solid import NeoHookeanSolid

GRAVITY_KPA_PER_MM = 9.81e-6  # of 1 kg/m^3


class ApparatusConfig(Config, frozen=True, kw_only=True):
    """Material and apparatus.

    youngs_kpa: of the organ; kidney and soft PVA gels lie near 5..30 kPa.
    tumor_ratio: tumors are stiffer by this factor (2..5).
    poisson, density_kg_m3: nearly incompressible, water-like.
    edge_mm: of the tetrahedra.
    contact_kpa_mm: penalty per depth; pressures of a few kPa sink in by about 0.1 mm.
    packing_kpa_mm: of what bears the underside: fat, foam.
    plate_mm: width of the plate along the organ; rounding_mm: of its edges.
    load_step_mm: the plate advances by this much at a time, the rod by half.
    """

    youngs_kpa: float = 15.0
    tumor_ratio: float = 3.0
    poisson: float = 0.49
    density_kg_m3: float = 1050.0
    edge_mm: float = 5.5
    contact_kpa_mm: float = 300.0
    packing_kpa_mm: float = 3.0
    plate_mm: float = 36.0
    rounding_mm: float = 4.0
    load_step_mm: float = 2.0
    sink_mm: float = 8.0
    poke_mm: float = 10.0
    poke_diameter_mm: float = 8.0

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"bench {name} is {getattr(self, name)}; it must be positive.")
        if not self.poisson <= 0.495:
            raise InputError(f"bench poisson is {self.poisson}; it must be at most 0.495.")


@dataclass(frozen=True, eq=False)
class State:
    """The organ at rest in one state: where the mesh's nodes lie, and what was measured."""

    name: str
    nodes_mm: Float64[np.ndarray, "n 3"]
    report: dict


class Apparatus:
    """The apparatus with one case on it."""

    def __init__(
        self, anatomy_ct: Anatomy, up_lps: tuple[float, float, float], config: ApparatusConfig
    ) -> None:
        self.config = config
        self.bench_from_ct = _bench_from_ct(anatomy_ct.organ, up_lps)
        self.anatomy = moved(anatomy_ct, self.bench_from_ct)
        self.mesh = tetrahedralise(self.anatomy.organ, config.edge_mm)
        ratio = 1 + (config.tumor_ratio - 1) * _tumor_share(self.mesh, self.anatomy)
        shear_kpa = config.youngs_kpa * ratio / (2 * (1 + config.poisson))
        self.solid = NeoHookeanSolid(self.mesh, shear_kpa, config.poisson)
        points_mm, areas_mm2 = _contact_points(self.anatomy.organ)
        self.contact = Contact(embed(self.mesh, points_mm), areas_mm2, config.contact_kpa_mm)
        volumes = self.solid.node_volumes_mm3
        self._weight_mn = config.density_kg_m3 * GRAVITY_KPA_PER_MM * volumes
        under = _faces_down(self.anatomy.organ, points_mm)
        surface = embed(self.mesh, points_mm[under])
        packing = Contact(surface, areas_mm2[under], config.packing_kpa_mm)
        self._packing = packing, (Support(points_mm[under, 2]),)
        self._hold = Hold(self.mesh.nodes_mm, volumes / volumes.sum())

    def carry(
        self, state: State, points_ct: Float[np.ndarray, "m 3"]
    ) -> Float64[np.ndarray, "m 3"]:
        """Points in or on the organ (CT frame) at their place on the bench, mm."""
        points = transform_points(self.bench_from_ct, np.asarray(points_ct, np.float64))
        # The displacement is carried, not the point: D0 is then exact to the last digit.
        return points + embed(self.mesh, points).carry(state.nodes_mm - self.mesh.nodes_mm)

    def settle(
        self, nodes_mm: np.ndarray, obstacles: Obstacles, weight: float = 0.0
    ) -> tuple[np.ndarray, Convergence]:
        """One load step: the nodes at rest in their bed among obstacles, under so many weights
        more than in the CT.

        Raises:
            TumortrackError: no equilibrium was found.
        """
        contacts = ((self.contact, (Support(), *obstacles)), self._packing)
        load_mn = weight * self._weight_mn
        problem = EquilibriumProblem(self.solid, contacts, load_mn, self._hold)
        return settle(problem, nodes_mm)

    def midsection(self, nodes_mm: np.ndarray) -> tuple[float, float]:
        """Lowest and highest z of the surface under the middle half of the plate, mm."""
        z = self.contact.surface.carry(nodes_mm)[self._in_middle, 2]
        return float(z.min()), float(z.max())

    def sides_outwards_mm(self, nodes_mm: np.ndarray) -> tuple[float, float]:
        """How far the midsection's two lateral edges have moved outwards."""
        before = self.contact.surface.carry(self.mesh.nodes_mm)[self._in_middle, 1]
        after = self.contact.surface.carry(nodes_mm)[self._in_middle, 1]
        return float(before.min() - after.min()), float(after.max() - before.max())

    @cached_property
    def _in_middle(self) -> Bool[np.ndarray, " m"]:
        at_rest = self.contact.surface.carry(self.mesh.nodes_mm)
        return np.abs(at_rest[:, 0]) < self.config.plate_mm / 4


def moved(anatomy: Anatomy, b_from_a: Float64[np.ndarray, "4 4"]) -> Anatomy:
    """An anatomy in another frame."""
    return Anatomy(
        tuple(part.moved(transform_points(b_from_a, part.vertices_mm)) for part in anatomy.parts)
    )


def triangles(mesh: Mesh) -> tuple[Float64[np.ndarray, "f 3"], Float64[np.ndarray, "f 3"]]:
    """Each triangle's middle and outward normal, twice its area long."""
    a, b, c = (mesh.vertices_mm[mesh.faces[:, i]] for i in range(3))
    return (a + b + c) / 3, np.cross(b - a, c - a)


def _bench_from_ct(organ_ct: Mesh, up_lps: tuple[float, float, float]) -> np.ndarray:
    upright = rotation_onto(np.array(up_lps), np.array([0.0, 0.0, 1.0]))
    flat = (organ_ct.vertices_mm - organ_ct.vertices_mm.mean(0)) @ upright.T
    x, y = np.linalg.eigh(np.cov(flat[:, :2].T))[1][:, 1]
    rotation = np.array([[x, y, 0], [-y, x, 0], [0, 0, 1]]) @ upright
    box = np.stack([f(organ_ct.vertices_mm @ rotation.T, axis=0) for f in (np.min, np.max)])
    middle = box.mean(0)
    return rigid(rotation, -np.array([middle[0], middle[1], box[0, 2]]))


def _contact_points(
    organ: Mesh, spacing_mm: float = 1.0
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, " m"]]:
    """One point of the surface per cube of this size that it passes, and the area there."""
    points_mm, areas_mm2, _ = surface_samples(organ, spacing_mm)
    cubes = np.floor(points_mm / spacing_mm).astype(int)
    _, first, cube = np.unique(cubes, axis=0, return_index=True, return_inverse=True)
    return points_mm[first], np.bincount(cube.ravel(), areas_mm2)


def _faces_down(
    organ: Mesh, points_mm: Float64[np.ndarray, "m 3"], steepest: float = 1.5
) -> Bool[np.ndarray, " m"]:
    """Which points of the surface lie on its underside, where the slope is at most so much."""
    from scipy.spatial import cKDTree

    middle, normal = triangles(organ)
    down = -normal[:, 2] > np.linalg.norm(normal, axis=1) / np.hypot(1, steepest)
    return np.asarray(down[cKDTree(middle).query(points_mm)[1]])


def _tumor_share(mesh: TetMesh, anatomy: Anatomy) -> Float64[np.ndarray, " t"]:
    """Share of each tetrahedron that lies in a tumor, by a voxel grid of 1 mm."""
    low = np.floor(anatomy.organ.box_mm[0]) - 1
    shape = np.ceil(anatomy.organ.box_mm[1] - low).astype(int) + 2
    labels = label_grid(anatomy, rigid(np.eye(3), low), tuple(shape.tolist()))
    # Fixed points spread over a tetrahedron: corners, edges' middles and centre, pulled inwards.
    spread = np.concatenate(
        [np.eye(4), (np.eye(4)[[0, 0, 0, 1, 1, 2]] + np.eye(4)[[1, 2, 3, 2, 3, 3]]) / 2]
    )
    weights = np.concatenate([0.75 * spread + 0.0625, np.full((1, 4), 0.25)])
    points = np.einsum("pk,tkj->tpj", weights, mesh.nodes_mm[mesh.tets])
    index = np.clip(np.rint(points - low).astype(int), 0, shape - 1)
    return np.asarray((labels[tuple(index.transpose(2, 0, 1))] > 1).mean(1), np.float64)
