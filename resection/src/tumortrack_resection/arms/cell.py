"""The workcell for kinematics and collision checking, and the group of its joints that moves."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float64

from tumortrack.assessment.advice import Place
from tumortrack.core.errors import NoPlan
from tumortrack.core.types import Mesh
from tumortrack.live.values import RigidShape
from tumortrack_resection.arms import body
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.arms.kinematics import (
    ArmModel,
    Pose,
    inverse_kinematics,
    level_pose,
    nearest_turn,
)
from tumortrack_resection.motions import ARMS, CUTTER, HOLDER, Joints

ORGAN = "organ"
TOOLS = {CUTTER: ("bracket", "pencil", "electrode"), HOLDER: ("rod", "cup")}
TOUCHES = {CUTTER: "cutter/electrode", HOLDER: "holder/cup"}  # what of a tool may touch the organ
CollidingPair = tuple[str, str]
_THICK_MM = 10.0  # of what a tool is made of, about its own axis
_MOST_ROOM_MM = 64.0  # asked for beyond all clearances: parts of an arm are no farther apart
_FACING = 0.5  # cosine from a tool's way back to the surface's normal: a flatter tip slides off
_YAWS = 8  # directions from which the electrode comes; the cup always comes from above


class ArmCell:
    """Both arms with their tools over the table, and the organ once it is known. pinocchio's
    buffers change with every call: one thread at a time. ``keep``: surfaces from which the
    electrode keeps a distance, mm, whatever it does."""

    def __init__(
        self,
        config: CellConfig | None = None,
        organ: Mesh | None = None,
        keep: Mapping[str, tuple[Mesh, float]] | None = None,
    ) -> None:
        self.config = config or CellConfig()
        self.organ = organ
        keep = {f"the margin of {name}": kept for name, kept in (keep or {}).items()}
        self.keep_mm = {name: mm for name, (_, mm) in keep.items()}
        self.home_rad: Joints = np.array(self.config.home_rad)
        self.limits_rad, self.speeds_rad_s = self.config.limits_rad, self.config.speeds_rad_s
        text = body.cell_urdf(self.config)
        self.model = pin.buildModelFromXML(text)
        self.solids = pin.buildGeomFromUrdfString(self.model, text, pin.GeometryType.COLLISION)
        self._data = self.model.createData()
        names = _solid_names(self.solids, body.cell_parts(self.config))
        kept = {name: mesh for name, (mesh, _) in keep.items()}
        for name, mesh in {**({} if organ is None else {ORGAN: organ}), **kept}.items():
            surface = _bounding_volumes(mesh)
            self.solids.addGeometryObject(pin.GeometryObject(name, 0, pin.SE3.Identity(), surface))
            names.append(name)
        index = {name: n for n, name in enumerate(names)}
        self._pairs = [pair for pair in _pairs() if index.keys() >= set(pair)]
        self._pairs += [(TOUCHES[CUTTER], name) for name in kept]
        for first, second in self._pairs:
            self.solids.addCollisionPair(pin.CollisionPair(index[first], index[second]))
        self._states: dict[tuple[Any, ...], Any] = {}

    def levers_mm(self, start_rad: Joints, goal_rad: Joints) -> Joints:
        """On the straight segment between two configurations, no point of an arm or its tool moves
        farther than this per radian of each of its joints."""
        levers: list[float] = []
        for arm, elbow in zip(ARMS, (2, 8), strict=True):
            model, tool = self.config.model(arm), self.config.flange_from_tip(arm)[:3, 3]
            upper, lower = np.abs(model.a_mm[1:3])
            d4, d5, d6 = model.d_mm[3:]
            ahead = float(np.hypot(*tool[:2])) + _THICK_MM
            hand = float(np.hypot(ahead, tool[2] + d6))
            wrist = hand + d5
            # The arm is longest where its elbow is straightest.
            ends = np.array([start_rad[elbow], goal_rad[elbow]])
            bent = 0.0 if ends[0] * ends[1] <= 0 else float(np.abs(ends).min())
            stretched = np.sqrt(upper**2 + lower**2 + 2 * upper * lower * np.cos(bent))
            shoulder = max(np.hypot(stretched, d4) + wrist, np.hypot(upper, d4) + 2 * d5)
            levers += [shoulder, shoulder, np.hypot(lower, d4) + wrist, wrist, hand, ahead]
        return np.array(levers)

    def tips(self, joints_rad: Joints) -> dict[str, Pose]:
        """``table_from_tip`` (mm) of both arms: z up; the instrument points along its x."""
        places = self._frames(joints_rad, [f"{arm}_tip" for arm in ARMS])
        return dict(zip(ARMS, places.values(), strict=True))

    @cached_property
    def _surfaces(self) -> list[tuple[body.Part, Mesh]]:
        return body.display_surfaces(self.config)

    def shapes(self, joints_rad: Joints) -> tuple[RigidShape, ...]:
        """Everything but the organ in the table frame, and a bead at each tip."""
        places = self._frames(joints_rad, {part.link for part, _ in self._surfaces})
        return tuple(
            RigidShape(part.name_in_cell, mesh, places[part.link], part.colour)
            for part, mesh in self._surfaces
        )

    def _frames(self, joints_rad: np.ndarray, names: Collection[str]) -> dict[str, Pose]:
        """``table_from_frame`` (mm) of links by their names, by forward kinematics."""
        pin.framesForwardKinematics(self.model, self._data, joints_rad)
        places = {}
        for name in names:
            places[name] = self._data.oMf[self.model.getFrameId(name)].homogeneous.copy()
            places[name][:3, 3] *= 1000
        return places

    def collisions(
        self,
        joints_rad: Joints,
        touching: Collection[str] = (),
        moving: str | None = None,
        room_mm: float = 0.0,
    ) -> CollidingPair | None:
        """The first pair that comes nearer than its clearance. ``touching``: arms whose
        electrode or cup may touch the organ; ``moving``: the arm that does, if the rest is known
        to be free; ``room_mm``: beyond all clearances, rounded up."""
        if room_mm > 0:
            room_mm = 2.0 ** np.ceil(np.log2(room_mm))  # few, as each has buffers of its own
        state = self._state(tuple(sorted(touching)), moving, room_mm)
        pin.updateGeometryPlacements(self.model, self._data, self.solids, state, joints_rad)
        if not pin.computeCollisions(self.solids, state, True):
            return None
        # It stops at the first collision; later results are of earlier calls.
        results = zip(self._pairs, state.activeCollisionPairs, state.collisionResults, strict=True)
        return next(pair for pair, active, result in results if active and result.isCollision())

    def _state(self, touching: tuple[str, ...], moving: str | None, room_mm: float) -> Any:
        """Collision buffers with only the relevant pairs active."""
        if (touching, moving, room_mm) not in self._states:
            state, ends = pin.GeometryData(self.solids), {TOUCHES[arm] for arm in touching}
            for n, pair in enumerate(self._pairs):
                still = moving is not None and not any(moving in name for name in pair)
                if still or (ORGAN in pair and ends & set(pair)):
                    state.deactivateCollisionPair(n)
                margin_mm = self._margin_mm(pair, touching) + room_mm
                state.collisionRequests[n].security_margin = margin_mm / 1000
            self._states[touching, moving, room_mm] = state
        return self._states[touching, moving, room_mm]

    def _margin_mm(self, pair: CollidingPair, touching: tuple[str, ...]) -> float:
        """The least distance of a pair."""
        if pair[1] in self.keep_mm:
            # In free motions it may come nearer between two tested poses.
            room_mm = 0.0 if CUTTER in touching else self.config.least_clearance_mm(touching)
            return self.keep_mm[pair[1]] + room_mm
        if ORGAN in pair or (body.STAND in pair and TOUCHES[CUTTER] in pair):
            return self.config.organ_clearance_mm
        tools = pair[0] == TOUCHES[CUTTER] and pair[1].removeprefix("holder/") in TOOLS[HOLDER]
        return self.config.contact_mm if tools and len(touching) == 2 else self.config.clearance_mm


def tip_places(
    config: CellConfig,
) -> Callable[[str, Float64[np.ndarray, " 6"]], Float64[np.ndarray, " 3"]]:
    """A function from an arm's six joints to its tip: table frame, mm. Arms may be queried in
    different threads."""
    cells = {arm: ArmCell(config) for arm in ARMS}

    def tip_mm(arm: str, own_rad: Float64[np.ndarray, " 6"]) -> Float64[np.ndarray, " 3"]:
        joints_rad = cells[arm].home_rad.copy()
        joints_rad[6 * ARMS.index(arm) :][:6] = own_rad
        return cells[arm].tips(joints_rad)[arm][:3, 3]

    return tip_mm


class Blocked(NoPlan):
    """This motion is impossible, another may not be; ``pair``: what would collide, if that is
    why."""

    def __init__(self, text: str, pair: CollidingPair | None = None) -> None:
        super().__init__(text)
        self.pair = pair

    @classmethod
    def by(cls, pair: CollidingPair, where: str = "") -> Blocked:
        return cls(f"{pair[0]} would meet {pair[1]}{where}", pair)


@dataclass(frozen=True, eq=False)
class PlanningGroup:
    """One arm's joints, which move while the others stand still at ``joints_rad`` (12).
    ``touching``: arms that may touch the organ with their electrode or cup."""

    cell: ArmCell
    arm: str
    joints_rad: Joints
    touching: Collection[str] = ()

    @cached_property
    def own(self) -> slice:
        first = 6 * ARMS.index(self.arm)
        return slice(first, first + 6)

    @property
    def current_rad(self) -> Float64[np.ndarray, " d"]:
        return self.joints_rad[self.own]

    @property
    def limits_rad(self) -> Float64[np.ndarray, " d"]:
        return self.cell.limits_rad[self.own]

    @property
    def model(self) -> ArmModel:
        return self.cell.config.model(self.arm)

    def all_joints(self, own_rad: Float64[np.ndarray, " d"]) -> Joints:
        joints = self.joints_rad.copy()
        joints[self.own] = own_rad
        return joints

    def inverse_kinematics(self, table_from_tip: Pose) -> Float64[np.ndarray, "k 6"]:
        """All branches that bring the tip to a pose, each joint turned near its present angle."""
        base_from_table, tip_from_flange = self._frames
        flange = base_from_table @ table_from_tip @ tip_from_flange
        return nearest_turn(self.model, inverse_kinematics(self.model, flange), self.current_rad)

    @cached_property
    def _frames(self) -> tuple[Pose, Pose]:
        """``base_from_table`` and ``tip_from_flange``, mm."""
        config = self.cell.config
        base, flange = config.base(self.arm).table_from_base, config.flange_from_tip(self.arm)
        return np.linalg.inv(base), np.linalg.inv(flange)

    def collides(
        self, own_rad: Float64[np.ndarray, " d"], room_mm: float = 0.0
    ) -> CollidingPair | None:
        """A pair that comes nearer than allowed, or than that and ``room_mm``."""
        return self.cell.collisions(self.all_joints(own_rad), self.touching, self.arm, room_mm)

    def segment_collides(
        self, start_rad: np.ndarray, goal_rad: np.ndarray, spacing: float = 1.0
    ) -> CollidingPair | None:
        """The same on the straight segment in joint space between two free configurations. With
        ``spacing`` 1 no point moves by more than twice the least clearance in one step: what is
        free with that clearance at both ends is free between."""
        least_mm = self.cell.config.least_clearance_mm(self.touching)
        levers_mm = self.cell.levers_mm(self.all_joints(start_rad), self.all_joints(goal_rad))
        moved_mm = float(np.abs(goal_rad - start_rad) @ levers_mm[self.own])
        n = int(np.ceil(moved_mm / (2 * least_mm * spacing)))
        if n < 2:
            return None
        step_rad = (goal_rad - start_rad) / n
        moved = np.full(n, moved_mm / n)
        found = blocked_between(
            0, n, moved, lambda k, mm: self.collides(start_rad + k * step_rad, mm)
        )
        return None if found is None else found[1]


def blocked_between(
    first: int, last: int, moved_mm: Float64[np.ndarray, " n"],
    test: Callable[[int, float], CollidingPair | None],
) -> tuple[int, CollidingPair] | None:  # fmt: skip
    """The number of a pose between two others at which something comes too near, and what. A
    pose is left out where a tested one keeps so much more that nothing can move as far. From the
    middle outward, as collisions are rarely near the ends. ``moved_mm``: at most, of any point,
    from pose ``first`` + n to the next; ``test``: the pair that comes nearer at a pose than its
    clearance and some room, mm."""
    way_mm = np.append(0.0, np.cumsum(moved_mm))
    open_ends = deque([(first, last)])
    while open_ends:
        a, b = open_ends.popleft()
        if b - a < 2:
            continue
        k = (a + b) // 2
        here_mm, *ends_mm = way_mm[[k - first, a + 1 - first, b - 1 - first]]
        room_mm = float(max(here_mm - ends_mm[0], ends_mm[1] - here_mm))
        tried = 0 < room_mm <= _MOST_ROOM_MM
        if tried and test(k, room_mm) is None:
            continue
        if (pair := test(k, 0.0)) is not None:
            return k, pair
        open_ends += [(a, k), (k, b)]
    return None


def _solid_names(solids: Any, parts: tuple[body.Part, ...]) -> list[str]:
    """Our names in pinocchio's order, that of each link's collision elements."""
    by_link: dict[str, list[str]] = defaultdict(list)
    for part in parts:
        if part.use != "picture":
            by_link[part.link].append(part.name_in_cell)
    return [by_link[solid.name.rsplit("_", 1)[0]].pop(0) for solid in solids.geometryObjects]


def _pairs() -> list[CollidingPair]:
    """All that could ever collide: not neighbouring links, nor what joints' offsets keep apart."""
    moving = {arm: [f"{arm}/{name}" for name in (*body.LINKS[2:], *TOOLS[arm])] for arm in ARMS}
    pairs = list(product(moving[CUTTER], moving[HOLDER]))
    for arm, other in (ARMS, ARMS[::-1]):
        own = moving[arm]
        pairs += product(own, [f"{other}/{name}" for name in (body.PEDESTAL, *body.LINKS[:2])])
        pairs += product(own[1:], (f"{arm}/{body.PEDESTAL}",))
        pairs += product(own, (body.TABLE, body.STAND, body.CAMERA))
        pairs += product(own[1:], (ORGAN,))
        pairs += product(own[1:], [f"{arm}/{name}" for name in body.LINKS[:2]])
        pairs += product(own[2:], own[:1])  # the upper arm
        pairs += product(own[4:], own[1:2])  # the forearm
    return pairs


def _bounding_volumes(organ: Mesh) -> Any:
    """The organ's surface as coal's tree of boxes, metres."""
    surface = coal.BVHModelOBBRSS()
    surface.beginModel(len(organ.faces), len(organ.vertices_mm))
    surface.addVertices(np.array(organ.vertices_mm / 1000))
    surface.addTriangles(np.array(organ.faces, dtype=np.int64))
    surface.endModel()
    return surface


class ArmsReach:
    """Whether one of the tips can touch the organ (``organ``: its surface, table frame) while the
    other arm stays where it is: without a collision there. The way there is not planned."""

    def __init__(self, config: CellConfig, organ: Mesh, joints_rad: Joints) -> None:
        cell = ArmCell(config, organ)
        self._groups = {arm: PlanningGroup(cell, arm, joints_rad, (arm,)) for arm in ARMS}

    def __call__(self, place_mm: Place, normal: Place) -> bool:
        """A place of its surface, and the outward normal there; table frame, mm."""
        ways = [(CUTTER, yaw) for yaw in np.linspace(0, 2 * np.pi, _YAWS, endpoint=False)
                if normal @ [-np.cos(yaw), -np.sin(yaw), 0.0] > _FACING]  # fmt: skip
        ways += [(HOLDER, 0.0)] if normal[2] > _FACING else []
        return any(
            self._groups[arm].collides(branch) is None
            for arm, yaw in ways
            for branch in self._groups[arm].inverse_kinematics(level_pose(place_mm, yaw))
        )
