"""The answer for one cloud: points, labelled grid, surfaces, motion and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec
import numpy as np
from jaxtyping import Float, Float64

from tumortrack.core.assessment import Assessment, Quality
from tumortrack.core.config import Config, check_seed
from tumortrack.core.errors import InputError, UnknownPart
from tumortrack.core.evidence import CAMERA, Evidence
from tumortrack.core.geometry import Points
from tumortrack.core.organ import KIDNEY, Organ, is_tumor
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.report import Finding, FitReport, Likely
from tumortrack.core.rigid_fit import kabsch
from tumortrack.core.types import CameraLabels, DepthFrame, Mesh, OccupancyCloud, SensorCloud

LARGEST_GRID = 400
_MOST_NAMED = 7  # parts in an estimate's repr
FAR_MM = 5.0  # an answer with a tumor's centre farther off has failed: a plan's whole usual margin
# Shown beside "good", which alone would claim more than is known.
NO_CHECK_FAILED, UNVERIFIED = "no check failed", "its place is not verified"


def verdict_words(verdict: Quality, reason: str) -> str:
    """The verdict as a sentence; ``reason``: why it is not good."""
    if verdict == "good":
        return f"good: {NO_CHECK_FAILED}; {UNVERIFIED}."
    text = f"{verdict}: {reason.rstrip('.')}."
    return f"{text} Do not rely on it." if verdict == "poor" else text


@runtime_checkable
class Motion(Protocol):
    """One frame's correspondence: undeformed CT (LPS, mm) <-> camera frame (mm). Any finite points,
    n x 3, are allowed, also outside the organ, and give finite ones; InputError for others."""

    def forward(self, points_ct: Points, /) -> Points:
        """From the CT to the camera frame."""

    def inverse(self, points_camera: Points, /) -> Points | None:
        """From the camera frame to the undeformed CT; None if the method has only ``forward``."""

    def std_mm(self, points_ct: Points, /) -> Float[np.ndarray, " n"] | None:
        """Uncertainty of ``forward``: one standard deviation, root mean square of the three axes;
        None if the method does not know it."""

    def largest_std_mm(self, points_ct: Points, /) -> Float[np.ndarray, " n"] | None:
        """The same along the most uncertain direction."""

    def covariance_mm2(self, points_ct: Points, /) -> Float[np.ndarray, "n 3 3"] | None:
        """The covariance in the camera frame."""


@dataclass(frozen=True, eq=False)
class LocatedPart:
    """Where the organ or a tumor is: ``center_mm`` and ``mesh`` in the camera frame, mm.
    ``error_bound95_mm``: with 95 % no point of it lies farther off; None: not known, or the answer
    is poor."""

    name: str
    center_mm: Float64[np.ndarray, " 3"]
    volume_ml: float
    mesh: Mesh
    error_bound95_mm: float | None


class Parts(dict[str, LocatedPart]):
    """What was found, by name; another name raises ``UnknownPart``, a KeyError that names those
    that there are."""

    def __missing__(self, name: str) -> LocatedPart:
        raise UnknownPart(f"{name!r} was not found; there are: {', '.join(self) or 'none'}.")


class FollowOptions(Config, frozen=True, kw_only=True):
    """How to locate a frame of a sequence. ``global_search``: also search independently of the last
    estimate and keep the better fit, as a search near the last one would keep its error.
    ``allow_flip``: the organ may have been turned over. ``smoothing_s``: time constant of the mean
    over past estimates; 0: none. ``known``: recent causes by failed check (``none``: no estimate),
    which are not searched for again. ``evidence``: what became known with this frame, in its camera
    frame; what was known before is in the last estimate, or, where there is none, in ``earlier``
    (as in ``Estimate.evidence``)."""

    global_search: bool = False
    allow_flip: bool = False
    smoothing_s: float = 0.0
    seed: int = 0
    known: dict[str, tuple[Likely, ...]] = msgspec.field(default_factory=dict)
    evidence: tuple[Evidence, ...] = ()
    earlier: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if not 0 <= self.smoothing_s <= 5:
            raise InputError(f"smoothing is {self.smoothing_s:g} s; allowed: 0 (off) to 5 s.")


@dataclass(frozen=True, eq=False, repr=False)
class Estimate:
    """Organ and tumors located in one sensor cloud, all in the camera frame, in mm.

    Attributes:
        volume: None where it was not requested (live).
        meshes: the organ's name, tumor_1, ... -> closed surfaces; a part that was not found is
            absent. The organ's surface includes its tumors, as in ``Anatomy``.
        report: figures: per part volume, centre, box and probability, the fit's cost, ...
        motion: None if the method knows none. ``unsmoothed``: the same before the mean over past
            frames; the next frame's search starts there.
        assessment: how far off the parts may be, whether it is good, and what to do if not.
        patient: of the model; nothing verifies that this is what the camera sees.
        structures: other surfaces of the CT that move with it, by name; empty without a motion.
        evidence: what is known beside the cloud, for the next frame.
        frame: the camera's, or that of evidence alone, without a cloud.
    """

    cloud: OccupancyCloud
    volume: CameraLabels | None
    meshes: Mapping[str, Mesh]
    report: FitReport
    motion: Motion | None = None
    unsmoothed: Motion | None = None
    assessment: Assessment = field(default_factory=Assessment)
    patient: Patient = NOBODY
    organ: Organ = KIDNEY
    structures: Mapping[str, Mesh] = field(default_factory=dict)
    evidence: tuple[Any, ...] = ()
    frame: str = CAMERA

    def __repr__(self) -> str:
        """The verdict, where the organ and each tumor are, and the frame, in ten lines at most."""
        lines = [f"Estimate: {verdict_words(self.quality, self.reason)}"]
        parts = self.report.parts
        for name, part in list(parts.items())[:_MOST_NAMED]:
            middle = None if part.center_mm is None else [round(n, 1) for n in part.center_mm]
            bound = self.assessment.bound_words(name)
            where = f"center_mm={middle}{bound and f', {bound}'}" if part.found else "not found"
            lines.append(f"{name}: {where}")
        if len(parts) > _MOST_NAMED:
            lines.append(f"and {len(parts) - _MOST_NAMED} other parts")
        axes = ": x right, y down, z forward" if self.frame == CAMERA else ""
        return "\n".join([*lines, f"frame: {self.frame}{axes}; mm"])

    def save(
        self,
        folder: str | Path,
        overwrite: bool = False,
        *,
        cloud: SensorCloud | None = None,
        full_view: DepthFrame | SensorCloud | None = None,
    ) -> None:
        """Write what `tumortrack locate` writes: points, labelled volume, surfaces, report, and a
        page to look at (index.html, picture.png). Raises InputError: the folder exists and
        ``overwrite`` is False, or the estimate is of a live frame and has no volume; StorageError:
        the disk refused.

        Args:
            cloud: the organ's points, in which it was located, for the page.
            full_view: all that the camera saw, likewise.
        """
        _located(self, cloud, full_view).save(folder, overwrite)

    def show(
        self,
        *,
        cloud: SensorCloud | None = None,
        full_view: DepthFrame | SensorCloud | None = None,
    ) -> None:
        """Show that page: within a notebook, else in the browser. Where there is no display, print
        where the page is: in a folder for temporary files. Arguments as of ``save``."""
        _located(self, cloud, full_view).show()

    @property
    def finding(self) -> Finding | None:
        return self.assessment.finding

    @property
    def causes(self) -> tuple[Likely, ...]:
        return self.assessment.causes

    @property
    def quality(self) -> Quality:
        return self.assessment.quality

    @property
    def reason(self) -> str:
        return self.assessment.reason

    @property
    def parts(self) -> Mapping[str, LocatedPart]:
        """What was found, by name: the organ, then its tumors. Another name raises UnknownPart, an
        InputError and KeyError."""
        shown = self.assessment.shown
        return Parts(
            (
                name,
                LocatedPart(
                    name,
                    np.array(part.center_mm, np.float64),
                    self.meshes[name].volume_ml,
                    self.meshes[name],
                    shown[name].error_bound95_mm if name in shown else None,
                ),
            )
            for name, part in self.report.parts.items()
            if part.center_mm is not None and name in self.meshes
        )

    @property
    def tumors(self) -> Mapping[str, LocatedPart]:
        """The tumors that were found, by name: tumor_1, ...; other names as of ``parts``."""
        return Parts((name, part) for name, part in self.parts.items() if is_tumor(name))

    @property
    def camera_from_ct(self) -> Float64[np.ndarray, "4 4"]:
        """The rigid transform that lies nearest to the motion (least squares over the organ's
        surface). Raises InputError: the method knows no motion."""
        camera_mm = self.organ_mesh.vertices_mm.astype(np.float64)
        return kabsch(self.inverse(camera_mm), camera_mm, np.ones(len(camera_mm)))

    def forward(self, points_ct: Points) -> Points:
        """Points of the CT (n, 3; LPS, mm), also outside the organ, in the camera frame. Raises
        InputError: the method knows no motion, or they are no finite points."""
        return self._known_motion().forward(points_ct)

    def inverse(self, points_camera: Points) -> Points:
        """Points of the camera frame (n, 3; mm) in the CT. Raises InputError as ``forward``."""
        back = self._known_motion().inverse(points_camera)
        if back is None:
            raise InputError("this method knows its motion in one direction alone.")
        return back

    def _known_motion(self) -> Motion:
        if self.motion is None:
            raise InputError(
                "this estimate knows no motion: it was read from a folder, or its method has none. "
                "Locate with a case: Tracker(load_case(FOLDER)).locate(cloud)."
            )
        return self.motion

    @property
    def organ_mesh(self) -> Mesh:
        return next(iter(self.meshes.values()))

    def assessed(self, **changes: Any) -> Estimate:
        """The same estimate with these fields of its assessment replaced."""
        return replace(self, assessment=msgspec.structs.replace(self.assessment, **changes))

    def reporting(self, **changes: Any) -> Estimate:
        """The same estimate with these fields of its report replaced."""
        return replace(self, report=msgspec.structs.replace(self.report, **changes))


def _located(
    estimate: Estimate, cloud: SensorCloud | None, full_view: DepthFrame | SensorCloud | None
) -> Any:
    """As `locate` writes and shows it. Files and pages lie in packages above this one, so they are
    loaded by name, when a user asks for them."""
    located = import_module("tumortrack.report.locating")
    return located.Located(estimate, seen=located.Seen(cloud, full_view))
