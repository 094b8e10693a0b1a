"""A plan carried out beside the live loop: halted by every doubt, planned anew where the tumor
has moved.

No torch here, and no clock but the updates' own arrival: ``act`` is called with every update.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.types import Mesh
from tumortrack.live.values import Polyline, RigidShape, TrackingResult, Workcell
from tumortrack.plan.execute import ABORTED, Execution
from tumortrack.plan.motions import JOINTS, Motions
from tumortrack.plan.values import Located, ResectionPlan

Colour = tuple[int, int, int]
TO_CUT: Colour = (0, 120, 240)
NOW: Colour = (255, 90, 30)
CUT: Colour = (120, 40, 40)
_SAME_MM = 0.2  # of heights
_OTHERS = 2.0  # other parts may have moved so many times as far as the tumor
_COMPARED = 500  # points of surfaces whose triangles differ
_BLIND_S = 0.2  # without an update for longer, the arms halt by themselves


class OperationConfig(Config, frozen=True, kw_only=True):
    """``moved_mm``: the tumor is elsewhere than planned if its surface moved by so much (root mean
    square). ``settled_mm``, ``settled_s``: it is planned anew once it has moved no more than that
    for so long; before, the arms wait. ``speed``: of the arms' time."""

    moved_mm: float = 2.0
    settled_mm: float = 0.7
    settled_s: float = 0.5
    speed: float = 1.0

    def __post_init__(self) -> None:
        for name in ("moved_mm", "settled_mm", "settled_s"):
            if not 0 < getattr(self, name) <= 100:
                raise InputError(f"{name} is {getattr(self, name):g}; allowed: 0 to 100.")
        if not 0 < self.speed <= 20:
            raise InputError(f"speed is {self.speed:g}; allowed: more than 0, up to 20.")


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan, the surfaces it was made for (table frame), and the motions."""

    plan: ResectionPlan
    meshes: Mapping[str, Mesh]
    motions: Motions

    @property
    def tumor(self) -> Mesh:
        return self.meshes[self.plan.tumor]


@dataclass(frozen=True)
class ResectionProgress:
    """How far a plan was carried out: whether the grasper holds, and the height of the last sweep
    that was finished over the tumor's lowest point (None: none was)."""

    holds: bool = False
    done_mm: float | None = None

    def first_sweep(self, planned: ResectionPlan, tumor: Mesh) -> int | None:
        """With which sweep another plan goes on: the first that lies beyond what was finished, in
        the order in which it cuts, and never past the last; None: from the approach.

        Sweeps are not the same from plan to plan, and so are told apart by their height.
        """
        if not self.holds:
            return None
        if self.done_mm is None:
            return 1
        low = float(tumor.box_mm[0, 2])
        onward = 1 if planned.cuts[-1].height_mm > planned.cuts[0].height_mm else -1
        left = {
            cut.sweep
            for cut in planned.cuts
            if onward * (cut.height_mm - low - self.done_mm) > _SAME_MM
        }
        return min(left, default=planned.sweeps)


# The estimate to plan on, the arms' joints, and how far they came
Replan = Callable[
    [TrackingResult, Float64[np.ndarray, " 12"], ResectionProgress], "Future[Planned]"
]
Locate = Callable[[TrackingResult], Located]
Draw = Callable[[Float64[np.ndarray, " 12"]], tuple[RigidShape, ...]]


class Operation:
    """``live.values.ArmsController``: arms that act on estimates.

    Args:
        planned: what to begin with.
        draw: the arms, table and tools as shapes, for twelve joint angles.
        locate: an update's estimate in the table's frame; None: a stored plan is carried out and
            nothing is looked at.
        replan: begins a new plan elsewhere, so that the loop goes on meanwhile.
        still_life: shapes that are shown all the time.
    """

    def __init__(
        self,
        planned: Planned,
        config: OperationConfig,
        draw: Draw,
        locate: Locate | None = None,
        replan: Replan | None = None,
    ) -> None:
        self._planned, self._config = planned, config
        self._draw, self._locate, self._replan = draw, locate, replan
        self._execution = Execution(planned.motions)
        self._last_s: float | None = None
        self._first_s = 0.0
        self._settled: tuple[Mesh, float] | None = None  # where the tumor is, and since when
        self._work: Future[Planned] | None = None
        self.still_life: tuple[RigidShape, ...] = ()
        self.log: list[dict] = []
        self.halts: Counter[str] = Counter()
        self._said = ""

    @property
    def ended(self) -> bool:
        return self._execution.ended

    @property
    def planned(self) -> Planned:
        """What is carried out now."""
        return self._planned

    @property
    def joints_rad(self) -> Float64[np.ndarray, " 12"]:
        """In the order of ``motions.JOINTS``."""
        return self._execution.joints_rad

    @property
    def progress(self) -> ResectionProgress:
        """How far it came."""
        if not self._execution.holds:
            return ResectionProgress()
        done = [cut for cut in self._planned.plan.cuts if cut.sweep < self._execution.sweep]
        if not done:
            return ResectionProgress(holds=True)
        return ResectionProgress(True, done[-1].height_mm - float(self._planned.tumor.box_mm[0, 2]))

    def act(self, update: TrackingResult, now_s: float | None = None) -> TrackingResult:
        """The update with what the arms do now. ``now_s``: a steady clock's time."""
        now_s = time.monotonic() if now_s is None else now_s
        self._pass(now_s)
        self._look(update, now_s)
        self._note(now_s)
        return replace(update, workcell=self.workcell())

    def abort(self, reason: str) -> None:
        """Stop for good, from whatever state."""
        self._execution.abort(reason)

    def workcell(self) -> Workcell:
        """What is seen of it."""
        execution = self._execution
        joints = execution.joints_rad
        return Workcell(
            execution.state,
            execution.halted,
            dict(zip(JOINTS, joints.tolist(), strict=True)),
            (*self.still_life, *self._draw(joints)),
            self._lines(),
        )

    def summary(self) -> dict:
        """For the report: states and when they began, halts, plans made anew."""
        return {
            "state": self._execution.state,
            "halted": self._execution.halted,
            "halts": dict(self.halts.most_common()),
            "log": self.log,
        }

    def _pass(self, now_s: float) -> None:
        """Let the time since the last update go by."""
        if self._last_s is None:
            self._last_s = self._first_s = now_s
        passed_s, speed = max(0.0, now_s - self._last_s), self._config.speed
        self._last_s = now_s
        self._execution.step(min(passed_s, _BLIND_S) * speed)
        if passed_s > _BLIND_S:
            self._execution.halt("no word from the loop")
            self._execution.step((passed_s - _BLIND_S) * speed)

    def _look(self, update: TrackingResult, now_s: float) -> None:
        """Go on, or halt and why."""
        execution = self._execution
        if self._work is not None:
            self._take_work(now_s)
        over = execution.ended or execution.state == ABORTED
        if self._locate is None or over or execution.sweep > self._planned.plan.sweeps:
            execution.go()  # nothing is looked at, nothing moves any more, or it is cut out
        elif update.estimate is None:
            self._settled = None
            execution.halt(f"no estimate: {update.reason}")
        elif update.quality != "good":
            self._settled = None
            execution.halt(f"{update.quality} estimate: {update.warning}")
        elif self._work is not None:
            execution.halt("planning anew")
        else:
            self._compare(update, self._locate(update), now_s)

    def _compare(self, update: TrackingResult, located: Located, now_s: float) -> None:
        execution, config = self._execution, self._config
        name = self._planned.plan.tumor
        tumor = located.meshes.get(name)
        if tumor is None:
            self._settled = None
            execution.halt(f"{name} was not found")
            return
        moved = [
            (apart_mm(located.meshes[part], mesh), part)
            for part, mesh in self._planned.meshes.items()
            if part in located.meshes
        ]
        far = [
            (off_mm, part)
            for off_mm, part in moved
            if off_mm > config.moved_mm * (1.0 if part == name else _OTHERS)
        ]
        if not far:
            self._settled = None
            execution.go()
            return
        off_mm, part = next((one for one in far if one[1] == name), max(far))
        execution.halt(f"{part} has moved by {off_mm:.1f} mm")
        if self._settled is None or apart_mm(tumor, self._settled[0]) > config.settled_mm:
            self._settled = (tumor, now_s)
        elif now_s - self._settled[1] >= config.settled_s and execution.still:
            self._settled = None
            if self._replan is not None:
                self._work = self._replan(update, execution.joints_rad, self.progress)

    def _take_work(self, now_s: float) -> None:
        work, execution = self._work, self._execution
        assert work is not None
        if execution.state == ABORTED:
            self._work = None
            work.cancel()
            return
        if not work.done():
            return
        self._work = None
        failure = work.exception()
        if failure is None:
            self._planned = work.result()
            execution.replace(self._planned.motions)
            self._log(now_s, "planned anew")
        elif isinstance(failure, TumortrackError):
            execution.abort(f"no new plan: {failure}")
        else:  # a defect of ours must stop the arms, and say so
            execution.abort(f"internal error, {type(failure).__name__}: {failure}")

    def _note(self, now_s: float) -> None:
        state = self._execution.state
        if not self.log or self.log[-1]["state"] != state:
            self._log(now_s, "")
        halted = "".join(c for c in self._execution.halted if not (c.isdigit() or c == "."))
        if halted != self._said:
            self._said = halted
            if halted:
                self.halts[halted] += 1

    def _log(self, now_s: float, what: str) -> None:
        entry = {"state": self._execution.state, "at_s": round(now_s - self._first_s, 3)}
        self.log.append({**entry, "event": what} if what else entry)

    def _lines(self) -> tuple[Polyline, ...]:
        sweep, plan = self._execution.sweep, self._planned.plan
        lines = []
        for number, cut in enumerate(plan.cuts, start=1):
            colour = CUT if cut.sweep < sweep else NOW if cut.sweep == sweep else TO_CUT
            lines.append(Polyline(f"cut/{number}", cut.path_mm, colour, 0.8))
        above = plan.grasp_mm + np.array([[0.0, 0.0, 40.0], [0.0, 0.0, 0.0]])
        return (*lines, Polyline("grasp", above, (90, 200, 255), 0.8))


def apart_mm(a: Mesh, b: Mesh) -> float:
    """How far a surface has moved, root mean square: of its vertices where both have the same
    triangles, else between the surfaces, for which sliding along itself is no motion."""
    if np.array_equal(a.faces, b.faces):
        off = a.vertices_mm - b.vertices_mm
        return float(np.sqrt((off**2).sum(axis=1).mean()))
    squares = [_nearest_mm(a, b) ** 2, _nearest_mm(b, a) ** 2]
    return float(np.sqrt(np.concatenate(squares).mean()))


def _nearest_mm(a: Mesh, b: Mesh) -> Float64[np.ndarray, " n"]:
    """Distances of some of a's vertices to b's."""
    some = a.vertices_mm[:: max(1, len(a.vertices_mm) // _COMPARED)]
    return cKDTree(b.vertices_mm).query(some)[0]
