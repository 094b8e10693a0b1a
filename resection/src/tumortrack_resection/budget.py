"""The error budget: how much nearer to the tumor than planned a cut may come.

Motion and lag displace the tumor against the plan in the same direction, so they add up. Tracking,
hand-eye calibration and tool are bounds of independent errors: they add in quadrature.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import shapely
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.halt import Halt
from tumortrack.tracking.margins import StatedRadius, margin_words, stated_radius
from tumortrack_resection.outline import evenly_round, polygon_of
from tumortrack_resection.resection import inside, plan_resection
from tumortrack_resection.ur_sink import OFF_MM
from tumortrack_resection.values import (
    MARGIN_MM,
    OVER_BUDGET,
    CutLayer,
    Located,
    ResectionConfig,
    ResectionPlan,
)

# So many standard deviations, but no less than the largest Hausdorff distance of a tumor of any
# organ in docs/results.md (clinic, case_00000). Not calibrated: see docs/resection.md.
DEVIATIONS, LEAST_TRACKING_MM = 3.0, 4.2
# Without standard deviations: the largest of M_lim (preset quick) there, P1 of case_00000.
UNKNOWN_TRACKING_MM = 8.0
# Calibrations with 3D cameras err by about 0.9 mm and 0.27 degrees (arXiv 2311.01335): 1.9 mm at
# 200 mm.
HAND_EYE_MM = 2.0
# Data sheets state repeatability alone, 0.05 mm (UR10e) and 0.1 mm (UR5); commanded poses of arms
# that are not calibrated are off by some 20 times that.
TOOL_MM = 1.0
MOVED_MM = 2.0  # allowed for in a plan: the arms halt once the tumor has moved farther
TERMS = ("tracking", "hand-eye", "tool", "motion", "lag")
_SPACING_MM = 0.25  # between points on the planned cut


class ErrorBudget(Config, frozen=True, kw_only=True):
    """Bounds of errors, mm, and the margin that they are taken from.

    Attributes:
        margin_mm: the least distance between the planned cut and the tumor's located surface;
            negative where the cut goes through the tumor.
        tracking_mm: of the tumor's located surface.
        hand_eye_mm: of the camera's place in the arms' frame, at the tumor.
        tool_mm: of the tool's tip: the arm's accuracy, compliance, and its tolerated distance from
            its target.
        motion_mm: of the tumor since the plan; when planned, what is allowed for.
        lag_mm: how far the tumor moves before the arms act on an estimate.
        assumed: terms that were neither measured nor stated.
        confidence: of the tracking term if it is a calibrated margin, else 0.
    """

    margin_mm: float
    tracking_mm: float = 0.0
    hand_eye_mm: float = 0.0
    tool_mm: float = 0.0
    motion_mm: float = 0.0
    lag_mm: float = 0.0
    assumed: tuple[str, ...] = ()
    confidence: float = 0.0

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
        return Halt("over_budget", {**values, "term": term, "term_mm": term_mm})

    @property
    def words(self) -> str:
        return self.as_halt.words

    def table(self) -> list[str]:
        """Lines for the screen."""
        lines = ["errors that the margin has to cover, mm:"]
        for name, value in self.terms.items():
            how = "  assumed" if name in self.assumed else ""
            if name == "tracking" and not how:
                sure = f"{100 * self.confidence:g} % margin"
                how = f"  {sure if self.confidence else 'not calibrated'}"
            lines.append(f"  {name:<9}{value:5.1f}{how}")
        lines.append(f"  {'together':<9}{self.sum_mm:5.1f}  of a margin of {self.margin_mm:.1f}")
        return lines

    def updated(
        self, std_mm: np.ndarray | None, stated: StatedRadius | None = None, **terms: float
    ) -> ErrorBudget:
        """With new ``margin_mm``, ``motion_mm`` and ``lag_mm``, and the tracking error that an
        estimate states of the tumor or, without one, its standard deviations."""
        others = tuple(name for name in self.assumed if name != "tracking")
        terms["confidence"] = stated.confidence if stated else 0.0
        if stated is not None:
            terms["tracking_mm"] = stated.mm
        elif std_mm is None:
            terms["tracking_mm"], others = UNKNOWN_TRACKING_MM, ("tracking", *others)
        else:
            terms["tracking_mm"] = max(DEVIATIONS * float(np.max(std_mm)), LEAST_TRACKING_MM)
        return msgspec.structs.replace(self, assumed=others, **terms)


def planned_budget(
    plan: ResectionPlan,
    located: Located,
    hand_eye_mm: float | None = None,
    tool_error_mm: float | None = None,
    moved_mm: float = MOVED_MM,
    confidence: float | None = None,
) -> ErrorBudget:
    """The budget of a plan; ``hand_eye_mm`` and ``tool_error_mm`` are assumed if not stated. Apart
    from ``moved_mm`` the organ lies still: there is no lag yet. The tumor's margin is the one with
    this or else the highest ``confidence``. InputError: none has it."""
    stated_mm = stated_radius(located.margin, plan.tumor, confidence)
    if confidence is not None and stated_mm is None:
        raise InputError(
            f"the estimate states no {100 * confidence:g} % margin of {plan.tumor}: "
            f"{margin_words(located.margin)}."
        )
    stated = {"hand-eye": hand_eye_mm, "tool": tool_error_mm}
    budget = ErrorBudget(
        margin_mm=kept_mm(plan.layers, tumor_points(plan, located)),
        hand_eye_mm=HAND_EYE_MM if hand_eye_mm is None else hand_eye_mm,
        tool_mm=OFF_MM + (TOOL_MM if tool_error_mm is None else tool_error_mm),
        motion_mm=moved_mm,
        assumed=tuple(name for name, value in stated.items() if value is None),
    )
    return budget.updated(located.std_mm.get(plan.tumor), stated_mm)


def widened(config: ResectionConfig, budget: ErrorBudget) -> ResectionConfig:
    """With all errors added to the margin of ``config``. Raises InputError: the method keeps no
    margin below the tumor, or ``sigmas`` would count errors twice; NoPlan: it becomes too wide."""
    if config.method != "margin" or config.sigmas > 0:
        raise InputError("--confidence needs the method margin, and no --sigmas.")
    wide_mm = config.margin_mm + budget.sum_mm
    if wide_mm > MARGIN_MM[1]:
        raise NoPlan(
            f"{config.margin_mm:g} mm of healthy tissue and {budget.sum_mm:.1f} mm of error are "
            f"{wide_mm:.1f} mm; allowed are {MARGIN_MM[1]:g}. Look from nearer, or uncover more."
        )
    return msgspec.structs.replace(config, margin_mm=wide_mm)


def checked_against(plan: ResectionPlan, budget: ErrorBudget, accept: bool) -> ResectionPlan:
    """The plan with a note on its budget. NoPlan: the margin doesn't cover the errors, and that was
    not accepted."""
    words = f"{budget.left_mm:.1f} mm of the margin are left after {budget.sum_mm:.1f} mm of error"
    if budget.left_mm < 0:
        words = f"{OVER_BUDGET}: {budget.words}"
        if not accept:
            raise NoPlan(
                f"the margin does not cover the errors: {budget.words}. {_remedy(plan, budget)} "
                "Only for a plan that nobody carries out, accept it (--accept-budget, "
                "accept_budget=True)."
            )
    return replace(plan, notes=(*plan.notes, f"{words}."))


def plan_within(
    located: Located,
    config: ResectionConfig,
    budget_of: Callable[[ResectionPlan], ErrorBudget],
    beyond_errors: bool = False,
) -> tuple[ResectionPlan, ResectionConfig, ErrorBudget]:
    """A plan, its configuration in the end, and its budget. ``beyond_errors``: all errors are added
    to the margin, and a note says so. Raises as ``widened``."""
    plan = plan_resection(located, config)
    budget = budget_of(plan)
    if not beyond_errors:
        return plan, config, budget
    healthy_mm, config = config.margin_mm, widened(config, budget)
    plan = plan_resection(located, config)
    budget = budget_of(plan)
    note = (
        f"the margin is {healthy_mm:g} mm of healthy tissue and {budget.sum_mm:.1f} mm of error, "
        f"with the tumor within {budget.tracking_mm:.1f} mm of its estimate in "
        f"{100 * budget.confidence:g} of 100 such cases."
    )
    return replace(plan, notes=(note, *plan.notes)), config, budget


def kept_mm(layers: tuple[CutLayer, ...], points_mm: Float[np.ndarray, "n 3"]) -> float:
    """The least distance between the planned cut and points of a tumor's surface; if the cut goes
    into the tumor, how deep, negative. The open top is no cut."""
    nearest_mm = np.full(len(points_mm), np.inf)
    below = shapely.Polygon()
    x, y, z = np.asarray(points_mm, float).T
    for layer in reversed(layers):  # from the floor up
        lines = [evenly_round(ring, _SPACING_MM) for ring in layer.rings_mm]
        beside_mm = cKDTree(np.concatenate(lines)).query(np.column_stack([x, y]))[0]
        beyond_mm = np.clip(z, layer.bottom_mm, layer.top_mm) - z
        nearest_mm = np.minimum(nearest_mm, np.hypot(beside_mm, beyond_mm))
        area = polygon_of(layer.rings_mm)
        ledge = area.difference(below)
        over = shapely.contains_xy(ledge, x, y)
        nearest_mm[over] = np.minimum(nearest_mm, np.abs(z - layer.bottom_mm))[over]
        below = area
    outside = ~inside(layers, points_mm)
    return float(-nearest_mm[outside].max() if outside.any() else nearest_mm.min())


def kept_words(plan: ResectionPlan, located: Located) -> str:
    """The margin kept and, if it differs, the one asked for."""
    kept = kept_mm(plan.layers, tumor_points(plan, located))
    asked = f"{plan.margin_mm:g} mm asked for"
    if kept < 0:
        return f"the cut goes {-kept:.1f} mm into the tumor ({asked})"
    return f"margin {kept:.1f} mm" + (
        "" if f"{kept:.1f}" == f"{plan.margin_mm:.1f}" else f" ({asked})"
    )


def tumor_points(plan: ResectionPlan, located: Located) -> Float64[np.ndarray, "n 3"]:
    """On the tumor's surface; table frame, mm."""
    return located.meshes[plan.tumor].spread_mm()


def _remedy(plan: ResectionPlan, budget: ErrorBudget) -> str:
    """A margin that suffices, if there is one."""
    enough_mm = math.ceil(2 * (plan.margin_mm - budget.left_mm) + 0.2) / 2
    if plan.method != "margin":
        return "The method keeps no margin below the tumor; take the method margin."
    if enough_mm > MARGIN_MM[1]:
        return "Look from nearer, or uncover more of the organ."
    return f"{enough_mm:g} mm would cover them (--margin, margin_mm)."
