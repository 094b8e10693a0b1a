"""Where an electrode goes and how far that is from surfaces: slow, plain, and not the planner's."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Anatomy, Mesh
from tumortrack_benchmarks.physics.cut import cut as cut_out
from tumortrack_resection.budget import foreseen_mm
from tumortrack_resection.check import TOLERANCE_MM
from tumortrack_resection.facets import Tools
from tumortrack_resection.values import Cut, Located, ResectionConfig, ResectionPlan, name_of

Ends = Float64[np.ndarray, "m 2 3"]  # tip and rear end of an electrode's axis
_AT_ONCE = 400_000  # pairs of points and axes


def swept(cut: Cut, electrode_mm: float = 70.0, step_mm: float = 0.4) -> Ends:
    """Along a cut, and between its points."""
    assert cut.axis is not None
    path = cut.path_mm
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    at = np.unique(np.append(way, np.arange(0.0, way[-1], step_mm)))
    tips = np.column_stack([np.interp(at, way, axis) for axis in path.T])
    return np.stack([tips, tips - electrode_mm * cut.axis], axis=1)


def on_axes(ends_mm: Ends, step_mm: float = 1.0) -> Float64[np.ndarray, "m k 3"]:
    """Points along each axis, tips first."""
    length = float(np.linalg.norm(ends_mm[0, 0] - ends_mm[0, 1]))
    shares = np.linspace(0, 1, int(np.ceil(length / step_mm)) + 1)[:, None]
    return ends_mm[:, :1] + shares * (ends_mm[:, 1:] - ends_mm[:, :1])


def to_axes(points_mm: Float64[np.ndarray, "n 3"], ends_mm: Ends) -> Float64[np.ndarray, " n"]:
    """Of each point, the distance to the nearest axis, to 1e-5 mm."""
    middle = ends_mm[0, 0]  # near to all of them, so that squares are small
    tips, along = ends_mm[:, 0] - middle, ends_mm[:, 1] - ends_mm[:, 0]
    squares, offsets = (along**2).sum(1), (tips * along).sum(1)
    nearest = np.empty(len(points_mm))
    count = max(1, _AT_ONCE // len(ends_mm))
    for first in range(0, len(points_mm), count):
        points = points_mm[first : first + count] - middle
        ahead = points @ along.T - offsets
        share = np.clip(ahead / squares, 0, 1)
        to_tips = (points**2).sum(1)[:, None] - 2 * points @ tips.T + (tips**2).sum(1)
        gaps = to_tips - 2 * share * ahead + share**2 * squares
        nearest[first : first + count] = np.sqrt(np.maximum(gaps.min(1), 0))
    return nearest


def beyond(planes: Float64[np.ndarray, "k 4"], points_mm: np.ndarray) -> np.ndarray:
    """How far each point is outside of each plane, mm (..., k)."""
    return points_mm @ planes[:, :3].T - planes[:, 3]


def in_plane(
    plane: Float64[np.ndarray, " 4"], mesh: Mesh, step_mm: float = 0.8
) -> Float64[np.ndarray, "n 3"]:
    """A lattice in a plane, all over a surface's box."""
    normal = plane[:3]
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    u /= np.linalg.norm(u)
    middle = mesh.box_mm.mean(0)
    middle = middle - (normal @ middle - plane[3]) * normal
    far = float(np.linalg.norm(np.ptp(mesh.box_mm, axis=0))) / 2 + 1
    ticks = np.arange(-far, far, step_mm)
    a, b = np.meshgrid(ticks, ticks)
    return middle + a.reshape(-1, 1) * u + b.reshape(-1, 1) * np.cross(normal, u)


def in_box(mesh: Mesh, points_mm: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    return ((points_mm >= mesh.box_mm[0]) & (points_mm <= mesh.box_mm[1])).all(1)


def in_organ(located: Located, points_mm: np.ndarray) -> np.ndarray:
    points = points_mm.reshape(-1, 3)
    points = points[in_box(located.organ, points)]
    return points[contains(located.organ, points)]


def keeps(plan: ResectionPlan) -> dict[str, float]:
    """Of all that the electrode keeps away from."""
    return {**dict.fromkeys(plan.taken, plan.margin_mm), **plan.keep_mm}


def gap_mm(plan: ResectionPlan, mesh: Mesh, tools: Tools = Tools()) -> float:  # noqa: B008
    """Of the electrode's whole length on all cuts, by dense points of a surface."""
    points = mesh.spread_mm(1.0)  # 5 mm are at most 0.04 mm too long
    lines = (swept(cut, tools.electrode_mm) for cut in plan.cuts)
    return min(to_axes(points, ends).min() for ends in lines) - tools.radius_mm


def holds(plan: ResectionPlan, located: Located, config: ResectionConfig, tools: Tools) -> None:
    """The law of every plan: the lines' distances, what they cut, and that the piece comes away."""
    assert 1 <= len(plan.facets) <= config.most_facets
    assert [cut.sweep for cut in plan.cuts] == [*range(1, len(plan.facets) + 1)]
    assert np.abs(np.linalg.norm(plan.facets[:, :3], axis=1) - 1).max() < 1e-12
    foreseen, surfaces = foreseen_mm(plan, located, tools), {**located.meshes, **located.structures}
    assert {name_of(n) for n in located.tumors} <= keeps(plan).keys()
    for name, mm in keeps(plan).items():
        gap = gap_mm(plan, surfaces[name], tools)
        assert gap > mm - TOLERANCE_MM / 2
        assert abs(foreseen[name] - gap) < 0.3
    depths = -beyond(plan.facets, located.meshes[plan.tumor].vertices_mm).max(0)
    room_mm = plan.margin_mm + tools.radius_mm
    assert (depths >= room_mm - 1e-9).all()
    if len(plan.taken) == 1:
        assert (depths <= room_mm + 0.1 + 1e-9).all()
    for number, (cut, plane) in enumerate(zip(plan.cuts, plan.facets, strict=True)):
        ends = swept(cut, tools.electrode_mm)
        others = np.delete(plan.facets, number, axis=0)
        assert np.abs(beyond(plane[None], ends.reshape(-1, 3))).max() < 1e-6
        within = in_organ(located, on_axes(ends))
        assert len(within)
        assert beyond(others, within).max(initial=0) < 1.5  # nothing but the facet
        wall = in_plane(plane, located.organ)
        wall = in_organ(located, wall[(beyond(others, wall) <= 0).all(1)])
        assert to_axes(wall, ends).max(initial=0) < tools.radius_mm  # no bridge
        assert not len(in_organ(located, ends[:, 1] + 4.0 * cut.axis))  # the grip is outside
        assert not len(in_organ(located, on_axes(ends[[0, -1]], 0.5)))  # it begins and ends there
    parts = [located.meshes[name_of(n)] for n in located.tumors]
    done = cut_out(Anatomy((located.organ, *parts)), plan, voxel_mm=0.7)
    assert done.detached
    assert (done.removed_share, done.cut_share, done.hurt) == (1.0, 0.0, ())
    assert np.abs(np.linalg.norm(plan.lift) - 1) < 1e-9
    assert plan.lift[2] >= 0
    assert (plan.facets[:, :3] @ plan.lift).max() < -0.04  # it comes free that way
