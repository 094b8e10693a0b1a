"""Frames known from one another: chains, what is not connected, cycles that do not close."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS, Affine, Points, rigid, transform_points
from tumortrack.core.rigid_fit import kabsch

# Where no error is stated: twice that of calibrations with 3D cameras (arXiv 2311.01335)
_USUAL_MM, _USUAL_DEG, _ROUNDED_MM = 2.0, 0.5, 0.01
_NOT_RIGID, _NEAREST_MM, _FARTHEST_MM = 1e-3, 3.0, 5000.0  # shifts in a room: else another unit
_SPREAD_MM, _TOUCH_MM, _SCATTER_MM = 10.0, 1.0, 4.0  # of places: about a line; at best, at most
_SURE = 3.0  # deviations: four touches, right to 1.5 mm, are then within their bound in 95 of 100
_LARGEST = 1e9  # number, and ratio of lengths, that mean anything
CAMERA = "camera"
_NEGATED = {
    "x and y of {} are negated (RAS for LPS)": RAS_FROM_LPS,
    "y and z of {} are negated (OpenGL's camera for OpenCV's)": np.diag([1.0, -1.0, -1.0, 1.0]),
}


class Link(NamedTuple):
    """``b_from_a``, mm, from ``source``. ``error_mm``, at the place ``at`` (in a), and
    ``error_deg`` are bounds that it states; ``faults``: what is wrong with its numbers."""

    b: str
    a: str
    b_from_a: Affine
    source: str
    error_mm: float | None = None
    error_deg: float = 0.0
    faults: tuple[str, ...] = ()
    at: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def name(self) -> str:
        return f"{self.b}_from_{self.a} ({self.source})"

    def others(self) -> Iterator[tuple[str, Link]]:
        """What it may have been meant as, in words."""
        turn, shift_mm, given = self.b_from_a[:3, :3], self.b_from_a[:3, 3], self.b_from_a
        meant = {
            f"{self.name} is inverted": np.linalg.inv(given),
            f"the shift of {self.name} is in m": rigid(turn, 1000 * shift_mm),
            f"the shift of {self.name} is in mm, not m": rigid(turn, shift_mm / 1000),
        }
        for words, flip in _NEGATED.items():
            meant[f"in {self.name} {words.format(self.a)}"] = given @ flip
            meant[f"in {self.name} {words.format(self.b)}"] = flip @ given
        return ((words, self._replace(b_from_a=one)) for words, one in meant.items())


Steps = tuple[tuple[Link, bool], ...]  # from a frame to another: links, and whether along them


class OpenCycle(NamedTuple):
    """From a frame to itself, first by the link that the others contradict: by how many mm at the
    organ and degrees it is open, how many mm are allowed, and in words what would close it."""

    steps: Steps
    off_mm: float
    off_deg: float
    allowed_mm: float
    cures: tuple[str, ...]


def read_link(b: str, a: str, rows: Any, source: str, metres: bool = False, **stated: Any) -> Link:
    """From 4 x 4 numbers, which need not be right: ``faults`` says so, and a shift beyond any room
    is taken in the other unit. A frame called image is in pixels: its axes may have any length.
    Raises InputError: they are no numbers, or no three directions."""
    matrix, faults, pixels = np.array(rows, float), list[str](), "image" in a.lower()
    finite = bool((np.abs(matrix) < _LARGEST).all())
    lengths = np.linalg.svd(matrix[:3, :3], compute_uv=False) if finite else np.zeros(3)
    if not lengths[2] > lengths[0] / _LARGEST:
        raise InputError(f"{source}: {b}_from_{a} must have 4 x 4 numbers: three axes, a shift.")
    if matrix[3, :3].any() and not matrix[:3, 3].any():
        matrix = matrix.T.copy()
        faults.append("is written by columns: transpose it")
    sizes = np.linalg.norm(matrix[:3, :3], axis=0) if pixels else np.ones(3)
    u, _, vt = np.linalg.svd(matrix[:3, :3] / sizes)
    off = max(np.abs(matrix[:3, :3] / sizes - u @ vt).max(), np.abs(matrix[3] - np.eye(4)[3]).max())
    if off > _NOT_RIGID:
        faults.append(f"is not rigid, by up to {off:.2g}; the nearest rotation is taken")
    if np.linalg.det(u @ vt) < 0:
        faults.append("is left-handed: an axis is mirrored")
    shift_mm = matrix[:3, 3] * (1000 if metres else 1)
    far_mm = float(np.linalg.norm(shift_mm))
    if far_mm > _FARTHEST_MM:
        faults.append(f"shifts by {far_mm / 1000:.4g} m; a thousandth of it is taken")
        shift_mm /= 1000
    elif 0 < far_mm < _NEAREST_MM and not metres and not pixels:
        faults.append(f"shifts by {far_mm:.3g} mm: is it in m?")
    return Link(b, a, rigid((u @ vt) * sizes, shift_mm), source, faults=tuple(faults), **stated)


def fit_link(b: str, a: str, places_b: Points, places_a: Points, source: str) -> Link:
    """The best rigid transform between the same places, mm; its error by how far it leaves them.
    Raises InputError: they are fewer than three, in a line, or in two units."""
    if not (np.abs([places_a, places_b]) < _LARGEST).all():
        raise InputError(f"{source}: every place must have three numbers, in mm.")
    sides, count = [side - side.mean(0) for side in (places_a, places_b)], len(places_a)
    spreads = [np.linalg.svd(side, compute_uv=False)[1] if count > 2 else 0 for side in sides]
    if min(spreads) < _SPREAD_MM or not 0.5 < spreads[0] / spreads[1] < 2:
        raise InputError(
            f"{source}: the places must be three or more, {_SPREAD_MM:g} mm or more from one line, "
            f"and alike in {a} and {b}, in mm; here they reach {spreads[0]:.3g} and "
            f"{spreads[1]:.3g} mm from it."
        )
    b_from_a = kabsch(places_a, places_b, np.ones(count))
    left_mm = np.linalg.norm(transform_points(b_from_a, places_a) - places_b, axis=1)
    std_mm = float(np.linalg.norm(left_mm)) / (count - 2) ** 0.5  # of a place
    source = f"{source}, to {std_mm:.1f} mm"
    faults = (f"leaves places {std_mm:.1f} mm off: touch again",) * (std_mm > _SCATTER_MM)
    std_mm = max(std_mm, _TOUCH_MM)
    error_deg = float(np.degrees(_SURE * std_mm / 3**0.5 / spreads[0]))
    at = tuple(places_a.mean(0).tolist())
    return Link(b, a, b_from_a, source, _SURE * std_mm / count**0.5, error_deg, faults, at)


def composed(steps: Steps) -> Affine:
    """The last frame from the first."""
    whole = np.eye(4)
    for link, along in steps:
        whole = (link.b_from_a if along else np.linalg.inv(link.b_from_a)) @ whole
    return whole


class FrameGraph:
    """``groups`` of connected frames, the one of ``root`` first; ``ways``: from each frame to the
    first of its group, by the earlier links; each of the others, ``spare``, closes a cycle. The
    organ is ``distance_mm`` before the camera, or before the first frame of a group without it."""

    def __init__(self, links: Iterable[Link], root: str, distance_mm: float = 150) -> None:
        self.spare, kept = list[Link](), list[Link]()
        together = {root: {root}}
        for link in links:
            ends = [together.setdefault(end, {end}) for end in (link.a, link.b)]
            (self.spare if ends[0] is ends[1] else kept).append(link)
            joined = ends[0] | ends[1]
            together |= dict.fromkeys(joined, joined)
        self.ways, self.groups = dict[str, Steps](), list[list[str]]()
        for first in sorted(together, key=lambda name: (name != root, "image" in name.lower())):
            if first not in self.ways:
                self.ways[first] = ()
                self.groups.append([first])
                for here in self.groups[-1]:  # which grows
                    for link in kept:
                        there = {link.a: link.b, link.b: link.a}.get(here, here)
                        if there not in self.ways:
                            self.ways[there] = ((link, link.b == here), *self.ways[here])
                            self.groups[-1].append(there)
        self._ahead = np.array([0.0, 0.0, distance_mm, 1.0])

    def between(self, a: str, b: str) -> Steps | None:
        """From a to b; None: they are not connected."""
        if not any({a, b} <= {*group} for group in self.groups):
            return None
        up, down = [*self.ways[a]], [*self.ways[b]]
        while up and down and up[-1][0] is down[-1][0]:
            up.pop(), down.pop()
        return (*up, *((link, not along) for link, along in reversed(down)))

    def organ_in(self, frame: str) -> Float64[np.ndarray, " 4"]:
        """Its place, mm."""
        group = next(group for group in self.groups if frame in group)
        steps = self.between(CAMERA if CAMERA in group else group[0], frame)
        return composed(steps or ()) @ self._ahead

    def open_cycles(self) -> Iterator[OpenCycle]:
        """Those that do not close within what their links state, or what is usual."""
        for link in self.spare:
            cycle = ((link, True), *(self.between(link.b, link.a) or ()))
            mm, deg = [_ROUNDED_MM], [_USUAL_DEG]
            for one, _ in cycle:
                lever_mm = float(np.linalg.norm(self.organ_in(one.a)[:3] - one.at))
                stated_mm = _USUAL_MM if one.error_mm is None else one.error_mm
                mm.append(stated_mm + lever_mm * np.radians(one.error_deg))
                deg.append(one.error_deg)
            allowed = np.array([np.linalg.norm(mm), np.linalg.norm(deg)])
            if ((off := self._apart(cycle)) <= allowed).all():
                continue
            times = {
                words: (self._apart((*cycle[:n], (meant, along), *cycle[n + 1 :])) / allowed).max()
                for n, (one, along) in enumerate(cycle)
                for words, meant in one.others()
            }
            cures = [words for words in sorted(times, key=times.__getitem__) if times[words] <= 1]
            yield OpenCycle(cycle, float(off[0]), float(off[1]), float(allowed[0]), tuple(cures))

    def _apart(self, cycle: Steps) -> Float64[np.ndarray, " 2"]:
        """By how many mm, at the organ, and degrees a cycle is open."""
        first, whole = cycle[0][0].a, composed(cycle)
        top, organ = composed(self.ways[first]), self.organ_in(first)
        off_mm = np.linalg.norm((top @ (whole @ organ - organ))[:3])
        cosine = (np.trace(whole) - 2) / 2  # its last row adds 1
        return np.array([off_mm, np.degrees(np.arccos(np.clip(cosine, -1, 1)))])
