"""Bayesian coherent point drift: drives the author's public program through its text files.

Hirose 2021, doi 10.1109/TPAMI.2020.2971687; program https://github.com/ohirose/bcpd (MIT), built
by its ``make`` with OpenBLAS. There is no Python package of it.
"""

from __future__ import annotations

import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.distance import cdist

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import Carry, Fit, stopwatch
from tumortrack_lab.peers.cpd import mutual_error_mm
from tumortrack_lab.peers.rigid import Pose, PoseSearch, RigidConfig

_PATIENCE_S = 120.0


class BcpdConfig(Config, frozen=True):
    """Settings of BCPD under the names of its options; lengths in units of the cloud's spread
    (the root mean square of its coordinates about their mean).

    ``program`` is the path of the built binary. ``kernel`` (beta) is the reach of the Gaussian
    over which points move together; ``length`` (lambda): the expected displacement is
    sqrt(3 / lambda); ``outliers`` (omega); ``near`` (gamma): small where the start is good.
    """

    program: str = ""
    rigid: RigidConfig = RigidConfig()
    starts: int = 3  # the best rigid poses, each fitted
    kernel: float = 1.2
    length: float = 50.0
    outliers: float = 0.1
    near: float = 0.1
    iterations: int = 300
    points: int = 700  # of the visible surface
    ridge: float = 1e-2  # of the interpolation of displacements into the depth


@dataclass(frozen=True, eq=False)
class Smooth:
    """BCPD's map: similarity after a displacement that is interpolated by its own Gaussian
    process (Hirose 2021b, doi 10.1109/TPAMI.2020.3043769), camera frame, mm."""

    points_mm: Float64[np.ndarray, "n 3"]
    weights: Float64[np.ndarray, "n 3"]
    kernel_mm: float
    matrix: Float64[np.ndarray, "3 3"]
    shift_mm: Float64[np.ndarray, " 3"]

    def __call__(self, at_mm: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3"]:
        """The mapped points."""
        moved = at_mm + _gaussian(at_mm, self.points_mm, self.kernel_mm) @ self.weights
        return moved @ self.matrix.T + self.shift_mm


class Bcpd:
    """Bayesian coherent point drift as a peer.

    Raises:
        InputError: ``config.program`` is not given or is no file.
    """

    name = "bcpd"

    def __init__(
        self, anatomy_ct: Anatomy, up_lps: tuple[float, float, float], config: BcpdConfig
    ) -> None:
        if not Path(config.program).is_file():
            raise InputError(
                f"BCPD's program {config.program!r} does not exist. Get the source from "
                "https://github.com/ohirose/bcpd, install OpenBLAS, run make, and give the path "
                "of the binary that it builds."
            )
        self.config = config
        with stopwatch() as watch:
            self._search = PoseSearch(anatomy_ct, up_lps, config.rigid)
        self.prepare_s = watch.seconds

    def fit(self, scene: Scene) -> Fit:
        """The map, from the best rigid poses, that leaves the cloud nearest the surface.

        Raises:
            NoEstimate: fewer than 20 points, or the program failed on them.
        """
        cloud = scene.cloud.points_mm.astype(float)
        with stopwatch() as watch:
            poses = self._search.poses(scene.cloud)[: self.config.starts]
            fits = [self._run(pose, cloud) for pose in poses]
            errors = [mutual_error_mm(smooth(smooth.points_mm), cloud) for smooth, _ in fits]
            best = int(np.argmin(errors))
        smooth, iterations = fits[best]
        report = {
            "start": poses[best].start,
            "iterations": iterations,
            "residual_mm": errors[best],
        }
        return Fit(_carry(poses[best], smooth), watch.seconds, report)

    def _run(self, pose: Pose, cloud: Float64[np.ndarray, "n 3"]) -> tuple[Smooth, int]:
        """One run of the program: its displacements v and shape y, and its count of loops."""
        config = self.config
        source = self._search.seen(cloud, pose.camera_from_ct)
        source = source[:: max(1, len(source) // config.points)]
        with tempfile.TemporaryDirectory() as folder:
            np.savetxt(Path(folder) / "x.txt", cloud, fmt="%.6f", delimiter="\t")
            np.savetxt(Path(folder) / "y.txt", source, fmt="%.6f", delimiter="\t")
            command = [
                *[str(Path(config.program).resolve()), "-xx.txt", "-yy.txt", "-oout_", "-q", "-sv"],
                *[f"-w{config.outliers}", f"-l{config.length}", f"-b{config.kernel}"],
                *[f"-g{config.near}", "-ux", "-c1e-5", f"-n{config.iterations}", "-r1"],
            ]
            try:
                done = subprocess.run(
                    command, cwd=folder, capture_output=True, text=True, timeout=_PATIENCE_S
                )
                displacement = np.loadtxt(Path(folder) / "out_v.txt", ndmin=2)
                shape = np.loadtxt(Path(folder) / "out_y.txt", ndmin=2)
            except (OSError, ValueError, subprocess.TimeoutExpired) as error:
                raise NoEstimate(f"BCPD's program gave no answer: {error}.") from error
            if done.returncode or shape.shape != source.shape or not np.isfinite(shape).all():
                raise NoEstimate(f"BCPD's program failed: {done.stderr.strip()[-300:]}.")
            loops = _loops(Path(folder) / "out_info.txt")
        kernel_mm = config.kernel * float(np.sqrt(((cloud - cloud.mean(0)) ** 2).mean()))
        kernel = _gaussian(source, source, kernel_mm) + config.ridge * np.eye(len(source))
        weights = np.linalg.solve(kernel, displacement)
        affine = np.linalg.lstsq(
            np.pad(source + displacement, ((0, 0), (0, 1)), constant_values=1), shape, rcond=None
        )[0]
        return Smooth(source, weights, kernel_mm, affine[:3].T, affine[3]), loops


def _loops(info: Path) -> int:
    for line in info.read_text().splitlines() if info.is_file() else ():
        if line.startswith("loops"):
            return int(line.split()[1])
    return 0


def _carry(pose: Pose, smooth: Smooth) -> Carry:
    return lambda points_ct: smooth(transform_points(pose.camera_from_ct, points_ct))


def _gaussian(
    a_mm: Float64[np.ndarray, "n 3"], b_mm: Float64[np.ndarray, "m 3"], reach_mm: float
) -> Float64[np.ndarray, "n m"]:
    return np.exp(-cdist(a_mm, b_mm, "sqeuclidean") / (2 * reach_mm**2))
