"""The error budget: how much nearer to a tumor than planned the electrode may come.

Motion and lag displace the tumor against the plan in the same direction, so they add up. Tracking,
hand-eye calibration and tool are bounds of independent errors: they add in quadrature.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from tumortrack.core.assessment import ErrorBound
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.halt import Halt
from tumortrack.core.mesh_query import contains, nearest_places
from tumortrack.core.organ import is_tumor, organ_name
from tumortrack_resection.facets import TOOLS, Tools
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


class ErrorBudget(Config, frozen=True, kw_only=True):
    """Bounds of errors, mm, and the distance that they are taken from, for one tumor.

    Attributes:
        part: the tumor's name.
        margin_mm: the least distance between the electrode, cutting or not, and the tumor's located
            surface; negative where it goes into the tumor.
        tracking_mm: of the tumor's located surface: the estimate's bound (95 %).
        hand_eye_mm: of the camera's place in the arms' frame, at the tumor.
        tool_mm: of the tool's tip: the arm's accuracy, compliance, and its tolerated distance from
            its target.
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
        """Each term by its name, mm."""
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
    def as_halt(self) -> Halt:
        """Why arms halt when no margin is left."""
        term, term_mm = max(self.terms.items(), key=lambda item: item[1])
        values: dict[str, float | str] = {"sum_mm": self.sum_mm, "margin_mm": self.margin_mm}
        values["part"] = self.part
        return Halt("over_budget", {**values, "term": term, "term_mm": term_mm})

    @property
    def words(self) -> str:
        return self.as_halt.words

    def table(self) -> list[str]:
        """Lines for the screen."""
        lines = [f"errors that the electrode's distance to {self.part} has to cover, mm:"]
        for name, value in self.terms.items():
            how = ErrorBound(value).words if name == "tracking" else ""
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
    """Of each tumor, the planned one's first. ``hand_eye_mm`` and ``tool_error_mm`` are assumed if
    not stated. Apart from ``moved_mm`` the organ lies still: there is no lag yet."""
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
    """Of the tumor that is the least safe."""
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
        notes = [f"{OVER_BUDGET}: {budget.words}." for budget in over]
        if not accept:
            raise NoPlan(
                f"the distance does not cover the errors: {over[0].words}. "
                f"{_remedy(plan, over[0])} Only for a plan that nobody carries out, accept it "
                "(--accept-budget, accept_budget=True)."
            )
    if not plan.clearances:
        unknown = "without the arms' motions nobody knows where the electrode goes"
        notes = [f"{UNCHECKED}: {unknown}.", *notes]
    return replace(plan, notes=(*plan.notes, *notes))


def foreseen_mm(plan: ResectionPlan, located: Located, tools: Tools) -> dict[str, float]:
    """The least distance of the electrode on its cuts to each tumor and structure, mm; negative: so
    deep inside. Of cuts without a direction, of the tip. What the arms do besides is known only
    once their motions are checked."""
    surfaces = {**located.meshes, **located.structures}
    organ = organ_name(located.meshes)
    lines = []
    for cut in plan.cuts:
        far = np.arange(0.0, tools.electrode_mm, 2 * _SPACING_MM) if cut.axis is not None else [0.0]
        axis = np.zeros(3) if cut.axis is None else cut.axis
        lines.append((cut.path_mm[:, None] - np.outer(far, axis)).reshape(-1, 3))
    points = np.concatenate(lines)
    least = {}
    for name, mesh in surfaces.items():
        if name == organ:
            continue
        away = np.linalg.norm(nearest_places(mesh, points) - points, axis=1)
        inside = contains(mesh, points) if is_tumor(name) else np.zeros(len(points), bool)
        deep, near = float(away[inside].max(initial=0)), float(away.min()) - tools.radius_mm
        least[name] = -deep if inside.any() else near
    return least


def kept_words(plan: ResectionPlan, least_mm: Mapping[str, float]) -> str:
    """The electrode's least distances: to the tumor, what was asked for, and to all others. Of an
    unchecked plan they are those of its cuts alone."""
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
    """A margin that suffices, if there is one."""
    enough_mm = math.ceil(2 * (plan.margin_mm - budget.left_mm) + 0.2) / 2
    if plan.method != "margin":
        return "The method knows the instrument's tip alone; take the method margin."
    if budget.part != plan.tumor:
        return f"Plan {budget.part} as well, or look from nearer."
    if enough_mm > MARGIN_MM[1]:
        return "Look from nearer, or uncover more of the organ."
    return f"{enough_mm:g} mm would cover them (--margin, margin_mm)."
