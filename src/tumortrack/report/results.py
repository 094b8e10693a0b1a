"""What ``evaluate`` and ``track`` return: the figures of their reports as frozen values, in mm and
ms where the name says so. docs/conventions.md defines each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from tumortrack.core.assessment import Quality
from tumortrack.report.summary import headlines, verdict_counts


class Value(msgspec.Struct, frozen=True, kw_only=True):
    """Further entries of a report are left out."""


class SurfaceErrors(Value, frozen=True, kw_only=True):
    """How far a surface is off; all None if it was not found."""

    center_mm: float | None = None
    hausdorff_mm: float | None = None
    hausdorff_one_sided_mm: float | None = None
    hausdorff_95_mm: float | None = None
    surface_mm: float | None = None


class PartErrors(SurfaceErrors, frozen=True, kw_only=True):
    found: bool
    iou: float


class TargetErrors(Value, frozen=True, kw_only=True):
    """Of inner points whose true places are known; ``each_mm`` in their order."""

    mean_mm: float = msgspec.field(name="mean")
    rms_mm: float = msgspec.field(name="rms")
    median_mm: float = msgspec.field(name="median")
    p95_mm: float = msgspec.field(name="p95")
    max_mm: float = msgspec.field(name="max")
    each_mm: tuple[float, ...] = msgspec.field(name="each")


class RigidErrors(Value, frozen=True, kw_only=True):
    """Of a rigid registration; ``not_available``: why there is none."""

    parts: dict[str, SurfaceErrors] = {}
    targets: TargetErrors | None = msgspec.field(name="tre_mm", default=None)
    not_available: str = ""


class SceneErrors(Value, frozen=True, kw_only=True):
    """Of one scene; ``failed``: why its answer counts as failed, None if it does not. ``targets``:
    None without targets, or without an answer."""

    name: str
    quality: Quality
    reason: str
    failed: str | None
    parts: dict[str, PartErrors]
    miou: float
    seconds: float | None = None
    targets: TargetErrors | None = msgspec.field(name="tre_mm", default=None)
    baselines: dict[str, RigidErrors] = {}


class Spread(Value, frozen=True, kw_only=True):
    """Of so many errors; None: infinite, as a part was not found."""

    count: int
    median_mm: float | None = msgspec.field(name="median")
    p95_mm: float | None = msgspec.field(name="p95")
    worst_mm: float | None = msgspec.field(name="worst")
    scene: str
    part: str


class MethodErrors(Value, frozen=True, kw_only=True):
    scenes: int
    center_mm: Spread | None = None
    hausdorff_mm: Spread | None = None
    target_mm: Spread | None = None


class GroupErrors(Value, frozen=True, kw_only=True):
    """Of the scenes with an answer of one verdict."""

    scenes: int
    estimate: MethodErrors
    best_rigid_pose: MethodErrors | None = None
    rigid_fit: MethodErrors | None = None


class PartSummary(SurfaceErrors, frozen=True, kw_only=True):
    """Medians over scenes; None: infinite. ``p95`` by the figure's name."""

    iou: float | None
    found: int
    scenes: int
    p95: dict[str, float | None]


class Evaluation(Value, frozen=True, kw_only=True):
    """``good``, ``poor``, ``none``: scenes by verdict. ``failed``: scenes with a part that was not
    found or a tumor that is far off; ``far``: of these the second kind, ``far_good`` of them called
    good. ``errors``: of ``all``, ``good`` and ``poor`` answers. ``said``: the same in words."""

    scenes: tuple[SceneErrors, ...]
    parts: dict[str, PartSummary]
    errors: dict[str, GroupErrors]
    good: int
    poor: int
    none: int
    failed: int
    far: int
    far_good: int
    miou: float | None
    said: str

    def __repr__(self) -> str:
        return f"Evaluation: {self.said}"


def evaluation(report: Mapping[str, Any]) -> Evaluation:
    """Of ``scenes`` and ``summary`` of an evaluation's report."""
    entries, summary = report["scenes"], report["summary"]
    names = dict.fromkeys(name for entry in entries for name in entry["parts"])
    said = "\n".join([verdict_counts(summary), *headlines(summary)])
    about = {"scenes": entries, "parts": {name: summary[name] for name in names}, "said": said}
    return msgspec.convert({**summary, **about}, Evaluation)


class Percentiles(Value, frozen=True, kw_only=True):
    """Of so many values; None of nothing."""

    count: int
    p50: float | None = None
    p95: float | None = None
    p99: float | None = None
    p999: float | None = msgspec.field(name="p99.9", default=None)
    max: float | None = None


class SinkSummary(Value, frozen=True, kw_only=True):
    delivered: int
    dropped: int
    errors: int
    last_error: str
    latency_ms: Percentiles


class TrackSummary(Value, frozen=True, kw_only=True):
    """``estimates`` by verdict, ``reasons`` in words; ``dropped``: frames that came too fast."""

    updates: int
    estimates: dict[str, int]
    no_estimate: int
    reasons: dict[str, int]
    clock_jumps: int
    latency_ms: Percentiles
    stages_ms: dict[str, Percentiles]
    center_error_mm: dict[str, Percentiles]
    dropped: int
    opened: int
    latency_from: str
    sinks: dict[str, SinkSummary]
    defects: tuple[str, ...]
    cameras: dict[str, int] = {}

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.estimates.items())
        p50 = "-" if self.latency_ms.p50 is None else f"{self.latency_ms.p50:.0f}"
        return (
            f"TrackSummary: {self.updates} frames: {counts}, {self.no_estimate} none; "
            f"median latency {p50} ms; {self.dropped} dropped"
        )


def track_summary(figures: Mapping[str, Any]) -> TrackSummary:
    """Of ``live.loop.summary``."""
    return msgspec.convert(figures, TrackSummary)
