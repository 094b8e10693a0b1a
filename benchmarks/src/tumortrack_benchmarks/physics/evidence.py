"""Evidence of a scene, drawn from its truth with the errors of tools, calibrations and hands.

All that the robot's tools tell of one scene (touches, held points, outlines of a probe that it
holds) shares one hand-eye error: a shift, and a turn about the organ's middle. Landmarks are
clicked in the camera's image and have none; of a held point it cancels, since which point was taken
is known through the same calibration. All errors of a piece but those that make it false are
stated: by ``std_mm``, and by ``shared_std_mm`` what it shares with others of the robot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from tumortrack.core.config import Config
from tumortrack.core.evidence import Evidence, FreeSpace, Grasp, Landmark, Outline, Touch
from tumortrack.core.geometry import perpendicular, plane_section, triangles_of, turned_by, unit
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Mesh
from tumortrack.io.scene_folder import Scene, Targets

Generator = np.random.Generator
Points = Float[np.ndarray, "n 3"]

_UNSEEN_MM = 8.0  # from any point of the cloud: well beyond its noise and spacing
_PLACES = 12  # of an outline
_CENTRAL = 0.15, 0.85  # of the vertices, between which planes lie
_SHAFT_MM, _SHAFT_RADIUS_MM = (5.0, 60.0), 3.0  # from the surface
_SEEN_SHARE = 0.2  # of the inner points, those nearest to the cloud: what a person can recognise


class EvidenceErrors(Config, frozen=True, kw_only=True):
    """Assumptions; mm are standard deviations along each axis where nothing else is said.

    ``tip_mm``: of a tool's tip. ``hand_eye_mm``: range of the length of the shift;
    ``hand_eye_degrees``: of the turn. ``probe_mm``: of a place of an outline, half of the variance
    shared by all places of it. ``click_mm``: of a landmark. ``grip_mm``: of which point of the CT a
    tool holds. ``false_contacts``: share of touches of something else, ``false_mm`` outside the
    surface; ``slips``: share of held points from which the tool is ``slip_mm`` away.
    """

    tip_mm: float = 1.0
    hand_eye_mm: tuple[float, float] = (1.0, 2.0)
    hand_eye_degrees: float = 0.5
    probe_mm: float = 1.5
    click_mm: float = 2.0
    grip_mm: float = 1.0
    false_contacts: float = 0.05
    false_mm: tuple[float, float] = (3.0, 15.0)
    slips: float = 0.05
    slip_mm: tuple[float, float] = (5.0, 15.0)


ERRORS = EvidenceErrors()
ALL_TRUE = EvidenceErrors(false_contacts=0.0, slips=0.0)
_LEAST_STD_MM = 0.05  # that evidence may state


class Piece(NamedTuple):
    """``false``: it is of another thing than it says."""

    evidence: Evidence
    false: bool = False


@dataclass(frozen=True, eq=False)
class EvidenceSource:
    """Draws pieces of evidence of one scene, one after the other; camera frame, mm."""

    scene: Scene
    errors: EvidenceErrors
    rng: Generator
    shift_mm: Float[np.ndarray, " 3"]
    turn: Float[np.ndarray, "3 3"]

    @classmethod
    def of(
        cls, scene: Scene, seed: Sequence[int], errors: EvidenceErrors = ERRORS
    ) -> EvidenceSource:
        """The same seed has the same hand-eye error, whatever the shares of false pieces."""
        rng = np.random.default_rng([*seed, 0])
        shift_mm = unit(rng.normal(size=3)) * rng.uniform(*errors.hand_eye_mm)
        turn = turned_by(unit(rng.normal(size=3)) * np.deg2rad(errors.hand_eye_degrees))
        return cls(scene, errors, np.random.default_rng([*seed, 1]), shift_mm, turn)

    @property
    def targets(self) -> Targets:
        assert self.scene.targets is not None
        return self.scene.targets

    @property
    def unseen(self) -> Bool[np.ndarray, " f"]:
        """The triangles of the organ that are far from all points of the cloud."""
        organ = self.scene.reference.organ
        centres, _ = triangles_of(organ.vertices_mm, organ.faces)
        return cKDTree(self.scene.cloud.points_mm).query(centres)[0] > _UNSEEN_MM

    def touches(self, aims_mm: Points, along: Points) -> list[Piece]:
        """The true surface is touched where it is nearest to each aim on the line through it
        (``along``: outward)."""
        return [self._touch(*aim) for aim in zip(aims_mm, along, strict=True)]

    def touches_at_random(self, count: int, faces: Bool[np.ndarray, " f"] | None) -> list[Piece]:
        """Anywhere on the surface, or on these triangles of it."""
        organ = self.scene.reference.organ
        centres, doubled = triangles_of(organ.vertices_mm, organ.faces)
        weights = np.linalg.norm(doubled, axis=1)
        weights = weights if faces is None or not faces.any() else weights * faces
        chosen = self.rng.choice(len(centres), count, p=weights / weights.sum())
        return self.touches(centres[chosen], doubled[chosen])

    def drawn(self, numbers: Mapping[str, int]) -> list[Piece]:
        """So many pieces of each kind (touch, landmark, held, free, plane), at random; of outlines,
        so many of each tumor."""
        tumors = len(self.scene.reference.tumors)
        outlines = [self.outline(n % tumors) for n in range(tumors * numbers.get("outline", 0))]
        return [
            *self.touches_at_random(numbers.get("touch", 0), None),
            *(outline for outline in outlines if outline is not None),
            *(self.landmarks(n) if (n := numbers.get("landmark", 0)) else ()),
            *(self.held(n % max(tumors, 1)) for n in range(numbers.get("held", 0))),
            *(self.free() for _ in range(numbers.get("free", 0))),
            *(self.plane() for _ in range(numbers.get("plane", 0))),
        ]

    def outline(self, tumor: int, normal: Float[np.ndarray, " 3"] | None = None) -> Piece | None:
        """Places on the border of a tumor (0: the first) in the plane through its middle; of a
        random normal, if none is given. None: its surface has no such section."""
        part = self.scene.reference.tumors[tumor]
        middle, errors = part.vertices_mm.mean(0), self.errors
        normal = self.normal() if normal is None else normal
        segments = plane_section(part.vertices_mm, part.faces, normal, middle)
        if len(segments) < _PLACES:
            return None
        places = segments.mean(1)
        across = perpendicular(normal)
        x, y = (places - middle) @ across, (places - middle) @ np.cross(normal, across)
        order = np.argsort(np.arctan2(y, x))
        places = places[order[np.linspace(0, len(order), _PLACES, endpoint=False).astype(int)]]
        half_mm = errors.probe_mm / np.sqrt(2)
        told = self._by_robot(places) + self.rng.normal(0, half_mm, 3)
        told = told + self.rng.normal(0, half_mm, told.shape)
        name = self.scene.reference.names[1 + tumor]
        stated = self._stated(middle, half_mm)
        stated |= {"shared_std_mm": float(np.hypot(stated["shared_std_mm"], half_mm)), "tool": ""}
        return Piece(Outline(places_mm=_tuples(told), part=name, **stated))

    def plane(self) -> Piece:
        """The organ's outline in an ultrasound image: in a plane through it, not near its ends."""
        organ, normal = self.scene.reference.organ, self.normal()
        low, high = np.quantile(organ.vertices_mm @ normal, _CENTRAL)
        middle = organ.vertices_mm.mean(0)
        middle = middle + (self.rng.uniform(low, high) - middle @ normal) * normal
        places = plane_section(organ.vertices_mm, organ.faces, normal, middle).mean(1)
        places = places[np.linspace(0, len(places), _PLACES, endpoint=False).astype(int)]
        told = self._by_robot(places) + self.rng.normal(0, self.errors.probe_mm, places.shape)
        stated = self._stated(middle, self.errors.probe_mm)
        return Piece(Outline(places_mm=_tuples(told), part=self.scene.reference.names[0], **stated))

    def normal(self) -> Float[np.ndarray, " 3"]:
        """Of a random plane."""
        return unit(self.rng.normal(size=3))

    def landmarks(self, count: int) -> list[Piece]:
        """Inner points nearest to what is seen, as if they were recognised on the surface."""
        targets, std_mm = self.targets, self.errors.click_mm
        away_mm = cKDTree(self.scene.cloud.points_mm).query(targets.points_mm)[0]
        near = np.argsort(away_mm)[: max(count, int(_SEEN_SHARE * len(away_mm)))]
        chosen = self.rng.choice(near, count, replace=False)
        told = targets.points_mm[chosen] + self.rng.normal(0, std_mm, (count, 3))
        pairs = zip(_tuples(targets.points_ct[chosen]), _tuples(told), strict=True)
        std_mm = max(std_mm, _LEAST_STD_MM)
        return [Piece(Landmark(point_ct=a, place_mm=b, std_mm=std_mm)) for a, b in pairs]

    def held(self, tumor: int = 0) -> Piece:
        """The inner point of a tumor (of the organ, where it has none there) that is nearest to the
        organ's surface."""
        targets, errors, rng = self.targets, self.errors, self.rng
        mine = np.flatnonzero(targets.labels == tumor + 2)
        mine = mine if len(mine) else np.arange(len(targets.labels))
        surface = cKDTree(self.scene.reference.organ.vertices_mm)
        point = mine[surface.query(targets.points_mm[mine])[0].argmin()]
        point_ct = targets.points_ct[point] + rng.normal(0, errors.grip_mm, 3)
        told = targets.points_mm[point] + rng.normal(0, errors.tip_mm, 3)
        if slipped := rng.uniform() < errors.slips:
            told = told + unit(rng.normal(size=3)) * rng.uniform(*errors.slip_mm)
        held = Grasp(
            point_ct=_tuples(point_ct), place_mm=_tuples(told), point_std_mm=errors.grip_mm,
            std_mm=max(errors.tip_mm, _LEAST_STD_MM), tool="robot",
        )  # fmt: skip
        return Piece(held, bool(slipped))

    def free(self) -> Piece:
        """Places along a tool's shaft that stands on the organ's surface."""
        organ = self.scene.reference.organ
        centres, doubled = triangles_of(organ.vertices_mm, organ.faces)
        face, way = self.rng.integers(len(centres)), np.linspace(*_SHAFT_MM, _PLACES)
        along = centres[face] + way[:, None] * unit(doubled[face])
        along = along[~contains(organ, along)]  # it may meet another fold
        told = self._by_robot(along) + self.rng.normal(0, self.errors.tip_mm, along.shape)
        stated = self._stated(along.mean(0), self.errors.tip_mm)
        return Piece(FreeSpace(places_mm=_tuples(told), tip_mm=_SHAFT_RADIUS_MM, **stated))

    def _touch(self, aim_mm: np.ndarray, outward: np.ndarray) -> Piece:
        errors, rng = self.errors, self.rng
        place, normal = met(self.scene.reference.organ, aim_mm, outward)
        false, off_mm = rng.uniform() < errors.false_contacts, rng.uniform(*errors.false_mm)
        there = place + false * off_mm * normal
        told = self._by_robot(there[None])[0] + rng.normal(0, errors.tip_mm, 3)
        stated = self._stated(place, errors.tip_mm)
        return Piece(Touch(place_mm=_tuples(told), **stated), bool(false))

    def _by_robot(self, places_mm: Points) -> Points:
        """As the robot has them in the camera's frame."""
        middle = self.scene.reference.organ.vertices_mm.mean(0)
        return (places_mm - middle) @ self.turn.T + middle + self.shift_mm

    def _stated(self, place_mm: np.ndarray, own_mm: float) -> dict[str, Any]:
        """Deviations of a piece of the robot: its own, and the shared one, by the mean square along
        an axis of shifts of uniform length and of turns, both in any direction."""
        low, high = self.errors.hand_eye_mm
        lever_mm = np.linalg.norm(place_mm - self.scene.reference.organ.vertices_mm.mean(0))
        shift = (low**2 + low * high + high**2) / 9
        turn = (np.deg2rad(self.errors.hand_eye_degrees) * lever_mm) ** 2 * 2 / 9
        return {
            "std_mm": max(own_mm, _LEAST_STD_MM),
            "shared_std_mm": float(np.sqrt(shift + turn)),
            "tool": "robot",
        }


def met(
    mesh: Mesh, aim_mm: Float[np.ndarray, " 3"], outward: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Where a tool that comes along the line through an aim meets the surface from outside, nearest
    to the aim (a line that misses: the nearest triangle's centre), and the normal there (unit)."""
    along, (centres, doubled) = unit(outward), triangles_of(mesh.vertices_mm, mesh.faces)
    corners = mesh.vertices_mm[mesh.faces]
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    facing = doubled @ along
    with np.errstate(divide="ignore", invalid="ignore"):
        far_mm = ((a - aim_mm) * doubled).sum(1) / facing
        from_a = aim_mm + far_mm[:, None] * along - a
        squared = (doubled**2).sum(1)
        u = (np.cross(from_a, c) * doubled).sum(1) / squared
        v = (np.cross(b, from_a) * doubled).sum(1) / squared
        inside = (facing > 0) & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
    hit = np.flatnonzero(inside)
    if not len(hit):
        nearest = int(np.linalg.norm(centres - aim_mm, axis=1).argmin())
        return centres[nearest], unit(doubled[nearest])
    face = hit[np.abs(far_mm[hit]).argmin()]
    return aim_mm + far_mm[face] * along, unit(doubled[face])


def hidden(scene: Scene, share: float, rng: Generator) -> Scene:
    """The scene without this share of its cloud, on one side of a line across the image."""
    angle = rng.uniform(0, 2 * np.pi)
    way, points_mm = np.array([np.cos(angle), np.sin(angle)]), scene.cloud.points_mm
    along = points_mm[:, :2] / points_mm[:, 2:] @ way
    line, depth = np.quantile(along, 1 - share), scene.depth
    if depth is not None:
        camera, (v, u) = depth.intrinsics, np.indices(depth.depth_mm.shape)
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        lost = x * way[0] + y * way[1] > line
        depth = depth.with_depth(np.where(lost, np.nan, depth.depth_mm).astype(np.float32))
    cloud = replace(scene.cloud, points_mm=points_mm[along <= line])
    return replace(scene, cloud=cloud, depth=depth)


def mirrored(scene: Scene) -> Scene:
    """The scene with all that is in it mirrored (x negated): an organ that no turn makes this one.
    A target is where the mirrored organ has that point of the CT."""
    flip = np.array([-1.0, 1.0, 1.0])
    depth = scene.depth
    if depth is not None:
        camera = depth.intrinsics
        camera = replace(camera, cx=camera.width - 1 - camera.cx)
        depth = replace(depth, depth_mm=depth.depth_mm[:, ::-1], intrinsics=camera)
    targets = scene.targets
    if targets is not None:
        targets = replace(targets, points_mm=targets.points_mm * flip)
    parts = (Mesh(p.vertices_mm * flip, p.faces[:, ::-1]) for p in scene.reference.parts)
    cloud = replace(scene.cloud, points_mm=scene.cloud.points_mm * flip)
    reference = scene.reference.with_parts(parts)
    return replace(scene, cloud=cloud, depth=depth, targets=targets, reference=reference)


def _tuples(points: np.ndarray) -> tuple:
    return tuple(map(_tuples, points)) if points.ndim > 1 else tuple(map(float, points))
