"""Loads on the organ of a simulated scene: solved for a few depths, interpolated in between.

A state is an equilibrium of ``elastic``: coefficients of the body's modes and a small rigid motion
on the bed. Between solved depths the unknowns follow a monotone cubic (PCHIP: Fritsch and Carlson
1980, doi 10.1137/0717021), so that nothing overshoots and nothing jumps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import PchipInterpolator

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import perpendicular
from tumortrack.simulate.elastic.equilibrium import ReducedModel
from tumortrack.simulate.elastic.loads import in_bed, indent

_DEPTHS = 7
_FOOT_MM = 2.0  # the tissue is held down this far beyond the instrument's radius
_FACING = 0.85  # least cosine between an indented place's normal and up
_RISE_DEGREES = 50.0  # of an instrument's shaft over the surface
_SIDES = 24  # from which it may come


@dataclass(frozen=True, eq=False)
class Bed:
    """An organ of fixed tissue on a fixed bed, both drawn by a seed, that takes loads."""

    organ: ReducedModel
    up: Float64[np.ndarray, " 3"]
    seed: int

    def under(self, what: str, load: Callable[..., None], *how: object) -> np.ndarray:
        """The unknowns at rest under a load of ``elastic.loads`` with its arguments; ``what`` names
        it in the error.

        Raises:
            InputError: this organ finds no equilibrium.
        """
        problem = in_bed(self.organ, self.up, np.random.default_rng([self.seed, 0xBED]))
        load(problem, *how)
        found = problem.equilibrium()
        if found is None:
            raise InputError(
                f"the organ does not come to rest under {what}; choose another seed. If that does "
                "not help, look at the case's pictures."
            )
        return found


@dataclass(frozen=True, eq=False)
class Indentation:
    """One place of the surface under an instrument; CT frame.

    Attributes:
        place_ct: the place at rest.
        axis: unit vector from the instrument's tip along its shaft.
        unknowns: of the body's modes and rigid motions, for a depth in mm.
    """

    place_ct: Float64[np.ndarray, " 3"]
    axis: Float64[np.ndarray, " 3"]
    unknowns: Callable[[float], Float64[np.ndarray, " m"]]


def indentations(
    bed: Bed, count: int, radius_mm: float, deepest_mm: float, rng: np.random.Generator
) -> tuple[Indentation, ...]:
    """Indentations of ``count`` different places that face up, by an instrument of that radius.

    Raises:
        InputError: an organ with fewer such places, or one that finds no equilibrium.
    """
    patches = bed.organ.patches
    facing = np.flatnonzero(patches.normals @ bed.up > _FACING)
    if len(facing) < count:
        raise InputError(
            f"only {len(facing)} places of the organ face the camera, {count} are to be pushed; "
            "ask for fewer."
        )
    points = patches.points_mm[facing]
    chosen = [int(rng.integers(len(facing)))]  # farthest point sampling
    distance = np.full(len(facing), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return tuple(_indentation(bed, int(n), radius_mm, deepest_mm) for n in facing[chosen])


def _indentation(bed: Bed, patch: int, radius_mm: float, deepest_mm: float) -> Indentation:
    points, outward = bed.organ.patches.points_mm, bed.organ.patches.normals[patch]
    depths, how = np.linspace(0, deepest_mm, _DEPTHS), (patch, outward, radius_mm + _FOOT_MM)
    states = np.stack([bed.under("poke", indent, *how, depth) for depth in depths.tolist()])
    axis = _clearest_axis(points, points[patch], outward)
    return Indentation(points[patch], axis, PchipInterpolator(depths, states - states[0]))


def _clearest_axis(points: np.ndarray, tip: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """The direction of a shaft that stays farthest from the organ, of those of equal rise."""
    one = perpendicular(outward)
    other = np.cross(outward, one)
    rise = np.deg2rad(_RISE_DEGREES)
    offset = points - tip
    best, widest = outward, -np.inf
    for angle in np.arange(_SIDES) * 2 * np.pi / _SIDES:
        aside = np.cos(angle) * one + np.sin(angle) * other
        axis = np.sin(rise) * outward + np.cos(rise) * aside
        along = offset @ axis
        apart = np.linalg.norm(offset - np.outer(along, axis), axis=1)
        gap = (apart[along > 10] / along[along > 10]).min(initial=np.inf)
        if gap > widest:
            best, widest = axis, gap
    return best
