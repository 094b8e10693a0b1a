"""A stream of sensor clouds -> estimates: each search starts at the last answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.assessment.causes import check_of
from tumortrack.assessment.verdict import Disputes
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.evidence import Evidence
from tumortrack.core.geometry import IDENTITY, Affine, transform_points
from tumortrack.core.report import Likely
from tumortrack.core.types import DepthFrame, SensorCloud, View
from tumortrack.tracking.cuts import Cuts
from tumortrack.tracking.tracker import Tracker, seen_from

# For so long after a good estimate the organ is also searched for upside down. In first views, that
# search called 18 of 46 kidneys of other patients, or mirrored ones, good; none without it.
_TURNED_OVER_S = 30.0
# Causes are searched for at most this often for each failed check, as that takes several frames.
_CAUSES_EVERY_S = 1.0
# Evidence outlasts a hand before the camera: tissue carries what lies on it, as it is seen again.
_REMEMBERED_S = 60.0
# Of an organ that is cut an image may show several pieces, of which only together are like it:
# where it was lost, they are taken together in one tenth of a second, and in the next one not.
_TOGETHER_NS = 100_000_000


class FollowerConfig(Config, frozen=True, kw_only=True):
    """``rescan_s``: interval of searches as in a first frame. ``forget_s``: an older estimate is
    not used for the next frame. ``smoothing_s``: time constant of the mean over past estimates, 0:
    none; the lag it adds is in every report."""

    rescan_s: float = 1.0
    forget_s: float = 1.0
    smoothing_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("rescan_s", "forget_s"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name):g}; it must be more than 0 s.")
        FollowOptions(smoothing_s=self.smoothing_s, seed=self.seed)  # the same checks


class Follower:
    """Locates in frame after frame, each search starting at the last estimate. Raises InputError:
    smoothing with a model that knows no motion."""

    def __init__(self, tracker: Tracker, config: FollowerConfig) -> None:
        if config.smoothing_s > 0 and tracker.anatomy_ct is None:
            raise InputError(
                "smoothing needs a motion, which models of the presets quick and paper do not "
                "know. Give the case itself, or leave smoothing out."
            )
        self._tracker, self._config = tracker, config
        self._last: Estimate | None = None
        self._scanned_ns, self._at_rest = 0, False
        self._known, self._known_ns = tuple[Any, ...](), 0  # evidence of the last estimate
        self._found: Estimate | None = None  # the last one, however old
        self._good_ns: int | None = None
        self.disputes, self.cuts = Disputes(), Cuts(tracker)
        self._causes_ns, self._causes = 0, dict[str, tuple[Likely, ...]]()

    def warm(self) -> None:
        self._tracker.warm()

    def forget(self) -> None:
        """Drop the last estimate and all evidence but cuts: after a new clock, or a new pick."""
        self._last, self._known, self._found = None, (), None

    def lose(self) -> None:
        """Drop the last estimate: the organ was not found."""
        self._last = None

    def begin(self, estimate: Estimate) -> None:
        """Start the next search at this estimate of an organ at rest, however old it is by then."""
        self._last, self._at_rest, self._scanned_ns = estimate, True, estimate.cloud.stamp_ns

    def last_box_mm(
        self, stamp_ns: int, camera_from_last: Affine = IDENTITY
    ) -> Float64[np.ndarray, "2 3"] | None:
        """The organ's box in the last estimate, if that is recent enough; camera frame.
        ``camera_from_last``: from the camera frame of that estimate."""
        last = self._recent(stamp_ns)
        if last is None and self.cuts.known and stamp_ns // _TOGETHER_NS % 2:
            last = self._found
        if last is None:
            return None
        organ = last.organ_mesh
        if camera_from_last is not IDENTITY:
            organ = organ.with_vertices(transform_points(camera_from_last, organ.vertices_mm))
        return organ.box_mm

    def locate(
        self,
        cloud: SensorCloud,
        full_view: DepthFrame | SensorCloud | None = None,
        *,
        views: Sequence[View] = (),
        evidence: Sequence[Evidence] = (),
        camera_from_last: Affine = IDENTITY,
    ) -> Estimate:
        """The estimate of this frame. ``views``: of further cameras; ``evidence``: what became
        known with it, beside what was known before; ``camera_from_last``: as in ``last_box_mm``.
        Raises NoEstimate, as ``Tracker.follow``; the last estimate is then dropped, but not the
        evidence. Cuts among it are known to the end, see ``cuts``."""
        if (tracker := self.cuts.tracker()) is not None:
            self.disputes.carry_over(self._tracker.anatomy_ct, tracker.anatomy_ct)
            self._tracker = tracker
        evidence = self.cuts.take(evidence, cloud.stamp_ns, camera_from_last)
        last, self._last, self._at_rest = self._recent(cloud.stamp_ns), None, False
        if last is not None and camera_from_last is not IDENTITY:
            last = seen_from(last, camera_from_last)
        earlier = () if last is not None else self._earlier(cloud.stamp_ns, camera_from_last)
        global_search = (cloud.stamp_ns - self._scanned_ns) * 1e-9 >= self._config.rescan_s
        if last is None or global_search:
            self._scanned_ns = cloud.stamp_ns
        since_ns = np.inf if self._good_ns is None else cloud.stamp_ns - self._good_ns
        if not 0 <= (cloud.stamp_ns - self._causes_ns) * 1e-9 < _CAUSES_EVERY_S:
            self._causes_ns, self._causes = cloud.stamp_ns, {}
        how = FollowOptions(
            global_search=global_search,
            allow_flip=bool(0 <= since_ns <= _TURNED_OVER_S * 1e9),
            smoothing_s=self._config.smoothing_s,
            seed=self._config.seed,
            known=self._causes,
            earlier=earlier,
        )
        try:
            self._last = self._tracker.follow(
                cloud, last, how, full_view, views=views, evidence=evidence
            )
        except NoEstimate as error:
            if error.causes:
                self._causes = {**self._causes, "none": error.causes}
            self.cuts.settle(cloud.stamp_ns)
            raise
        self.cuts.settle(cloud.stamp_ns, self._last, camera_from_last)
        self._known, self._known_ns = self._last.evidence, cloud.stamp_ns
        self._found = self._last
        if causes := self._last.causes:
            self._causes = {**self._causes, check_of(self._last): causes}
        if self._last.quality == "good":
            self._good_ns = cloud.stamp_ns
        return self._disputed(self.cuts.reported(self._last))

    def _disputed(self, estimate: Estimate) -> Estimate:
        """Poor, while evidence that contradicted one before is not acknowledged, or too little is
        known of what was cut; the next frame is followed as if it were not."""
        finding = self.disputes.update(estimate) or self.cuts.finding
        if finding is None or estimate.finding is not None:
            return estimate
        return estimate.assessed(finding=finding)

    def _earlier(self, stamp_ns: int, camera_from_last: Affine) -> tuple[Any, ...]:
        """Evidence of before the organ was lost."""
        if not 0 <= (stamp_ns - self._known_ns) * 1e-9 <= _REMEMBERED_S:
            return ()
        if camera_from_last is IDENTITY:
            return self._known
        return tuple(each.seen_from(camera_from_last) for each in self._known)

    def _recent(self, stamp_ns: int) -> Estimate | None:
        if self._last is None:
            return None
        age_s = (stamp_ns - self._last.cloud.stamp_ns) * 1e-9
        recent = 0 <= age_s <= self._config.forget_s or self._at_rest
        return self._last if recent else None
