"""What is done to the organ: solved beforehand in a few key states, interpolated in time.

A state is what ``elastic.settle`` finds: coefficients of the body's modes and a small rigid motion
on the bed. Between key states the unknowns follow a monotone cubic (PCHIP: Fritsch and Carlson
1980, doi 10.1137/0717021), so that nothing overshoots and nothing jumps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import PchipInterpolator

from tumortrack.core.errors import InputError
from tumortrack.simulate.elastic.loads import Load, Poke, Swell, bedded
from tumortrack.simulate.elastic.settle import ReducedModel, settle

_KEY_STATES = 7
_FOOT_MM = 2.0  # the tissue is held down so far beyond the instrument's radius
_FACING = 0.85  # least cosine between a pushed place's normal and up
_RISE_DEGREES = 50.0  # of an instrument's shaft over the surface
_SIDES = 24  # from which it may come


@dataclass(frozen=True, eq=False)
class Push:
    """One place of the surface under an instrument; CT frame.

    Attributes:
        place_ct: the place at rest.
        outward: unit vector against which it is pressed.
        axis: unit vector from the instrument's tip along its shaft.
        unknowns: of the body's modes and rigid motions, for a depth in mm.
    """

    place_ct: Float64[np.ndarray, " 3"]
    outward: Float64[np.ndarray, " 3"]
    axis: Float64[np.ndarray, " 3"]
    unknowns: Callable[[float], Float64[np.ndarray, " m"]]


class Bed:
    """An organ of fixed tissue on a fixed bed, both drawn by a seed, that takes loads."""

    def __init__(self, organ: ReducedModel, up: Float64[np.ndarray, " 3"], seed: int) -> None:
        self.organ, self.up = organ, up
        self._seed = seed

    def under(self, load: Load) -> Float64[np.ndarray, " m"]:
        """The unknowns at rest under a load.

        Raises:
            InputError: this organ comes to no rest.
        """
        problem = bedded(self.organ, self.up, np.random.default_rng([self._seed, 0xBED]))
        load.add(problem)
        found = settle(problem)
        if found is None:
            raise InputError(
                f"the organ does not come to rest under {type(load).__name__.lower()}; choose "
                "another seed. If that does not help, look at the case's pictures."
            )
        return found


def swollen(bed: Bed, strain: float) -> Float64[np.ndarray, " m"]:
    """The unknowns of an organ whose volume grew by a strain, less what hinders it."""
    return bed.under(Swell(strain))


def pushes_on(
    bed: Bed, count: int, radius_mm: float, deepest_mm: float, rng: np.random.Generator
) -> tuple[Push, ...]:
    """Pushes at ``count`` different places that face up, by an instrument of that radius.

    Raises:
        InputError: an organ with fewer such places, or one that comes to no rest.
    """
    patches = bed.organ.patches
    facing = np.flatnonzero(patches.normals @ bed.up > _FACING)
    if len(facing) < count:
        raise InputError(
            f"only {len(facing)} places of the organ face the camera, {count} are to be pushed; "
            "ask for fewer."
        )
    chosen = _apart(patches.points_mm[facing], count, rng)
    return tuple(_push(bed, int(n), radius_mm, deepest_mm) for n in facing[chosen])


def _push(bed: Bed, patch: int, radius_mm: float, deepest_mm: float) -> Push:
    place, outward = bed.organ.patches.points_mm[patch], bed.organ.patches.normals[patch]
    depths = np.linspace(0, deepest_mm, _KEY_STATES)
    states = np.stack(
        [
            bed.under(Poke.at(bed.organ, patch, outward, radius_mm + _FOOT_MM, depth))
            for depth in depths.tolist()
        ]
    )
    axis = _way_out(bed.organ.patches.points_mm, place, outward)
    return Push(place, outward, axis, PchipInterpolator(depths, states - states[0]))


def _apart(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Farthest point sampling from a random start."""
    chosen = [int(rng.integers(len(points)))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)


def _way_out(points: np.ndarray, tip: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """The direction of a shaft that keeps farthest from the organ, of those that rise alike."""
    one = np.cross(outward, np.eye(3)[np.argmin(np.abs(outward))])
    one /= np.linalg.norm(one)
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
