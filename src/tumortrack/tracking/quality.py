"""Whether an estimate should be relied on: the same judgement of files and of live frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt

from tumortrack.core.causes import Check
from tumortrack.core.errors import NotThisOrgan
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import DepthFrame, Intrinsics, Look, Mesh, SensorCloud
from tumortrack.models.in_distribution import FIT_FACTOR, RIVAL_COST
from tumortrack.models.margins import ModelMargins, exceeded, figures, stated_margin
from tumortrack.sense.noise import CAMERA_STD
from tumortrack.sense.render import render_depth

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
_Failed = tuple[Check, str] | None


def judged(
    estimate: Estimate,
    seen: DepthFrame | SensorCloud,
    strictly: bool = False,
    others: Sequence[Look] = (),
) -> Estimate:
    """The estimate with its ``quality``, ``good`` or ``poor``, and the ``reason`` in words; also in
    its report, with the check that failed and the shares of the organ that are seen through and, of
    a cloud, not seen.

    Poor is an estimate that fits the points worse than usual in validation, through which the
    camera sees, that lies where a cloud has no points, that lacks a tumor, or that says itself that
    a tumor's place is unsure. Good means no more than that none holds. Raises NotThisOrgan: a depth
    image sees through so much of it that the organ cannot lie there. Clouds refuse nothing: they
    may be joined from several views.

    Args:
        seen: all that the camera saw, not the organ's points alone, where it is known.
        strictly: the fit must be no worse than usual, whatever the camera sees round the organ.
        others: more looks at it; the one that says most against the estimate counts.
    """
    organ = next(iter(estimate.meshes.values()))
    views, looks = [(organ, seen)], estimate.report.get("looks")
    if looks is not None:
        before = zip(others, looks["camera_from_look"][1:], strict=True)
        for one, camera_from_look in before:
            look_from_camera = np.linalg.inv(np.array(camera_from_look))
            there_mm = transform_points(look_from_camera, organ.vertices_mm)
            views.append((organ.moved(there_mm), one.seen))
    by_image = [seen_through(there, view) for there, view in views if isinstance(view, DepthFrame)]
    clouds = [cloud_shares(there, view) for there, view in views if isinstance(view, SensorCloud)]
    unseen = max((share for _, share in clouds), default=0.0)
    if clouds:
        estimate.report["unseen"] = unseen
    told = min((share for _, share, _ in by_image), default=0.0) if not clouds else 0.0
    by_depth = max((share for share, _, _ in by_image), default=0.0)
    through = max(by_depth, *(share for share, _ in clouds), 0.0)
    estimate.report["seen_through"] = through
    doubtful, impossible = _LIMITS if estimate.motion is not None else _ROUGH_LIMITS
    if by_depth > impossible:
        raise NotThisOrgan(
            f"the camera sees through {100 * by_depth:.0f} % of where the organ would lie"
        )
    failed = _misplaced(estimate) or _misfit(estimate, told > _TOLD and not strictly)
    failed, where = failed or _doubt(estimate), "of where the organ lies"
    if by_image:
        estimate.report["in_sight"] = by_image[0][2]
    if through > doubtful:
        estimate.report["doubted_in_sight"] = estimate.report.get("in_sight", 0.0)
        failed = "seen_through", f"the camera sees through {100 * through:.0f} % {where}"
    elif unseen > _UNSEEN and failed is None:
        failed = "unseen", f"over {100 * unseen:.0f} % {where} the cloud has no points"
    if failed is not None:
        return doubted(estimate, failed[1], failed[0])
    estimate.report["quality"] = {"verdict": "good", "reason": "", "check": ""}
    return replace(estimate, quality="good", reason="")


def unless_hidden(estimate: Estimate, last: Estimate) -> Estimate:
    """The estimate, poor where the camera saw through the ``last`` one, which lay there too, and
    sees less of it now: whatever came before it is no evidence that the organ lies there."""
    doubted_at = last.report.get("doubted_in_sight", 0.0)
    report, (now, then) = estimate.report, (next(iter(e.meshes.values())) for e in (estimate, last))
    if "doubted_in_sight" in report or report.get("in_sight", 1.0) >= _AS_MUCH * doubted_at:
        return estimate
    if np.abs(now.box_mm - then.box_mm).max() > _ELSEWHERE_MM:
        return estimate
    report["doubted_in_sight"] = doubted_at
    reason = "a moment ago the camera saw through where the organ lies; what showed that is hidden"
    return estimate if estimate.quality == "poor" else doubted(estimate, reason)


def with_margin(estimate: Estimate, cloud: SensorCloud, margins: ModelMargins | None) -> Estimate:
    """The estimate with what its model's ``margins`` say in its report; where they say nothing of
    such a one it is ``poor``: within the margin, or no answer. ``cloud``: in which it was located.
    """
    report, organ = estimate.report, next(iter(estimate.meshes.values()))
    if margins is not None and estimate.quality == "good":
        if "unseen" not in report:
            report["unseen"] = cloud_shares(organ, cloud)[1]
        if reason := exceeded(margins.limits, figures(report, margins)):
            estimate = doubted(estimate, reason)
    report["margin"] = stated_margin(report, margins, estimate.quality == "good")
    return estimate


def doubted(estimate: Estimate, reason: str, check: Check = "other") -> Estimate:
    """The same estimate, poor for this reason: this check failed."""
    estimate.report["quality"] = {"verdict": "poor", "reason": reason, "check": check}
    return replace(estimate, quality="poor", reason=reason)


def _misplaced(estimate: Estimate) -> _Failed:
    """Whether a camera was found too far from where its pose says."""
    looks = estimate.report.get("looks", {"shift_mm": (), "turn_degrees": ()})
    most_mm, most_degrees = _FARTHEST * CAMERA_STD[0], np.rad2deg(_FARTHEST * CAMERA_STD[-1])
    errors = zip(looks["shift_mm"], looks["turn_degrees"], strict=True)
    for number, (shift_mm, degrees) in enumerate(errors, start=1):
        if shift_mm > most_mm or degrees > most_degrees:
            off = f"{shift_mm:.1f} mm and {degrees:.1f} degrees"
            return "poses", f"view {number} shows the organ {off} from where its pose has it"
    return None


def _misfit(estimate: Estimate, told: bool) -> _Failed:
    """What the fit says against it; ``told``: a wrong place would be seen through."""
    cost = estimate.report.get("fit_cost")
    if cost is None:
        return None
    if told and cost["strays"] > _MOST_STRAYS:
        share = 100 * cost["strays"]
        return "strays", f"{share:.0f} % of the points do not lie on the organ's surface"
    now, most = (cost["without_strays"], FIT_FACTOR) if told else (cost["now"], 1.0)
    if now > most * cost["usual"]:
        worse = "the organ's surface fits the points worse than in most validation scenes"
        return "fit", f"{worse} ({now / cost['usual']:.1f} times the usual cost)"
    return None


def _doubt(estimate: Estimate) -> _Failed:
    """What else the estimate itself says against it."""
    size = estimate.report.get("size")
    if size is not None and size["gain"] > RIVAL_COST:
        return "size", f"an organ {size['times']:.2f} times as large fits better"
    cost = estimate.report.get("fit_cost", {})
    if beyond := cost.get("beyond"):
        return "place", _other_side(beyond["tilt_degrees"])
    for other in cost.get("others", ()):
        name, apart_mm = max(other["apart_mm"].items(), key=lambda item: item[1])
        if apart_mm > _UNSURE_MM:
            return "place", f"{name} may as well lie {apart_mm:.1f} mm away, which fits too"
    for name, part in estimate.report["parts"].items():
        if not part["found"]:
            return "place", f"{name} was not found"
        if part.get("center_std_mm", 0.0) > _UNSURE_MM:
            return "place", f"the place of {name} is unsure by {part['center_std_mm']:.1f} mm"
        if part["probability"] is not None and part["probability"] < _UNSURE:
            share = part["probability"]
            return "place", f"the points of {name} have a probability of {share:.2f}"
    return None


def _other_side(tilt_degrees: float) -> str:
    """``tilt_degrees``: in which the organ fits, against what is allowed or was found."""
    fits = f"it fits the points as well tilted by {tilt_degrees:.0f} degrees"
    if tilt_degrees > _UPSIDE_DOWN:
        return f"the organ may lie upside down: {fits}"
    if tilt_degrees > _FAR_TILTED:
        return f"the organ may be tilted farther than stated: {fits}"
    return f"the organ may not have been turned over: {fits}"


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
    rim = binary_dilation(picture, iterations=_RIM) & ~picture
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
    empty = np.ones(organ_mm.shape, bool)
    empty[row, column] = False
    picture = np.isfinite(organ_mm)
    apart = np.sqrt(picture.sum() / on.sum())  # pixels between neighbours
    far = distance_transform_edt(empty) > max(_NEAR_MM / _PIXEL_MM, 2 * apart)
    return through, float(far[picture].mean())
