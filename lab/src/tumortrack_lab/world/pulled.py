"""An organ that fat and vessels hold, and whose tumor the cup of a vacuum grasper pulls. Finite
elements, which share nothing with the elastic body of the default method.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tumortrack_lab.twin.apparatus import ApparatusConfig
from tumortrack_lab.twin.equilibrium import Nodes
from tumortrack_lab.twin.solid import NeoHookeanSolid
from tumortrack_lab.world.families import (
    BED_DEPTH_MM,
    GRIP_MN_MM,
    Deformed,
    equilibria,
    log_uniform,
    random_tissue,
    volume_change,
)
from tumortrack_lab.world.forces import Capsule, Force, Springs
from tumortrack_lab.world.organ import Generator, Organ, Stage, Vector

CUP_MM, CUP_LENGTH_MM = 8.0, 20.0  # radius and length of the grasper's cup
_RIM = 0.4  # of the organ's height: below, fat holds it
_BED_KPA, _VESSELS_MN_MM = 5.0, 200.0
_STEP_MM = 2.0  # of the pull, at a time


class Held(NamedTuple):
    """An organ on its bed before the pull. ``steady``: what holds it."""

    organ: Organ
    solid: NeoHookeanSolid
    steady: tuple[Force, ...]

    @classmethod
    def plain(cls, organ: Organ) -> Held:
        """Of even tissue, as that of the twin's apparatus."""
        tissue, mesh = ApparatusConfig(), organ.mesh
        ratio = 1 + (tissue.tumor_ratio - 1) * organ.in_tumor
        shear = tissue.youngs_kpa / (2 * (1 + tissue.poisson)) * ratio
        solid = NeoHookeanSolid(mesh, shear, tissue.poisson)
        return cls(organ, solid, _steady(Stage(organ, solid), _BED_KPA, _VESSELS_MN_MM))

    @classmethod
    def random(cls, organ: Organ, rng: Generator) -> Held:
        """Tissue as of the wider world's, bed and vessels likewise."""
        drawn, solid = random_tissue(organ, organ.mesh, rng)
        bed_kpa, vessels = log_uniform(rng, 0.3, 40.0), log_uniform(rng, 30.0, 600.0)
        steady = _steady(Stage(organ, solid), bed_kpa, vessels)
        if drawn["capsule_mn_mm"] > 0:
            steady = (*steady, Capsule.of(organ.mesh, drawn["capsule_mn_mm"]))
        return cls(organ, solid, steady)

    def pulled(self, grip_mm: Vector, way: Vector, pulls_mm: Sequence[float]) -> list[Deformed]:
        """The states in which the cup, which took the surface's place ``grip_mm`` (bench frame, at
        rest), has moved so far along the unit vector ``way``; from small to large. Raises
        TumortrackError: no equilibrium was found."""
        stage = Stage(self.organ, self.solid)
        patch = stage.patch(grip_mm, CUP_MM)
        keys, done_mm, nodes = [], 0.0, self.organ.mesh.nodes_mm
        for pull_mm in pulls_mm:
            steps = max(1, int(np.ceil((pull_mm - done_mm) / _STEP_MM)))
            ways = np.linspace(done_mm, pull_mm, steps + 1)[1:]
            loads = [(*self.steady, stage.grip(patch, mm * way, GRIP_MN_MM)) for mm in ways]
            nodes = equilibria(self.solid, loads, nodes)[0][-1] if pull_mm > 0 else nodes
            done_mm = pull_mm
            keys.append(self._state(nodes, pull_mm))
        return keys

    def _state(self, nodes: Nodes, pull_mm: float) -> Deformed:
        about = {"pull_mm": pull_mm, "volume_change": volume_change(self.solid, nodes)}
        return Deformed(self.organ, nodes, self.organ.mesh.tets, self._rim_mm, None, about)

    @property
    def _rim_mm(self) -> float:
        return _RIM * float(self.organ.size_mm[2])


def _steady(stage: Stage, bed_kpa: float, vessels_mn_mm: float) -> tuple[Force, ...]:
    """Fat below the rim, and vessels at the hilum."""
    organ = stage.organ
    low = np.flatnonzero(organ.points_mm[:, 2] < _RIM * organ.size_mm[2])
    springs = bed_kpa / BED_DEPTH_MM * organ.areas_mm2[low]
    hilum = stage.grip(stage.patch(organ.hilum_mm, 15.0), np.zeros(3), vessels_mn_mm)
    return Springs(stage.rows(low), organ.points_mm[low], springs), hilum
