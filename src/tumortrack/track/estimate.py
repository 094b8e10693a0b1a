"""What the tracker says about one cloud: points, labelled grid, surfaces and numbers."""

from __future__ import annotations

from dataclasses import dataclass

from tumortrack.core.motion import Motion
from tumortrack.core.types import CameraLabels, Mesh, OccupancyCloud


@dataclass(frozen=True, eq=False)
class Estimate:
    """Organ and tumors located in one sensor cloud, all in the camera frame, in mm.

    ``meshes`` maps kidney, tumor_1, ... to closed surfaces; a part that was not found is absent.
    The kidney's surface is the whole organ, tumors included, as in ``Anatomy``. ``report`` is
    plain JSON: per part volume, centre, box and probability, and ``timings`` in seconds.
    ``volume`` is None where nobody asked for it (live). ``motion`` says where every point of the
    CT is, where the method knows that.
    """

    cloud: OccupancyCloud
    volume: CameraLabels | None
    meshes: dict[str, Mesh]
    report: dict
    motion: Motion | None = None
