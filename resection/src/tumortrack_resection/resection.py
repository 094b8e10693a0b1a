"""From a located organ to a plan: which tumor to cut out, where to hold it, along which lines.

Two methods: the paper's (its section "Integration with Robotic Resection") and ``margin``.
"""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError, cKDTree

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.organ import organ_name
from tumortrack.core.types import ORGAN
from tumortrack_resection.margin import margin_plan
from tumortrack_resection.outline import common, concave_hull, evenly, grown, polygon_of, rings_of
from tumortrack_resection.values import (
    UNGUARDED,
    Cut,
    CutLayer,
    Located,
    MethodResult,
    ResectionConfig,
    ResectionPlan,
    name_of,
)

_DIRECTIONS, _MOST = 192, 12_000  # of the hull, points it is made of: off by 0.5 mm
_WALL_MM = 1.0  # between points of the piece's wall and of structures
_FEWEST = 30  # points that define a tumor's shape
_WHOLE = 0.99  # of another tumor's points


def plan_resection(located: Located, config: ResectionConfig) -> ResectionPlan:
    """The plan, table frame, mm. Raises InputError: no such tumor; NoPlan: nothing to cut, or not
    as asked."""
    label, share = _chosen_tumor(located, config)
    method = published_plan if config.method == "published" else margin_plan
    layers, cuts, grasp_mm = method(located, label, config)
    taken = inside(layers, located.points_mm)
    volumes_ml = _volumes_ml(located, label, taken)
    notes = _others(located, label, taken, layers) + _kept_away(located, layers, cuts, config)
    healthy_share = volumes_ml["healthy"] / volumes_ml["parenchyma"]
    if healthy_share > config.most_healthy:
        raise NoPlan(
            f"{healthy_share:.0%} of the organ's healthy tissue would come away; allowed are "
            f"{config.most_healthy:.0%}. Ask for a smaller margin, or allow more."
        )
    return ResectionPlan(
        method=config.method,
        tumor=name_of(label),
        label=label,
        grasp_mm=grasp_mm,
        cuts=cuts,
        layers=layers,
        margin_mm=config.margin_mm,
        volumes_ml=volumes_ml,
        exophytic=share,
        stamp_ns=located.stamp_ns,
        notes=notes,
    )


def published_plan(located: Located, label: int, config: ResectionConfig) -> MethodResult:
    """The paper's method: the piece, two sweeps, and where to hold (its section II-D).

    The tumor's points are projected on the table's plane; their concave hull, grown by the margin
    and clipped to the organ's projection, is cut along twice: at the middle of the tumor's bounding
    box, and on the box's lower face. Held is the tumor's centre of mass, carried up to the top of
    the box. NoPlan where there is no contour.
    """
    tumor = located.of(label)
    low, high = float(tumor[:, 2].min()), float(tumor[:, 2].max())
    wide = grown(concave_hull(tumor[:, :2]), config.margin_mm)
    ring = rings_of(common(wide, concave_hull(located.points_mm[:, :2])))[0]
    flat = evenly(np.concatenate([ring, ring[:1]]), config.spacing_mm)
    cuts = (Cut.level(1, flat, (low + high) / 2), Cut.level(2, flat, low))
    x, y, _ = tumor.mean(0)
    return (CutLayer(low, np.inf, (ring,)),), cuts, np.array([x, y, high], float)


def _chosen_tumor(located: Located, config: ResectionConfig) -> tuple[int, float]:
    """Label of the tumor to cut out, and its share outside the organ's hull."""
    if len(located.of(ORGAN)) < _FEWEST:
        raise NoPlan("no organ was located, so nothing can be planned. Locate it first.")
    if not located.tumors:
        raise NoPlan("no tumor was located, so there is nothing to cut out.")
    names = {name_of(label): label for label in located.tumors}
    if config.tumor and config.tumor not in names:
        raise InputError(f"there is no {config.tumor!r}; located were {', '.join(names)}.")
    candidates = [names[config.tumor]] if config.tumor else list(names.values())
    shares = exophytic_shares(located, candidates)
    label = max(shares, key=lambda tumor: shares[tumor])
    name, n = name_of(label), len(located.of(label))
    if n < _FEWEST:
        raise NoPlan(f"{name} has only {n} points; {_FEWEST} are needed. Locate with more points.")
    if shares[label] < config.least_exophytic:
        inside = f"{name} lies" if len(candidates) == 1 else "all tumors lie"
        raise NoPlan(
            f"{inside} wholly inside the organ ({shares[label]:.0%} outside its hull, "
            f"{config.least_exophytic:.0%} are needed): there is no contour to cut along."
        )
    needed = (organ_name(located.meshes), *names)
    if lacking := [part for part in needed if part not in located.meshes]:
        raise NoPlan(
            f"{lacking[0] or 'the organ'} has no surface to keep a margin from. Locate it again."
        )
    return label, shares[label]


def exophytic_shares(located: Located, labels: list[int]) -> dict[int, float]:
    """How much of each tumor lies outside the convex hull of the organ without tumors.

    Of a dense cloud the hull needs only the farthest point in each of many directions.
    """
    organ = located.of(ORGAN)
    organ = organ[:: 1 + len(organ) // _MOST]
    n = np.arange(_DIRECTIONS)
    z = 1 - (2 * n + 1) / _DIRECTIONS  # a Fibonacci sphere
    turn, ring = n * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    farthest = (directions.astype(np.float32) @ organ.T.astype(np.float32)).argmax(axis=1)
    try:
        hull = ConvexHull(organ[np.unique(farthest)].astype(np.float64))
    except QhullError as error:
        raise NoPlan("the organ's points lie in a plane; locate it anew.") from error
    normals, offsets = np.split(hull.equations.astype(np.float32), [3], axis=1)
    shares = {}
    for label in labels:
        points = located.of(label).astype(np.float32)
        shares[label] = float(((normals @ points.T + offsets).max(axis=0) > 0).mean())
    return shares


def inside(layers: tuple[CutLayer, ...], points_mm: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Which points lie in the piece that the layers make up (n,)."""
    within = np.zeros(len(points_mm), bool)
    for layer in layers:
        area = polygon_of(layer.rings_mm)
        left, low, right, high = area.bounds
        x, y, z = points_mm.T
        near = np.flatnonzero(
            (z >= layer.bottom_mm) & (z < layer.top_mm)
            & (x > left) & (x < right) & (y > low) & (y < high)
        )  # fmt: skip
        shapely.prepare(area)
        within[near] = shapely.contains_xy(area, x[near], y[near])
    return within


def _kept_away(
    located: Located, layers: tuple[CutLayer, ...], cuts: tuple[Cut, ...], config: ResectionConfig
) -> tuple[str, ...]:
    """A note on structures without a distance to keep. InputError: one was not located; NoPlan: a
    stroke, or the wall of the piece, comes too near to one."""
    if lacking := sorted(config.keep_away.keys() - located.structures.keys()):
        raise InputError(
            f"--keep-away {lacking[0]}: there is no such structure in this estimate. It has: "
            f"{', '.join(located.structures) or 'none'}."
        )
    high = located.organ.box_mm[1, 2]
    walls = [
        np.column_stack([ring, np.full(len(ring), z)])
        for layer in layers
        for z in np.arange(layer.bottom_mm, min(layer.top_mm, high) + _WALL_MM, _WALL_MM)
        for ring in (evenly(np.concatenate([flat, flat[:1]]), _WALL_MM) for flat in layer.rings_mm)
    ]
    cut_mm = np.concatenate([*(cut.path_mm for cut in cuts), *walls])
    for name, least_mm in config.keep_away.items():
        away_mm, _ = cKDTree(located.structures[name].spread_mm(_WALL_MM)).query(cut_mm)
        nearest = int(away_mm.argmin())
        if away_mm[nearest] < least_mm:
            x, y, z = cut_mm[nearest]
            raise NoPlan(
                f"a cut would come within {away_mm[nearest]:.1f} mm of {name}, at x {x:.0f}, "
                f"y {y:.0f}, z {z:.0f} mm (table); {least_mm:g} mm are to be kept. "
                "Ask for a smaller margin or distance, or plan another tumor."
            )
    others = [name for name in located.structures if name not in config.keep_away]
    return (f"{UNGUARDED} {', '.join(others)}.",) if others else ()


def _volumes_ml(located: Located, label: int, taken: np.ndarray) -> dict[str, float]:
    """Of closed surfaces, as `locate` states them; how much of the parenchyma comes away is counted
    among its points, which lie evenly in it."""
    organ_ml = located.organ.volume_ml
    tumors_ml = {n: located.meshes[name_of(n)].volume_ml for n in located.tumors}
    parenchyma_ml = organ_ml - sum(tumors_ml.values())
    healthy_ml = parenchyma_ml * float(taken[located.labels == ORGAN].mean())
    with_it_ml = [
        ml for n, ml in tumors_ml.items() if n == label or taken[located.labels == n].any()
    ]
    return {
        "organ": organ_ml,
        "parenchyma": parenchyma_ml,
        "tumor": tumors_ml[label],
        "piece": healthy_ml + sum(with_it_ml),
        "healthy": healthy_ml,
    }


def _others(
    located: Located, label: int, taken: np.ndarray, piece: tuple[CutLayer, ...]
) -> tuple[str, ...]:
    """What becomes of other tumors; a cut through one is no plan, however little it takes."""
    notes = []
    for other in located.tumors:
        if other == label:
            continue
        share, name = float(taken[located.labels == other].mean()), name_of(other)
        if share == 0 and not inside(piece, located.meshes[name].spread_mm()).any():
            continue
        if share < _WHOLE:
            much = f"{share:.0%} of it" if share >= 0.01 else "an edge of it"
            raise NoPlan(
                f"the cut would go through {name} ({much} would come away). Ask for another "
                "margin, or plan that tumor."
            )
        notes.append(f"{name} comes away with {name_of(label)}.")
    return tuple(notes)
