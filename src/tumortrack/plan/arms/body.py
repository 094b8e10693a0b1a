"""What arms, tools and surroundings are made of: simple solids on links.

One list serves all: collisions (the plain solids that enclose), URDF and pictures. Link frames
are those of the URDF: z along the link's own joint, before its Denavit-Hartenberg transform.
Sizes are ours, rounded up from the maker's drawings; lateral offsets likewise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from tumortrack.core.geometry import rigid, rotation_onto
from tumortrack.plan.arms.config import CellConfig
from tumortrack.plan.arms.dh import ArmModel
from tumortrack.plan.motions import CUTTER, HOLDER

GREY, DARK, BLUE = (206, 210, 214), (92, 98, 106), (104, 160, 196)
STEEL, YELLOW, CUP = (176, 182, 190), (222, 190, 80), (70, 76, 92)
WOOD, POST = (226, 229, 232), (150, 158, 166)

PENCIL_RADIUS_MM, ELECTRODE_RADIUS_MM = 6.5, 1.2

LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
TABLE, STAND, CAMERA, PEDESTAL = "table", "stand", "camera", "pedestal"


@dataclass(frozen=True, eq=False)
class Part:
    """One solid on a link.

    Attributes:
        name: within its link's arm: ``forearm``, ``electrode``.
        link: the URDF's link.
        kind, size_mm: box (x, y, z) or cylinder (radius, length), its axis along z.
        link_from_part: mm.
        use: what it is for: collisions, pictures, or both.
    """

    name: str
    link: str
    kind: Literal["box", "cylinder"]
    size_mm: tuple[float, ...]
    link_from_part: Float64[np.ndarray, "4 4"]
    colour: tuple[int, int, int]
    use: Literal["both", "collision", "picture"] = "both"

    @property
    def whose(self) -> str:
        """Its name within the cell: ``cutter/forearm``, ``table``."""
        return self.name if self.link == TABLE else f"{self.link.split('_')[0]}/{self.name}"


@dataclass(frozen=True)
class _Girth:
    """Radii and lateral offsets of one type of arm, mm: offsets of upper arm and forearm along
    their joints' axes."""

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
    name: str,
    link: str,
    ends_mm: tuple[tuple[float, float, float], tuple[float, float, float]],
    radius_mm: float,
    colour: tuple[int, int, int],
    use: Literal["both", "collision", "picture"] = "both",
) -> Part:
    """A cylinder between two points of its link."""
    start, end = np.array(ends_mm, float)
    length = float(np.linalg.norm(end - start))
    turn = rotation_onto(np.array([0.0, 0.0, 1.0]), end - start)
    place = rigid(turn, (start + end) / 2)
    return Part(name, link, "cylinder", (radius_mm, length), place, colour, use)


def arm_parts(arm: str, model: ArmModel) -> tuple[Part, ...]:
    """The seven links of an arm: one enclosing cylinder each, and finer ones for the eye."""
    g, (_, a2, a3, *_) = _GIRTHS[model.name], model.a_mm
    d1, _, _, d4, d5, d6 = model.d_mm
    up, low, r, w = g.upper_offset, g.forearm_offset, g.joint, g.wrist
    solid, look = "collision", "picture"
    rows = [
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
        (
            "elbow_cap",
            "upper_arm",
            ((a2, 0, up + 0.7 * r), (a2, 0, up + 0.9 * r)),
            0.8 * r,
            BLUE,
            look,
        ),
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
    return tuple(
        _rod(name, f"{arm}_{link}_link", ends, radius, colour, use)  # type: ignore[arg-type]
        for name, link, ends, radius, colour, use in rows
    )


def tool_parts(config: CellConfig) -> tuple[Part, ...]:
    """Instrument and grasper, on their arms' flanges (z out of the flange)."""
    c, link = config, f"{CUTTER}_tool"
    ahead, down = c.pencil_mm, c.bracket_mm
    cutter = (
        _rod("bracket", link, ((0, 0, 0), (0, 0, down)), 10.0, STEEL),
        _rod("pencil", link, ((-10, 0, down), (ahead, 0, down)), PENCIL_RADIUS_MM, BLUE),
        _rod(
            "electrode",
            link,
            ((ahead, 0, down), (ahead + c.electrode_mm, 0, down)),
            ELECTRODE_RADIUS_MM,
            YELLOW,
        ),
    )
    link, shaft = f"{HOLDER}_tool", c.rod_mm - c.cup_mm
    holder = (
        _rod("rod", link, ((0, 0, 0), (0, 0, shaft)), 6.0, STEEL),
        _rod("cup", link, ((0, 0, shaft), (0, 0, c.rod_mm)), c.cup_radius_mm, CUP),
    )
    return cutter + holder


def surroundings(config: CellConfig) -> tuple[Part, ...]:
    """Table, the organ's post, the arms' pedestals and a camera in the way, in the table frame."""
    width, depth = config.table_mm
    middle = np.array(config.middle_mm)
    slab = rigid(np.eye(3), middle - [0.0, 0.0, 20.0])
    table = Part(TABLE, TABLE, "box", (width, depth, 40.0), slab, WOOD)
    # The post ends a little below the organ, which must not count as touched by its own support.
    x, y, z = config.middle_mm
    ends = ((x, y, z), (x, y, z + config.stand_mm - 3))
    post = _rod(STAND, TABLE, ends, config.stand_radius_mm, POST)
    parts = [table, post, *_pedestals(config)]
    if config.camera_is_obstacle:
        place = rigid(np.eye(3), middle + config.camera_mm)
        parts.append(Part(CAMERA, TABLE, "box", (42.0, 23.0, 42.0), place, DARK))
    return tuple(parts)


def _pedestals(config: CellConfig) -> list[Part]:
    """What bases above the table stand on."""
    pedestals = []
    for arm in (CUTTER, HOLDER):
        x, y, z = config.base(arm).position_mm
        top = config.middle_mm[2]
        if z > top:
            radius = 1.15 * _GIRTHS[config.model(arm).name].base
            ends = ((x, y, top), (x, y, z))
            pedestals.append(_rod(f"{arm}/{PEDESTAL}", TABLE, ends, radius, POST))
    return pedestals


def cell_parts(config: CellConfig) -> tuple[Part, ...]:
    """Everything that the cell is made of."""
    arms = (part for arm in (CUTTER, HOLDER) for part in arm_parts(arm, config.model(arm)))
    return (*surroundings(config), *arms, *tool_parts(config))
