"""What cameras see where the organ would be: through it, at its surface, beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32

from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.render import render_depth
from tumortrack.core.types import DepthFrame, Intrinsics, Mesh, SensorCloud, View

_ON = 1 / 3  # of what is behind: on the surface
_AGAINST = 3.0  # pixels that a pixel that is seen through outweighs
_WIDTH = 212  # pixels of the depth image in which the organ is compared
_THROUGH_MM = 6.0  # points so far behind the estimated surface are behind the organ, or, of a
_NOISES = 3.0  # noisy camera, so many standard deviations of it
_RIM = 2  # pixels round the organ (some 3 mm)
_PIXEL_MM = 1.5  # of the image in which a cloud is compared
_MAX_PIXELS = 1024  # along a side
_MAX_POINTS = 20_000  # of a cloud: enough for the shares, where all of 400,000 would delay a frame
_STEP_MM = 3.0  # by which a flap may lie off, before it is seen past its rim
_SEEN_WITHIN_MM = 6.0  # of a point, or twice the points' usual distance


class Sight(NamedTuple):
    """Shares of the organ's image, of all views the worst: ``through`` which something is seen;
    ``by_depth``: in depth images; ``rim``: of its rim in which the surroundings are seen; not
    hidden (``in_sight``; None: no depth image); without points of a cloud (``unseen``; None: there
    is no cloud)."""

    through: float = 0.0
    by_depth: float = 0.0
    rim: float = 0.0
    in_sight: float | None = None
    unseen: float | None = None


def sight_of(estimate: Estimate, views: Sequence[View]) -> Sight:
    images, clouds, cut = [], [], estimate.report.cut is not None
    pairs = _organ_before_cameras(estimate, views)
    for (organ, seen), view in zip(pairs, views, strict=False):  # a network takes the first alone
        if isinstance(seen, DepthFrame):
            images.append(seen_through(organ, seen, _behind_mm(view), cut))
        elif len(seen.points_mm):  # touches alone hide nothing, and are no scan
            clouds.append(cloud_shares(organ, seen, _behind_mm(view), cut))
    by_depth = max((share for share, _, _ in images), default=0.0)
    return Sight(
        through=max(by_depth, *(share for share, _ in clouds), 0.0),
        by_depth=by_depth,
        rim=min((share for _, share, _ in images), default=0.0) if not clouds else 0.0,
        in_sight=images[0][2] if images else None,
        unseen=max(share for _, share in clouds) if clouds else None,
    )


def _organ_before_cameras(
    estimate: Estimate, views: Sequence[View]
) -> list[tuple[Mesh, DepthFrame | SensorCloud]]:
    """For each camera, the organ in its (corrected) frame, and all that it saw."""
    organ, corrected = estimate.organ_mesh, estimate.report.views
    pairs = [(organ, views[0].full_view)]
    if corrected is not None:
        for view, pose in zip(views[1:], corrected.camera_from_view[1:], strict=True):
            view_from_camera = np.linalg.inv(np.array(pose))
            vertices_mm = transform_points(view_from_camera, organ.vertices_mm)
            pairs.append((organ.with_vertices(vertices_mm), view.full_view))
    return pairs


def _behind_mm(view: View) -> float:
    """What lies so far behind the estimated surface is behind the organ, and no noise of it."""
    measured_mm = 0.0 if view.cloud.noise is None else view.cloud.noise.measured_mm
    return float(np.hypot(_THROUGH_MM, _NOISES * measured_mm))


def seen_through(
    organ: Mesh, frame: DepthFrame, behind_mm: float = _THROUGH_MM, cut: bool = False
) -> tuple[float, float, float]:
    """Three shares of the estimated organ's image, all 0 if no pixel has a return there.

    1. Where the camera sees something behind the surface, such as a table, which the organ would
       hide; of the pixels with a return.
    2. Of a rim round the image: where something lies behind the organ's nearest point. A wrong
       organ reaches beyond the true one, and is seen through if something can be seen there.
    3. Where nothing hides the organ.

    ``cut``: beside a flap's rim the organ has steps in depth, and the flap may lie a little off:
    there the deeper surface counts.
    """
    seen_mm, organ_mm = _compared(organ, frame)
    image = np.isfinite(organ_mm)
    both = image & np.isfinite(seen_mm)
    if not both.any():
        return 0.0, 0.0, 0.0
    in_sight = (seen_mm[both] > organ_mm[both] - behind_mm).sum() / image.sum()
    rim = _within(_RIM, image) & ~image
    rim_share = (seen_mm[rim] > organ_mm[image].min()).sum() / max(rim.sum(), 1)
    if cut:
        organ_mm = _deepest(organ_mm, _STEP_MM * _pixels_per_mm(frame, organ_mm))
    through = (seen_mm[both] > organ_mm[both] + behind_mm).mean()
    return float(through), float(rim_share), float(in_sight)


def log_likelihood(organ: Mesh, view: View) -> float:
    """Log-likelihood of a view's depth image with the organ there, but for a constant and a factor:
    each pixel that shows its surface speaks for it, each that shows what it would hide against."""
    assert isinstance(view.full_view, DepthFrame)
    seen_mm, organ_mm = _compared(organ, view.full_view)
    off_mm, behind_mm = seen_mm - organ_mm, _behind_mm(view)  # NaN where one shows nothing
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
    organ: Mesh, cloud: SensorCloud, behind_mm: float = _THROUGH_MM, cut: bool = False
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
    image = np.isfinite(organ_mm)
    deepest_mm = _deepest(organ_mm, _STEP_MM / _PIXEL_MM) if cut else organ_mm
    surface_mm = deepest_mm[row, column]
    on = image[row, column]
    if not on.any():
        return 0.0, 1.0
    through = float((z_mm[on] > surface_mm[on] + behind_mm).mean())
    filled = np.zeros(organ_mm.shape, bool)
    filled[row, column] = True
    spacing = np.sqrt(image.sum() / on.sum())  # pixels between neighbouring points
    near = _within(max(_SEEN_WITHIN_MM / _PIXEL_MM, 2 * spacing), filled)
    return through, float(1 - near[image].mean())


def _pixels_per_mm(frame: DepthFrame, organ_mm: Float32[np.ndarray, "h w"]) -> float:
    """Of the smaller image, at the organ."""
    full, middle_mm = frame.intrinsics, float(np.median(organ_mm[np.isfinite(organ_mm)]))
    return full.fx * organ_mm.shape[1] / full.width / middle_mm


def _deepest(organ_mm: Float32[np.ndarray, "h w"], radius_px: float) -> Float32[np.ndarray, "h w"]:
    """The organ's deepest surface so near to each pixel."""
    from scipy.ndimage import maximum_filter

    shown = np.where(np.isfinite(organ_mm), organ_mm, -np.inf)
    return np.asarray(maximum_filter(shown, 1 + 2 * round(radius_px)), np.float32)


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
