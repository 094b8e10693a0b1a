"""The base that the organ lies on as in its CT, with beads whose places are known.

The bench is the twin's: the patient's direction that faces the camera is up, the organ's long axis
lies along x, its lowest point at z = 0. A cradle round its underside, open upwards, keeps it from
rolling. Beads lie in cones of 45 degrees, which centre them, on posts beside the organ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import DIRECTIONS_LPS as WAYS
from tumortrack.core.geometry import Direction, rigid, rotation_onto, transform_points
from tumortrack.core.render import Visibility
from tumortrack.core.solids import mesh_of
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.report.renderer import ParallelView
from tumortrack_experiment.kit import stands
from tumortrack_experiment.kit.solids import box, cone, height_field, rounded_plate, written
from tumortrack_experiment.kit.values import PrintedPart
from tumortrack_experiment.kit_file import LEAST_BEADS
from tumortrack_experiment.register.beads import expected_tre_mm

FLE_MM = 0.2  # rms error of a bead's middle in 3-D, for the expected target errors
_THICK_MM = 5.0
_GRID_MM, _FILLET_MM, _RIM_MM = 1.0, 1.5, 4.0  # of the cradle
_STEADY_MM = 8.0  # the organ's centre of mass lies so far inside of what bears it
_LIP_MM, _SLOPE = 0.6, np.sqrt(0.5)  # of a cone beyond the circle of touch; 45 degrees
_FOOT = 1.4  # radii of a post
_CLEAR_MM = 7.0  # between a post and the organ, whose sides come out when it is pressed
_APART_MM = 18.0  # of two beads: of two 11 mm apart a CT showed neither
_LEAN = 0.9  # of a view from the farthest side, by its height
_TRIES = 60_000
_GAP_MM, _LEAST_GAP_MM = 2.0, 1.0  # no two pairs of beads are equally far apart to within it
_MIRROR_MM = 10.0  # so ill fit the mirrored beads: fifty times their error


class BaseConfig(Config, frozen=True, kw_only=True):
    """``bed_mm``: the printer's, X Y; ``camera_mm``: from the organ's top, up to ``tilt_deg`` off
    the vertical."""

    states: tuple[str, ...] = ("D1", "D2", "D3", "P1")
    bead_mm: float = 6.0
    beads: int = 7
    bed_mm: tuple[float, float] = (220.0, 220.0)
    camera_mm: float = 200.0
    tilt_deg: float = 30.0

    def __post_init__(self) -> None:
        self.check_between("base:", bead_mm=(3, 12), beads=(LEAST_BEADS, 10), tilt_deg=(0, 45))
        self.check_between("base:", camera_mm=(70, 1000))
        stands.check_states(self.states)

    @property
    def post_mm(self) -> float:
        """A post's radius above."""
        return float(self.bead_mm / 2 * _SLOPE) + _LIP_MM + 2.0


@dataclass(frozen=True, eq=False)
class Base:
    """The plate and what stands on it, base frame. ``beads_mm``: the beads' middles at rest;
    ``tre_mm``: expected at each tumor's middle; ``gap_mm``, ``mirror_mm``: of ``uniqueness_mm``;
    ``steady_mm``: how far inside the cradle the organ's weight acts."""

    parts: tuple[PrintedPart, ...]
    beads_mm: Float64[np.ndarray, "n 3"]
    base_from_ct: Float64[np.ndarray, "4 4"]
    anatomy: Anatomy
    tre_mm: tuple[float, ...]
    gap_mm: float
    mirror_mm: float
    steady_mm: float


def base_design(anatomy_ct: Anatomy, up_lps: Direction, config: BaseConfig) -> Base:
    """Lay the organ down, surround it with beads, and make what it lies on. The same case and
    configuration give the same base. Raises InputError: no place for the beads."""
    base_from_ct = laid_down(anatomy_ct.organ, up_lps)
    anatomy = anatomy_ct.with_parts(
        p.with_vertices(transform_points(base_from_ct, p.vertices_mm)) for p in anatomy_ct.parts
    )
    sockets = stands.Sockets.beside(anatomy.organ)
    standing = stands.stands_for(config.states, anatomy, sockets)
    beads = _arranged(anatomy, standing, config)
    reach = [np.abs(beads[:, :2]).max(0) + _FOOT * config.post_mm + 3]
    reach += [np.abs(anatomy.organ.vertices_mm[:, :2]).max(0) + 8]
    reach += [np.abs(sockets.legs(6.0)).max(0)[[1, 3]]] if standing else []
    x, y = (float(side) for side in np.ceil(np.max(reach, axis=0)))
    cradle, steady_mm = _cradle(anatomy.organ)
    solid = rounded_plate((x, y), -_THICK_MM, 0, 8.0) + cradle
    if standing:
        solid = sockets.cut_into(solid)
        for at in (-12, 12):  # notches for rubber bands
            for side in (-y, y):
                solid -= box((at - 3, side - 3, -_THICK_MM - 1), (at + 3, side + 3, 1))
    foot, half_ball = _FOOT * config.post_mm, config.bead_mm / 2
    for number, (a, b, c) in enumerate(beads.tolist(), 1):
        rim, apex = c - half_ball * _SLOPE + _LIP_MM, c - half_ball / _SLOPE
        solid += cone((a, b, -1), rim + 1, foot, config.post_mm)
        solid -= cone((a, b, apex), 4 * half_ball, 0.0, 4 * half_ball)
        solid -= written(str(number), (a, b - np.copysign(foot + 5, b), -0.6), 6.0, 1.0)
    solid -= written("+", (x - 6, 20, -0.6), 7.0, 1.0)
    for name, way in WAYS.items():
        to = base_from_ct[:2, :3] @ way
        if np.abs(to).max() > 0.7:  # the four that lie in the plate
            at = np.copysign([x - 6, y - 6], to) * (np.abs(to) == np.abs(to).max())
            solid -= written(name[0].upper(), (*at, -0.6), 7.0, 1.0)
    lifted = rigid(np.eye(3), np.array([0, 0, _THICK_MM]))
    purpose = "carries the organ, the beads and the stands"
    plate = PrintedPart("base", purpose, mesh_of(solid), "base", lifted)
    tilts = [stands.wedge(s, (x, y), -_THICK_MM) for s in config.states if stands.tilt_of(s)]
    tre = expected_tre_mm(beads, _middles(anatomy.tumors), FLE_MM)
    parts = (plate, *standing, *tilts)
    gap, mirror = map(float, uniqueness_mm(beads))
    return Base(parts, beads, base_from_ct, anatomy, tuple(tre.tolist()), gap, mirror, steady_mm)


def laid_down(organ_ct: Mesh, up_lps: Direction) -> Float64[np.ndarray, "4 4"]:
    """``base_from_ct``: z up, the long axis along x, the box's middle at x = y = 0, its foot at 0,
    as the benchmarks' twin lays it down."""
    upright = rotation_onto(np.array(up_lps), np.array([0.0, 0.0, 1.0]))
    flat = (organ_ct.vertices_mm - organ_ct.vertices_mm.mean(0)) @ upright.T
    x, y = np.linalg.eigh(np.cov(flat[:, :2].T))[1][:, 1]
    rotation = np.array([[x, y, 0], [-y, x, 0], [0, 0, 1]]) @ upright
    turned = organ_ct.vertices_mm @ rotation.T
    low, high = turned.min(0), turned.max(0)
    return rigid(rotation, -np.array([*(low + high)[:2] / 2, low[2]]))


def uniqueness_mm(
    beads_mm: Float[np.ndarray, "*k n 3"],
) -> tuple[Float64[np.ndarray, "*k"], Float64[np.ndarray, "*k"]]:
    """The least difference between two distances of beads, and the rms that is left of a proper
    rigid fit to the mirrored arrangement: twice the beads' deviation along their thinnest axis."""
    n = beads_mm.shape[-2]
    first, second = np.triu_indices(n, 1)
    apart = np.linalg.norm(beads_mm[..., first, :] - beads_mm[..., second, :], axis=-1)
    thin = np.linalg.svd(beads_mm - beads_mm.mean(-2, keepdims=True), compute_uv=False)[..., -1]
    gap = np.diff(np.sort(apart), axis=-1).min(-1)
    return np.asarray(gap), np.asarray(2 * thin / np.sqrt(n))


def eyes_mm(organ: Mesh, config: BaseConfig) -> Float64[np.ndarray, "9 3"]:
    """Where the camera may be: above, and tilted to eight sides; base frame."""
    around, tilt = np.radians(np.arange(0, 360, 45)), np.radians(config.tilt_deg)
    ways = [np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt) + 0 * around]
    ways_up = np.concatenate([[[0, 0, 1.0]], np.stack(ways, 1)])
    return ways_up * config.camera_mm + [0, 0, organ.box_mm[1, 2]]


def seen_beads(
    occluders: list[Mesh], beads_mm: Float[np.ndarray, "n 3"], eyes: np.ndarray, bead_mm: float
) -> Bool[np.ndarray, "e n"]:
    """Which beads (columns) are seen whole from which eyes (rows)."""
    counts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in occluders)])
    faces = [mesh.faces + n for mesh, n in zip(occluders, counts, strict=False)]
    vertices = np.concatenate([mesh.vertices_mm for mesh in occluders])
    visible = Visibility(Mesh(vertices, np.concatenate(faces)))
    around = np.array([[0, 0, 1], [0.9, 0, 0.4], [-0.9, 0, 0.4], [0, 0.9, 0.4], [0, -0.9, 0.4]])
    points = (beads_mm[:, None] + around * bead_mm / 2).reshape(-1, 3)
    return np.array([visible(points, eye).reshape(len(beads_mm), -1).all(1) for eye in eyes])


def _arranged(anatomy: Anatomy, standing: list[PrintedPart], config: BaseConfig) -> np.ndarray:
    """One bead in each of as many sectors. Of many arrangements that are unique and of which every
    camera sees enough in every state, the one with a small target error on a small plate."""
    places, eyes = _places(anatomy.organ, standing, config), eyes_mm(anatomy.organ, config)
    sectors = np.array_split(np.arange(len(places)), config.beads)
    good = np.full(_TRIES, len(sectors[-1]) > 2)
    if good.any():
        rng, fewest = np.random.default_rng(0), np.full(_TRIES, config.beads)
        chosen = np.stack([sector[rng.integers(len(sector), size=_TRIES)] for sector in sectors], 1)
        gap, mirror = uniqueness_mm(places[chosen])
        good = (gap >= _LEAST_GAP_MM) & (mirror >= _MIRROR_MM)
        first, second = np.triu_indices(config.beads, 1)
        apart = np.abs(places[chosen[:, first]] - places[chosen[:, second]])
        level = np.hypot(apart[..., 0], apart[..., 1])  # no post stands before another's bead
        good &= (level > _LEAN * apart[..., 2] + 2 * _FOOT * config.post_mm).all(1)
        good &= (np.hypot(level, apart[..., 2]) >= _APART_MM).all(1)
        for state in {part.state for part in standing}:
            there = [anatomy.organ, *(part.mesh for part in standing if part.state == state)]
            for seen in seen_beads(there, places, eyes, config.bead_mm):
                fewest = np.minimum(fewest, seen[chosen].sum(1))
        good &= fewest >= LEAST_BEADS
    if not good.any():
        raise InputError(
            f"base: no arrangement of {config.beads} beads of {config.bead_mm:g} mm has distances "
            f"that all differ by {_LEAST_GAP_MM:g} mm, with {LEAST_BEADS} seen in every state. "
            "Take another number of beads, smaller ones, fewer states, or a larger --bed."
        )
    good &= fewest >= min(LEAST_BEADS + 1, fewest[good].max())  # one to spare, if it can be had
    good &= gap >= min(_GAP_MM, 0.9 * gap[good].max())
    drawn = places[chosen[good]]
    tre = expected_tre_mm(drawn, _middles(anatomy.tumors or (anatomy.organ,)), FLE_MM).max(1)
    area = np.abs(drawn[..., :2]).max(1).prod(1)
    return np.asarray(drawn[(tre * area).argmin()])


def _middles(parts: tuple[Mesh, ...]) -> np.ndarray:
    return np.array([part.vertices_mm.mean(0) for part in parts])


def _places(organ: Mesh, standing: list[PrintedPart], config: BaseConfig) -> np.ndarray:
    """Where a bead may lie, by angle: in each direction and at each height the nearest place to the
    organ from which every camera sees it beside the organ."""
    from scipy.spatial import cKDTree

    angle, away = np.radians(np.arange(0, 360, 4.0)), np.arange(20.0, 1.5 * organ.longest_mm, 3.0)
    height = np.round(max(organ.box_mm[1, 2], 50.0) * np.array([0.15, 0.3, 0.45, 0.6]), 1) + 3
    a, h, d = (axis.ravel() for axis in np.meshgrid(angle, height, away, indexing="ij"))
    places, foot = np.stack([d * np.cos(a), d * np.sin(a), h], 1), _FOOT * config.post_mm
    free = cKDTree(organ.vertices_mm[:, :2]).query(places[:, :2])[0] > foot + _CLEAR_MM
    long, short = sorted(config.bed_mm, reverse=True)
    free &= (np.abs(places[:, :2]) < np.array([long, short]) / 2 - foot - 4).all(1)
    if standing:
        free &= np.abs(places[:, 0]) > stands.PLATE_MM / 2 + 4 + foot
    free &= seen_beads([organ], places, eyes_mm(organ, config), config.bead_mm).all(0)
    grid = free.reshape(-1, len(away))
    return places[np.flatnonzero(grid.any(1)) * len(away) + grid.argmax(1)[grid.any(1)]]


def _cradle(organ: Mesh) -> tuple[Any, float]:
    """What bears the organ's underside, and how far inside it the weight acts. It is as low as lets
    the organ lie steady, and opens upwards everywhere."""
    import trimesh
    from scipy import ndimage
    from scipy.spatial import ConvexHull

    view = ParallelView("below", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    frame = view.frame_around(organ.vertices_mm, 20.0)
    under, (x, y) = view.depth_of(organ, frame, _GRID_MM), frame.pixel_centres(_GRID_MM)
    middle = trimesh.Trimesh(organ.vertices_mm, organ.faces, process=False).center_mass[:2]
    for height in np.arange(4.0, max(0.4 * organ.box_mm[1, 2], 5.0), 2.0):
        rows, columns = np.nonzero(under < height)
        planes = ConvexHull(np.stack([x[columns], y[rows]], 1)).equations
        steady = -float((planes[:, :2] @ middle + planes[:, 2]).max())
        if steady >= _STEADY_MM:
            break
    away = ndimage.distance_transform_edt(under >= height) * _GRID_MM
    top = np.minimum(np.minimum(under, height), height - 2 * np.maximum(away - _RIM_MM, 0))
    reach = np.arange(-1, 2) * _GRID_MM  # within the fillet's radius
    sphere = np.sqrt(np.maximum(_FILLET_MM**2 - reach[:, None] ** 2 - reach**2, 0)) - _FILLET_MM
    top = ndimage.grey_opening(np.maximum(top, -1.0), structure=sphere)
    return height_field(x, y, top, -2.0), steady
