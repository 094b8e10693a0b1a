"""A small ellipsoid with a ball as its tumor, on a coarse lattice."""

from __future__ import annotations

import numpy as np
import trimesh

from tumortrack.core.types import Anatomy, Mesh
from tumortrack.organ.body import BodyConfig

UP = (0.0, -1.0, 0.0)
CENTER = np.array([60.0, -20.0, -900.0])
RADII = np.array([30.0, 24.0, 48.0])
SMALL = BodyConfig(cells=200, modes=20, responses=80, patches=200, states=80)


def organ() -> Anatomy:
    ball = trimesh.creation.icosphere(subdivisions=4)
    whole = Mesh(ball.vertices * RADII + CENTER, ball.faces)
    tumor = Mesh(ball.vertices * 11 + CENTER + [0, -8, 20], ball.faces)
    return Anatomy((whole, tumor))


def bent(anatomy: Anatomy, share: float) -> Anatomy:
    """Thicker towards one end, and bent: with a share of 1 no half turn makes it look the same."""
    middle, half = anatomy.organ.box_mm.mean(0), np.ptp(anatomy.organ.box_mm, axis=0).max() / 2

    def moved(mesh: Mesh) -> Mesh:
        off = mesh.vertices_mm - middle
        end = off[:, 2:] / half
        wider = off * np.where([True, True, False], 1 + 0.5 * share * end, 1)
        return mesh.with_vertices(middle + wider + share * np.array([14.0, 0, 0]) * end**2)

    return Anatomy(tuple(moved(part) for part in anatomy.parts))
