"""A plan carried out beside the live loop: halted by every doubt, replanned if the tumor moved.
It has no clock but the arrival of updates."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from tumortrack.assessment.advice import Place, Reach, advise, worthwhile
from tumortrack.core.colours import ENERGISED
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Evidence
from tumortrack.core.geometry import IDENTITY, Affine, transform_points
from tumortrack.core.rigid_fit import kabsch
from tumortrack.core.types import Mesh
from tumortrack.live.values import Polyline, RigidShape, StopReason, TrackingResult
from tumortrack_resection.budget import MOVED_MM, LiveBudget
from tumortrack_resection.grip import Grip
from tumortrack_resection.halt import Halt
from tumortrack_resection.motions import CUTTER, JOINTS, Execution, Joints, Motions, Stage
from tumortrack_resection.swept import Swept
from tumortrack_resection.values import ELECTRODE, Located, ResectionPlan
from tumortrack_resection.workcell import TipOf, Workcell, cut_lines, stage_words

_OTHER_PARTS = 2.0  # they may move so many times as far as the tumor
_COMPARED = 500  # points of surfaces with different triangles
_ELECTRODE = f"{CUTTER}/{ELECTRODE}"  # drawn in a colour of its own while it is energised
_SILENT_S = 0.2  # without an update for longer, the arms halt
_RESTLESS_S = 10.0  # of waiting for what moved to lie still, before that is said
_AGAIN_S = 5.0  # until it is planned again, where there was no plan for an organ that is cut


class OperationConfig(Config, frozen=True, kw_only=True):
    """When to halt the arms and when to replan.

    Attributes:
        moved_mm: of the tumor's surface, root mean square: then it counts as moved.
        settled_mm, settled_s: a new plan waits until it has moved no more than that for so long.
        speed: factor on the motions' speed.
    """

    moved_mm: float = MOVED_MM
    settled_mm: float = 0.7
    settled_s: float = 0.5
    speed: float = 1.0

    def __post_init__(self) -> None:
        for name in ("moved_mm", "settled_mm", "settled_s"):
            if not 0 < getattr(self, name) <= 100:
                raise InputError(f"{name} is {getattr(self, name):g}; allowed: over 0 to 100.")
        if not 0 < self.speed <= 20:
            raise InputError(f"speed is {self.speed:g}; allowed: more than 0, up to 20.")


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan, the surfaces it was made for (table frame), and the motions."""

    plan: ResectionPlan
    meshes: Mapping[str, Mesh]
    motions: Motions

    @property
    def kept_mm(self) -> dict[str, float]:
        """The electrode's least distance to each tumor, as checked; of structures it is no
        matter of errors in tumors' places."""
        return {name: mm for name, mm in self.plan.least_mm.items() if name in self.meshes}


class ResectionProgress(NamedTuple):
    """Whether the grasper holds, and how many sweeps are done."""

    holds: bool = False
    done: int = 0

    @property
    def first_sweep(self) -> int | None:
        """The sweep at which another plan continues; None: it begins with the approach."""
        return self.done + 1 if self.holds else None


# The estimate to plan on, the arms' joints, their progress, and the plan so far
Replan = Callable[[TrackingResult, Joints, ResectionProgress, ResectionPlan], "Future[Planned]"]
Locate = Callable[[TrackingResult], Located]
Draw = Callable[[Joints], tuple[RigidShape, ...]]
# From the organ's surface (table frame) and where the arms stand: what their tips reach
ReachOf = Callable[[Mesh, Joints], Reach]


class Following(NamedTuple):
    """What an operation that follows the organ needs. ``locate``: an update's estimate in the
    table's frame; None: estimates are ignored. ``replan``: begins a new plan in another process.
    ``budget``: adds up the errors. ``grip``, ``swept``: what the holder holds and what
    is cut, as evidence. ``reach``: touches are advised where the arms can take them. ``tip_mm``:
    where their tools are. ``real``: there are sinks of real arms, connected or not."""

    locate: Locate | None = None
    replan: Replan | None = None
    budget: LiveBudget | None = None
    grip: Grip | None = None
    reach: ReachOf | None = None
    tip_mm: TipOf | None = None
    real: bool = False
    swept: Swept | None = None


_UNSEEING = Following()


class Operation:
    """``live.values.Controller``: arms that act on estimates. ``draw``: arms, table and
    tools as shapes, from twelve joint angles. ``static_shapes``: drawn with every update.
    ``log``: states and when they began. ``halts``: how often each reason halted the arms."""

    def __init__(
        self, planned: Planned, config: OperationConfig, draw: Draw, live: Following = _UNSEEING
    ) -> None:
        self.planned, self._config = planned, config
        self._warnings = planned.plan.warnings  # also of later plans: the budget stays accepted
        self._draw = draw
        self._locate, self._replan, self._budget, _, self._reach = live[:5]
        self._knows = [each for each in (live.grip, live.swept) if each is not None]
        self.tip_mm, self._real = live.tip_mm, live.real
        self._execution = Execution(planned.motions)
        self._last_s: float | None = None
        self._first_s = 0.0
        self._settled: tuple[Mesh, float] | None = None  # the tumor's surface, and since when
        self._off_s: float | None = None  # since when something lies elsewhere
        self._work: Future[Planned] | None = None
        self._cut = False  # whether the first sweep of any plan has begun
        self._no_plan: tuple[Halt, float] | None = None  # for what is cut; and when it was sought
        self.static_shapes: tuple[RigidShape, ...] = ()
        self.log: list[dict[str, Any]] = []
        self.halts: Counter[str] = Counter()
        self._counted: object = None  # the last counted reason, without its numbers

    @property
    def ended(self) -> bool:
        return self._execution.ended

    @property
    def progress(self) -> ResectionProgress:
        execution = self._execution
        return ResectionProgress(execution.holds, max(0, execution.sweep - 1))

    def act(self, update: TrackingResult, now_s: float | None = None) -> TrackingResult:
        """The update with the arms' present state."""
        now_s = time.monotonic() if now_s is None else now_s
        self._advance(now_s)
        self._decide(update, now_s)
        for each in self._knows:
            each.update(self._execution, update)
        if not self.log or self.log[-1]["state"] != self._execution.state:
            self._log(now_s)
        halt = self._execution.halted
        reason = None if halt is None else halt.same_as
        if halt is not None and reason != self._counted:
            self.halts[halt.words_without_numbers] += 1
        self._counted = reason
        return replace(update, control=self.workcell(), estimate=self._advised(update))

    def _advised(self, update: TrackingResult) -> Estimate | None:
        """The estimate with advice that the arms can follow; with none while they are at work."""
        estimate, execution = update.estimate, self._execution
        if estimate is None or self._locate is None or self._reach is None:
            return estimate
        if not estimate.assessment.next_evidence or self.planned.plan.tumor not in estimate.meshes:
            return estimate
        if execution.halted is None or execution.grips:
            return estimate.assessed(next_evidence=())
        table_from_camera = update.published_frame.published_from_camera
        organ = next(iter(self._locate(update).meshes.values()))
        reaches = self._reach(organ, execution.joints_rad)

        def reach(place_mm: Place, normal: Place) -> bool:
            there_mm = transform_points(table_from_camera, place_mm[None])[0]
            return reaches(there_mm, table_from_camera[:3, :3] @ normal)

        advice = advise(estimate, self.planned.plan.tumor, reach)
        return estimate.assessed(next_evidence=worthwhile(advice))

    def evidence(self, camera_from_published: Affine, stamp_ns: int) -> tuple[Evidence, ...]:
        """Where the holder has the tissue that it grips, and where the electrode cuts."""
        told = (each.evidence(camera_from_published, stamp_ns) for each in self._knows)
        return tuple(piece for pieces in told for piece in pieces)

    @property
    def halt(self) -> Halt | None:
        return self._execution.halted

    def stop(self, why: StopReason, words: str = "") -> None:
        """For good, from any state."""
        self._execution.abort(Halt(why, {"message": words}))

    def workcell(self) -> Workcell:
        execution, plan = self._execution, self.planned.plan
        joints, sweep = execution.joints_rad, execution.sweep
        above = plan.grasp_mm + np.outer([40.0, 0.0], plan.lift)
        lines = (*cut_lines(plan.cuts, sweep), Polyline("grasp", above, (90, 200, 255), 0.8))
        drawn = self._draw(joints)
        if execution.cutting:
            drawn = tuple(
                replace(each, colour=ENERGISED) if each.name == _ELECTRODE else each
                for each in drawn
            )
        state = f"{execution.state} ({self._note})" if self._note else execution.state
        now = None if self._budget is None else self._budget.now
        halt, note = execution.halted, "" if now is None else now.left_words
        note += f"; at {execution.pace:.0%} of the speed" if note and execution.pace < 1 else ""
        stopped = "" if halt is None else halt.message
        line = f"arms: {stage_words(state, self._real)}" + (f" ({stopped})" if stopped else "")
        return Workcell(
            state,
            stopped,
            note,
            line="; ".join(filter(None, (line, note))),
            kind=(state, halt and halt.same_as),
            joints_rad=dict(zip(JOINTS, joints.tolist(), strict=True)),
            shapes=(*self.static_shapes, *drawn),
            lines=lines,
            halt=halt,
            left_mm=None if now is None else now.left_mm,
            cutting=execution.cutting,
            all_cut=execution.sweep > self.planned.plan.sweeps,
        )

    @property
    def _note(self) -> str:
        """Warnings on the plan."""
        warnings = (*self._warnings, *self.planned.plan.warnings)
        return "; ".join(dict.fromkeys(each.split(":")[0].rstrip(".") for each in warnings))

    def summary(self) -> dict[str, Any]:
        resection = {
            "state": self._execution.state,
            "note": self._note,
            "halted": self._execution.halted.message if self._execution.halted else "",
            "halts": dict(self.halts.most_common()),
            "log": self.log,
            **({} if self._budget is None else {"budget": self._budget.summary()}),
        }
        return {"resection": resection}

    def _advance(self, now_s: float) -> None:
        if self._last_s is None:
            self._last_s = self._first_s = now_s
        elapsed_s, speed = max(0.0, now_s - self._last_s), self._config.speed
        self._last_s = now_s
        self._execution.step(min(elapsed_s, _SILENT_S) * speed)
        if elapsed_s > _SILENT_S:
            self._execution.halt(Halt("silent"))
            self._execution.step((elapsed_s - _SILENT_S) * speed)
        self._cut |= self._execution.sweep > 0

    def _decide(self, update: TrackingResult, now_s: float) -> None:
        execution = self._execution
        if self._budget is not None:
            self._budget.forget()
        if self._work is not None:
            self._take_work(self._work, now_s)
        over = execution.ended or execution.state == Stage.ABORTED
        if self._locate is None or over or execution.sweep > self.planned.plan.sweeps:
            execution.pace = 1.0  # nothing to compare, nothing moves any more, or all is cut
            execution.go()
        elif update.estimate is None:
            self._halt_unsettled(Halt("no_estimate", {"message": update.reason}, update.finding))
        elif (halt := _slipped(update)) is not None:
            self._halt_unsettled(halt)
        elif update.quality != "good":
            self._halt_unsettled(Halt("poor", {"message": update.warning}, update.finding))
        elif self._work is not None:
            execution.halt(Halt("planning"))
        elif execution.stage == Stage.PULL:
            execution.go()  # the tumor moves because it is pulled; it is planned on when taut
        else:
            self._compare(update, self._locate(update), now_s)

    def _halt_unsettled(self, halt: Halt) -> None:
        """Halt; the tumor's place is unknown or a new plan would not help, so none is begun."""
        self._settled = None
        self._execution.halt(halt)

    def _compare(self, update: TrackingResult, located: Located, now_s: float) -> None:
        """Go on if everything lies as planned; else halt, and replan once the tumor has settled."""
        execution, config = self._execution, self._config
        name = self.planned.plan.tumor
        for part in (name, *self.planned.meshes):
            if part not in located.meshes:
                self._halt_unsettled(Halt("missing", {"part": part}))
                return
        tumor = located.meshes[name]
        halt, plan_anew = self._reason_to_halt(update, located)
        if halt is None:
            self._settled = self._off_s = self._no_plan = None
            execution.go()
            if self._budget is not None:
                execution.pace = self._budget.pace if execution.sweep else 1.0
                self._budget.went_on()
            return
        if not plan_anew:
            self._halt_unsettled(halt)
            return
        if self._no_plan is not None and now_s - self._no_plan[1] < _AGAIN_S:
            self._halt_unsettled(self._no_plan[0])
            return
        execution.halt(self._after_a_while(halt, now_s))
        if self._settled is None or distance_mm(tumor, self._settled[0]) > config.settled_mm:
            self._settled = (tumor, now_s)
        elif now_s - self._settled[1] >= config.settled_s and execution.still:
            self._settled = self._off_s = None
            if self._replan is not None:
                plan = self.planned.plan.transformed(_moved(self.planned.meshes[name], tumor))
                self._work = self._replan(update, execution.joints_rad, self.progress, plan)

    def _after_a_while(self, halt: Halt, now_s: float) -> Halt:
        """Where it moved and does not come to rest, that is why the arms wait on."""
        self._off_s = now_s if self._off_s is None else self._off_s
        if halt.kind != "moved" or now_s - self._off_s <= _RESTLESS_S:
            return halt
        return Halt("restless", {**halt.values, "seconds": now_s - self._off_s})

    def _reason_to_halt(self, update: TrackingResult, located: Located) -> tuple[Halt | None, bool]:
        """And whether a new plan would help."""
        name, moved = self.planned.plan.tumor, []
        over_budget: tuple[Halt | None, bool] = None, False
        for part, mesh in self.planned.meshes.items():
            off_mm = distance_mm(located.meshes[part], mesh)
            if off_mm > self._config.moved_mm * (1.0 if part == name else _OTHER_PARTS):
                moved.append((part == name, off_mm, part))
        if self._budget is not None:
            tumors = {
                part: (located.meshes[part], _distances_mm(located.meshes[part], mesh).max())
                for part, mesh in self.planned.meshes.items()
                if part in self.planned.kept_mm
            }
            over_budget = self._budget.add_up(update, name, tumors, self.planned.kept_mm)
        if moved:
            _, off_mm, part = max(moved)  # the tumor, or else what moved farthest
            return Halt("moved", {"part": part, "off_mm": off_mm}), True
        taut = self._execution.stage == Stage.TAUT and self._replan is not None
        if over_budget[0] is None and taut:
            return Halt("planning"), True  # however little the pull has moved it
        return over_budget

    def _take_work(self, work: Future[Planned], now_s: float) -> None:
        """Take over the new plan once it is ready; stop for good if planning failed, but of an
        organ that is cut seek one again, as it moves on."""
        execution = self._execution
        if execution.state == Stage.ABORTED:
            self._work = None
            work.cancel()
            return
        if not work.done():
            return
        self._work = None
        failure = work.exception()
        if failure is None:
            self.planned = work.result()
            execution.replace(self.planned.motions)
            self._log(now_s, event="planned anew")
        elif isinstance(failure, TumortrackError):
            halt = Halt("no_plan", {"message": str(failure)})
            self._no_plan = halt, now_s
            execution.halt(halt) if self._cut else execution.abort(halt)
        else:  # a defect of the planner must stop the arms, and be reported
            words = f"{type(failure).__name__}: {failure}"
            execution.abort(Halt("defect", {"message": words}))

    def _log(self, now_s: float, **event: str) -> None:
        at_s = round(now_s - self._first_s, 3)
        self.log.append({"state": self._execution.state, "at_s": at_s, **event})


def _slipped(update: TrackingResult) -> Halt | None:
    """That the estimate contradicts what the holder holds; one of them is wrong."""
    assert update.estimate is not None
    for each in update.estimate.report.evidence:
        if each.name == "grasp" and each.rejected:
            return Halt("slipped", {"off_mm": each.off_mm})
    return None


def distance_mm(now: Mesh, before: Mesh) -> float:
    """How far a surface has moved, root mean square: of its vertices if the triangles are the
    same, else from what there was to what there is: the walls of a new cut have not moved."""
    return float(np.sqrt((_distances_mm(now, before) ** 2).mean()))


def _distances_mm(now: Mesh, before: Mesh) -> Float64[np.ndarray, " n"]:
    if np.array_equal(now.faces, before.faces):
        return np.sqrt(((now.vertices_mm - before.vertices_mm) ** 2).sum(axis=1))
    of = before.vertices_mm[:: max(1, len(before.vertices_mm) // _COMPARED)]
    return np.asarray(cKDTree(now.vertices_mm).query(of)[0])


def _moved(before: Mesh, now: Mesh) -> Affine:
    """How a tumor has moved, as far as it moved rigidly; not at all, where nobody knows."""
    if not np.array_equal(now.faces, before.faces):
        return IDENTITY
    return kabsch(before.vertices_mm, now.vertices_mm, np.ones(len(now.vertices_mm)))
