"""What was cut of a followed organ, in places of the CT, and its tracker with all of it.

The organ does not heal: what was cut is known to the end. A cut before the camera is carried to the
CT by where the organ lay then. Making a tracker with more of it takes a second or two; until then
frames are followed with the one before.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import msgspec
import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Cut, Evidence
from tumortrack.core.geometry import IDENTITY, Affine, Points, transform_points
from tumortrack.core.report import FAR_OFF, CutReport, Finding, Point
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion
from tumortrack.tracking.tracker import Tracker

_APART_MM = 1.5  # one place is kept in each cube of this size: what is cut fills few of them
_AIR_MM = 1.0  # outside the organ's surface; as of ``registration.flap``
_WAITS_NS = 1_000_000_000  # for an answer that says where the organ is; later it may have moved
_SURE_MM = 2.0  # of an answer that is too unsure to be good: a shift of cuts that does no harm
_EVERY_NS, _RESTED_NS = 3_000_000_000, 500_000_000  # a tracker is made so often, or after a leg


class Cuts:
    """Of one organ, from the start of its tracker. ``beside``: new trackers are made while frames
    go on; else the frame waits, and a replay gives the same."""

    def __init__(self, tracker: Tracker, beside: bool = False) -> None:
        self.beside, self.trouble = beside, ""
        self._first, self._pool = tracker, ThreadPoolExecutor(1, "cuts")
        self._places_ct, self._kerf_mm = dict[Any, Point](), 0.0  # a place in each cube
        # Since when, in the frame of the last estimate: no estimate has said yet where they are.
        self._waiting = list[tuple[int, Cut, Points]]()
        self._told, self._carried, self._lost = False, 0, 0
        self._in_use = self._asked = 0  # how many places the tracker knows, and the one to come
        self._since_ns = self._newest_ns = 0  # of places that no tracker was asked for
        self._coming: Future[Tracker] | None = None
        shape = tracker.model.shape if isinstance(tracker.model, RegistrationModel) else None
        if shape is not None and (cut := shape.cut) is not None:
            before = tuple(map(tuple, cut.points_ct.tolist()))
            self._keep(Cut(points_ct=before, kerf_mm=cut.kerf_mm), cut.points_ct, 0)
            self._in_use = self._asked = self.known

    @property
    def known(self) -> int:
        """How many places of cuts."""
        return len(self._places_ct)

    @property
    def finding(self) -> Finding | None:
        """What is wrong with every answer for now."""
        known, new = self.known, self.known - self._in_use
        if self._told or (self._lost and (not known or self._lost > self._carried)):
            return Finding("cut_unknown")
        if 2 * new > known:
            trouble = self.trouble and f": {self.trouble}"
            return Finding("cut_new", {"percent": 100 * new / known, "trouble": trouble})
        return None

    def tell(self) -> None:
        """It is being cut, and nothing is known of where: until a cut says it."""
        self._told = True

    def deny(self) -> None:
        """The user says that it was not cut where nothing is known of it."""
        self._told, self._lost = False, 0

    def take(
        self, evidence: Sequence[Evidence], stamp_ns: int, camera_from_last: Affine
    ) -> tuple[Evidence, ...]:
        """Evidence of a frame; what is no cut is handed back. ``camera_from_last``: from the frame
        of the last estimate. Raises InputError: the model knows no motion."""
        cuts = [each for each in evidence if isinstance(each, Cut)]
        if cuts and not isinstance(self._first.model, RegistrationModel):
            raise InputError("cuts need a model that knows a motion: give the case itself.")
        for cut in cuts:
            if cut.points_ct:
                self._keep(cut, np.array(cut.points_ct), stamp_ns)
                continue
            places_mm = transform_points(np.linalg.inv(camera_from_last), np.array(cut.places_mm))
            self._waiting.append((cut.stamp_ns or stamp_ns, cut, places_mm))
        return tuple(each for each in evidence if not isinstance(each, Cut))

    def settle(
        self, stamp_ns: int, estimate: Estimate | None = None, camera_from_last: Affine = IDENTITY
    ) -> None:
        """At a frame's end: ``estimate``: what was found, not judged by cuts."""
        waiting, self._waiting = self._waiting, []
        for since_ns, cut, places_mm in waiting:
            places_mm = transform_points(camera_from_last, places_mm)
            if not 0 <= stamp_ns - since_ns <= _WAITS_NS:
                self._lost += len(places_mm)
            elif (points_ct := _in_ct(places_mm, estimate)) is None:
                self._waiting.append((since_ns, cut, places_mm))
            else:
                self._carried += len(places_mm)
                self._keep(cut, points_ct, stamp_ns)
        if self._coming is not None or self.known == self._asked:
            return
        waits, moves = stamp_ns - self._since_ns, stamp_ns - self._newest_ns
        if not (0 <= waits < _EVERY_NS and 0 <= moves < _RESTED_NS):
            self._asked = self.known
            self._coming = self._pool.submit(_made, self._first, self.all)
            if not self.beside:
                wait([self._coming])

    def tracker(self) -> Tracker | None:
        """One that knows more than that in use, once. Raises what its making raised."""
        if self._coming is None or not self._coming.done():
            return None
        coming, self._coming = self._coming, None
        try:
            made = coming.result()
        except InputError as error:
            self.trouble = str(error)
            return None
        self._in_use, self.trouble = self._asked, ""
        return made

    def reported(self, estimate: Estimate) -> Estimate:
        """With what is known of cuts by now, also where its tracker does not know it yet."""
        if not (about := self.summary()):
            return estimate
        told, known, unknown = estimate.report.cut or CutReport(), about["known"], about["unknown"]
        return estimate.reporting(cut=msgspec.structs.replace(told, known=known, unknown=unknown))

    def summary(self) -> dict[str, Any]:
        """What is known of cuts, how much of it is in use, and of which share nobody knows where it
        was (JSON types); empty: nothing was cut."""
        if not (self.known or self._lost or self._told):
            return {}
        unknown = self._lost / (self._lost + self._carried or 1)
        about = {"known": self.known, "in_use": self._in_use, "unknown": round(unknown, 3)}
        return {**about, "told": self._told, "trouble": self.trouble}

    def _keep(self, cut: Cut, points_ct: Points, stamp_ns: int) -> None:
        model = self._first.model
        assert isinstance(model, RegistrationModel)
        shape = model.shape if model.shape.cut is None else model.shape.cut.intact
        points_ct = points_ct[shape.distances_mm(points_ct, 0) < _AIR_MM]
        if not len(points_ct):
            return
        before, self._told = self.known, False
        self._kerf_mm = max(cut.kerf_mm, self._kerf_mm)
        cubes = map(tuple, np.floor(points_ct / _APART_MM).astype(int).tolist())
        for cube, point in zip(cubes, map(tuple, points_ct.tolist()), strict=True):
            self._places_ct.setdefault(cube, point)
        if self.known > before:
            self._newest_ns = stamp_ns
            self._since_ns = stamp_ns if before == self._asked else self._since_ns

    @property
    def all(self) -> Cut:
        """What is known, in places of the CT."""
        return Cut(points_ct=tuple(self._places_ct.values()), kerf_mm=self._kerf_mm)


def _made(tracker: Tracker, cut: Cut) -> Tracker:
    made = tracker.with_cut([cut])
    made.warm()
    return made


def _in_ct(places_mm: Points, estimate: Estimate | None) -> Points | None:
    """Places of the camera's frame, in the CT; None: it is not known well enough."""
    if estimate is None or not isinstance(motion := estimate.motion, ElasticMotion):
        return None
    points_ct, finding = motion.inverse(places_mm), estimate.finding
    if finding is None:
        return points_ct
    std_mm = motion.std_mm(points_ct) if finding.kind in FAR_OFF else None
    return None if std_mm is None or std_mm.mean() > _SURE_MM else points_ct
