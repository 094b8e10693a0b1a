"""Arms, tools and surroundings as simple solids on links, one list for collisions (plain solids
that enclose), URDF and display. Sizes and lateral offsets are ours, rounded up from the maker's
drawings."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from tumortrack.core.colours import Colour
from tumortrack.core.geometry import rigid, rotation_onto, transform_points
from tumortrack.core.types import Mesh
from tumortrack_resection.arms.config import (
    ELECTRODE_RADIUS_MM,
    PENCIL_RADIUS_MM,
    STAND_GAP_MM,
    CellConfig,
)
from tumortrack_resection.arms.kinematics import ArmModel, Pose
from tumortrack_resection.motions import ARMS, CUTTER, HOLDER
from tumortrack_resection.ur_sink import UR_JOINTS

Use = Literal["both", "collision", "picture"]
_Ends = tuple[tuple[float, float, float], tuple[float, float, float]]

GREY, DARK, BLUE = (206, 210, 214), (92, 98, 106), (104, 160, 196)
STEEL, YELLOW, CUP = (176, 182, 190), (222, 190, 80), (70, 76, 92)
WOOD, POST = (226, 229, 232), (150, 158, 166)

_BEAD_MM, _SIDES = 1.5, 28  # of display surfaces

LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
TABLE, STAND, CAMERA, PEDESTAL = "table", "stand", "camera", "pedestal"


@dataclass(frozen=True, eq=False)
class Part:
    """One solid. ``size_mm``: of a box x, y, z; of a cylinder along z radius, length; of a ball
    its radius. ``use``: for collisions, pictures, or both."""

    name: str
    link: str
    kind: Literal["box", "cylinder", "ball"]
    size_mm: tuple[float, ...]
    link_from_part: Pose
    colour: Colour
    use: Use = "both"

    @property
    def name_in_cell(self) -> str:
        """``cutter/forearm``, ``table``."""
        return self.name if self.link == TABLE else f"{self.link.split('_')[0]}/{self.name}"


class _Girth(NamedTuple):
    """Radii of one type of arm, and its links' offsets along their joints' axes, mm."""

    base: float
    joint: float
    tube: float
    forearm: float
    wrist: float
    upper_offset: float
    forearm_offset: float


_GIRTHS = {
    "ur5": _Girth(75.0, 60.0, 46.0, 42.0, 40.0, 136.0, 16.5),
    "ur10e": _Girth(95.0, 78.0, 60.0, 52.0, 56.0, 176.0, 39.3),
}


def _rod(
    name: str, link: str, ends_mm: _Ends, radius_mm: float, colour: Colour, use: Use = "both"
) -> Part:
    """A cylinder between two points of its link."""
    start, end = np.array(ends_mm, float)
    length = float(np.linalg.norm(end - start))
    turn = rotation_onto(np.array([0.0, 0.0, 1.0]), end - start)
    place = rigid(turn, (start + end) / 2)
    return Part(name, link, "cylinder", (radius_mm, length), place, colour, use)


def _arm_parts(arm: str, model: ArmModel) -> list[Part]:
    """The seven links of an arm: one enclosing cylinder each, and finer ones for display."""
    g, (_, a2, a3, *_) = _GIRTHS[model.name], model.a_mm
    d1, _, _, d4, d5, d6 = model.d_mm
    up, low, r, w = g.upper_offset, g.forearm_offset, g.joint, g.wrist
    cap = up + 0.9 * r
    solid: Use = "collision"
    look: Use = "picture"
    rows: list[tuple[str, str, _Ends, float, Colour, Use]] = [
        ("base", "base", ((0, 0, 0), (0, 0, d1 - r)), g.base, DARK, "both"),
        ("shoulder", "shoulder", ((0, r, d1), (0, r - up, d1)), r, GREY, solid),
        ("shoulder", "shoulder", ((0, 0, d1 - r), (0, 0, d1 + 0.8 * r)), r, GREY, look),
        ("shoulder_side", "shoulder", ((0, 0, d1), (0, r - up, d1)), 0.9 * r, GREY, look),
        ("shoulder_cap", "shoulder", ((0, 0, d1 + 0.8 * r), (0, 0, d1 + r)), 0.9 * r, BLUE, look),
        ("upper_arm", "upper_arm", ((r, 0, up), (a2 - r, 0, up)), r, GREY, solid),
        ("upper_arm", "upper_arm", ((0, 0, up), (a2, 0, up)), g.tube, GREY, look),
        ("upper_arm_joint", "upper_arm", ((0, 0, up - r), (0, 0, up + 0.8 * r)), r, GREY, look),
        ("upper_arm_cap", "upper_arm", ((0, 0, up + 0.8 * r), (0, 0, up + r)), 0.9 * r, BLUE, look),
        ("elbow", "upper_arm", ((a2, 0, up - r), (a2, 0, up + 0.7 * r)), 0.9 * r, GREY, look),
        ("elbow_cap", "upper_arm", ((a2, 0, up + 0.7 * r), (a2, 0, cap)), 0.8 * r, BLUE, look),
        ("forearm", "forearm", ((w, 0, low), (a3 - w, 0, low)), g.forearm, GREY, solid),
        ("forearm", "forearm", ((0, 0, low), (a3, 0, low)), 0.85 * g.forearm, GREY, look),
        ("forearm_joint", "forearm", ((0, 0, up - r), (0, 0, low - 0.8 * w)), 0.85 * r, GREY, look),
        ("forearm_end", "forearm", ((a3, 0, low - w), (a3, 0, low + w)), w, GREY, look),
        ("wrist_1", "wrist_1", ((0, 0, low), (0, 0, d4 + w)), w, GREY, solid),
        ("wrist_1", "wrist_1", ((0, 0, low + w), (0, 0, d4 + 0.8 * w)), 0.95 * w, GREY, look),
        ("wrist_1_cap", "wrist_1", ((0, 0, d4 + 0.8 * w), (0, 0, d4 + w)), 0.85 * w, BLUE, look),
        ("wrist_2", "wrist_2", ((0, 0, -w), (0, 0, d5 + w)), w, GREY, solid),
        ("wrist_2", "wrist_2", ((0, 0, -0.9 * w), (0, 0, d5 + 0.8 * w)), 0.95 * w, GREY, look),
        ("wrist_2_cap", "wrist_2", ((0, 0, d5 + 0.8 * w), (0, 0, d5 + w)), 0.85 * w, BLUE, look),
        ("wrist_3", "wrist_3", ((0, 0, 0.3 * w), (0, 0, d6)), 0.9 * w, DARK, "both"),
    ]
    return [
        _rod(name, f"{arm}_{link}_link", ends, radius, colour, use)
        for name, link, ends, radius, colour, use in rows
    ]


def _tool_parts(config: CellConfig) -> list[Part]:
    """Instrument and grasper, on their arms' flanges (z out of the flange)."""
    hand, ahead, down = f"{CUTTER}_tool", config.pencil_mm, config.bracket_mm
    end = config.flange_from_tip(CUTTER)[:3, 3].tolist()
    grasper, shaft, cup = f"{HOLDER}_tool", config.rod_mm - config.cup_mm, config.cup_radius_mm
    wire = ELECTRODE_RADIUS_MM
    return [
        _rod("bracket", hand, ((0, 0, 0), (0, 0, down)), 10.0, STEEL),
        _rod("pencil", hand, ((-10, 0, down), (ahead, 0, down)), PENCIL_RADIUS_MM, BLUE),
        _rod("electrode", hand, ((ahead, 0, down), tuple(end)), wire, YELLOW),
        _rod("rod", grasper, ((0, 0, 0), (0, 0, shaft)), 6.0, STEEL),
        _rod("cup", grasper, ((0, 0, shaft), (0, 0, config.rod_mm)), cup, CUP),
    ]


def _surroundings(config: CellConfig) -> list[Part]:
    """Table, the organ's post, pedestals, and a camera that is an obstacle."""
    middle, (x, y, top) = np.array(config.middle_mm), config.middle_mm
    slab = rigid(np.eye(3), middle - [0.0, 0.0, 20.0])
    post = ((x, y, top), (x, y, top + config.stand_mm - STAND_GAP_MM))
    parts = [
        Part(TABLE, TABLE, "box", (*config.table_mm, 40.0), slab, WOOD),
        _rod(STAND, TABLE, post, config.stand_radius_mm, POST),
    ]
    for arm in ARMS:
        x, y, z = config.base(arm).position_mm
        if z > top:
            radius = 1.15 * _GIRTHS[config.model(arm).name].base
            parts.append(_rod(f"{arm}/{PEDESTAL}", TABLE, ((x, y, top), (x, y, z)), radius, POST))
    if config.camera_is_obstacle:
        place = rigid(np.eye(3), middle + config.camera_mm)
        parts.append(Part(CAMERA, TABLE, "box", (42.0, 23.0, 42.0), place, DARK))
    return parts


def cell_parts(config: CellConfig) -> tuple[Part, ...]:
    """Everything that the workcell is made of."""
    arms = (part for arm in ARMS for part in _arm_parts(arm, config.model(arm)))
    return (*_surroundings(config), *arms, *_tool_parts(config))


def display_surfaces(config: CellConfig) -> list[tuple[Part, Mesh]]:
    """The visible parts, each with its surface in its link's frame, and a bead at each tip."""
    parts = [part for part in cell_parts(config) if part.use != "collision"]
    parts += [Part("tip", f"{arm}_tip", "ball", (_BEAD_MM,), np.eye(4), YELLOW) for arm in ARMS]
    return [(part, _surface(part)) for part in parts]


def _surface(part: Part) -> Mesh:
    from trimesh import creation

    if part.kind == "ball":
        solid = creation.icosphere(1, *part.size_mm)
    elif part.kind == "box":
        solid = creation.box(part.size_mm)
    else:
        radius, length = part.size_mm
        solid = creation.cylinder(radius, length, sections=_SIDES)
    return Mesh(transform_points(part.link_from_part, np.array(solid.vertices)), solid.faces)


def cell_urdf(config: CellConfig) -> str:
    """All links and joints, of primitive shapes only; the root is ``table``. Joints that move
    are named as in ``motions.JOINTS``; ``cutter_tip`` and ``holder_tip`` are the tips' frames.
    Lengths in metres, as URDF wants them."""
    robot = ET.Element("robot", name="tumortrack_cell")
    ET.SubElement(robot, "link", name=TABLE)
    for arm in ARMS:
        base, flange, tool, tip = (f"{arm}_{end}" for end in ("base_link", "flange", "tool", "tip"))
        _add_arm(robot, config.model(arm), arm)
        _add_mount(robot, TABLE, base, config.base(arm).table_from_base)
        for link in (tool, tip):
            ET.SubElement(robot, "link", name=link)
        _add_mount(robot, flange, tool, np.eye(4))
        _add_mount(robot, tool, tip, config.flange_from_tip(arm))
    links = {link.get("name"): link for link in robot.iter("link")}
    for part in cell_parts(config):
        for role, unused in (("visual", "collision"), ("collision", "picture")):
            if part.use != unused:
                _add_solid(links[part.link], part, role)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _add_arm(robot: ET.Element, model: ArmModel, arm: str) -> None:
    """Links and joints named ``ARM_...``, from ``ARM_base_link`` to ``ARM_flange``."""
    links = [*(f"{arm}_{link}_link" for link in LINKS), f"{arm}_flange"]
    for link in links:
        ET.SubElement(robot, "link", name=link)
    rows = [(0.0, 0.0, 0.0), *zip(model.a_mm, model.d_mm, model.alpha_rad, strict=True)]
    names = [*UR_JOINTS, "flange_joint"]
    for n, (name, ends, row) in enumerate(zip(names, itertools.pairwise(links), rows, strict=True)):
        turns = n < len(UR_JOINTS)
        joint = _add_joint(robot, f"{arm}_{name}", "revolute" if turns else "fixed", *ends)
        a, d, alpha = row
        _add_origin(joint, np.array([a, 0.0, d]), [alpha, 0.0, 0.0])
        if turns:
            ET.SubElement(joint, "axis", xyz="0 0 1")
            lower, upper = repr(float(-model.limits_rad[n])), repr(float(model.limits_rad[n]))
            speed = repr(float(model.speeds_rad_s[n]))
            # The effort is the base joint's of the larger arm; nothing here computes with it.
            limit = {"lower": lower, "upper": upper, "effort": "330", "velocity": speed}
            ET.SubElement(joint, "limit", limit)


def _add_joint(robot: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _add_mount(robot: ET.Element, parent: str, child: str, place: np.ndarray) -> None:
    _add_place(_add_joint(robot, f"{child}_mount", "fixed", parent, child), place)


def _add_place(element: ET.Element, place: Pose) -> None:
    """A rigid transform (mm) as the origin of an element."""
    from pinocchio.rpy import matrixToRpy

    _add_origin(element, place[:3, 3], matrixToRpy(place[:3, :3]))


def _add_origin(element: ET.Element, xyz_mm: np.ndarray, rpy_rad: Iterable[float]) -> None:
    ET.SubElement(element, "origin", xyz=_numbers(xyz_mm / 1000), rpy=_numbers(rpy_rad))


def _add_solid(link: ET.Element, part: Part, role: str) -> None:
    element = ET.SubElement(link, role, name=f"{part.link}/{part.name}")
    _add_place(element, part.link_from_part)
    geometry = ET.SubElement(element, "geometry")
    if part.kind == "box":
        ET.SubElement(geometry, "box", size=_numbers(np.array(part.size_mm) / 1000))
    else:
        radius, length = (repr(size / 1000) for size in part.size_mm)
        ET.SubElement(geometry, "cylinder", radius=radius, length=length)
    if role == "visual":
        name = "colour_{:02x}{:02x}{:02x}".format(*part.colour)
        material = ET.SubElement(element, "material", name=name)
        rgba = [channel / 255 for channel in part.colour] + [1.0]
        ET.SubElement(material, "color", rgba=_numbers(rgba))


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
