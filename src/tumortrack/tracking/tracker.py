"""Sensor cloud -> estimate, by whichever kind of model there is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate, Following
from tumortrack.core.process import keep_small_blocks
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.models.model import Model
from tumortrack.occupancy.locator import OccupancyLocator
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.registration.locator import RegistrationLocator
from tumortrack.registration.model import RegistrationModel

_ALONE = Following()


@runtime_checkable
class Locator(Protocol):
    """One method at work; ``Tracker`` documents the calls."""

    anatomy_ct: Anatomy | None

    def locate(self, cloud: SensorCloud, grid: int, seed: int) -> Estimate: ...

    def follow(self, cloud: SensorCloud, last: Estimate | None, how: Following) -> Estimate: ...

    def warm(self) -> None: ...


_LOCATORS: dict[type[Model], Callable[[Any], Locator]] = {
    RegistrationModel: RegistrationLocator,
    OccupancyModel: OccupancyLocator,
}


class Tracker:
    """Locates the organ and tumors of one model in sensor clouds (camera frame, mm).

    A process that has one keeps what memory a frame frees for the next one.
    """

    def __init__(self, model: Model) -> None:
        keep_small_blocks()
        self.model = model
        self._locator = _LOCATORS[type(model)](model)

    @property
    def anatomy_ct(self) -> Anatomy | None:
        """The organ in the CT (LPS, mm) if this model's estimates have a motion; None for models
        that know no correspondences."""
        return self._locator.anatomy_ct

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

    def follow(
        self, cloud: SensorCloud, last: Estimate | None = None, how: Following = _ALONE
    ) -> Estimate:
        """The same, fast, for one frame of many: no volume, and a search that starts at the
        ``last`` estimate, if there is one a moment old. Models that know no motion smooth nothing.

        Raises:
            NoEstimate: as ``locate``.
            InputError: the cloud is in metres.
        """
        return self._locator.follow(cloud, last, how)

    def warm(self) -> None:
        """Load and compile what ``follow`` needs, which its first call would otherwise wait for."""
        self._locator.warm()
