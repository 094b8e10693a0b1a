"""What an answer says of itself: how well it fits, how sure it is, and what speaks against it."""

from __future__ import annotations

from typing import Literal

import msgspec

Point = tuple[float, float, float]

# Which check an estimate failed; other: of a moment, a margin or the model.
Check = Literal["poses", "fit", "strays", "seen_through", "unseen", "size", "place", "other"]
Kind = Literal[
    "not_judged", "poses", "strays", "fit", "size", "upside_down", "tilted", "not_turned", "rival",
    "missing", "unsure", "improbable", "seen_through", "unseen", "hidden_now", "beyond_margins",
    "model",
]  # fmt: skip
# The check that each kind of finding belongs to, and its sentence.
_FINDINGS: dict[Kind, tuple[Check, str]] = {
    "not_judged": ("other", "it was not judged"),
    "poses": (
        "poses",
        "view {view} shows the organ {shift_mm:.1f} mm and {degrees:.1f} degrees from where its "
        "pose has it",
    ),
    "strays": ("strays", "{percent:.0f} % of the points do not lie on the organ's surface"),
    "fit": (
        "fit",
        "the organ's surface fits the points worse than in most validation scenes ({times:.1f} "
        "times the usual cost)",
    ),
    "size": ("size", "an organ {times:.2f} times as large fits better"),
    "upside_down": (
        "place",
        "the organ may lie upside down: it fits the points as well tilted by {degrees:.0f} degrees",
    ),
    "tilted": (
        "place",
        "the organ may be tilted farther than stated: it fits the points as well tilted by "
        "{degrees:.0f} degrees",
    ),
    "not_turned": (
        "place",
        "the organ may not have been turned over: it fits the points as well tilted by "
        "{degrees:.0f} degrees",
    ),
    "rival": ("place", "{part} may as well lie {apart_mm:.1f} mm away, which fits too"),
    "missing": ("place", "{part} was not found"),
    "unsure": ("place", "the place of {part} is unsure by {std_mm:.1f} mm"),
    "improbable": ("place", "the points of {part} have a probability of {probability:.2f}"),
    "seen_through": (
        "seen_through",
        "the camera sees through {percent:.0f} % of where the organ lies",
    ),
    "unseen": ("unseen", "over {percent:.0f} % of where the organ lies the cloud has no points"),
    "hidden_now": (
        "other",
        "a moment ago the camera saw through where the organ lies; what showed that is hidden",
    ),
    "beyond_margins": ("other", "{figure} is {value:.3g}; margins are known up to {limit:.3g}"),
    "model": ("other", "{words}"),
}


class Finding(msgspec.Struct, frozen=True):
    """What speaks against an answer: a kind and its numbers, from which the sentence is made."""

    kind: Kind
    values: dict[str, float | str] = {}

    @property
    def check(self) -> Check:
        """The check that failed."""
        return _FINDINGS[self.kind][0]

    @property
    def words(self) -> str:
        """For people."""
        return _FINDINGS[self.kind][1].format(**self.values)


class _Value(msgspec.Struct, frozen=True, kw_only=True):
    """Written whole, and read whatever else a file holds."""


class PartReport(_Value, frozen=True, kw_only=True, omit_defaults=True):
    """One part, camera frame. ``points``: of the labelled cloud, with their mean ``probability``;
    ``center_axes``: unit vectors along which the centre has the deviations
    ``center_axes_std_mm``, the least sure first. None: not found, or the method does not know."""

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


class Residuals(_Value, frozen=True, kw_only=True):
    """Distances of the observed points from the estimated surface, mm."""

    median: float
    p95: float


class RivalFit(_Value, frozen=True, kw_only=True):
    """Another fit, which costs ``more``; ``apart_mm``: how far off the parts' middles lie in it."""

    more: float
    apart_mm: dict[str, float]


class ExcludedFit(_Value, frozen=True, kw_only=True):
    """A fit in a pose that the case excludes, and how much ``less`` it costs."""

    less: float
    tilt_degrees: float


class FitCost(_Value, frozen=True, kw_only=True):
    """Cost ``now``, and ``without_strays``, beside the ``usual`` one of validation scenes;
    ``strays``: share of the points."""

    now: float
    without_strays: float
    usual: float
    strays: float
    others: tuple[RivalFit, ...] = ()
    beyond: ExcludedFit | None = None


class SizeFit(_Value, frozen=True, kw_only=True):
    """An organ so many ``times`` as large costs less by ``gain``."""

    times: float
    gain: float


class SmoothingReport(_Value, frozen=True, kw_only=True):
    """Time constant of the mean over past estimates, and the lag that it adds."""

    time_s: float = 0.0
    lag_ms: float = 0.0


class LooksReport(_Value, frozen=True, kw_only=True):
    """Of several looks: where each camera was, and how far from where its pose says."""

    camera_from_look: tuple[tuple[tuple[float, ...], ...], ...]
    shift_mm: tuple[float, ...]
    turn_degrees: tuple[float, ...]


class AllowedPoses(_Value, frozen=True, kw_only=True):
    """Poses that the case allows; ``up_lps``: what faces the camera."""

    up_lps: Point
    tilt_degrees: float
    either_side: bool


class MotionReport(_Value, frozen=True, kw_only=True):
    """The fitted motion: pose, elastic ``coefficients`` and their ``rarity``, Gauss-Newton
    ``steps``, and the model error beside it."""

    camera_from_ct: tuple[tuple[float, float, float, float], ...]
    coefficients: tuple[float, ...]
    rarity: float
    steps: int
    discrepancy_mm: float | None
    noise_mm: float | None


class StatedMargin(_Value, frozen=True, kw_only=True):
    """Radii by part, mm, that hold with this confidence; ``map``: of any mapped point."""

    confidence: float
    mm: dict[str, float]


class MarginReport(_Value, frozen=True, kw_only=True):
    """``stated`` by rising confidence; or none, and the ``reason``."""

    stated: tuple[StatedMargin, ...] = ()
    reason: str = ""


class ScanReport(_Value, frozen=True, kw_only=True):
    """Standard deviation of the least sure tumor's centre with one look, two, ..."""

    center_std_mm: tuple[float, ...]


class FitReport(_Value, frozen=True, kw_only=True, omit_defaults=True):
    """An answer's figures, mm in the camera frame; None where a method does not know them.

    Attributes:
        timings: seconds by stage.
        unseen: share of the organ's picture in which a cloud has no points.
        seen_through: share of it behind which the camera sees something else.
        in_sight: share of it that nothing hides.
        doubted_in_sight: ``in_sight`` when the camera last saw through it.
        cameras: numbers of those that saw it, where there are several.
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
    looks: LooksReport | None = None
    fit_mm: Residuals | None = None
    timings: dict[str, float] = {}
    unseen: float | None = None
    seen_through: float | None = None
    in_sight: float | None = None
    doubted_in_sight: float | None = None
    margin: MarginReport | None = None
    cameras: tuple[int, ...] = ()
    scan: ScanReport | None = None
    peer: dict[str, object] = {}

    @property
    def tumors(self) -> dict[str, PartReport]:
        """All parts but the organ, which is the first."""
        return dict(list(self.parts.items())[1:])
