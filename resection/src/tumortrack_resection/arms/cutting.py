"""The instrument's way through a plan's cuts: directions, leads in and out, passes."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from tumortrack.core.geometry import rigid
from tumortrack.core.types import Mesh
from tumortrack_resection.arms.cell import ArmCell, Blocked, CollidingPair, PlanningGroup
from tumortrack_resection.arms.config import ELECTRODE_RADIUS_MM
from tumortrack_resection.arms.kinematics import Pose, level_pose, nearest_turn
from tumortrack_resection.arms.paths import connect, follow, resampled
from tumortrack_resection.arms.trajectory import TrajectoryBuilder
from tumortrack_resection.motions import CUTTER, HOLDER
from tumortrack_resection.values import Cut

_STEP_MM = 2.0  # between poses on a cut
_AIR_STEP_MM = 5.0  # on the straight lead-in and lead-out
_CORNER = np.cos(np.radians(40.0))  # at sharper corners the tip stops
_YAWS = 24  # of a level instrument
_ROLLS, _LEAP = 12, 5  # about the electrode's own axis, and between two that are tried
_PROBE_STEP = 3  # points of a level stroke between comparisons of directions
_MOST_LEGS = 8  # of a level stroke
_FAR_RAD = 2.0  # a joint turns farther only if nothing else is possible
_TRIED, _ENOUGH = 4, 3  # legs of a pass that are tried whole, and that are enough of a facet
_SEARCHED = 4  # legs of a level stroke whose approach is searched by trees
_FARTHEST_MM = 200.0  # the instrument goes back so far, to be clear of organ and tumors
_SPREAD_MM = 2.0  # between points of the organ's surface
# Between passes the tip may go back and up first, mm: most often that is free
DETOURS_MM = ((60.0, 0.0), (0.0, 70.0), (60.0, 70.0), (0.0, 140.0))


class Outside:
    """How far the instrument has to go straight back until its electrode is clear of the organ,
    of all that it keeps away from (``things``, with distances in mm), and of the cup that holds
    it (at ``grasp_mm``, coming from ``lift``)."""

    def __init__(
        self,
        cell: ArmCell,
        things: Sequence[tuple[Mesh, float]],
        grasp_mm: np.ndarray,
        lift: np.ndarray,
    ) -> None:
        config = cell.config
        slack_mm = ELECTRODE_RADIUS_MM + _SPREAD_MM
        rod_mm = grasp_mm + np.outer(np.arange(0.0, config.rod_mm, _SPREAD_MM), lift)
        self._obstacles = [
            (cKDTree(mesh.spread_mm(_SPREAD_MM)), mm + config.organ_clearance_mm + slack_mm)
            for mesh, mm in things
        ]
        self._obstacles.append(
            (cKDTree(rod_mm), config.cup_radius_mm + config.clearance_mm + slack_mm)
        )
        self._longest_mm = config.electrode_mm

    def back_mm(self, tip: Float64[np.ndarray, " 3"], ahead: Float64[np.ndarray, " 3"]) -> float:
        """Of an instrument that points ``ahead``. 0: it is clear where it is."""
        along = np.arange(0.0, _FARTHEST_MM + self._longest_mm, _SPREAD_MM)
        points = tip - along[:, None] * ahead
        near = np.zeros(len(points), bool)
        for tree, room_mm in self._obstacles:
            near |= tree.query(points, distance_upper_bound=room_mm)[0] < room_mm
        return float(along[near].max() + _SPREAD_MM) if near.any() else 0.0


@dataclass(frozen=True, eq=False)
class Leg:
    """Poses of the tip (``table_from_tip``) on a cut in one direction: lead-in, cut, lead-out."""

    enter: Float64[np.ndarray, "i 4 4"]
    cut: Float64[np.ndarray, "n 4 4"]
    leave: Float64[np.ndarray, "o 4 4"]

    @classmethod
    def along(
        cls, path_mm: Float64[np.ndarray, "n 3"], turn: np.ndarray, back_mm: Sequence[float]
    ) -> Leg:
        """With a straight lead-in and lead-out along the instrument's axis, where it cuts
        nothing more; each so long. ``turn``: table from tip (3, 3)."""
        cut = poses(path_mm, turn)
        leads = [straight_back(cut[n], far) for n, far in zip((0, -1), back_mm, strict=True)]
        return cls(leads[0][::-1], cut, leads[1])

    @property
    def poses(self) -> Float64[np.ndarray, "m 4 4"]:
        return np.concatenate([self.enter[:-1], self.cut, self.leave[1:]])

    @property
    def runs(self) -> list[tuple[slice, bool]]:
        """Slices of ``poses`` without a stop, and whether they cut; at sharp corners the tip
        stops."""
        edges = np.diff(self.cut[:, :3, 3], axis=0)
        edges /= np.linalg.norm(edges, axis=1, keepdims=True)
        corners = np.flatnonzero((edges[1:] * edges[:-1]).sum(1) < _CORNER) + 1
        ends = [0, *corners.tolist(), len(self.cut) - 1]
        first, last = len(self.enter) - 1, len(self.enter) + len(self.cut) - 2
        cuts = [(slice(first + a, first + b + 1), True) for a, b in itertools.pairwise(ends)]
        leave = slice(last, last + len(self.leave))
        runs = [(slice(0, first + 1), False), *cuts, (leave, False)]
        return [(run, cutting) for run, cutting in runs if run.stop - run.start > 1]


def poses(tips_mm: Float64[np.ndarray, "n 3"], turn: np.ndarray) -> Float64[np.ndarray, "n 4 4"]:
    """``table_from_tip`` at these places, all turned alike (3, 3)."""
    return np.array([rigid(turn, tip) for tip in tips_mm])


def straight_back(table_from_tip: Pose, far_mm: float) -> Float64[np.ndarray, "n 4 4"]:
    """From a pose back along the instrument's axis."""
    steps = np.linspace(0, far_mm, int(np.ceil(far_mm / _AIR_STEP_MM)) + 1)
    tips = table_from_tip[:3, 3] - steps[:, None] * table_from_tip[:3, 0]
    return poses(tips, table_from_tip[:3, :3])


def turns_about(axis: Float64[np.ndarray, " 3"], count: int = _ROLLS) -> list[np.ndarray]:
    """Table from tip (3, 3) of an instrument that points along ``axis``, turned about it."""
    aside = np.eye(3)[np.abs(axis).argmin()]
    first = np.cross(axis, aside) / np.linalg.norm(np.cross(axis, aside))
    second = np.cross(axis, first)
    angles = 2 * np.pi * np.arange(count) / count
    ups = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    return [np.stack([axis, np.cross(up, axis), up], axis=1) for up in ups]


class Way(NamedTuple):
    """One way to carry a pass out, and its joints at the leg's poses."""

    cut: Cut
    leg: Leg
    joints_rad: Float64[np.ndarray, "n 6"]


def ways(group: PlanningGroup, cuts: Sequence[Cut], outside: Outside) -> list[Way]:
    """How the arm can carry one of several passes out that are as good as one another: in either
    direction, turned about the electrode's axis; without the approach. Raises Blocked: the most
    frequent reason."""
    reasons: list[Blocked] = []
    found: list[Way] = []
    for cut in cuts:
        for oriented, leg in itertools.islice(_legs(group, cut, outside, reasons), _TRIED):
            try:
                found.append(Way(oriented, leg, follow(group, leg.poses)))
            except Blocked as blocked:
                reasons.append(blocked)
            if len(found) == _ENOUGH:
                return found
    if not found:
        raise _most_frequent(reasons, cuts[0].path_mm[0])
    return found


def _legs(
    group: PlanningGroup, cut: Cut, outside: Outside, reasons: list[Blocked]
) -> Iterator[tuple[Cut, Leg]]:
    """Those whose first, middle and last pose are possible, and from whose middle the instrument
    can go straight back. Turns that are alike do not follow one another."""
    assert cut.axis is not None
    path_mm = resampled(cut.path_mm, _STEP_MM)
    places = path_mm[[len(path_mm) // 2, 0, -1]]
    middle_mm, *back_mm = (outside.back_mm(place, cut.axis) for place in places)
    back = places[0] - middle_mm * cut.axis
    turns = turns_about(cut.axis)
    for n in range(len(turns)):
        turn = turns[_LEAP * n % len(turns)]
        if any(free(group, rigid(turn, place), reasons) is None for place in (*places, back)):
            continue
        for way in (1, -1):
            leg = Leg.along(path_mm[::way], turn, back_mm[::way])
            if free(group, leg.enter[0], reasons) is not None:
                yield replace(cut, path_mm=cut.path_mm[::way]), leg


def go_one_of(builder: TrajectoryBuilder, ways: Sequence[Way]) -> Cut:
    """Approach and carry out the nearest way, or one that can be reached at all. Raises Blocked."""
    away, reasons = builder.group(CUTTER, (HOLDER,)), list[Blocked]()
    turned: list[tuple[float, int, Way]] = []
    for way in ways:
        first = way.joints_rad[0]
        shift = nearest_turn(away.model, first, away.current_rad) - first
        joints = way.joints_rad + shift
        if (np.abs(joints) > away.limits_rad).any():
            joints = way.joints_rad
        far = float(np.abs(joints[0] - away.current_rad).max())
        turned.append((far, len(turned), way._replace(joints_rad=joints)))
    for search in (False, True):
        for far, _, way in sorted(turned, key=lambda each: each[:2]):
            if search or far <= _FAR_RAD:
                try:
                    _execute(builder, way, search)
                except Blocked as blocked:
                    reasons.append(blocked)
                else:
                    return way.cut
    raise _most_frequent(reasons, ways[0].cut.path_mm[0])


def free(
    group: PlanningGroup, table_from_tip: Pose, reasons: list[Blocked] | None = None
) -> Float64[np.ndarray, " 6"] | None:
    """The nearest joints that bring the tip there without a collision; or None, and one more of
    ``reasons``."""
    solutions = group.inverse_kinematics(table_from_tip)
    pair: CollidingPair | None = None
    for n in np.argsort(np.abs(solutions - group.current_rad).max(1, initial=0.0)):
        if (pair := group.collides(solutions[n])) is None:
            return solutions[n]
    if pair is not None and reasons is not None:
        reasons.append(Blocked.by(pair))
    return None


def _execute(builder: TrajectoryBuilder, way: Way, search: bool) -> None:
    """Approach (``search``: by trees) and leg. Raises Blocked; nothing is added then."""
    away = builder.group(CUTTER, (HOLDER,))
    ends = builder.tip(CUTTER), way.leg.poses[0]
    corners = [[aside(away, pose, *by) for pose in ends] for by in DETOURS_MM]
    detours = [np.array(pair) for pair in corners if all(len(corner) for corner in pair)]
    approach = connect(away, way.joints_rad[0], builder.rng if search else None, detours)
    attempt = copy(builder)
    attempt.go(CUTTER, approach)
    for run, cutting in way.leg.runs:
        attempt.go(CUTTER, way.joints_rad[run], builder.cell.config.cutting_mm_s, cutting)
    builder.take(attempt)


def _most_frequent(reasons: list[Blocked], place_mm: np.ndarray) -> Blocked:
    if reasons:
        often = Counter(str(blocked) for blocked in reasons).most_common(1)[0][0]
        return next(blocked for blocked in reasons if str(blocked) == often)
    x, y, z = place_mm
    return Blocked(f"the {CUTTER} reaches ({x:.0f}, {y:.0f}, {z:.0f}) mm from no direction")


def cut_level(builder: TrajectoryBuilder, cut: Cut, outside: Outside) -> None:
    """A stroke of the level instrument, in as few legs as possible, each from another side.
    Raises Blocked: somewhere no direction is possible."""
    path_mm = resampled(cut.path_mm, _STEP_MM)
    for _ in range(_MOST_LEGS):
        path_mm = path_mm[_cut_leg(builder, cut, path_mm, outside) :]
        if len(path_mm) < 2:
            return
    raise Blocked(f"a cut would need more than {_MOST_LEGS} directions of the {CUTTER}")


def _cut_leg(builder: TrajectoryBuilder, cut: Cut, path_mm: np.ndarray, outside: Outside) -> int:
    """The longest first leg; returns the number of the point where it ends."""
    group, reasons = builder.group(CUTTER, (CUTTER, HOLDER)), list[Blocked]()
    probes = np.unique(np.r_[np.arange(0, len(path_mm), _PROBE_STEP), len(path_mm) - 1])
    legs: list[tuple[int, float, int, np.ndarray, int]] = []
    for turn in level_turns():
        first = free(group, rigid(turn, path_mm[0]), reasons)
        if first is None:
            continue
        clear = (free(group, rigid(turn, path_mm[n]), reasons) is None for n in probes[1:])
        run = next((n for n, blocked in enumerate(clear) if blocked), len(probes) - 1)
        if run > 0:
            turn_rad = float(np.abs(first - group.current_rad).max())
            legs.append((-run, turn_rad, len(legs), turn, int(probes[run])))
    for search in (False, True):
        for *_, turn, last in sorted(legs, key=lambda leg: leg[:3])[
            : _SEARCHED if search else None
        ]:
            try:
                part = path_mm[: last + 1]
                back_mm = tuple(outside.back_mm(part[n], turn[:, 0]) for n in (0, -1))
                leg = Leg.along(part, turn, back_mm)
                _execute(builder, Way(cut, leg, follow(group, leg.poses)), search)
            except Blocked as blocked:
                reasons.append(blocked)
            else:
                return last
    raise _most_frequent(reasons, path_mm[0])


def level_turns(count: int = _YAWS) -> list[np.ndarray]:
    """Table from tip (3, 3) of a level instrument, in directions all round."""
    yaws = 2 * np.pi * np.arange(count) / count
    return [level_pose(np.zeros(3), yaw)[:3, :3] for yaw in yaws]


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
