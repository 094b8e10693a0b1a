"""The workcell as one value: two arms, their tools, table, stand and camera."""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack_resection.arms.kinematics import MODELS, ArmModel, Pose, level_pose
from tumortrack_resection.facets import Tools
from tumortrack_resection.motions import ARMS, CUTTER, JOINTS, Joints

PENCIL_RADIUS_MM, ELECTRODE_RADIUS_MM = 6.5, 1.2
STAND_GAP_MM = 3.0  # between the organ's lowest point and what carries it
_DOWN = np.diag([1.0, -1.0, -1.0])  # a flange that points down, over a tip whose z is up
_LENGTHS = (
    *("bracket_mm", "pencil_mm", "electrode_mm", "rod_mm", "cup_mm", "cup_radius_mm"),
    *("stand_mm", "stand_radius_mm", "cutting_mm_s", "grasping_mm_s"),
)
_ALLOWED: dict[str, tuple[float, float]] = {
    **dict.fromkeys(_LENGTHS, (0, 1000)),
    **dict.fromkeys(("clearance_mm", "organ_clearance_mm", "contact_mm"), (0.5, 100)),
    "speed_share": (0, 1),
    "tool_error_mm": (0, 50),
}


class Base(Config, frozen=True, kw_only=True):
    """An arm's base in the table frame: its middle, turned about the vertical."""

    position_mm: tuple[float, float, float]
    yaw_deg: float

    @property
    def table_from_base(self) -> Pose:
        return level_pose(np.array(self.position_mm), np.radians(self.yaw_deg))


class CellConfig(Config, frozen=True, kw_only=True):
    """What stands where; table frame, mm.

    Attributes:
        cutter_base, holder_base: where they stand, on pedestals if above the table.
        bracket_mm, pencil_mm, electrode_mm: the instrument hangs so far below the flange; its grip
            reaches so far ahead, and then the bare electrode, level or by ``bend_deg`` downward.
        rod_mm, cup_mm, cup_radius_mm: the grasper hangs straight down; its end is a soft cup.
        home_rad: all twelve joints in the order of ``JOINTS``.
        middle_mm: of the table's top, straight below the organ; ``table_mm``: its size, x and y.
        stand_mm: height of the organ's lowest point above it; ``stand_radius_mm``: of the post.
        camera_mm: the camera's middle over ``middle_mm``, if ``camera_is_obstacle``: by default it
            is assumed to be swung away, as the arms work where it is.
        clearance_mm: the arms' least distance from each other, themselves and all that stands;
            ``organ_clearance_mm``: from the organ, except for electrode and cup at work;
            ``contact_mm``: of the electrode from the soft cup then.
        cutting_mm_s: the tip's maximum speed on a cut and in tissue; ``grasping_mm_s``: on the
            straight path to the grasp and back. ``speed_share``: of the maker's joint speeds.
        pull_mm: the holder rises so far once it holds, so that the tissue is taut when it is cut.
        tool_error_mm: largest error of a tool's tip at its planned place, loads included.
    """

    cutter_model: Literal["ur10e", "ur5"] = "ur10e"
    holder_model: Literal["ur10e", "ur5"] = "ur5"
    cutter_base: Base = Base(position_mm=(850.0, 0.0, 100.0), yaw_deg=0.0)
    holder_base: Base = Base(position_mm=(-520.0, 0.0, 150.0), yaw_deg=180.0)
    bracket_mm: float = 110.0
    pencil_mm: float = 110.0
    electrode_mm: float = 70.0
    bend_deg: float = 0.0
    rod_mm: float = 200.0
    cup_mm: float = 20.0
    cup_radius_mm: float = 8.0
    home_rad: tuple[float, ...] = (
        *(-0.490, -2.077, 2.569, -2.063, -np.pi / 2, -2.061),
        *(-0.416, -2.132, 1.865, -1.304, -np.pi / 2, -0.416),
    )
    middle_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    table_mm: tuple[float, float] = (2000.0, 1000.0)
    stand_mm: float = 120.0
    stand_radius_mm: float = 20.0
    camera_mm: tuple[float, float, float] = (0.0, 0.0, 320.0)
    camera_is_obstacle: bool = False
    clearance_mm: float = 8.0
    organ_clearance_mm: float = 3.0
    contact_mm: float = 1.5
    cutting_mm_s: float = 10.0
    grasping_mm_s: float = 25.0
    speed_share: float = 0.5
    pull_mm: float = 0.0
    tool_error_mm: float | None = None

    def __post_init__(self) -> None:
        if len(self.home_rad) != len(JOINTS):
            raise InputError(f"home has {len(self.home_rad)} joints; give {len(JOINTS)} angles.")
        for name, (low, high) in _ALLOWED.items():
            value = getattr(self, name)
            if value is not None and not (0 < value < 1000 and low <= value <= high):
                allowed = f"{low or 'over 0'} to {high}"
                raise InputError(f"cell: {name} is {value:g}; allowed: {allowed}.")
        self.check_between("cell:", table_mm=(100, 10_000), pull_mm=(0, 20), bend_deg=(0, 90))
        places = (*self.middle_mm, *self.camera_mm, *self.home_rad)
        for base in (self.cutter_base, self.holder_base):
            places += (*base.position_mm, base.yaw_deg)
        if not np.isfinite(places).all() or np.abs(places).max() > 10_000:
            raise InputError("cell: places must be finite and within 10000 mm, angles finite.")
        if self.cup_mm >= self.rod_mm:
            raise InputError("cell: the cup must be shorter than the rod that ends in it.")

    @property
    def tools(self) -> Tools:
        x, y, z = self.middle_mm
        # The post ends a little below the organ, which must not count as touched by its support.
        stand = (x, y, z + self.stand_mm - STAND_GAP_MM, self.stand_radius_mm)
        return Tools(
            self.electrode_mm, ELECTRODE_RADIUS_MM, self.cup_radius_mm, stand,
            self.organ_clearance_mm,
        )  # fmt: skip

    def model(self, arm: str) -> ArmModel:
        return MODELS[self.cutter_model if arm == CUTTER else self.holder_model]

    @property
    def limits_rad(self) -> Joints:
        """Of all twelve joints, in both directions."""
        return np.concatenate([self.model(arm).limits_rad for arm in ARMS])

    @property
    def speeds_rad_s(self) -> Joints:
        """The maximum planned with, of all twelve joints."""
        return self.speed_share * np.concatenate([self.model(arm).speeds_rad_s for arm in ARMS])

    def base(self, arm: str) -> Base:
        return self.cutter_base if arm == CUTTER else self.holder_base

    def least_clearance_mm(self, touching: Collection[str]) -> float:
        """Of any pair: the tools come nearest to each other where both arms may touch the organ."""
        contact_mm = self.contact_mm if len(touching) == len(ARMS) else np.inf
        return min(self.clearance_mm, self.organ_clearance_mm, contact_mm)

    def flange_from_tip(self, arm: str) -> Pose:
        """The instrument points along x, and is level where z is up: where the flange points
        down, or by ``bend_deg`` off it."""
        if arm == CUTTER:
            turn = _DOWN @ Rotation.from_euler("y", self.bend_deg, degrees=True).as_matrix()
            grip_mm = np.array([self.pencil_mm, 0.0, self.bracket_mm])
            return rigid(turn, grip_mm + self.electrode_mm * turn[:, 0])
        return rigid(_DOWN, np.array([0.0, 0.0, self.rod_mm]))
