"""What is mixed for a kit, by weight. The sheet's template holds the sources.

Stiffness depends on the PVA's grade, the rate of thawing and the cast's size more than on what can
be looked up: published ranges say how to begin, coupons say what was made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tumortrack.core.config import Config

COUPON_MM = (29.0, 12.5)  # diameter, height: test piece A of ISO 7743 (compression of rubber)
COUPONS = 3  # of each batch
COUPONS_ML = COUPONS * np.pi / 4 * COUPON_MM[0] ** 2 * COUPON_MM[1] / 1000
# g/ml: water at 20 degrees, PVA, BaSO4 (CRC Handbook of Chemistry and Physics); silicone as
# Smooth-On's data sheet of Ecoflex 00-30 has it
_WATER, _PVA, _BASO4, _SILICONE = 0.998, 1.27, 4.50, 1.07


class Mix(Config, frozen=True, kw_only=True):
    """The hydrogel, by weight. ``baso4_percent``: of the tumors, as in the paper; ``spare``: our
    choice, for what stays in jug, sprue and vents."""

    pva_percent: float = 10.0
    cycles: int = 1
    baso4_percent: float = 2.27
    spare: float = 0.10

    def __post_init__(self) -> None:
        self.check_between("mix:", pva_percent=(5, 20), cycles=(1, 8), baso4_percent=(0.5, 10))


@dataclass(frozen=True)
class Batch:
    """One of the two hydrogels, spare included; ``silicone_g``: instead, were it silicone."""

    name: str
    ml: float
    water_g: float
    pva_g: float
    baso4_g: float
    silicone_g: float


def batches(mix: Mix, organ_ml: float, tumors_ml: tuple[float, ...]) -> tuple[Batch, Batch]:
    """The organ's hydrogel and the tumors', with their coupons. ``organ_ml`` holds the tumors.
    Volumes add up as those of water, PVA and BaSO4 do."""
    inside, out = sum(tumors_ml), []
    for name, cast_ml, baso4 in (
        ("organ", organ_ml - inside, 0.0), ("tumors", inside, mix.baso4_percent / 100),
    ):  # fmt: skip
        ml, pva = (cast_ml + COUPONS_ML) * (1 + mix.spare), mix.pva_percent / 100
        water = 1 - pva - baso4
        grams = ml / (water / _WATER + pva / _PVA + baso4 / _BASO4)
        out.append(Batch(name, ml, grams * water, grams * pva, grams * baso4, ml * _SILICONE))
    return out[0], out[1]
