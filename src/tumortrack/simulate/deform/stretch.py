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

from tumortrack.core.compiled import njit
from tumortrack.core.config import Config
from tumortrack.simulate.deform.base import Points, View


@dataclass(frozen=True, eq=False)
class Stretch:
    """x -> centre + matrix (x - centre) + sagitta ((x - centre) . along / reach)^2 across."""

    centre_ct: Float64[np.ndarray, " 3"]
    matrix: Float64[np.ndarray, "3 3"]
    along: Float64[np.ndarray, " 3"]
    across: Float64[np.ndarray, " 3"]  # unit, at right angles to ``along``
    sagitta_mm: float
    reach_mm: float

    def apply(self, points_ct: Points) -> Float32[np.ndarray, "n 3"]:
        bend = self.along / self.reach_mm, self.sagitta_mm * self.across
        return _moved(points_ct, self.centre_ct, self.matrix, *bend)

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


@njit(nogil=True)
def _moved(points, centre, matrix, along, bend):  # type: ignore[no-untyped-def]
    """One pass over the points, five times as fast as NumPy with its array per term."""
    out = np.empty(points.shape, np.float32)
    cx, cy, cz = centre
    ax, ay, az = along
    bx, by, bz = bend
    for i in range(len(points)):
        x, y, z = points[i, 0] - cx, points[i, 1] - cy, points[i, 2] - cz
        reach = x * ax + y * ay + z * az
        far = reach * reach
        x, y, z = x + far * bx, y + far * by, z + far * bz
        out[i, 0] = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + cx
        out[i, 1] = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + cy
        out[i, 2] = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + cz
    return out
