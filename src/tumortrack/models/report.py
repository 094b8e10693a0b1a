"""What every kind of locator says about its work in the same words."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float

import tumortrack
from tumortrack.core.types import SensorCloud


def report_head(cloud: SensorCloud, seed: int) -> dict:
    """The first entries of report.json."""
    return {
        "tumortrack": tumortrack.__version__,
        "units": "mm",
        "frame": "camera",
        "stamp_ns": cloud.stamp_ns,
        "seed": seed,
        "points": len(cloud.points_mm),
    }


def fit_report(distances_mm: Float[np.ndarray, " n"]) -> dict:
    """How far the observed points lie from the estimated surface."""
    return {
        "median": float(np.median(distances_mm)),
        "p95": float(np.percentile(distances_mm, 95)),
    }


@contextmanager
def stage(seconds: dict[str, float], name: str, device: torch.device) -> Iterator[None]:
    """Notes how long a ``with`` block took."""
    start = time.perf_counter()
    yield
    if device.type == "cuda":  # kernels run on behind the call
        torch.cuda.synchronize(device)
    seconds[name] = time.perf_counter() - start
