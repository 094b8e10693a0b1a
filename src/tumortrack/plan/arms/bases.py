"""Other places for the arms' bases, where a plan is out of reach from where they stand."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import msgspec
import numpy as np

from tumortrack.core.errors import NoPlan
from tumortrack.core.types import Mesh
from tumortrack.plan.arms.cell import ArmCell, PlanningGroup
from tumortrack.plan.arms.config import Base, CellConfig
from tumortrack.plan.arms.kinematics import level_pose
from tumortrack.plan.arms.procedure import plan_motions
from tumortrack.plan.motions import ARMS, CUTTER, HOLDER, Motions
from tumortrack.plan.values import ResectionPlan

# Round the organ: how far off the base stands, as a share of the arm's reach, and on which side
# (degrees from where it stands now). The first are tried first.
_DISTANCES = (0.65, 0.5, 0.8)
_SIDES_DEG = (0.0, 30.0, -30.0, 60.0, -60.0)
_YAWS = 8  # in which the instrument is asked to reach
_MOST_TRIED = 8  # pairs of places for which motions are planned
_EDGE_MM = 120.0  # a base's middle is no nearer to the table's edge


def search_bases(
    plan: ResectionPlan, config: CellConfig, organ: Mesh, seed: int = 0
) -> tuple[ArmCell, Motions, str]:
    """The motions from where the arms stand, or else from elsewhere round the table.

    A small fixed grid of places for both bases, on their pedestals and facing as they do: first
    those within reach of every stroke, near to where the arms stand now; then the first for which
    the whole procedure can be planned.

    Returns:
        The cell (with the organ) that serves, the motions, and what was changed, for the user:
        empty where nothing was.

    Raises:
        NoPlan: from none of them; the reason is that of the places they stand in.
    """
    cell = ArmCell(config, organ)
    try:
        return cell, plan_motions(plan, cell, organ, seed=seed), ""
    except NoPlan as failure:
        reason = failure
    for elsewhere in itertools.islice(_elsewhere(plan, config), _MOST_TRIED):
        cell = ArmCell(elsewhere, organ)
        if cell.collisions(cell.home_rad) is not None:
            continue
        try:
            motions = plan_motions(plan, cell, organ, seed=seed)
        except NoPlan:
            continue
        return cell, motions, _note(elsewhere)
    raise NoPlan(f"{reason} Other places for the arms round the table were tried in vain.")


def _elsewhere(plan: ResectionPlan, config: CellConfig) -> Iterator[CellConfig]:
    """Configurations in which both arms reach all they have to, the least change first."""
    # Ends and middles of all strokes
    strokes = np.concatenate([cut.path_mm[[0, len(cut.path_mm) // 2, -1]] for cut in plan.cuts])
    targets = {CUTTER: strokes, HOLDER: plan.grasp_mm[None] + [[0, 0, 0], [0, 0, 60.0]]}
    good: dict[str, list[Base]] = {}
    for arm in ARMS:
        places = _places(config, arm, plan.grasp_mm[:2])
        good[arm] = [base for base in places if _reaches(_with(config, {arm: base}), arm, targets)]
    pairs = itertools.product(enumerate(good[CUTTER]), enumerate(good[HOLDER]))
    for (_, cutter), (_, holder) in sorted(pairs, key=lambda pair: pair[0][0] + pair[1][0]):
        yield _with(config, {CUTTER: cutter, HOLDER: holder})


def _places(config: CellConfig, arm: str, middle_mm: np.ndarray) -> list[Base]:
    """Where this arm could stand on the table, its present place first."""
    now = config.base(arm)
    off = np.array(now.position_mm[:2]) - middle_mm
    facing = np.arctan2(off[1], off[0])
    half = np.array(config.table_mm) / 2 - _EDGE_MM
    bases = [now]
    for side, share in itertools.product(_SIDES_DEG, _DISTANCES):
        angle = facing + np.radians(side)
        far = share * config.model(arm).reach_mm
        x, y = middle_mm + far * np.array([np.cos(angle), np.sin(angle)])
        if abs(x - config.middle_mm[0]) <= half[0] and abs(y - config.middle_mm[1]) <= half[1]:
            place = (round(float(x)), round(float(y)), now.position_mm[2])
            bases.append(Base(position_mm=place, yaw_deg=now.yaw_deg + side))
    return bases


def _reaches(config: CellConfig, arm: str, targets_mm: dict[str, np.ndarray]) -> bool:
    """Whether the arm's tip comes to all its targets, each time pointing in any direction."""
    cell = ArmCell(config)
    group = PlanningGroup(cell, arm, cell.home_rad)
    yaws = np.linspace(0, 2 * np.pi, _YAWS if arm == CUTTER else 1, endpoint=False)
    return all(
        any(len(group.inverse_kinematics(level_pose(target, yaw))) for yaw in yaws)
        for target in targets_mm[arm]
    )


def _with(config: CellConfig, bases: dict[str, Base]) -> CellConfig:
    return msgspec.structs.replace(config, **{f"{arm}_base": base for arm, base in bases.items()})


def _note(config: CellConfig) -> str:
    places = []
    for arm in ARMS:
        base = config.base(arm)
        x, y, z = base.position_mm
        places.append(
            f"{arm}'s base at ({x:g}, {y:g}, {z:g}) mm, turned by {base.yaw_deg:g} degrees"
        )
    return f"the arms do not manage from where they stand; planned with the {', the '.join(places)}"
