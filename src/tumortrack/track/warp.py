"""Locating with a warp: place the pre-operative organ, then read everything off it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from tumortrack.core.types import Anatomy, CameraLabels, Mesh, OccupancyCloud, SensorCloud
from tumortrack.imaging.raster import label_grid
from tumortrack.learn.fit import check_familiar, check_likely, fit_mm, spread_mm
from tumortrack.learn.model import Model
from tumortrack.learn.warp.locate import best_fit, first_motions
from tumortrack.learn.warp.motion import WarpMotion
from tumortrack.learn.warp.network import WarpNetwork
from tumortrack.sense.cloud import check_cloud, thin_cloud
from tumortrack.track.estimate import Estimate
from tumortrack.track.report import fit_report, report_head, stage
from tumortrack.track.volume import describe_parts, grid_over

QUERIES = 40_000  # as many as the paper asks
_KNOWN_AT = 256  # places where the uncertainty is worked out; others take the nearest's
_FIELD_MM = 0.3  # error of the distance fields and surfaces themselves


class WarpLocator:
    """Locates by a warp network and its refinement; its estimates have a motion."""

    def __init__(self, model: Model) -> None:
        from scipy.spatial import cKDTree

        assert isinstance(model.network, WarpNetwork)
        assert model.shape is not None
        assert model.trust is not None
        self._model, self._network, self._shape = model, model.network, model.shape
        self._trust = model.trust
        self._device = next(model.network.parameters()).device
        organ = model.shape.anatomy_ct.organ
        self.organ_box_ct: Float[np.ndarray, "2 3"] | None = organ.box_mm
        few = max(1, len(organ.vertices_mm) // (_KNOWN_AT // 2))
        inner = [part.vertices_mm for part in model.shape.anatomy_ct.tumors]
        self._known_ct = np.concatenate(
            [organ.vertices_mm[::few], *(v[:: max(1, len(v) // 64)] for v in inner)]
        )
        self._nearest_known = cKDTree(self._known_ct)

    def locate(self, cloud: SensorCloud, grid: int, seed: int) -> Estimate:
        """See ``track.tracker.Tracker.locate``."""
        rng = np.random.default_rng(seed)
        seconds: dict[str, float] = {}
        check_cloud(cloud)
        points = thin_cloud(cloud, self._model.config.scene.cloud.n_points, rng).points_mm
        with stage(seconds, "encode", self._device):
            starts = first_motions(self._network, self._shape, points)
        with stage(seconds, "refine", self._device):
            refine, usual_cost = self._model.config.refine, self._trust.usual_cost
            fit = best_fit(self._shape, points, starts, refine, usual_cost)
            distances = np.abs(fit.distances_mm)
            check_familiar(self._model.familiar, spread_mm(points), fit_mm(distances))
            check_likely(fit.motion.rarity)
        with stage(seconds, "surfaces", self._device):
            motion = replace(fit.motion, std_scale=self._trust.std_scale)
            parts = self._shape.anatomy_ct.parts
            moved = Anatomy(tuple(part.moved(motion.carry(part.vertices_mm)) for part in parts))
        with stage(seconds, "fine", self._device):
            inside = self._asked(motion, moved.organ, cloud.stamp_ns, rng)
        with stage(seconds, "volume", self._device):
            camera_from_index, shape = grid_over(moved.organ.vertices_mm, grid)
            labels = label_grid(moved, camera_from_index, shape)
        meshes = dict(zip(moved.names, moved.parts, strict=True))
        report = {
            **report_head(cloud, seed, camera_from_index),
            "fit_mm": fit_report(distances),
            "parts": self._described(motion, meshes, inside),
            "motion": {
                "camera_from_ct": motion.camera_from_ct.tolist(),
                "coefficients": motion.coefficients.tolist(),
                "rarity": motion.rarity,
                "steps": fit.steps,
            },
            "timings": {**seconds, "total": sum(seconds.values())},
        }
        volume = CameraLabels(labels, camera_from_index)
        return Estimate(inside, volume, meshes, report, motion)

    def _asked(
        self, motion: WarpMotion, organ: Mesh, stamp_ns: int, rng: np.random.Generator
    ) -> OccupancyCloud:
        """Random points of the organ's box that lie inside, with label and probability: that the
        nearest surface does not lie on the point's other side, errors being normal."""
        from scipy.special import ndtr

        lower, upper = organ.box_mm
        points = rng.uniform(lower, upper, (QUERIES, 3)).astype(np.float32)
        points_ct = motion.back(points).astype(np.float32)
        labels, margin_mm = self._shape.labels_at(points_ct)
        inside = labels > 0
        deviation = np.hypot(self._std_near(motion, points_ct[inside]), _FIELD_MM)
        probability = ndtr(margin_mm[inside] / deviation)
        return OccupancyCloud(points[inside], labels[inside], probability, stamp_ns)

    def _std_near(
        self, motion: WarpMotion, points_ct: Float32[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, " n"]:
        deviation = motion.std_mm(self._known_ct)
        assert deviation is not None
        return deviation[self._nearest_known.query(points_ct)[1]]

    def _described(
        self, motion: WarpMotion, meshes: dict[str, Mesh], inside: OccupancyCloud
    ) -> dict[str, dict]:
        """``describe_parts``, and how unsure the place of each part's middle is."""
        parts = describe_parts(self._model.parts, meshes, inside)
        middles = [part.box_mm.mean(0) for part in self._shape.anatomy_ct.parts]
        deviation = motion.std_mm(np.array(middles))
        assert deviation is not None
        for part, std_mm in zip(parts.values(), deviation, strict=True):
            part["center_std_mm"] = float(std_mm)
        return parts
