"""From a whole depth image to the organ's points: one step, one file.

``organ_points`` is the entry; ``config`` its switches; ``picture`` what all steps look at; then
``crop``, ``plane``, ``pieces``, ``choose`` in this order.
"""

from tumortrack.sense.region.config import RegionConfig
from tumortrack.sense.region.organ import Hints, Region, organ_points

__all__ = ["Hints", "Region", "RegionConfig", "organ_points"]
