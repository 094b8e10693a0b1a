"""A deformation: the organ turned about an axis, the more the farther along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tumortrack.core.config import Config
from tumortrack.simulation.deform.base import Points, View


@dataclass(frozen=True)
class Twist:
    center_ct: np.ndarray  # mm, LPS
    radians_per_mm: float

    def apply(self, points_ct: Points) -> Points:
        x, y, z = (points_ct - self.center_ct).T
        angle = self.radians_per_mm * z
        turned = [x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle), z]
        return (np.stack(turned, axis=1) + self.center_ct).astype(np.float32)

    def record(self) -> dict[str, Any]:
        return {"kind": "twist", "radians_per_mm": self.radians_per_mm}


class TwistConfig(Config, frozen=True, tag="twist"):
    """``most_degrees``: between the organ's two ends."""

    most_degrees: float = 30.0

    def sample(self, view: View, rng: np.random.Generator) -> Twist:
        lower, upper = view.anatomy_ct.organ.box_mm
        degrees = rng.uniform(-self.most_degrees, self.most_degrees)
        return Twist((lower + upper) / 2, float(np.radians(degrees) / (upper - lower)[2]))
