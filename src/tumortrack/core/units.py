"""Raw depths to millimetres, and guessing the unit of those that were read as such."""

from __future__ import annotations

from enum import Enum

import numpy as np
from jaxtyping import Float, Float32, Num

from tumortrack.core.types import DepthFrame, SensorCloud

# What cameras and programs write where there is no depth, beside 0, NaN, infinity, numbers below 0,
# and the largest number of its type: the largest of 16 bits, also as a float, and in metres.
_NO_DEPTH = np.array([65535.0, 65.535], np.float32)
_SHARE = 0.1  # of the lengths in range: an organ may be that little of a depth image
_SAMPLED = 20_000  # lengths at most


def depths_mm(steps: Num[np.ndarray, "h w"], unit_mm: float) -> Float32[np.ndarray, "h w"]:
    """A raw depth image, of which a step is ``unit_mm``, in mm; NaN where it has no depth."""
    largest = np.iinfo(steps.dtype) if steps.dtype.kind in "iu" else np.finfo(steps.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        raw = steps.astype(np.float32)
        depth_mm = raw * np.float32(unit_mm)
        seen = (depth_mm > 0) & np.isfinite(depth_mm)
        seen &= ~np.isin(raw, _NO_DEPTH) & (raw < np.float32(largest.max))
    return np.where(seen, depth_mm, np.float32(np.nan))


class Unit(Enum):
    """Units often taken for mm, and how many mm one is. Depth steps of 1 mm read as 0.1 are
    ``CENTIMETRE``, mm read as metres ``MICROMETRE``."""

    METRE = 1000.0
    INCH = 25.4
    CENTIMETRE = 10.0
    TENTH = 0.1
    MICROMETRE = 0.001

    @property
    def of_cloud(self) -> str:
        """Advice, as a clause, about a cloud in this unit."""
        return _OF_CLOUD[self]

    @property
    def of_depth(self) -> str:
        """Advice, as a clause, about a depth image whose depths are off by this factor."""
        return (
            f"times {self.value:g} they would lie there; check what one step of the depth image is "
            "(depth_unit_mm in the intrinsics file; 0.1 mm where the file does not say)"
        )


_OF_CLOUD = {
    Unit.METRE: "it looks like metres: multiply it by 1000 (of a file: --unit m)",
    Unit.INCH: "it looks like inches: multiply it by 25.4",
    Unit.CENTIMETRE: "it looks like centimetres, or steps of 1 mm read as 0.1: multiply it by 10",
    Unit.TENTH: "it looks like tenths of a millimetre: divide it by 10",
    Unit.MICROMETRE: "it looks like millimetres read as metres: leave out --unit m",
}


def likely_unit(lengths_mm: Float[np.ndarray, ...], range_mm: tuple[float, float]) -> Unit | None:
    """The unit in which most of the lengths, which were read as mm, lie in the expected range; None
    if a tenth of them do as they are, or in no unit. Only finite lengths count."""
    lengths = lengths_mm[np.isfinite(lengths_mm)]
    lengths = lengths[:: len(lengths) // _SAMPLED + 1]

    def share(factor: float) -> float:
        return float(np.mean((lengths > range_mm[0] / factor) & (lengths < range_mm[1] / factor)))

    if not len(lengths) or share(1.0) >= _SHARE:
        return None
    best = max(Unit, key=lambda unit: share(unit.value))
    return best if share(best.value) >= _SHARE else None


def unit_advice(content: DepthFrame | SensorCloud, near_mm: float, far_mm: float) -> str:
    """Advice about the unit, as a clause, if hardly any depth lies between near and far but many
    would in another unit; else empty."""
    z_mm = content.depth_mm if isinstance(content, DepthFrame) else content.points_mm[:, 2]
    unit = likely_unit(z_mm, (near_mm, far_mm))
    if unit is None:
        return ""
    return unit.of_depth if isinstance(content, DepthFrame) else unit.of_cloud
