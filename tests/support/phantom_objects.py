"""The built-in phantom on coarse voxels, and a quick oblique scan, for the phantom's tests."""

from __future__ import annotations

from tumortrack.core.types import LabelVolume
from tumortrack.simulation.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.simulation.phantom.scanner import ScannerParameters

VOXEL = 1.0
FIRST = PhantomParameters()
QUICK_SCAN = ScannerParameters(spacing_mm=(1.0, 1.1, 1.3), tilt_deg=(12.0, -8.0, 20.0))


def first_labels() -> LabelVolume:
    return phantom_labels(FIRST, VOXEL)
