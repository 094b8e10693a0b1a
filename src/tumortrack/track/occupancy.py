"""Locating with an occupancy network: ask for labels, coarse then fine, then everywhere."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float32

from tumortrack.core.errors import NoEstimate
from tumortrack.core.types import Anatomy, CameraLabels, OccupancyCloud, SensorCloud
from tumortrack.learn.fit import check_familiar, fit_mm, spread_mm, surface_distances
from tumortrack.learn.model import Model, has_fast_bfloat16
from tumortrack.learn.network import Latent, OccupancyNetwork
from tumortrack.sense.cloud import check_cloud, thin_cloud
from tumortrack.track.estimate import Estimate, Following
from tumortrack.track.report import fit_report, report_head, stage
from tumortrack.track.sparse import sparse_margins
from tumortrack.track.volume import (
    describe_parts,
    drop_islands,
    grid_over,
    keep_largest_pieces,
    part_surfaces,
)

COARSE_QUERIES = 10_000
FINE_QUERIES = 40_000
FEWEST_INSIDE = 20  # of the coarse queries: fewer are no organ
_LIVE_GRID = 48  # of a live estimate's surfaces: about 2 mm for a kidney
_LIVE_MARGIN = 0.1  # of the organ's extent: how far it may move from one live frame to the next
CHUNK = 2048  # queries at once and core: their activations stay in its cache

Box = Float[np.ndarray, "2 3"]


class OccupancyLocator:
    """Locates by an occupancy network; its estimates have no motion."""

    anatomy_ct: Anatomy | None = None

    def __init__(self, model: Model) -> None:
        assert isinstance(model.network, OccupancyNetwork)
        self.model = model
        self._network = model.network.folded()
        self._device = next(model.network.parameters()).device
        self._bf16 = has_fast_bfloat16(self._device)

    @torch.inference_mode()
    def locate(self, cloud: SensorCloud, grid: int, seed: int) -> Estimate:
        """See ``track.tracker.Tracker.locate``.

        The two passes of queries follow the follow-up (LUDO): 10,000 coarse ones where the organ
        can be, then 40,000 in the box of those inside, enlarged.
        """
        rng = np.random.default_rng(seed)
        return self._located(cloud, None, grid, seed, rng)

    @torch.inference_mode()
    def follow(self, cloud: SensorCloud, last: Estimate | None, how: Following) -> Estimate:
        """See ``track.tracker.Tracker.follow``: the last organ's box, enlarged, stands for the
        coarse queries, and the dense grid that surfaces come from is coarse."""
        rng = np.random.default_rng((how.seed, cloud.stamp_ns))
        box = None
        if last is not None and not how.thorough:
            low, high = last.cloud.points_mm.min(0), last.cloud.points_mm.max(0)
            margin = _LIVE_MARGIN * float((high - low).max())
            box = np.stack([low - margin, high + margin]).astype(float)
        return replace(self._located(cloud, box, _LIVE_GRID, how.seed, rng), volume=None)

    def warm(self) -> None:
        """See ``track.tracker.Tracker.warm``."""
        points = np.random.default_rng(0).normal(0, 15, (self.model.config.scene.cloud.n_points, 3))
        cloud = SensorCloud(points + [0, 0, 150])
        with suppress(NoEstimate):  # it is no organ
            self.follow(cloud, None, Following())

    def _located(
        self, cloud: SensorCloud, box: Box | None, grid: int, seed: int, rng: np.random.Generator
    ) -> Estimate:
        """``box``: where the organ can lie; found out where it is None."""
        seconds: dict[str, float] = {}
        check_cloud(cloud)
        thinned = thin_cloud(cloud, self.model.config.scene.cloud.n_points, rng)
        with stage(seconds, "encode", self._device):
            latent = self._encode(thinned)
        if box is None:
            with stage(seconds, "coarse", self._device):
                box = self._coarse_box(latent, cloud, rng)
        with stage(seconds, "fit", self._device):
            distances = surface_distances(
                lambda points: self._logits(latent, points), box, thinned.points_mm
            )
            spread = spread_mm(thinned.points_mm)
            check_familiar(self.model.familiar, spread, fit_mm(distances))
        with stage(seconds, "fine", self._device):
            inside = self._fine(latent, box, cloud.stamp_ns, rng)
            if len(inside.points_mm) < FEWEST_INSIDE:
                raise NoEstimate("no organ was found: it has left the place where it was.")
        with stage(seconds, "volume", self._device):
            camera_from_index, shape = grid_over(inside.points_mm, grid)
            margins, found = sparse_margins(
                lambda points: self._logits(latent, points), camera_from_index, shape
            )
        with stage(seconds, "surfaces", self._device):
            labels = keep_largest_pieces(found, len(self.model.parts))
            inside = drop_islands(inside, found, labels, camera_from_index)
            meshes = part_surfaces(margins, labels, camera_from_index, self.model.parts)
        volume = CameraLabels(labels, camera_from_index)
        report = {
            **report_head(cloud, seed),
            "voxel_mm": float(camera_from_index[0, 0]),
            "fit_mm": fit_report(distances),
            "parts": describe_parts(self.model.parts, meshes, inside),
            "timings": {**seconds, "total": sum(seconds.values())},
        }
        return Estimate(inside, volume, meshes, report)

    def _encode(self, cloud: SensorCloud) -> Latent:
        points = torch.tensor(cloud.points_mm, device=self._device)[None]
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16):
            return self._network.encode(points)

    def _coarse_box(self, latent: Latent, cloud: SensorCloud, rng: np.random.Generator) -> Box:
        lower, upper = self.model.query_box_mm + np.median(cloud.points_mm, axis=0)
        points = rng.uniform(lower, upper, (COARSE_QUERIES, 3)).astype(np.float32)
        inside = points[self._logits(latent, points).argmax(-1).cpu().numpy() > 0]
        if len(inside) < FEWEST_INSIDE:
            raise NoEstimate(
                f"no organ was found: {len(inside)} of {COARSE_QUERIES} queries round the cloud "
                "lie inside. Does the cloud show this model's organ, freed of its background?"
            )
        gap = float((np.prod(upper - lower) / COARSE_QUERIES) ** (1 / 3))
        low, high = inside.min(0), inside.max(0)
        margin = 0.05 * (high - low) + gap / 2
        return np.stack([low - margin, high + margin])

    def _fine(
        self, latent: Latent, box: Box, stamp_ns: int, rng: np.random.Generator
    ) -> OccupancyCloud:
        points = rng.uniform(box[0], box[1], (FINE_QUERIES, 3)).astype(np.float32)
        best = self._logits(latent, points).softmax(-1).max(-1)
        probability, labels = best.values.cpu().numpy(), best.indices.cpu().numpy()
        inside = labels > 0
        return OccupancyCloud(points[inside], labels[inside], probability[inside], stamp_ns)

    def _logits(self, latent: Latent, points_mm: Float32[np.ndarray, "n 3"]) -> torch.Tensor:
        """(n, classes), float32, on the model's device."""
        queries = torch.tensor(points_mm, device=self._device)[None]
        size = CHUNK * torch.get_num_threads() if self._device.type == "cpu" else 2**17
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16):
            chunks = [self._network.query(latent, part)[0] for part in queries.split(size, dim=1)]
        return torch.cat(chunks).float()
