"""Sensor cloud -> estimate, by whichever kind of model there is."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError
from tumortrack.core.types import SensorCloud
from tumortrack.learn.model import Model
from tumortrack.track.estimate import Estimate
from tumortrack.track.occupancy import OccupancyLocator
from tumortrack.track.warp import WarpLocator

LARGEST_GRID = 400


class Locator(Protocol):
    """One kind of model at work."""

    organ_box_ct: Float[np.ndarray, "2 3"] | None

    def locate(self, cloud: SensorCloud, grid: int, seed: int) -> Estimate: ...


class Tracker:
    """Locates the organ and tumors of one model in sensor clouds (camera frame, mm)."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._locator: Locator = (
            WarpLocator(model) if model.config.network.warps else OccupancyLocator(model)
        )

    @property
    def organ_box_ct(self) -> Float[np.ndarray, "2 3"] | None:
        """The organ's box in the CT (LPS, mm: lower and upper corner) if this model's estimates
        have a motion; None for models that know no correspondences."""
        return self._locator.organ_box_ct

    def locate(self, cloud: SensorCloud, grid: int = 160, seed: int = 0) -> Estimate:
        """Everything about one cloud; the same cloud and seed give the same answer.

        ``grid``: voxels along the longest side of the dense volume.

        Raises:
            NoEstimate: too few points, no organ found in them, or they do not show this model's.
            InputError: the cloud is in metres; the seed is negative.
        """
        if seed < 0:
            raise InputError(f"the seed is {seed}; it must be 0 or more.")
        return self._locator.locate(cloud, grid, seed)
