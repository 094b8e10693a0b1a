"""The last word before anything moves: how near the tools of finished motions come to the parts.

Nothing here is the planner's: kinematics and solids are read from the text of ``cell.urdf``.

- Solids: the tools' cylinders with their flat ends, exact (coal's GJK).
- Poses: all samples, and so many between them that no end of a solid's axis moves farther than
  ``STEP_MM`` from one to the next, over the table and relative to the carried piece. Between two
  poses an axis is at most half a step nearer.
- Least distance: it changes by no more than the solid moves, so most poses can be left out
  (Piyavskii 1972, doi 10.1016/0041-5553(72)90115-2). It is that of all poses, to ``_EXACT_MM``.
- Depth: where a solid meets a closed part, or begins in it, the same search goes by the signed
  distances of points ``_APART_MM`` apart on its axis. 0: it touches, but its axis is outside.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.geometry import rotation_onto
from tumortrack.core.mesh_query import contains
from tumortrack.core.organ import is_tumor, organ_name
from tumortrack.core.types import Mesh
from tumortrack_resection.motions import Joints, Motions, Stage
from tumortrack_resection.urdf import GRASPER, Configurations, Ends, Frames, ToolSolid, UrdfCell
from tumortrack_resection.values import CUTS_TUMOR, ELECTRODE, Clearance, Located, ResectionPlan

STEP_MM, TOLERANCE_MM = 0.3, 0.3
IN_TISSUE = (ELECTRODE, "shaft")  # what of the cutter is meant to be there
_APART_MM, _EXACT_MM = 0.3, 1e-3
_DOUBTFUL_MM = 0.01  # distances that differ by so much more than the solid moved are wrong
_MOST_POSES = 1_000_000

_Found = tuple[float, Float64[np.ndarray, " 3"]]  # a distance and the nearest place of a part, mm


class _Poses:
    """What is tested: ``ends_mm`` of each solid (table frame), the same as seen from the carried
    ``piece``, and whether the electrode ``cuts``. A gap between two stages counts as a motion."""

    def __init__(
        self, cell: UrdfCell, solids: Sequence[ToolSolid], motions: Motions, step_mm: float
    ):
        self._stages = stages = motions.stages
        if not stages:
            raise InputError("there are no motions that could be checked.")
        samples = np.concatenate([stage.joints_rad for stage in stages])
        if not np.isfinite(samples).all():
            raise InputError("the motions have joint angles that are not finite.")
        self._first = np.cumsum([0, *(len(stage.times_s) for stage in stages)])
        names = [stage.name for stage in stages]
        lift = int(self._first[names.index(Stage.LIFT) if Stage.LIFT in names else -1])
        ends_mm = cell.ends(solids, samples)
        piece = _piece(cell, samples, lift)
        ends_mm += [_seen(piece, ends) for ends in ends_mm]
        chord_mm = np.linalg.norm(np.diff(ends_mm, axis=1), axis=-1).max((0, 2))
        # Along a straight line of joints, an end's second derivative is at most turn^2 x reach.
        turn = np.abs(np.diff(samples, axis=0)).sum(1)
        way_mm = np.minimum(chord_mm + turn**2 * cell.reach_mm / 2, turn * cell.reach_mm)
        parts = np.append(np.maximum(np.ceil(way_mm / step_mm), 1), 1)
        if parts.sum() > _MOST_POSES:
            raise InputError(f"the motions are too long: over {_MOST_POSES} poses to be checked.")
        parts = parts.astype(int)
        self._sample = np.repeat(np.arange(len(samples)), parts)
        steps = np.arange(len(self._sample)) - np.repeat(np.cumsum(parts) - parts, parts)
        self._share = steps / parts[self._sample]
        later = np.minimum(self._sample + 1, len(samples) - 1)
        way = samples[later] - samples[self._sample]
        joints_rad = samples[self._sample] + self._share[:, None] * way
        self.ends_mm = cell.ends(solids, joints_rad)
        self.piece = _piece(cell, joints_rad, int(np.searchsorted(self._sample, lift)))
        cutting = np.concatenate([stage.cutting for stage in stages]).astype(bool)
        before = cutting[np.maximum(self._sample - 1, 0)] & (steps == 0)
        self.cuts: Bool[np.ndarray, " n"] = before | cutting[self._sample] | cutting[later]

    def when(self, pose: int) -> tuple[str, float]:
        """The stage, and seconds after it began."""
        at = self._sample[pose] + self._share[pose]
        n = int(np.searchsorted(self._first, np.ceil(at), side="right")) - 1
        name, times_s = self._stages[n].name, self._stages[n].times_s
        return name, float(np.interp(at - self._first[n], np.arange(len(times_s)), times_s))


def _piece(cell: UrdfCell, joints_rad: Configurations, lift: int) -> Frames:
    """``table_from_piece``: from configuration ``lift`` on it moves with the holder's tip."""
    turned, at_mm = cell.frames(GRASPER, joints_rad)
    start = min(lift, len(joints_rad) - 1)
    turned = np.einsum("nca,da->ncd", turned, turned[start])
    at_mm = at_mm - np.einsum("ncd,d->nc", turned, at_mm[start])
    turned[:lift], at_mm[:lift] = np.eye(3), 0
    return turned, at_mm


def _seen(frames: Frames, points_mm: Float64[np.ndarray, "n k 3"]) -> Float64[np.ndarray, "n k 3"]:
    """Points of the table's frame in others, which are frames of that."""
    return np.einsum("nkc,nca->nka", points_mm - frames[1][:, None], frames[0])


class _Surface:
    """A part, and coal's tree of boxes round it. InputError: it has no faces."""

    def __init__(self, name: str, mesh: Mesh) -> None:
        import coal

        if not len(mesh.faces):
            raise InputError(f"{name} has no surface that could be checked.")
        self.mesh, self._tree = mesh, coal.BVHModelOBBRSS()
        self._tree.beginModel(len(mesh.faces), len(mesh.vertices_mm))
        self._tree.addVertices(np.array(mesh.vertices_mm))
        self._tree.addTriangles(mesh.faces.astype(np.int64))
        self._tree.endModel()
        self.middle_mm = mesh.box_mm.mean(0)
        self.radius_mm = float(np.linalg.norm(mesh.vertices_mm - self.middle_mm, axis=1).max())

    def distance(self, ends_mm: Float64[np.ndarray, "2 3"], radius_mm: float) -> _Found:
        """From a cylinder to the surface (0: they cross), or from a point: two equal ends."""
        import coal

        axis, turned, solid = ends_mm[0] - ends_mm[1], np.eye(3), coal.Sphere(0.0)
        if radius_mm:
            turned = rotation_onto(np.array([0.0, 0.0, 1.0]), axis)
            solid = coal.Cylinder(radius_mm, float(np.linalg.norm(axis)))
        place, result = coal.Transform3s(turned, ends_mm.mean(0)), coal.DistanceResult()
        request = coal.DistanceRequest(True, True)  # a crossing has a place only with its depth
        mm = coal.distance(solid, place, self._tree, coal.Transform3s(), request, result)
        return max(float(mm), 0.0), result.getNearestPoint2()


class _Search:
    """The least distance of one solid to one part, both in the part's frame."""

    def __init__(self, surface: _Surface, ends_mm: Ends, radius_mm: float) -> None:
        self._surface, self._ends_mm, self._radius_mm = surface, ends_mm, radius_mm
        along = ends_mm[:, 0] - ends_mm[:, 1]
        self._length_mm = float(np.linalg.norm(along[0]))
        # No point of a cylinder moves farther than an end of its axis and its rim as it turns.
        way_mm = np.linalg.norm(np.diff(ends_mm, axis=0), axis=2).max(1)
        rim_mm = radius_mm / self._length_mm * np.linalg.norm(np.diff(along, axis=0), axis=1)
        self._moved_mm = np.append(0.0, np.cumsum(way_mm + rim_mm))
        off_mm = ends_mm.mean(1) - surface.middle_mm
        ahead_mm = np.abs((off_mm * along).sum(1)) / self._length_mm
        aside_mm = np.sqrt(np.maximum((off_mm**2).sum(1) - ahead_mm**2, 0)) - radius_mm
        beyond_mm = np.maximum([aside_mm, ahead_mm - self._length_mm / 2], 0)
        self._ball_mm = np.hypot(*beyond_mm) - surface.radius_mm  # distance to a ball round it
        self._gap, self._depth = cache(self._gap_at), cache(self._depth_at)

    def least(self, among: Int64[np.ndarray, " k"]) -> tuple[int, float, np.ndarray]:
        """The pose, the distance there and the nearest place of the part."""
        if not self._meets:
            pose, mm = self._least_gap(among)
            return pose, mm, self._gap(pose)[1]
        pose, mm = _least(lambda n: self._depth(n)[0], self._moved_mm, among)
        return pose, mm, self._depth(pose)[1]

    @cached_property
    def _meets(self) -> bool:
        """The part is closed, and the solid begins in it or comes to it at any pose."""
        if not self._surface.mesh.closed:
            return False
        _, mm = self._least_gap(np.arange(len(self._ends_mm)))
        return mm <= _EXACT_MM or bool(contains(self._surface.mesh, self._ends_mm[0]).any())

    def _least_gap(self, among: Int64[np.ndarray, " k"]) -> tuple[int, float]:
        first = int(among[np.argmin(self._ball_mm[among])])
        most_mm = max(self._gap(first)[0], self._ball_mm[first]) + _EXACT_MM
        near = among[~(self._ball_mm[among] > most_mm)]
        return _least(lambda n: self._gap(n)[0], self._moved_mm, near, enough_mm=0.0)

    def _gap_at(self, pose: int) -> _Found:
        return self._surface.distance(self._ends_mm[pose], self._radius_mm)

    def _depth_at(self, pose: int) -> _Found:
        """Negative: of the deepest point of the axis; else no more than the axis' distance."""
        along_mm = np.linspace(0, self._length_mm, int(self._length_mm / _APART_MM) + 2)
        first, last = self._ends_mm[pose]
        axis_mm = first + along_mm[:, None] / self._length_mm * (last - first)
        inside = np.flatnonzero(contains(self._surface.mesh, axis_mm))
        if not len(inside):
            return self._gap(pose)
        wall = cache(lambda n: self._surface.distance(axis_mm[[n, n]], 0.0))
        deepest, mm = _least(lambda n: -wall(n)[0], along_mm, inside)
        return mm, wall(deepest)[1]


def _least(
    value: Callable[[int], float],
    moved_mm: Float64[np.ndarray, " n"],
    among: Int64[np.ndarray, " k"],
    enough_mm: float = -np.inf,
) -> tuple[int, float]:
    """Where a value that changes by no more than ``moved_mm`` does is least, and that value: NaN
    if it changes by more. ``enough_mm``: no need to look for less."""
    at_mm, last = moved_mm[among], len(among) - 1
    seen = {n: value(int(among[n])) for n in (0, last)}
    best = min(seen, key=seen.__getitem__)
    new, waiting = [(0, last)], list[tuple[float, int, int]]()
    while True:
        for left, right in new:
            distance_mm = float(at_mm[right] - at_mm[left])
            if not abs(seen[left] - seen[right]) <= distance_mm + _DOUBTFUL_MM:
                return int(among[right]), np.nan
            if right - left > 1:
                bound_mm = (seen[left] + seen[right] - distance_mm) / 2
                heapq.heappush(waiting, (bound_mm, left, right))
        if seen[best] <= enough_mm or not waiting or waiting[0][0] >= seen[best] - _EXACT_MM:
            return int(among[best]), seen[best]
        _, left, right = heapq.heappop(waiting)
        lowest_mm = (at_mm[left] + at_mm[right] + seen[left] - seen[right]) / 2
        middle = int(np.clip(np.searchsorted(at_mm, lowest_mm), left + 1, right - 1))
        seen[middle] = value(int(among[middle]))
        best = min(best, middle, key=seen.__getitem__)
        new = [(left, middle), (middle, right)]


def clearances(
    urdf: str, motions: Motions, parts: Mapping[str, Mesh], carried: Collection[str]
) -> tuple[Clearance, ...]:
    """Of each solid of the tools from each of ``parts``: surfaces of tumors and structures,
    table frame, mm (one that is open has no depth: crossed, it is at 0). Those ``carried`` move
    with the holder's tip from the beginning of ``Stage.LIFT``. ArtifactError: no cell's URDF.
    InputError: nothing to be checked."""
    if unknown := set(carried) - set(parts):
        raise InputError(f"{', '.join(sorted(unknown))} would be carried and is no part.")
    cell, found = UrdfCell(urdf), []
    poses = _Poses(cell, cell.solids, motions, STEP_MM)
    every, cuts = np.arange(len(poses.cuts)), np.flatnonzero(poses.cuts)
    surfaces = {name: _Surface(name, mesh) for name, mesh in parts.items()}
    for solid, ends_mm in zip(cell.solids, poses.ends_mm, strict=True):
        seen_mm = _seen(poses.piece, ends_mm)
        for name, surface in surfaces.items():
            search = _Search(surface, seen_mm if name in carried else ends_mm, solid.radius_mm)
            pose, mm, place_mm = search.least(every)
            cuts_it = solid.name == ELECTRODE and len(cuts)
            energised_mm = search.least(cuts)[1] if cuts_it else None
            if name in carried:
                place_mm = poses.piece[0][pose] @ place_mm + poses.piece[1][pose]
            x, y, z = place_mm.tolist()
            stage, at_s = poses.when(pose)
            found.append(Clearance(solid.name, name, mm, energised_mm, stage, at_s, (x, y, z)))
    return tuple(found)


def faults(
    found: Sequence[Clearance], least_mm: Mapping[str, float], taken: Collection[str]
) -> list[str]:
    """What forbids the motions, a sentence each. ``least_mm``: by part, what electrode and shaft
    must keep, less ``TOLERANCE_MM``; the other solids may touch ``taken``, the tumors that come
    away, and no other part named here."""
    known = {one.part for one in found if one.solid == ELECTRODE}
    lacking = [f"How near the electrode comes to {n} is unknown." for n in {*least_mm} - known]
    return sorted(lacking) + [text for one in found if (text := _fault(one, least_mm, taken))]


def _fault(one: Clearance, least_mm: Mapping[str, float], taken: Collection[str]) -> str:
    if not np.isfinite([one.least_mm, one.energised_mm or 0.0]).all():
        return f"How near the {one.solid} comes to {one.part} cannot be computed."
    needs_mm = least_mm.get(one.part)
    if needs_mm is None:
        return ""
    needs = ""
    if one.solid in IN_TISSUE:
        kept, needs = one.least_mm >= needs_mm - TOLERANCE_MM, f", which needs {needs_mm:.1f} mm"
    else:
        kept = one.least_mm > 0 or one.part in taken
    if kept:
        return ""
    how = f"comes within {one.least_mm:.1f} mm of" if one.least_mm > 0 else "touches"
    if one.least_mm < 0:
        how = f"goes {-one.least_mm:.1f} mm deep into"
    x, y, z = one.place_mm
    where = f"{one.at_s:.1f} s after {one.stage} began, at x {x:.0f}, y {y:.0f}, z {z:.0f} mm"
    return f"The {one.solid} {how} {one.part}{needs}: {where} (table frame)."


def electrode_poses(
    urdf: str, motions: Motions, step_mm: float = STEP_MM
) -> tuple[Ends, Bool[np.ndarray, " n"]]:
    """Tip and rear end of the bare electrode's axis (table frame, mm), at most ``step_mm`` from
    one pose to the next, and whether it cuts. Errors as of ``clearances``."""
    cell = UrdfCell(urdf)
    solids = [next(solid for solid in cell.solids if solid.name == ELECTRODE)]
    poses = _Poses(cell, solids, motions, step_mm)
    return poses.ends_mm[0], poses.cuts


def electrode_line(urdf: str) -> Callable[[Joints], Float64[np.ndarray, "2 3"]]:
    """From both arms' joints to the same ends."""
    cell = UrdfCell(urdf)
    solids = [next(solid for solid in cell.solids if solid.name == ELECTRODE)]
    return lambda joints_rad: cell.ends(solids, joints_rad[None])[0][0]


def checked(plan: ResectionPlan, motions: Motions, urdf: str, located: Located) -> ResectionPlan:
    """The plan with its ``clearances``; ``located``: what it was planned on. Raises NoPlan: a
    tool comes nearer to something than it may. The paper's method is not refused, but says what
    it does to the tumor. An instrument that withdraws is not checked: it goes straight back."""
    if motions.stages[0].name == Stage.WITHDRAW:
        motions = Motions(motions.stages[1:])
    organ = organ_name(located.meshes)
    parts = {name: mesh for name, mesh in located.surfaces.items() if name != organ}
    found = clearances(urdf, motions, parts, plan.taken)
    published = plan.method == "published"
    needed = {name: plan.margin_mm for name in plan.taken if not published} | plan.keep_mm
    if wrong := faults(found, needed, plan.taken):
        raise NoPlan(f"{wrong[0]} Ask for another margin, or place the organ otherwise.")
    plan = replace(plan, clearances=found)
    harm = [
        f"{CUTS_TUMOR} {name}, up to {-mm:.1f} mm deep"
        for name, mm in plan.least_mm.items()
        if mm < 0 and is_tumor(name)
    ]
    touched = [
        f"the {each.solid} touches {each.part}" for each in found
        if each.least_mm <= 0 and each.solid not in IN_TISSUE and each.part in plan.taken
    ]  # fmt: skip
    notes = [*(f"{words}." for words in harm), *plan.notes, *(f"{words}." for words in touched)]
    return replace(plan, notes=tuple(notes))
