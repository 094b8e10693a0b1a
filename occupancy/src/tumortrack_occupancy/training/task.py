"""What an occupancy network learns, how it is validated, and the model that results."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from torch.nn import functional

from tumortrack.case.symmetry import ambiguous, half_turns
from tumortrack.core.errors import NoEstimate
from tumortrack.core.mesh_query import thinned
from tumortrack.registration.in_distribution import InDistributionRange, fit_mm, spread_mm
from tumortrack.simulation.scene import SceneRecipe, Simulator, body_for
from tumortrack_occupancy.model import OccupancyModel
from tumortrack_occupancy.network import Latent, OccupancyNetwork
from tumortrack_occupancy.training.query_points import OccupancyPool
from tumortrack_occupancy.training.state import TrainingRun
from tumortrack_occupancy.training.stream import refill
from tumortrack_occupancy.volume import FIT_STEPS, lattice_over, surface_distances

_AT_ONCE = 32  # scenes
_FIT_ON = 32  # scenes
_QUERIES = 2**13  # at once: bounds the memory


class OccupancyTask:
    """Labels of points near surfaces, as in the paper. ``points``: labelled points for training
    scenes, which show ``shown_ct``; ``body``: the elastic body, if they need it. Raises InputError:
    a part is too small to be learnt."""

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self._run, self._device = run, device
        self.points = OccupancyPool(run.anatomy_ct, run.config.scene.occupancy, run.seed)
        organ, *tumors = run.anatomy_ct.parts
        shown = thinned(organ, run.config.cell_mm) if run.config.cell_mm else organ
        self.shown_ct = run.anatomy_ct.with_parts([shown, *tumors])
        self.body = body_for(run.anatomy_ct, run.up_lps, run.config.scene, run.seed)

    @torch.no_grad()
    def validate(self, network: OccupancyNetwork) -> tuple[float, float]:
        """Over all points of the validation scenes: cross-entropy, and mean IoU of the parts
        (organ, tumors; not the outside)."""
        network.eval()
        arrays = self._scenes.clouds_mm, self._scenes.points_mm
        batches = (torch.from_numpy(v).to(self._device).split(_AT_ONCE) for v in arrays)
        logits = torch.cat([network(*pair).cpu() for pair in zip(*batches, strict=True)])
        labels = torch.from_numpy(self._scenes.labels.astype(np.int64))
        loss = float(functional.cross_entropy(logits.flatten(0, 1), labels.flatten()))
        n_classes = len(self._run.anatomy_ct.parts) + 1
        pairs = logits.argmax(-1).numpy().ravel() * n_classes + self._scenes.labels.ravel()
        confusion = np.bincount(pairs, minlength=n_classes**2).reshape(n_classes, n_classes)
        intersection = confusion.diagonal()
        union = confusion.sum(0) + confusion.sum(1) - intersection
        return loss, float((intersection / np.maximum(union, 1))[1:].mean())

    @torch.no_grad()
    def model(self, network: OccupancyNetwork, provenance: dict[str, Any]) -> OccupancyModel:
        """The finished model of the network."""
        network.eval()
        scenes, spreads, fits = self._scenes, list[float](), list[float]()
        for points_mm, box_mm in zip(scenes.clouds_mm[:_FIT_ON], scenes.boxes_mm, strict=False):
            latent = network.encode(torch.from_numpy(points_mm).to(self._device)[None])
            around = grown_box(box_mm[None] + np.median(points_mm, axis=0))
            fit = spread = spread_mm(points_mm)
            with suppress(NoEstimate):  # after a few steps a network finds no organ
                lattice = lattice_over(partial(self._logits, network, latent), around, FIT_STEPS)
                fit = fit_mm(surface_distances(lattice, points_mm))
            spreads.append(spread)
            fits.append(fit)
        if same := ambiguous(half_turns(self._run.anatomy_ct)):
            provenance = {**provenance, "half_turn_mm": same[0].mean_mm}
        return OccupancyModel(
            network=network,
            config=self._run.config,
            parts=self._run.anatomy_ct.names,
            query_box_mm=grown_box(scenes.boxes_mm),
            in_distribution=InDistributionRange(
                spread_mm=(min(spreads), max(spreads)), fit_mm=float(np.percentile(fits, 95))
            ),
            provenance=provenance,
        )

    @cached_property
    def _scenes(self) -> ValidationScenes:
        """The first scenes of the ``validation`` stream."""
        run, config, pool, rows = self._run, self._run.config, self.points.parts[0], []
        simulator = Simulator(run.anatomy_ct, run.up_lps, config.scene, self.body)
        for index in range(config.validation_pairs):
            recipe = SceneRecipe(run.seed, "validation", index)
            scene = simulator.render(recipe)
            points_ct, labels = pool.draw_evenly(recipe.generator(999), config.validation_points)
            observed = scene.cloud.points_mm
            organ = scene.forward(run.anatomy_ct.organ.vertices_mm) - np.median(observed, axis=0)
            box = np.array([organ.min(0), organ.max(0)], float)
            cloud = refill(observed, config.scene.cloud.n_points)
            rows.append((cloud, scene.forward(points_ct), labels, box))
        return ValidationScenes(*(np.stack(column) for column in zip(*rows, strict=True)))

    def _logits(
        self, network: OccupancyNetwork, latent: Latent, queries_mm: np.ndarray
    ) -> torch.Tensor:
        parts = torch.from_numpy(queries_mm).to(self._device)[None].split(_QUERIES, dim=1)
        return torch.cat([network.query(latent, part)[0] for part in parts])


@dataclass(frozen=True, eq=False)
class ValidationScenes:
    """Scenes with points uniform in the organ's enlarged box, so that numbers of points measure
    volumes; camera frame, mm."""

    clouds_mm: Float32[np.ndarray, "s n 3"]
    points_mm: Float32[np.ndarray, "s q 3"]
    labels: UInt8[np.ndarray, "s q"]
    boxes_mm: Float64[np.ndarray, "s 2 3"]  # the organ's, relative to the points' median


def grown_box(boxes_mm: Float64[np.ndarray, "s 2 3"]) -> Float64[np.ndarray, "2 3"]:
    """The bounding box of all boxes, 10 % larger."""
    lower, upper = boxes_mm[:, 0].min(0), boxes_mm[:, 1].max(0)
    return np.stack([lower - 0.05 * (upper - lower), upper + 0.05 * (upper - lower)])
