"""Localisation with an occupancy network: coarse queries, then a lattice, then voxels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.evidence import Evidence
from tumortrack.core.report import Finding, FitReport
from tumortrack.core.types import Anatomy, CameraLabels, OccupancyCloud, SensorCloud, View
from tumortrack.registration.frame import Frame, Rng, describe_parts, grid_over, residuals
from tumortrack.registration.in_distribution import check_in_distribution
from tumortrack_occupancy import volume
from tumortrack_occupancy.inference import Inference
from tumortrack_occupancy.kernels import leading
from tumortrack_occupancy.model import OccupancyModel
from tumortrack_occupancy.sparse import halved_lattice, organ_lattice, sparse_logits, sparse_margins

COARSE_QUERIES = 10_000
FINE_QUERIES = 40_000
FEWEST_INSIDE = 20  # of the coarse queries: with fewer there is no organ
_LATTICE_MM = 4.5  # largest step: every ball of 7.8 mm contains a lattice point
_LIVE_MARGIN = 0.1  # of the organ's extent: the largest motion between live frames


class OccupancyLocator:
    """Locates by an occupancy network; its estimates have no motion."""

    anatomy_ct: Anatomy | None = None

    def __init__(self, model: OccupancyModel, bfloat16: bool | None = None) -> None:
        self.model = model
        self.inference = Inference(model.network, bfloat16)

    def locate(
        self,
        views: Sequence[View],
        grid: int,
        seed: int,
        evidence: Sequence[Evidence] = (),
        any_pose: bool = False,
    ) -> Estimate:
        """See ``tracking.tracker.Tracker.locate``. The two passes of queries are those of the
        follow-up (LUDO): 10,000 coarse ones where the organ can be, then 40,000 in the enlarged box
        of those inside."""
        frame = _Frame(self, _only_cloud(views, evidence), seed, np.random.default_rng(seed))
        lattice = frame.lattice(frame.coarse_box())
        distances_mm = frame.checked(lattice)
        inside = frame.inside(lattice)
        with frame.stage("volume"):
            camera_from_index, shape = grid_over(inside.points_mm, grid)
            margins, labels = sparse_margins(frame.logits_at, camera_from_index, shape)
        return frame.estimate(distances_mm, inside, margins, labels, camera_from_index)

    def follow(self, views: Sequence[View], last: Estimate | None, how: FollowOptions) -> Estimate:
        """See ``tracking.tracker.Tracker.follow``. The enlarged box of the last organ replaces the
        coarse queries, and its lattice is queried only where the organ is (``organ_lattice``). If
        the organ reaches the box's border, there is no last estimate, or with ``global_search``, it
        is searched for as in a first frame, with every lattice point queried. The surfaces' grid is
        twice as fine as the lattice, and queried only near surfaces."""
        cloud = _only_cloud(views)
        rng = np.random.default_rng((how.seed, cloud.stamp_ns))
        frame = _Frame(self, cloud, how.seed, rng)
        lattice = None
        if last is not None and not how.global_search:
            low, high = last.cloud.points_mm.min(0), last.cloud.points_mm.max(0)
            margin = _LIVE_MARGIN * float((high - low).max())
            lattice = frame.lattice(np.stack([low - margin, high + margin]).astype(float))
        if lattice is None or lattice.cut_off():
            lattice = frame.lattice(frame.coarse_box(), everywhere=True)
        distances_mm = frame.checked(lattice)
        with frame.stage("volume"):
            finer = halved_lattice(frame.logits_at, lattice)
        inside = frame.inside(finer)
        return replace(frame.estimate(distances_mm, inside, *volume.margins_on(finer)), volume=None)

    def warm(self) -> None:
        """See ``tracking.tracker.Tracker.warm``."""
        rng = np.random.default_rng(0)
        points = rng.normal(0, 15, (self.model.config.scene.cloud.n_points, 3)) + [0, 0, 150]
        frame = _Frame(self, SensorCloud(points), 0, rng)
        box = self.model.query_box_mm + np.median(points, axis=0)
        finer = halved_lattice(frame.logits_at, frame.lattice(box))
        for step in (frame.inside, frame.checked):
            with suppress(NoEstimate):  # this is no organ
                step(finer)
        ball = np.linalg.norm(np.indices((16, 16, 16)).T - 7.5, axis=-1) < 5
        margins = np.where(ball, 1, -1).astype(np.float16)[None]
        volume.part_surfaces(margins, ball.astype(np.uint8), np.eye(4), self.model.parts[:1])


def _only_cloud(views: Sequence[View], evidence: Sequence[Evidence] = ()) -> SensorCloud:
    if len(views) > 1 or evidence:
        raise InputError(
            "several views, and evidence, need a model that knows a motion: preset elastic; quick "
            "and paper take one cloud."
        )
    return views[0].cloud


class _Frame(Frame):
    """One cloud, from its latent code to the estimate."""

    def __init__(self, locator: OccupancyLocator, cloud: SensorCloud, seed: int, rng: Rng) -> None:
        super().__init__(locator.model, cloud, seed, rng)
        self._box_mm = locator.model.query_box_mm
        self._inference = locator.inference
        with self.stage("encode"):
            self._latent = self._inference.encode(self.points_mm)

    def logits_at(self, points_mm: volume.Points) -> torch.Tensor:
        return self._inference.logits(self._latent, points_mm)

    def coarse_box(self) -> volume.Box:
        """The organ's box, from coarse random queries."""
        lower, upper = self._box_mm + np.median(self.cloud.points_mm, axis=0)
        points = self.rng.uniform(lower, upper, (COARSE_QUERIES, 3)).astype(np.float32)
        with self.stage("coarse"):
            inside = points[self.logits_at(points).argmax(-1).cpu().numpy() > 0]
        if len(inside) < FEWEST_INSIDE:
            values: dict[str, float | str] = {"inside": len(inside), "queries": COARSE_QUERIES}
            raise NoEstimate(Finding("few_inside", values))
        gap = float((np.prod(upper - lower) / COARSE_QUERIES) ** (1 / 3))
        low, high = inside.min(0), inside.max(0)
        margin = 0.05 * (high - low) + gap / 2
        return np.stack([low - margin, high + margin])

    def lattice(self, box: volume.Box, everywhere: bool = False) -> volume.LogitLattice:
        """Over a box, queried everywhere or only where the organ is."""
        steps = max(volume.FIT_STEPS, math.ceil(float((box[1] - box[0]).max()) / _LATTICE_MM))
        over = volume.lattice_over if everywhere else organ_lattice
        with self.stage("lattice"):
            return over(self.logits_at, box, steps)

    def checked(self, lattice: volume.LogitLattice) -> Float32[np.ndarray, " n"]:
        """The observed points' distances from the surface; NoEstimate if this is not the organ."""
        with self.stage("fit"):
            distances_mm = volume.surface_distances(lattice, self.points_mm)
            check_in_distribution(self.model.in_distribution, self.points_mm, distances_mm)
        return distances_mm

    def inside(self, lattice: volume.LogitLattice) -> OccupancyCloud:
        """The points inside the organ, of 40,000 random ones in the lattice's box."""
        with self.stage("fine"):
            low, high = lattice.box_mm
            points = self.rng.uniform(low, high, (FINE_QUERIES, 3)).astype(np.float32)
            logits = sparse_logits(self.logits_at, lattice, points)
            labels = leading(logits)[0]
            inside = labels > 0
            probability = torch.from_numpy(logits[inside]).softmax(-1).amax(-1).numpy()
        if inside.sum() < FEWEST_INSIDE:
            raise NoEstimate(Finding("left"))
        stamp_ns = self.cloud.stamp_ns
        return OccupancyCloud(points[inside], labels[inside], probability, stamp_ns)

    def estimate(
        self,
        distances_mm: Float32[np.ndarray, " n"],
        inside: OccupancyCloud,
        margins: volume.Margins,
        labels: volume.Labels,
        camera_from_index: volume.Affine,
    ) -> Estimate:
        """The estimate from margins and labels on a grid."""
        names = self.model.parts
        with self.stage("surfaces"):
            kept = volume.keep_largest_pieces(labels, len(names))
            inside = volume.drop_islands(inside, labels, kept, camera_from_index)
            meshes = volume.part_surfaces(margins, kept, camera_from_index, names)
        parts = describe_parts(names, meshes, inside)
        report = FitReport(
            parts=parts,
            seed=self.seed,
            points=len(self.cloud.points_mm),
            voxel_mm=float(camera_from_index[0, 0]),
            fit_mm=residuals(distances_mm),
            timings=self.timings,
        )
        return Estimate(inside, CameraLabels(kept, camera_from_index), meshes, report)
