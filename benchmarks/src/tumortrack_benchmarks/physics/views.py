"""A camera's view of a state: the organ among fat, drape, hands and instruments, with the noise of
``noise``; and the organ's points as the live path finds them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from tumortrack.core.camera import d405
from tumortrack.core.cloud import CloudConfig
from tumortrack.core.geometry import rigid, rotation_onto, transform_points, unit
from tumortrack.core.render import render_depth
from tumortrack.core.types import DepthFrame, Intrinsics, Mesh, SensorCloud
from tumortrack.segmentation import Hints, RegionConfig, organ_points
from tumortrack_benchmarks.physics.equilibrium import Rod
from tumortrack_benchmarks.physics.families import Deformed, log_uniform
from tumortrack_benchmarks.physics.noise import StereoCamera, StereoConfig
from tumortrack_benchmarks.physics.occluders import ellipsoid, rod_mesh

_SIZE_PX = (424, 240)
_NEAR_MM, _FAR_MM = (85.0, 230.0), 420.0  # of the organ's nearest point; nothing is seen beyond
_MOST_TILT = 60.0  # degrees from straight above
_DEEPER_MM = 15.0  # behind a slit's film: seen through a gap between coarse walls

Generator = np.random.Generator
Transform = Float64[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class View:
    """A measured frame, and data about it. ``hidden_share``: the share of the organ's visible
    pixels that hand or instruments hide; ``visible_share``: of the whole organ's pixels, in or
    outside the image, the share with a return."""

    frame: DepthFrame
    camera_from_bench: Transform
    about: dict[str, Any]


def render_view(
    state: Deformed, organ: Mesh, hidden: float, rng: Generator, beside: tuple[Mesh, ...] = ()
) -> View:
    """One random view of the state's true surface (bench frame) and of other objects. ``hidden``:
    the share of the organ's pixels that a hand or instruments hide."""
    camera = d405(*_SIZE_PX)
    to_camera, about = _camera_pose(organ, rng)
    alone = _organ_depth(state, organ, to_camera, camera)
    below = _render(_ground_mesh(state.rim_mm, rng), to_camera, camera)
    others = [_render(mesh, to_camera, camera) for mesh in (*beside, *_beside(organ, rng))]
    scene = np.fmin.reduce([alone, below, *others])
    own = np.isfinite(alone) & (alone <= scene)
    if hidden > 0 and own.any():
        at, share, about["occluder"] = _covering(alone, own, camera, hidden, rng)
        scene = np.fmin(scene, _render(at(share), np.eye(4), camera))
    visible = own & (alone <= scene)
    scene[scene > _FAR_MM] = np.nan
    sensor = StereoConfig(subpixel_px=rng.uniform(0.03, 0.12), gloss_degrees=rng.uniform(2.0, 7.0))
    frame = StereoCamera(camera, sensor, rng).see(scene.astype(np.float32))
    wide = Intrinsics(
        *(2 * _SIZE_PX[0], 2 * _SIZE_PX[1]), camera.fx, camera.fy,
        camera.cx + _SIZE_PX[0] / 2, camera.cy + _SIZE_PX[1] / 2,
    )  # fmt: skip
    every = max(int(np.isfinite(_render(organ, to_camera, wide)).sum()), 1)
    about |= {
        "hidden_wanted": hidden,
        "hidden_share": 1 - float(visible.sum() / max(own.sum(), 1)),
        "visible_share": float((visible & np.isfinite(frame.depth_mm)).sum() / every),
        "subpixel_px": sensor.subpixel_px,
        "gloss_degrees": sensor.gloss_degrees,
    }
    return View(frame, to_camera, about)


def organ_cloud(view: View, organ: Mesh, rng: Generator) -> tuple[SensorCloud, float]:
    """The organ's points as tracking finds them, and the share of them that lie on it. Raises
    NoEstimate: too few are found."""
    rest = organ.vertices_mm - organ.vertices_mm.mean(0)
    extents = np.ptp(rest @ np.linalg.svd(rest, full_matrices=False)[2].T, axis=0)
    crop = CloudConfig(near_mm=75.0, far_mm=330.0, n_points=2000)
    size = (0.7 * float(extents.min()), 1.25 * float(extents.max()))
    region = RegionConfig(crop=crop, organ_mm=size)
    cloud = organ_points(view.frame, region, Hints(), rng).cloud
    there = cKDTree(transform_points(view.camera_from_bench, organ.vertices_mm))
    return cloud, float((there.query(cloud.points_mm)[0] < 4.0).mean())


def _camera_pose(organ: Mesh, rng: Generator) -> tuple[Transform, dict[str, Any]]:
    """From a random direction above, turned at random about its axis, the organ near the image's
    middle."""
    tilt = min(abs(rng.normal(0, 25.0)), _MOST_TILT)
    turn, roll = rng.uniform(0, 2 * np.pi, 2)
    near, lean = log_uniform(rng, *_NEAR_MM), np.deg2rad(tilt)
    back = np.array([np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn), np.cos(lean)])
    spin = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    rotation = spin @ rotation_onto(-back, np.array([0.0, 0.0, 1.0]))
    there = organ.vertices_mm @ rotation.T
    pose = rigid(rotation, np.array([*-there[:, :2].mean(0), near - there[:, 2].min()]))
    pose[:2, 3] += rng.uniform(-0.08, 0.08, 2) * near
    about = {"tilt_degrees": tilt, "nearest_mm": near, "roll_degrees": float(np.rad2deg(roll))}
    return pose, about


def _render(mesh: Mesh, to_camera: Transform, camera: Intrinsics) -> np.ndarray:
    """True depths of a mesh (bench frame), NaN where it is not seen."""
    there = transform_points(to_camera, mesh.vertices_mm)
    return render_depth(there, mesh.faces, camera).depth_mm.astype(float)


def _organ_depth(
    state: Deformed, organ: Mesh, to_camera: Transform, camera: Intrinsics
) -> np.ndarray:
    """Of a slit organ: with the slit's walls instead of the triangles that span it."""
    film = _render(organ, to_camera, camera)
    if state.wound is None:
        return film
    rest = state.organ.anatomy.organ.vertices_mm
    before, now = (_edges(points[organ.faces]) for points in (rest, organ.vertices_mm))
    skin = Mesh(organ.vertices_mm, organ.faces[(now < 1.8 * before + 1.0).all(1)])
    walls = Mesh(state.nodes_mm, state.wound.walls)
    depth = np.fmin(_render(skin, to_camera, camera), _render(walls, to_camera, camera))
    depth = np.maximum(depth, film)  # the walls of a coarse mesh may stand out of the skin
    depth[~(depth < film + _DEEPER_MM)] = np.nan
    return depth


def _edges(corners: np.ndarray) -> np.ndarray:
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


def _ground_mesh(rim_mm: float, rng: Generator) -> Mesh:
    """The uneven ground round the organ, as high as its bed's rim."""
    ticks = np.arange(-320.0, 321.0, 8.0)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    height = np.full(x.shape, rim_mm)
    for _ in range(6):
        wave, phase = rng.normal(0, 1 / 25.0, 2), rng.uniform(0, 2 * np.pi)
        height += rng.uniform(0, 1.2) * np.cos(wave[0] * x + wave[1] * y + phase)
    n = len(ticks)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    return Mesh(np.stack([x, y, height], -1).reshape(-1, 3), faces)


def _beside(organ: Mesh, rng: Generator) -> list[Mesh]:
    """None to two gauzes or instruments that lie about the organ."""
    things = []
    low, high = organ.box_mm
    for _ in range(rng.integers(3)):
        angle = rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        reach = float(np.abs(way * (high - low) / 2).sum()) + rng.uniform(15.0, 60.0)
        place = (low + high) / 2 + reach * way
        place[2] = low[2] + rng.uniform(0.2, 0.6) * (high[2] - low[2])
        if rng.uniform() < 0.5:
            half = rng.uniform([8.0, 8.0, 4.0], [25.0, 25.0, 14.0])
            things.append(ellipsoid(place, half))
        else:
            axis = unit(np.cross(way, [0, 0, 1.0]) + 0.4 * way + rng.normal(0, 0.2, 3))
            things.append(rod_mesh(Rod(place - 60 * axis, axis, rng.uniform(2.5, 6.0), 160.0)))
    return things


def _covering(
    organ: np.ndarray, own: np.ndarray, camera: Intrinsics, hidden: float, rng: Generator
) -> tuple[Callable[[float], Mesh], float, str]:
    """A hand or instruments that come in from a side (camera frame), as a function of how far; how
    far they hide the share ``hidden`` of the visible organ; and which of them."""
    kind, angle = str(rng.choice(["hand", "instruments"])), rng.uniform(0, 2 * np.pi)
    back = np.array([np.cos(angle), np.sin(angle), 0.0])  # where they come from
    side = np.array([-back[1], back[0], 0.0])
    shape = (_hand_mesh if kind == "hand" else _instruments)(back, side, rng)
    row, column = np.nonzero(own)
    middle = float(organ[own].min()) - rng.uniform(5.0, 25.0)
    aim = np.array([column.mean() - camera.cx, row.mean() - camera.cy]) / camera.fx * middle
    size = float(np.hypot(np.ptp(column), np.ptp(row))) / camera.fx * middle

    def at(share: float) -> Mesh:
        place = np.array([*aim, middle]) + (1.2 - 3.0 * share) * size * back
        return Mesh(shape.vertices_mm + place, shape.faces)

    low, high = 0.0, 1.0
    for _ in range(12):
        share = (low + high) / 2
        with np.errstate(invalid="ignore"):
            covered = float((_render(at(share), np.eye(4), camera)[own] < organ[own]).mean())
        low, high = (share, high) if covered < hidden else (low, share)
    return at, high, kind


def _hand_mesh(back: np.ndarray, side: np.ndarray, rng: Generator) -> Mesh:
    """Four fingers, a palm and the arm behind them."""
    rods, rise = [], np.array([0.0, 0.0, -0.25])
    for n, length in enumerate((66.0, 76.0, 72.0, 55.0)):
        axis = unit(back + (1.5 - n) * rng.uniform(0.0, 0.12) * side + rise)
        tip = (n - 1.5) * 20.0 * side + (76.0 - length) * back
        rods.append(Rod(tip, axis, rng.uniform(7.5, 10.0), 110.0))
    palm = 75.0 * unit(back + rise)
    rods += [Rod(palm + n * 16.0 * side, unit(back + rise), 14.0) for n in (-2, -1, 0, 1, 2)]
    return _joined(rods)


def _instruments(back: np.ndarray, side: np.ndarray, rng: Generator) -> Mesh:
    """One to three shafts, and a blade that follows."""
    rods, rise = [], np.array([0.0, 0.0, -0.3])
    for n in range(rng.integers(1, 4)):
        axis = unit(back + rng.normal(0, 0.15) * side + rise)
        tip = rng.uniform(-30, 30) * side + 12.0 * n * back
        rods.append(Rod(tip, axis, rng.uniform(3.0, 6.0), 300.0))
    wide = rng.uniform(10.0, 35.0)
    edge = [Rod(n * side + 30 * back, unit(back + rise), 3.0) for n in np.arange(-wide, wide, 4.0)]
    return _joined(rods + edge)


def _joined(rods: list[Rod]) -> Mesh:
    """Of rods in local coordinates: ``rod_mesh`` ends what reaches behind a camera at z = 0."""
    away = np.array([0.0, 0.0, 1000.0])
    meshes = [rod_mesh(replace(rod, tip_mm=rod.tip_mm + away)) for rod in rods]
    starts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    vertices = np.concatenate([mesh.vertices_mm - away for mesh in meshes])
    return Mesh(vertices, np.concatenate(faces))
