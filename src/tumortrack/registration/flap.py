"""An organ that is being cut: what an electrode has parted, and the flap that it leaves.

A cut has three effects. The organ's surface gets walls (``_grooved``); cells that it crosses no
longer hold (``_softened``); and what lies on the tumor's side of it, the flap, moves in a way that
no state of the library knows. So six modes stand beside the library's: how the softened body
follows three forces on the flap and three torques about its middle. Their prior is what a flap's
loads do to it: a little, as long as it is held all round, and more the less holds it.

Cuts that are moved with meshes: Paulus et al. 2015 (doi 10.1007/s11548-015-1192-4); reduced modes
of soft joints are this project's own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import ndimage
from scipy.spatial import cKDTree

from tumortrack.case.surface import largest_shell
from tumortrack.core.cloud import FEWEST_POINTS
from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Cut
from tumortrack.core.geometry import triangles_of
from tumortrack.core.report import CutReport
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Mesh
from tumortrack.organ.body import ElasticBody
from tumortrack.organ.finite import CONTRAST, BlockCholesky, ElementLattice, LatticeSolid
from tumortrack.organ.modes import RigidMotions, compliance_modes, patches_of
from tumortrack.organ.rest_shape import FLAP_MODES, CutOrgan, DistanceField, Flap, RestShape
from tumortrack.registration.compliance import RefinedFit
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import FARTHEST, RegistrationResult, refine
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.registration.search import far_from

_APART_MM = 1.5  # between places of a cut that are kept
_NEIGHBOURS = 10  # of a place of the cut, through which its plane is laid
# A cell is cut by at least this share of the places that a plane across it would hold: a corner
# that a stray place touches does not count.
_CROSSED = 0.12
_CUT, _OPEN = 1e-3, 1e-4  # stiffness of cut cells, and of empty ones beside them, of what was there
_PATCHES, _FORCED = 600, 80  # as of the intact body's, and half of its places of forces: sooner
_STEP_MM, _RIM_MM = 1.0, 2.0  # of the field with the groove; how far round a kerf it changes
_NEAR_STEPS = 1.5  # from the last place of a cut, in its places' distances, it ends
# What a flap bears, mN, each axis: its weight or a cup's pull; and how stiff tissue is, kPa. Both
# are presumed (kidneys have 5 to 30 kPa): they decide how much has to be cut before a flap moves.
_LOAD_MN, _TISSUE_KPA = 2000.0, 15.0
_MOST_MM = 8.0  # of a flap's motion, one deviation, however little holds it
_SURFACE = 500  # places of a flap's surface by which it is judged how much of it is seen
_SEEN_MM = 4.0  # of a point: there a surface is seen
_BESIDE_MM = 10.0  # of a cut: there its flap and its bed are seen
_MINE = 0.2  # of a cut's places that are nearest to a tumor: less was not cut for it
_RESTS, _REST_STEPS = 3, 8  # of places of the rest from which fits start; of the way there
_LIFTED_MM = 12.0  # from where a flap was: points so near may be its
_STARTED = 1.5  # deviations of a flap's motion, from which fits start


def cut_shape(shape: RestShape, cuts: Sequence[Cut], poisson: float) -> RestShape:
    """The organ with all that was cut of it, and of what ``shape`` is. ``cuts``: points of the CT;
    ``poisson``: Poisson's ratio of its tissue. A second. Raises InputError: a cut has no points of
    the CT, or all of them lie off the organ."""
    shape = shape if shape.cut is None else shape.cut.intact
    if any(not cut.points_ct for cut in cuts):
        raise InputError("a cut's places must be carried to the CT first, by where the organ was.")
    points_ct = np.concatenate([np.array(cut.points_ct) for cut in cuts])
    points_ct = _thinned(points_ct[shape.distances_mm(points_ct, 0) < _STEP_MM])
    if not len(points_ct):
        raise InputError("all that was cut lies off the organ: is it in the CT's frame (LPS, mm)?")
    body, lattice = shape.body, lattice_of(shape.body)
    solid = LatticeSolid(shape.anatomy_ct, lattice, poisson)
    crossed = crossed_cells(solid, points_ct)
    factor = solid.factor_of(_softened(solid, crossed))
    flaps = dict(_flaps(shape, solid, crossed, points_ct))
    modes, states = list[np.ndarray](), list[np.ndarray]()
    for flap in flaps.values():
        mine, covariance = _modes_of(solid, factor, flap)
        modes.append(solid.spread(mine).astype(np.float32))
        states.append(covariance)
    kerf_mm = max(cut.kerf_mm for cut in cuts)
    kerf = _kerf(shape.distances[0], points_ct, kerf_mm)
    field, organ = _grooved(shape.distances[0], kerf), _without(shape.anatomy_ct.organ, kerf)
    patches = patches_of(shape.anatomy_ct.organ, _PATCHES, np.random.default_rng(0))
    assert body.compliance is not None
    compliance = compliance_modes(solid, patches, body.compliance.shape[-1], factor, _FORCED)
    new = replace(
        body,
        modes=np.concatenate([body.modes, *modes], axis=-1),
        states=_with_uncorrelated(body.states, states),
        compliance=solid.spread(compliance).astype(np.float32),
    )
    anatomy = replace(shape.anatomy_ct, parts=(organ, *shape.anatomy_ct.tumors))
    distances = (field, *shape.distances[1:])
    middles = lattice.origin_mm + lattice.spacing_mm * (solid.cells + 0.5)
    of_flaps = {n: _flap(middles[flap], organ, lattice.spacing_mm) for n, flap in flaps.items()}
    return RestShape(anatomy, new, distances, CutOrgan(points_ct, kerf_mm, of_flaps, shape))


def _flap(cells_ct: Float64[np.ndarray, "k 3"], organ: Mesh, spacing_mm: float) -> Flap:
    middles, normals = triangles_of(organ.vertices_mm, organ.faces)
    mine = cKDTree(cells_ct).query(middles, distance_upper_bound=spacing_mm)[0] < np.inf
    some = np.flatnonzero(mine)[:: max(1, int(mine.sum()) // _SURFACE)]
    return Flap(cells_ct, middles[some], normals[some])


def carried_over(motion: ElasticMotion, shape: RestShape) -> ElasticMotion:
    """A motion of the same organ, of which less or more was cut: its flaps stay where they were."""
    coefficients, of_flaps = np.zeros(shape.body.modes.shape[-1]), _flaps_of(motion.shape)
    library = motion.shape.body.modes.shape[-1] - motion.shape.flap_modes
    coefficients[:library] = motion.coefficients[:library]
    for name, flap in _flaps_of(shape).items():
        if name in of_flaps:
            coefficients[flap] = motion.coefficients[of_flaps[name]]
    others = tuple((carried_over(other, shape), share) for other, share in motion.alternatives)
    return replace(
        motion, shape=shape, coefficients=coefficients, covariance=None, alternatives=others
    )


def _flaps_of(shape: RestShape) -> dict[str, slice]:
    """Which coefficients are each flap's."""
    if shape.cut is None:
        return {}
    first = shape.body.modes.shape[-1] - shape.flap_modes
    return {
        name: slice(first + FLAP_MODES * number, first + FLAP_MODES * (number + 1))
        for number, name in enumerate(shape.cut.flaps)
    }


def flap_starts(
    views: MultiViewCloud, starts: Sequence[ElasticMotion], config: GaussNewtonConfig
) -> list[ElasticMotion]:
    """Where fits of an organ that was cut start, beside ``starts``: those are of an organ in one
    piece, and lie between a lifted flap and its rest. First the rest is fitted to the points beside
    the flap; from there with each flap shifted and turned both ways along each axis of its
    prior."""
    rests, few = list[RegistrationResult](), msgspec.structs.replace(config, steps=_REST_STEPS)
    for start in starts:
        if (cut := start.shape.cut) is None or not cut.flaps:
            return []
        rest = np.flatnonzero(_away_of_flaps_mm(start, views.points_mm) == np.inf)
        if len(rest) < FEWEST_POINTS:
            continue
        some = replace(views, points_mm=views.points_mm[rest], view=views.view[rest])
        rests.append(refine(start.shape, some, start, few))
    found = list[ElasticMotion]()
    for fit in sorted(rests, key=lambda fit: fit.cost):
        motion = replace(fit.motion, covariance=None)
        if len(found) < _RESTS and far_from(motion, found):
            found.append(motion)
    return [moved for motion in found for moved in (motion, *with_flaps_moved(motion))]


def with_points_of_flaps(motion: ElasticMotion, views: MultiViewCloud) -> MultiViewCloud:
    """With those of the candidates that lie so near to where flaps would be that they may be
    theirs; the views themselves, if there are none."""
    cut, candidates_mm = motion.shape.cut, views.candidates_mm
    if cut is None or not cut.flaps or candidates_mm is None or not len(candidates_mm):
        return views
    near = np.isfinite(_away_of_flaps_mm(motion, candidates_mm))
    if not near.any():
        return views
    points_mm = np.concatenate([views.points_mm, candidates_mm[near]])
    view = np.append(views.view, np.zeros(int(near.sum()), int))
    return replace(views, points_mm=points_mm, view=view, candidates_mm=candidates_mm[~near])


def _away_of_flaps_mm(
    motion: ElasticMotion, points_mm: Float[np.ndarray, "n 3"]
) -> Float64[np.ndarray, " n"]:
    """How far points (camera frame) lie from where flaps were; infinite where they cannot be
    theirs."""
    assert motion.shape.cut is not None
    points_ct = motion.inverse(points_mm)
    return motion.shape.cut.cells.query(points_ct, distance_upper_bound=_LIFTED_MM)[0]


def with_flaps_moved(motion: ElasticMotion) -> Iterator[ElasticMotion]:
    """With each flap moved both ways along each axis of its prior, from where it is."""
    for flap in _flaps_of(motion.shape).values():
        squares, axes = np.linalg.eigh(motion.shape.body.covariance[flap, flap])
        ways = _STARTED * (axes * np.sqrt(squares)).T
        for way in (*ways, *-ways):
            coefficients = motion.coefficients.copy()
            coefficients[flap] += way
            yield replace(motion, coefficients=coefficients)


def lattice_of(body: ElasticBody) -> ElementLattice:
    return ElementLattice(body.origin_mm.astype(float), body.spacing_mm, body.modes.shape[:3])


def _thinned(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "m 3"]:
    """The mean of the points in each cube: an electrode passes most places often."""
    cubes = np.floor(points / _APART_MM).astype(int)
    _, cube, counts = np.unique(cubes, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(cube.ravel(), axis) for axis in points.T], axis=1)
    return np.asarray(sums / counts[:, None])


def crossed_cells(
    solid: LatticeSolid, points_ct: Float64[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " c"]:
    """Which cells are cut: by how densely places lie in them, against how densely they lie."""
    h, lattice = solid.lattice.spacing_mm, solid.lattice
    count = min(_NEIGHBOURS, len(points_ct))
    reach = cKDTree(points_ct).query(points_ct, count)[0].reshape(len(points_ct), -1)[:, -1]
    per_mm2 = count / (np.pi * np.maximum(reach, _APART_MM) ** 2)
    place = np.floor((points_ct - lattice.origin_mm) / h).astype(int)
    inside = ((place >= 0) & (place < lattice.cells)).all(1)
    cell = np.ravel_multi_index(tuple(place[inside].T), lattice.cells)
    size = int(np.prod(lattice.cells))
    counts, density = np.bincount(cell, None, size), np.bincount(cell, per_mm2[inside], size)
    needed = _CROSSED * h**2 * density / np.maximum(counts, 1)
    mine = np.ravel_multi_index(tuple(solid.cells.T), lattice.cells)
    return np.asarray((counts > 0) & (counts >= needed))[mine]


def _softened(solid: LatticeSolid, crossed: Bool[np.ndarray, " c"]) -> Float64[np.ndarray, " c"]:
    moduli = solid.moduli(CONTRAST)
    cut = np.zeros(solid.lattice.cells, bool)
    cut[tuple(solid.cells[crossed].T)] = True
    beside = ndimage.binary_dilation(cut, np.ones((3, 3, 3)))[tuple(solid.cells.T)]
    moduli[beside & (solid.organ == 0)] = _OPEN
    moduli[crossed] *= _CUT
    return moduli


def _flaps(
    shape: RestShape,
    solid: LatticeSolid,
    crossed: Bool[np.ndarray, " c"],
    points_ct: Float64[np.ndarray, "n 3"],
) -> Iterator[tuple[str, Bool[np.ndarray, " c"]]]:
    """Of each tumor that was cut round, its name and the cells on its side of the cut: those that
    lie nearer to it than the place of the cut that is nearest to them, and hang together with
    it."""
    lattice = solid.lattice
    middles = np.ascontiguousarray(lattice.origin_mm + lattice.spacing_mm * (solid.cells + 0.5))
    nearest = cKDTree(points_ct).query(middles)[1]
    tumors = shape.anatomy_ct.tumors
    away_mm = [cKDTree(part.vertices_mm).query(points_ct)[0] for part in tumors]
    owner = np.argmin(away_mm, axis=0) if tumors else np.zeros(0, int)
    for number in np.flatnonzero(np.bincount(owner) >= _MINE * len(owner)).tolist():
        off_mm = cKDTree(tumors[number].vertices_mm).query(middles)[0]
        off_mm[shape.distances_mm(middles, number + 1) < 0] = 0.0
        inside = (solid.organ > 0) & ~crossed & (off_mm < away_mm[number][nearest])
        grid = np.zeros(lattice.cells, bool)
        grid[tuple(solid.cells[inside].T)] = True
        piece = ndimage.label(grid)[0][tuple(solid.cells.T)]
        sizes = np.bincount(piece, off_mm < lattice.spacing_mm)  # of what is the tumor's
        sizes[0] = 0
        if sizes.max() > 0:
            yield shape.anatomy_ct.names[number + 1], piece == int(sizes.argmax())


def _modes_of(
    solid: LatticeSolid, factor: BlockCholesky, flap: Bool[np.ndarray, " c"]
) -> tuple[Float64[np.ndarray, "f 6"], Float64[np.ndarray, "6 6"]]:
    """Modes that move the flap's mean by 1 mm along an axis, or turn it by 1 mm at its radius of
    gyration, and their coefficients' covariance."""
    volume = np.repeat((solid.organ * flap)[:, None] / 8, 8, axis=1)
    nodes = solid.unknowns[:, ::3] // 3
    share = np.bincount(nodes.ravel(), volume.ravel(), len(solid.nodes))
    share = share / share.sum()
    arms = solid.nodes_mm - share @ solid.nodes_mm
    radius_mm = float(np.sqrt(share @ (arms**2).sum(1) * 2 / 3))
    turns = [np.cross(axis, arms) / radius_mm for axis in np.eye(3)]
    moves = np.stack([*(np.tile(axis, (len(arms), 1)) for axis in np.eye(3)), *turns], axis=2)
    moves = moves.reshape(-1, FLAP_MODES)  # of every node, as the flap moves rigidly
    forces = moves * np.repeat(share, 3)[:, None]
    rigid = RigidMotions.from_solid(solid)
    responses = rigid.removed(factor.solve(rigid.balanced(forces)))
    # What each does to the flap: its mean motion, least squares by volume.
    yields = np.linalg.solve(forces.T @ moves, forces.T @ responses)
    load = _LOAD_MN / _TISSUE_KPA
    squares, axes = np.linalg.eigh(yields @ yields.T * load**2)
    limited = squares * _MOST_MM**2 / (squares + _MOST_MM**2)
    return responses @ np.linalg.inv(yields), (axes * limited) @ axes.T


def _with_uncorrelated(
    states: np.ndarray, covariances: Sequence[Float64[np.ndarray, "6 6"]]
) -> np.ndarray:
    """States with further coefficients, which have these covariances exactly, and none with each
    other or those before."""
    rng, every = np.random.default_rng(0), states.astype(float)
    for covariance in covariances:
        drawn = rng.normal(size=(len(every), len(covariance)))
        known = np.column_stack([np.ones(len(every)), every])
        drawn -= known @ np.linalg.lstsq(known, drawn, rcond=None)[0]
        whitened = np.linalg.inv(np.linalg.cholesky(np.cov(drawn.T)))
        every = np.column_stack([every, drawn @ (np.linalg.cholesky(covariance) @ whitened).T])
    return every.astype(np.float32)


def _grooved(field: DistanceField, kerf: DistanceField) -> DistanceField:
    """The organ's distances with the kerf carved out, on the kerf's lattice."""
    values = field.values_mm
    for axis, (count, wanted) in enumerate(zip(values.shape, kerf.values_mm.shape, strict=True)):
        at = np.arange(wanted) * kerf.spacing_mm / field.spacing_mm
        low = np.minimum(at.astype(int), count - 2)
        share = np.float32(at - low).reshape([-1 if a == axis else 1 for a in range(3)])
        values = (1 - share) * values.take(low, axis) + share * values.take(low + 1, axis)
    return kerf._replace(values_mm=np.maximum(values, -kerf.values_mm).astype(np.float32))


def _kerf(
    field: DistanceField, points_ct: Float64[np.ndarray, "n 3"], kerf_mm: float
) -> DistanceField:
    """Distances to where an electrode was, negative inside, no larger than 1 mm: half a kerf to
    either side of the planes through neighbouring places. On a lattice where the organ's is."""
    step = min(field.spacing_mm, _STEP_MM)
    shape = [int((count - 1) * field.spacing_mm / step) + 1 for count in field.values_mm.shape]
    near = np.zeros(shape, bool)
    places = np.rint((points_ct - field.origin_mm) / step).astype(int)
    near[tuple(places[((places >= 0) & (places < shape)).all(1)].T)] = True
    near = ndimage.binary_dilation(near, iterations=int(np.ceil((kerf_mm + _RIM_MM) / step)))
    nodes = np.argwhere(near) * step + field.origin_mm
    away, which = cKDTree(points_ct).query(nodes, min(_NEIGHBOURS, len(points_ct)))
    neighbours = points_ct[which.reshape(len(nodes), -1)]
    middle = neighbours.mean(1)
    spread = neighbours - middle[:, None]
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    off_mm = np.abs(((nodes - middle) * normal).sum(1))
    beside_mm = np.sqrt(np.maximum(away.reshape(len(nodes), -1)[:, 0] ** 2 - off_mm**2, 0))
    apart_mm = np.median(np.linalg.norm(spread, axis=2), axis=1)
    values = np.ones(shape, np.float32)
    inside = beside_mm < _NEAR_STEPS * apart_mm
    values[near] = np.where(inside, np.minimum(off_mm - kerf_mm / 2, 1.0), 1.0)
    return DistanceField(values, field.origin_mm, step)


def _without(organ: Mesh, kerf: DistanceField) -> Mesh:
    """The organ's surface, with the walls of a kerf."""
    from skimage import measure

    values = np.pad(kerf.values_mm, 1, constant_values=1.0)
    vertices, faces, _, _ = measure.marching_cubes(values, 0.0)
    cut = Mesh((vertices - 1) * kerf.spacing_mm + kerf.origin_mm, faces)
    return largest_shell(mesh_of(solid_of(organ, "the organ") - solid_of(cut, "the kerf")))


def carried_to_ct(cuts: Sequence[Cut], motion: ElasticMotion) -> tuple[Cut, ...]:
    """Cuts as places of the CT; ``motion``: where the organ lay when those before the camera were
    made."""
    return tuple(
        cut if cut.points_ct else cut.of_ct(motion.inverse(np.array(cut.places_mm))) for cut in cuts
    )


def cut_report(fit: RefinedFit, config: GaussNewtonConfig) -> CutReport | None:
    """What an answer knows of cuts; None: of none."""
    if (cut := fit.motion.shape.cut) is None:
        return None
    points_ct = fit.motion.inverse(fit.views.points_mm)
    beside = cut.places.query(points_ct, distance_upper_bound=_BESIDE_MM)[0] < np.inf
    far = np.abs(fit.distances_mm[beside]) > FARTHEST * fit.views.width_mm(config)
    return CutReport(
        places=len(cut.points_ct),
        kerf_mm=cut.kerf_mm,
        flaps={name: _seen(fit, flap) for name, flap in cut.flaps.items()},
        outliers=float(far.mean()) if beside.any() else 0.0,
    )


def _seen(fit: RefinedFit, flap: Flap) -> float:
    """Of the part of a flap's surface that faces the first camera, the share with points near."""
    motion = fit.motion
    places_mm = motion.forward(flap.surface_ct)
    facing = ((flap.normals_mm2 @ motion.rotation.T) * places_mm).sum(1) < 0
    if not facing.any() or not len(fit.views.points_mm):
        return 0.0
    near = cKDTree(fit.views.points_mm).query(places_mm[facing])[0] < _SEEN_MM
    return float(np.average(near, weights=np.linalg.norm(flap.normals_mm2[facing], axis=1)))
