"""Where one frame's organ lies: a pose, an elastic state, and how sure they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import Points, rigid
from tumortrack.core.process import parallel_for
from tumortrack.registration import kernels
from tumortrack.registration.kernels import Flow, Pose
from tumortrack.registration.rest_shape import RestShape
from tumortrack.simulate.elastic.flow import steps_for

Moved = Float64[np.ndarray, "n 3"]
_AT_ONCE = 4096  # points: a thread's part
_FEW = 64  # as well, where each takes longer


@dataclass(frozen=True, eq=False)
class ElasticMotion:
    """``core.estimate.Motion`` of a shape: x -> rotation (flow(x) - center_ct) + centre_mm.

    Attributes:
        rotation, centre_mm: where the organ's axes and centre are before the camera.
        coefficients: of the body's modes; ``covariance``: of shift (mm), turn (rad; both in the
            CT's axes, about the centre) and coefficients, as ``refine`` left it, if it did.
        std_scale: a factor for its standard deviations, found on validation scenes.
    """

    shape: RestShape
    rotation: Float64[np.ndarray, "3 3"]
    centre_mm: Float64[np.ndarray, " 3"]
    coefficients: Float64[np.ndarray, " m"]
    covariance: Float64[np.ndarray, "p p"] | None = None
    std_scale: float = 1.0

    @property
    def camera_from_ct(self) -> Float64[np.ndarray, "4 4"]:
        """The rigid part."""
        return rigid(self.rotation, self.centre_mm - self.rotation @ self.shape.body.center_ct)

    @property
    def rarity(self) -> float:
        """The state's squared Mahalanobis distance in the body's library, whose mean is 1."""
        off = self.coefficients - self.shape.body.mean
        return float(off @ self.shape.body.precision @ off) / len(off)

    def carry(self, points_ct: Points, /) -> Moved:
        """CT (LPS, mm) -> camera frame (mm)."""
        return self._moved(kernels.carry, self._flow, points_ct)

    def back(self, points_camera: Points, /) -> Moved:
        """Camera frame (mm) -> CT (LPS, mm)."""
        opposite = self._flow._replace(velocity=-self._flow.velocity)
        return self._moved(kernels.back, opposite, points_camera)

    def std_mm(self, points_ct: Points, /) -> Float64[np.ndarray, " n"] | None:
        """One standard deviation along any axis, mm: the root of the mean over three of them."""
        covariance = self.covariance_mm2(points_ct)
        return None if covariance is None else np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3)

    def largest_std_mm(self, points_ct: Points, /) -> Float64[np.ndarray, " n"] | None:
        """One standard deviation along the axis that is least sure, mm."""
        covariance = self.covariance_mm2(points_ct)
        return None if covariance is None else np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])

    def covariance_mm2(self, points_ct: Points, /) -> Float64[np.ndarray, "n 3 3"] | None:
        """Of the places to which ``carry`` takes points, in the camera's axes: the pose's and the
        state's, to first order."""
        if self.covariance is None:
            return None
        body, points = self.shape.body, np.ascontiguousarray(points_ct, np.float32)
        root = np.linalg.cholesky(self.covariance).astype(np.float32)
        known = self._flow, body.modes, body.center_ct.astype(np.float32), root
        out = np.empty((len(points), 3, 3), np.float32)
        parallel_for(
            lambda part: kernels.covariances(*known, points[part], out[part]), len(points), _FEW
        )
        return self.std_scale**2 * (self.rotation @ out.astype(float) @ self.rotation.T)

    def _moved(self, kernel: Callable[..., None], flow: Flow, points_mm: Points) -> Moved:
        points, out = np.ascontiguousarray(points_mm, np.float32), np.empty((len(points_mm), 3))
        pose = Pose(self.shape.body.center_ct, self.rotation, self.centre_mm)
        parallel_for(lambda part: kernel(flow, pose, points[part], out[part]), len(out), _AT_ONCE)
        return out

    @cached_property
    def _flow(self) -> Flow:
        """What the kernels follow."""
        body = self.shape.body
        velocity = body.velocity(self.coefficients)
        steps = steps_for(velocity, body.spacing_mm)
        return Flow(velocity, body.origin_mm, np.float32(body.spacing_mm), steps)


def blend(a: ElasticMotion, b: ElasticMotion, share: float) -> ElasticMotion:
    """Between two motions of one shape: ``share`` 0 is at ``a``, 1 at ``b``, whose covariance it
    keeps."""
    turn = Rotation.from_matrix(a.rotation.T @ b.rotation).as_rotvec()
    return replace(
        b,
        rotation=a.rotation @ Rotation.from_rotvec(share * turn).as_matrix(),
        centre_mm=(1 - share) * a.centre_mm + share * b.centre_mm,
        coefficients=(1 - share) * a.coefficients + share * b.coefficients,
    )
