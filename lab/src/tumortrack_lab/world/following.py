"""Followers in sequences: every frame's error, stated deviation and verdict.

A method is made for a tracker and a sequence, and then gets one moment after the other: the depth
image of each camera, and the cameras' poses with a calibration's errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Evidence
from tumortrack.core.geometry import transform_points
from tumortrack.core.report import Finding
from tumortrack.core.types import DepthFrame, Look, Mesh, SensorCloud
from tumortrack.live.loop import SURE_AFTER
from tumortrack.registration.rest_shape import distance_of
from tumortrack.report.metrics import surface_distances
from tumortrack.report.rivals import rigid_fit
from tumortrack.sense.region import Hints, RegionConfig, organ_points
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.tracker import Follower, FollowerConfig, Tracker, region_for
from tumortrack_lab.study.tumor_sites import TumorSite
from tumortrack_lab.world.evidence import ALL_TRUE, EvidenceSource, Piece
from tumortrack_lab.world.films import Film

_SURFACES_EVERY = 3  # frames: a Hausdorff distance takes as long as locating
_COARSE = 16  # of the volume, which is not used
_TOUCHES = 6  # in the first frame
_NOTHING_KNOWN = Hints()


class Moment(NamedTuple):
    """One moment: a depth image a camera, and the cameras' poses; the first one's is the frame in
    which answers are given."""

    frames: tuple[DepthFrame, ...]
    first_from_camera: Float64[np.ndarray, "views 4 4"]


Locate = Callable[[Moment], Estimate]


def track(tracker: Tracker, evidence: Sequence[Evidence] = ()) -> Locate:
    """The first camera's images as `tumortrack track` follows them, its wait for the third good
    estimate in a row included. ``evidence``: what becomes known with the first frame."""
    region, follower = region_for(tracker.model), Follower(tracker, FollowerConfig())
    in_a_row, new = 0, tuple(evidence)

    def locate(look: Moment) -> Estimate:
        nonlocal in_a_row, new
        frame, known, new = look.frames[0], new, ()
        try:
            cloud = _organ(frame, region, Hints(last_box_mm=follower.last_box_mm(frame.stamp_ns)))
        except NoEstimate:
            follower.lose()
            in_a_row = 0
            raise
        in_a_row, before = 0, in_a_row
        estimate = follower.locate(cloud, frame, evidence=known)
        in_a_row = before + 1 if estimate.quality == "good" else 0
        wait = Finding("model", {"words": "wait"})
        return estimate.assessed(finding=wait) if 0 < in_a_row < SURE_AFTER else estimate

    return locate


def track_touched(tracker: Tracker, film: Film) -> Locate:
    """``track`` with touches of the unseen side in the first frame, if the organ is found in it."""
    frame, pieces = film.looks(0)[0], list[Piece]()
    with suppress(NoEstimate):
        seen = Scene(_organ(frame, region_for(tracker.model)), film.truth(0), frame)
        source = EvidenceSource.of(seen, (film.meta["number"],), ALL_TRUE)
        pieces = source.touches_at_random(_TOUCHES, source.unseen)
    return track(tracker, [piece.evidence for piece in pieces])


def first_look(tracker: Tracker) -> Locate:
    """Each image of the first camera as if it were the first: no memory."""
    region = region_for(tracker.model)
    return lambda look: tracker.follow(_organ(look.frames[0], region), seen=look.frames[0])


def several_looks(tracker: Tracker) -> Locate:
    """All cameras, each with a place of its own: `tumortrack locate` with several views."""
    region = region_for(tracker.model)

    def locate(look: Moment) -> Estimate:
        clouds = [_organ(frame, region) for frame in look.frames]
        others = zip(clouds[1:], look.frames[1:], look.first_from_camera[1:], strict=True)
        looks = [Look(*other) for other in others]
        return tracker.locate(clouds[0], _COARSE, 0, look.frames[0], looks)

    return locate


def _organ(frame: DepthFrame, region: RegionConfig, hints: Hints = _NOTHING_KNOWN) -> SensorCloud:
    rng = np.random.default_rng((0, frame.stamp_ns))  # as the live loop's
    return organ_points(frame, region, hints, rng).cloud


METHODS: dict[str, Callable[[Tracker, Film], Locate]] = {
    "track": lambda tracker, _: track(tracker),
    "track-touched": track_touched,
    "first-look": lambda tracker, _: first_look(tracker),
    "several-looks": lambda tracker, _: several_looks(tracker),
}


def judge(
    locate: Locate, film: Film, sites: dict[str, TumorSite], region: RegionConfig
) -> list[dict[str, Any]]:
    """A row for each frame and tumor: quality, errors of its centre and, in every third frame of
    all but random sequences, of its surface (Hausdorff), stated deviations, and the centre's error
    in the best rigid pose and in a rigid fit to the organ that the first camera sees in ``region``;
    mm. Without an estimate, or an organ, what needs one is absent."""
    poses, rows, organ = film.first_from_camera(), [], distance_of(film.rest.organ)
    every = _SURFACES_EVERY if film.meta["kind"] != "random" else len(film.stamps_ns) + 1
    for number, time_s in enumerate(film.seconds.tolist()):
        about: dict[str, Any] = {
            "time_s": time_s,
            "bend_mm": float(film.bend_mm[number]),
            "hidden_share": float(film.hidden_share[number]),
        }
        motion, parts = None, {}
        try:
            estimate = locate(Moment(film.looks(number), poses))
            about |= {"quality": estimate.quality, "reason": estimate.reason}
            motion, parts = estimate.motion, estimate.report.parts
        except NoEstimate as error:
            about |= {"quality": "none", "reason": str(error)}
        if motion is not None:
            off_mm = motion.carry(film.targets_ct) - film.targets_mm[number]
            about["targets_mm"] = float(np.linalg.norm(off_mm, axis=1).mean())
        truth = film.truth(number)
        rigid = {"rigid_center_mm": film.camera_from_ct[number]}
        with suppress(NoEstimate):
            cloud = _organ(film.looks(number)[0], region)
            rigid["rigid_fit_center_mm"] = rigid_fit(organ, cloud, film.camera_from_ct[number])
        for name, rest, true in zip(
            film.rest.names[1:], film.rest.tumors, truth.tumors, strict=True
        ):
            row = {**about, "tumor": name, "site": sites[name].kind}
            for key, pose in rigid.items():
                row[key] = _center_mm(transform_points(pose, rest.vertices_mm), true)
            if motion is not None:
                estimated = rest.moved(motion.carry(rest.vertices_mm))
                row["center_mm"] = _center_mm(estimated.vertices_mm, true)
                if (number + 1) % every == 0:
                    row["hausdorff_mm"] = surface_distances(estimated, true, 2.0).hausdorff_mm
                stds = ("center_std_mm", "surface_std_mm")
                row |= {key: getattr(parts[name], key) for key in stds}
            rows.append(row)
    return rows


def _center_mm(found_mm: np.ndarray, true: Mesh) -> float:
    return float(np.linalg.norm(found_mm.mean(0) - true.vertices_mm.mean(0)))  # the same vertices
