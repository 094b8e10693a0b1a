"""How the organ is found among other things: options that `track`, `resect` and `locate` share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tumortrack.cli.stated import StatedPatient

if TYPE_CHECKING:
    from tumortrack.models.model import Model
    from tumortrack.sense.region import RegionConfig


@dataclass(frozen=True, kw_only=True)
class FindingOrgan(StatedPatient):
    """Options of commands that look for an organ in depth images.

    Attributes:
        range: keep depths between NEAR and FAR mm (default: those that the model has learned).
        box: keep what lies in a box: two opposite corners X Y Z X Y Z, camera frame, mm.
        whole: what is in range and box is the organ alone; do not look for it among other things.
    """

    range: tuple[float, float] | None = None
    box: tuple[float, float, float, float, float, float] | None = None
    whole: bool = False

    def region(self, model: Model) -> RegionConfig:
        """Raises InputError: a range or box that is none."""
        from tumortrack.tracking.tracker import region_for

        box = None if self.box is None else (self.box[:3], self.box[3:])
        return region_for(model, range_mm=self.range, box_mm=box, whole=self.whole)
