"""A plan with what the check of its finished motions found, or none."""

from __future__ import annotations

from dataclasses import replace

from tumortrack.core.errors import NoPlan
from tumortrack.core.organ import is_tumor, organ_name
from tumortrack_resection import check
from tumortrack_resection.motions import WITHDRAW, Motions
from tumortrack_resection.values import CUTS_TUMOR, Located, ResectionPlan


def checked(plan: ResectionPlan, motions: Motions, urdf: str, located: Located) -> ResectionPlan:
    """The plan with its ``clearances``. ``urdf``: cell.urdf; ``located``: what it was planned on.

    Raises NoPlan: a tool comes nearer to something than it may. The paper's method is not refused,
    but says what it does to the tumor. An instrument that withdraws from where it was halted is not
    checked: it goes straight back.
    """
    if motions.stages[0].name == WITHDRAW:
        motions = Motions(motions.stages[1:])
    surfaces = {**located.meshes, **located.structures}
    organ = organ_name(located.meshes)
    parts = {name: mesh for name, mesh in surfaces.items() if name != organ}
    found = check.clearances(urdf, motions, parts, plan.taken)
    published = plan.method == "published"
    needed = {name: plan.margin_mm for name in plan.taken if not published} | plan.keep_mm
    if faults := check.faults(found, needed, plan.taken):
        raise NoPlan(f"{faults[0]} Ask for another margin, or place the organ otherwise.")
    plan = replace(plan, clearances=found)
    harm = [
        f"{CUTS_TUMOR} {name}, up to {-mm:.1f} mm deep"
        for name, mm in plan.least_mm.items()
        if mm < 0 and is_tumor(name)
    ]
    touched = [
        f"the {each.solid} touches {each.part}" for each in found
        if each.least_mm <= 0 and each.solid not in check.IN_TISSUE and each.part in plan.taken
    ]  # fmt: skip
    notes = [*(f"{words}." for words in harm), *plan.notes, *(f"{words}." for words in touched)]
    return replace(plan, notes=tuple(notes))
