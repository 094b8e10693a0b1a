"""What a colour camera in each depth camera's place sees of a sequence: mottled, wet tissue with
vessels, under a lamp that moves.

It is painted onto the organ, so it moves and stretches along; all of it comes from the truth. What
lies before or beside the organ is shaded by its measured depth alone. Looks are assumptions; there
are no shadows, no smoke and no blood.
"""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from tumortrack.core.geometry import transform_points, triangles_of
from tumortrack.core.store import write_atomically, write_json
from tumortrack.core.types import DepthFrame
from tumortrack_lab.world.films import Film
from tumortrack_lab.world.noise import points_of

_TISSUE, _VESSEL, _BESIDE = np.array([[168.0, 82, 70], [84, 28, 40], [190, 165, 115]])
_MOTTLES = ((30.0, 0.12), (5.0, 0.07))  # wavelength in mm, share of the brightness
_VEINS = ((30.0, 0.16), (11.0, 0.2))  # the same, and width as a share of the wavelength / 2 pi
_BARE = 0.2  # share of sequences whose organ has no texture, as phantoms have none
_FILM, _SHINE = 0.08, 90.0  # how uneven the wet surface is, and how sharp its highlights are
_BRIGHT_MM, _BEFORE_MM, _NOISE = 170.0, 6.0, 3.0  # lamp; what covers the organ; grey levels

Field = Callable[[np.ndarray], np.ndarray]
Texture = tuple[Field, ...]  # mottle, veins and how the wet film tilts (x, y, z), over the CT


def paint(film: Film) -> None:
    """Write ``colour_0/`` and so on: a JPEG a frame, named as its depth image; colour.json says how
    strong the texture is. The same sequence, the same pictures."""
    from PIL import Image

    rng = np.random.default_rng(list(film.folder.name.encode()))
    texture = _texture(rng)
    strength = float(rng.choice([0.0, rng.uniform(0.4, 1.0)], p=[_BARE, 1 - _BARE]))
    way, period_s = rng.normal(0, 60.0, (2, 3)) * [1, 1, 0.3], rng.uniform(3.0, 9.0)
    poses = np.linalg.inv(film.first_from_camera(as_it_is=True))
    for n in range(len(poses)):
        (film.folder / f"colour_{n}").mkdir(exist_ok=True)
    for number, time_s in enumerate(film.seconds):
        phase = 2 * np.pi * time_s / period_s
        lamp_mm = (way[0] * np.cos(phase) + way[1] * np.sin(phase))[None]  # about the first camera
        for n, (frame, pose) in enumerate(zip(film.looks(number), poses, strict=True)):
            organ = film.truth(number).organ
            there = transform_points(pose, organ.vertices_mm)
            lamp = transform_points(pose, lamp_mm)[0]
            rest = film.rest.organ
            seen = _picture(there, rest.vertices_mm, rest.faces, frame, lamp, texture, strength)
            noisy = np.clip(seen + rng.normal(0, _NOISE, seen.shape), 0, 255).astype(np.uint8)
            stream = io.BytesIO()
            Image.fromarray(noisy).save(stream, "JPEG", quality=92, subsampling=0)
            name = f"colour_{n}/{film.stamps_ns[number]}.jpg"
            write_atomically(film.folder / name, stream.getvalue())
    write_json(film.folder / "colour.json", {"texture": strength, "lamp_period_s": period_s})


def _picture(
    there_mm: np.ndarray, rest_mm: np.ndarray, faces: np.ndarray, frame: DepthFrame,
    lamp_mm: np.ndarray, texture: Texture, strength: float,
) -> Float64[np.ndarray, "h w 3"]:  # fmt: skip
    """The organ (camera frame) with its texture, and what lies before and beside it."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    rays = points_of(np.ones(frame.depth_mm.shape), frame.intrinsics).reshape(-1, 3)
    scene = EmbreeScene()
    _mesh = TriangleMesh(scene, there_mm[faces].astype(np.float32))  # the scene needs it alive
    start, way = np.zeros_like(rays, np.float32), rays.astype(np.float32)
    hit = scene.run(start, way, output=1)
    depth = np.nan_to_num(frame.depth_mm, nan=np.inf).ravel().astype(float)
    own = np.flatnonzero((hit["primID"] >= 0) & (hit["tfar"] < depth + _BEFORE_MM))
    u, v = hit["u"][own], hit["v"][own]
    weights = np.stack([1 - u - v, u, v], axis=1)[:, :, None]
    corners = faces[hit["primID"][own]]
    rest, place = ((weights * points[corners]).sum(1) for points in (rest_mm, there_mm))
    normals = np.zeros_like(there_mm)
    np.add.at(normals, faces, triangles_of(there_mm, faces)[1][:, None])
    mottle, veins, *slopes = texture
    normal = _unit((weights * _unit(normals)[corners]).sum(1))
    to_lamp, to_camera = _unit(lamp_mm - place), _unit(-place)
    lit = (_BRIGHT_MM / np.linalg.norm(lamp_mm - place, axis=1)) ** 2
    skin = _TISSUE * (1 + strength * mottle(rest))[:, None]
    skin += strength * veins(rest)[:, None] * (_VESSEL - skin)
    wet = _unit(normal + _FILM * np.stack([slope(rest) for slope in slopes], axis=1))
    shine = np.clip((wet * _unit(to_lamp + to_camera)).sum(1), 0, 1) ** _SHINE
    shade = 0.25 + 0.75 * np.clip((normal * to_lamp).sum(1), 0, 1)
    out = np.where(np.isfinite(depth), _BRIGHT_MM / depth, 0.4)[:, None] * _BESIDE * 0.8
    out[own] = (shade[:, None] * skin + 230 * shine[:, None]) * lit[:, None]
    return np.clip(out, 0, 255).reshape(*frame.depth_mm.shape, 3)


def _texture(rng: np.random.Generator) -> Texture:
    mottles = [(_waves(mm, rng), share) for mm, share in _MOTTLES]
    veins = [(_waves(mm, rng), width) for mm, width in _VEINS]
    return (
        lambda x: sum(share * field(x) for field, share in mottles),
        lambda x: np.maximum.reduce([np.exp(-((field(x) / width) ** 2)) for field, width in veins]),
        *(_waves(6.0, rng) for _ in range(3)),
    )


def _waves(length_mm: float, rng: np.random.Generator) -> Field:
    """A smooth random field of variance 1."""
    ways = _unit(rng.normal(size=(24, 3)))
    ways *= 2 * np.pi / length_mm * rng.uniform(0.7, 1.3, (24, 1))
    phases = rng.uniform(0, 2 * np.pi, 24)
    return lambda x: np.cos(x @ ways.T + phases).sum(1) / np.sqrt(12)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
