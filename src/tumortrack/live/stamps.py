"""Whether a frame's stamp is valid."""

from __future__ import annotations

from tumortrack.core.errors import NoEstimate

_AHEAD_S = 0.1  # what two clocks may differ by
_ACCEPTED_AFTER = 3  # frames whose stamps increase: then the clock was set back


class StampOrder:
    """Refuses stamps that go back unless the clock was set back. It must see every frame: of two
    that were exchanged the loop may be handed one."""

    def __init__(self) -> None:
        self._last_ns = -1
        self._behind: list[int] = []

    def check(self, stamp_ns: int) -> None:
        """Raises NoEstimate for a frame that is out of order."""
        if stamp_ns < 0:
            raise NoEstimate(f"the frame's stamp is {stamp_ns} ns; it must be 0 or more")
        back_ns = self._last_ns - stamp_ns
        if back_ns >= 0:
            grows = not self._behind or stamp_ns > self._behind[-1]
            self._behind = [*self._behind, stamp_ns] if grows else [stamp_ns]
            if len(self._behind) < _ACCEPTED_AFTER:
                raise NoEstimate(f"the frame's stamp went back by {back_ns * 1e-9:.3f} s")
        self._last_ns, self._behind = stamp_ns, []


def check_age(age_s: float, stale_s: float, other_clock: bool = True) -> None:
    """Raises NoEstimate for a frame that is stale, or from the future. ``age_s``: how long ago it
    was made, or came, as far as is known; ``other_clock``: by a camera's clock against this
    computer's."""
    clocks = "the clocks of camera and computer"
    if age_s > stale_s:
        doubt = f", if {clocks} agree" if other_clock else ""
        raise NoEstimate(f"the frame is stale: {age_s:.2f} s old{doubt}")
    if age_s < -_AHEAD_S:
        raise NoEstimate(f"the frame's stamp lies {-age_s:.2f} s in the future: {clocks} disagree")
