"""Estimates whose reports say what a test needs, and looks that they are judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from tumortrack.core.assessment import ErrorBound
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import IDENTITY
from tumortrack.core.report import Finding, FitReport, NextEvidence
from tumortrack.core.types import DepthFrame, SensorCloud, View

NOWHERE = {
    "camera_from_ct": np.eye(4).tolist(),
    "camera_from_deformed_ct": np.eye(4).tolist(),
    **{
        "coefficients": [],
        "normalized_mahalanobis": 0.3,
        "steps": 4,
        "compliance_std_mm": None,
        "misfit_mm": 0.1,
    },
}


def report_of(**entries: Any) -> FitReport:
    """Of entries as in report.json; parts need no label."""
    parts = entries.get("parts", {}).items()
    labelled = {n: {"label": k, "found": True, **part} for k, (n, part) in enumerate(parts, 1)}
    return msgspec.convert({**entries, "parts": labelled}, FitReport)


def reporting(estimate: Estimate, **entries: Any) -> Estimate:
    """The same estimate with these entries in its report; of a part, too."""
    known = msgspec.to_builtins(estimate.report)
    parts = known.get("parts", {})
    for name, part in entries.pop("parts", {}).items():
        parts[name] = {**parts.get(name, {}), **part}
    return replace(estimate, report=report_of(**{**known, "parts": parts, **entries}))


def advised(estimate: Estimate, advice: Sequence[dict[str, Any]]) -> Estimate:
    """The same estimate with this advice, as in report.json."""
    return estimate.assessed(next_evidence=msgspec.convert(advice, tuple[NextEvidence, ...]))


def bounded(estimate: Estimate, **bounds_mm: float) -> Estimate:
    """The same estimate, good, and its parts off by at most so much."""
    bounds = {name: ErrorBound(mm) for name, mm in bounds_mm.items()}
    return estimate.assessed(finding=None, bounds=bounds)


def looked(full_view: DepthFrame | SensorCloud) -> list[View]:
    """One view; of a cloud all points are the organ's."""
    organ = full_view if isinstance(full_view, SensorCloud) else SensorCloud(np.zeros((1, 3)))
    return [View(organ, full_view, IDENTITY)]


def poor(words: str) -> Finding:
    """A reason of a test's own."""
    return Finding("model", {"message": words})
