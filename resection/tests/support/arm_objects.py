"""A kidney-like ellipsoid with a tumor at its side, and the arms that cut it out."""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np

from plan_objects import located_of, sphere
from tumortrack.core.types import Mesh
from tumortrack_resection.arms.cell import ArmCell
from tumortrack_resection.arms.kinematics import ArmModel
from tumortrack_resection.values import Cut, Located, ResectionPlan

Vector = tuple[float, float, float]
HALF_MM = np.array([55.0, 30.0, 25.0])
STAND_MM = 120.0
TUMOR_MM = 12.0  # radius


@cache
def seen(shift_mm: Vector = (0.0, 0.0, 0.0), angle_rad: float = 0.6, n: int = 6_000) -> Located:
    """The ellipsoid united with the tumor, lowest point on the stand, as an estimate."""
    middle_mm = np.array([0.0, 0.0, STAND_MM + HALF_MM[2]]) + shift_mm
    body = sphere(middle_mm, HALF_MM, 3)
    return located_of(body, sphere(_tumor(angle_rad) + middle_mm, TUMOR_MM, 3), n=n)


def organ(shift_mm: Vector = (0.0, 0.0, 0.0), angle_rad: float = 0.6) -> Mesh:
    return seen(shift_mm, angle_rad).organ


def _tumor(angle_rad: float) -> np.ndarray:
    return np.array([np.cos(angle_rad), np.sin(angle_rad), 0.1]) * HALF_MM


def plan(
    shift_mm: Vector = (0.0, 0.0, 0.0),
    angle_rad: float = 0.6,
    radius_mm: float = 17.0,
    step_mm: float = 1.5,
) -> ResectionPlan:
    """Closed contours around the tumor at its middle and at its underside."""
    centre = _tumor(angle_rad) + [0.0, 0.0, STAND_MM + HALF_MM[2]] + np.array(shift_mm)
    angles = np.linspace(0, 2 * np.pi, int(2 * np.pi * radius_mm / step_mm) + 1) + angle_rad
    ring = centre[:2] + radius_mm * np.stack([np.cos(angles), np.sin(angles)], 1)
    low, top = centre[2] - TUMOR_MM, centre[2] + TUMOR_MM
    cuts = tuple(
        Cut(n, np.column_stack([ring, np.full(len(ring), height)]))
        for n, height in ((1, centre[2]), (2, low))
    )
    return ResectionPlan(
        method="published", tumor="tumor_1", label=2, grasp_mm=np.append(centre[:2], top),
        cuts=cuts, piece=seen(shift_mm, angle_rad).meshes["tumor_1"], taken=("tumor_1",),
        keep_mm={}, facets=np.zeros((0, 4)), lift=np.array([0.0, 0.0, 1.0]), margin_mm=5.0,
        volumes_ml={}, exophytic=0.5,
    )  # fmt: skip


def bare(cell: ArmCell) -> ArmCell:
    """The same workcell without clearances: only what touches collides."""
    config = msgspec.structs.replace(cell.config)
    for name in ("clearance_mm", "organ_clearance_mm", "contact_mm"):
        msgspec.structs.force_setattr(config, name, 0.0)
    return ArmCell(config, cell.organ)


def flange_pose(model: ArmModel, joints_rad: np.ndarray) -> np.ndarray:
    """``base_from_flange`` (..., 4, 4), mm, of joints (..., 6), by the plain product of the six
    Denavit-Hartenberg transforms.

    Independent of every library: what the others are checked against.
    """
    base_from_flange = np.eye(4)
    joints = np.moveaxis(np.asarray(joints_rad), -1, 0)
    for theta, a, d, alpha in zip(joints, model.a_mm, model.d_mm, model.alpha_rad, strict=True):
        (ct, st), (ca, sa) = (np.cos(theta), np.sin(theta)), (np.cos(alpha), np.sin(alpha))
        step = np.zeros((*theta.shape, 4, 4))
        step[..., 0, :] = np.stack([ct, -st * ca, st * sa, a * ct], -1)
        step[..., 1, :] = np.stack([st, ct * ca, -ct * sa, a * st], -1)
        step[..., 2:, :] = [[0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        base_from_flange = base_from_flange @ step
    return base_from_flange


# A way between two strokes (milliradians, but for the fifth joint) on which toppra, on its first
# grid, creeps for minutes.
_CREEPING = (
    "-490 -2077 2569 -2063 -2061, -507 -2109 2580 -2041 -2078, -521 -2135 2588 -2024 -2092, "
    "-532 -2158 2596 -2009 -2103, -543 -2179 2602 -1995 -2114, -554 -2200 2609 -1981 -2126, "
    "-565 -2218 2614 -1967 -2140, -575 -2230 2614 -1955 -2161, -581 -2229 2605 -1948 -2190, "
    "-583 -2211 2586 -1946 -2230, -581 -2176 2556 -1950 -2281, -576 -2130 2518 -1958 -2339, "
    "-570 -2077 2475 -1969 -2403, -562 -2020 2430 -1981 -2468, -555 -1964 2385 -1993 -2533, "
    "-547 -1907 2341 -2004 -2598, -540 -1851 2296 -2016 -2664, -532 -1794 2251 -2028 -2729, "
    "-525 -1738 2207 -2040 -2794, -518 -1681 2162 -2051 -2859, -510 -1625 2117 -2063 -2925, "
    "-503 -1568 2072 -2075 -2990, -495 -1512 2028 -2087 -3055, -488 -1455 1983 -2098 -3121, "
    "-480 -1399 1938 -2110 -3186, -473 -1343 1894 -2122 -3251, -465 -1286 1849 -2134 -3316, "
    "-458 -1230 1804 -2145 -3382, -451 -1173 1759 -2157 -3447, -443 -1117 1715 -2169 -3512, "
    "-436 -1060 1670 -2181 -3577, -428 -1006 1627 -2192 -3640, -421 -957 1589 -2203 -3696, "
    "-414 -917 1559 -2212 -3742, -407 -890 1539 -2220 -3773, -401 -875 1531 -2227 -3789, "
    "-395 -870 1531 -2231 -3795, -389 -871 1535 -2235 -3793, -384 -874 1542 -2238 -3788, "
    "-379 -878 1549 -2242 -3782, -373 -882 1556 -2245 -3777, -367 -886 1565 -2249 -3771, "
    "-359 -892 1575 -2254 -3763"
)
CREEPING_MRAD = np.insert(np.loadtxt(_CREEPING.split(", ")), 4, -1571.0, axis=1)
