"""Where on the organ a tip of the arms can touch it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tumortrack.core.types import Mesh
from tumortrack.registration.advice import Place
from tumortrack_resection.arms.cell import ArmCell, PlanningGroup
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.arms.kinematics import Pose, level_pose
from tumortrack_resection.motions import CUTTER, HOLDER, Joints

_FACING = 0.5  # cosine from a tool's way back to the surface's normal: a flatter tip slides off
_YAWS = 8  # directions from which the electrode comes; the cup always comes from above


class ArmsReach:
    """Whether one of the tips can touch the organ (``organ``: its surface, table frame) while the
    other arm stays where it is: without a collision there. The way there is not planned."""

    def __init__(self, config: CellConfig, organ: Mesh, joints_rad: Joints) -> None:
        self._cell, self._joints_rad = ArmCell(config, organ), joints_rad

    def __call__(self, place_mm: Place, normal: Place) -> bool:
        """A place of its surface, and the outward normal there; table frame, mm."""
        return any(self._free(arm, pose) for arm, pose in _touching(place_mm, normal))

    def _free(self, arm: str, table_from_tip: Pose) -> bool:
        group = PlanningGroup(self._cell, arm, self._joints_rad, touching=(arm,))
        branches = group.inverse_kinematics(table_from_tip)
        return any(group.collides(branch) is None for branch in branches)


def _touching(place_mm: Place, normal: Place) -> Iterator[tuple[str, Pose]]:
    """Arms with poses of their tips there that face the surface."""
    if normal[2] > _FACING:
        yield HOLDER, level_pose(place_mm, 0.0)
    for yaw in np.linspace(0, 2 * np.pi, _YAWS, endpoint=False):
        if normal @ [-np.cos(yaw), -np.sin(yaw), 0.0] > _FACING:
            yield CUTTER, level_pose(place_mm, yaw)
