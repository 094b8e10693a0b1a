"""The cell, built once: where the tips are, what collides with what, how near things are."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.types import Mesh
from tumortrack.plan.arms.body import CAMERA, LINKS, PEDESTAL, STAND, TABLE, Part, cell_parts
from tumortrack.plan.arms.config import Base, CellConfig
from tumortrack.plan.arms.urdf import cell_urdf
from tumortrack.plan.motions import CUTTER, HOLDER

if TYPE_CHECKING:
    from tumortrack.live.values import RigidShape

__all__ = ["ArmCell", "Base", "CellConfig"]

ORGAN = "organ"
ARMS = (CUTTER, HOLDER)
TOOLS = {CUTTER: ("bracket", "pencil", "electrode"), HOLDER: ("rod", "cup")}
TOUCHES = {CUTTER: "cutter/electrode", HOLDER: "holder/cup"}  # what of a tool may touch the organ
_THICK_MM = 10.0  # of what a tool is made of, about its own axis


class ArmCell:
    """Both arms with their tools over the table, and the organ once it is known.

    Values do not change after construction, but the buffers of pinocchio do: one thread at a time.
    """

    def __init__(self, config: CellConfig | None = None, organ: Mesh | None = None) -> None:
        import pinocchio as pin

        self.config = config or CellConfig()
        self.organ = organ
        text = cell_urdf(self.config)
        self._model = pin.buildModelFromXML(text)
        self._data = self._model.createData()
        self._solids = pin.buildGeomFromUrdfString(self._model, text, pin.GeometryType.COLLISION)
        self._names = _name_solids(self._solids, cell_parts(self.config))
        if organ is not None:
            surface = _bounding_volumes(organ)
            self._solids.addGeometryObject(
                pin.GeometryObject(ORGAN, 0, pin.SE3.Identity(), surface)
            )
            self._names.append(ORGAN)
        index = {name: n for n, name in enumerate(self._names)}
        self._pairs = [pair for pair in _pairs() if pair[0] in index and pair[1] in index]
        for one, other in self._pairs:
            self._solids.addCollisionPair(pin.CollisionPair(index[one], index[other]))
        self._tips = {arm: self._model.getFrameId(f"{arm}_tip") for arm in ARMS}
        self._around = {
            arm: (
                np.linalg.inv(self.config.base(arm).table_from_base),
                np.linalg.inv(self.config.flange_from_tip(arm)),
            )
            for arm in ARMS
        }
        self._states: dict[tuple, Any] = {}
        self._looks: Any = None

    def with_organ(self, organ: Mesh | None) -> ArmCell:
        """The same cell with this organ on its post (table frame, mm)."""
        return ArmCell(self.config, organ)

    @property
    def home_rad(self) -> Float64[np.ndarray, " 12"]:
        return np.array(self.config.home_rad)

    @cached_property
    def limits_rad(self) -> Float64[np.ndarray, " 12"]:
        """Each joint may turn so far both ways."""
        return np.concatenate([self.config.model(arm).limits_rad for arm in ARMS])

    @cached_property
    def speeds_rad_s(self) -> Float64[np.ndarray, " 12"]:
        """Greatest speeds planned with."""
        makers = np.concatenate([self.config.model(arm).speeds_rad_s for arm in ARMS])
        return self.config.speed_share * makers

    def levers_mm(
        self, start_rad: Float64[np.ndarray, " 12"], goal_rad: Float64[np.ndarray, " 12"]
    ) -> Float64[np.ndarray, " 12"]:
        """On the straight way between two configurations, no point of an arm or its tool moves
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

    def around_arm(self, arm: str) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "4 4"]]:
        """``base_from_table`` and ``tip_from_flange``, mm."""
        return self._around[arm]

    def tips(self, joints_rad: Float64[np.ndarray, " 12"]) -> dict[str, Float64[np.ndarray, "4 4"]]:
        """``table_from_tip`` (mm) of ``cutter`` and ``holder``: z up; the instrument points along
        its x."""
        import pinocchio as pin

        pin.framesForwardKinematics(self._model, self._data, joints_rad)
        places = {}
        for arm, frame in self._tips.items():
            place = self._data.oMf[frame].homogeneous.copy()
            place[:3, 3] *= 1000
            places[arm] = place
        return places

    def collisions(
        self,
        joints_rad: Float64[np.ndarray, " 12"],
        touching: Collection[str] = (),
        clearance: bool = True,
        moving: str | None = None,
    ) -> tuple[str, str] | None:
        """Names of the first pair that collides, or None.

        Args:
            touching: arms whose electrode or cup may be on or in the organ now.
            clearance: things that come nearer than the configured clearances collide too.
            moving: the arm that moves, if the rest is known to be free; None: test everything.
        """
        import pinocchio as pin

        state = self._state(tuple(sorted(touching)), clearance, moving)
        pin.updateGeometryPlacements(self._model, self._data, self._solids, state, joints_rad)
        if not pin.computeCollisions(self._solids, state, True):
            return None
        # It stops at the first; results beyond that are of earlier calls.
        results = zip(self._pairs, state.activeCollisionPairs, state.collisionResults, strict=True)
        return next(pair for pair, active, one in results if active and one.isCollision())

    def nearest(
        self, joints_rad: Float64[np.ndarray, " 12"], touching: Collection[str] = ()
    ) -> tuple[float, tuple[str, str]]:
        """The least distance of any pair, mm (negative: how deep), and its names."""
        import pinocchio as pin

        state = self._state(tuple(sorted(touching)), False, None)
        pin.updateGeometryPlacements(self._model, self._data, self._solids, state, joints_rad)
        n = pin.computeDistances(self._solids, state)
        return 1000 * state.distanceResults[n].min_distance, self._pairs[n]

    def shapes(self, joints_rad: Float64[np.ndarray, " 12"]) -> tuple[RigidShape, ...]:
        """Everything as surfaces in the table frame, and a bead at each tip (``cutter/tip``); the
        organ is not among them."""
        import pinocchio as pin

        from tumortrack.plan.arms.looks import Looks, tip

        if self._looks is None:
            self._looks = Looks(cell_parts(self.config))
        pin.framesForwardKinematics(self._model, self._data, joints_rad)
        places = {}
        for link in self._looks.links:
            place = self._data.oMf[self._model.getFrameId(link)].homogeneous.copy()
            place[:3, 3] *= 1000
            places[link] = place
        tips = (tip(arm, place) for arm, place in self.tips(joints_rad).items())
        return (*self._looks.shapes(places), *tips)

    def _state(self, touching: tuple[str, ...], clearance: bool, moving: str | None) -> Any:
        """Collision buffers in which only the pairs that matter are active."""
        key = (touching, clearance, moving)
        if key not in self._states:
            import pinocchio as pin

            state, ends = pin.GeometryData(self._solids), {TOUCHES[arm] for arm in touching}
            for n, pair in enumerate(self._pairs):
                still = moving is not None and not any(moving in name for name in pair)
                if still or (ORGAN in pair and ends & set(pair)):
                    state.deactivateCollisionPair(n)
                margin = self._margin_mm(pair, touching)
                state.collisionRequests[n].security_margin = margin / 1000 if clearance else 0.0
            self._states[key] = state
        return self._states[key]

    def _margin_mm(self, pair: tuple[str, str], touching: tuple[str, ...]) -> float:
        """How near these two may come."""
        if ORGAN in pair or (STAND in pair and TOUCHES[CUTTER] in pair):
            return self.config.organ_clearance_mm
        tools = pair[0] == TOUCHES[CUTTER] and pair[1].removeprefix("holder/") in TOOLS[HOLDER]
        return self.config.contact_mm if tools and len(touching) == 2 else self.config.clearance_mm


def _name_solids(solids: Any, parts: tuple[Part, ...]) -> list[str]:
    """Our names in pinocchio's order, which is that of each link's collision elements."""
    by_link: dict[str, Iterator[str]] = {}
    for link in {part.link for part in parts}:
        by_link[link] = iter([p.whose for p in parts if p.link == link and p.use != "picture"])
    return [next(by_link[solid.name.rsplit("_", 1)[0]]) for solid in solids.geometryObjects]


def _pairs() -> list[tuple[str, str]]:
    """All that could ever meet. Links next to each other are left out, and of an arm with itself
    what its joints' offsets keep apart."""
    moving = {arm: [f"{arm}/{name}" for name in (*LINKS[2:], *TOOLS[arm])] for arm in ARMS}
    pairs = list(product(moving[CUTTER], moving[HOLDER]))
    for arm, other in (ARMS, ARMS[::-1]):
        own = moving[arm]
        still = [f"{arm}/{name}" for name in LINKS[:2]]
        pairs += product(own, [f"{other}/{name}" for name in (PEDESTAL, *LINKS[:2])])
        pairs += product(own[1:], (f"{arm}/{PEDESTAL}",))
        pairs += product(own, (TABLE, STAND, CAMERA))
        pairs += product(own[1:], (ORGAN,))
        pairs += product(own[1:], still)
        pairs += product(own[2:], own[:1])  # the upper arm
        pairs += product(own[4:], own[1:2])  # the forearm
    return pairs


def _bounding_volumes(organ: Mesh) -> Any:
    """The organ's surface as coal's tree of boxes, metres."""
    import coal

    surface = coal.BVHModelOBBRSS()
    surface.beginModel(len(organ.faces), len(organ.vertices_mm))
    surface.addVertices(np.array(organ.vertices_mm / 1000))
    surface.addTriangles(np.array(organ.faces, dtype=np.int64))
    surface.endModel()
    return surface
