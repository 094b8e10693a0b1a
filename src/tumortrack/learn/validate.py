"""How good a network is on scenes it does not train on, and where organs lie in them."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float64

from tumortrack.core.errors import NoEstimate
from tumortrack.core.types import Anatomy
from tumortrack.learn.config import TrainConfig
from tumortrack.learn.fit import Familiar, fit_mm, spread_mm, surface_distances
from tumortrack.learn.network import Latent, OccupancyNetwork
from tumortrack.simulate.dataset import refill
from tumortrack.simulate.elastic.body import Body
from tumortrack.simulate.occupancy import OccupancyPool
from tumortrack.simulate.scene import SceneRecipe, Simulator

_AT_ONCE = 32  # scenes
_FIT_ON = 32  # scenes
_QUERIES = 2**13  # at once: bounds the memory


class ValidationSet:
    """Scenes of the ``validation`` stream with points spread evenly over the organ's enlarged
    box, so that the shares of points are volumes and the mIoU is one of volumes."""

    def __init__(
        self,
        anatomy_ct: Anatomy,
        up_lps: tuple[float, float, float],
        config: TrainConfig,
        pool: OccupancyPool,
        seed: int,
        device: torch.device,
        body: Body | None = None,
    ) -> None:
        simulator = Simulator(anatomy_ct, up_lps, config.scene, body)
        vertices = anatomy_ct.organ.vertices_mm
        clouds, points, labels, boxes = [], [], [], []
        n = config.scene.cloud.n_points
        for index in range(config.validation_pairs):
            recipe = SceneRecipe(seed, "validation", index)
            stage = simulator.stage(recipe)
            drawn, answer = pool.draw_evenly(recipe.generator(999), config.validation_points)
            observed = stage.cloud.points_mm
            clouds.append(refill(observed, n))
            points.append(stage.carry(drawn))
            labels.append(answer)
            organ = stage.carry(vertices) - np.median(observed, axis=0)
            boxes.append((organ.min(0), organ.max(0)))
        self._clouds = torch.from_numpy(np.stack(clouds)).to(device)
        self._points = torch.from_numpy(np.stack(points)).to(device)
        self._labels = torch.from_numpy(np.stack(labels)).to(device)
        self._n_classes = len(anatomy_ct.parts) + 1
        self._boxes_mm = np.array(boxes, float)
        self.query_box_mm = _grown(self._boxes_mm)

    @torch.no_grad()
    def miou(self, network: OccupancyNetwork) -> float:
        """Mean over the parts (organ, tumors; not the outside) of the IoU over all points."""
        n = self._n_classes
        counts = torch.zeros(n * n, dtype=torch.long)
        network.eval()
        for i in range(0, len(self._clouds), _AT_ONCE):
            latent = network.encode(self._clouds[i : i + _AT_ONCE])
            guess = network.query(latent, self._points[i : i + _AT_ONCE]).argmax(-1)
            pairs = guess * n + self._labels[i : i + _AT_ONCE].long()
            counts += torch.bincount(pairs.flatten().cpu(), minlength=n * n)
        table = counts.reshape(n, n).double()
        both = table.diagonal()
        either = table.sum(0) + table.sum(1) - both
        return float((both / either.clamp(min=1))[1:].mean())

    @torch.no_grad()
    def familiar(self, network: OccupancyNetwork) -> Familiar:
        """What the clouds are like, and how far they lie from the surfaces that a network sees."""
        network.eval()
        spreads, fits = [], []
        for cloud, box_mm in zip(self._clouds[:_FIT_ON], self._boxes_mm, strict=False):
            latent = network.encode(cloud[None])
            points_mm = cloud.cpu().numpy()
            around = _grown(box_mm[None] + np.median(points_mm, axis=0))

            def logits_at(queries_mm: np.ndarray, latent: Latent = latent) -> torch.Tensor:
                queries = torch.from_numpy(queries_mm).to(self._clouds.device)[None]
                parts = queries.split(_QUERIES, dim=1)
                return torch.cat([network.query(latent, part)[0] for part in parts])

            spreads.append(spread_mm(points_mm))
            try:
                fits.append(fit_mm(surface_distances(logits_at, around, points_mm)))
            except NoEstimate:  # a network of a few steps sees no organ
                fits.append(spreads[-1])
        return Familiar(
            spread_mm=(min(spreads), max(spreads)), fit_mm=float(np.percentile(fits, 95))
        )


def _grown(boxes_mm: Float64[np.ndarray, "s 2 3"]) -> Float64[np.ndarray, "2 3"]:
    """The box of all the boxes, 10 % larger."""
    lower, upper = boxes_mm[:, 0].min(0), boxes_mm[:, 1].max(0)
    return np.stack([lower - 0.05 * (upper - lower), upper + 0.05 * (upper - lower)])
