"""How good a network is on scenes it does not train on, and where organs lie in them."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float64

from tumortrack.core.types import Anatomy
from tumortrack.learn.config import TrainConfig
from tumortrack.learn.network import OccupancyNetwork
from tumortrack.simulate.occupancy import OccupancyPool
from tumortrack.simulate.scene import SceneRecipe, Simulator

_AT_ONCE = 32  # scenes


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
    ) -> None:
        simulator = Simulator(anatomy_ct, up_lps, config.scene)
        vertices = anatomy_ct.organ.vertices_mm
        clouds, points, labels, boxes = [], [], [], []
        for index in range(config.validation_pairs):
            recipe = SceneRecipe(seed, "validation", index)
            stage = simulator.stage(recipe)
            drawn, answer = pool.draw_evenly(recipe.generator(999), config.validation_points)
            clouds.append(stage.cloud.points_mm)
            points.append(stage.carry(drawn))
            labels.append(answer)
            observed = stage.cloud.points_mm
            organ = stage.carry(vertices) - np.median(observed, axis=0)
            boxes.append((organ.min(0), organ.max(0)))
        n = min(map(len, clouds))
        self._clouds = torch.from_numpy(np.stack([c[:n] for c in clouds])).to(device)
        self._points = torch.from_numpy(np.stack(points)).to(device)
        self._labels = torch.from_numpy(np.stack(labels)).to(device)
        self._n_classes = len(anatomy_ct.parts) + 1
        self.query_box_mm = _grown(np.array(boxes, float))

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


def _grown(boxes_mm: Float64[np.ndarray, "s 2 3"]) -> Float64[np.ndarray, "2 3"]:
    """The box of all the boxes, 10 % larger."""
    lower, upper = boxes_mm[:, 0].min(0), boxes_mm[:, 1].max(0)
    return np.stack([lower - 0.05 * (upper - lower), upper + 0.05 * (upper - lower)])
