"""What is known about a frame besides its depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tumortrack.sense.measured_noise import DepthNoise
from tumortrack.sense.region.tissue import TissueClassifier


@dataclass(frozen=True, eq=False)
class Hints:
    """What is known about a frame besides its depth.

    Attributes:
        mask: of a depth image's pixels, True where the organ may be.
        picked_mm: a point on the organ, camera frame; selects the piece. Organs move: once there is
            an estimate, give its box instead.
        last_box_mm: lower and upper corner of the last estimate's organ, camera frame.
        picture: colour or grey image in the depth image's pixels, for ``taught``.
        taught: tells the organ from other tissue by colour. None: only geometry counts.
        noise: of this camera, as an earlier frame showed it; None: it is measured.
    """

    mask: Bool[np.ndarray, "h w"] | None = None
    picked_mm: Float[np.ndarray, " 3"] | None = None
    last_box_mm: Float[np.ndarray, "2 3"] | None = None
    picture: UInt8[np.ndarray, "h w *rgb"] | None = None
    taught: TissueClassifier | None = None
    noise: DepthNoise | None = None
