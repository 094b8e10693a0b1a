"""The instrument's way through a plan's cuts: directions, leads in and out, legs."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float64

from tumortrack.core.types import Mesh
from tumortrack.imaging.meshes import solid_of
from tumortrack_resection.arms.body import ELECTRODE_RADIUS_MM, PENCIL_RADIUS_MM
from tumortrack_resection.arms.cell import Blocked, PlanningGroup
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.arms.kinematics import Pose, level_pose, yaw_of
from tumortrack_resection.arms.paths import connect, follow, resampled
from tumortrack_resection.arms.trajectory import TrajectoryBuilder
from tumortrack_resection.motions import CUTTER, HOLDER
from tumortrack_resection.values import Cut, ResectionPlan

_STEP_MM = 2.0  # between poses on a cut
_AIR_STEP_MM = 5.0  # on the straight lead-in and lead-out
_LINK_MM = 12.0  # strokes whose ends are no farther apart are one pass
_CLEAR_MM = 6.0  # distance of the tip from the organ before it moves elsewhere
_CORNER = np.cos(np.radians(40.0))  # at sharper corners the tip stops
_WALL_MM = 1.5  # the outline counts as part of the piece
_FAR_MM = 1000.0
_YAWS = 24
_PROBE_STEP = 3  # points of a pass between comparisons of directions
_TISSUE_BIN_MM = 3.0  # smaller differences in cut tissue do not count
_MOST_LEGS = 8  # of a pass
_FAR_RAD = 2.0  # a joint turns farther only if nothing else is possible
_SEARCHED = 4  # directions for which a path is searched by trees
# Between passes the tip may go back and up first, mm: most often that is free
DETOURS_MM = ((60.0, 0.0), (0.0, 70.0), (60.0, 70.0), (0.0, 140.0))


def cut_pass(
    builder: TrajectoryBuilder, path_mm: Float64[np.ndarray, "n 3"], around: Surroundings
) -> None:
    """The instrument along a pass, in as few legs as possible: between two it leaves and comes from
    another side. Raises Blocked: somewhere no direction is possible; with the most frequent
    reason."""
    for _ in range(_MOST_LEGS):
        done = _cut_leg(builder, path_mm, around)
        if done == len(path_mm) - 1:
            return
        path_mm = path_mm[done:]
    raise Blocked(f"a cut would need more than {_MOST_LEGS} directions of the {CUTTER}")


def _cut_leg(builder: TrajectoryBuilder, path_mm: np.ndarray, around: Surroundings) -> int:
    """The longest first leg; returns the number of the point where it ends."""
    away, inside = builder.group(CUTTER, (HOLDER,)), builder.group(CUTTER, (CUTTER, HOLDER))
    reasons: list[Blocked] = []
    later: list[tuple[float, Leg, np.ndarray]] = []
    for yaw, last in _directions(path_mm, around, inside):
        candidate = leg(path_mm[: last + 1], yaw, around)
        try:
            joints = follow(inside, candidate.poses)
            turn = float(np.abs(joints[0] - away.current_rad).max())
            later.append((turn, candidate, joints))
            if turn > _FAR_RAD:
                continue
            approach = connect(away, joints[0], detours=_detours(away, candidate))
        except Blocked as blocked:
            reasons.append(blocked)
        else:
            return _execute(builder, candidate, approach, joints)
    for _, candidate, joints in sorted(later, key=lambda each: each[0])[:_SEARCHED]:
        try:
            approach = connect(away, joints[0], builder.rng, _detours(away, candidate))
        except Blocked:
            continue
        return _execute(builder, candidate, approach, joints)
    if reasons:
        often = Counter(str(blocked) for blocked in reasons).most_common(1)[0][0]
        raise next(blocked for blocked in reasons if str(blocked) == often)
    x, y, z = path_mm[0]
    raise Blocked(
        f"the {CUTTER} reaches ({x:.0f}, {y:.0f}, {z:.0f}) mm from no direction: its grip would "
        f"be in the organ, or its electrode at the {HOLDER}"
    )


def _directions(
    path_mm: np.ndarray, around: Surroundings, group: PlanningGroup
) -> list[tuple[float, int]]:
    """Possible directions of the instrument (yaw, radians), each with the last point of the path it
    reaches; the best first: farthest, then least healthy tissue cut beside the outline, then least
    turning of joints."""
    probes = np.unique(np.r_[np.arange(0, len(path_mm), _PROBE_STEP), len(path_mm) - 1])
    now = yaw_of(group.cell.tips(group.joints_rad)[CUTTER])
    yaws = now + np.linspace(0, 2 * np.pi, _YAWS, endpoint=False)
    fits = around.fits(path_mm[probes], yaws)
    tissue_mm = around.tissue_mm(path_mm[probes], yaws)
    scores = []
    for n, yaw in enumerate(yaws):
        run = int(np.argmin(np.r_[fits[n], False])) - 1  # the last probe before the first misfit
        if run < 1:
            continue
        turns = group.inverse_kinematics(level_pose(path_mm[0], yaw)) - group.current_rad
        if len(turns):
            bins = round(float(tissue_mm[n, : run + 1].mean()) / _TISSUE_BIN_MM)
            scores.append((-run, bins, float(np.abs(turns).max(1).min()), float(yaw)))
    return [(yaw, int(probes[-run])) for run, _, _, yaw in sorted(scores)]


def _detours(group: PlanningGroup, leg: Leg) -> list[np.ndarray]:
    """Corners of detours: back and up, across, and down again."""
    there = level_pose(leg.enter_mm[0], leg.yaw_rad)
    here = group.cell.tips(group.joints_rad)[CUTTER]
    detours = [[aside(group, pose, *by) for pose in (here, there)] for by in DETOURS_MM]
    return [np.array(corners) for corners in detours if all(len(corner) for corner in corners)]


def aside(
    group: PlanningGroup, table_from_tip: Pose, back_mm: float, up_mm: float
) -> Float64[np.ndarray, " d"]:
    """The moving arm's joints with its tip back and up from a pose; empty if out of reach."""
    moved = table_from_tip.copy()
    moved[:3, 3] += [0.0, 0.0, up_mm] - back_mm * table_from_tip[:3, 0]
    solutions = group.inverse_kinematics(moved)
    if not len(solutions):
        return np.zeros(0)
    return solutions[np.abs(solutions - group.current_rad).max(1).argmin()]


def _execute(
    builder: TrajectoryBuilder, leg: Leg, approach_rad: np.ndarray, joints_rad: np.ndarray
) -> int:
    builder.go(CUTTER, approach_rad)
    for run, cutting in leg.runs:
        builder.go(CUTTER, joints_rad[run], builder.cell.config.cutting_mm_s, cutting)
    return len(leg.cut_mm) - 1


def passes(cuts: Iterable[Cut]) -> list[Float64[np.ndarray, "n 3"]]:
    """The tip's paths, closely spaced: strokes in order, joined if one begins beside the end of the
    last."""
    paths: list[np.ndarray] = []
    for cut in cuts:
        if paths and np.linalg.norm(paths[-1][-1] - cut.path_mm[0]) <= _LINK_MM:
            paths[-1] = np.concatenate([paths[-1], cut.path_mm])
        else:
            paths.append(cut.path_mm)
    steps = (np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-6 for path in paths)
    return [
        resampled(path[np.r_[True, moves]], _STEP_MM)
        for path, moves in zip(paths, steps, strict=True)
    ]


class Surroundings:
    """Organ, piece and grasper as polygons at a height, seen from above."""

    def __init__(self, organ: Mesh, config: CellConfig, plan: ResectionPlan) -> None:
        self._solid = solid_of(organ, "the organ's surface")
        self._layers, self._grasp_mm, self._config = plan.layers, plan.grasp_mm, config
        electrode_mm = ELECTRODE_RADIUS_MM + config.contact_mm
        # A little less than what collides: the exact test follows.
        pencil_mm = 0.8 * (PENCIL_RADIUS_MM + config.organ_clearance_mm)
        pencil_cup_mm = PENCIL_RADIUS_MM + config.clearance_mm
        clear_cup_mm = ELECTRODE_RADIUS_MM + config.clearance_mm + 1.0
        # By height: a plan has few different ones.
        self._organ = cache(self._section)
        self._healthy = cache(self._without_piece)
        self._bars_electrode = cache(lambda z: self._cup(z, electrode_mm))
        self._bars_pencil = cache(lambda z: self._near(z, pencil_mm, pencil_cup_mm))
        self._not_clear = cache(lambda z: self._near(z, _CLEAR_MM, clear_cup_mm))

    def depth_mm(self, point_mm: Float64[np.ndarray, " 3"]) -> float:
        """Thickness of the organ straight above a point."""
        x, y, z = (float(value) for value in point_mm)
        above = [h for h in range(2, 200, 2) if shapely.contains_xy(self._organ(z + h), x, y)]
        return float(max(above, default=0))

    def back_out_mm(self, tip_mm: Float64[np.ndarray, " 3"], yaw_rad: float) -> float:
        """Distance straight back until the tip is clear of organ and grasper for good."""
        ray = _lines(tip_mm[None], np.array([yaw_rad]), _FAR_MM)[0, 0]
        within = shapely.intersection(ray, self._not_clear(float(tip_mm[2])))
        inside = shapely.get_coordinates(within)
        return float(np.linalg.norm(inside - tip_mm[:2], axis=1).max(initial=0.0))

    def tissue_mm(
        self, tips_mm: Float64[np.ndarray, "n 3"], yaws_rad: Float64[np.ndarray, " y"]
    ) -> Float64[np.ndarray, "y n"]:
        """Length of the instrument in healthy tissue, outside the piece, at these places."""
        lines = _lines(tips_mm, yaws_rad, self._config.electrode_mm + self._config.pencil_mm)
        return shapely.length(shapely.intersection(lines, _at(self._healthy, tips_mm)))

    def fits(
        self, tips_mm: Float64[np.ndarray, "n 3"], yaws_rad: Float64[np.ndarray, " y"]
    ) -> Bool[np.ndarray, "y n"]:
        """Whether the level instrument keeps clear of the grasper, and its grip of the organ."""
        bare = self._config.electrode_mm
        electrode = _lines(tips_mm, yaws_rad, bare)
        pencil = _lines(tips_mm, yaws_rad, bare + self._config.pencil_mm, bare)
        return ~(
            shapely.intersects(electrode, _at(self._bars_electrode, tips_mm))
            | shapely.intersects(pencil, _at(self._bars_pencil, tips_mm))
        )

    def _section(self, height_mm: float) -> Any:
        """The organ's section at this height."""
        # Even-odd: holes come as rings of their own.
        section = shapely.Polygon()
        for ring in self._solid.slice(height_mm).to_polygons():
            section = section.symmetric_difference(shapely.Polygon(ring).buffer(0))
        return section.simplify(0.1)

    def _without_piece(self, height_mm: float) -> Any:
        rings = [
            shapely.Polygon(ring).buffer(_WALL_MM)
            for layer in self._layers
            if layer.bottom_mm - _WALL_MM <= height_mm <= layer.top_mm + _WALL_MM
            for ring in layer.rings_mm
        ]
        return self._organ(height_mm).difference(shapely.union_all(rings))

    def _cup(self, height_mm: float, around_mm: float) -> Any:
        """The grasper's surroundings at this height."""
        if height_mm + around_mm < self._grasp_mm[2]:
            return shapely.Polygon()
        radius = self._config.cup_radius_mm + around_mm
        return shapely.Point(self._grasp_mm[:2]).buffer(radius, 6)

    def _near(self, height_mm: float, organ_mm: float, cup_mm: float) -> Any:
        """All within a margin of the organ (slightly more) or of the grasper at this height."""
        heights = (height_mm - organ_mm, height_mm, height_mm + organ_mm)
        organ = shapely.union_all([self._organ(h) for h in heights]).buffer(organ_mm, 4)
        return shapely.union(organ, self._cup(height_mm, cup_mm))


@dataclass(frozen=True, eq=False)
class Leg:
    """A piece of a pass in one direction: the tip's lead-in, cut and lead-out, mm."""

    yaw_rad: float
    enter_mm: Float64[np.ndarray, "i 3"]
    cut_mm: Float64[np.ndarray, "n 3"]
    leave_mm: Float64[np.ndarray, "o 3"]

    @property
    def poses(self) -> Float64[np.ndarray, "m 4 4"]:
        """``table_from_tip`` along the whole leg; corners are there once."""
        tips = np.concatenate([self.enter_mm[:-1], self.cut_mm, self.leave_mm[1:]])
        return level_poses(tips, self.yaw_rad)

    @property
    def runs(self) -> list[tuple[slice, bool]]:
        """Slices of ``poses`` without a stop, and whether they cut; each begins where the last
        ends. At sharp corners of the cut the tip stops."""
        edges = np.diff(self.cut_mm, axis=0)
        edges /= np.linalg.norm(edges, axis=1, keepdims=True)
        corners = np.flatnonzero((edges[1:] * edges[:-1]).sum(1) < _CORNER) + 1
        ends = [0, *corners.tolist(), len(self.cut_mm) - 1]
        first, last = len(self.enter_mm) - 1, len(self.enter_mm) + len(self.cut_mm) - 2
        cuts = [(slice(first + a, first + b + 1), True) for a, b in itertools.pairwise(ends)]
        leave = slice(last, last + len(self.leave_mm))
        runs = [(slice(0, first + 1), False), *cuts, (leave, False)]
        return [(run, cutting) for run, cutting in runs if run.stop - run.start > 1]


def leg(cut_mm: Float64[np.ndarray, "n 3"], yaw_rad: float, around: Surroundings) -> Leg:
    """With a straight lead-in to the first point and lead-out from the last, along the instrument's
    axis, where it cuts nothing more."""
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
    leads = []
    for tip in (cut_mm[0], cut_mm[-1]):
        far = max(around.back_out_mm(tip, yaw_rad), _AIR_STEP_MM)
        steps = int(np.ceil(far / _AIR_STEP_MM)) + 1
        leads.append(tip - np.linspace(0, far, steps)[:, None] * ahead)
    return Leg(yaw_rad, leads[0][::-1], cut_mm, leads[1])


def level_poses(
    tips_mm: Float64[np.ndarray, "n 3"], yaw_rad: float
) -> Float64[np.ndarray, "n 4 4"]:
    """``table_from_tip`` of a level instrument that points towards the yaw."""
    return np.array([level_pose(tip, yaw_rad) for tip in tips_mm])


def _at(section: Any, tips_mm: np.ndarray) -> list[Any]:
    return [section(float(height)) for height in tips_mm[:, 2]]


def _lines(
    tips_mm: np.ndarray, yaws_rad: np.ndarray, to_mm: float, from_mm: float = 0.0
) -> np.ndarray:
    """Lines (y, n) back from each tip against each direction, seen from above."""
    ahead = np.stack([np.cos(yaws_rad), np.sin(yaws_rad)], 1)[:, None]
    ends = [tips_mm[None, :, :2] - far * ahead for far in (from_mm, to_mm)]
    return shapely.linestrings(np.stack(ends, axis=2))
