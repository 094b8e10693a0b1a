"""What else lies before the camera: instruments, fat, a drape's edge, background.

All of it acts on the depth image of the organ (camera frame, mm), so that the cloud still comes
from ``sense.cloud`` alone. Occluders are taken to be segmented out: where they hide the organ there
is no return, and they give none of their own. Background is what a segmentation has left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rotation_onto, triangles_of
from tumortrack.core.types import DepthFrame, Mesh
from tumortrack.sense.camera import deproject
from tumortrack.sense.render import render_depth
from tumortrack_lab.twin.equilibrium import Rod

SHAFT_CLEARANCE_MM = 3.0  # between a shaft's tip and the organ, towards the camera
SHAFT_RISE_DEGREES = 30.0  # of a shaft above the image plane
LARGEST_SHARE = 0.9  # that can be hidden
_TOUCH_MM = 1.0  # a shaft keeps this far from all of the organ that is seen
_RING_MM = 4.0  # a rod is cut into rings: a triangle that reaches behind the camera is not drawn
_LAST_DEPTH_MM = 5.0  # a rod that comes straight at the camera ends here
_LUMP_SHARE = 2 / 3  # of the background; the rest is an instrument's tip
_PARTS = (1 / 3, 2 / 3, 1.0)  # of the share: up to which the shaft, the lump, the drape hide
_PULLED_BACK_MM = 140.0  # a shaft that hides nothing yet
_LUMP_MM = (1.0, 100.0)  # longest half axis
_DRAPE_MM = (-160.0, 160.0)  # place of its edge along its way, from the organ's middle
_DRAPE_ABOVE_MM = 3.0  # before the organ's nearest point
_HALVINGS = 14

Occluder = Callable[[float], Mesh]  # a mesh (camera frame) that hides more the higher its number
Flat = Float64[np.ndarray, " 2"]
Generator = np.random.Generator


def rod_mesh(rod: Rod) -> Mesh:
    """The rod's closed surface."""
    import trimesh

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
    angle, rise = rng.uniform(0, 2 * np.pi), np.deg2rad(SHAFT_RISE_DEGREES)
    axis = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), -np.sin(rise)])
    tip = target - [0, 0, SHAFT_CLEARANCE_MM]
    while Rod(tip, axis, radius_mm).distance(points[::7])[0].min() < _TOUCH_MM:
        tip[2] -= 1.0
    return Rod(tip, axis, radius_mm)


def add_background(
    frame: DepthFrame, share: float, support_mm: float, rng: Generator
) -> tuple[DepthFrame, float]:
    """The frame with background in pixels without return: ``share`` of all returns, to the nearest
    pixel; and what share that is. ``support_mm``: depth of the support plane. Two thirds are the
    top of a lump of fat that lies on the support beside the organ, one third is the end of an
    instrument there; a crop by depth keeps both. Raises InputError: no room beside the organ."""
    organ = _returns(frame)
    count = round(share / (1 - share) * organ)
    lump = round(_LUMP_SHARE * count)
    out = _filled(frame, _lumps(frame, support_mm, rng), lump, support_mm, nearest=True)
    out = _filled(out, _tips(out, support_mm, rng), count - lump, support_mm, nearest=False)
    got = _returns(out) - organ
    return out, got / (got + organ)


def _lumps(frame: DepthFrame, support_mm: float, rng: Generator) -> Iterator[Mesh]:
    """Half ellipsoids on the support beside the organ, ever larger."""
    import trimesh

    ball = trimesh.creation.icosphere(3, 1.0)
    for size_mm in (14.0, 18.0, 24.0, 32.0):
        for angle in rng.uniform(0, 2 * np.pi, 8):
            beside = _beside(frame, angle, support_mm, 0.5 * size_mm)
            half = size_mm * np.array([1.0, 1.0, 0.6])
            yield Mesh(ball.vertices * half + np.array([*beside, support_mm]), ball.faces)


def _tips(frame: DepthFrame, support_mm: float, rng: Generator) -> Iterator[Mesh]:
    """Rods that stand beside the organ and lean outwards, ever thicker."""
    height_mm = support_mm - float(np.nanmedian(frame.depth_mm))
    for radius_mm in (4.0, 6.0, 9.0, 13.0):
        for angle in rng.uniform(0, 2 * np.pi, 8):
            depth = support_mm - rng.uniform(0.3, 0.9) * max(height_mm, 5.0)
            tip = np.array([*_beside(frame, angle, depth, radius_mm), depth])
            lean = np.array([0.7 * np.cos(angle), 0.7 * np.sin(angle), -1.0])
            yield rod_mesh(Rod(tip, lean / np.linalg.norm(lean), radius_mm))


def _filled(
    frame: DepthFrame, solids: Iterator[Mesh], count: int, support_mm: float, nearest: bool
) -> DepthFrame:
    """The frame with the nearest or the farthest ``count`` pixels of the first solid that shows so
    many where nothing else is seen, and nearer than the support."""
    for solid in solids:
        seen = render_depth(solid.vertices_mm, solid.faces, frame.intrinsics).depth_mm
        with np.errstate(invalid="ignore"):
            free = np.flatnonzero((seen < support_mm) & np.isnan(frame.depth_mm))
        if len(free) >= count:
            depths = seen.ravel()[free]
            order = np.argsort(depths if nearest else -depths, kind="stable")
            chosen = free[order[:count]]
            depth_mm = frame.depth_mm.copy()
            depth_mm.flat[chosen] = seen.flat[chosen]
            return replace(frame, depth_mm=depth_mm)
    raise InputError(
        "the image has no room for background beside the organ; the organ must be wholly in "
        "view. Raise the camera or choose a wider one."
    )


def _beside(frame: DepthFrame, angle: float, depth_mm: float, gap_mm: float) -> Flat:
    """(x, y) at a depth, in a direction of the image, ``gap_mm`` beyond the organ's edge there."""
    camera = frame.intrinsics
    row, column = np.nonzero(np.isfinite(frame.depth_mm))
    middle = np.array([np.median(column), np.median(row)])
    offset = np.stack([column, row], axis=1) - middle
    direction = _unit(angle)
    along = offset @ direction
    across = np.abs(offset @ np.array([-direction[1], direction[0]]))
    edge_px = along[across < 10].max(initial=0.0)
    pixel = middle + edge_px * direction - np.array([camera.cx, camera.cy])
    focal = np.array([camera.fx, camera.fy])
    return pixel * depth_mm / focal + gap_mm * direction


def hide_share(
    frame: DepthFrame, share: float, shaft_radius_mm: float, rng: Generator
) -> DepthFrame:
    """The frame with that share of its returns hidden by a shaft, a lump of fat and the edge of a
    drape, one after another. With the same generator they keep their places and directions from
    one share to another; only how far they reach differs. Raises InputError: a share outside
    0..0.9, or a frame without returns."""
    if not 0 <= share <= LARGEST_SHARE:
        raise InputError(f"a share of {share:g} cannot be hidden; allowed: 0 to {LARGEST_SHARE:g}.")
    total, out = _returns(frame), frame
    if not total:
        raise InputError("the depth image has no return, so nothing of it can be hidden.")
    occluders = (_shaft(frame, shaft_radius_mm, rng), _lump(frame, rng), _drape(frame, rng))
    for occluder, part in zip(occluders, _PARTS, strict=True):
        out = _reached(out, occluder, total - round(part * share * total))
    return out


def _reached(frame: DepthFrame, occluder: Occluder, fewest: int) -> DepthFrame:
    """The frame with as much hidden as leaves ``fewest`` returns or more, by bisection."""
    farthest = _without(frame, occluder(1.0))
    if _returns(farthest) >= fewest:
        return farthest
    best, low, high = frame, 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        tried = _without(frame, occluder(middle))
        if _returns(tried) >= fewest:
            best, low = tried, middle
        else:
            high = middle
    return best


def _shaft(frame: DepthFrame, radius_mm: float, rng: Generator) -> Occluder:
    """The shaft of the views, drawn back along itself."""
    rod = shaft_over(frame, radius_mm, rng)

    back = _PULLED_BACK_MM
    return lambda number: rod_mesh(replace(rod, tip_mm=rod.tip_mm + (1 - number) * back * rod.axis))


def _lump(frame: DepthFrame, rng: Generator) -> Occluder:
    """A lump of fat with hills that grows over the organ from a place on its outline."""
    import trimesh

    ball = trimesh.creation.icosphere(4, 1.0)
    directions, phases = rng.standard_normal((5, 3)), rng.uniform(0, 2 * np.pi, 5)
    hills = 0.09 * np.sin(2.5 * ball.vertices @ directions.T + phases).sum(1)
    unit = ball.vertices * (1 + hills)[:, None]
    x, y = _unit(rng.uniform(0, 2 * np.pi))
    spin = np.array([[x, -y], [y, x]])
    points = deproject(frame).astype(float)
    outwards = points[:, :2] @ _unit(rng.uniform(0, 2 * np.pi))
    place = points[int(np.argmax(outwards))]

    def solid(number: float) -> Mesh:
        size = _LUMP_MM[0] + number * (_LUMP_MM[1] - _LUMP_MM[0])
        vertices = unit * np.array([size, 0.7 * size, 0.4 * size])
        vertices[:, :2] = vertices[:, :2] @ spin.T
        middle = np.array([place[0], place[1], place[2] - 0.25 * size])
        return Mesh(vertices + middle, ball.faces)

    return solid


def _drape(frame: DepthFrame, rng: Generator) -> Occluder:
    """A creased sheet before the organ whose wavy edge comes in from any side."""
    points = deproject(frame).astype(float)
    middle, nearest_mm = points.mean(0), float(points[:, 2].min())
    way = _unit(rng.uniform(0, 2 * np.pi))
    across = np.array([-way[1], way[0]])
    waves, phases = rng.uniform(0.02, 0.12, 4), rng.uniform(0, 2 * np.pi, 4)
    steps = np.linspace(0, 1, 41)
    side, back = np.meshgrid(400 * (steps - 0.5), 500 * steps**2, indexing="ij")
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).reshape(-1, 1)
    faces = np.concatenate([corner + [0, 41, 1], corner + [1, 41, 42]])
    edge = 4.0 * np.sin(side[..., None] * waves + phases).sum(-1)

    def solid(number: float) -> Mesh:
        along = _DRAPE_MM[0] + number * (_DRAPE_MM[1] - _DRAPE_MM[0]) + edge - back
        flat = middle[:2] + along[..., None] * way + side[..., None] * across
        creases = 1.0 + np.sin(0.15 * along + phases[0]) * np.sin(0.2 * side + phases[1])
        depth = nearest_mm - _DRAPE_ABOVE_MM - creases
        vertices = np.concatenate([flat, depth[..., None]], axis=-1).reshape(-1, 3)
        towards_camera = triangles_of(vertices, faces)[1][:, 2].sum() < 0
        return Mesh(vertices, faces if towards_camera else faces[:, ::-1])

    return solid


def _unit(angle: float) -> Flat:
    return np.array([np.cos(angle), np.sin(angle)])
