"""A fitted motion -> an estimate: surfaces, labels and figures, made once, in the order in which
``EstimateMaker.estimate`` calls for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt8

from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Evidence
from tumortrack.core.geometry import largest_std_of
from tumortrack.core.raster import label_grid
from tumortrack.core.report import (
    AllowedPoses,
    AlternativeFit,
    EvidenceReport,
    ExcludedFit,
    FitCost,
    FitReport,
    MotionReport,
    PartReport,
    SizeFit,
    SmoothingReport,
)
from tumortrack.core.rigid_fit import kabsch
from tumortrack.core.types import Anatomy, CameraLabels, Mesh, OccupancyCloud, View
from tumortrack.native import F32, F64, I32, kernel
from tumortrack.registration.compliance import RefinedFit
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.evidence import TrackedEvidence
from tumortrack.registration.flap import cut_report
from tumortrack.registration.frame import Frame, describe_parts, grid_over, residuals
from tumortrack.registration.gauss_newton import FARTHEST, RegistrationResult
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud, depth_share
from tumortrack.registration.search import PosePrior

QUERIES = 40_000  # as many as the paper asks
CARRIED = 20_000  # points of the undeformed organ that live estimates carry along
NODES_MM = 2.0  # apart, of the lattice by which points find the nearest sample
_SAMPLES = 256  # places where the uncertainty is computed; other points take the nearest's
_FIELD_MM = 0.3  # error of the distance fields and surfaces themselves

# In C: native/exact/lookup.c.
_probabilities = kernel("probabilities", F32["n"], F64["s"], I32["n"], F32["n"].out, result=int)
_look_up = kernel("look_up", F32[3], I32["i", "j", "k"], F32["n", 3], float, I32["n"].out)


class Found(NamedTuple):
    """A frame's fit; the prior by which it is the most likely; its motion as the points alone show
    it; evidence by now, and that part of it, as it came, which is of earlier frames."""

    fit: RegistrationResult
    prior: PosePrior
    shown: ElasticMotion
    pieces: tuple[Evidence, ...] = ()
    before: tuple[TrackedEvidence, ...] = ()


@dataclass(frozen=True, eq=False)
class _OrganPoints:
    """Points of the undeformed organ: place (CT, mm), label, distance to the nearest surface that
    bounds it, and the number of the nearest sample of uncertainty."""

    points_ct: Float32[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    margin_mm: Float32[np.ndarray, " n"]
    sample: Int32[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _Placed:
    """The organ before the camera: its motion with covariance, the moved surfaces, and the
    covariances (mm^2) at the samples, part by part, and at the middle of each part's box; ``fit``:
    the same without the camera's common error."""

    motion: ElasticMotion
    meshes: dict[str, Mesh]
    structures: dict[str, Mesh]
    sample_mm2: Float[np.ndarray, "k 3 3"]
    middle_mm2: Float[np.ndarray, "parts 3 3"]
    fit_sample_mm2: Float[np.ndarray, "k 3 3"]
    fit_middle_mm2: Float[np.ndarray, "parts 3 3"]

    def probability(self, mine: _OrganPoints) -> Float32[np.ndarray, " n"]:
        """The chance that each point lies on the side of the nearest surface where it was found,
        if errors are normal."""
        variances = np.trace(self.sample_mm2, axis1=1, axis2=2) / 3
        return probabilities(mine.margin_mm, 1 / np.sqrt(variances + _FIELD_MM**2), mine.sample)


class EstimateMaker:
    """Makes the estimates of one model."""

    def __init__(self, model: RegistrationModel) -> None:
        self._model, self._shape = model, model.shape
        anatomy = model.shape.anatomy_ct
        self._surfaces = (*anatomy.parts, *anatomy.structures.values())
        together = np.concatenate([mesh.vertices_mm for mesh in self._surfaces])
        self._vertices_ct = together.astype(np.float32)
        counts = [_SAMPLES // 2, *[64] * len(anatomy.tumors)]
        vertices = [part.vertices_mm for part in anatomy.parts]
        samples = [v[:: max(1, len(v) // count)] for v, count in zip(vertices, counts, strict=True)]
        self.samples_ct = np.concatenate(samples)
        self._sample_ends = np.cumsum([len(places) for places in samples])[:-1]  # of each part's
        self._nearest_sample = nearest_lookup(self.samples_ct)
        self._carried: _OrganPoints | None = None

    def estimate(
        self,
        frame: Frame,
        views: Sequence[View],
        found: Found,
        refined: RefinedFit,
        smoothing: SmoothingReport | None = None,
        grid: int | None = None,
    ) -> Estimate:
        """Of a frame. ``grid``: voxels along the longest side of the volume; None: there is none,
        and the labelled points are the same ones in every frame."""
        fit, config, stamp_ns = found.fit, self._model.config.refine, frame.cloud.stamp_ns
        size = fit.views.apparent_size(fit.motion, config)
        with frame.stage("surfaces"):
            placed = self._placed(fit, refined, size)
        volume = None
        if grid is None:
            with frame.stage("forward"):
                inside = self._forward(placed, stamp_ns)
        else:
            with frame.stage("fine"):
                inside = self._drawn(placed, stamp_ns, frame.rng)
            with frame.stage("volume"):
                organ = placed.meshes[self._model.parts[0]]
                camera_from_index, shape = grid_over(organ.vertices_mm, grid)
                parts = Anatomy(tuple(placed.meshes.values()))
                volume = CameraLabels(
                    label_grid(parts, camera_from_index, shape), camera_from_index
                )
        told, known = _evidence_of(found, refined, placed.motion)
        report = FitReport(
            parts=self._parts(placed, inside, fit.views, refined),
            seed=frame.seed,
            points=sum(len(view.cloud.points_mm) for view in views),
            voxel_mm=None if volume is None else float(volume.camera_from_index[0, 0]),
            size=size,
            smoothing=smoothing,
            structures=tuple(placed.structures),
            fit_cost=_fit_cost(fit, found.prior, self._model.calibration.usual_cost, config),
            poses=AllowedPoses(
                up_lps=found.prior.up_ct.tolist(),
                tilt_degrees=found.prior.tilt_degrees,
                allow_flip=found.prior.allow_flip,
            ),
            motion=MotionReport(
                camera_from_ct=self._nearest_rigid(placed).tolist(),
                camera_from_deformed_ct=placed.motion.camera_from_deformed_ct.tolist(),
                coefficients=placed.motion.coefficients.tolist(),
                normalized_mahalanobis=fit.motion.normalized_mahalanobis,
                steps=refined.steps,
                compliance_std_mm=refined.compliance_std_mm,
                misfit_mm=refined.misfit_mm,
                depth_share=placed.motion.depth_share,
            ),
            views=fit.views.described() if len(views) > 1 else None,
            evidence=told,
            cut=cut_report(refined, config),
            fit_mm=residuals(np.abs(refined.distances_mm)),
            timings=frame.timings,
        )
        return Estimate(
            cloud=inside,
            volume=volume,
            meshes=placed.meshes,
            report=report,
            motion=placed.motion,
            unsmoothed=found.shown,
            structures=placed.structures,
            evidence=known,
        )

    def warm(self, fit: RegistrationResult, refined: RefinedFit) -> None:
        """Prepare what the first estimate of a frame would wait for."""
        size = fit.views.apparent_size(fit.motion, self._model.config.refine)
        self._forward(self._placed(fit, refined, size), 0)

    def _nearest_rigid(self, placed: _Placed) -> Float64[np.ndarray, "4 4"]:
        rest = self._model.shape.anatomy_ct.organ.vertices_mm.astype(np.float64)
        there = placed.meshes[self._model.parts[0]].vertices_mm.astype(np.float64)
        return kabsch(rest, there, np.ones(len(rest)))

    def _placed(self, fit: RegistrationResult, refined: RefinedFit, size: SizeFit) -> _Placed:
        share = 0.0
        if len(fit.views.points_mm):
            share = depth_share(size, refined.motion.centre_mm[2], fit.views.depth_error)
        std_scale = self._model.calibration.std_scale
        motion = replace(refined.motion, depth_share=share, std_scale=std_scale)
        anatomy = self._shape.anatomy_ct
        ends = np.cumsum([len(mesh.vertices_mm) for mesh in self._surfaces])[:-1]
        moved = np.split(motion.forward(self._vertices_ct), ends)
        there = zip((*anatomy.names, *anatomy.structures), self._surfaces, moved, strict=True)
        meshes = {name: mesh.with_vertices(places) for name, mesh, places in there}
        structures = {name: meshes.pop(name) for name in anatomy.structures}
        places_ct = np.concatenate([self.samples_ct, self._shape.middles_ct])
        known_mm2 = motion.covariance_mm2(places_ct)
        assert known_mm2 is not None
        along = share * motion.forward(places_ct)
        fit_mm2, count = known_mm2 - along[:, :, None] * along[:, None, :], len(self.samples_ct)
        spread = known_mm2[:count], known_mm2[count:], fit_mm2[:count], fit_mm2[count:]
        return _Placed(motion, meshes, structures, *spread)

    def _parts(
        self, placed: _Placed, inside: OccupancyCloud, views: MultiViewCloud, refined: RefinedFit
    ) -> dict[str, PartReport]:
        known_mm = views.points_mm  # what was seen, and what evidence says
        if views.evidence is not None:
            known_mm = np.concatenate([known_mm, views.evidence.places_of_tissue_mm])
        held_mm = refined.prior_pull_mm
        surfaces_mm2 = np.split(placed.sample_mm2, self._sample_ends)
        fit_middle_mm = largest_std_of(placed.fit_middle_mm2)
        fit_surface_mm = np.split(largest_std_of(placed.fit_sample_mm2), self._sample_ends)
        deviations = {}
        for n, name in enumerate(self._model.parts):
            squares, axes = np.linalg.eigh(placed.middle_mm2[n])
            center_mm = placed.meshes[name].box_mm.mean(0)
            deviations[name] = {
                "prior_pull_mm": held_mm[n],
                "fit_std_mm": (float(fit_middle_mm[n]), float(fit_surface_mm[n].max())),
                "center_std_mm": float(np.sqrt(squares.mean())),
                "center_axes_std_mm": tuple(np.sqrt(squares[::-1]).tolist()),
                "center_axes": tuple(map(tuple, axes.T[::-1].tolist())),
                "surface_std_mm": float(np.sqrt(np.linalg.eigvalsh(surfaces_mm2[n]).max())),
                "nearest_mm": float(np.sqrt(((known_mm - center_mm) ** 2).sum(1).min())),
            }
        return describe_parts(self._model.parts, placed.meshes, inside, deviations)

    def _drawn(self, placed: _Placed, stamp_ns: int, rng: np.random.Generator) -> OccupancyCloud:
        """Random points of the organ's box that lie inside, with label and probability."""
        lower, upper = placed.meshes[self._model.parts[0]].box_mm
        points = rng.random((QUERIES, 3), np.float32)
        points *= (upper - lower).astype(np.float32)
        points += lower.astype(np.float32)
        inside, mine = self._inside(placed.motion.inverse(points).astype(np.float32))
        probability = placed.probability(mine)
        return OccupancyCloud(points.take(inside, 0), mine.labels, probability, stamp_ns)

    def _forward(self, placed: _Placed, stamp_ns: int) -> OccupancyCloud:
        """The same points of the organ in every frame: labels stay, places and probabilities are
        new."""
        if self._carried is None:
            lower, upper = self._shape.anatomy_ct.organ.box_mm
            rng, found = np.random.default_rng(0), np.zeros((0, 3), np.float32)
            while len(found) < CARRIED:
                points = rng.uniform(lower, upper, (CARRIED, 3)).astype(np.float32)
                found = np.concatenate([found, points[self._shape.labels_at(points)[0] > 0]])
            self._carried = self._inside(found[:CARRIED])[1]
        mine = self._carried
        places = placed.motion.forward(mine.points_ct).astype(np.float32)
        return OccupancyCloud(places, mine.labels, placed.probability(mine), stamp_ns)

    def _inside(
        self, points_ct: Float32[np.ndarray, "n 3"]
    ) -> tuple[Int64[np.ndarray, " m"], _OrganPoints]:
        """The numbers of the points that lie inside, and what is known of these points."""
        labels, margin_mm = self._shape.labels_at(points_ct)
        inside = np.flatnonzero(labels)
        mine = points_ct.take(inside, 0)  # much faster than by a mask
        sample = look_up(*self._nearest_sample, mine)
        return inside, _OrganPoints(mine, labels[inside], margin_mm[inside], sample)


def _evidence_of(
    found: Found, refined: RefinedFit, motion: ElasticMotion
) -> tuple[tuple[EvidenceReport, ...], tuple[TrackedEvidence, ...]]:
    """What a report says of the evidence, and what the next frame needs of it."""
    if not found.pieces:
        return (), ()
    evidence, terms, before = refined.views.evidence, refined.terms, found.before
    assert evidence is not None
    assert terms is not None
    reports = evidence.described(found.pieces, motion, len(before), terms)
    new = [TrackedEvidence(piece, found.shown) for piece in found.pieces[len(before) :]]
    pairs = zip((*before, *new), reports, strict=True)
    return reports, tuple(known for known, entry in pairs if not entry.rejected)


def _fit_cost(
    fit: RegistrationResult, prior: PosePrior, usual_cost: float, config: GaussNewtonConfig
) -> FitCost:
    """``usual_cost``: of one view, without its noise. Of several views the one with most outliers
    counts."""
    views, outliers, now = fit.views, fit.outliers, fit.points_cost
    if views.count > 1:
        far = np.abs(fit.distances_mm) > FARTHEST * views.width_mm(config)
        outliers = max(float(far[views.view == n].mean()) for n in range(views.count))
    names, middles_ct = fit.motion.shape.anatomy_ct.names, fit.motion.shape.middles_ct
    here, others = fit.motion.forward(middles_ct), list[AlternativeFit]()
    for alternative, (_, share) in zip(fit.alternatives, fit.motion.alternatives, strict=False):
        there = alternative.motion.forward(middles_ct)
        cosine = (np.trace(alternative.motion.rotation @ fit.motion.rotation.T) - 1) / 2
        distance_mm = np.linalg.norm(there - here, axis=1).tolist()
        others.append(
            AlternativeFit(
                more=alternative.cost - fit.cost,
                share=share,
                distance_mm=dict(zip(names, distance_mm, strict=True)),
                center_mm=dict(zip(names, map(tuple, there.tolist()), strict=True)),
                turn_degrees=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
            )
        )
    # With the other side up, as good, or better where that is excluded; or this fit, if it is so.
    excluded = fit if prior.excludes(fit.motion.rotation) else fit.excluded_pose
    excluded_pose = None
    if excluded is not None:
        tilt_degrees = float(prior.tilt_degrees_of(excluded.motion.rotation))
        excluded_pose = ExcludedFit(less=fit.cost - excluded.cost, tilt_degrees=tilt_degrees)
    return FitCost(
        now=now,
        without_outliers=fit.cost_without_strays - (fit.cost - now),
        usual=usual_cost * views.count + views.noise_cost(config),
        outliers=outliers,
        others=tuple(others),
        excluded_pose=excluded_pose,
    )


def nearest_lookup(
    places_mm: Float[np.ndarray, "p 3"],
) -> tuple[Float32[np.ndarray, " 3"], Int32[np.ndarray, "i j k"]]:
    """For ``look_up``: a lattice's origin, over the places' box and a node beyond, and the number
    of the place nearest to each node."""
    lower, upper = places_mm.min(0) - NODES_MM, places_mm.max(0) + NODES_MM
    shape = tuple(np.ceil((upper - lower) / NODES_MM).astype(int) + 1)
    nodes = lower + NODES_MM * np.indices(shape).reshape(3, -1).T
    # Half the squared distance, up to what it is for all places; by thousands, for the cache.
    half = (places_mm**2).sum(1) / 2
    parts = np.array_split(nodes, len(nodes) // 1000 + 1)
    which = np.concatenate([(half - some @ places_mm.T).argmin(1) for some in parts])
    return lower.astype(np.float32), which.astype(np.int32).reshape(shape)


def look_up(
    origin: Float32[np.ndarray, " 3"],
    nearest: Int32[np.ndarray, "i j k"],
    points: Float32[np.ndarray, "n 3"],
) -> Int32[np.ndarray, " n"]:
    """The number of the place nearest to each point: that of the nearest node of a lattice, which
    may be another where two are about as near; outside the lattice that of its border."""
    out = np.empty(len(points), np.int32)
    _look_up(origin, nearest, points, NODES_MM, out)
    return out


def probabilities(
    margins: Float32[np.ndarray, " n"],
    per_std: Float64[np.ndarray, " s"],
    which: Int32[np.ndarray, " n"],
) -> Float32[np.ndarray, " n"]:
    """Of normal errors below margins, 0 or more; ``per_std[which]`` is one over a point's standard
    deviation. Raises IndexError."""
    out = np.empty(len(margins), np.float32)
    if _probabilities(margins, per_std, which, out):
        raise IndexError(f"which has numbers beyond the {len(per_std)} standard deviations")
    return out
