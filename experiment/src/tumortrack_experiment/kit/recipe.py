"""What is mixed for a kit, with sources: every number here is cited, computed, or called our choice.

Stiffness depends on grade of PVA, rate of thawing and size of the cast more than on what can be
looked up: the published ranges only say how to begin, the coupons say what was made.
"""

from __future__ import annotations

from dataclasses import dataclass

from tumortrack.core.config import Config

COUPON_MM = (29.0, 12.5)  # diameter, height: test piece A of ISO 7743 (compression of rubber)
COUPONS = 3  # of each batch
# g/ml; water at 20 degrees, PVA 1.19 to 1.31, BaSO4 4.50 (CRC Handbook of Chemistry and Physics)
_WATER, _PVA, _BASO4 = 0.998, 1.27, 4.50
_SILICONE = 1.07  # g/ml: Smooth-On's data sheet of Ecoflex 00-10, 00-30

# Material, published Young's modulus, source.
STIFFNESS = (
    ("PVA in water, 1 to 5 cycles", "24 to 135 kPa",
     "Fromageau et al. 2007, doi 10.1109/IEMBS.2007.4353073"),
    ("PVA in water, 1 to 8 cycles", "20 to 280 kPa",
     "Qian et al. 2012, doi 10.1109/IECBES.2012.6498202"),
    ("10 % PVA in water, 2 cycles, with a biocide", "79 &plusmn; 11 kPa",
     "King et al., vessel mimicking material for Doppler flow phantoms (manuscript, no DOI seen)"),
    ("7.5 to 20 % PVA in ethanol and water", "20 to 220 kPa at 15 % strain",
     "Price et al. 2010, doi 10.1088/0031-9155/55/4/018"),
    ("human kidney, low and high strain (what a phantom aims at)", "about 20 and 500 kPa",
     "Hattab et al. 2020, doi 10.1038/s41598-020-68886-3"),
    ("ready-made silicones", "none of those tested meets both of these moduli",
     "Hattab et al. 2020, doi 10.1038/s41598-020-68886-3"),
)  # fmt: skip


class Mix(Config, frozen=True, kw_only=True):
    """Hydrogel by weight. ``baso4_percent``: of the tumors, as in the paper; ``spare``: our choice,
    for what stays in jug, sprue and vents."""

    pva_percent: float = 10.0
    cycles: int = 2
    baso4_percent: float = 2.27
    spare: float = 0.10

    def __post_init__(self) -> None:
        self.check_between("mix:", pva_percent=(5, 20), cycles=(1, 8), baso4_percent=(0.5, 10))
        self.check_between("mix:", spare=(0, 1))


@dataclass(frozen=True)
class Batch:
    """One of the two hydrogels; ml and g, spare included. ``silicone_g``: if it were silicone."""

    name: str
    ml: float
    water_g: float
    pva_g: float
    baso4_g: float
    silicone_g: float


def coupon_ml() -> float:
    """What one batch's coupons take."""
    across, high = COUPON_MM
    return COUPONS * 3.14159265 / 4 * across**2 * high / 1000


def batches(mix: Mix, organ_ml: float, tumors_ml: tuple[float, ...]) -> tuple[Batch, Batch]:
    """The organ's hydrogel and the tumors'; ``organ_ml`` holds the tumors. Volumes add up as those
    of water, PVA and BaSO4 do."""
    inside = sum(tumors_ml)
    return (
        _batch("organ", organ_ml - inside, mix, 0.0),
        _batch("tumors", inside, mix, mix.baso4_percent),
    )


def _batch(name: str, cast_ml: float, mix: Mix, baso4_percent: float) -> Batch:
    ml = (cast_ml + coupon_ml()) * (1 + mix.spare)
    pva, baso4 = mix.pva_percent / 100, baso4_percent / 100
    water = 1 - pva - baso4
    grams = ml / (water / _WATER + pva / _PVA + baso4 / _BASO4)
    return Batch(name, ml, grams * water, grams * pva, grams * baso4, ml * _SILICONE)


def shopping(made: tuple[Batch, ...], beads: int, bead_mm: float, plastic_ml: float,
             pins: int) -> list[tuple[str, str, str]]:  # fmt: skip
    """Item, amount, and what it may cost: the prices are our rough estimates, in EUR of 2026."""
    pva, baso4 = (sum(getattr(batch, key) for batch in made) for key in ("pva_g", "baso4_g"))
    return [
        ("PVA, fully hydrolysed (99 %), 85 to 146 kDa", f"{pva:.0f} g", "60 for 250 g"),
        ("BaSO4, powder", f"{baso4:.1f} g", "30 for 500 g"),
        ("water, distilled", f"{sum(b.water_g for b in made) / 1000:.2f} l", "2"),
        ("biocide (benzalkonium chloride, potassium sorbate)", "as its maker says", "15"),
        ("filament, PETG (PLA softens at the hydrogel's heat)",
         f"{plastic_ml * 1.27 / 1000:.2f} kg if printed solid", "25 per kg"),
        (f"beads of glass or ceramic, {bead_mm:g} mm (steel leaves streaks in a CT)",
         f"{beads} and spare ones", "10"),
        ("pins: stainless or, better, glass-fibre rods", f"{pins}", "10"),
        ("nylon bolts and nuts M4, rubber bands, mold seal (silicone grease), glue", "", "25"),
        ("depth camera RealSense D405", "1", "300"),
        ("time in a CT, a scan for each state", "", "your hospital's"),
    ]  # fmt: skip


def times(mix: Mix, plastic_ml: float) -> list[tuple[str, str]]:
    """Steps and hours, our estimates: print at 12 ml an hour, as a nozzle of 0.4 mm does."""
    return [
        ("printing", f"about {plastic_ml * 0.5 / 12:.0f} h at half-filled walls, unattended"),
        ("dissolving PVA at 90 degrees, degassing", "3 h"),
        ("casting and freezing the tumors, one cycle", "24 h"),
        ("casting the organ round them", "1 h"),
        (f"{mix.cycles} cycles: 16 h at -20 degrees, 8 h at room temperature",
         f"{mix.cycles * 24} h"),
        ("a state: set, record, carry away the camera, scan", "20 min each"),
    ]  # fmt: skip
