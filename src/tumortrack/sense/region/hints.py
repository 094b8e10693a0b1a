"""What is known about a frame besides its depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tumortrack.sense.region.taught import Taught


@dataclass(frozen=True, eq=False)
class Hints:
    """What is known about a frame besides its depth.

    Attributes:
        mask: of a depth image's pixels, True where the organ may be.
        picked_mm: a point on the organ, camera frame: it decides which piece is taken. Organs move:
            once there is an estimate, give its box instead.
        last_box_mm: lower and upper corner of the last estimate's organ, camera frame.
        taught: what clicks have taught of organ and surroundings; it looks at ``picture``, which
            has a depth image's pixels. None: only geometry counts.
    """

    mask: Bool[np.ndarray, "h w"] | None = None
    picked_mm: Float[np.ndarray, " 3"] | None = None
    last_box_mm: Float[np.ndarray, "2 3"] | None = None
    picture: UInt8[np.ndarray, "h w *rgb"] | None = None
    taught: Taught | None = None
