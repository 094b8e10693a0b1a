"""Whether a frame's stamp can be believed: fresh, and later than the one before."""

from __future__ import annotations

from tumortrack.core.errors import NoEstimate

_AHEAD_S = 0.1  # what two clocks may differ by
_BELIEVED_AFTER = 3  # frames whose stamps grow: then the clock was set back, and goes on from there


class StampCheck:
    """Refuses stale frames and stamps that go back, until a clock that was set back has settled."""

    def __init__(self, stale_s: float) -> None:
        self._stale_s = stale_s
        self._last_ns: int | None = None
        self._behind: list[int] = []
        self.jumps = 0

    def check(self, stamp_ns: int, age_s: float) -> None:
        """``age_s``: how long ago the frame was made, or came, as well as one can tell.

        Raises:
            NoEstimate: stale, or out of order.
        """
        if age_s > self._stale_s:
            raise NoEstimate(
                f"the frame is stale: {age_s:.2f} s old, if the clocks of camera and computer agree"
            )
        if age_s < -_AHEAD_S:
            raise NoEstimate(
                f"the frame's stamp lies {-age_s:.2f} s in the future: the clocks of camera and "
                "computer disagree"
            )
        if stamp_ns < 0:
            raise NoEstimate(f"the frame's stamp is {stamp_ns} ns; it must be 0 or more")
        self._in_order(stamp_ns)

    def _in_order(self, stamp_ns: int) -> None:
        if self._last_ns is None or stamp_ns > self._last_ns:
            self._last_ns, self._behind = stamp_ns, []
            return
        grows = not self._behind or stamp_ns > self._behind[-1]
        self._behind = [*self._behind, stamp_ns] if grows else [stamp_ns]
        back_s = (self._last_ns - stamp_ns) * 1e-9
        if len(self._behind) >= _BELIEVED_AFTER:
            self._last_ns, self._behind = stamp_ns, []
            self.jumps += 1
            return
        raise NoEstimate(f"the frame's stamp went back by {back_s:.3f} s")
