"""The replanning worker: a process of its own, so that planning holds up no frame."""

from __future__ import annotations

import signal

from tumortrack.core.errors import NoPlan
from tumortrack.plan.arms.cell import ArmCell
from tumortrack.plan.arms.config import CellConfig
from tumortrack.plan.arms.procedure import plan_motions
from tumortrack.plan.config import ResectionConfig
from tumortrack.plan.motions import Joints
from tumortrack.plan.operation import Planned, ResectionProgress
from tumortrack.plan.resection import plan_resection
from tumortrack.plan.values import Located

_setting: list[tuple[ResectionConfig, ArmCell]] = []


def initialize(config: ResectionConfig, cell: CellConfig) -> None:
    """Called once in the new process. Ctrl-C is for the live loop to handle, not for the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _setting.append((config, ArmCell(cell)))


def warm_up() -> None:
    """Returns when the process has begun and has loaded what is slow to load."""
    import ruckig  # noqa: F401
    import toppra  # noqa: F401


def replan(located: Located, joints_rad: Joints, progress: ResectionProgress) -> Planned:
    """The plan for the organ as it lies now, from where the arms are; see ``plan_motions``.

    Raises:
        NoPlan: there is none.
    """
    config, cell = _setting[0]
    plan = plan_resection(located, config)
    organ = located.meshes.get("kidney")
    if organ is None:
        raise NoPlan("the organ's surface was not found")
    from_sweep = progress.first_sweep(plan, located.meshes[plan.tumor])
    motions = plan_motions(plan, cell, organ, start_rad=joints_rad, from_sweep=from_sweep)
    return Planned(plan, located.meshes, motions)
