"""The workcell's URDF from the makers' numbers, with primitive shapes only: no mesh files to find.

Each Denavit-Hartenberg row becomes the origin of the joint that follows it. Lengths in metres, as
URDF wants them.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import numpy as np

from tumortrack.live.sinks.ur import UR_JOINTS
from tumortrack.plan.arms.body import LINKS, TABLE, Part, cell_parts
from tumortrack.plan.arms.config import CellConfig
from tumortrack.plan.arms.kinematics import ArmModel, Pose
from tumortrack.plan.motions import ARMS


def cell_urdf(config: CellConfig) -> str:
    """Table, stand, camera and both arms with their tools; the root is ``table``.

    Joints that move are named as in ``plan.motions.JOINTS``; ``cutter_tip`` and ``holder_tip`` are
    the tips' frames.
    """
    robot = ET.Element("robot", name="tumortrack_cell")
    ET.SubElement(robot, "link", name=TABLE)
    for arm in ARMS:
        _add_arm(robot, config.model(arm), arm)
        _add_mount(robot, TABLE, f"{arm}_base_link", config.base(arm).table_from_base)
        for link in ("tool", "tip"):
            ET.SubElement(robot, "link", name=f"{arm}_{link}")
        _add_mount(robot, f"{arm}_flange", f"{arm}_tool", np.eye(4))
        _add_mount(robot, f"{arm}_tool", f"{arm}_tip", config.flange_from_tip(arm))
    _add_solids(robot, cell_parts(config))
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
    turn = place[:3, :3]
    level = np.hypot(turn[0, 0], turn[1, 0])
    if level > 1e-9:
        roll, yaw = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
    else:  # the x-axis stands upright: one of the two angles is free
        roll, yaw = np.arctan2(-turn[1, 2], turn[1, 1]), 0.0
    _add_origin(element, place[:3, 3], [roll, np.arctan2(-turn[2, 0], level), yaw])


def _add_origin(element: ET.Element, xyz_mm: np.ndarray, rpy_rad: Iterable[float]) -> None:
    ET.SubElement(element, "origin", xyz=_numbers(xyz_mm / 1000), rpy=_numbers(rpy_rad))


def _add_solids(robot: ET.Element, parts: Iterable[Part]) -> None:
    """Every part becomes a visual, a collision or both of its link."""
    links = {link.get("name"): link for link in robot.iter("link")}
    for part in parts:
        for role, unused in (("visual", "collision"), ("collision", "picture")):
            if part.use == unused:
                continue
            element = ET.SubElement(links[part.link], role, name=f"{part.link}/{part.name}")
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
