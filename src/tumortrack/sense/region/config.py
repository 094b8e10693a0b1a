"""The switches of finding the organ in a whole depth image."""

from __future__ import annotations

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.sense.cloud import CloudConfig


class RegionConfig(Config, frozen=True, kw_only=True):
    """From a whole depth image to the organ's points; camera frame, mm.

    crop: depths kept, and how many points are drawn at the end.
    box_mm: region of interest, two opposite corners; None: everywhere.
    last_margin_mm: the last estimate's organ box, enlarged by this much on every side, narrows the
        crop; zero switches that off.
    plane: remove the large plane behind the organ (table, drape), and what lies behind it.
    plane_mm: at most this far from the plane is still the plane: how uneven a drape may be.
    plane_share: of everything seen, at least this share must lie on it.
    flying: remove points that have hardly a neighbour in depth.
    pieces: take one connected piece; zero ``opening_mm`` and ``gap_mm`` leave it as it is.
    opening_mm: what is narrower than twice this is no piece of its own and connects nothing:
        shafts, the strip where a finger touches.
    crease_mm: a valley deeper than this over 4 mm to either side parts two pieces; zero: never.
    gap_mm: pieces that continue each other behind something nearer and not wider than this are
        one: an organ behind a shaft.
    steepest_degrees: neighbouring pixels whose depths differ by more than a surface turned away by
        this much (and noise) would explain are parted.
    noise_mm: standard deviation of depth at 150 mm; grows with z^2.
    organ_mm: longest and shortest extent of pieces that may be the organ, if no hint names it.
    """

    crop: CloudConfig = CloudConfig()
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    last_margin_mm: float = 20.0
    plane: bool = True
    plane_mm: float = 5.0
    plane_share: float = 0.15
    flying: bool = True
    pieces: bool = True
    opening_mm: float = 3.0
    crease_mm: float = 1.2
    gap_mm: float = 20.0
    steepest_degrees: float = 75.0
    noise_mm: float = 0.2
    organ_mm: tuple[float, float] = (30.0, 160.0)

    def __post_init__(self) -> None:
        for name, most in (
            ("last_margin_mm", 1e3),
            ("plane_mm", 50.0),
            ("plane_share", 1.0),
            ("opening_mm", 20.0),
            ("crease_mm", 20.0),
            ("gap_mm", 100.0),
            ("steepest_degrees", 89.0),
            ("noise_mm", 10.0),
        ):
            if not 0 <= getattr(self, name) <= most:
                raise InputError(f"region {name} is {getattr(self, name)}; allowed: 0 to {most:g}.")
        if not 0 < self.organ_mm[0] < self.organ_mm[1]:
            raise InputError(
                f"region organ_mm is {self.organ_mm}; give two sizes in mm, the smaller first."
            )
        if self.box_mm is not None and not all(
            abs(a - b) > 1 for a, b in zip(*self.box_mm, strict=True)
        ):
            raise InputError(
                f"region box_mm is {self.box_mm}; give two opposite corners (x y z, camera frame, "
                "mm) at least 1 mm apart along each axis."
            )
