"""Which part of a tumor's error has which cause: fits that are told parts of the truth, side by
side. Their differences are the causes' shares.

A state of the wider world is a known displacement of all points. Fits begin at its truth, so that
none is lost; from rung to rung they are told less of it: the inside, the underside, the sides, true
depths. Beside that, parts of what the prior assumes are exchanged for the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import Affine, Points, rigid, transform_points, triangles_of, unit
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.case import Case
from tumortrack.models.config import GaussNewtonConfig
from tumortrack.registration import kernels
from tumortrack.registration.gauss_newton import refine
from tumortrack.registration.kernels import POSE, Flow
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.rest_shape import RestShape
from tumortrack.sense.camera import d405
from tumortrack.sense.cloud import CloudConfig, cloud_from_depth
from tumortrack.simulate.elastic.body import BodyConfig, ElasticBody, body_of, reduced_organ
from tumortrack.simulate.elastic.flow import steps_for
from tumortrack.simulate.elastic.loads import random_states
from tumortrack.simulate.elastic.modes import ReducedModel
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.peers.base import fit_over_volume, matched_vertices
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.tets import embed
from tumortrack_lab.twin.equilibrium import settle
from tumortrack_lab.twin.solid import NeoHookeanSolid
from tumortrack_lab.world import views
from tumortrack_lab.world.forces import LoadedBody, Springs, rows_of
from tumortrack_lab.world.noise import StereoCamera, StereoConfig
from tumortrack_lab.world.organ import Organ

AS_USED = GaussNewtonConfig()
CERTAIN = msgspec.structs.replace(AS_USED, n_effective=1e6, sigma_mm=0.3)  # each point for itself
POSED = msgspec.structs.replace(AS_USED, shift_mm=0.01, turn_rad=0.001)  # stays where it starts
RATIOS, POISSONS = (1.0, 3.0, 8.0), (0.45, 0.49)  # of tissue, to which the truth is rounded
_CALIBRATED = StereoConfig(bias_px=0, lens_px=0, slant_px=0)
_RANGE = CloudConfig(near_mm=1.0, far_mm=1000.0)  # nothing but the organ is in these pictures
_DRAWN, _TAKEN = 6000, 1000  # points of the surface; of them by one fit
_BEHIND_MM = 1.0  # a camera sees a place that lies no deeper than its picture, by this
_VIEWS_DEGREES = 0.0, 45.0, -45.0  # about the organ's length, as in sequences
_PINNED_MN_MM = 1000.0  # a point
_RATIO, _POISSON, _SHEAR_KPA = 3.0, 0.49, 5.0  # the twin's tissue
_LIBRARY = 200  # of the library's states where others join them

Carry = Callable[[Points], Points]


@dataclass(frozen=True, eq=False)
class Told:
    """A state's truth, mm; ``rest`` (CT frame) and ``true`` (camera frame) have the same vertices.
    ``rim_mm``: up to this height on the bench the organ lies hidden in its bed."""

    rest: Anatomy
    true: Anatomy
    camera_from_bench: Affine
    bench_from_ct: Affine
    rim_mm: float

    @classmethod
    def of(cls, rest: Anatomy, reference: Anatomy, meta: Mapping[str, Any]) -> Told:
        """What an undisturbed scene of the world shows, its segmentation being right."""
        pairs = zip(rest.parts, reference.parts, strict=True)
        true = rest.of(a.moved(matched_vertices(a, b)) for a, b in pairs)
        there, at_rest = np.array(meta["camera_from_bench"]), np.array(meta["bench_from_ct"])
        return cls(rest, true, there, at_rest, meta["material"]["rim_mm"])

    def off_mm(self, carry: Carry) -> list[float]:
        """How far a map from the CT to the camera has the middle of each tumor's vertices off."""
        pairs = zip(self.rest.tumors, self.true.tumors, strict=True)
        middles = (carry(a.vertices_mm).mean(0) - b.vertices_mm.mean(0) for a, b in pairs)
        return [float(np.linalg.norm(off)) for off in middles]

    @property
    def camera_from_ct(self) -> Affine:
        """The best rigid pose."""
        return fit_over_volume(self.rest.organ, self.true.organ)[0]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Places of the organ's surface at rest (CT frame) and now (camera frame), mm."""

    points_ct: Points
    points_mm: Points

    def of(self, some: Bool[np.ndarray, " n"]) -> Pairs:
        return Pairs(self.points_ct[some][:_TAKEN], self.points_mm[some][:_TAKEN])


def evidence(state: Told, rng: np.random.Generator) -> dict[str, Pairs | Points]:
    """What is told of the surface: all of it, what three cameras see, what the first one sees and
    that with the underside in its bed, without error; and the first one's points (n, 3; mm) with
    the noise of a camera that is calibrated."""
    rest, true = state.rest.organ, state.true.organ
    areas = np.linalg.norm(triangles_of(rest.vertices_mm, rest.faces)[1], axis=1)
    face = rng.choice(len(areas), _DRAWN, p=areas / areas.sum())
    shares = rng.dirichlet(np.ones(3), _DRAWN)
    corners = (part.vertices_mm[part.faces[face]] for part in (rest, true))
    every = Pairs(*(np.einsum("nc,ncd->nd", shares, corner) for corner in corners))
    to_bench = np.linalg.inv(state.camera_from_bench)
    organ = true.moved(transform_points(to_bench, true.vertices_mm))
    bench_mm, middle = transform_points(to_bench, every.points_mm), organ.vertices_mm.mean(0)
    in_bed, seen = bench_mm[:, 2] < state.rim_mm, []
    for degrees in _VIEWS_DEGREES:
        turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
        pose = state.camera_from_bench @ rigid(turn, middle - turn @ middle)
        seen.append(_seen(organ, pose, bench_mm) & ~in_bed)
    down = triangles_of(organ.vertices_mm, organ.faces)[1][face][:, 2] < 0
    picture = views.render(organ, state.camera_from_bench, d405(*views.SIZE_PX))
    frame = StereoCamera(d405(*views.SIZE_PX), _CALIBRATED, rng).see(picture.astype(np.float32))
    noisy = cloud_from_depth(frame, _RANGE, rng).points_mm
    return {
        "whole surface": every.of(np.ones(_DRAWN, bool)),
        "three views": every.of(seen[0] | seen[1] | seen[2]),
        "one view": every.of(seen[0]),
        "one view and the underside": every.of(seen[0] | (in_bed & down)),
        "calibrated": noisy[transform_points(to_bench, noisy)[:, 2] > state.rim_mm],
    }


def _seen(organ: Mesh, camera_from_bench: Affine, points_mm: Points) -> Bool[np.ndarray, " n"]:
    camera = d405(*views.SIZE_PX)
    depth_mm = views.render(organ, camera_from_bench, camera)
    x, y, z = transform_points(camera_from_bench, points_mm).T
    pixels = np.rint([y / z * camera.fy + camera.cy, x / z * camera.fx + camera.cx]).astype(int)
    last = np.array(depth_mm.shape)[:, None] - 1
    row, column = np.clip(pixels, 0, last)
    near = z < depth_mm[row, column] + _BEHIND_MM  # NaN: nothing is seen there
    return (z > 0) & near & (pixels == [row, column]).all(0)


def recognised(
    start: ElasticMotion, pairs: Pairs, config: GaussNewtonConfig, prior: float = 1.0
) -> ElasticMotion:
    """The likeliest motion near ``start`` if the place of each point on the organ is known: as
    ``gauss_newton``, with displacements instead of distances to the surface. ``prior``: weight of
    the library's."""
    body, motion = start.shape.body, start
    points = np.ascontiguousarray(pairs.points_ct, np.float32)
    weight = min(config.n_effective / len(points), 1.0) / config.sigma_mm**2
    for _ in range(config.steps):
        velocity = body.velocity(motion.coefficients)
        steps = steps_for(velocity, body.spacing_mm)
        flow = Flow(velocity, body.origin_mm, np.float32(body.spacing_mm), steps)
        effects = np.empty((len(points), 3, POSE + len(motion.coefficients)))
        kernels.effects(flow, body.modes, body.center_ct, points, effects)
        slopes = effects.reshape(-1, effects.shape[-1])
        off = ((pairs.points_mm - motion.carry(points)) @ motion.rotation).ravel()
        curvature, gradient = weight * slopes.T @ slopes, weight * slopes.T @ off
        curvature[POSE:, POSE:] += prior * body.precision
        gradient[POSE:] -= prior * body.precision @ (motion.coefficients - body.mean)
        change = np.linalg.solve(curvature, gradient)
        turn = Rotation.from_rotvec(change[3:POSE]).as_matrix()
        centre_mm = motion.centre_mm + motion.rotation @ change[:3]
        coefficients = motion.coefficients + change[POSE:]
        motion = ElasticMotion(motion.shape, motion.rotation @ turn, centre_mm, coefficients)
        if np.abs(change).max() < config.enough_mm:
            break
    return motion


def best_of_modes(shape: RestShape, state: Told) -> ElasticMotion:
    """The truth as well as pose and modes can say it: the inside is told, too."""
    pose = state.camera_from_ct
    place = transform_points(pose, shape.body.center_ct[None])[0]
    start = ElasticMotion(shape, pose[:3, :3], place, np.zeros(len(shape.body.mean)))
    both = ([part.vertices_mm for part in one.parts] for one in (state.rest, state.true))
    return recognised(start, Pairs(*map(np.concatenate, both)), CERTAIN, prior=1e-3)


def inside_of(organ: Organ, state: Told, pairs: Pairs) -> Carry:
    """Finite elements of even tissue (tumors stiffer by the twin's factor) that follow what is told
    of the surface; nothing else pulls. Raises TumortrackError: no equilibrium."""
    mesh = organ.mesh
    there = state.camera_from_ct @ np.linalg.inv(state.bench_from_ct)  # all but what bends it
    rest_mm = transform_points(state.bench_from_ct, pairs.points_ct)
    bent_mm = transform_points(np.linalg.inv(there), pairs.points_mm) - rest_mm
    pinned = embed(mesh, rest_mm)
    rows, springs = rows_of(pinned, len(mesh.nodes_mm)), np.full(len(rest_mm), _PINNED_MN_MM)
    pins = Springs(rows, pinned.carry(mesh.nodes_mm) + bent_mm, springs)
    solid = NeoHookeanSolid(mesh, _SHEAR_KPA * (1 + (_RATIO - 1) * organ.in_tumor), _POISSON)
    bent = settle(LoadedBody(solid, (pins,)), mesh.nodes_mm)[0] - mesh.nodes_mm

    def carry(points_ct: Points) -> Points:
        points_mm = transform_points(state.bench_from_ct, points_ct)
        return transform_points(there, points_mm + embed(mesh, points_mm).carry(bent))

    return carry


class Priors:
    """Bodies of a case that assume another truth than ``shape``'s, the model's: of its tissue, of
    its loads, or of how far they go."""

    def __init__(self, case: Case, shape: RestShape, config: BodyConfig) -> None:
        self.shape, up = shape, unit(np.asarray(case.up_lps, float))

        def reduced(poisson: float) -> ReducedModel:
            one = msgspec.structs.replace(config, poisson=poisson)
            return reduced_organ(case.anatomy, up, one, np.random.default_rng(0))

        def library(reduced: ReducedModel, ratio: float | None = None) -> ElasticBody:
            drawn, rng = copy(reduced), np.random.default_rng(1)
            if ratio is not None:  # in every state
                fixed = partial(reduced.stiffness, contrast=ratio)
                drawn.stiffness = lambda modulus, contrast: fixed(modulus)  # type: ignore[method-assign]
            states = random_states(drawn, up, config.bed_anywhere, rng, config.states)
            return body_of(reduced, np.array(states, np.float32))

        tissues = {poisson: reduced(poisson) for poisson in POISSONS}
        self._poissons = {poisson: library(one) for poisson, one in tissues.items()}
        self._ratios = {ratio: library(tissues[POISSONS[-1]], ratio) for ratio in RATIOS}

    def exchanged(
        self,
        material: Mapping[str, float],
        others: Float64[np.ndarray, "s m"],
        alike: Float64[np.ndarray, "t m"],
    ) -> dict[str, RestShape]:
        """Shapes by what their bodies assume. ``others``: the truths of other states; ``alike``: of
        those under the same kind of load."""
        ratio = min(RATIOS, key=lambda one: abs(np.log(one / material["tumor_ratio"])))
        poisson = min(POISSONS, key=lambda one: abs(one - material["poisson"]))
        states = self.shape.body.states
        mean, some = states.mean(0), states[:: max(1, len(states) // _LIBRARY)]

        def among(these: Float64[np.ndarray, "u m"]) -> ElasticBody:
            """The library keeps about a fifth of the weight."""
            times = max(1, round(4 * len(some) / len(these)))
            joined = np.concatenate([some, *[these.astype(np.float32)] * times])
            return replace(self.shape.body, states=joined)

        spread = {
            f"states spread {factor:g} times as far": replace(
                self.shape.body, states=mean + np.float32(factor) * (states - mean)
            )
            for factor in (0.5, 2.0)
        }
        bodies = {
            **spread,
            "tumors as stiff as they are": self._ratios[ratio],
            "true Poisson's ratio": self._poissons[poisson],
            "this world's states": among(others),
            "this world's, same kind of load": among(alike if len(alike) else others),
        }
        return {what: replace(self.shape, body=body) for what, body in bodies.items()}


def fits(
    start: ElasticMotion, told: Pairs | Points, exchanged: Mapping[str, ElasticMotion]
) -> dict[str, ElasticMotion]:
    """By what else is known: the likeliest motions near ``start``, the truth, given places of the
    surface (or mere points, mm). ``exchanged``: starts of other bodies, the truth as well."""
    points = (told.points_mm if isinstance(told, Pairs) else told).astype(np.float32)
    weights = {"as used": AS_USED, "points weigh more": CERTAIN, "pose told": POSED}
    found = {what: refine(start.shape, points, start, one).motion for what, one in weights.items()}
    if isinstance(told, Pairs):
        found["places recognised"] = recognised(start, told, AS_USED)
        found["recognised, weigh more"] = recognised(start, told, CERTAIN)
    for what, near in exchanged.items():
        found[what] = refine(near.shape, points, near, AS_USED).motion
    return found


def judged(
    state: Told, scene: Scene, shapes: Mapping[str, RestShape], organ: Organ, tracker: Tracker
) -> list[dict[str, Any]]:
    """A row a tumor and fit: what was told of the surface, what else was known, and how far off the
    tumor's middle is. ``scene``: the state as a camera sees it; ``shapes``: the model's under "",
    and with bodies that were exchanged. Raises TumortrackError: no equilibrium within."""
    starts = {what: best_of_modes(shape, state) for what, shape in shapes.items()}
    start, seen = starts.pop(""), evidence(state, np.random.default_rng(0))
    whole, rigidly = seen["whole surface"], partial(transform_points, state.camera_from_ct)
    assert isinstance(whole, Pairs)
    found: dict[tuple[str, str], Carry] = {("", "rigid"): rigidly, ("", "modes"): start.carry}
    found["whole surface", "finite elements"] = inside_of(organ, state, whole)
    for told, points in {**seen, "as it is seen": scene.cloud.points_mm[:_TAKEN]}.items():
        motions = fits(start, points, starts)
        found |= {(told, what): motion.carry for what, motion in motions.items()}
    try:
        located = tracker.follow(scene.cloud, seen=scene.depth).motion
        assert located is not None
        found["as it is seen", "found"] = located.carry
    except NoEstimate:  # its row is missing, as the table's numbers tell
        pass
    rest, true = state.rest.organ.vertices_mm, state.true.organ.vertices_mm
    bend_mm = float(np.linalg.norm(true - rigidly(rest), axis=1).max())
    about, sites = {"family": scene.meta["family"], "bend_mm": bend_mm}, tumor_sites_of(state.rest)
    return [
        {**about, "told": told, "what": what, "site": sites[tumor].kind, "off_mm": off_mm}
        for (told, what), carry in found.items()
        for tumor, off_mm in zip(sites, state.off_mm(carry), strict=True)
    ]
