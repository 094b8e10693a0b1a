"""A case's whole kit: its parts, and what was measured on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Direction
from tumortrack.core.types import Anatomy
from tumortrack_experiment.kit.base import Base, BaseConfig, base_design
from tumortrack_experiment.kit.checks import Check, check_base, check_mold, check_print
from tumortrack_experiment.kit.mold import MoldConfig, OrganMold, organ_mold, tumor_molds
from tumortrack_experiment.kit.recipe import Mix
from tumortrack_experiment.kit.split import fits, split_to_bed
from tumortrack_experiment.kit.stands import coupon_mold
from tumortrack_experiment.kit.values import PrintedPart


@dataclass(frozen=True, eq=False)
class Design:
    """Everything about a kit. ``molds``: the organ's, then the tumors'."""

    anatomy_ct: Anatomy
    base: Base
    base_config: BaseConfig
    molds: tuple[OrganMold, ...]
    mix: Mix
    parts: tuple[PrintedPart, ...]
    checks: tuple[Check, ...]


def design_kit(
    anatomy: Anatomy,
    up_lps: Direction,
    base_config: BaseConfig,
    mold_config: MoldConfig,
    mix: Mix,
    progress: Callable[[str], None] = lambda _: None,
) -> Design:
    """Molds, base and stands of a case, measured. ``progress`` hears what comes next. Raises
    InputError: the base does not fit the printer's bed in one piece, or what the parts' functions
    say."""
    bed = mold_config.bed_mm
    progress("base, beads and stands")
    base = base_design(anatomy, up_lps, base_config)
    plate, *standing = base.parts
    if not fits(plate, bed):
        size = " x ".join(f"{side:.0f}" for side in np.ptp(plate.mesh.box_mm, axis=0))
        raise InputError(
            f"--bed {' '.join(f'{side:g}' for side in bed)}: the base is {size} mm and must be "
            "printed in one piece, or its beads' places are not known. Take a larger printer, "
            "or fewer or smaller beads."
        )
    progress("the organ's mold")
    organ = organ_mold(anatomy, mold_config)
    progress("the tumors' molds")
    molds = (organ, *tumor_molds(anatomy, mold_config, organ.pins))
    progress("checks of all parts")
    names = ("organ", *(f"tumor {n}" for n in range(1, len(molds))))
    others = [p for part in (*standing, coupon_mold()) for p in split_to_bed(part, bed)]
    checks = [row for n, m in zip(names, molds, strict=True) for row in check_mold(n, m)]
    checks += check_base(base, base_config)
    checks += [row for part in (plate, *others) for row in check_print(part, bed)]
    parts = (*(part for mold in molds for part in mold.parts), plate, *others)
    return Design(anatomy, base, base_config, molds, mix, parts, tuple(checks))
