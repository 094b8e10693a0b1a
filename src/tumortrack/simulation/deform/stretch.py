"""Global, volume-preserving deformation: squeeze along one axis, bulge across it, and bend.

Ours, not the paper's: drags of single vertices never flatten or bend an organ as a whole, as
plates, gravity and a pushing instrument do. Both maps preserve volume: the stretch has determinant
1, and the bend moves points at right angles to the direction on which its amount depends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from tumortrack.core.config import Config
from tumortrack.simulation.deform.base import Points, View


@dataclass(frozen=True, eq=False)
class Stretch:
    """x -> centre + matrix (x - centre + sagitta ((x - centre) . along / reach)^2 across)."""

    centre_ct: Float64[np.ndarray, " 3"]
    matrix: Float64[np.ndarray, "3 3"]
    along: Float64[np.ndarray, " 3"]
    across: Float64[np.ndarray, " 3"]  # unit, at right angles to ``along``
    sagitta_mm: float
    reach_mm: float

    def apply(self, points_ct: Points) -> Float32[np.ndarray, "n 3"]:
        offset = np.asarray(points_ct, np.float64) - self.centre_ct
        reach = (offset @ self.along / self.reach_mm)[:, None]
        bent = offset + self.sagitta_mm * reach**2 * self.across
        return (bent @ self.matrix.T + self.centre_ct).astype(np.float32)

    def record(self) -> dict[str, Any]:
        numbers = {name: np.asarray(value).tolist() for name, value in vars(self).items()}
        return {"kind": "stretch"} | numbers


class StretchConfig(Config, frozen=True, tag="stretch"):
    """``thinnest``, ``thickest``: smallest and largest stretch along a random axis (1 keeps the
    length); ``sagitta_mm``: largest bend at the organ's end."""

    thinnest: float = 0.78
    thickest: float = 1.1
    sagitta_mm: float = 8.0

    def sample(self, view: View, rng: np.random.Generator) -> Stretch:
        """Draw axes uniformly on the sphere, stretch and bend uniformly within their ranges."""
        from scipy.spatial.transform import Rotation  # slow to import

        lower, upper = view.anatomy_ct.organ.box_mm
        axes = Rotation.random(rng=rng).as_matrix()
        stretch = rng.uniform(self.thinnest, self.thickest)
        matrix = axes @ np.diag([stretch, stretch**-0.5, stretch**-0.5]) @ axes.T
        along, across, _ = Rotation.random(rng=rng).as_matrix()
        sagitta_mm = float(rng.uniform(-self.sagitta_mm, self.sagitta_mm))
        reach_mm = float(np.max(upper - lower) / 2)
        return Stretch((lower + upper) / 2, matrix, along, across, sagitta_mm, reach_mm)
