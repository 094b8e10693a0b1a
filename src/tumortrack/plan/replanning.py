"""Planning in a process of its own, beside the live loop: what that process does."""

from __future__ import annotations

import signal

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import NoPlan
from tumortrack.plan.arms.cell import ArmCell
from tumortrack.plan.arms.config import CellConfig
from tumortrack.plan.arms.procedure import plan_motions
from tumortrack.plan.config import ResectionConfig
from tumortrack.plan.operation import Planned, ResectionProgress
from tumortrack.plan.resection import plan_resection
from tumortrack.plan.values import Located

_given: list[tuple[ResectionConfig, ArmCell]] = []


def begin(config: ResectionConfig, cell: CellConfig) -> None:
    """Called once in the new process. Ctrl-C is the live loop's affair, not ours."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _given.append((config, ArmCell(cell)))


def ready() -> None:
    """Returns when the process has begun and has loaded what is slow to load."""
    import ruckig  # noqa: F401
    import toppra  # noqa: F401


def plan_anew(
    seen: Located, joints_rad: Float64[np.ndarray, " 12"], progress: ResectionProgress
) -> Planned:
    """The plan for the organ as it lies now, from where the arms are; see ``plan_motions``.

    Raises:
        NoPlan: there is none.
    """
    config, cell = _given[0]
    resection = plan_resection(seen, config)
    organ = seen.meshes.get("kidney")
    if organ is None:
        raise NoPlan("the organ's surface was not found")
    motions = plan_motions(
        resection,
        cell.with_organ(organ),
        organ,
        start_rad=joints_rad,
        from_sweep=progress.first_sweep(resection, seen.meshes[resection.tumor]),
    )
    return Planned(resection, seen.meshes, motions)
