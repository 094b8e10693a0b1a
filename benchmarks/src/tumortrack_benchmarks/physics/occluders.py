"""Other objects before the camera: instruments, fat, background.

All act on the depth image of the organ (camera frame, mm), so that the cloud still comes from
``core.cloud``. Occluders count as segmented out: where they hide the organ there is no return.
Background is what a segmentation has left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh
from jaxtyping import Float64

from tumortrack.core.camera import deproject
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rotation_onto
from tumortrack.core.render import render_depth
from tumortrack.core.types import DepthFrame, Mesh
from tumortrack_benchmarks.physics.equilibrium import Rod

_CLEARANCE_MM = 3.0  # between a shaft's tip and the organ, towards the camera
_RISE_DEGREES = 30.0  # of a shaft above the image plane
_TOUCH_MM = 1.0  # a shaft keeps this far from all of the organ that is seen
_RING_MM = 4.0  # between a rod's rings: triangles that reach behind the camera are not drawn
_LAST_DEPTH_MM = 5.0  # a rod that comes straight at the camera ends here

Flat = Float64[np.ndarray, " 2"]
Generator = np.random.Generator


def rod_mesh(rod: Rod) -> Mesh:
    """The rod's closed surface."""
    tip, axis, length = rod.tip_mm, rod.axis, rod.length_mm
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
    out, before = _without(frame, rod_mesh(rod)), _returns(frame)
    return out, (before - _returns(out)) / max(before, 1)


def _without(frame: DepthFrame, mesh: Mesh) -> DepthFrame:
    """The frame without what a solid hides."""
    with np.errstate(invalid="ignore"):
        solid = render_depth(mesh.vertices_mm, mesh.faces, frame.intrinsics)
        hidden = solid.depth_mm < frame.depth_mm
    return replace(frame, depth_mm=np.where(hidden, np.float32(np.nan), frame.depth_mm))


def _returns(frame: DepthFrame) -> int:
    return int(np.isfinite(frame.depth_mm).sum())


def shaft_over(frame: DepthFrame, radius_mm: float, rng: Generator) -> Rod:
    """A shaft that comes from any side, 30 degrees above the image plane, and ends 3 mm above a
    random place in the middle tenth of what is seen; higher where it would else touch the organ
    on its way."""
    row, column = np.nonzero(np.isfinite(frame.depth_mm))
    offset = row - np.median(row), column - np.median(column)
    inner = np.argsort(np.hypot(*offset), kind="stable")
    points = deproject(frame).astype(np.float64)
    target = points[inner[rng.integers(max(len(points) // 10, 1))]]
    angle, rise = rng.uniform(0, 2 * np.pi), np.deg2rad(_RISE_DEGREES)
    axis = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), -np.sin(rise)])
    tip = target - [0, 0, _CLEARANCE_MM]
    while Rod(tip, axis, radius_mm).distance(points[::7])[0].min() < _TOUCH_MM:
        tip[2] -= 1.0
    return Rod(tip, axis, radius_mm)


def add_background(
    frame: DepthFrame, share: float, support_mm: float, rng: Generator
) -> tuple[DepthFrame, float]:
    """The frame with background in pixels without return: ``share`` of all returns, to the nearest
    pixel; and what share that is. ``support_mm``: depth of the support plane. It is the top of a
    lump of fat that lies on the support beside the organ: of half ellipsoids, ever larger, the
    first that has so many free pixels. Raises InputError: no room beside the organ."""
    organ = _returns(frame)
    count = round(share / (1 - share) * organ)
    for size_mm in (14.0, 18.0, 24.0, 32.0):
        for angle in rng.uniform(0, 2 * np.pi, 8):
            place = np.array([*_beside(frame, angle, support_mm, 0.5 * size_mm), support_mm])
            lump = ellipsoid(place, size_mm * np.array([1.0, 1.0, 0.6]))
            depth = render_depth(lump.vertices_mm, lump.faces, frame.intrinsics).depth_mm
            with np.errstate(invalid="ignore"):
                free = np.flatnonzero((depth < support_mm) & np.isnan(frame.depth_mm))
            if len(free) >= count:
                chosen = free[np.argsort(depth.ravel()[free], kind="stable")[:count]]
                depth_mm = frame.depth_mm.copy()
                depth_mm.flat[chosen] = depth.flat[chosen]
                return replace(frame, depth_mm=depth_mm), count / (count + organ)
    raise InputError(
        "the image has no room for background beside the organ; the organ must be wholly in "
        "view. Raise the camera or choose a wider one."
    )


def ellipsoid(middle_mm: np.ndarray, half_mm: np.ndarray) -> Mesh:
    ball = trimesh.creation.icosphere(3)
    return Mesh(ball.vertices * half_mm + middle_mm, ball.faces)


def _beside(frame: DepthFrame, angle: float, depth_mm: float, gap_mm: float) -> Flat:
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
