"""A linear-elastic finite-element surface fit to the partial cloud.

The family of methods that does best on the Sparse Data Challenge (BCF-FEM, arXiv 2403.09964): the
organ is an elastic body, unknown forces act on its surface, and its deformed surface must pass
through the observed points. Own formulation: the pose is a true rotation, the displacement
relative to it a sum of the body's softest surface modes, and both follow from one small
least-squares problem, iterated with new closest points. Quadratic tetrahedra assembled by
scikit-fem: they do not lock up to Poisson ratios of about 0.49, as linear ones do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import Fit
from tumortrack_lab.peers.pose_search import (
    CROP_PERCENT,
    Direction,
    Points,
    PoseSearch,
    RigidConfig,
    SurfacePoints,
    Transform,
    seen_from,
    tukey,
    turned_about,
)
from tumortrack_lab.tets import TetMesh, factorised, find, tetrahedralise

_RIGID_MODES = 6
# Of the diagonal: the mesh may err by 1 mm, for the organ's own surface is embedded in it.
_ENVELOPE = 7e-3
_STEP_MM = 1.0  # along the surface, for the normals of the deformed one
_BESIDE_MM = 2.0  # spacing: partners lie this far apart along the surface
_SEEN_POINTS = 500  # of the visible surface that look for their place in the cloud
_CONVERGED_MM = 0.05  # a step smaller than this ends the iteration
_FREE = 1e-6  # the pose's precision: as good as none

Amplitudes = Float64[np.ndarray, " modes"]
Step = Float64[np.ndarray, " unknowns"]  # turn and shift (CT frame, about the middle), amplitudes


@dataclass(frozen=True, eq=False)
class PeerElasticBody:
    """An organ's quadratic mesh and its modes, whose surface mean squares are 1 / area."""

    corners_mm: Float64[np.ndarray, "t 4 3"]  # of the tetrahedra
    nodes: Int[np.ndarray, "t 10"]  # four corners, then the edges in scikit-fem's order
    modes: Float64[np.ndarray, "n 3 modes"]  # displacement of every node in every mode
    # Strain energy per squared amplitude, times 2, for a Young's modulus of 1.
    stiffness: Float64[np.ndarray, " modes"]
    area_mm2: float

    def modes_at(self, points_mm: Float[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3 modes"]:
        """Displacement of the given points (undeformed, mm) in every mode."""
        element, shapes = self._shapes(points_mm)
        out = np.zeros((len(points_mm), *self.modes.shape[1:]))
        for column in range(shapes.shape[1]):
            out += shapes[:, column, None, None] * self.modes[self.nodes[element, column]]
        return out

    def displacement(
        self, points_mm: Float[np.ndarray, "m 3"], amplitudes: Float[np.ndarray, " modes"]
    ) -> Float64[np.ndarray, "m 3"]:
        """The modes' displacement of the given points (undeformed, mm)."""
        element, shapes = self._shapes(points_mm)
        moved = self.modes @ amplitudes
        return np.einsum("mk,mkc->mc", shapes, moved[self.nodes[element]])

    def _shapes(
        self, points_mm: Float[np.ndarray, "m 3"]
    ) -> tuple[Int[np.ndarray, " m"], Float64[np.ndarray, "m 10"]]:
        """Each point's element (the nearest for points just outside) and shape functions there."""
        element, weights = find(self.corners_mm, points_mm)
        return element, _quadratic(weights)


def _quadratic(weights: Float64[np.ndarray, "m 4"]) -> Float64[np.ndarray, "m 10"]:
    """Quadratic shape functions of barycentric weights."""
    first, second = np.array([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]).T
    edges = 4 * weights[:, first] * weights[:, second]
    return np.concatenate([weights * (2 * weights - 1), edges], axis=1)


def stiffness_matrix(tets: TetMesh, poisson: float) -> tuple[Any, Any]:
    """The sparse stiffness matrix for a Young's modulus of 1, and scikit-fem's basis over it."""
    from skfem import Basis, ElementTetP2, ElementVector, MeshTet
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = MeshTet(
        np.ascontiguousarray(tets.nodes_mm.T), np.ascontiguousarray(tets.tets.T, dtype=int)
    )
    basis = Basis(mesh, ElementVector(ElementTetP2()), intorder=2)
    return linear_elasticity(*lame_parameters(1.0, poisson)).assemble(basis), basis


def elastic_body(tets: TetMesh, poisson: float, modes: int) -> PeerElasticBody:
    """The body with its softest surface modes, rigid motions left out: solutions of K u = s M u,
    K the stiffness, M the mass of the *surface* (Steklov's problem). Among all fields with a
    given surface displacement they have the least strain energy inside, so a few hundred stand for
    every way in which forces on the surface deform the organ. Raises InputError: more modes than
    the mesh's surface has, or the mesh is in pieces."""
    from scipy.sparse.linalg import LinearOperator, eigsh
    from skfem import BilinearForm, FacetBasis
    from skfem.helpers import dot

    K, basis = stiffness_matrix(tets, poisson)
    facets = FacetBasis(basis.mesh, basis.elem, intorder=4)
    M = BilinearForm(lambda u, v, _: dot(u, v)).assemble(facets)
    if modes + _RIGID_MODES >= len(basis.get_dofs().flatten()):
        raise InputError(f"{modes} modes are more than this mesh's surface has; refine the mesh.")
    # K alone is singular; a shift of the size of the softest mode makes it definite.
    area = float(M.sum() / 3)
    shift = 0.1 / np.sqrt(area)
    inverse = LinearOperator(K.shape, matvec=factorised(K + shift * M), dtype=float)
    start = np.random.default_rng(0).normal(size=K.shape[0])  # else ARPACK's own changes
    values, vectors = eigsh(
        K, k=modes + _RIGID_MODES, M=M, sigma=-shift, OPinv=inverse, v0=start, tol=1e-6
    )
    if values[_RIGID_MODES] < 1e-6 * values[-1]:
        raise InputError("the organ's mesh is in several pieces; one is needed.")
    mesh = basis.mesh
    numbers = np.concatenate([mesh.t, mesh.t2e + mesh.p.shape[1]]).T  # of corners, then of edges
    node_dofs = np.empty((numbers.max() + 1, 3), int)
    for axis in range(3):
        node_dofs[numbers, axis] = basis.element_dofs[axis::3].T
    return PeerElasticBody(
        corners_mm=mesh.p.T[mesh.t.T],
        nodes=numbers,
        modes=vectors[node_dofs][:, :, _RIGID_MODES:],
        stiffness=values[_RIGID_MODES:],
        area_mm2=area,
    )


class ElasticPeerConfig(Config, frozen=True):
    """The weight of strain energy against data is not tuned but stated in mm: among the
    displacements that the energy makes likely (Gaussian, variance inverse to stiffness) the root
    mean square over the surface is ``displacement_mm``; a point lies ``noise_mm`` off the
    surface. Points off by more than ``outlier_mm`` at the end do not count (Tukey)."""

    rigid: RigidConfig = RigidConfig()
    starts: int = 4  # the best rigid poses, each fitted
    edge_mm: float = 12.0
    poisson: float = 0.47
    modes: int = 100
    displacement_mm: float = 3.0
    noise_mm: float = 1.5
    outlier_mm: float = 5.0
    first_outlier_mm: float = 15.0
    iterations: int = 30


class _State(NamedTuple):
    """Where the body lies and how it is deformed: camera = pose (ct + modes @ amplitudes)."""

    camera_from_ct: Transform
    amplitudes: Amplitudes


class _Pairs(NamedTuple):
    """One equation a pair of points."""

    rows: Float64[np.ndarray, "n unknowns"]  # derivative of the distance by a step
    residual_mm: Float64[np.ndarray, " n"]  # distance along the surface normal
    weight: Float64[np.ndarray, " n"]  # Tukey's (0: an outlier)
    share: Float64[np.ndarray, " n"]  # a constant weight


class ElasticPeer:
    """Fits from each of the best rigid poses and keeps the fit of least cost."""

    def __init__(self, anatomy_ct: Anatomy, up_lps: Direction, config: ElasticPeerConfig) -> None:
        self.config = config
        self._search = PoseSearch(anatomy_ct, up_lps, config.rigid)
        mesh = tetrahedralise(anatomy_ct.organ, config.edge_mm, _ENVELOPE)
        self.body = elastic_body(mesh, config.poisson, config.modes)
        self._surface = EmbeddedSurface(self.body, self._search)
        variance = config.displacement_mm**2 * self.body.area_mm2
        self._precision = self.body.stiffness * (1 / self.body.stiffness).sum() / variance

    def fit(self, scene: Scene) -> Fit:
        cloud = scene.cloud.points_mm.astype(float)
        poses = self._search.poses(scene.cloud)[: self.config.starts]
        fits = (self._fit_from(pose.camera_from_ct, cloud) for pose in poses)
        return min(fits, key=lambda fit: fit.report["cost"])

    def _fit_from(self, camera_from_ct: Transform, cloud: Points) -> Fit:
        """The limit beyond which points are outliers shrinks during the iteration."""
        config = self.config
        state = _State(camera_from_ct, np.zeros(len(self._precision)))
        reach = np.geomspace(config.first_outlier_mm, config.outlier_mm, config.iterations // 2)
        for iteration in range(config.iterations):
            last = iteration >= len(reach)
            outlier_mm = config.outlier_mm if last else float(reach[iteration])
            step = self._step(self._pairs(state, cloud, outlier_mm), state.amplitudes)
            moved = state.camera_from_ct @ turned_about(self._surface.middle, step[:6])
            state = _State(moved, state.amplitudes + step[6:])
            if last and self._surface_rms(step[6:]) + np.linalg.norm(step[3:6]) < _CONVERGED_MM:
                break
        return self._candidate(state, cloud, iteration + 1)

    def _candidate(self, state: _State, cloud: Points, iterations: int) -> Fit:
        """Starts are compared by the cost (data, Tukey's, and strain energy); the residual is the
        root mean square distance of the points that count."""

        def carry(points_ct: np.ndarray) -> np.ndarray:
            moved = points_ct + self.body.displacement(points_ct, state.amplitudes)
            return transform_points(state.camera_from_ct, moved)

        pairs = self._pairs(state, cloud, self.config.outlier_mm)
        data = (self.config.outlier_mm / self.config.noise_mm) ** 2 / 6
        cost = data * (pairs.share @ (1 - pairs.weight**1.5))
        cost += self._precision @ state.amplitudes**2 / 2
        kept = pairs.weight > 0
        residual = np.sqrt((pairs.residual_mm[kept] ** 2).mean()) if kept.any() else np.inf
        report = {
            "iterations": iterations,
            "cost": float(cost),
            "residual_mm": float(residual),
            "displacement_mm": self._surface_rms(state.amplitudes),
        }
        return Fit(carry, report)

    def _pairs(self, state: _State, points: Points, outlier_mm: float) -> _Pairs:
        """Cloud points and the surface points nearest to them; then the other way round, for the
        surface that the camera should see: the cloud's rim says where the organ ends."""
        ct_from_camera = np.linalg.inv(state.camera_from_ct)
        placed, eye_ct = transform_points(ct_from_camera, points), ct_from_camera[:3, 3]
        shape = self._surface.shape(state.amplitudes)
        toward = np.flatnonzero(shape.faces(eye_ct))
        index = toward[cKDTree(shape.points_mm[toward]).query(placed)[1]]
        deepest = np.percentile(points[:, 2], CROP_PERCENT)
        visible = self._surface.seen(shape, state.camera_from_ct, deepest)
        nearest = cKDTree(placed).query(shape.points_mm[visible])[1]
        index = np.concatenate([index, visible])
        partner = np.concatenate([placed, placed[nearest]])
        apart, normal = partner - shape.points_mm[index], shape.normals[index]
        residual = np.einsum("ij,ij->i", normal, apart)
        # Partners beside the surface's end have no place on it: their distance counts too.
        off = np.maximum(np.abs(residual), np.linalg.norm(apart, axis=1) - _BESIDE_MM)
        ratio = len(placed) / max(len(visible), 1)  # both ways weigh the same
        alike = np.full(len(visible), ratio)
        turn = np.cross(shape.points_mm[index] - self._surface.middle, normal)
        bend = np.einsum("ij,ijk->ik", normal, self._surface.modes[index])
        rows = np.concatenate([turn, normal, bend], axis=1)
        share = np.concatenate([np.ones(len(placed)), alike])
        return _Pairs(rows, residual, tukey(off, outlier_mm), share)

    def _step(self, pairs: _Pairs, amplitudes: Amplitudes) -> Step:
        """One Gauss-Newton step."""
        precision = np.concatenate([np.full(6, _FREE), self._precision])
        pull = np.concatenate([np.zeros(6), self._precision * amplitudes])
        scaled = pairs.rows * (pairs.weight * pairs.share / self.config.noise_mm**2)[:, None]
        system = scaled.T @ pairs.rows + np.diag(precision)
        return cho_solve(cho_factor(system), scaled.T @ pairs.residual_mm - pull)

    def _surface_rms(self, amplitudes: Amplitudes) -> float:
        return float(np.sqrt(amplitudes @ amplitudes / self.body.area_mm2))


class EmbeddedSurface:
    """Points of the organ's fine surface that move with the body's modes, and their normals."""

    def __init__(self, body: PeerElasticBody, search: PoseSearch) -> None:
        rest = search.surface
        self._rest, self._visibility = rest, search.visibility
        self.middle = rest.points_mm.mean(0)
        self.modes = body.modes_at(rest.points_mm)
        # Two short steps along the surface show how its normal turns with the modes.
        helper = np.eye(3)[np.abs(rest.normals).argmin(1)]
        first = np.cross(rest.normals, helper)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        self._tangents = (first, np.cross(rest.normals, first))
        self._slopes = tuple(
            (body.modes_at(rest.points_mm + _STEP_MM * along) - self.modes) / _STEP_MM
            for along in self._tangents
        )

    def shape(self, amplitudes: Amplitudes) -> SurfacePoints:
        """The deformed surface, CT frame."""
        pairs = zip(self._tangents, self._slopes, strict=True)
        first, second = (along + slope @ amplitudes for along, slope in pairs)
        normal = np.cross(first, second)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return SurfacePoints(self._rest.points_mm + self.modes @ amplitudes, normal)

    def seen(
        self, shape: SurfacePoints, camera_from_ct: Transform, deepest_mm: float
    ) -> Int[np.ndarray, " m"]:
        """Some of the points that the camera should see above a depth, evenly spread; occlusion is
        that of the undeformed organ, orientation that of the deformed one."""
        visible = seen_from(self._visibility, self._rest, camera_from_ct)
        visible &= shape.faces(np.linalg.inv(camera_from_ct)[:3, 3])
        axis = camera_from_ct[2]
        index = np.flatnonzero(visible & (shape.points_mm @ axis[:3] + axis[3] < deepest_mm))
        return index[:: max(1, len(index) // _SEEN_POINTS)]
