"""URDF texts from the makers' numbers, with primitive shapes only: no mesh files to find.

Each Denavit-Hartenberg row becomes the origin of the joint that follows it. Lengths in metres, as
URDF wants them.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.arms.body import LINKS, TABLE, Part, arm_parts, cell_parts
from tumortrack.plan.arms.config import CellConfig
from tumortrack.plan.arms.dh import ArmModel
from tumortrack.plan.motions import CUTTER, HOLDER, UR_JOINTS


def arm_urdf(model: ArmModel, prefix: str) -> str:
    """One arm alone, without a tool: links and joints are named ``prefix_...``; its root is
    ``prefix_base_link``, its last link ``prefix_flange``."""
    robot = ET.Element("robot", name=model.name)
    _add_arm(robot, model, prefix)
    _add_solids(robot, arm_parts(prefix, model))
    return _text(robot)


def cell_urdf(config: CellConfig) -> str:
    """Table, stand, camera and both arms with their tools; the root is ``table``.

    Joints that move are named as in ``plan.motions.JOINTS``; ``cutter_tip`` and ``holder_tip`` are
    the tips' frames.
    """
    robot = ET.Element("robot", name="tumortrack_cell")
    ET.SubElement(robot, "link", name=TABLE)
    for arm in (CUTTER, HOLDER):
        _add_arm(robot, config.model(arm), arm)
        _add_fixed(robot, (TABLE, f"{arm}_base_link"), config.base(arm).table_from_base)
        for link in ("tool", "tip"):
            ET.SubElement(robot, "link", name=f"{arm}_{link}")
        _add_fixed(robot, (f"{arm}_flange", f"{arm}_tool"), np.eye(4))
        _add_fixed(robot, (f"{arm}_tool", f"{arm}_tip"), config.flange_from_tip(arm))
    _add_solids(robot, cell_parts(config))
    return _text(robot)


def _add_arm(robot: ET.Element, model: ArmModel, prefix: str) -> None:
    for link in LINKS:
        ET.SubElement(robot, "link", name=f"{prefix}_{link}_link")
    ET.SubElement(robot, "link", name=f"{prefix}_flange")
    origin = ((0.0, 0.0), 0.0)
    pairs = itertools.pairwise(LINKS)
    for n, (joint, (parent, child)) in enumerate(zip(UR_JOINTS, pairs, strict=True)):
        element = _add_joint(
            robot,
            f"{prefix}_{joint}",
            "revolute",
            f"{prefix}_{parent}_link",
            f"{prefix}_{child}_link",
        )
        _origin_of_row(element, origin)
        ET.SubElement(element, "axis", xyz="0 0 1")
        limit, speed = model.limits_rad[n], model.speeds_rad_s[n]
        # The effort is the base joint's of the larger arm; nothing here computes with it.
        ET.SubElement(
            element,
            "limit",
            lower=repr(float(-limit)),
            upper=repr(float(limit)),
            effort="330",
            velocity=repr(float(speed)),
        )
        origin = ((model.a_mm[n], model.d_mm[n]), model.alpha_rad[n])
    flange = _add_joint(
        robot, f"{prefix}_flange_joint", "fixed", f"{prefix}_wrist_3_link", f"{prefix}_flange"
    )
    _origin_of_row(flange, origin)


def _add_joint(robot: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _add_fixed(robot: ET.Element, links: tuple[str, str], place: np.ndarray) -> None:
    joint = _add_joint(robot, f"{links[1]}_mount", "fixed", *links)
    _add_origin(joint, place)


def _origin_of_row(joint: ET.Element, row: tuple[tuple[float, float], float]) -> None:
    (a, d), alpha = row
    xyz = _numbers(np.array([a, 0.0, d]) / 1000)
    ET.SubElement(joint, "origin", xyz=xyz, rpy=_numbers([alpha, 0.0, 0.0]))


def _add_origin(parent: ET.Element, place: Float64[np.ndarray, "4 4"]) -> None:
    turn = place[:3, :3]
    level = np.hypot(turn[0, 0], turn[1, 0])
    if level > 1e-9:
        roll, yaw = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
    else:  # the x-axis stands upright: one of the two angles is free
        roll, yaw = np.arctan2(-turn[1, 2], turn[1, 1]), 0.0
    rpy = [roll, np.arctan2(-turn[2, 0], level), yaw]
    ET.SubElement(parent, "origin", xyz=_numbers(place[:3, 3] / 1000), rpy=_numbers(rpy))


def _add_solids(robot: ET.Element, parts: Iterable[Part]) -> None:
    """Every part becomes a visual, a collision or both of its link."""
    links = {link.get("name"): link for link in robot.iter("link")}
    for part in parts:
        for role, unused in (("visual", "collision"), ("collision", "picture")):
            if part.use == unused:
                continue
            element = ET.SubElement(links[part.link], role, name=f"{part.link}/{part.name}")
            _add_origin(element, part.link_from_part)
            geometry = ET.SubElement(element, "geometry")
            if part.kind == "box":
                ET.SubElement(geometry, "box", size=_numbers(np.array(part.size_mm) / 1000))
            else:
                radius, length = (repr(size / 1000) for size in part.size_mm)
                ET.SubElement(geometry, "cylinder", radius=radius, length=length)
            if role == "visual":
                colour = [channel / 255 for channel in part.colour] + [1.0]
                name = "colour_{:02x}{:02x}{:02x}".format(*part.colour)
                material = ET.SubElement(element, "material", name=name)
                ET.SubElement(material, "color", rgba=_numbers(colour))


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _text(robot: ET.Element) -> str:
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"
