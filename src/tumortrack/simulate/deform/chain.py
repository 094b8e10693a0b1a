"""Several deformations, one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tumortrack.core.config import Config
from tumortrack.simulate.deform.base import Deformation, View
from tumortrack.simulate.deform.drag import DragConfig
from tumortrack.simulate.deform.elastic import ElasticConfig
from tumortrack.simulate.deform.stretch import StretchConfig


@dataclass(frozen=True)
class Chain:
    """The first is applied first."""

    links: tuple[Deformation, ...]

    def apply(self, points_ct: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        for link in self.links:
            points_ct = link.apply(points_ct)
        return points_ct

    def record(self) -> dict:
        return {"kind": "chain", "links": [link.record() for link in self.links]}


class ChainConfig(Config, frozen=True, tag="chain"):
    """Each link is sampled from the view of the undeformed organ; local ones come first."""

    links: tuple[DragConfig | StretchConfig | ElasticConfig, ...]

    def sample(self, view: View, rng: np.random.Generator) -> Chain:
        return Chain(tuple(link.sample(view, rng) for link in self.links))
