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
from tumortrack.simulate.elastic.loads import in_bed, indent
from tumortrack.simulate.elastic.modes import ReducedModel

_DEPTHS = 7
_FOOT_MM = 2.0  # the tissue is held down this far beyond the instrument's radius
_FACING = 0.85  # least cosine between an indented place's normal and up
_RISE_DEGREES = 50.0  # of an instrument's shaft over the surface
_SIDES = 24  # from which it may come


@dataclass(frozen=True, eq=False)
class Indentation:
    """One place of the surface under an instrument; CT frame."""

    place_ct: Float64[np.ndarray, " 3"]  # at rest
    axis: Float64[np.ndarray, " 3"]  # unit vector from the instrument's tip along its shaft
    unknowns: Callable[[float], Float64[np.ndarray, " m"]]  # for a depth in mm


@dataclass(frozen=True, eq=False)
class Bed:
    """An organ of fixed tissue on a fixed bed, both drawn by a seed, that takes loads."""

    organ: ReducedModel
    up: Float64[np.ndarray, " 3"]
    seed: int

    def under(self, what: str, load: Callable[..., None], *how: object) -> np.ndarray:
        """The unknowns at rest under a load of ``elastic.loads`` with its arguments; InputError,
        naming ``what``, where there is no equilibrium."""
        problem = in_bed(self.organ, self.up, np.random.default_rng([self.seed, 0xBED]))
        load(problem, *how)
        found = problem.equilibrium()
        if found is None:
            raise InputError(
                f"the organ does not come to rest under {what}; choose another seed. If that does "
                "not help, look at the case's pictures."
            )
        return found

    def indentations(
        self, count: int, radius_mm: float, deepest_mm: float, rng: np.random.Generator
    ) -> list[Indentation]:
        """Indentations of ``count`` different places that face up, by an instrument of that radius;
        InputError where the organ has fewer, or finds no equilibrium."""
        places, normals = self.organ.patches.points_mm, self.organ.patches.normals
        facing = np.flatnonzero(normals @ self.up > _FACING)
        if len(facing) < count:
            raise InputError(
                f"only {len(facing)} places of the organ face the camera, {count} are to be "
                "pushed; ask for fewer."
            )
        points = places[facing]
        chosen = [int(rng.integers(len(facing)))]  # farthest point sampling
        distance = np.full(len(facing), np.inf)
        while len(chosen) < count:
            distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
            chosen.append(int(np.argmax(distance)))
        made, depths = [], np.linspace(0, deepest_mm, _DEPTHS)
        for patch in facing[chosen].tolist():
            how = patch, normals[patch], radius_mm + _FOOT_MM
            states = [self.under("poke", indent, *how, depth) for depth in depths.tolist()]
            unknowns = PchipInterpolator(depths, np.stack(states) - states[0])
            axis = _clearest_axis(places - places[patch], normals[patch])
            made.append(Indentation(places[patch], axis, unknowns))
        return made


def _clearest_axis(offset_mm: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """The direction of a shaft that stays farthest from the organ, of those of equal rise;
    ``offset_mm``: of the organ's places from the shaft's tip."""
    one = perpendicular(outward)
    other, rise = np.cross(outward, one), np.deg2rad(_RISE_DEGREES)

    def gap(axis: np.ndarray) -> float:
        along = offset_mm @ axis
        apart = np.linalg.norm(offset_mm - np.outer(along, axis), axis=1)
        return float((apart[along > 10] / along[along > 10]).min(initial=np.inf))

    turns = np.arange(_SIDES) * 2 * np.pi / _SIDES
    aside = [np.cos(angle) * one + np.sin(angle) * other for angle in turns]
    return max((np.sin(rise) * outward + np.cos(rise) * way for way in aside), key=gap)
