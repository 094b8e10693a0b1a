"""What an answer says of itself: how well it fits, how sure it is, what speaks against it or
weakens its case, or why there is none."""

from __future__ import annotations

import string
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum, auto
from typing import Any, Literal

import msgspec

from tumortrack.core.renamed import Renamed
from tumortrack.core.tables import read_table
from tumortrack.core.wording import for_caller

Point = tuple[float, float, float]

# Which check an estimate failed; other: of a moment, or the model. none: no estimate.
Check = Literal[
    "poses", "fit", "outliers", "seen_through", "unseen", "size", "place", "other", "none"
]
Kind = Literal[
    "not_judged", "poses", "outliers", "fit", "size", "upside_down", "tilted", "not_turned",
    "alternative",
    "missing", "unsure", "miss", "depths", "improbable", "seen_through", "unseen", "hidden_now",
    "evidence", "disputed", "cut_unknown", "cut_new", "flap", "model", "frame_in_doubt",
    "good_again",
    # No estimate: the frame or its source.
    "no_frame", "source", "defect", "stamp_negative", "stamp_back", "stale", "future", "too_late",
    "frozen", "other_frame_id", "frame_id_changed", "intrinsics_changed", "moved", "cameras",
    "no_pose", "old_pose", "new_pose", "pose_gap", "unconnected", "scan_waits", "scan_failed",
    "scan_poor",
    # No estimate: the organ in it.
    "few_points", "few_in_range", "sparse", "line", "behind_camera", "pick_missed", "no_picture",
    "no_organ_colour", "spread", "misfit", "implausible", "organ_seen_through", "few_inside",
    "left", "far_off",
    # What weakens a case.
    "cut", "thick", "flat", "dropped", "left_out", "beside", "volume",
]  # fmt: skip


FAR_OFF = "miss", "depths"  # what makes an answer poor that nothing else speaks against
# Known well enough: with 95 % to 0.5 mm of a probe's way at 10 mm/s; to 1 mm of 5 cm.
_KNOWN_LAG_S, _KNOWN_SCALE = 0.025, 0.02


class _Said(msgspec.Struct, forbid_unknown_fields=True):
    """Of a ``poor`` estimate the check that failed, and the sentence; of ``none``, and of a weak
    ``case``, the sentence."""

    poor: dict[Kind, tuple[Check, str]]
    none: dict[Kind, str]
    case: dict[Kind, str]


_MESSAGES = read_table("tumortrack.core", "findings.toml", _Said)
_SENTENCES = (
    {kind: said for kind, (_, said) in _MESSAGES.poor.items()} | _MESSAGES.none | _MESSAGES.case
)


class _WithoutNumbers(string.Formatter):
    """Writes # for every number."""

    def format_field(self, value: Any, format_spec: str) -> str:
        return value if isinstance(value, str) else "#"


class Finding(msgspec.Struct, Renamed, frozen=True):
    """What speaks against an answer, or why there is none, or what weakens a case for good, which
    every answer repeats: a kind and its values, from which the sentence is made."""

    kind: Kind
    values: Mapping[str, float | str | None] = {}

    @property
    def check(self) -> Check:
        return _MESSAGES.poor[self.kind][0] if self.kind in _MESSAGES.poor else "none"

    @property
    def message(self) -> str:
        return for_caller(_SENTENCES[self.kind].format(**self.values))

    @property
    def words_without_numbers(self) -> str:
        """For counts of what happened often."""
        return _WithoutNumbers().vformat(_SENTENCES[self.kind], (), self.values)

    @property
    def same_as(self) -> tuple[Kind, object]:
        """Equal for what is the same but for its numbers: the kind, and what was said in words."""
        return self.kind, self.values.get("message")


Note = str | Finding  # of how a case was made: in passing, or a weakness


class _Value(msgspec.Struct, Renamed, frozen=True, kw_only=True):
    """Written whole, and read whatever else a file holds."""


class PartReport(_Value, frozen=True, kw_only=True, omit_defaults=True):
    """One part, camera frame. ``points``: of the labelled cloud, with their mean ``probability``;
    ``center_axes``: unit vectors along which the centre has the deviations
    ``center_axes_std_mm``, the least sure first; ``nearest_mm``: from the centre to the nearest
    point that was seen or is known; ``prior_pull_mm``: how far the elastic prior, against the
    points, holds the centre; ``fit_std_mm``: the largest deviations of centre and surface without
    the camera's common error. None: not found, or the method does not know."""

    label: int
    found: bool
    volume_ml: float | None = None
    center_mm: Point | None = None
    box_mm: tuple[Point, Point] | None = None
    points: int | None = None
    probability: float | None = None
    center_std_mm: float | None = None
    center_axes_std_mm: Point | None = None
    center_axes: tuple[Point, Point, Point] | None = None
    surface_std_mm: float | None = None
    nearest_mm: float | None = None
    prior_pull_mm: float | None = None
    fit_std_mm: tuple[float, float] | None = None


class Residuals(_Value, frozen=True, kw_only=True):
    """Distances of the observed points from the estimated surface, mm."""

    median: float
    p95: float


class AlternativeFit(_Value, frozen=True, kw_only=True):
    """Another fit, which costs ``more``, and has this ``share`` of the probability;
    ``distance_mm``: how far off the parts' middles lie in it, at ``center_mm``, with the organ
    turned by so much."""

    more: float
    distance_mm: dict[str, float]
    center_mm: dict[str, Point] = {}
    turn_degrees: float = 0.0
    share: float = 0.0

    @property
    def message(self) -> str:
        places = (
            f"{n} at ({x:.1f}, {y:.1f}, {z:.1f}) mm" for n, (x, y, z) in self.center_mm.items()
        )
        chance = f"with a chance of {100 * self.share:.0f} %"
        return f"or, {chance}, turned by {self.turn_degrees:.0f} degrees: {', '.join(places)}"


class ExcludedFit(_Value, frozen=True, kw_only=True):
    """A fit in a pose that the case excludes, and how much ``less`` it costs."""

    less: float
    tilt_degrees: float


class FitCost(_Value, frozen=True, kw_only=True):
    """Cost ``now``, and ``without_outliers``, beside the ``usual`` one of validation scenes;
    ``outliers``: share of the points."""

    now: float
    without_outliers: float
    usual: float
    outliers: float
    others: tuple[AlternativeFit, ...] = ()
    excluded_pose: ExcludedFit | None = None


class SizeFit(_Value, frozen=True, kw_only=True):
    """An organ so many ``times`` as large costs less by ``gain``; ``std``: of ``times``."""

    times: float
    gain: float
    std: float = 0.0  # not stated by runs of before


class SmoothingReport(_Value, frozen=True, kw_only=True):
    """Time constant of the mean over past estimates, and the lag that it adds."""

    time_s: float = 0.0
    lag_ms: float = 0.0


class ViewsReport(_Value, frozen=True, kw_only=True):
    """Of several views: where each camera was, and how far from where its pose says."""

    camera_from_view: tuple[tuple[tuple[float, ...], ...], ...]
    shift_mm: tuple[float, ...]
    turn_degrees: tuple[float, ...]


class EvidenceReport(_Value, frozen=True, kw_only=True):
    """One piece of evidence: its kind, part, tool and deviation; how far it lies from the answer at
    most. ``information_gain``: which share of what it says is new beside all else (0 to 1);
    ``rejected``: it contradicts the rest; ``before``: it is of an earlier frame; ``places_mm``: by
    now, camera frame."""

    name: str
    off_mm: float
    information_gain: float
    rejected: bool
    part: str = ""
    tool: str = ""
    std_mm: float | None = None
    before: bool = False
    places_mm: tuple[Point, ...] = ()


class ProbeReport(_Value, frozen=True, kw_only=True):
    """What is wrong in all images of a tracked probe (``core.ultrasound.ImageErrors``), with
    standard deviations. ``shift_std_mm``: by what that leaves open the answer may be shifted, along
    the worst axis; 0 where a camera saw the organ."""

    tool: str
    places: int
    planes: int
    lag_s: float
    lag_std_s: float
    depth: float
    depth_std: float
    width: float
    width_std: float
    shift_std_mm: float = 0.0

    @property
    def undetermined(self) -> tuple[str, ...]:
        """What the planes leave open."""
        known = {
            "lag": self.lag_std_s <= _KNOWN_LAG_S,
            "depth": self.depth_std <= _KNOWN_SCALE,
            "width": self.width_std <= _KNOWN_SCALE,
        }
        return tuple(name for name, is_known in known.items() if not is_known)

    @property
    def message(self) -> str:
        late = "the poses lag the images" if self.lag_s < 0 else "images lag the poses"
        said = {
            "lag": f"{late} by {abs(self.lag_s):.2f} s (standard deviation {self.lag_std_s:.2f})",
            "depth": _longer("along the beam", self.depth, self.depth_std),
            "width": _longer("across the beam", self.width, self.width_std),
        }
        known = [words for name, words in said.items() if name not in self.undetermined]
        if self.undetermined:
            stds = {
                "lag": f"the lag of its images ({self.lag_std_s:.2f} s)",
                "depth": f"lengths along the beam ({self.depth_std:.1%})",
                "width": f"lengths across it ({self.width_std:.1%})",
            }
            which = ", ".join(stds[name] for name in self.undetermined)
            known.append(
                f"undetermined, with the standard deviation: {which}; "
                "sweep forth and back, over the organ's ends"
            )
        return f"{self.tool}, {self.planes} planes: {'; '.join(known)}"


def _longer(along: str, share: float, std: float) -> str:
    longer = "shorter" if share < 0 else "longer"
    return f"lengths {along} are {abs(share):.1%} {longer} than stated (deviation {std:.1%})"


class NextEvidence(_Value, frozen=True, kw_only=True):
    """What to learn next of a part, and what one standard deviation of its middle along its least
    sure axis, and its bound, are and would be ``then``. ``place_mm`` and ``direction`` (unit), by
    kind: of a touch on the organ, with the surface's normal; an outline's middle, with its plane's
    normal; a landmark (``name``: the structure); a view: the camera's place and line of sight."""

    kind: Literal["touch", "outline", "landmark", "view"]
    part: str
    place_mm: Point
    direction: Point
    std_mm: float
    then_std_mm: float
    bound_mm: float | None = None  # not known
    then_bound_mm: float | None = None
    name: str = ""

    @property
    def message(self) -> str:
        x, y, z = (f"{value:.0f}" for value in self.place_mm)
        axis = "xyz"[max(range(3), key=lambda axis: abs(self.direction[axis]))]
        what = {
            "touch": f"touch the organ at {x}, {y}, {z} mm",
            "outline": f"outline {self.part} across {axis}",
            "landmark": f"point at {self.name}",
            "view": f"look from {x}, {y}, {z} mm as well",
        }[self.kind]
        if self.bound_mm is None or self.then_bound_mm is None:
            return what
        bounds = f"{self.then_bound_mm:.1f} mm instead of {self.bound_mm:.1f}"
        return f"{what}: {self.part} would be off by at most {bounds} (95 %)"


class AllowedPoses(_Value, frozen=True, kw_only=True):
    """Poses that the case allows; ``up_lps``: what faces the camera."""

    up_lps: Point
    tilt_degrees: float
    allow_flip: bool


class MotionReport(_Value, frozen=True, kw_only=True):
    """The fitted motion: the rigid transform nearest to it over the organ's surface
    (``camera_from_ct``), and what it is made of: the pose of the deformed organ, elastic
    ``coefficients``; Gauss-Newton ``steps``.
    ``normalized_mahalanobis``: of the library's state; ``compliance_std_mm``: of the compliance,
    whose coefficients are the last; ``misfit_mm``: what the library leaves of groups of
    neighbouring points, root mean square; ``depth_share``: standard deviation of the camera's
    depths, all alike, as a share of them."""

    camera_from_ct: tuple[tuple[float, float, float, float], ...]
    camera_from_deformed_ct: tuple[tuple[float, float, float, float], ...]
    coefficients: tuple[float, ...]
    normalized_mahalanobis: float
    steps: int
    compliance_std_mm: float | None
    misfit_mm: float
    depth_share: float = 0.0  # not stated by runs of before


class CutReport(_Value, frozen=True, kw_only=True):
    """What an answer knows of cuts: at how many places (one in each cube of 1.5 mm), how wide they
    are, and of each tumor's flap the share of its near side that points show; ``outliers``: share
    of the points beside it that lie on no surface. Live, ``known``: how many places are known by
    now, also those that the answer does not know yet; ``unknown``: of which share of an electrode's
    way nobody knows where it was."""

    places: int = 0
    kerf_mm: float = 0.0
    flaps: dict[str, float] = {}
    outliers: float = 0.0
    known: int = 0
    unknown: float = 0.0


class ScanReport(_Value, frozen=True, kw_only=True):
    """How far off the least sure tumor is at most (95 %) with one view, two, ...; without one, the
    organ."""

    error_bound95_mm: tuple[float, ...]


class FitReport(_Value, frozen=True, kw_only=True, omit_defaults=True):
    """An answer's figures, mm in the camera frame; None where a method does not know them.

    Attributes:
        timings: seconds by stage.
        unseen: share of the organ's picture in which a cloud has no points.
        seen_through: share of it behind which the camera sees something else.
        in_sight: share of it that nothing hides.
        doubted_in_sight: ``in_sight`` when the camera last saw through it.
        cameras: numbers of those that saw it, where there are several.
        piece: of the first image, in which it was found; 0: the most likely
        (``SensorCloud.others``).
        peer: of a method beside this one: what it says of its fit.
    """

    parts: dict[str, PartReport] = {}
    seed: int = 0
    points: int = 0
    voxel_mm: float | None = None
    size: SizeFit | None = None
    smoothing: SmoothingReport | None = None
    structures: tuple[str, ...] = ()
    fit_cost: FitCost | None = None
    poses: AllowedPoses | None = None
    motion: MotionReport | None = None
    views: ViewsReport | None = None
    evidence: tuple[EvidenceReport, ...] = ()
    probes: tuple[ProbeReport, ...] = ()
    cut: CutReport | None = None
    fit_mm: Residuals | None = None
    timings: dict[str, float] = {}
    unseen: float | None = None
    seen_through: float | None = None
    in_sight: float | None = None
    doubted_in_sight: float | None = None
    cameras: tuple[int, ...] = ()
    piece: int = 0
    scan: ScanReport | None = None
    peer: dict[str, object] = {}

    @property
    def tumors(self) -> dict[str, PartReport]:
        """All parts but the organ, which is the first."""
        return dict(list(self.parts.items())[1:])


class Cause(StrEnum):
    """Of a poor estimate, or of none."""

    UNIT = auto()
    FRAME = auto()
    MIRRORED = auto()
    SCALE = auto()
    OBJECT = auto()
    BACKGROUND = auto()
    HIDDEN = auto()
    ANOTHER_PATIENT = auto()
    DEFORMED = auto()
    POSES = auto()
    VIEW = auto()
    EVIDENCE = auto()
    NOISE = auto()
    PROBE = auto()


@dataclass(frozen=True)
class Likely:
    """A likely cause. ``number``: the factor of UNIT and SCALE, the share of BACKGROUND and HIDDEN,
    of EVIDENCE the piece, from 1 (None: all of it), of NOISE its standard deviation, mm. ``fit``:
    cost of the fit without it over the model's usual cost; None: not tried."""

    cause: Cause
    number: float | None = None
    fit: float | None = None
