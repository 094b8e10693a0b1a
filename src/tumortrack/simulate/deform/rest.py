"""No deformation: the organ as it was in the CT."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tumortrack.core.config import Config
from tumortrack.simulate.deform.base import View


class Rest:
    def apply(self, points_ct: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return points_ct.astype(np.float32)

    def record(self) -> dict:
        return {"kind": "rest"}


class RestConfig(Config, frozen=True, tag="rest"):
    """The identity, for rigid scenes."""

    def sample(self, view: View, rng: np.random.Generator) -> Rest:
        return Rest()
