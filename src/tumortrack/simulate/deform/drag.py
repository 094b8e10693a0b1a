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

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from tumortrack.core.compiled import njit
from tumortrack.core.config import Config
from tumortrack.core.errors import TumortrackError
from tumortrack.simulate.deform.base import Points, View

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


@dataclass(frozen=True, eq=False)
class Drags:
    """Successive drags: centre (CT frame, after the drags before), shift, falloff; all in mm."""

    centres_ct: Float32[np.ndarray, "k 3"]
    shifts_mm: Float32[np.ndarray, "k 3"]
    sigmas_mm: Float32[np.ndarray, " k"]

    def apply(self, points_ct: Points) -> Float32[np.ndarray, "n 3"]:
        return _drag(points_ct.astype(np.float32), self.centres_ct, self.shifts_mm, self.sigmas_mm)

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


_BLOCK = 1024  # points whose coordinates stay in the L1 cache through all drags
_SMALLEST = np.float32(-12.0)  # exponents below, factors of 6e-6, count as zero
_LOG2_E = np.float32(1.4426950408889634)
# 2^r = sum of (r ln 2)^k / k!, within 1.2e-7 for r in -0.5 ... 0.5
_T1, _T2, _T3, _T4, _T5, _T6 = (
    np.float32(math.log(2) ** k / math.factorial(k)) for k in range(1, 7)
)


# Fast math: the last digits (1e-5 mm) may depend on the processor, so that a scene replays bit for
# bit on the machine that made it, and elsewhere to that precision.
@njit(nogil=True, fastmath=True, inline="always")
def _exp(x):  # type: ignore[no-untyped-def]
    """exp(x) for -80 < x <= 0. Unlike the C library's it is vectorized over points."""
    binary = x * _LOG2_E
    whole = np.floor(binary + np.float32(0.5))
    r = binary - whole
    power = r * (_T1 + r * (_T2 + r * (_T3 + r * (_T4 + r * (_T5 + r * _T6)))))
    exponent = (np.int32(whole) + np.int32(127)) << np.int32(23)
    return (np.float32(1.0) + power) * np.int32(exponent).view(np.float32)


@njit(nogil=True, fastmath=True, inline="always")
def _carry(points, centres, shifts, sigmas, out):  # type: ignore[no-untyped-def]
    n = len(points)
    x, y, z = np.empty((3, min(n, _BLOCK)), np.float32)
    for start in range(0, n, _BLOCK):
        size = min(_BLOCK, n - start)
        for i in range(size):
            x[i], y[i], z[i] = points[start + i]
        for k in range(len(centres)):
            scale = np.float32(-0.5) / (sigmas[k] * sigmas[k])
            cx, cy, cz = centres[k]
            sx, sy, sz = shifts[k]
            for i in range(size):
                dx, dy, dz = x[i] - cx, y[i] - cy, z[i] - cz
                exponent = scale * (dx * dx + dy * dy + dz * dz)
                factor = _exp(max(exponent, _SMALLEST))
                factor = factor if exponent > _SMALLEST else np.float32(0.0)
                x[i] += factor * sx
                y[i] += factor * sy
                z[i] += factor * sz
        for i in range(size):
            out[start + i, 0], out[start + i, 1], out[start + i, 2] = x[i], y[i], z[i]


# Neither of the next two calls the other: whether a call is inlined, which in fast math moves last
# digits, depends on whether this process compiled them or loaded them from numba's cache.
@njit(nogil=True, fastmath=True)
def _drag(points, centres, shifts, sigmas):  # type: ignore[no-untyped-def]
    out = np.empty_like(points)
    _carry(points, centres, shifts, sigmas, out)
    return out


@njit(nogil=True, fastmath=True)
def _centres(start, shifts, sigmas):  # type: ignore[no-untyped-def]
    """A vertex is dragged from where earlier drags left it."""
    centres = start.copy()
    for k in range(1, len(start)):
        _carry(start[k : k + 1], centres[:k], shifts[:k], sigmas[:k], centres[k : k + 1])
    return centres
