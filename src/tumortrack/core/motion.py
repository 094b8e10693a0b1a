"""Where points of the CT are now, and where points before the camera were in the CT."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "n 3"]
Carry = Callable[[Points], Points]


@runtime_checkable
class Motion(Protocol):
    """One frame's correspondence: undeformed CT (LPS, mm) <-> camera frame (mm).

    It is asked for any finite points, also outside the organ, and answers with finite ones.
    """

    def carry(self, points_ct: Points, /) -> Points:
        """Where points of the CT lie before the camera."""
        ...

    def back(self, points_camera: Points, /) -> Points | None:
        """Where points before the camera were in the CT; None if only the way there is known."""
        ...

    def std_mm(self, points_ct: Points, /) -> Float[np.ndarray, " n"] | None:
        """How unsure ``carry`` is of each point: one standard deviation along any axis, mm; None
        where the method does not know."""
        ...


@dataclass(frozen=True, eq=False)
class OneWay:
    """The motion of a method that knows the way from the CT to the camera and nothing else."""

    carry: Carry

    def back(self, points_camera: Points, /) -> None:
        return None

    def std_mm(self, points_ct: Points, /) -> None:
        return None
