"""Manual steps on the simulated bench: put the organ into a state, show it to the camera, and take
the phantom to the scanner."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core import store
from tumortrack.core.config import Config
from tumortrack.core.geometry import rigid
from tumortrack.core.types import Intrinsics
from tumortrack.phantom.dicom import write_dicom_series
from tumortrack.phantom.scanner import ScannerParameters
from tumortrack.sense.camera import d405
from tumortrack.sense.files import intrinsics_json
from tumortrack_lab.rehearsal.bench import PRINTED_HU, Setup, scan_bench, see_bench


class BenchErrors(Config, frozen=True, kw_only=True):
    """True errors of the apparatus, which the commands do not know: of the camera's focal length
    and principal point against its own intrinsics, and of its depth, by a factor and an offset.
    Within what D405 owners report at 70 to 200 mm (librealsense #12236, #14204). ``distortion``:
    residual of the rectification, as in OpenCV (k1, k2, p1, p2, k3)."""

    focal: float = 1.004
    centre_px: tuple[float, float] = (1.5, -1.0)
    distortion: tuple[float, float, float, float, float] = (0.004, -0.006, 0.0003, -0.0002, 0.0)
    depth_scale: float = 1.004
    depth_offset_mm: float = 0.3


@dataclass(frozen=True, eq=False)
class Hands:
    """``folder`` is the simulated camera's (``rehearsal.camera``)."""

    folder: Path
    errors: BenchErrors
    camera_from_base: Float64[np.ndarray, "4 4"]

    @property
    def believed(self) -> Intrinsics:
        """The device's own intrinsics."""
        return d405()

    @property
    def true(self) -> Intrinsics:
        """The true intrinsics."""
        camera, focal, (right, down) = self.believed, self.errors.focal, self.errors.centre_px
        fx, fy = camera.fx * focal, camera.fy * focal
        return replace(camera, fx=fx, fy=fy, cx=camera.cx + right, cy=camera.cy + down)

    def plug_in(self) -> None:
        """Connect the camera; it shows nothing yet."""
        self.folder.mkdir(parents=True, exist_ok=True)
        store.write_json(self.folder / "camera.json", intrinsics_json(self.believed))

    def show(self, setup: Setup) -> None:
        """Let the camera see the bench as it is now."""
        frame = see_bench(setup, self.camera_from_base, self.true)
        depth_mm = frame.depth_mm * self.errors.depth_scale + self.errors.depth_offset_mm
        aside = self.folder / "next.npy"
        np.save(aside, depth_mm.astype(np.float32))
        aside.rename(self.folder / "now.npy")

    def scanned(
        self, setup: Setup, out: Path, seed: int, printed_hu: float = PRINTED_HU
    ) -> Float64[np.ndarray, "4 4"]:
        """Write a DICOM series of the bench in the scanner; returns ``scanner_from_base``."""
        rng = np.random.default_rng(seed)
        turn = Rotation.from_euler("xyz", rng.uniform(-6, 6, 3) + [90, 0, 0], degrees=True)
        scanner_from_base = rigid(turn.as_matrix(), rng.uniform(-30, 30, 3))
        volume = scan_bench(setup, scanner_from_base, ScannerParameters(), seed, printed_hu)
        write_dicom_series(volume, out, seed, "Phantom on its base")
        return scanner_from_base


def looking_down(above_mm: float, tilt_degrees: tuple[float, float]) -> Float64[np.ndarray, "4 4"]:
    """``camera_from_base`` of a camera over the base, tilted about its own x and y."""
    down = np.diag([1.0, -1.0, -1.0])
    tilt = Rotation.from_euler("xy", tilt_degrees, degrees=True).as_matrix()
    return rigid(tilt @ down, np.array([0.0, 0.0, above_mm]))
