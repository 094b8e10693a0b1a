"""The paper's deformation: visible vertices are dragged, neighbours follow with Gaussian falloff.

Source: the paper, section Localization and table "compare_deformations". The table calls its
third number sigma^2. Its values are 100/3, 50/3, 35/3, 30/3, 20/3 and 10/3: radii of 100 ...
10 mm under the three-sigma rule, so they are standard deviations in mm. Read as variances, most
of the table's drags fold space (a drag is one-to-one only if exp(-1/2) * distance / sigma < 1), so
that labels of folded points are undefined, and configuration 3 moves next to nothing 10 mm below
the surface. ``falloff = "sigma"`` (default) takes the first reading; ``"variance"`` takes the
table's heading literally. See docs/method.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from tumortrack.core.config import Config
from tumortrack.core.errors import TumortrackError
from tumortrack.native import F32, kernel
from tumortrack.simulation.deform.base import Points, View

# (largest distance in mm, falloff, repeats), table "compare_deformations"
Step = tuple[float, float, int]
CONFIGURATIONS: dict[int, tuple[Step, ...]] = {
    1: ((16, 33.3, 1),),
    2: ((16, 33.3, 1), (16, 16.7, 1), (8, 11.7, 1)),
    3: ((8, 11.7, 1), (6, 10, 1), (4, 6.7, 1), (4, 3.3, 5), (2, 3.3, 10)),
    4: ((16, 13.3, 1), (16, 10, 1), (16, 6.7, 1)),
    5: ((10, 33.3, 1), (16, 13.3, 1), (16, 6.7, 1)),
}
CONFIGURATIONS[6] = (*CONFIGURATIONS[2], *CONFIGURATIONS[3][1:])


_SHIFTS = F32["k", 3], F32["k"]  # and their falloffs
# Drags one after the other: points, centres and shifts -> dragged points.
_drag = kernel("drag", F32["n", 3], (F32["k", 3], *_SHIFTS), F32["n", 3].out)
# Where drags start -> their centres, each dragged by those before it.
_drag_centres = kernel("drag_centres", F32["k", 3], (F32["k", 3].out, *_SHIFTS))


@dataclass(frozen=True, eq=False)
class Drags:
    """Successive drags: centre (CT frame, after the drags before), shift, falloff; all in mm."""

    centres_ct: Float32[np.ndarray, "k 3"]
    shifts_mm: Float32[np.ndarray, "k 3"]
    sigmas_mm: Float32[np.ndarray, " k"]

    def apply(self, points_ct: Points) -> Float32[np.ndarray, "n 3"]:
        points = np.ascontiguousarray(points_ct, np.float32)
        out = np.empty_like(points)
        _drag(points, (self.centres_ct, self.shifts_mm, self.sigmas_mm), out)
        return out

    def record(self) -> dict[str, Any]:
        return {"kind": "drag"} | {name: value.tolist() for name, value in vars(self).items()}


class DragConfig(Config, frozen=True, tag="drag"):
    """Drags of visible vertices, by default the table's configuration 3; without steps the organ
    stays undeformed."""

    steps: tuple[Step, ...] = CONFIGURATIONS[3]
    falloff: Literal["sigma", "variance"] = "sigma"

    def sample(self, view: View, rng: np.random.Generator) -> Drags:
        """Draw centres uniformly among the visible vertices of the undeformed organ, distances
        uniformly up to the step's, directions uniformly on the sphere."""
        steps = [(d, s) for d, s, times in self.steps for _ in range(times)]
        distances, sigmas = np.array(steps, float).reshape(-1, 2).T
        if self.falloff == "variance":
            sigmas = np.sqrt(sigmas)
        start = _visible_vertices(view, len(steps), rng).astype(np.float32)
        directions = rng.normal(size=(len(steps), 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        shifts = directions * (distances * rng.uniform(size=len(steps)))[:, None]
        shifts_mm, sigmas_mm = shifts.astype(np.float32), sigmas.astype(np.float32)
        return Drags(_centres(start, shifts_mm, sigmas_mm), shifts_mm, sigmas_mm)


def _visible_vertices(view: View, count: int, rng: np.random.Generator) -> np.ndarray:
    vertices = view.anatomy_ct.organ.vertices_mm
    chosen = np.empty((0, 3))
    for _ in range(100):
        if len(chosen) >= count:
            return chosen[:count]
        drawn = vertices[rng.integers(len(vertices), size=4 * count)]
        chosen = np.concatenate([chosen, drawn[view.visible(drawn)]])
    raise TumortrackError("the camera sees none of the organ's vertices; check the pose range.")


def _centres(start: np.ndarray, shifts: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """A vertex is dragged from where earlier drags left it."""
    centres = np.empty_like(start)
    _drag_centres(start, (centres, shifts, sigmas))
    return centres
