"""Scenes of ``region_objects`` in colour: tissue with mottles and highlights, drapes, gloves and
steel under a lamp that is never white; and clicks as a user makes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from region_objects import BACKGROUND, FAT, HAND, ORGAN, SHAFT, Scene

Pixel = tuple[int, int]

# sRGB. Looks are assumptions; the first of each is the usual one.
COLOURS = {
    ORGAN: ((168, 82, 70), (140, 60, 58), (185, 105, 92)),
    FAT: ((222, 188, 112), (214, 164, 128), (230, 205, 160)),
    HAND: ((236, 236, 232), (70, 105, 165), (222, 168, 142)),  # gloves, bare skin
    BACKGROUND: ((62, 108, 102), (50, 90, 140), (150, 150, 148)),
    SHAFT: ((150, 152, 156),),
}
BRIGHT_MM = 170.0


@dataclass(frozen=True)
class Light:
    """``mm``: the lamp's place before the camera. ``gain``: of red, green and blue. ``noise``: of a
    pixel, grey levels. ``exposure``: 1: tissue at 170 mm is as bright as its colour."""

    mm: tuple[float, float, float] = (30.0, -20.0, 0.0)
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise: float = 4.0
    exposure: float = 1.0


def random_light(rng: np.random.Generator) -> Light:
    x, y = rng.normal(0, 40, 2)
    red, blue = np.exp(rng.normal(0, 0.12, 2))
    return Light(
        (x, y, rng.uniform(-40, 10)),
        (red, 1.0, blue),
        rng.uniform(3, 8),
        rng.uniform(0.7, 1.2),
    )


def random_colours(rng: np.random.Generator) -> dict[int, np.ndarray]:
    """One of the colours of each material, and somewhat off that."""
    return {
        kind: np.array(some[rng.integers(len(some))]) * np.exp(rng.normal(0, 0.06, 3))
        for kind, some in COLOURS.items()
    }


def painted(
    scene: Scene, colours: dict[int, np.ndarray], light: Light, rng: np.random.Generator
) -> np.ndarray:
    """What a camera in the depth camera's place sees: (h, w, 3), uint8. The table and what has no
    depth are painted too."""
    kinds, camera = scene.kinds, scene.clean.intrinsics
    depth_mm = np.nan_to_num(scene.clean.depth_mm, nan=600.0)
    v, u = np.mgrid[: camera.height, : camera.width]
    points = np.stack(
        [(u - camera.cx) / camera.fx * depth_mm, (v - camera.cy) / camera.fy * depth_mm, depth_mm],
        axis=-1,
    )
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normal = _unit(normal) * np.where(normal[..., 2:] > 0, -1, 1)
    albedo = np.zeros_like(points)
    for kind, colour in colours.items():
        mottle = np.exp(
            sum(share * _waves(points, mm, rng) for mm, share in ((25, 0.1), (5, 0.06)))
        )
        hue = np.exp(0.03 * np.stack([_waves(points, 15, rng) for _ in range(3)], -1))
        own = (colour / 255) ** 2.2 * mottle[..., None] ** (2.0 if kind != SHAFT else 0) * hue
        if kind == ORGAN:  # vessels
            thin = np.exp(-((_waves(points, 25, rng) / 0.07) ** 2))[..., None]
            own = own + 0.5 * thin * ((np.array([95, 35, 48]) / 255) ** 2.2 - own)
        albedo[kinds == kind] = own[kinds == kind]
    to_lamp = np.array(light.mm) - points
    lit = (BRIGHT_MM / np.linalg.norm(to_lamp, axis=-1, keepdims=True)) ** 2
    to_lamp, to_camera = _unit(to_lamp), _unit(-points)
    shade = 0.2 + 0.8 * np.clip((normal * to_lamp).sum(-1, keepdims=True), 0, 1)
    film = 0.1 * np.stack([_waves(points, 6, rng) for _ in range(3)], -1)
    half = _unit(to_lamp + to_camera)
    shine = np.clip((_unit(normal + film) * half).sum(-1, keepdims=True), 0, 1) ** 60
    wet = np.isin(kinds, (ORGAN, FAT, SHAFT))[..., None]
    linear = light.exposure * lit * (albedo * shade + 0.5 * wet * shine) * np.array(light.gain)
    grey = 255 * np.clip(linear, 0, 1) ** (1 / 2.2) + rng.normal(0, light.noise, points.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def clicks_on(scene: Scene, organ: bool, count: int, rng: np.random.Generator) -> list[Pixel]:
    """Places well inside the organ, or of each other thing in turn, that have a depth, far from
    those before."""
    measured = np.isfinite(scene.frame.depth_mm)
    kinds = (ORGAN,) if organ else (FAT, HAND, BACKGROUND, SHAFT)
    inside = {
        kind: distance_transform_edt(scene.kinds == kind) * measured
        for kind in kinds
        if (scene.kinds == kind).sum() > 400
    }
    chosen: list[Pixel] = []
    for n in range(count):
        depth = list(inside.values())[n % len(inside)]
        rows, columns = np.nonzero(depth > min(6, 0.6 * depth.max()))
        if chosen:  # the farthest of some
            some = rng.integers(len(rows), size=12)
            rows, columns = rows[some], columns[some]
            away = [np.hypot(rows - r, columns - c) for r, c in chosen]
            pick = int(np.min(away, axis=0).argmax())
        else:
            pick = int(rng.integers(len(rows)))
        chosen.append((int(rows[pick]), int(columns[pick])))
    return chosen


def _waves(points: np.ndarray, length_mm: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth random field of variance 1."""
    ways = _unit(rng.normal(size=(8, 3))) * 2 * np.pi / length_mm
    ways *= rng.uniform(0.7, 1.3, (8, 1))
    phases = rng.uniform(0, 2 * np.pi, 8).astype(np.float32)
    return np.cos(points.astype(np.float32) @ ways.T.astype(np.float32) + phases).sum(-1) / 2


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
