"""Whether an estimate should be relied on: the same judgement of files and of live frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from tumortrack.core.errors import NotThisOrgan
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.report import Finding, FitReport, Kind, LooksReport
from tumortrack.core.types import DepthFrame, Intrinsics, Look, Mesh, SensorCloud
from tumortrack.models.in_distribution import FIT_FACTOR, RIVAL_COST
from tumortrack.sense.noise import CAMERA_STD
from tumortrack.sense.render import render_depth
from tumortrack.tracking.margins import ModelMargins, exceeded, figures, stated_margin

# Standard deviation of a tumor's middle, and how far from it another fit, nearly as likely, may
# have it.
_UNSURE_MM = 3.0
# Shares of the organ's picture. Right estimates have up to 0.03 (moving and pushed, on tables, in
# beds and cavities, among instruments and hands), an organ upside down 0.12 to 0.16, one laid on
# the points of a hand 0.2 to 0.4, a model laid on another patient's kidney mostly 0.1 to 0.24.
_LIMITS = 0.05, 0.09  # doubtful, impossible
# Without a motion surfaces are rougher: where centres are 2 to 8 mm off, 0.09 to 0.15 are usual.
_ROUGH_LIMITS = 0.1, 0.2
_WIDTH = 212  # pixels: so coarse a picture tells
# Of a state that was doubted: less of what was in sight then may hide the doubt; moved by more from
# one frame to the next, it is another state.
_AS_MUCH, _ELSEWHERE_MM = 0.9, 10.0
_THROUGH_MM = 6.0  # behind the estimated surface: what is seen there lies behind, not beside
# Where the camera sees something round the organ, in more than this share of a rim so many pixels
# (some 3 mm) wide, a wrong place is mostly seen through. Strays are no part of the judged fit then,
# and it may cost ``FIT_FACTOR`` times what is usual: in a wider world than training's (make world)
# the cost alone, without strays up to 1.5 times the usual one, spoke against 18 answers, all right.
_TOLD, _RIM = 0.5, 2
_MOST_STRAYS = 0.5  # of the points: no robust estimate bears more (the breakdown point)
_FARTHEST = 3.0  # standard deviations of where cameras are
_FAR_TILTED, _UPSIDE_DOWN = 60.0, 110.0  # degrees
_UNSURE = 0.6  # mean probability of a tumor's points
_PIXEL_MM = 1.5  # of the picture that a cloud is compared in
_MOST_PIXELS = 1024  # along a side
_MOST_POINTS = 20_000  # of a cloud that tell enough: a frame must not wait for all of 400,000
# Share of the organ's picture where a cloud has no point: up to 0.03 where the whole side that the
# camera sees was scanned (80 scenes, two kinds of deformation); more, and there is no telling what
# lies there: an organ upside down reaches so far beyond the points that it fits.
_UNSEEN = 0.1
_NEAR_MM = 6.0  # of a point, or twice the points' usual distance: seen


def judged(estimate: Estimate, looks: Sequence[Look], strictly: bool = False) -> Estimate:
    """The estimate with what speaks against it, and in its report the shares of the organ that are
    seen through, in sight and, of a cloud, not seen.

    Poor is an estimate that fits the points worse than usual in validation, through which the
    camera sees, that lies where a cloud has no points, that lacks a tumor, or that says itself that
    a tumor's place is unsure. Good means no more than that none holds. Raises NotThisOrgan: a depth
    image sees through so much of it that the organ cannot lie there. Clouds refuse nothing: they
    may be joined from several views.

    Args:
        looks: at it; the one that says most against the estimate counts.
        strictly: the fit must be no worse than usual, whatever the camera sees round the organ.
    """
    views = _organ_before_cameras(estimate, looks)
    by_image = [seen_through(there, view) for there, view in views if isinstance(view, DepthFrame)]
    clouds = [cloud_shares(there, view) for there, view in views if isinstance(view, SensorCloud)]
    unseen = max((share for _, share in clouds), default=0.0)
    told = min((share for _, share, _ in by_image), default=0.0) if not clouds else 0.0
    by_depth = max((share for share, _, _ in by_image), default=0.0)
    through = max(by_depth, *(share for share, _ in clouds), 0.0)
    doubtful, impossible = _LIMITS if estimate.motion is not None else _ROUGH_LIMITS
    if by_depth > impossible:
        raise NotThisOrgan(Finding("organ_seen_through", {"percent": 100 * by_depth}))
    report = estimate.report
    finding = _misplaced(report.looks) or _misfit(report, told > _TOLD and not strictly)
    finding = finding or _doubt(report)
    in_sight = by_image[0][2] if by_image else None
    if through > doubtful:
        finding = _found("seen_through", percent=100 * through)
    elif unseen > _UNSEEN and finding is None:
        finding = _found("unseen", percent=100 * unseen)
    return replace(estimate, finding=finding).reporting(
        unseen=unseen if clouds else report.unseen,
        seen_through=through,
        in_sight=in_sight,
        doubted_in_sight=(in_sight or 0.0) if through > doubtful else None,
    )


def _organ_before_cameras(
    estimate: Estimate, looks: Sequence[Look]
) -> list[tuple[Mesh, DepthFrame | SensorCloud]]:
    """The organ in the frame of each camera, as its place was corrected, and all that it saw."""
    organ, corrected = estimate.organ_mesh, estimate.report.looks
    views = [(organ, looks[0].seen)]
    if corrected is not None:
        for look, pose in zip(looks[1:], corrected.camera_from_look[1:], strict=True):
            look_from_camera = np.linalg.inv(np.array(pose))
            there_mm = transform_points(look_from_camera, organ.vertices_mm)
            views.append((organ.moved(there_mm), look.seen))
    return views


def doubt_if_hidden(estimate: Estimate, last: Estimate) -> Estimate:
    """The estimate, poor where the camera saw through the ``last`` one, which lay there too, and
    sees less of it now: whatever came before it is no evidence that the organ lies there."""
    doubted_at, report = last.report.doubted_in_sight, estimate.report
    if doubted_at is None or report.doubted_in_sight is not None:
        return estimate
    in_sight = 1.0 if report.in_sight is None else report.in_sight
    moved_mm = np.abs(estimate.organ_mesh.box_mm - last.organ_mesh.box_mm).max()
    if in_sight >= _AS_MUCH * doubted_at or moved_mm > _ELSEWHERE_MM:
        return estimate
    estimate = estimate.reporting(doubted_in_sight=doubted_at)
    return replace(estimate, finding=estimate.finding or Finding("hidden_now"))


def with_margin(estimate: Estimate, cloud: SensorCloud, margins: ModelMargins | None) -> Estimate:
    """The estimate with what its model's ``margins`` say in its report; where they say nothing of
    such a one it is ``poor``: within the margin, or no answer. ``cloud``: in which it was located.
    """
    if margins is not None and estimate.finding is None:
        if estimate.report.unseen is None:
            estimate = estimate.reporting(unseen=cloud_shares(estimate.organ_mesh, cloud)[1])
        finding = exceeded(margins.limits, figures(estimate.report, margins))
        estimate = replace(estimate, finding=finding)
    margin = stated_margin(estimate.report, margins, estimate.finding is None)
    return estimate.reporting(margin=margin)


def _found(kind: Kind, **values: Any) -> Finding:
    return Finding(kind, values)


def _misplaced(looks: LooksReport | None) -> Finding | None:
    """Whether a camera was found too far from where its pose says."""
    if looks is None:
        return None
    most_mm, most_degrees = _FARTHEST * CAMERA_STD[0], np.rad2deg(_FARTHEST * CAMERA_STD[-1])
    errors = zip(looks.shift_mm, looks.turn_degrees, strict=True)
    for number, (shift_mm, degrees) in enumerate(errors, start=1):
        if shift_mm > most_mm or degrees > most_degrees:
            return _found("poses", view=number, shift_mm=shift_mm, degrees=degrees)
    return None


def _misfit(report: FitReport, surroundings_seen: bool) -> Finding | None:
    """What the fit says against it; ``surroundings_seen``: a wrong place would be seen through."""
    cost = report.fit_cost
    if cost is None:
        return None
    if surroundings_seen and cost.strays > _MOST_STRAYS:
        return _found("strays", percent=100 * cost.strays)
    now, most = (cost.without_strays, FIT_FACTOR) if surroundings_seen else (cost.now, 1.0)
    if now > most * cost.usual:
        return _found("fit", times=now / cost.usual)
    return None


def _doubt(report: FitReport) -> Finding | None:
    """What else the estimate itself says against it."""
    size, cost = report.size, report.fit_cost
    if size is not None and size.gain > RIVAL_COST:
        return _found("size", times=size.times)
    if cost is not None and cost.beyond is not None:
        return _found(_other_side(cost.beyond.tilt_degrees), degrees=cost.beyond.tilt_degrees)
    for other in () if cost is None else cost.others:
        name, apart_mm = max(other.apart_mm.items(), key=lambda item: item[1])
        if apart_mm > _UNSURE_MM:
            return _found("rival", part=name, apart_mm=apart_mm)
    for name, part in report.parts.items():
        if not part.found:
            return _found("missing", part=name)
        if part.center_std_mm is not None and part.center_std_mm > _UNSURE_MM:
            return _found("unsure", part=name, std_mm=part.center_std_mm)
        if part.probability is not None and part.probability < _UNSURE:
            return _found("improbable", part=name, probability=part.probability)
    return None


def _other_side(tilt_degrees: float) -> Kind:
    """``tilt_degrees``: in which the organ fits, against what is allowed or was found."""
    if tilt_degrees > _UPSIDE_DOWN:
        return "upside_down"
    return "tilted" if tilt_degrees > _FAR_TILTED else "not_turned"


def seen_through(organ: Mesh, frame: DepthFrame) -> tuple[float, float, float]:
    """The share of the estimated organ's picture behind whose surface the camera sees something,
    a table, say, which it could not see if the organ lay there. Pixels without return, and those
    where something lies before the organ, say nothing. 0 where no pixel says anything. And the
    share of a rim round the picture where something lies behind the organ's nearest point: a wrong
    organ reaches beyond the true one, and is seen through where there is something to be seen. And
    the share of its picture that nothing hides."""
    every = max(1, round(frame.intrinsics.width / _WIDTH))
    seen_mm = frame.depth_mm[::every, ::every]
    given = frame.intrinsics
    scaled = (number / every for number in (given.fx, given.fy, given.cx, given.cy))
    few = Intrinsics(*seen_mm.shape[::-1], *scaled)
    organ_mm = render_depth(organ.vertices_mm, organ.faces, few).depth_mm
    both = np.isfinite(organ_mm) & np.isfinite(seen_mm)
    if not both.any():
        return 0.0, 0.0, 0.0
    picture = np.isfinite(organ_mm)
    in_sight = (seen_mm[both] > organ_mm[both] - _THROUGH_MM).sum() / picture.sum()
    rim = _within(_RIM, picture) & ~picture
    told = (seen_mm[rim] > organ_mm[picture].min()).sum() / max(rim.sum(), 1)
    through = (seen_mm[both] > organ_mm[both] + _THROUGH_MM).mean()
    return float(through), float(told), float(in_sight)


def cloud_shares(organ: Mesh, cloud: SensorCloud) -> tuple[float, float]:
    """By a cloud, whose camera is at its origin: the share of the points in the organ's picture
    that lie behind its surface, and the share of the picture that has no points."""
    nearest_mm = organ.vertices_mm[:, 2].min()
    if nearest_mm <= _PIXEL_MM:  # round the camera
        return 0.0, 1.0
    focal = nearest_mm / _PIXEL_MM
    outline = focal * organ.vertices_mm[:, :2] / organ.vertices_mm[:, 2:]
    low, high = np.floor(outline.min(0)), np.ceil(outline.max(0))
    width, height = (int(n) for n in high - low + 1)
    if max(width, height) > _MOST_PIXELS:
        return 0.0, 1.0
    camera = Intrinsics(width, height, focal, focal, *(-low).tolist())
    organ_mm = render_depth(organ.vertices_mm, organ.faces, camera).depth_mm
    points_mm = cloud.points_mm[:: len(cloud.points_mm) // _MOST_POINTS + 1]
    points_mm = points_mm[points_mm[:, 2] > 0].astype(np.float64)
    column, row = np.rint(focal * points_mm[:, :2] / points_mm[:, 2:] - low).astype(int).T
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, z_mm = column[within], row[within], points_mm[within, 2]
    surface_mm = organ_mm[row, column]
    on = np.isfinite(surface_mm)
    if not on.any():
        return 0.0, 1.0
    through = float((z_mm[on] > surface_mm[on] + _THROUGH_MM).mean())
    filled = np.zeros(organ_mm.shape, bool)
    filled[row, column] = True
    picture = np.isfinite(organ_mm)
    apart = np.sqrt(picture.sum() / on.sum())  # pixels between neighbours
    near = _within(max(_NEAR_MM / _PIXEL_MM, 2 * apart), filled)
    return through, float(1 - near[picture].mean())


def _within(reach: float, filled: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Which pixels have a filled one within so many pixels' distance. (Row by row: SciPy's
    distances are slow to import, for which a verdict would wait.)"""
    room, (height, width) = int(min(reach, np.hypot(*filled.shape))), filled.shape
    before = np.cumsum(np.pad(filled, ((room, room), (room + 1, room))), axis=1)
    near = np.zeros(filled.shape, bool)
    for down in range(-room, room + 1):
        across = min(int(np.sqrt(reach**2 - down**2)), room)
        rows = before[room + down : room + down + height]
        ends = rows[:, room + across + 1 :][:, :width]
        near |= ends > rows[:, room - across : room - across + width]
    return near
