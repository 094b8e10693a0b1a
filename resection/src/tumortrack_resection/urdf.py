"""Both arms as ``cell.urdf`` has them: kinematics, and the solids of their tools. Read from the
text alone: who checks motions by it depends on no mistake of the planner that wrote it. Lengths
in mm."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import ArtifactError
from tumortrack.core.geometry import rigid
from tumortrack_resection.motions import JOINTS
from tumortrack_resection.values import ELECTRODE

_TABLE, GRASPER = "table", "holder_tip"
_TOOLS = {"cutter_tool": {"bracket", "pencil", ELECTRODE}, "holder_tool": {"rod", "cup"}}

Configurations = Float64[np.ndarray, "n 12"]
Ends = Float64[np.ndarray, "n 2 3"]  # of a solid's axis, first the one nearer the tool's tip
Frames = tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3"]]  # how turned, and where


@dataclass(frozen=True, eq=False)
class ToolSolid:
    """A cylinder, the ends of its axis in the frame of its link."""

    name: str
    link: str
    ends_mm: Float64[np.ndarray, "2 3"]
    radius_mm: float


class UrdfCell:
    """Both arms' joints, and the ``solids`` of their tools. ``reach_mm``: no end of a solid is
    farther from the table's origin or from the holder's tip. ArtifactError: the text is no URDF,
    or of other joints or tools."""

    def __init__(self, text: str) -> None:
        try:
            robot = ET.fromstring(text)
            above = {_of(joint, "child", "link"): joint for joint in robot.iter("joint")}
            links = [*_TOOLS, *(tool.replace("tool", "tip") for tool in _TOOLS)]
            self._chains = {link: _chain(dict(above), link) for link in links}
            self.solids = [
                self._solid(link.attrib["name"], element)
                for link in robot.iter("link")
                for element in link.iter("collision")
                if link.get("name") in _TOOLS
            ]
        except (ET.ParseError, KeyError, ValueError) as error:
            raise ArtifactError(f"the cell's URDF cannot be understood: {error!r}.") from None
        for tool, needed in _TOOLS.items():
            if lacking := needed - {solid.name for solid in self.solids if solid.link == tool}:
                raise ArtifactError(f"the cell's URDF lacks {sorted(lacking)} on {tool}.")
        hops = [hop[:3, 3] for link in ("cutter_tool", GRASPER) for hop, _ in self._chains[link]]
        longest_mm = max(np.linalg.norm(solid.ends_mm, axis=1).max() for solid in self.solids)
        self.reach_mm = float(np.linalg.norm(hops, axis=1).sum() + longest_mm)

    def _solid(self, link: str, element: ET.Element) -> ToolSolid:
        keys = ("length", "radius")
        length_mm, radius_mm = (1000 * float(_of(element, "geometry/cylinder", k)) for k in keys)
        if not (0 < length_mm < np.inf and 0 < radius_mm < np.inf):
            raise ValueError(f"a solid of {link} has no size")
        place, tip = _origin(element), self._chains[link.replace("tool", "tip")][-1][0]
        ends_mm = place[:3, 3] + np.array([[0.5], [-0.5]]) * length_mm * place[:3, 2]
        nearer = np.argsort(np.linalg.norm(ends_mm - tip[:3, 3], axis=1))
        name = element.attrib["name"].removeprefix(f"{link}/")
        return ToolSolid(name, link, ends_mm[nearer], radius_mm)

    def frames(self, link: str, joints_rad: Configurations) -> Frames:
        """``table_from_link`` (n)."""
        # Long rows of each axis' coordinates: five times faster than n products of matrices.
        axes = np.tile(np.eye(3)[..., None], len(joints_rad))
        at_mm = np.zeros((3, len(joints_rad)))
        for parent_from_child, joint in self._chains[link]:
            at_mm += np.einsum("a,acn->cn", parent_from_child[:3, 3], axes)
            x, y, z = np.einsum("ab,acn->bcn", parent_from_child[:3, :3], axes)
            if joint:
                angle = joints_rad[:, JOINTS.index(joint)]
                cos, sin = np.cos(angle), np.sin(angle)
                x, y = cos * x + sin * y, cos * y - sin * x
            axes = np.stack([x, y, z])
        return axes.transpose(2, 1, 0), at_mm.T

    def ends(self, solids: Sequence[ToolSolid], joints_rad: Configurations) -> list[Ends]:
        """Of the axes of solids; table frame."""
        frames = {link: self.frames(link, joints_rad) for link in {one.link for one in solids}}
        places = [(solid.ends_mm, *frames[solid.link]) for solid in solids]
        return [np.einsum("ka,nca->nkc", ends, turned) + at[:, None] for ends, turned, at in places]


def _of(element: ET.Element, path: str, key: str) -> str:
    if (found := element.find(path)) is None:
        raise ValueError(f"{element.get('name')} has no {path}")
    return found.attrib[key]


def _chain(above: dict[str, ET.Element], link: str) -> list[tuple[Float64[np.ndarray, "4 4"], str]]:
    """From the table to a link: ``parent_from_child`` at zero, and the joint's name if it turns."""
    steps, below = [], link
    while below != _TABLE:
        joint = above.pop(below)  # KeyError: nothing holds it, or it holds itself
        name = joint.attrib["name"] if (turns := joint.get("type") == "revolute") else ""
        known = _of(joint, "axis", "xyz") == "0 0 1" if turns else joint.get("type") == "fixed"
        if not known or joint.find("mimic") is not None:
            raise ValueError(f"the joint of {below} is neither fixed nor turns freely about 0 0 1")
        steps.append((_origin(joint), name))
        below = _of(joint, "parent", "link")
    if [name for _, name in steps[::-1] if name] != [j for j in JOINTS if j[:6] == link[:6]]:
        raise ValueError(f"{link} does not hang on the six joints of its arm, in their order")
    return steps[::-1]


def _origin(element: ET.Element) -> Float64[np.ndarray, "4 4"]:
    """An element's place: turned by roll, pitch and yaw about the fixed axes x, y and z."""
    origin = element.find("origin")
    given = {} if origin is None else origin.attrib
    (x, y, z), rpy = np.array([given.get(key, "0 0 0").split() for key in ("xyz", "rpy")], float)
    if not np.isfinite([x, y, z, *rpy]).all():
        raise ValueError("an origin is not finite")
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return rigid(yaw @ pitch @ roll, 1000 * np.array([x, y, z]))
