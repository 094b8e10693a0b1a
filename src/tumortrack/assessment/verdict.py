"""Checks of an estimate, the same for files and live frames: good, or poor for a stated reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool

from tumortrack.assessment.advice import with_bounds, worthwhile
from tumortrack.assessment.bound import POOR_MM, bounds_of, depths_within_mm
from tumortrack.core.assessment import ErrorBound, deciding
from tumortrack.core.errors import NotThisOrgan
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.report import EvidenceReport, Finding, FitReport, Kind, LooksReport
from tumortrack.core.types import DepthFrame, Intrinsics, Look, Mesh, SensorCloud
from tumortrack.models.in_distribution import FIT_FACTOR, RIVAL_COST
from tumortrack.sense.noise import CAMERA_STD
from tumortrack.sense.render import render_depth

# Where no bound is known: largest standard deviation of a tumor's centre, and largest
# distance to it in another fit that is nearly as likely.
_MAX_UNCERTAINTY_MM = 3.0
# Shares of the organ's image that are seen through. Right estimates have up to 0.03 (moving and
# pushed, on tables, in beds and cavities, among instruments and hands), an organ upside down 0.12
# to 0.16, one fitted to a hand 0.2 to 0.4, one of another patient's kidney mostly 0.1 to 0.24.
_LIMITS = 0.05, 0.09  # doubtful, impossible
# Without a motion surfaces are rougher: with centres 2 to 8 mm off, 0.09 to 0.15 are usual.
_ROUGH_LIMITS = 0.1, 0.2
_ON = 1 / 3  # of what is behind: on the surface
_AGAINST = 3.0  # pixels that a pixel that is seen through outweighs
_WIDTH = 212  # pixels of the depth image in which the organ is compared
# The doubt about an earlier estimate stays if less than this share of what was in sight then is in
# sight now, unless the organ moved by more than this from one frame to the next.
_AS_MUCH, _MOVED_MM = 0.9, 10.0
_THROUGH_MM = 6.0  # points so far behind the estimated surface are behind the organ, or, of a
_NOISES = 3.0  # noisy camera, so many standard deviations of it
# If the camera sees the surroundings in more than this share of a rim so many pixels (some 3 mm)
# wide round the organ, most wrong places are seen through. The fit is then judged without strays
# and may cost ``FIT_FACTOR`` times the usual cost: in a wider world than training's (make world)
# the cost alone, without strays up to 1.5 times the usual one, rejected 18 answers, all right.
_RIM_SHARE, _RIM = 0.5, 2
_MAX_STRAYS = 0.5  # share of the points: the breakdown point of robust estimates
_MAX_CAMERA_ERROR = 3.0  # standard deviations of a camera's pose
_FAR_TILTED, _UPSIDE_DOWN = 60.0, 110.0  # degrees
_MIN_PROBABILITY = 0.6  # mean over a tumor's points
# Pieces of evidence: of earlier frames; of this one, that agree, also for each that does not. Of 12
# touches with 5 % false ones 29 % of the answers were poor for one that was left out.
_FEW, _MANY, _FOR_EACH = 3, 8, 5
_PIXEL_MM = 1.5  # of the image in which a cloud is compared
_MAX_PIXELS = 1024  # along a side
_MAX_POINTS = 20_000  # of a cloud: enough for the shares, where all of 400,000 would delay a frame
# Largest share of the organ's image without points of a cloud: up to 0.03 if the whole side that
# faces the camera was scanned (80 scenes, two kinds of deformation). An organ upside down reaches
# far beyond the points that it fits.
_MAX_UNSEEN = 0.1
_SEEN_WITHIN_MM = 6.0  # of a point, or twice the points' usual distance


def judged(
    estimate: Estimate, looks: Sequence[Look], strictly: bool = False, factor: float = 1.0
) -> Estimate:
    """The estimate with its bounds and the finding that makes it poor, if any, and in its report
    the shares of the organ that are seen through, in sight and, of a cloud, not seen.

    An estimate is poor if it fits the points worse than usual in validation, if the camera sees
    through it, if it lies where a cloud has no points, if it lacks a tumor, or if a tumor's place
    is uncertain; good means only that none of these holds. Raises NotThisOrgan: a depth image sees
    through so much of it that the organ cannot be there. Clouds never raise it: they may be joined
    from several views.

    Args:
        looks: at the organ; of each share, the worst counts.
        strictly: the fit must be no worse than usual, whatever the camera sees round the organ.
        factor: by which the bounds are multiplied.
    """
    views = _organ_before_cameras(estimate, looks)
    images, clouds = [], []
    for (organ, seen), look in zip(views, looks, strict=False):  # a network takes the first alone
        if isinstance(seen, DepthFrame):
            images.append(seen_through(organ, seen, _behind_mm(look)))
        elif len(seen.points_mm):  # touches alone hide nothing, and are no scan
            clouds.append(cloud_shares(organ, seen, _behind_mm(look)))
    unseen = max((share for _, share in clouds), default=0.0)
    rim_share = min((share for _, share, _ in images), default=0.0) if not clouds else 0.0
    by_depth = max((share for share, _, _ in images), default=0.0)
    through = max(by_depth, *(share for share, _ in clouds), 0.0)
    doubtful, impossible = _LIMITS if estimate.motion is not None else _ROUGH_LIMITS
    if by_depth > impossible:
        raise NotThisOrgan(Finding("organ_seen_through", {"percent": 100 * by_depth}))
    report = msgspec.structs.replace(
        estimate.report, unseen=unseen if clouds else estimate.report.unseen
    )
    bounds = bounds_of(report, factor)
    finding = _misplaced_camera(report.looks)
    finding = finding or _misfit(report, rim_share > _RIM_SHARE and not strictly)
    finding = finding or _doubt(report, bounds)
    in_sight = images[0][2] if images else None
    if through > doubtful:
        finding = Finding("seen_through", {"percent": 100 * through})
    elif unseen > _MAX_UNSEEN and finding is None and not _deciding(report, bounds):
        finding = Finding("unseen", {"percent": 100 * unseen})
    advice = worthwhile(with_bounds(report, estimate.assessment.next_evidence, factor))
    judged = estimate.assessed(bounds=bounds, factor=factor, finding=finding, next_evidence=advice)
    return judged.reporting(
        unseen=report.unseen,
        seen_through=through,
        in_sight=in_sight,
        doubted_in_sight=(in_sight or 0.0) if through > doubtful else None,
    )


def _organ_before_cameras(
    estimate: Estimate, looks: Sequence[Look]
) -> list[tuple[Mesh, DepthFrame | SensorCloud]]:
    """For each camera, the organ in its (corrected) frame, and all that it saw."""
    organ, corrected = estimate.organ_mesh, estimate.report.looks
    views = [(organ, looks[0].seen)]
    if corrected is not None:
        for look, pose in zip(looks[1:], corrected.camera_from_look[1:], strict=True):
            look_from_camera = np.linalg.inv(np.array(pose))
            vertices_mm = transform_points(look_from_camera, organ.vertices_mm)
            views.append((organ.moved(vertices_mm), look.seen))
    return views


def doubt_if_hidden(estimate: Estimate, last: Estimate) -> Estimate:
    """The estimate, poor if the camera saw through the ``last`` one at the same place and sees less
    of it now: what hides the organ since then is no evidence that it is there."""
    doubted_at, report = last.report.doubted_in_sight, estimate.report
    if doubted_at is None or report.doubted_in_sight is not None:
        return estimate
    in_sight = 1.0 if report.in_sight is None else report.in_sight
    moved_mm = np.abs(estimate.organ_mesh.box_mm - last.organ_mesh.box_mm).max()
    if in_sight >= _AS_MUCH * doubted_at or moved_mm > _MOVED_MM:
        return estimate
    estimate = estimate.reporting(doubted_in_sight=doubted_at)
    return estimate.assessed(finding=estimate.finding or Finding("hidden_now"))


def _misplaced_camera(looks: LooksReport | None) -> Finding | None:
    """Whether a camera was found too far from its stated pose."""
    if looks is None:
        return None
    most_mm, most_rad = _MAX_CAMERA_ERROR * CAMERA_STD[0], _MAX_CAMERA_ERROR * CAMERA_STD[-1]
    errors = zip(looks.shift_mm, looks.turn_degrees, strict=True)
    for view, (shift_mm, degrees) in enumerate(errors, start=1):
        if shift_mm > most_mm or degrees > np.rad2deg(most_rad):
            return Finding("poses", {"view": view, "shift_mm": shift_mm, "degrees": degrees})
    return None


def _misfit(report: FitReport, surroundings_seen: bool) -> Finding | None:
    """Too many strays, or too high a cost. ``surroundings_seen``: a wrong place is seen through."""
    cost = report.fit_cost
    if cost is None:
        return None
    if surroundings_seen and cost.strays > _MAX_STRAYS:
        return Finding("strays", {"percent": 100 * cost.strays})
    now, factor = (cost.without_strays, FIT_FACTOR) if surroundings_seen else (cost.now, 1.0)
    if now > factor * cost.usual:
        times = now / cost.usual
        return Finding("fit", {"times": times, "digits": _telling(times, factor)})
    return None


def _doubt(report: FitReport, bounds: Mapping[str, ErrorBound]) -> Finding | None:
    """Another size or pose as likely; a part that is missing, or a tumor that may be far off."""
    size, cost = report.size, report.fit_cost
    if size is not None and size.gain > RIVAL_COST:
        return Finding("size", {"times": size.times})
    if cost is not None and cost.beyond is not None:
        degrees = cost.beyond.tilt_degrees
        return Finding(_tilt_finding(degrees), {"degrees": degrees})
    if (finding := _contradiction(report.evidence)) is not None:
        return finding
    for name, part in report.parts.items():
        if not part.found:
            return Finding("missing", {"part": name})
    if not (deciding := _deciding(report, bounds)):
        return _unsure(report)
    bound_mm, name = max((each.error_bound95_mm, name) for name, each in deciding.items())
    if not bound_mm > POOR_MM:
        return None
    depth_mm = depths_within_mm(report, name)
    if 2 * depth_mm**2 > bound_mm**2:  # most of it
        return Finding("depths", {"depth_mm": depth_mm})
    digits = _telling(bound_mm, POOR_MM)
    values: dict[str, float | str | None] = {
        "part": name,
        "miss_mm": bound_mm,
        "limit_mm": POOR_MM,
        "digits": digits,
    }
    return Finding("miss", values)


def _contradiction(evidence: Sequence[EvidenceReport]) -> Finding | None:
    """Evidence that was left out and decides: of earlier frames most of it, as the answer is rather
    wrong; of this one what a tool holds, or more than many that agree outvote."""
    old = [each.left_out for each in evidence if each.before]
    out = [not each.before and each.left_out for each in evidence]
    agree = len(evidence) - len(old) - sum(out)
    outvoted = agree >= max(_MANY, _FOR_EACH * sum(out))
    most_old = len(old) >= _FEW and sum(old) > len(old) / 2
    wrong = [
        (each.off_mm, number, each.name)
        for number, each in enumerate(evidence, start=1)
        if each.left_out and (most_old if each.before else not outvoted or each.name == "held")
    ]
    if not wrong:
        return None
    off_mm, number, name = max(wrong)  # as causes.py names it
    return Finding("evidence", {"name": name, "number": number, "off_mm": off_mm})


def _telling(value: float, limit: float) -> str:
    """As many decimals as tell a value from the limit that it exceeds."""
    return next((n for n in "123" if round(value, int(n)) > limit), "4")


def _deciding(report: FitReport, bounds: Mapping[str, ErrorBound]) -> Mapping[str, ErrorBound]:
    """The bounds by which an answer is judged: all tumors', or of an organ without tumors its own;
    empty if one is not known."""
    known = deciding(bounds)
    return known if known.keys() >= {*(report.tumors or report.parts)} else {}


def _unsure(report: FitReport) -> Finding | None:
    """Another fit that is as likely, or an uncertain part."""
    for other in () if report.fit_cost is None else report.fit_cost.others:
        name, apart_mm = max(other.apart_mm.items(), key=lambda item: item[1])
        if apart_mm > _MAX_UNCERTAINTY_MM:
            return Finding("rival", {"part": name, "apart_mm": apart_mm})
    for name, part in report.parts.items():
        if part.center_std_mm is not None and part.center_std_mm > _MAX_UNCERTAINTY_MM:
            return Finding("unsure", {"part": name, "std_mm": part.center_std_mm})
        if part.probability is not None and part.probability < _MIN_PROBABILITY:
            return Finding("improbable", {"part": name, "probability": part.probability})
    return None


def _tilt_finding(tilt_degrees: float) -> Kind:
    """``tilt_degrees``: of the other pose in which the organ fits."""
    if tilt_degrees > _UPSIDE_DOWN:
        return "upside_down"
    return "tilted" if tilt_degrees > _FAR_TILTED else "not_turned"


def _behind_mm(look: Look) -> float:
    """What lies so far behind the estimated surface is behind the organ, and no noise of it."""
    measured_mm = 0.0 if look.cloud.noise is None else look.cloud.noise.measured_mm
    return float(np.hypot(_THROUGH_MM, _NOISES * measured_mm))


def seen_through(
    organ: Mesh, frame: DepthFrame, behind_mm: float = _THROUGH_MM
) -> tuple[float, float, float]:
    """Three shares of the estimated organ's image, all 0 if no pixel has a return there.

    1. Where the camera sees something behind the surface, such as a table, which the organ would
       hide; of the pixels with a return.
    2. Of a rim round the image: where something lies behind the organ's nearest point. A wrong
       organ reaches beyond the true one, and is seen through if something can be seen there.
    3. Where nothing hides the organ.
    """
    seen_mm, organ_mm = _compared(organ, frame)
    image = np.isfinite(organ_mm)
    both = image & np.isfinite(seen_mm)
    if not both.any():
        return 0.0, 0.0, 0.0
    in_sight = (seen_mm[both] > organ_mm[both] - behind_mm).sum() / image.sum()
    rim = _within(_RIM, image) & ~image
    rim_share = (seen_mm[rim] > organ_mm[image].min()).sum() / max(rim.sum(), 1)
    through = (seen_mm[both] > organ_mm[both] + behind_mm).mean()
    return float(through), float(rim_share), float(in_sight)


def explained(organ: Mesh, look: Look) -> float:
    """Log-likelihood of a look's depth image with the organ there, but for a constant and a factor:
    each pixel that shows its surface speaks for it, each that shows what it would hide against."""
    assert isinstance(look.seen, DepthFrame)
    seen_mm, organ_mm = _compared(organ, look.seen)
    off_mm, behind_mm = seen_mm - organ_mm, _behind_mm(look)  # NaN where one shows nothing
    on, through = np.abs(off_mm) < _ON * behind_mm, off_mm > behind_mm
    return float(on.sum() - _AGAINST * through.sum())


def _compared(organ: Mesh, frame: DepthFrame) -> tuple[np.ndarray, np.ndarray]:
    """Depths that were seen, and the organ's, in a smaller image."""
    every = max(1, round(frame.intrinsics.width / _WIDTH))
    seen_mm = frame.depth_mm[::every, ::every]
    full = frame.intrinsics
    scaled = (number / every for number in (full.fx, full.fy, full.cx, full.cy))
    reduced = Intrinsics(*seen_mm.shape[::-1], *scaled)
    return seen_mm, render_depth(organ.vertices_mm, organ.faces, reduced).depth_mm


def cloud_shares(
    organ: Mesh, cloud: SensorCloud, behind_mm: float = _THROUGH_MM
) -> tuple[float, float]:
    """Of a cloud, whose camera is at its origin: the share of the points in the organ's image that
    lie behind its surface, and the share of the image without points."""
    nearest_mm = organ.vertices_mm[:, 2].min()
    if nearest_mm <= _PIXEL_MM:  # round the camera
        return 0.0, 1.0
    focal = nearest_mm / _PIXEL_MM
    outline = focal * organ.vertices_mm[:, :2] / organ.vertices_mm[:, 2:]
    low, high = np.floor(outline.min(0)), np.ceil(outline.max(0))
    width, height = (int(n) for n in high - low + 1)
    if max(width, height) > _MAX_PIXELS:
        return 0.0, 1.0
    camera = Intrinsics(width, height, focal, focal, *(-low).tolist())
    organ_mm = render_depth(organ.vertices_mm, organ.faces, camera).depth_mm
    points_mm = cloud.points_mm[:: len(cloud.points_mm) // _MAX_POINTS + 1]
    points_mm = points_mm[points_mm[:, 2] > 0].astype(np.float64)
    column, row = np.rint(focal * points_mm[:, :2] / points_mm[:, 2:] - low).astype(int).T
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, z_mm = column[within], row[within], points_mm[within, 2]
    surface_mm = organ_mm[row, column]
    on = np.isfinite(surface_mm)
    if not on.any():
        return 0.0, 1.0
    through = float((z_mm[on] > surface_mm[on] + behind_mm).mean())
    filled = np.zeros(organ_mm.shape, bool)
    filled[row, column] = True
    image = np.isfinite(organ_mm)
    spacing = np.sqrt(image.sum() / on.sum())  # pixels between neighbouring points
    near = _within(max(_SEEN_WITHIN_MM / _PIXEL_MM, 2 * spacing), filled)
    return through, float(1 - near[image].mean())


def _within(reach: float, filled: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels with a filled one within so many pixels' distance, by sums along rows (SciPy's
    distance transform is slow to import, which would delay the first verdict)."""
    pad, (height, width) = int(min(reach, np.hypot(*filled.shape))), filled.shape
    sums = np.cumsum(np.pad(filled, ((pad, pad), (pad + 1, pad))), axis=1)
    near = np.zeros(filled.shape, bool)
    for down in range(-pad, pad + 1):
        across = min(int(np.sqrt(reach**2 - down**2)), pad)
        rows = sums[pad + down : pad + down + height]
        ends = rows[:, pad + across + 1 :][:, :width]
        near |= ends > rows[:, pad - across : pad - across + width]
    return near
