"""A motion without an inverse and without uncertainty, as of a method that only carries points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class OneWay:
    forward: Callable[[np.ndarray], np.ndarray]

    def inverse(self, points_camera: np.ndarray, /) -> None:
        return None

    def std_mm(self, points_ct: np.ndarray, /) -> None:
        return None

    largest_std_mm = covariance_mm2 = std_mm
