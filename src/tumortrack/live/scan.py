"""A first estimate from several looks of a camera that is led round an organ at rest."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points, unit
from tumortrack.core.report import ScanReport
from tumortrack.core.types import Look, SensorCloud
from tumortrack.live.values import CameraView
from tumortrack.tracking.tracker import Tracker

LOOKS, WITHIN_S = 3, 5.0
# A look sees the organ's shift along its own line of sight, within a millimetre or so. What the
# others leave open sideways is half along the line of a look from 30 degrees aside.
APART_DEG = 30.0


class Scan:
    """Collects looks until there are enough. ``told``: what each look added, once it is done."""

    def __init__(self, tracker: Tracker) -> None:
        if tracker.anatomy_ct is None:
            raise InputError("a scan needs a model that knows a motion: give the case itself.")
        self._tracker, self.told = tracker, ""
        self._looks: list[tuple[CameraView, SensorCloud, Float64[np.ndarray, " 3"]]] = []

    def look(self, view: CameraView, organ: SensorCloud) -> Estimate:
        """The estimate from all looks, in the frame of the last one. Raises NoEstimate: there are
        too few yet, they are too much alike, or they do not show one organ at rest; then it begins
        anew."""
        there_mm = transform_points(view.published_from_camera, organ.points_mm.astype(float))
        towards = unit(view.published_from_camera[:3, 3] - np.median(there_mm, axis=0))
        oldest_ns = view.seen.stamp_ns - WITHIN_S * 1e9
        self._looks = [one for one in self._looks if one[0].seen.stamp_ns >= oldest_ns]
        angles = [np.degrees(np.arccos(np.clip(towards @ d, -1, 1))) for *_, d in self._looks]
        if min(angles, default=180.0) >= APART_DEG:
            self._looks.append((view, organ, towards))
        if len(self._looks) < LOOKS:
            raise NoEstimate(
                f"scan: {len(self._looks)} of {LOOKS} looks; lead the camera on round the organ, "
                f"{APART_DEG:g} degrees from each look, all within {WITHIN_S:g} s"
            )
        *others, (last, cloud, _) = self._looks
        self._looks = []
        last_from_published = np.linalg.inv(last.published_from_camera)
        looks = [
            Look(its, one.seen.content, last_from_published @ one.published_from_camera)
            for one, its, _ in others
        ]
        try:
            found = [
                self._tracker.follow(cloud, seen=last.seen.content, others=looks[:n])
                for n in range(LOOKS)
            ]
        except NoEstimate as error:
            raise NoEstimate(f"scan, begun anew: {error}") from error
        whole = found[-1]
        if whole.quality != "good":
            raise NoEstimate(f"scan, begun anew: laid together, the looks are poor: {whole.reason}")
        stated_mm = [_least_sure_mm(one) for one in found]
        whole = whole.reporting(scan=ScanReport(center_std_mm=tuple(stated_mm)))
        steps = ", then ".join(f"{mm:.1f} mm" for mm in stated_mm)
        self.told = (
            f"scan: the least sure tumor's centre has a standard deviation of {steps}, with one "
            f"to {LOOKS} looks"
        )
        return whole


def _least_sure_mm(estimate: Estimate) -> float:
    """One standard deviation of the centre of the tumor, or else the organ, that is least sure."""
    parts = list((estimate.report.tumors or estimate.report.parts).values())
    return max(part.center_std_mm or 0.0 for part in parts)
