"""The error budget: how much nearer to a tumor than planned the electrode may come.

Motion and lag displace the tumor against the plan in the same direction, so they add up. Tracking,
hand-eye calibration and tool are bounds of independent errors: they add in quadrature.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float64

from tumortrack.core.assessment import ErrorBound
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.mesh_query import contains, nearest_places
from tumortrack.core.organ import organ_name
from tumortrack.core.types import Mesh
from tumortrack.live.values import TrackingResult
from tumortrack_resection.facets import TOOLS, Tools
from tumortrack_resection.halt import Halt
from tumortrack_resection.ur_sink import OFF_MM
from tumortrack_resection.values import (
    MARGIN_MM,
    OVER_BUDGET,
    UNCHECKED,
    Located,
    ResectionPlan,
    name_of,
)

# Where the method knows no bound: the largest Hausdorff distance that the preset quick of version
# 0.1 had for a tumor of five organs under finite-element loads.
UNKNOWN_TRACKING_MM = 8.0
# Calibrations with 3D cameras err by about 0.9 mm and 0.27 degrees (arXiv 2311.01335): 1.9 mm at
# 200 mm.
HAND_EYE_MM = 2.0
# Data sheets state repeatability alone, 0.05 mm (UR10e) and 0.1 mm (UR5); commanded poses of arms
# that are not calibrated are off by some 20 times that.
TOOL_MM = 1.0
MOVED_MM = 2.0  # allowed for in a plan: the arms halt once the tumor has moved farther
TERMS = ("tracking", "hand-eye", "tool", "motion", "lag")
_SPACING_MM = 0.5  # between points on the planned cuts

_SPEED_S = 0.3  # time over which a speed is averaged: estimates jitter from frame to frame
_GAP_S = 0.5  # an older position does not count for the speed
_SLOWEST = 0.25  # pace of sweeps, however large a tumor's bound is


class ErrorBudget(Config, frozen=True, kw_only=True):
    """Bounds of errors, mm, and the distance that they are taken from, for one tumor.

    Attributes:
        margin_mm: the electrode's least distance to the tumor's located surface, cutting or not;
            negative where it goes into the tumor.
        tracking_mm: of that surface: the estimate's bound (95 %).
        hand_eye_mm: of the camera's place in the arms' frame, at the tumor.
        tool_mm: of the tool's tip: the arm's accuracy, and its tolerated distance from its target.
        motion_mm: of the tumor since the plan; when planned, what is allowed for.
        lag_mm: how far the tumor moves before the arms act on an estimate.
        assumed: terms that were neither measured nor stated.
    """

    margin_mm: float
    part: str = ""
    tracking_mm: float = 0.0
    hand_eye_mm: float = 0.0
    tool_mm: float = 0.0
    motion_mm: float = 0.0
    lag_mm: float = 0.0
    assumed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, value in self.terms.items():
            if not 0 <= value < math.inf:
                raise InputError(f"error budget: {name} is {value:g} mm; allowed: 0 or more.")
        if not math.isfinite(self.margin_mm):
            raise InputError(f"error budget: the margin is {self.margin_mm:g} mm; give a number.")

    @property
    def terms(self) -> dict[str, float]:
        return {name: getattr(self, f"{name.replace('-', '_')}_mm") for name in TERMS}

    @property
    def sum_mm(self) -> float:
        independent_mm = math.hypot(self.tracking_mm, self.hand_eye_mm, self.tool_mm)
        return self.motion_mm + self.lag_mm + independent_mm

    @property
    def left_mm(self) -> float:
        """Of the margin; negative: the tumor may be cut."""
        return self.margin_mm - self.sum_mm

    @property
    def left_words(self) -> str:
        if self.left_mm < 0:
            return f"errors exceed the distance to {self.part} by {-self.left_mm:.1f} mm"
        return f"{self.left_mm:.1f} mm or more are left of the distance to each tumor"

    @property
    def as_halt(self) -> Halt:
        """Why arms halt when no margin is left."""
        term, term_mm = max(self.terms.items(), key=lambda item: item[1])
        values: dict[str, float | str] = {"sum_mm": self.sum_mm, "margin_mm": self.margin_mm}
        values["part"] = self.part
        return Halt("over_budget", {**values, "term": term, "term_mm": term_mm})

    @property
    def message(self) -> str:
        return self.as_halt.message

    def table(self) -> list[str]:
        lines = [f"errors that the electrode's distance to {self.part} has to cover, mm:"]
        for name, value in self.terms.items():
            how = ErrorBound(value).message if name == "tracking" else ""
            how = "assumed" if name in self.assumed else how
            lines.append(f"  {name:<9}{value:5.1f}  {how}".rstrip())
        of = f"of {self.margin_mm:.1f}" if self.margin_mm > 0 else "of none: it is cut"
        lines.append(f"  {'together':<9}{self.sum_mm:5.1f}  {of}")
        return lines

    def updated(self, bound_mm: float | None, good: bool = True, **terms: float) -> ErrorBudget:
        """With new ``margin_mm``, ``motion_mm`` and ``lag_mm``, and an estimate's bound of the
        tumor's error, which holds only if the estimate is ``good``; else it is assumed."""
        assumed = tuple(name for name in self.assumed if name != "tracking")
        if bound_mm is None or not good:
            assumed = ("tracking", *assumed)
        terms["tracking_mm"] = UNKNOWN_TRACKING_MM if bound_mm is None else bound_mm
        return msgspec.structs.replace(self, assumed=assumed, **terms)


def planned_budgets(
    plan: ResectionPlan,
    located: Located,
    hand_eye_mm: float | None = None,
    tool_error_mm: float | None = None,
    moved_mm: float = MOVED_MM,
    tools: Tools = TOOLS,
) -> tuple[ErrorBudget, ...]:
    """Of each tumor, the planned one's first. What is not stated is assumed. Apart from
    ``moved_mm`` the organ lies still: there is no lag yet."""
    stated = {"hand-eye": hand_eye_mm, "tool": tool_error_mm}
    least_mm = plan.least_mm or foreseen_mm(plan, located, tools)
    others = [name for name in map(name_of, located.tumors) if name != plan.tumor]
    budgets = []
    for part in (plan.tumor, *others):
        budget = ErrorBudget(
            margin_mm=least_mm[part],
            part=part,
            hand_eye_mm=HAND_EYE_MM if hand_eye_mm is None else hand_eye_mm,
            tool_mm=OFF_MM + (TOOL_MM if tool_error_mm is None else tool_error_mm),
            motion_mm=moved_mm,
            assumed=tuple(name for name, value in stated.items() if value is None),
        )
        budgets.append(budget.updated(located.bounds_mm.get(part), good=not located.doubt))
    return tuple(budgets)


def tightest(budgets: Sequence[ErrorBudget]) -> ErrorBudget:
    return min(budgets, key=lambda budget: budget.left_mm)


def checked_against(
    plan: ResectionPlan, budgets: Sequence[ErrorBudget], accept: bool
) -> ResectionPlan:
    """The plan with a note on its budgets, and one if it is unchecked. NoPlan: a distance doesn't
    cover the errors, and that was not accepted."""
    over = [budget for budget in budgets if budget.left_mm < 0]
    budget = tightest(budgets)
    notes = [f"{budget.left_mm:.1f} mm are left of the distance to {budget.part} after "
             f"{budget.sum_mm:.1f} mm of error."]  # fmt: skip
    if over:
        notes = [f"{OVER_BUDGET}: {budget.message}." for budget in over]
        if not accept:
            raise NoPlan(
                f"the distance does not cover the errors: {over[0].message}. "
                f"{_remedy(plan, over[0])} Only for a plan that nobody carries out, accept it "
                "(--accept-budget, accept_budget=True)."
            )
    if not plan.clearances:
        unknown = "without the arms' motions nobody knows where the electrode goes"
        notes = [f"{UNCHECKED}: {unknown}.", *notes]
    return replace(plan, notes=(*plan.notes, *notes))


def foreseen_mm(plan: ResectionPlan, located: Located, tools: Tools) -> dict[str, float]:
    """The least distance of the electrode (without a direction: of the tip) on its cuts to each
    tumor and structure, mm; negative: so deep inside. What the arms do besides is known only
    once their motions are checked."""
    lines = []
    for cut in plan.cuts:
        far = np.arange(0.0, tools.electrode_mm, 2 * _SPACING_MM) if cut.axis is not None else [0.0]
        axis = np.zeros(3) if cut.axis is None else cut.axis
        lines.append((cut.path_mm[:, None] - np.outer(far, axis)).reshape(-1, 3))
    points = np.concatenate(lines)
    organ = organ_name(located.meshes)
    return {
        name: nearest(mesh, points, tools.radius_mm)[0]
        for name, mesh in located.surfaces.items()
        if name != organ
    }


def nearest(
    mesh: Mesh, points: Float64[np.ndarray, "n 3"], radius_mm: float
) -> tuple[float, int, Float64[np.ndarray, " 3"]]:
    """Of points on an electrode's axis: its distance to a surface, negative where a point is so
    deep in a tumor; which point that is, and the nearest place of the surface."""
    places = nearest_places(mesh, points)
    away = np.linalg.norm(places - points, axis=1)
    inside = contains(mesh, points) if mesh.closed else np.zeros(len(points), bool)
    at = int(np.where(inside, away, -1.0).argmax() if inside.any() else away.argmin())
    mm = -away[at] if inside.any() else away[at] - radius_mm
    return float(mm), at, places[at]


def kept_words(plan: ResectionPlan, least_mm: Mapping[str, float]) -> str:
    """The electrode's least distances; of an unchecked plan those of its cuts alone."""
    kept, how = least_mm[plan.tumor], "the electrode"
    if not plan.clearances:
        how = "on its cuts, unchecked, the electrode"
    asked = f"{plan.margin_mm:g} mm asked for"
    if kept < 0:
        words = f"{how} goes {-kept:.1f} mm into {plan.tumor} ({asked})"
    else:
        words = f"{how} keeps {kept:.1f} mm from {plan.tumor} ({asked})"
    others = [f"{mm:.1f} mm from {name}" for name, mm in least_mm.items() if name != plan.tumor]
    return ", ".join([words, *others])


def lost_words(plan: ResectionPlan) -> str:
    """The healthy tissue that a plan costs."""
    ml = plan.volumes_ml
    lost_ml = ml["healthy"] + ml.get("kerf", 0.0)
    words = f"{lost_ml:.1f} ml of healthy tissue ({lost_ml / ml['parenchyma']:.0%} of the organ's)"
    if "kerf" in ml:
        return f"{words} are lost, {ml['kerf']:.1f} of it in the cuts"
    return f"{words} are in it; what the electrode cuts besides is not counted"


def _remedy(plan: ResectionPlan, budget: ErrorBudget) -> str:
    enough_mm = math.ceil(2 * (plan.margin_mm - budget.left_mm) + 0.2) / 2
    if plan.method != "margin":
        return "The method knows the instrument's tip alone; take the method margin."
    if budget.part != plan.tumor:
        return f"Plan {budget.part} as well, or look from nearer."
    if enough_mm > MARGIN_MM[1]:
        return "Look from nearer, or uncover more of the organ."
    return f"{enough_mm:g} mm would cover them (--margin, margin_mm)."


class LiveBudget:
    """Adds up the errors of every update. Where a person accepted a planned distance that does
    not cover a tumor's errors, they never halt the arms, unless they become unknown.
    ``servo_s``: how far the arms lag behind. ``now``: of the last estimate and the tumor that is
    the least safe; ``worst``: the one with the least left while the arms were allowed to move."""

    def __init__(self, planned: Sequence[ErrorBudget], servo_s: float = 0.0) -> None:
        self._planned = {budget.part: budget for budget in planned}
        self._servo_s = servo_s
        self.now: ErrorBudget | None = None
        self.worst: ErrorBudget | None = None
        # Of the tumor's centroid, by stamp
        self._places: deque[tuple[int, Float64[np.ndarray, " 3"]]] = deque()

    def add_up(
        self,
        update: TrackingResult,
        part: str,
        tumors: Mapping[str, tuple[Mesh, float]],
        least_mm: Mapping[str, float],
    ) -> tuple[Halt | None, bool]:
        """Why the arms must halt (None: they need not), and whether a new plan would help.
        ``part``: the planned tumor; ``tumors``: all surfaces, table frame, each with its largest
        distance from where it was planned, mm; ``least_mm``: the electrode's distances from
        them, as planned."""
        estimate = update.estimate
        assert estimate is not None
        late_ms = max(update.latency_ms or 0.0, 0.0)  # a camera's clock may be ahead
        smoothing = estimate.report.smoothing
        late_ms += 0.0 if smoothing is None else smoothing.lag_ms
        speed_mm_s = self._speed_mm_s(update.stamp_ns, tumors[part][0])
        lag_mm = speed_mm_s * (late_ms / 1000 + self._servo_s)
        bounds = estimate.assessment.bounds
        budgets = {
            name: self._planned[name].updated(
                bounds[name].error_bound95_mm if name in bounds else None,
                margin_mm=least_mm[name], motion_mm=float(motion_mm), lag_mm=lag_mm,
            )
            for name, (_, motion_mm) in tumors.items()
            if name in self._planned
        }  # fmt: skip
        self.now = tightest(list(budgets.values()))
        for name, now in budgets.items():
            if "tracking" in now.assumed and "tracking" not in self._planned[name].assumed:
                return Halt("no_bound", {"part": name}), False
        covered = {n: each for n, each in budgets.items() if self._planned[n].left_mm >= 0}
        if not covered or (worst := tightest(list(covered.values()))).left_mm >= 0:
            return None, False
        return worst.as_halt, msgspec.structs.replace(worst, motion_mm=0.0).left_mm >= 0

    @property
    def pace(self) -> float:
        """Of sweeps, as a share: what the bound of the tumor that is the least safe leaves of its
        distance from the electrode, but at least a quarter."""
        if self.now is None or self.now.margin_mm <= 0:
            return _SLOWEST
        return max(1 - self.now.tracking_mm / self.now.margin_mm, _SLOWEST)

    def went_on(self) -> None:
        """The arms may move on the last estimate."""
        if self.now is not None and (self.worst is None or self.now.left_mm < self.worst.left_mm):
            self.worst = self.now

    def forget(self) -> None:
        """There is no estimate."""
        self.now = None

    def summary(self) -> dict[str, Any]:
        planned = tightest(list(self._planned.values()))
        budgets = {"planned": planned, "worst": self.worst}
        return {
            name: {**to_builtins(budget), "sum_mm": budget.sum_mm, "left_mm": budget.left_mm}
            for name, budget in budgets.items()
            if budget is not None
        }

    def _speed_mm_s(self, stamp_ns: int, tumor: Mesh) -> float:
        """Recent speed of the tumor's centroid; 0 for the first estimate."""
        places = self._places
        if places and not 0 < stamp_ns - places[-1][0] <= 1e9 * _GAP_S:
            places.clear()
        places.append((stamp_ns, tumor.vertices_mm.mean(0)))
        while len(places) > 2 and places[-1][0] - places[1][0] >= 1e9 * _SPEED_S:
            places.popleft()
        (first_ns, first_mm), (last_ns, last_mm) = places[0], places[-1]
        if last_ns == first_ns:
            return 0.0
        return float(np.linalg.norm(last_mm - first_mm)) / (1e-9 * (last_ns - first_ns))
