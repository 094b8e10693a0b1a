"""Several deformations one after the other, or none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tumortrack.core.config import Config
from tumortrack.simulate.deform import installed
from tumortrack.simulate.deform.base import Deformation, Points, View


@dataclass(frozen=True)
class Chain:
    """The first is applied first."""

    links: tuple[Deformation, ...]

    def apply(self, points_ct: Points) -> Points:
        for link in self.links:
            points_ct = link.apply(points_ct)
        return points_ct

    def record(self) -> dict[str, Any]:
        return {"kind": "chain", "links": [link.record() for link in self.links]}


class ChainConfig(Config, frozen=True, tag="chain"):
    """Each link is sampled from the view of the undeformed organ; local ones come first."""

    links: tuple[installed.LinkConfig, ...]

    def sample(self, view: View, rng: np.random.Generator) -> Chain:
        return Chain(tuple(link.sample(view, rng) for link in self.links))


def links_of(model: Config) -> tuple[Config, ...]:
    """A model's links: of one that is no chain, itself."""
    return model.links if isinstance(model, ChainConfig) else (model,)


class Rest:
    """The organ as it was in the CT."""

    def apply(self, points_ct: Points) -> Points:
        return points_ct.astype(np.float32)

    def record(self) -> dict[str, Any]:
        return {"kind": "rest"}


class RestConfig(Config, frozen=True, tag="rest"):
    """The identity, for rigid scenes."""

    def sample(self, view: View, rng: np.random.Generator) -> Rest:
        return Rest()
