"""From a resection plan to motions of both arms; and the worker that replans beside the live
loop, in a process of its own."""

from __future__ import annotations

import itertools
import signal
from collections.abc import Container, Iterator
from copy import copy
from typing import NamedTuple

import msgspec
import numpy as np

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.geometry import rigid
from tumortrack_resection.arms import cutting
from tumortrack_resection.arms.cell import TOUCHES, ArmCell, Blocked, PlanningGroup
from tumortrack_resection.arms.config import Base, CellConfig
from tumortrack_resection.arms.cutting import Outside, Way, level_turns, turns_about
from tumortrack_resection.arms.kinematics import Pose, upright, yaw_of
from tumortrack_resection.arms.paths import connect, follow, out_of_reach
from tumortrack_resection.arms.trajectory import TrajectoryBuilder, first_hit
from tumortrack_resection.check import checked
from tumortrack_resection.drafts import Draft, Drafts
from tumortrack_resection.facets import UP
from tumortrack_resection.motions import ARMS, CUTTER, HOLDER, JOINTS, Joints, Motions, Stage
from tumortrack_resection.operation import Planned, ResectionProgress
from tumortrack_resection.values import Cut, Located, ResectionConfig, ResectionPlan

_VACUUM_S = 0.5  # until the cup holds
_LET_GO_S = 0.3
_TAUT_S = 1.0  # until the pulled tumor has been located
_ABOVE_MM = 60.0  # the cup comes from here, and goes back
_STEP_MM = 5.0
_GRIPS = 4  # ways of holding that are tried
# Places of a base round the organ: distance as a share of the arm's reach, and direction (degrees
# from the present one), in the order of trying.
_DISTANCES = (0.65, 0.5, 0.8)
_SIDES_DEG = (0.0, 30.0, -30.0, 60.0, -60.0)
_YAWS = 8  # in which a level instrument is asked to reach
_MOST_PIECES, _ELSEWHERE = 8, 3  # for which motions are planned, and with other bases
_HAND = tuple(f"{HOLDER}/{name}" for name in ("cup", "rod", "wrist_3"))
_ROOM_MM = 4.0  # between the arms beyond their clearance, so that they still manage later on
_MOST_TRIED = 4  # pairs of places for which motions are planned
_EDGE_MM = 120.0  # a base's middle is no nearer to the table's edge
_AWAY_MM = (-100.0, -50.0, 0.0, 50.0, 100.0)  # a tip's home, along each axis, where it is blocked


class Start(NamedTuple):
    """Where the arms are when they are planned for again. ``from_sweep``: the grasper holds
    already; begin with this sweep, from 1; one more than there are: lift, release and go home."""

    joints_rad: Joints
    from_sweep: int | None = None


class FacetsBlocked(Blocked):
    """Facets that the arms can't cut, by the numbers of their sweeps; the reason is the first's."""

    def __init__(self, blocked: dict[int, Blocked]) -> None:
        first = next(iter(blocked.values()))
        super().__init__(str(first), first.pair)
        self.numbers = tuple(blocked)


def plan_motions(
    located: Located,
    config: ResectionConfig,
    cell: CellConfig,
    start: Start | None = None,
    like: ResectionPlan | None = None,
    pieces: int = _MOST_PIECES,
    drafts: Drafts | None = None,
) -> tuple[ResectionPlan, Motions]:
    """A plan that both arms can carry out, and their motions; the same every time. Pieces are tried
    in the order of the healthy tissue that they take; a facet that the arms don't manage is left
    out of those that follow.

    Args:
        located: the organ as it lies now, table frame, mm.
        start: where the arms are, if not at home.
        like: an earlier plan with facets, which are kept; as it lies now.
        pieces: for so many motions are planned at most.
        drafts: of the same, if there are some already.

    Raises NoPlan: nothing to cut, or the arms manage no piece; InputError: no such start.
    """
    if start is not None:
        _check_start(start, cell)
    from_sweep = None if start is None else start.from_sweep
    done = None if like is None or from_sweep is None else from_sweep - 1
    drafts = drafts or Drafts(located, config, cell.tools, like, done)
    reason: Blocked | None = None
    roomy = start is None and config.method == "margin"
    rooms_mm: tuple[float, ...] = (_ROOM_MM, 0.0) if roomy else (0.0,)
    for _ in range(pieces):
        try:
            draft = drafts.best()
        except NoPlan:
            if reason is None:
                raise
            break
        for room_mm in rooms_mm:
            tried = msgspec.structs.replace(cell, clearance_mm=cell.clearance_mm + room_mm)
            try:
                return _attempt(draft, tried, start, np.random.default_rng(0))
            except Blocked as blocked:
                last = blocked
        reason, rooms_mm = reason or last, (0.0,)  # for the best piece alone: it takes as long
        if not isinstance(last, FacetsBlocked) or config.method == "published":
            break
        drafts.leave_out(last.numbers)
    raise NoPlan(
        f"the arms can't carry this out: {reason}. Place the arms or the organ otherwise, or plan "
        "with other margins."
    ) from reason


def _check_start(start: Start, cell: CellConfig) -> None:
    """Raises InputError: arms can't be there, or no sweep has that number."""
    joints = np.asarray(start.joints_rad)
    if joints.shape != (len(JOINTS),) or not (np.abs(joints) <= cell.limits_rad).all():
        raise InputError("the arms' start must be twelve joint angles within their limits.")
    if start.from_sweep is not None and start.from_sweep < 1:
        raise InputError(f"from_sweep is {start.from_sweep}; sweeps are counted from 1.")


def _attempt(
    draft: Draft, config: CellConfig, start: Start | None, rng: np.random.Generator
) -> tuple[ResectionPlan, Motions]:
    """The procedure with this piece. Raises Blocked."""
    located = draft.located
    cell = ArmCell(config, located.organ, draft.keep)
    joints_rad = cell.home_rad if start is None else start.joints_rad
    builder = TrajectoryBuilder(cell, joints_rad, rng)
    things = [(located.organ, 0.0), *draft.keep.values()]
    from_sweep = None if start is None else start.from_sweep
    cup_mm, lift = draft.grasp_mm, draft.lift
    if from_sweep is not None:  # it is where it is
        cup_mm, lift = builder.tip(HOLDER)[:3, 3], builder.tip(HOLDER)[:3, 2]
    outside = Outside(cell, things, cup_mm, lift)
    if start is not None:
        _withdraw(builder, outside, from_sweep is not None)
    if from_sweep is not None:
        return _cut_and_finish(builder, draft, outside, from_sweep)
    reason: Blocked | None = None
    for grip in _grips(builder, draft):
        try:
            attempt = copy(builder)
            _grasp(attempt, grip, draft.lift)
            return _cut_and_finish(attempt, draft, outside, 1)
        except Blocked as blocked:
            reason = reason or blocked
            pair = blocked.pair or ()
            if not any(name.startswith(HOLDER) and name not in _HAND for name in pair):
                break  # held otherwise, the holder's hand would be where it is
    assert reason is not None
    raise reason


def _grips(builder: TrajectoryBuilder, draft: Draft) -> Iterator[np.ndarray]:
    """Joint paths straight onto the grasp, those near the arm's present place first. The cup is
    round: how it is turned does not matter. Blocked: there is none."""
    group = builder.group(HOLDER, touching=(HOLDER,))
    turn = upright(draft.lift, yaw_of(builder.tip(HOLDER)))
    heights = np.linspace(_ABOVE_MM, 0, int(_ABOVE_MM / _STEP_MM) + 1)
    poses = cutting.poses(draft.grasp_mm + heights[:, None] * draft.lift, turn)
    starts = group.inverse_kinematics(poses[0])
    if not len(starts):
        raise out_of_reach(group, poses[0])
    reason: Blocked | None = None
    count = 0
    for start in sorted(starts, key=lambda start: np.abs(start - group.current_rad).max()):
        try:
            path = follow(group, poses, start)
        except Blocked as blocked:
            reason = reason or blocked
            continue
        if np.abs(path[0] - start).max() < 1e-6 and count < _GRIPS:
            count += 1
            yield path
    if not count and reason is not None:
        raise reason


def _grasp(builder: TrajectoryBuilder, grip_rad: np.ndarray, lift: np.ndarray) -> None:
    """Approach, grasp, hold and pull."""
    builder.go(HOLDER, connect(builder.group(HOLDER), grip_rad[0], builder.rng))
    builder.close("approach")
    builder.go(HOLDER, grip_rad, builder.cell.config.grasping_mm_s)
    builder.close("grasp")
    builder.wait(_VACUUM_S)
    builder.close(Stage.HOLD)
    if pull_mm := builder.cell.config.pull_mm:
        _rise(builder, lift, pull_mm, builder.cell.config.cutting_mm_s)
        builder.close(Stage.PULL)
        builder.wait(_TAUT_S)
        builder.close(Stage.TAUT)


def _cut_and_finish(
    builder: TrajectoryBuilder, draft: Draft, outside: Outside, first: int
) -> tuple[ResectionPlan, Motions]:
    """From this sweep on; the instrument has gone home before the piece is lifted."""
    if first > len(draft.sweeps) + 1:
        raise InputError(f"from_sweep is {first}; there are {len(draft.sweeps)} sweeps.")
    made = {*range(1, first), *draft.through}
    ways = {} if draft.level else _ways(builder, draft, outside, made)
    cuts: list[Cut] = []
    for sweep, choices in enumerate(draft.sweeps, start=1):
        try:
            if sweep in made:
                cuts.append(choices[0])
            elif draft.level:
                cuts += choices
                cutting.cut_level(builder, choices[0], outside)
            else:
                cuts.append(cutting.go_one_of(builder, ways[sweep]))
        except Blocked as blocked:
            raise FacetsBlocked({sweep: blocked}) from blocked
        if sweep >= first:
            builder.close(f"sweep {sweep}")
    _go_home(builder, CUTTER, (HOLDER,))
    _rise(builder, draft.lift)
    builder.close(Stage.LIFT)
    builder.wait(_LET_GO_S)
    builder.close(Stage.RELEASE)
    _go_home(builder, HOLDER, ())
    builder.close("home")
    return draft.plan(tuple(cuts)), Motions(builder.stages)


def _ways(
    builder: TrajectoryBuilder, draft: Draft, outside: Outside, made: Container[int]
) -> dict[int, list[Way]]:
    """Of each sweep that is not made. Raises FacetsBlocked."""
    group, blocks = builder.group(CUTTER, (CUTTER, HOLDER)), dict[int, Blocked]()
    ways: dict[int, list[Way]] = {}
    for sweep, choices in enumerate(draft.sweeps, start=1):
        if sweep not in made:
            try:
                ways[sweep] = cutting.ways(group, choices, outside)
            except Blocked as blocked:
                blocks[sweep] = blocked
    if blocks:
        raise FacetsBlocked(blocks)
    return ways


def _withdraw(builder: TrajectoryBuilder, outside: Outside, holding: bool) -> None:
    """Straight back with an instrument that is in tissue or too near to anything, only until it
    is free, and up with a cup on it."""
    here = builder.group(CUTTER, (HOLDER,))
    if here.collides(here.current_rad) is not None:
        tip = builder.tip(CUTTER)
        leave = cutting.straight_back(tip, outside.back_mm(tip[:3, 3], tip[:3, 0]))
        free = (n for n, pose in enumerate(leave) if cutting.free(here, pose) is not None)
        leave = leave[: next(free, len(leave)) + 1]
        config, both = here.cell.config, (CUTTER, HOLDER)
        group = PlanningGroup(ArmCell(config, here.cell.organ), CUTTER, builder.joints_rad, both)
        if group.collides(group.current_rad) is not None:
            # The organ has come too near to more than the electrode: going back makes it no nearer.
            group = PlanningGroup(ArmCell(config), CUTTER, builder.joints_rad, both)
        builder.go(CUTTER, follow(group, leave), config.cutting_mm_s)
        builder.close(Stage.WITHDRAW)
    pair = builder.cell.collisions(builder.joints_rad, (CUTTER,))
    if not holding and pair is not None and TOUCHES[HOLDER] in pair:
        builder.wait(_LET_GO_S)
        _rise(builder, UP)


def _rise(
    builder: TrajectoryBuilder,
    direction: np.ndarray,
    by_mm: float = _ABOVE_MM,
    mm_s: float | None = None,
) -> None:
    """The holder goes straight up, or after the last cut with the piece where that comes free."""
    tip = builder.tip(HOLDER)
    far = np.linspace(0, by_mm, max(2, int(by_mm / _STEP_MM)) + 1)
    rising = cutting.poses(tip[:3, 3] + far[:, None] * direction, tip[:3, :3])
    builder.follow(HOLDER, rising, mm_s or builder.cell.config.grasping_mm_s)


def _go_home(builder: TrajectoryBuilder, arm: str, touching: tuple[str, ...]) -> None:
    """One arm, straight in joint space if that is free; what is ``touching`` stands still."""
    group = builder.group(arm, touching)
    tip = builder.tip(arm)
    corners = [cutting.aside(group, tip, *by) for by in cutting.DETOURS_MM]
    detours = [corner[None] for corner in corners if len(corner)]
    builder.go(arm, connect(group, builder.cell.home_rad[group.own], builder.rng, detours))


def search_bases(
    located: Located, config: ResectionConfig, cell: CellConfig, drafts: Drafts | None = None
) -> tuple[CellConfig, ResectionPlan, Motions, str]:
    """A plan with its motions from where the arms stand, or else from elsewhere round the table
    (a small fixed grid, the least change first, those within reach of every stroke); the cell
    that they are for; and a note on what was changed. Raises as ``plan_motions``: the reason is
    the one for where the arms stand now. An arm that would meet something at home gets a home
    near it."""
    drafts = drafts or Drafts(located, config, cell.tools)
    given, cell = cell, _with_free_homes(cell, located)
    said = "" if cell == given else "an arm is blocked at home_rad; it has another home, nearby"
    plan = drafts.best().plan()
    try:
        return cell, *plan_motions(located, config, cell, drafts=drafts), said
    except NoPlan as failure:
        reason = failure
    for moved in itertools.islice(_reachable_cells(plan, cell), _MOST_TRIED):
        moved = _with_free_homes(moved, located)
        try:
            made = plan_motions(located, config, moved, pieces=_ELSEWHERE)
            return moved, *made, f"{reason} {_note(moved)}"
        except NoPlan:
            continue
    raise NoPlan(f"{reason} Other places for the arms round the table were tried in vain.")


def _with_free_homes(cell: CellConfig, located: Located) -> CellConfig:
    home_rad = np.array(cell.home_rad)
    for arm in ARMS:
        group = PlanningGroup(ArmCell(cell, located.organ), arm, home_rad)
        if group.collides(group.current_rad) is None:
            continue
        tip, turn = group.cell.tips(home_rad)[arm], cell.base(arm).table_from_base[:3, :3]
        choices = [
            own_rad
            for by in itertools.product(_AWAY_MM, _AWAY_MM, _AWAY_MM)
            for own_rad in group.inverse_kinematics(rigid(tip[:3, :3], tip[:3, 3] + turn @ by))
            if group.collides(own_rad, _ROOM_MM) is None
        ]
        if choices:
            home_rad[group.own] = min(
                choices, key=lambda own: np.abs(own - group.current_rad).max()
            )
    return msgspec.structs.replace(cell, home_rad=tuple(home_rad.tolist()))


def _reachable_cells(plan: ResectionPlan, config: CellConfig) -> Iterator[CellConfig]:
    """Configurations in which both arms reach all they have to, the least change first."""
    # Ends and middles of all strokes
    tips = [(cut, tip) for cut in plan.cuts for tip in cut.path_mm[[0, len(cut.path_mm) // 2, -1]]]
    level = level_turns(_YAWS)
    turns = {id(cut): level if cut.axis is None else turns_about(cut.axis) for cut in plan.cuts}
    targets = {
        CUTTER: [[rigid(turn, tip) for turn in turns[id(cut)]] for cut, tip in tips],
        HOLDER: [
            [rigid(upright(plan.lift), plan.grasp_mm + far * plan.lift)] for far in (0.0, _ABOVE_MM)
        ],
    }
    good = []
    for arm in ARMS:
        places = [
            msgspec.structs.replace(config, **{f"{arm}_base": base})
            for base in _places(config, arm, plan.grasp_mm[:2])
        ]
        good.append([place.base(arm) for place in places if _reaches(place, arm, targets[arm])])
    pairs = itertools.product(*map(enumerate, good))
    for (_, cutter), (_, holder) in sorted(pairs, key=lambda pair: pair[0][0] + pair[1][0]):
        yield msgspec.structs.replace(config, cutter_base=cutter, holder_base=holder)


def _places(config: CellConfig, arm: str, middle_mm: np.ndarray) -> list[Base]:
    """Where this arm could stand on the table, its present place first."""
    now = config.base(arm)
    off = np.array(now.position_mm[:2]) - middle_mm
    facing = np.arctan2(off[1], off[0])
    half = np.array(config.table_mm) / 2 - _EDGE_MM
    bases = [now]
    for side, share in itertools.product(_SIDES_DEG, _DISTANCES):
        angle = facing + np.radians(side)
        far = share * config.model(arm).reach_mm
        x, y = middle_mm + far * np.array([np.cos(angle), np.sin(angle)])
        if abs(x - config.middle_mm[0]) <= half[0] and abs(y - config.middle_mm[1]) <= half[1]:
            place = (round(float(x)), round(float(y)), now.position_mm[2])
            bases.append(Base(position_mm=place, yaw_deg=now.yaw_deg + side))
    return bases


def _reaches(config: CellConfig, arm: str, targets: list[list[Pose]]) -> bool:
    """Whether the arm's tip comes to each of these places, in any of its poses there."""
    cell = ArmCell(config)
    group = PlanningGroup(cell, arm, cell.home_rad)
    return all(any(len(group.inverse_kinematics(pose)) for pose in poses) for poses in targets)


def _note(config: CellConfig) -> str:
    places = []
    for arm in ARMS:
        (x, y, z), yaw_deg = config.base(arm).position_mm, config.base(arm).yaw_deg
        places.append(f"{arm}'s base at ({x:g}, {y:g}, {z:g}) mm, turned by {yaw_deg:g} degrees")
    return f"Planned with the {', the '.join(places)}."


_setting: list[tuple[ResectionConfig, CellConfig, str]] = []  # of the worker


def begin_worker(config: ResectionConfig, cell: CellConfig, urdf: str) -> None:
    """In the new process, which ignores Ctrl-C: the live loop handles it. ``urdf``: of the
    plan's folder, by which motions are checked."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _setting.append((config, cell, urdf))


def warm_up() -> None:
    """Loads in the worker what is slow to load."""
    import toppra  # noqa: F401


def replan(
    located: Located, joints_rad: Joints, progress: ResectionProgress, before: ResectionPlan
) -> Planned:
    """The plan for the organ as it lies now, from where the arms are. The facets of the plan
    ``before`` are kept if possible, and in any case once one is cut. Raises NoPlan: there is
    none, or it fails the check."""
    config, cell, urdf = _setting[0]
    start = Start(joints_rad, progress.first_sweep)
    like = before if len(before.facets) else None
    try:
        plan, motions = plan_motions(located, config, cell, start, like)
    except NoPlan:
        if like is None or progress.done:
            raise
        plan, motions = plan_motions(located, config, cell, start)
    if hit := first_hit(motions, cell, located.organ, begun=True):
        raise NoPlan(f"the arms can't carry this out: {hit}")
    return Planned(checked(plan, motions, urdf, located), located.meshes, motions)
