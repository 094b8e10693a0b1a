"""From frame to frame: where to look next, and when to look everywhere again."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate, Following
from tumortrack.core.types import SensorCloud
from tumortrack.tracking.tracker import Tracker


class FollowerConfig(Config, frozen=True, kw_only=True):
    """``rescan_s``: so often the organ is also looked for as in a first frame. ``forget_s``: an
    estimate older than that says nothing about the next frame. ``smoothing_s``: time constant of
    the mean over past estimates; 0: none; the lag it adds stands in every report."""

    rescan_s: float = 1.0
    forget_s: float = 1.0
    smoothing_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("rescan_s", "forget_s"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name):g}; it must be more than 0 s.")
        Following(smoothing_s=self.smoothing_s, seed=self.seed)  # the same checks


class Follower:
    """Locates in one frame after the other, each helped by the one before.

    Raises:
        InputError: smoothing, where the model knows no motion.
    """

    def __init__(self, tracker: Tracker, config: FollowerConfig) -> None:
        if config.smoothing_s > 0 and tracker.anatomy_ct is None:
            raise InputError(
                "smoothing needs a motion, which models of the presets quick and paper do not "
                "know. Train with --preset clinic, or leave smoothing out."
            )
        self._tracker, self._config = tracker, config
        self._last: Estimate | None = None
        self._scanned_ns = 0

    def warm(self) -> None:
        """See ``Tracker.warm``."""
        self._tracker.warm()

    def forget(self) -> None:
        """Nothing is known of where the organ is: a new clock, a new pick."""
        self._last = None

    def last_box_mm(self, stamp_ns: int) -> Float64[np.ndarray, "2 3"] | None:
        """The organ's box in the last estimate (camera frame), if that is recent enough."""
        last = self._recent(stamp_ns)
        if last is None:
            return None
        return next(iter(last.meshes.values())).box_mm

    def locate(self, cloud: SensorCloud) -> Estimate:
        """The estimate of this frame.

        Raises:
            NoEstimate: see ``Tracker.follow``; the last estimate is forgotten then.
        """
        last, self._last = self._recent(cloud.stamp_ns), None
        thorough = (cloud.stamp_ns - self._scanned_ns) * 1e-9 >= self._config.rescan_s
        if last is None or thorough:
            self._scanned_ns = cloud.stamp_ns
        how = Following(
            thorough=thorough, smoothing_s=self._config.smoothing_s, seed=self._config.seed
        )
        self._last = self._tracker.follow(cloud, last, how)
        return self._last

    def _recent(self, stamp_ns: int) -> Estimate | None:
        last = self._last
        if last is None:
            return None
        age_s = (stamp_ns - last.cloud.stamp_ns) * 1e-9
        return last if 0 <= age_s <= self._config.forget_s else None
