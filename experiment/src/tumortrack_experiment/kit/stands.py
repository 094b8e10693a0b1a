"""Stands that impose a state on the organ: all of them stand in the same two sockets of the base.

D1, D2, D3: a plate over the midsection whose legs stop it 4, 8, 12 mm under the organ's highest
point there, as in the paper. P1: a rod of 8 mm with a round end that a collar stops when it is
pressed in by 10 mm, away from the tumors. T10: a bar under one edge that tilts the base by 10
degrees, so that the organ's weight pulls another way and the camera sees it from another side.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points, triangles_of
from tumortrack.core.solids import mesh_of
from tumortrack.core.types import Anatomy, Mesh
from tumortrack_experiment.kit.recipe import COUPON_MM, COUPONS
from tumortrack_experiment.kit.solids import ball, box, cone, written
from tumortrack_experiment.kit.values import PrintedPart

COMPRESSION_MM = {"D1": 4.0, "D2": 8.0, "D3": 12.0}
POKE_MM, POKE_DIAMETER_MM = 10.0, 8.0  # as the benchmarks' twin has them
PLATE_MM = 36.0  # along the organ
_TILTS_DEG = (2, 25)  # what lies farther over slides
_GAP_MM = 10.0  # between organ and legs: at D3 a kidney's sides come out by some 5 mm
_LEG_MM, _BEAM_MM = 5.0, 8.0
_FIT_MM = 0.25  # on each side of what is put into something
_SOCKET_WALL_MM, _HIGH_MM = 4.0, 8.0


@dataclass(frozen=True)
class Sockets:
    """Where legs stand: their inner faces at these y, x within half a plate's width; base frame."""

    y_mm: tuple[float, float]

    @staticmethod
    def beside(organ: Mesh) -> Sockets:
        points = organ.vertices_mm
        middle = points[np.abs(points[:, 0]) < PLATE_MM / 2 + _GAP_MM]
        return Sockets((float(middle[:, 1].min()) - _GAP_MM, float(middle[:, 1].max()) + _GAP_MM))

    def legs(self, grown: float = 0.0) -> list[tuple[float, float, float, float]]:
        """Lower and upper x, lower and upper y of each leg, grown by some mm."""
        low, high = self.y_mm
        x = PLATE_MM / 2 + grown
        sides = ((low - _LEG_MM, low), (high, high + _LEG_MM))
        return [(-x, x, start - grown, end + grown) for start, end in sides]

    def cut_into(self, base: Any) -> Any:
        """A base with walls round each leg, and the room for it."""
        for leg in range(2):
            base += _block(self.legs(_SOCKET_WALL_MM)[leg], -1, _HIGH_MM)
        for leg in range(2):  # the cradle, too, makes room
            base -= _block(self.legs(_FIT_MM)[leg], 0, 200)
        return base


def tilt_of(state: str) -> int | None:
    """The degrees of a state such as T10."""
    found = re.fullmatch(r"T(\d+)", state)
    return int(found[1]) if found else None


def check_states(states: tuple[str, ...]) -> None:
    """InputError for a state that no stand imposes, or one that is given twice."""
    low, high = _TILTS_DEG
    for state in states:
        tilt = tilt_of(state)
        if not (state in (*COMPRESSION_MM, "P1") or (tilt is not None and low <= tilt <= high)):
            raise InputError(
                f"--states {state}: there is no such state. Allowed: D1, D2, D3 (pressed by 4, 8, "
                f"12 mm), P1 (a rod), T{low} to T{high} (tilted by so many degrees)."
            )
    if len(set(states)) < len(states):
        raise InputError("--states names one state twice.")


def stands_for(states: tuple[str, ...], anatomy: Anatomy, sockets: Sockets) -> list[PrintedPart]:
    """What is printed for the states that need sockets; ``anatomy`` in the base frame."""
    out = []
    for state in states:
        if state in COMPRESSION_MM:
            out.append(_press(state, anatomy.organ, sockets))
        elif state == "P1":
            out += _poke(anatomy, sockets)
    return out


def midsection_top_mm(organ: Mesh) -> float:
    """Height of the surface's highest point under the middle half of the plate, base frame."""
    spread = organ.spread_mm(1.0)
    return float(spread[np.abs(spread[:, 0]) < PLATE_MM / 4, 2].max())


def _press(state: str, organ: Mesh, sockets: Sockets) -> PrintedPart:
    by_mm = COMPRESSION_MM[state]
    under = midsection_top_mm(organ) - by_mm
    low, high = sockets.y_mm
    radius, end = 4.0, (low - _LEG_MM, high + _LEG_MM)
    beam = _block((-PLATE_MM / 2, PLATE_MM / 2, *end), under + radius, under + _BEAM_MM)
    for side in (-1, 1):  # round where the organ bends about its edges
        edge = cone((0, 0, 0), end[1] - end[0], radius).rotate((-90, 0, 0))
        beam += edge.translate((side * (PLATE_MM / 2 - radius), end[0], under + radius))
    beam = beam.hull()
    for leg in sockets.legs():
        beam += _block(leg, 0, under + radius)
    purpose = f"presses the midsection by {by_mm:g} mm; stands in the sockets"
    return _part(f"press_{state}", purpose, beam, state, upside_down=under + _BEAM_MM)


def _poke(anatomy: Anatomy, sockets: Sockets) -> list[PrintedPart]:
    x, y, z = poke_point(anatomy).tolist()
    under = float(anatomy.organ.box_mm[1, 2]) + 8.0
    low, high = sockets.y_mm
    beam = _block((-7, 7, low - _LEG_MM, high + _LEG_MM), under, under + _BEAM_MM)
    radius = POKE_DIAMETER_MM / 2
    arm = box((-7, y - 7, under), (7, y + 7, under + _BEAM_MM)) + cone((x, y, under), _BEAM_MM, 9)
    beam += arm.hull()
    for leg in sockets.legs():
        head = (-7, 7, *leg[2:])
        beam += (_block(leg, 0, _HIGH_MM + 4) + _block(head, under, under + 1)).hull()
    beam -= cone((x, y, under - 1), _BEAM_MM + 2, radius + 0.2)
    tip, top = z - POKE_MM, under + _BEAM_MM
    rod = ball((x, y, tip + radius), radius) + cone((x, y, tip + radius), top - tip, radius)
    rod += cone((x, y, top), 6, 10)
    about = "stops the rod when it is pressed in by 10 mm"
    return [
        _part("guide_P1", f"guides the rod and {about}", beam, "P1", upside_down=top),
        _part("rod_P1", f"its collar {about}", rod, "P1", upside_down=top + 6),
    ]


def poke_point(anatomy: Anatomy) -> Float64[np.ndarray, " 3"]:
    """Where the surface faces up, farthest from every tumor and from the organ's rim, as the
    laboratory's twin has it; frame of the anatomy, z up."""
    from scipy.spatial import cKDTree

    organ = anatomy.organ
    middle, normal = triangles_of(organ.vertices_mm, organ.faces)
    facing = normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    top = (facing > min(0.85, float(facing.max()))) & (middle[:, 2] > middle[:, 2].mean())
    away = [middle[facing < 0.5], *(tumor.vertices_mm for tumor in anatomy.tumors)]
    room = np.min([cKDTree(points).query(middle[top])[0] for points in away], axis=0)
    return middle[top][int(room.argmax())]


def wedge(state: str, half_mm: tuple[float, float], bottom_mm: float) -> PrintedPart:
    """The bar under the base's edge at +x that tilts it about its edge at -x."""
    tilt, (half, across) = np.radians(tilt_of(state) or 0), half_mm
    width = min(across, 35.0)
    fall = float(np.tan(tilt))

    def wall(start: float, end: float, top: float) -> Any:
        below = [bottom_mm - (x + half) * fall for x in (start, end)]
        solid = box((start, -width, min(below) - 50), (end, width, top))
        return solid.trim_by_plane(
            (np.sin(tilt), 0, np.cos(tilt)), -half * np.sin(tilt) + bottom_mm * np.cos(tilt)
        )

    bar = wall(half - 20, half + 4, bottom_mm) + wall(half + 0.4, half + 4, bottom_mm + 4)
    mesh = mesh_of(bar)
    c, s = np.cos(tilt), np.sin(tilt)
    flat = rigid(np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]), np.zeros(3))
    flat[2, 3] = -transform_points(flat, mesh.vertices_mm)[:, 2].min()
    purpose = f"lies under the base's edge with the + mark and tilts it by {tilt_of(state)} degrees"
    return PrintedPart(f"wedge_{state}", purpose, mesh, "base", flat, state)


def _part(name: str, purpose: str, solid: Any, state: str, upside_down: float) -> PrintedPart:
    """A part that is printed head first, its top at this height."""
    over = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, upside_down]))
    return PrintedPart(name, purpose, mesh_of(solid), "base", over, state)


def _block(sides: tuple[float, float, float, float], low: float, high: float) -> Any:
    x0, x1, y0, y1 = sides
    return box((x0, y0, low), (x1, y1, high))


def coupon_mold() -> PrintedPart:
    """A slab with a through-hole for each coupon: laid on a film, filled, covered by a film. K:
    of the organ's batch; T: of the tumors'."""
    across, high = COUPON_MM
    step = across + 6.0
    slab = box((0, 0, 0), (COUPONS * step + 16, 2 * step + 6, high))
    for row, letter in enumerate("KT"):
        y = 3 + step / 2 + row * step
        for n in range(COUPONS):
            slab -= cone((3 + step * (n + 0.5), y, -1), high + 2, across / 2)
        slab -= written(letter, (COUPONS * step + 9, y, high - 0.6), 8.0, 1.0)
    purpose = "molds the coupons that tell stiffness and HU of both batches"
    return PrintedPart("coupons", purpose, mesh_of(slab), "ct", np.eye(4))
