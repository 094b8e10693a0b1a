"""Scenes as a camera over an operating field sees them: an organ on a table or sunk into a bed,
a drape, shafts, a hand; with the truth of every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tumortrack.core.camera import d405
from tumortrack.core.geometry import rigid, rotation_onto, transform_points
from tumortrack.core.render import render_depth
from tumortrack.core.types import DepthFrame, Intrinsics, Mesh
from tumortrack.simulation.noise import D405_NOISE, NoiseConfig, add_noise

BASELINE_MM = 18.0  # of a D405
BACKGROUND, ORGAN, SHAFT, HAND, FAT = range(5)


@dataclass(frozen=True)
class Props:
    """How hard a scene is.

    distance_mm: camera to the organ's top. tilt_degrees: of the table. waves_mm: height of the
    drape's waves. bed: the organ lies half sunk in something soft that rises around it. cavity: it
    lies in a hole, below, level with or above what surrounds the hole. fat: some lies against the
    organ, flush with it. up: which way of the organ points up, in its own frame; None: one of its
    two broad sides, by chance.
    """

    distance_mm: tuple[float, float] = (110.0, 200.0)
    tilt_degrees: float = 15.0
    waves_mm: float = 0.0
    shafts: int = 0
    hand: bool = False
    bed: bool = False
    cavity: bool = False
    fat: bool = False
    up: tuple[float, float, float] | None = None


EASY = Props()
DRAPED = Props(tilt_degrees=30.0, waves_mm=3.0, distance_mm=(100.0, 300.0))
TOOLS = Props(tilt_degrees=30.0, waves_mm=3.0, shafts=3)
HANDS = Props(tilt_degrees=30.0, waves_mm=3.0, shafts=1, hand=True)
SUNK = Props(tilt_degrees=30.0, waves_mm=3.0, shafts=2, bed=True)
CAVITY = Props(tilt_degrees=15.0, waves_mm=2.0, shafts=1, cavity=True)
DIFFICULTIES = {
    "table": EASY,
    "uneven drape, 100-300 mm": DRAPED,
    "shafts": TOOLS,
    "hand": HANDS,
    "sunk into a bed": SUNK,
    "in a cavity": CAVITY,
}


@dataclass(frozen=True, eq=False)
class Scene:
    """``frame``: as seen, with noise. ``what``: of every pixel, which object is the nearest; an
    organ's pixel that flew over 3 mm is BACKGROUND. ``kinds``: the same without noise.
    ``camera_from_organ``: its pose."""

    frame: DepthFrame
    clean: DepthFrame
    what: np.ndarray
    camera_from_organ: np.ndarray
    kinds: np.ndarray


def make_scene(
    organ: Mesh,
    props: Props,
    rng: np.random.Generator,
    camera: Intrinsics | None = None,
    noise: NoiseConfig = D405_NOISE,
) -> Scene:
    camera = camera or d405(424, 240)
    table_from_organ, size_mm = _laid_down(organ, props, rng)
    sunk_mm = size_mm[2] * rng.uniform(0.3, 0.5) if props.bed else 0.0
    table_from_organ[2, 3] -= sunk_mm
    top_mm = np.array([0.0, 0.0, size_mm[2] - sunk_mm])
    camera_from_table = _looking_at(top_mm, props, rng)
    ground = _Ground(props, sunk_mm, size_mm, rng)
    things = [
        (BACKGROUND, ground.surface()),
        (ORGAN, organ.with_vertices(transform_points(table_from_organ, organ.vertices_mm))),
    ]
    if props.fat:
        things.append((FAT, _fat(things[1][1], rng)))
    if props.shafts:
        count = rng.integers(1, props.shafts + 1)
        things += [(SHAFT, _shaft(size_mm, top_mm[2], rng)) for _ in range(count)]
    if props.hand:
        things.append((HAND, _hand(size_mm, top_mm[2], rng)))
    depth_mm = np.full((camera.height, camera.width), np.nan, np.float32)
    what = np.full(depth_mm.shape, BACKGROUND, np.uint8)
    for kind, mesh in things:
        placed = transform_points(camera_from_table, mesh.vertices_mm)
        thing_mm = render_depth(placed, mesh.faces, camera).depth_mm
        nearer = (thing_mm < depth_mm) | (np.isfinite(thing_mm) & np.isnan(depth_mm))
        depth_mm[nearer], what[nearer] = thing_mm[nearer], kind
    clean = DepthFrame(depth_mm, camera, 5)
    shaded = depth_mm.copy()
    shaded[stereo_shadow(clean)] = np.nan
    frame = add_noise(DepthFrame(shaded, camera, 5), noise, rng)
    flown = (what == ORGAN) & ~(np.abs(frame.depth_mm - depth_mm) < 3)
    kinds = what.copy()
    what[flown] = BACKGROUND
    return Scene(frame, clean, what, camera_from_table @ table_from_organ, kinds)


def stereo_shadow(frame: DepthFrame) -> np.ndarray:
    """Pixels that the left imager sees and the right one does not: no match, no depth. A nearer
    thing k pixels to the right hides a pixel if its disparity is larger by k."""
    disparity = frame.intrinsics.fx * BASELINE_MM / np.nan_to_num(frame.depth_mm, nan=1e6)
    hidden = np.zeros(disparity.shape, bool)
    for k in range(1, 40):
        hidden[:, :-k] |= disparity[:, k:] - disparity[:, :-k] > k + 0.5
    return hidden


def _laid_down(
    organ: Mesh, props: Props, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """``table_from_organ`` (table: z up, its surface at 0) of an organ lying on a broad side, and
    its size as it lies."""
    centred = organ.vertices_mm - organ.box_mm.mean(0)
    axes = np.linalg.svd(centred[:: max(len(centred) // 2000, 1)], full_matrices=False)[2]
    axes[2] = np.cross(axes[0], axes[1])
    roll = Rotation.from_euler("x", rng.choice([0, 180]) + rng.uniform(-25, 25), degrees=True)
    if props.up is not None:
        axes = rotation_onto(np.array(props.up), np.array([0.0, 0.0, 1.0]))
        roll = Rotation.identity()
    turn = Rotation.from_euler("z", rng.uniform(0, 360), degrees=True)
    tip = Rotation.from_euler("y", rng.uniform(-15, 15), degrees=True)
    rotation = (turn * tip * roll).as_matrix() @ axes
    lying = centred @ rotation.T
    shift = -lying.mean(0)
    shift[2] = -lying[:, 2].min()
    return rigid(rotation, shift - rotation @ organ.box_mm.mean(0)), np.ptp(lying, axis=0)


def _looking_at(top_mm: np.ndarray, props: Props, rng: np.random.Generator) -> np.ndarray:
    """``camera_from_table`` of a camera that looks at about the organ's top."""
    tilt, around = np.radians(rng.uniform(0, props.tilt_degrees)), rng.uniform(0, 2 * np.pi)
    up = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), -np.cos(tilt)])
    spin = Rotation.from_euler("z", rng.uniform(0, 360), degrees=True).as_matrix()
    rotation = rotation_onto(np.array([0.0, 0.0, 1.0]), up) @ spin
    at = np.array([*rng.uniform(-12, 12, 2), rng.uniform(*props.distance_mm)])
    return rigid(rotation, at - rotation @ top_mm)


class _Ground:
    """The background as a height over the table: waves, a bed that rises around the organ, or a
    hole around it."""

    def __init__(
        self, props: Props, sunk_mm: float, size_mm: np.ndarray, rng: np.random.Generator
    ) -> None:
        self.waves_mm, self.size_mm = props.waves_mm, size_mm
        self.along = rng.normal(size=(5, 2))
        self.along /= np.linalg.norm(self.along, axis=1, keepdims=True)
        self.along *= 2 * np.pi / rng.uniform(50, 150, (5, 1))
        self.phase = rng.uniform(0, 2 * np.pi, 5)
        self.rise_mm = rng.uniform(0, 6) if sunk_mm else 0.0
        self.hole_mm = rng.uniform(0.6, 1.3) * size_mm[2] if props.cavity else 0.0
        self.around_mm = rng.uniform(3, 15, 2)

    def surface(self) -> Mesh:
        side = np.arange(-450.0, 451.0, 4.0)
        x, y = np.meshgrid(side, side)
        wave = np.cos(
            x[..., None] * self.along[:, 0] + y[..., None] * self.along[:, 1] + self.phase
        )
        height = self.waves_mm * wave.sum(-1) / 2.5
        # Soft tissue bulges a little where the organ was pressed in.
        away = np.hypot(x / (self.size_mm[0] / 2 + 8), y / (self.size_mm[1] / 2 + 8))
        height += self.rise_mm * np.exp(-(((away - 1) / 0.3) ** 2))
        if self.hole_mm:
            wide, tall = self.size_mm[:2] / 2 + self.around_mm
            height = np.where(np.hypot(x / wide, y / tall) > 1, height + self.hole_mm, 0.0)
        n = len(side)
        a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
        faces = np.concatenate(
            [np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)]
        )
        return Mesh(np.stack([x.ravel(), y.ravel(), height.ravel()], 1), faces)


def _capsule(start: ArrayLike, end: ArrayLike, radius_mm: float) -> trimesh.Trimesh:
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    shape = trimesh.creation.capsule(height=length, radius=radius_mm, count=(16, 16))
    way = rigid(rotation_onto(np.array([0.0, 0.0, 1.0]), (end - start) / length), (start + end) / 2)
    shape.apply_transform(way)
    return shape


def _shaft(size_mm: np.ndarray, top_mm: float, rng: np.random.Generator) -> Mesh:
    """A rod from outside the picture to a tip that touches the organ or hovers over it."""
    radius = rng.uniform(1.5, 6.0)
    tip = np.array([*(rng.uniform(-0.35, 0.35, 2) * size_mm[:2]), 0.0])
    inner = np.sqrt(max(1 - np.sum((tip[:2] / (size_mm[:2] / 2)) ** 2), 0.0))
    tip[2] = top_mm * (0.4 + 0.6 * inner) + radius + rng.choice([0.0, rng.uniform(3, 30)])
    around, rise = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(8, 50))
    towards = [np.cos(around) * np.cos(rise), np.sin(around) * np.cos(rise), np.sin(rise)]
    rod = _capsule(tip, tip + 300 * np.array(towards), radius)
    return Mesh(rod.vertices, rod.faces)


def _fat(organ: Mesh, rng: np.random.Generator) -> Mesh:
    """A layer against a third to a half of the organ's outline that goes on at its height, without
    a crease, and ends 15 to 40 mm farther out. In the table's frame."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    side = np.arange(-120.0, 121.0)  # mm, a cell each
    far = 10_000.0  # from so far above all rays are parallel
    above = Intrinsics(len(side), len(side), far, far, 120.0, 120.0)
    placed = organ.vertices_mm * [1, -1, -1] + [0, 0, far]
    organ_mm = far - np.nan_to_num(render_depth(placed, organ.faces, above).depth_mm, nan=far)
    x, y = np.meshgrid(side, -side)
    level = rng.uniform(0.5, 0.85) * organ_mm.max()
    away = distance_transform_edt(organ_mm < level)
    turn = np.arctan2(y, x) - rng.uniform(0, 2 * np.pi)
    turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    wide = rng.uniform(15, 40) + 5 * np.cos(3 * turn)
    here = (turn < rng.uniform(1.0, 1.6)) & (away < wide) & (np.hypot(x, y) > 5)
    lumps = gaussian_filter(rng.normal(size=x.shape), 5.0)
    plateau = np.where(away > 0, level + lumps / lumps.std() * 0.5, organ_mm)
    height = gaussian_filter(np.maximum(organ_mm, plateau), 5.0)
    n = len(side)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    return Mesh(
        np.stack([x.ravel(), y.ravel(), height.ravel()], 1), faces[here.ravel()[faces].all(1)]
    )


def _hand(size_mm: np.ndarray, top_mm: float, rng: np.random.Generator) -> Mesh:
    """Palm, fingers and forearm that come in from a side; the fingertips lie on the organ's edge,
    on its flank or beside it."""
    around = rng.uniform(0, 2 * np.pi)
    out = np.array([np.cos(around), np.sin(around), 0.0])
    aside = np.array([-out[1], out[0], 0.0])
    reach = 0.5 * float(np.hypot(*(out[:2] * size_mm[:2])))  # to about the organ's edge
    height = rng.uniform(0.5, 1.1) * top_mm + 7
    edge = out * reach * rng.uniform(0.6, 1.2) + np.array([0, 0, height])
    knuckles = edge + out * 55 + np.array([0, 0, rng.uniform(0, 25)])
    parts = []
    for k in range(4):
        sideways = aside * (k - 1.5) * rng.uniform(15, 20)
        tip = edge + sideways + out * rng.uniform(-12, 12)
        bend = (tip + knuckles + sideways) / 2 + np.array([0, 0, rng.uniform(0, 12)])
        parts += [_capsule(tip, bend, 7.5), _capsule(bend, knuckles + sideways, 8.5)]
    palm = trimesh.creation.icosphere(3, 1.0)
    palm.apply_scale([45, 42, 15])
    turned = np.stack([out, aside, [0, 0, 1]], 1)
    palm.apply_transform(rigid(turned, knuckles + out * 35))
    arm = _capsule(knuckles + out * 60, knuckles + out * 300 + np.array([0, 0, 40]), 28)
    whole = trimesh.util.concatenate([*parts, palm, arm])
    return Mesh(whole.vertices, whole.faces)


def working_truth(scene: Scene, shape: tuple[int, int]) -> np.ndarray:
    """``what`` in the pixels of a working picture of this shape."""
    step = int(np.ceil(scene.what.shape[1] / shape[1]))
    return scene.what[step // 2 :: step, step // 2 :: step]


def precision_recall(scene: Scene, taken: np.ndarray) -> tuple[float, float]:
    """Of the pixels taken for the organ, the share that is; of the organ's, the share found."""
    truth = working_truth(scene, taken.shape) == ORGAN
    predicted = taken == 0
    both = np.count_nonzero(truth & predicted)
    return both / max(np.count_nonzero(predicted), 1), both / max(np.count_nonzero(truth), 1)
