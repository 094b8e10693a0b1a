"""A recorded frame that has not been read yet."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NoReturn, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool

from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, DepthFrame, SensorCloud


@dataclass(frozen=True, eq=False)
class Content:
    """What was recorded of one instant; camera frame, mm. ``mask`` and ``truth`` as in ``Seen``."""

    frame: DepthFrame | SensorCloud
    mask: Bool[np.ndarray, "h w"] | None = None
    truth: Anatomy | None = None


@dataclass(frozen=True, eq=False)
class Shot:
    """When a frame was taken, and the way to it. ``load`` raises InputError where it is damaged;
    what it gives has this stamp."""

    stamp_ns: int
    load: Callable[[], Content]


@runtime_checkable
class Reel(Protocol):
    """An open recording."""

    def shots(self) -> Iterator[Shot]:
        """From the first to the last, anew with each call. What is damaged is a shot too, whose
        ``load`` says so."""
        ...

    def close(self) -> None:
        """May be called twice."""
        ...


def refuse(error: InputError) -> NoReturn:
    """The ``load`` of a frame that is known to be damaged."""
    raise error
