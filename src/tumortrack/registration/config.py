"""The warp decoder's configuration: latent -> pose and elastic state (``registration``)."""

from __future__ import annotations

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError


class RegistrationHeadConfig(Config, frozen=True, tag="warp"):
    """Two hidden layers of ``width``, then a rotation, a place, ``modes`` coefficients and whether
    the cloud lies the right way round. The loss compares the places of ``points`` points."""

    modes: int
    width: int = 256
    points: int = 96

    def __post_init__(self) -> None:
        if min(self.modes, self.width, self.points) < 1:
            raise InputError("warp: modes, width and points must be positive.")
