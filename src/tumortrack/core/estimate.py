"""What is located in one cloud: points, labelled grid, surfaces, motion and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import msgspec
import numpy as np
from jaxtyping import Float

from tumortrack.core.causes import Likely
from tumortrack.core.config import Config, check_seed
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.report import Finding, FitReport
from tumortrack.core.types import CameraLabels, Mesh, OccupancyCloud

LARGEST_GRID = 400
Quality = Literal["good", "poor", "none"]  # none: there is no estimate
# An answer with a tumor's centre farther off has failed: the plan's usual margin, all of it.
FAR_MM = 5.0
# What people read where it is good: that word alone would say more than is known.
NO_CHECK_FAILED, UNVERIFIED = "no check failed", "its place is not verified"
NOT_JUDGED = Finding("not_judged")


def verdict_words(verdict: Quality, reason: str) -> str:
    """A sentence that begins with the verdict; ``reason``: why it is not good."""
    if verdict == "good":
        return f"good: {NO_CHECK_FAILED}; {UNVERIFIED}."
    said = f"{verdict}: {reason.rstrip('.')}."
    return f"{said} Do not rely on it." if verdict == "poor" else said


@runtime_checkable
class Motion(Protocol):
    """One frame's correspondence: undeformed CT (LPS, mm) <-> camera frame (mm). It takes any
    finite points, n x 3, also outside the organ, and returns finite ones; InputError for others."""

    def carry(self, points_ct: Points, /) -> Points:
        """CT points in the camera frame."""

    def back(self, points_camera: Points, /) -> Points | None:
        """Camera points in the undeformed CT; None if the method knows only ``carry``."""

    def std_mm(self, points_ct: Points, /) -> Float[np.ndarray, " n"] | None:
        """Uncertainty of ``carry`` at each point: one standard deviation along any axis, mm; None
        where the method does not know it."""

    def largest_std_mm(self, points_ct: Points, /) -> Float[np.ndarray, " n"] | None:
        """The same along the axis that is least sure."""

    def covariance_mm2(self, points_ct: Points, /) -> Float[np.ndarray, "n 3 3"] | None:
        """The same as a whole covariance, camera frame, mm^2."""


class FollowOptions(Config, frozen=True, kw_only=True):
    """How one frame of many is located. ``thorough``: also search without the last estimate, and
    keep the better fit: a search near the last answer alone would keep its error. ``either_side``:
    somebody may have turned the organ over. ``smoothing_s``: time constant of the mean over past
    estimates; 0: none. ``known``: causes found a moment ago, by the check that failed (of no
    estimate: ``none``), which are not looked for again."""

    thorough: bool = False
    either_side: bool = False
    smoothing_s: float = 0.0
    seed: int = 0
    known: dict[str, tuple[Likely, ...]] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if not 0 <= self.smoothing_s <= 5:
            raise InputError(f"smoothing is {self.smoothing_s:g} s; allowed: 0 (off) to 5 s.")


@dataclass(frozen=True, eq=False)
class Estimate:
    """Organ and tumors located in one sensor cloud, all in the camera frame, in mm.

    Attributes:
        volume: None where it was not requested (live).
        meshes: the organ's name, tumor_1, ... -> closed surfaces; a part that was not found is
            absent. The organ's surface includes its tumors, as in ``Anatomy``.
        report: its figures: per part volume, centre, box and probability, the fit's cost, ...
        motion: where every point of the CT is, if the method knows that; ``unsmoothed``: before the
            mean over past frames: the next frame's search starts from it.
        finding: what speaks against it (see ``tracking.quality.judged``); None: it is good.
        causes: of a poor one, the likeliest first: see ``tracking.causes``.
        advice: what most likely happened and what to do, in words; follows the finding's.
        patient: whose organ the model is of; that this one lies there nothing verifies.
        organ: which organ that is.
        structures: what else of the CT moves with it, by name; empty without a motion.
    """

    cloud: OccupancyCloud
    volume: CameraLabels | None
    meshes: dict[str, Mesh]
    report: FitReport
    motion: Motion | None = None
    unsmoothed: Motion | None = None
    finding: Finding | None = NOT_JUDGED
    causes: tuple[Likely, ...] = ()
    advice: str = ""
    patient: Patient = NOBODY
    organ: Organ = KIDNEY
    structures: Mapping[str, Mesh] = field(default_factory=dict)

    @property
    def quality(self) -> Quality:
        """Whether it may be relied on."""
        return "good" if self.finding is None else "poor"

    @property
    def reason(self) -> str:
        """Why it is poor, and what to do, in words; empty: it is good."""
        return "" if self.finding is None else self.finding.words + self.advice

    @property
    def organ_mesh(self) -> Mesh:
        """The organ's surface, tumors included."""
        return next(iter(self.meshes.values()))

    def reporting(self, **changes: Any) -> Estimate:
        """The same with these fields of its report."""
        return replace(self, report=msgspec.structs.replace(self.report, **changes))
