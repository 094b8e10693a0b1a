"""Recordings on disk: folders of frames, ROS bags, and what the sink ``recording`` writes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from tumortrack.live.values import Observation


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """A frame that is read when ``load`` is called, which raises InputError if it is damaged. The
    observation has this stamp; its ``arrived_ns`` is 0."""

    stamp_ns: int
    load: Callable[[], Observation]


@runtime_checkable
class Recording(Protocol):
    """An open recording."""

    def frames(self) -> Iterator[RecordedFrame]:
        """From first to last; each call starts again. A damaged frame is one whose ``load``
        raises."""
        ...

    def close(self) -> None:
        """May be called twice."""
        ...
