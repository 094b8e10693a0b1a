"""What the tracker says about one cloud: points, labelled grid, surfaces and numbers."""

from __future__ import annotations

from dataclasses import dataclass

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.motion import Motion
from tumortrack.core.types import CameraLabels, Mesh, OccupancyCloud

LARGEST_GRID = 400


class Following(Config, frozen=True, kw_only=True):
    """How one frame of many is located. ``thorough``: also search as if there were no last
    estimate, and take what fits better: a search near the last answer alone keeps what was wrong
    in it. ``smoothing_s``: time constant of the mean over past estimates; 0: none."""

    thorough: bool = False
    smoothing_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"the seed is {self.seed}; it must be 0 or more.")
        if not 0 <= self.smoothing_s <= 5:
            raise InputError(f"smoothing is {self.smoothing_s:g} s; allowed: 0 (off) to 5 s.")


@dataclass(frozen=True, eq=False)
class Estimate:
    """Organ and tumors located in one sensor cloud, all in the camera frame, in mm.

    ``meshes`` maps kidney, tumor_1, ... to closed surfaces; a part that was not found is absent.
    The kidney's surface is the whole organ, tumors included, as in ``Anatomy``. ``report`` is
    plain JSON: per part volume, centre, box and probability, and ``timings`` in seconds.
    ``volume`` is None where nobody asked for it (live). ``motion`` says where every point of the
    CT is, where the method knows that; ``unsmoothed`` the same before a mean over past frames was
    taken: where the next frame's search starts.
    """

    cloud: OccupancyCloud
    volume: CameraLabels | None
    meshes: dict[str, Mesh]
    report: dict
    motion: Motion | None = None
    unsmoothed: Motion | None = None
