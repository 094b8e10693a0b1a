"""Deformations of the organ's elastic body: states of its library, scaled and mixed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float32

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.organ.body import BodyConfig, ElasticBody
from tumortrack.simulation.deform.base import Points, View


@dataclass(frozen=True, eq=False)
class ElasticDeformation:
    """Points follow the velocity field that coefficients of the body's modes give."""

    body: ElasticBody
    coefficients: Float32[np.ndarray, " m"]

    @cached_property
    def _velocity(self) -> Float32[np.ndarray, "i j k 3"]:
        return self.body.velocity(self.coefficients)

    def apply(self, points_ct: Points) -> Float32[np.ndarray, "n 3"]:
        return self.body.follow(self._velocity, points_ct)

    def record(self) -> dict[str, Any]:
        return {"kind": "elastic", "coefficients": self.coefficients.tolist()}


class ElasticConfig(Config, frozen=True, tag="elastic"):
    """A random state of the body's library times ``scale``; a fraction ``mixed`` of scenes adds a
    second state times ``second_scale``. ``body``: how the library is made."""

    scale: tuple[float, float] = (0.2, 1.1)
    mixed: float = 0.25
    second_scale: tuple[float, float] = (0.1, 0.6)
    body: BodyConfig = BodyConfig()

    def sample(self, view: View, rng: np.random.Generator) -> ElasticDeformation:
        """Draw states and scales uniformly. Raises InputError: a view without a body."""
        if view.body is None:
            raise InputError(
                "elastic deformations need the organ's body; build it with body_for(...) and give "
                "it to the Simulator."
            )
        states = view.body.states
        state = states[rng.integers(len(states))] * rng.uniform(*self.scale)
        if rng.uniform() < self.mixed:
            state = state + states[rng.integers(len(states))] * rng.uniform(*self.second_scale)
        coefficients, swelling = state.astype(np.float32), states[:, -1]
        # Swell or shrink no more than the library's states.
        coefficients[-1] = np.clip(coefficients[-1], swelling.min(), swelling.max())
        return ElasticDeformation(view.body, coefficients)
