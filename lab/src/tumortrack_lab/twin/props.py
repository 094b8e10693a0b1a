"""What else lies before the camera: an instrument's shaft, the poking rod, background.

All of it acts on the depth image of the organ (camera frame, mm), so that the cloud still comes
from ``sense.cloud`` alone. An instrument is taken to be segmented out: where it hides the organ
there is no return, and its own surface gives none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rotation_onto
from tumortrack.core.types import DepthFrame, Mesh
from tumortrack.sense.camera import deproject_pixels
from tumortrack.sense.render import render_depth

SHAFT_CLEARANCE_MM = 3.0  # between a shaft's tip and the organ, towards the camera
SHAFT_RISE_DEGREES = 30.0  # of a shaft above the image plane
_TOUCH_MM = 1.0  # a shaft keeps this far from all of the organ that is seen
_RING_MM = 4.0  # a rod is cut into rings: a triangle that reaches behind the camera is not drawn
_LAST_DEPTH_MM = 5.0  # a rod that comes straight at the camera ends here
_LUMP_SHARE = 2 / 3  # of the background; the rest is an instrument's tip


@dataclass(frozen=True)
class Rod:
    """A rod with a hemispherical end, camera frame: the tip touches ``tip_mm``, the unit vector
    ``axis`` points away from it along the rod."""

    tip_mm: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius_mm: float
    length_mm: float = 250.0


def rod_mesh(rod: Rod) -> Mesh:
    """The rod's closed surface."""
    import trimesh

    tip, axis = np.array(rod.tip_mm), np.array(rod.axis)
    length = rod.length_mm
    if axis[2] < 0:  # towards the camera's plane
        length = min(length, max((_LAST_DEPTH_MM - tip[2]) / axis[2], 3 * rod.radius_mm))
    angle = np.linspace(0, np.pi / 2, 9)
    cap = rod.radius_mm * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    along = np.linspace(rod.radius_mm, length, int(np.ceil(length / _RING_MM)) + 1)[1:]
    side = np.stack([np.full(len(along), rod.radius_mm), along], axis=1)
    profile = np.concatenate([cap, side, [[0.0, length]]])
    solid = trimesh.creation.revolve(profile, sections=48)
    faces = solid.faces if solid.volume > 0 else solid.faces[:, ::-1]
    upright = rotation_onto(np.array([0.0, 0.0, 1.0]), axis)
    return Mesh(solid.vertices @ upright.T + tip, faces)


def occlude(frame: DepthFrame, rod: Rod) -> tuple[DepthFrame, float]:
    """The frame without what the rod hides, and the share of its returns that were lost."""
    mesh = rod_mesh(rod)
    front = render_depth(mesh.vertices_mm, mesh.faces, frame.intrinsics).depth_mm
    with np.errstate(invalid="ignore"):
        hidden = front < frame.depth_mm
    share = hidden.sum() / max(np.isfinite(frame.depth_mm).sum(), 1)
    depth_mm = np.where(hidden, np.float32(np.nan), frame.depth_mm)
    return DepthFrame(depth_mm, frame.intrinsics, frame.stamp_ns), float(share)


def shaft_over(frame: DepthFrame, radius_mm: float, rng: np.random.Generator) -> Rod:
    """A shaft that comes from any side, 30 degrees above the image plane, and ends 3 mm above a
    random place in the middle tenth of what is seen; higher where it would else touch the organ
    on its way."""
    seen = np.flatnonzero(np.isfinite(frame.depth_mm))
    row, column = np.divmod(seen, frame.intrinsics.width)
    middle = np.median(row), np.median(column)
    inner = np.argsort(np.hypot(row - middle[0], column - middle[1]), kind="stable")
    depth_mm = frame.depth_mm.ravel()[seen].astype(np.float64)
    points = deproject_pixels(seen, depth_mm, frame.intrinsics).astype(np.float64)
    target = points[inner[rng.integers(max(len(seen) // 10, 1))]]
    angle, rise = rng.uniform(0, 2 * np.pi), np.deg2rad(SHAFT_RISE_DEGREES)
    axis = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), -np.sin(rise)])
    tip = target - [0, 0, SHAFT_CLEARANCE_MM]
    while _gap_mm(points[::7], tip, axis, radius_mm) < _TOUCH_MM:
        tip[2] -= 1.0
    (x, y, z), (u, v, w) = tip.tolist(), axis.tolist()
    return Rod((x, y, z), (u, v, w), radius_mm)


def _gap_mm(
    points_mm: Float64[np.ndarray, "n 3"],
    tip_mm: Float64[np.ndarray, " 3"],
    axis: Float64[np.ndarray, " 3"],
    radius_mm: float,
) -> float:
    """Least distance of points to a rod's surface."""
    offset = points_mm - (tip_mm + radius_mm * axis)
    offset -= np.maximum(offset @ axis, 0)[:, None] * axis
    return float(np.linalg.norm(offset, axis=1).min()) - radius_mm


def add_background(
    frame: DepthFrame, share: float, support_mm: float, rng: np.random.Generator
) -> tuple[DepthFrame, float]:
    """The frame with background in pixels without return, and its share of all returns.

    Two thirds are the top of a lump of fat that lies on the support beside the organ, one third
    is the end of an instrument there, which a segmentation has left. Both are nearer than the
    support, so a crop by depth keeps them. What the organ covers stays covered.

    Args:
        share: of all returns, to the nearest pixel.
        support_mm: depth of the support plane.

    Raises:
        InputError: the image has no room beside the organ.
    """
    organ = int(np.isfinite(frame.depth_mm).sum())
    count = round(share / (1 - share) * organ)
    lump = round(_LUMP_SHARE * count)
    with_lump = _lump(frame, lump, support_mm, rng)
    depth_mm = _tip(with_lump, count - lump, support_mm, rng).depth_mm
    got = np.isfinite(depth_mm).sum() - organ
    return DepthFrame(depth_mm, frame.intrinsics, frame.stamp_ns), float(got / (got + organ))


def _lump(frame: DepthFrame, count: int, support_mm: float, rng: np.random.Generator) -> DepthFrame:
    """The highest ``count`` pixels of a half ellipsoid on the support."""
    import trimesh

    ball = trimesh.creation.icosphere(3, 1.0)
    for size_mm in (14.0, 18.0, 24.0, 32.0):
        for angle in rng.uniform(0, 2 * np.pi, 8):
            beside = _beside(frame, angle, support_mm, 0.5 * size_mm)
            half = size_mm * np.array([1.0, 1.0, 0.6])
            vertices = ball.vertices * half + np.array([*beside, support_mm])
            seen = render_depth(vertices, ball.faces, frame.intrinsics).depth_mm
            filled = _fill(frame, seen, count, support_mm, nearest=True)
            if filled is not None:
                return filled
    raise InputError(_NO_ROOM)


def _tip(frame: DepthFrame, count: int, support_mm: float, rng: np.random.Generator) -> DepthFrame:
    """The lowest ``count`` pixels of a rod that stands beside the organ, leaning outwards."""
    height_mm = support_mm - float(np.nanmedian(frame.depth_mm))
    for radius_mm in (4.0, 6.0, 9.0, 13.0):
        for angle in rng.uniform(0, 2 * np.pi, 8):
            depth = support_mm - rng.uniform(0.3, 0.9) * max(height_mm, 5.0)
            beside = _beside(frame, angle, depth, radius_mm)
            lean = np.array([0.7 * np.cos(angle), 0.7 * np.sin(angle), -1.0])
            x, y, z = (lean / np.linalg.norm(lean)).tolist()
            rod = Rod((float(beside[0]), float(beside[1]), float(depth)), (x, y, z), radius_mm)
            mesh = rod_mesh(rod)
            seen = render_depth(mesh.vertices_mm, mesh.faces, frame.intrinsics).depth_mm
            filled = _fill(frame, seen, count, support_mm, nearest=False)
            if filled is not None:
                return filled
    raise InputError(_NO_ROOM)


_NO_ROOM = (
    "the image has no room for background beside the organ; the organ must be wholly in view. "
    "Raise the camera or choose a wider one."
)


def _fill(
    frame: DepthFrame,
    seen: Float32[np.ndarray, "h w"],
    count: int,
    support_mm: float,
    nearest: bool,
) -> DepthFrame | None:
    """``count`` of the free pixels where something nearer than the support is seen; None where
    there are fewer."""
    with np.errstate(invalid="ignore"):
        free = np.flatnonzero((seen < support_mm) & np.isnan(frame.depth_mm))
    if len(free) < count:
        return None
    depths = seen.ravel()[free]
    order = np.argsort(depths if nearest else -depths, kind="stable")
    chosen = free[order[:count]]
    depth_mm = frame.depth_mm.copy()
    depth_mm.flat[chosen] = seen.flat[chosen]
    return DepthFrame(depth_mm, frame.intrinsics, frame.stamp_ns)


def _beside(
    frame: DepthFrame, angle: float, depth_mm: float, gap_mm: float
) -> Float64[np.ndarray, " 2"]:
    """(x, y) at a depth, in a direction of the image, ``gap_mm`` beyond the organ's edge there."""
    camera = frame.intrinsics
    row, column = np.nonzero(np.isfinite(frame.depth_mm))
    middle = np.array([np.median(column), np.median(row)])
    offset = np.stack([column, row], axis=1) - middle
    direction = np.array([np.cos(angle), np.sin(angle)])
    along = offset @ direction
    across = np.abs(offset @ np.array([-direction[1], direction[0]]))
    edge_px = along[across < 10].max(initial=0.0)
    pixel = middle + edge_px * direction - np.array([camera.cx, camera.cy])
    focal = np.array([camera.fx, camera.fy])
    return pixel * depth_mm / focal + gap_mm * direction
