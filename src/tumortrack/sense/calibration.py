"""A depth camera that is out of calibration: every depth wrong by an offset and a factor.

Stereo cameras drift with temperature and shocks, until they are calibrated again. The
error is constant over a frame, so no averaging removes it.
"""

from __future__ import annotations

import numpy as np

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame


class CalibrationConfig(Config, frozen=True, kw_only=True):
    """Largest errors; each frame draws its own, uniformly to either side. Zero switches it off.

    offset_mm: added to every depth.
    scale: share of the depth, 0..0.2.
    """

    offset_mm: float = 0.0
    scale: float = 0.0

    def __post_init__(self) -> None:
        for name, most in (("offset_mm", 20.0), ("scale", 0.2)):
            value = getattr(self, name)
            if not 0 <= value <= most:
                raise InputError(f"calibration {name} is {value}; allowed: 0 (off) to {most:g}.")


CALIBRATED = CalibrationConfig()


def miscalibrate(
    frame: DepthFrame, config: CalibrationConfig, rng: np.random.Generator
) -> DepthFrame:
    """The frame as a camera out of calibration would state it.

    ``rng`` is left as it was. Where it is off, nothing is drawn and the frame itself comes back.
    """
    if config == CALIBRATED:
        return frame
    offset, scale = rng.spawn(1)[0].uniform(-1, 1, 2)
    factor = np.float32(1 + scale * config.scale)
    depth_mm = frame.depth_mm * factor + np.float32(offset * config.offset_mm)
    depth_mm.flags.writeable = False  # nobody else's: taken over without a copy
    return DepthFrame(depth_mm, frame.intrinsics, frame.stamp_ns)
