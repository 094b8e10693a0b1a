"""Deformations, one file per model, and chains of them.

A model's configuration samples parameters from the camera's view (``sample``); the sampled
deformation is a value that maps any point of the CT frame to its new place (``apply``) and can be
recorded (``record``). To add one here: write its file, and add its configuration to the union in
``installed``. Other packages add theirs by an entry point, see there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tumortrack.core.config import Config
from tumortrack.simulation.deform import installed
from tumortrack.simulation.deform.base import Deformation, Points, View
from tumortrack.simulation.deform.drag import DragConfig
from tumortrack.simulation.deform.elastic import ElasticConfig
from tumortrack.simulation.deform.stretch import StretchConfig

__all__ = ["ChainConfig", "DragConfig", "ElasticConfig", "StretchConfig"]


@dataclass(frozen=True)
class Chain:
    """Deformations applied one after the other."""

    links: tuple[Deformation, ...]

    def apply(self, points_ct: Points) -> Points:
        for link in self.links:
            points_ct = link.apply(points_ct)
        return points_ct

    def record(self) -> dict[str, Any]:
        return {"kind": "chain", "links": [link.record() for link in self.links]}


class ChainConfig(Config, frozen=True, tag="chain"):
    """Each link is sampled from the view of the undeformed organ; list local ones first."""

    links: tuple[installed.LinkConfig, ...]

    def sample(self, view: View, rng: np.random.Generator) -> Chain:
        return Chain(tuple(link.sample(view, rng) for link in self.links))


def links_of(model: Config) -> tuple[Config, ...]:
    """The links of a chain; any other model alone."""
    return model.links if isinstance(model, ChainConfig) else (model,)
