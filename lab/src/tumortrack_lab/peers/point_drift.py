"""Coherent point drift, classic and Bayesian: non-rigid, from rigid starts.

The observed cloud is the data, the part of the model's surface that the camera should see is the
moving set: the whole organ would be pulled onto one side of the cloud. Displacements are
interpolated into the depth by the methods' own Gaussian kernel.

CPD: Myronenko, Song 2010, doi 10.1109/TPAMI.2010.46 (pycpd). BCPD: Hirose 2021, doi
10.1109/TPAMI.2020.2971687; there is no Python package of it, so the author's public program,
https://github.com/ohirose/bcpd (MIT), is driven through its text files.
"""

from __future__ import annotations

import subprocess
import tempfile
from abc import abstractmethod
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack_lab.peers.base import Carry, DeformablePeer
from tumortrack_lab.peers.pose_search import Direction, Points, RigidConfig, Transform, trimmed_mean

_KEPT = 0.9  # of the distances
_PATIENCE_S = 120.0


class CpdConfig(Config, frozen=True):
    """Settings of CPD, lengths in mm; the paper's name of each in brackets."""

    rigid: RigidConfig = RigidConfig()
    starts: int = 2  # the best rigid poses, each fitted
    kernel_mm: float = 50.0  # distance over which points move together (beta)
    smooth: float = 1000.0  # weight of smoothness, of points scaled to a spread of 1 (lambda)
    outliers: float = 0.1  # (w)
    first_sigma_mm: float = 6.0  # annealing starts at the error that a rigid pose leaves
    iterations: int = 60
    points: int = 400  # of the visible surface


class BcpdConfig(Config, frozen=True):
    """Settings of BCPD, the paper's name of each in brackets; lengths in units of the cloud's
    spread (the root mean square of its coordinates about their mean)."""

    program: str = ""  # path of the built binary
    rigid: RigidConfig = RigidConfig()
    starts: int = 3  # the best rigid poses, each fitted
    kernel: float = 1.2  # reach of the Gaussian over which points move together (beta)
    length: float = 50.0  # the expected displacement is sqrt(3 / length) (lambda)
    outliers: float = 0.1  # (omega)
    near: float = 0.1  # small where the start is good (gamma)
    iterations: int = 300
    points: int = 700  # of the visible surface
    ridge: float = 1e-2  # of the interpolation of displacements into the depth


class _PointDrift(DeformablePeer):
    config: CpdConfig | BcpdConfig

    def _fit_from(self, camera_from_ct: Transform, cloud: Points) -> tuple[float, Carry, dict]:
        source = self._search.seen(cloud, camera_from_ct)
        source = source[:: max(1, len(source) // self.config.points)]
        drift, iterations = self._drift(source, cloud)
        # Trimmed mean distance of the drifted surface to the cloud and back: it compares starts.
        moved = drift(source)
        both = (moved, cloud), (cloud, moved)
        error_mm = sum(trimmed_mean(cKDTree(to).query(at)[0], _KEPT) for to, at in both) / 2
        report = {"iterations": iterations, "residual_mm": error_mm}
        return error_mm, lambda ct: drift(transform_points(camera_from_ct, ct)), report

    @abstractmethod
    def _drift(self, source: Points, cloud: Points) -> tuple[Carry, int]:
        """The drift of a rigidly placed surface onto a cloud, v(z) = sum over n of G(z, y_n) w_n,
        and the iterations it took."""


class Cpd(_PointDrift):
    name = "cpd"
    config: CpdConfig

    def _drift(self, source: Points, cloud: Points) -> tuple[Carry, int]:
        from pycpd import DeformableRegistration

        config = self.config
        registration = DeformableRegistration(
            X=cloud,
            Y=source,
            sigma2=config.first_sigma_mm**2,
            alpha=config.smooth / ((cloud - cloud.mean(0)) ** 2).mean(),
            beta=config.kernel_mm,
            w=config.outliers,
            max_iterations=config.iterations,
        )
        registration.register()
        carry = _coherent(source, registration.W, config.kernel_mm)
        return carry, int(registration.iteration)


class Bcpd(_PointDrift):
    """Bayesian coherent point drift as a peer. Raises InputError: ``config.program`` is not given
    or is no file."""

    name = "bcpd"
    config: BcpdConfig

    def _prepare(self, anatomy_ct: Anatomy, up_lps: Direction) -> None:
        if not Path(self.config.program).is_file():
            raise InputError(
                f"BCPD's program {self.config.program!r} does not exist. Get the source from "
                "https://github.com/ohirose/bcpd, install OpenBLAS, run make, and give the path "
                "of the binary that it builds."
            )
        super()._prepare(anatomy_ct, up_lps)

    def _drift(self, source: Points, cloud: Points) -> tuple[Carry, int]:
        """The program's displacements v, interpolated by its own Gaussian process (Hirose 2021b,
        doi 10.1109/TPAMI.2020.3043769), then the similarity that carries y + v to its shape y'.
        Raises NoEstimate: the program failed on these points."""
        config = self.config
        displacement, shape, loops = self._run(source, cloud)
        kernel_mm = config.kernel * float(np.sqrt(((cloud - cloud.mean(0)) ** 2).mean()))
        kernel = _gaussian(source, source, kernel_mm) + config.ridge * np.eye(len(source))
        weights = np.linalg.solve(kernel, displacement)
        moved = np.pad(source + displacement, ((0, 0), (0, 1)), constant_values=1)
        affine = np.linalg.lstsq(moved, shape, rcond=None)[0]
        carry = _coherent(source, weights, kernel_mm)
        return lambda at_mm: carry(at_mm) @ affine[:3] + affine[3], loops

    def _run(self, source: Points, cloud: Points) -> tuple[Points, Points, int]:
        """One run of the program: its displacements v and shape y, and its count of loops."""
        config = self.config
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            np.savetxt(folder / "x.txt", cloud, fmt="%.6f", delimiter="\t")
            np.savetxt(folder / "y.txt", source, fmt="%.6f", delimiter="\t")
            command = [
                *[str(Path(config.program).resolve()), "-xx.txt", "-yy.txt", "-oout_", "-q", "-sv"],
                *[f"-w{config.outliers}", f"-l{config.length}", f"-b{config.kernel}"],
                *[f"-g{config.near}", "-ux", "-c1e-5", f"-n{config.iterations}", "-r1"],
            ]
            try:
                done = subprocess.run(
                    command, cwd=folder, capture_output=True, text=True, timeout=_PATIENCE_S
                )
                displacement = np.loadtxt(folder / "out_v.txt", ndmin=2)
                shape = np.loadtxt(folder / "out_y.txt", ndmin=2)
            except (OSError, ValueError, subprocess.TimeoutExpired) as error:
                raise NoEstimate(f"BCPD's program gave no answer: {error}.") from error
            if done.returncode or shape.shape != source.shape or not np.isfinite(shape).all():
                raise NoEstimate(f"BCPD's program failed: {done.stderr.strip()[-300:]}.")
            info = folder / "out_info.txt"
            lines = info.read_text().splitlines() if info.is_file() else []
            loops = (int(line.split()[1]) for line in lines if line.startswith("loops"))
            return displacement, shape, next(loops, 0)


def _coherent(source: Points, weights: Points, kernel_mm: float) -> Carry:
    return lambda at_mm: at_mm + _gaussian(at_mm, source, kernel_mm) @ weights


def _gaussian(
    a_mm: Float64[np.ndarray, "n 3"], b_mm: Float64[np.ndarray, "m 3"], reach_mm: float
) -> Float64[np.ndarray, "n m"]:
    return np.exp(-cdist(a_mm, b_mm, "sqeuclidean") / (2 * reach_mm**2))
