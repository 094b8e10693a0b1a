"""The base that the organ lies on as in its CT, with beads whose places are known.

The bench is the twin's: the patient's direction that faces the camera is up, the organ's long axis
lies along x, its lowest point at z = 0. A cradle round its underside, open upwards, keeps it from
rolling. Beads lie in cones of 45 degrees, which centre them, on posts beside the organ.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from jaxtyping import Float, Float64

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import (
    DIRECTIONS_LPS,
    Direction,
    rigid,
    rotation_onto,
    transform_points,
)
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.meshes import mesh_of
from tumortrack.report.renderer import ParallelView
from tumortrack.sense.render import Visibility
from tumortrack_experiment.kit import stands
from tumortrack_experiment.kit.solids import box, cone, height_field, rounded_plate, written
from tumortrack_experiment.kit.stands import PLATE_MM, Sockets
from tumortrack_experiment.kit.values import PrintedPart
from tumortrack_experiment.kit_file import LEAST_BEADS

PLATE_THICK_MM = 5.0
_GRID_MM = 1.0  # of the cradle
_FILLET_MM = 1.5
_CRADLE_WALL_MM = 4.0
_STEADY_MM = 8.0  # the organ's centre of mass lies so far inside of what bears it
_LIP_MM = 0.6  # of a bead's cone beyond the circle that the bead touches
_CLEAR_MM = 7.0  # between a post's foot and the organ, whose sides come out when it is pressed
_TRIES = 30_000
_MIRROR_MM = 10.0  # a mirrored arrangement fits no better: fifty times a bead's error
_SLOPE = np.sqrt(0.5)  # of the cones: 45 degrees


class BaseConfig(Config, frozen=True, kw_only=True):
    """Beads, and the camera that must see them: ``camera_mm`` from the organ's top, up to so many
    degrees off the vertical. ``localisation_mm``: the rms error of a bead's middle in 3-D, for the
    expected target errors. ``gap_mm``: no two pairs of beads are equally far apart to within it."""

    states: tuple[str, ...] = ("D1", "D2", "D3", "P1")
    bead_mm: float = 6.0
    beads: int = 7
    camera_mm: float = 200.0
    tilt_deg: float = 30.0
    localisation_mm: float = 0.2
    gap_mm: float = 2.0

    def __post_init__(self) -> None:
        self.check_between("base:", bead_mm=(3, 12), beads=(4, 10), camera_mm=(70, 1000))
        self.check_between("base:", tilt_deg=(0, 45), localisation_mm=(0.01, 2), gap_mm=(0.5, 5))
        stands.check_states(self.states)


@dataclass(frozen=True, eq=False)
class Base:
    """The plate as a part, in the base frame; ``beads_mm``: the beads' middles at rest;
    ``anatomy``: where the organ lies. ``parts``: the plate, then what stands on it."""

    parts: tuple[PrintedPart, ...]
    beads_mm: Float64[np.ndarray, "n 3"]
    base_from_ct: Float64[np.ndarray, "4 4"]
    anatomy: Anatomy
    tre_mm: tuple[float, ...]  # expected at each tumor's middle
    gap_mm: float
    mirror_mm: float
    steady_mm: float
    cradle_mm: float


def base_design(anatomy_ct: Anatomy, up_lps: Direction, config: BaseConfig) -> Base:
    """Lay the organ down, surround it with beads, and make what it lies on. The same case and
    configuration give the same base.

    Raises:
        InputError: no place for so many beads that the camera would see.
    """
    base_from_ct = laid_down(anatomy_ct.organ, up_lps)
    anatomy = Anatomy(
        tuple(p.moved(transform_points(base_from_ct, p.vertices_mm)) for p in anatomy_ct.parts)
    )
    sockets = Sockets.beside(anatomy.organ)
    standing = stands.stands_for(config.states, anatomy, sockets)
    beads = _arranged(anatomy, standing, config)
    cradle, cradle_mm, steady_mm = _cradle(anatomy.organ)
    radius = _post_radius(config.bead_mm)
    feet = np.abs(beads[:, :2]).max(0) + 1.4 * radius + 3
    legs = np.abs(sockets.legs(5.0)).max(0)[[1, 3]] if standing else np.zeros(2)
    organ = np.abs(anatomy.organ.vertices_mm[:, :2]).max(0) + 8
    half = np.ceil(np.max([feet, legs, organ], axis=0))
    solid = rounded_plate((half[0], half[1]), -PLATE_THICK_MM, 0, 8.0) + cradle
    if standing:
        solid += sockets.solid()
        notches = [(x, y) for x in (-12, 12) for y in (-half[1], half[1])]  # for rubber bands
        for x, y in notches:
            solid -= box((x - 3, y - 3, -PLATE_THICK_MM - 1), (x + 3, y + 3, 1))
    for bead in beads:
        solid += _post(bead, config.bead_mm)
    for bead in beads:
        solid -= _seat(bead, config.bead_mm)
    solid -= _marks(beads, half, radius, base_from_ct)
    plate = PrintedPart(
        "base", "carries the organ, the beads and the stands", mesh_of(solid), "base",
        rigid(np.eye(3), np.array([0, 0, PLATE_THICK_MM])),
    )  # fmt: skip
    tilted = [
        stands.wedge(state, (half[0], half[1]), -PLATE_THICK_MM)
        for state in config.states
        if stands.tilt_of(state)
    ]
    middles = np.array([tumor.vertices_mm.mean(0) for tumor in anatomy.tumors]).reshape(-1, 3)
    tre = expected_tre_mm(beads, middles, config.localisation_mm)
    gap, mirror = uniqueness_mm(beads)
    return Base(
        (plate, *standing, *tilted), beads, base_from_ct, anatomy, tuple(tre.tolist()), gap, mirror,
        steady_mm, cradle_mm,
    )  # fmt: skip


def laid_down(organ_ct: Mesh, up_lps: Direction) -> Float64[np.ndarray, "4 4"]:
    """``base_from_ct``: z up, the long axis along x, the box's middle at x = y = 0, its foot at 0,
    as the laboratory's twin lays it down."""
    upright = rotation_onto(np.array(up_lps), np.array([0.0, 0.0, 1.0]))
    flat = (organ_ct.vertices_mm - organ_ct.vertices_mm.mean(0)) @ upright.T
    x, y = np.linalg.eigh(np.cov(flat[:, :2].T))[1][:, 1]
    rotation = np.array([[x, y, 0], [-y, x, 0], [0, 0, 1]]) @ upright
    turned = organ_ct.vertices_mm @ rotation.T
    low, high = turned.min(0), turned.max(0)
    return rigid(rotation, -np.array([*(low + high)[:2] / 2, low[2]]))


def expected_tre_mm(
    beads_mm: Float[np.ndarray, "*k n 3"], targets_mm: Float[np.ndarray, "m 3"], fle_mm: float
) -> Float64[np.ndarray, "*k m"]:
    """The rms error expected at targets after a rigid fit to beads that are localised with an rms
    error ``fle_mm`` in 3-D, equal in all directions (Fitzpatrick, West, Maurer 1998, doi
    10.1109/42.736021, equation 46); of several arrangements at once."""
    middle = beads_mm.mean(-2, keepdims=True)
    _, spread, axes = np.linalg.svd(beads_mm - middle, full_matrices=False)
    n = beads_mm.shape[-2]
    along = (targets_mm - middle) @ np.swapaxes(axes, -1, -2)  # by principal axes
    off_axis = (along**2).sum(-1, keepdims=True) - along**2
    squares = spread**2 / n
    from_axis = squares.sum(-1, keepdims=True) - squares  # of the beads, mean square
    share = (off_axis / from_axis[..., None, :]).sum(-1) / 3
    return np.asarray(fle_mm * np.sqrt((1 + share) / n))


def uniqueness_mm(beads_mm: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """The least difference between two distances of beads, and the rms that is left of a proper
    rigid fit to the mirrored arrangement: twice the beads' deviation along their thinnest axis."""
    first, second = np.triu_indices(len(beads_mm), 1)
    apart = np.sort(np.linalg.norm(beads_mm[first] - beads_mm[second], axis=1))
    return float(np.diff(apart).min()), float(_mirror_mm(beads_mm))


def _mirror_mm(beads_mm: Float[np.ndarray, "*k n 3"]) -> Float64[np.ndarray, "*k"]:
    middle = beads_mm.mean(-2, keepdims=True)
    thin = np.linalg.svd(beads_mm - middle, compute_uv=False)[..., -1]
    return np.asarray(2 * thin / np.sqrt(beads_mm.shape[-2]))


def eyes_mm(organ: Mesh, config: BaseConfig) -> Float64[np.ndarray, "9 3"]:
    """Where the camera may be: above, and tilted to eight sides; base frame."""
    around = np.radians(np.arange(0, 360, 45))
    tilt = np.radians(config.tilt_deg)
    ways = np.stack([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around)], 1)
    ways = np.concatenate([[[0, 0, 1.0]], np.insert(ways, 2, np.cos(tilt), axis=1)])
    return ways * config.camera_mm + [0, 0, organ.box_mm[1, 2]]


def seen_beads(
    occluders: list[Mesh], beads_mm: Float[np.ndarray, "n 3"], eyes: np.ndarray, bead_mm: float
) -> np.ndarray:
    """Which beads (columns) are seen whole from which eyes (rows)."""
    counts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in occluders)])
    vertices = np.concatenate([mesh.vertices_mm for mesh in occluders])
    faces = [mesh.faces + n for mesh, n in zip(occluders, counts, strict=False)]
    visible = Visibility(Mesh(vertices, np.concatenate(faces)))
    around = np.array([[0, 0, 1], [0.9, 0, 0.4], [-0.9, 0, 0.4], [0, 0.9, 0.4], [0, -0.9, 0.4]])
    points = (beads_mm[:, None] + around * bead_mm / 2).reshape(-1, 3)
    return np.array([visible(points, eye).reshape(len(beads_mm), -1).all(1) for eye in eyes])


def _arranged(anatomy: Anatomy, standing: list[PrintedPart], config: BaseConfig) -> np.ndarray:
    """One bead in each of as many sectors. Of many arrangements whose distances differ enough and
    of which every camera sees enough beads in every state, the one with a small target error on a
    small plate."""
    places = _places(anatomy.organ, standing, config)
    sectors = np.array_split(np.arange(len(places)), config.beads)
    if any(len(sector) < 3 for sector in sectors):
        raise InputError(
            f"base: no room for {config.beads} beads of {config.bead_mm:g} mm that a camera at "
            f"{config.camera_mm:g} mm would see. Take fewer beads, or a smaller tilt."
        )
    rng = np.random.default_rng(0)
    chosen = np.stack([sector[rng.integers(len(sector), size=_TRIES)] for sector in sectors], 1)
    drawn = places[chosen]
    first, second = np.triu_indices(config.beads, 1)
    apart = np.sort(np.linalg.norm(drawn[:, first] - drawn[:, second], axis=2), axis=1)
    gap = np.diff(apart, axis=1).min(1)
    good = (gap >= config.gap_mm) & (apart[:, 0] > 4 * config.bead_mm)
    good[good] = _mirror_mm(drawn[good]) >= _MIRROR_MM
    for state in {part.state for part in standing}:
        there = [anatomy.organ, *(part.mesh for part in standing if part.state == state)]
        seen = seen_beads(there, places, eyes_mm(anatomy.organ, config), config.bead_mm)
        good &= np.min([row[chosen].sum(1) for row in seen], axis=0) >= LEAST_BEADS
    if not good.any():
        raise InputError(
            f"base: of {_TRIES} arrangements of {config.beads} beads none has distances that all "
            f"differ by {config.gap_mm:g} mm, with {LEAST_BEADS} in view in every state. Take "
            "another number of beads, fewer states, or a smaller tilt."
        )
    drawn = drawn[good]
    targets = [part.vertices_mm.mean(0) for part in (anatomy.tumors or (anatomy.organ,))]
    tre = expected_tre_mm(drawn, np.array(targets), config.localisation_mm).max(1)
    area = np.abs(drawn[..., :2]).max(1).prod(1)
    return np.asarray(drawn[(tre * area).argmin()])


def _places(organ: Mesh, standing: list[PrintedPart], config: BaseConfig) -> np.ndarray:
    """Where a bead may lie, by angle: in each direction and at each height the nearest place to the
    organ from which every camera sees it beside the organ."""
    from scipy.spatial import cKDTree

    top = organ.box_mm[1, 2]
    angle = np.radians(np.arange(0, 360, 4.0))
    height = np.round(top * np.array([0.15, 0.3, 0.45, 0.6]), 1) + 3
    away = np.arange(20.0, 1.5 * organ.longest_mm, 3.0)
    a, h, d = (axis.ravel() for axis in np.meshgrid(angle, height, away, indexing="ij"))
    places = np.stack([d * np.cos(a), d * np.sin(a), h], 1)
    foot = 1.4 * _post_radius(config.bead_mm)
    free = cKDTree(organ.vertices_mm[:, :2]).query(places[:, :2])[0] > foot + _CLEAR_MM
    if standing:
        free &= np.abs(places[:, 0]) > PLATE_MM / 2 + 4 + foot
    free &= seen_beads([organ], places, eyes_mm(organ, config), config.bead_mm).all(0)
    grid = free.reshape(-1, len(away))
    nearest = np.flatnonzero(grid.any(1)) * len(away) + grid.argmax(1)[grid.any(1)]
    return places[nearest]


def _post_radius(bead_mm: float) -> float:
    return bead_mm / 2 * _SLOPE + _LIP_MM + 2.0


def _post(bead: np.ndarray, bead_mm: float) -> object:
    x, y, z = bead.tolist()
    radius = _post_radius(bead_mm)
    rim = z - bead_mm / 2 * _SLOPE + _LIP_MM
    return cone((x, y, -1), rim + 1, 1.4 * radius, radius)


def _seat(bead: np.ndarray, bead_mm: float) -> object:
    """The cone that holds a ball with its middle there."""
    x, y, z = bead.tolist()
    apex = z - bead_mm / 2 / _SLOPE
    return cone((x, y, apex), bead_mm * 2, 0.0, bead_mm * 2)


def _cradle(organ: Mesh) -> tuple[object, float, float]:
    """What bears the organ's underside, its height, and how far inside it the weight acts. It is
    as low as lets the organ lie steady, and opens upwards everywhere."""
    import trimesh
    from scipy import ndimage
    from scipy.spatial import ConvexHull

    view = ParallelView("below", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    frame = view.frame_around(organ.vertices_mm, 20.0)
    under = view.depth_of(organ, frame, _GRID_MM)
    x, y = frame.pixel_centres(_GRID_MM)
    middle = trimesh.Trimesh(organ.vertices_mm, organ.faces, process=False).center_mass[:2]
    for height in np.arange(4.0, 0.4 * organ.box_mm[1, 2], 2.0):
        bears = under < height
        rows, columns = np.nonzero(bears)
        planes = ConvexHull(np.stack([x[columns], y[rows]], 1)).equations
        steady = -float((planes[:, :2] @ middle + planes[:, 2]).max())
        if steady >= _STEADY_MM:
            break
    away = ndimage.distance_transform_edt(~bears) * _GRID_MM
    wall = height - 2 * np.maximum(away - _CRADLE_WALL_MM, 0)
    top = np.clip(np.minimum(np.minimum(under, height), wall), -1.0, None)
    reach = np.arange(-_FILLET_MM, _FILLET_MM + 0.1, _GRID_MM / 2)[::2]
    sphere = _FILLET_MM**2 - reach[:, None] ** 2 - reach**2
    top = ndimage.grey_opening(
        top, footprint=sphere >= 0, structure=np.sqrt(np.maximum(sphere, 0)) - _FILLET_MM
    )
    return height_field(x, y, top, -2.0), float(height), steady


def _marks(beads: np.ndarray, half: np.ndarray, radius: float, base_from_ct: np.ndarray) -> object:
    """Engraved: a number at each bead, + at the edge to +x, and the patient's directions."""
    solids = []
    for number, (x, y, _) in enumerate(beads.tolist(), 1):
        beside = y - np.copysign(1.4 * radius + 4.5, y)
        solids.append(written(str(number), (x, beside, -0.6), 6.0, 1.0))
    solids.append(written("+", (half[0] - 6, 20, -0.6), 7.0, 1.0))
    for name, direction in DIRECTIONS_LPS.items():
        to = base_from_ct[:2, :3] @ direction
        if np.abs(to).max() > 0.7:  # the four that lie in the plate
            x, y = np.copysign(half - 6, to) * (np.abs(to) == np.abs(to).max())
            solids.append(written(name[0].upper(), (x, y, -0.6), 7.0, 1.0))
    return reduce(lambda a, b: a + b, solids)
