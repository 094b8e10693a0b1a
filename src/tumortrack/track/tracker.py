"""Sensor cloud -> estimate: the whole method in the order in which it happens."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float, Float32

import tumortrack
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.types import CameraLabels, OccupancyCloud, SensorCloud
from tumortrack.learn.fit import check_familiar, fit_mm, spread_mm, surface_distances
from tumortrack.learn.model import Model, has_fast_bfloat16
from tumortrack.learn.network import Latent
from tumortrack.sense.cloud import check_cloud, thin_cloud
from tumortrack.track.estimate import Estimate
from tumortrack.track.volume import (
    dense_margins,
    describe_parts,
    drop_islands,
    grid_over,
    keep_largest_pieces,
    part_surfaces,
)

COARSE_QUERIES = 10_000
FINE_QUERIES = 40_000
FEWEST_INSIDE = 20  # of the coarse queries: fewer are no organ
LARGEST_GRID = 400
CHUNK = 2048  # queries at once and core: their activations stay in its cache

Box = Float[np.ndarray, "2 3"]


class Tracker:
    """Locates the organ and tumors of one model in sensor clouds (camera frame, mm)."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._network = model.network.folded()
        self._device = next(model.network.parameters()).device
        self._bf16 = has_fast_bfloat16(self._device)

    @property
    def organ_box_ct(self) -> Box | None:
        """The organ's box in the CT (LPS, mm: lower and upper corner) if this model's estimates
        have a motion; None for models that know no correspondences."""
        return None

    @torch.inference_mode()
    def locate(self, cloud: SensorCloud, grid: int = 160, seed: int = 0) -> Estimate:
        """Everything about one cloud; the same cloud and seed give the same answer.

        The two passes of queries follow the follow-up (LUDO): 10,000 coarse ones where the organ
        can be, then 40,000 in the box of those inside, enlarged. ``grid``: voxels along the
        longest side of the dense volume.

        Raises:
            NoEstimate: too few points, no organ found in them, or they do not show this model's.
            InputError: the cloud is in metres; the seed is negative.
        """
        if seed < 0:
            raise InputError(f"the seed is {seed}; it must be 0 or more.")
        rng = np.random.default_rng(seed)
        seconds: dict[str, float] = {}
        check_cloud(cloud)
        thinned = thin_cloud(cloud, self.model.config.scene.cloud.n_points, rng)
        with self._timed(seconds, "encode"):
            latent = self._encode(thinned)
        with self._timed(seconds, "coarse"):
            box = self._coarse_box(latent, cloud, rng)
        with self._timed(seconds, "fit"):
            distances = surface_distances(
                lambda points: self._logits(latent, points), box, thinned.points_mm
            )
            spread = spread_mm(thinned.points_mm)
            check_familiar(self.model.familiar, spread, fit_mm(distances))
        with self._timed(seconds, "fine"):
            inside = self._fine(latent, box, cloud.stamp_ns, rng)
        with self._timed(seconds, "volume"):
            camera_from_index, shape = grid_over(inside.points_mm, grid)
            margins, found = dense_margins(
                lambda points: self._logits(latent, points), camera_from_index, shape
            )
        with self._timed(seconds, "surfaces"):
            labels = keep_largest_pieces(found, len(self.model.parts))
            inside = drop_islands(inside, found, labels, camera_from_index)
            meshes = part_surfaces(margins, labels, camera_from_index, self.model.parts)
        volume = CameraLabels(labels, camera_from_index)
        report = {
            "tumortrack": tumortrack.__version__,
            "units": "mm",
            "frame": "camera",
            "stamp_ns": cloud.stamp_ns,
            "seed": seed,
            "points": len(cloud.points_mm),
            "voxel_mm": float(camera_from_index[0, 0]),
            "fit_mm": {
                "median": float(np.median(distances)),
                "p95": float(np.percentile(distances, 95)),
            },
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

    @contextmanager
    def _timed(self, seconds: dict[str, float], stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        if self._device.type == "cuda":  # kernels run on behind the call
            torch.cuda.synchronize(self._device)
        seconds[stage] = time.perf_counter() - start
