"""Where the organ lies in one frame: a pose, an elastic state, and their uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, Points, largest_std_of, rigid, std_of, turned_by
from tumortrack.core.process import parallel_for
from tumortrack.core.renamed import Renamed
from tumortrack.native import F32, F64, kernel
from tumortrack.organ.flow import FLOW, MODES, Flow, LatticeField, steps_for
from tumortrack.organ.rest_shape import DISTANCES, DistanceField, RestShape

POSE = 6  # unknowns before the coefficients: shift and turn
_AT_ONCE = 4096  # points per thread
_FEW = 1024  # the same, where each takes longer


class Pose(NamedTuple):
    """x -> rotation (x - center_ct) + centre_mm; float64."""

    center_ct: Float64[np.ndarray, " 3"]
    rotation: Float64[np.ndarray, "3 3"]
    centre_mm: Float64[np.ndarray, " 3"]


# In C: native/fast/motion.c. Derivatives by coefficients are to first order: the modes halfway
# along a point's path. The opposite flow has the opposite velocity.
_POSE, _POINTS = (F64[3], F64[3, 3], F64[3]), F32["n", 3]
_forward = kernel("forward", FLOW, _POSE, _POINTS, F64["n", 3].out)
_inverse = kernel("inverse", FLOW, _POSE, _POINTS, F64["n", 3].out)  # with the opposite flow
_effects = kernel("effects", FLOW, MODES, F64[3], _POINTS, F32["m"].out, F64["n", 3, "p"].out)
_residual_rows = kernel("residual_rows", MODES, DISTANCES, FLOW, _POSE, _POINTS, F32["n", "q"].out)


def residual_rows(
    modes: LatticeField,
    field: DistanceField,
    opposite: Flow,
    pose: Pose,
    points: Float32[np.ndarray, "n 3"],
) -> Float32[np.ndarray, "n q"]:
    """What shift, turn and coefficients each do to the signed distance (mm) of points (camera
    frame), carried back, to a surface at rest; the distance itself stands in the last column."""
    out = np.empty((len(points), POSE + modes.values.shape[-1] + 1), np.float32)
    _residual_rows(modes, field, opposite, pose, points, out)
    return out


@dataclass(frozen=True, eq=False)
class ElasticMotion(Renamed):
    """``core.estimate.Motion`` of a shape: x -> rotation (flow(x) - center_ct) + centre_mm.

    Attributes:
        rotation, centre_mm: where the organ's axes and centre are before the camera.
        coefficients: of the body's modes; ``covariance``: of shift (mm), turn (rad; both in the
            CT's axes, about the centre) and coefficients, once fitted.
        alternatives: other motions that explain the points nearly as well, each with its share of
            the probability.
        depth_share: standard deviation of the camera's depths, as a share of them, all alike.
        std_scale: a factor for its standard deviations, found on validation scenes.
    """

    shape: RestShape
    rotation: Float64[np.ndarray, "3 3"]
    centre_mm: Float64[np.ndarray, " 3"]
    coefficients: Float64[np.ndarray, " m"]
    covariance: Float64[np.ndarray, "p p"] | None = None
    alternatives: tuple[tuple[ElasticMotion, float], ...] = ()
    depth_share: float = 0.0
    std_scale: float = 1.0

    @property
    def camera_from_deformed_ct(self) -> Float64[np.ndarray, "4 4"]:
        """Where the flow has carried points of the CT -> camera."""
        return rigid(self.rotation, self.centre_mm - self.rotation @ self.shape.body.center_ct)

    @property
    def normalized_mahalanobis(self) -> float:
        """The state's squared Mahalanobis distance in the body's library, whose mean is 1."""
        off = self.coefficients - self.shape.body.mean
        return float(off @ self.shape.body.precision @ off) / len(off)

    def changed(self, change: Float64[np.ndarray, " p"]) -> ElasticMotion:
        """With this added to shift, turn and coefficients; still with its covariance."""
        shift, turn = change[:3], change[3:POSE]
        return replace(
            self,
            rotation=self.rotation @ turned_by(turn),
            centre_mm=self.centre_mm + self.rotation @ shift,
            coefficients=self.coefficients + change[POSE:],
        )

    def forward(self, points_ct: Points, /) -> Float64[np.ndarray, "n 3"]:
        """CT (LPS, mm) -> camera frame (mm)."""
        return self._moved(_forward, self._flow, points_ct)

    def inverse(self, points_camera: Points, /) -> Float64[np.ndarray, "n 3"]:
        """Camera frame (mm) -> CT (LPS, mm)."""
        return self._moved(_inverse, self._opposite, points_camera)

    def std_mm(self, points_ct: Points, /) -> Float64[np.ndarray, " n"] | None:
        """One standard deviation along any axis, mm: the root of the mean over three of them."""
        covariance = self.covariance_mm2(points_ct)
        return None if covariance is None else std_of(covariance)

    def largest_std_mm(self, points_ct: Points, /) -> Float64[np.ndarray, " n"] | None:
        """One standard deviation along the least certain axis, mm."""
        covariance = self.covariance_mm2(points_ct)
        return None if covariance is None else largest_std_of(covariance)

    def covariance_mm2(self, points_ct: Points, /) -> Float64[np.ndarray, "n 3 3"] | None:
        """Of the places to which ``forward`` takes points, in the camera's axes: of pose and state
        to first order, of the alternatives and the camera's depths."""
        if self.covariance is None:
            return None
        points = _given(points_ct)
        out, places_mm = np.empty((len(points), 3, 3)), self.forward(points)
        parallel_for(lambda part: self._spread(points[part], out[part]), len(points), _FEW)
        out = self.rotation @ out @ self.rotation.T
        for alternative, share in self.alternatives:
            away = alternative.forward(points) - places_mm
            out += share * away[:, :, None] * away[:, None, :]
        out *= self.std_scale**2
        along = self.depth_share * places_mm
        return out + along[:, :, None] * along[:, None, :]

    def pose_covariance(self, points_ct: Points, /) -> Float64[np.ndarray, "n 6 6"] | None:
        """Of the places to which ``forward`` takes points (mm), as ``covariance_mm2``, and of the
        organ's turn, without its deformation (rad), both about the camera's axes."""
        if self.covariance is None:
            return None
        modes = self._modes(points_ct)
        return modes @ modes.transpose(0, 2, 1)

    def spread_modes(
        self, points_ct: Points, weights: Float64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n 3 q"]:
        """The covariance of all places together: the sum of ``mode @ mode.T``. Each mode is what
        one standard deviation of it does (mm, camera's axes), independently of the others; the
        first ones move points most, by their ``weights``. At each point alone, what they do
        together is ``covariance_mm2``. Raises InputError: the motion has no covariance."""
        if self.covariance is None:
            raise InputError("a motion that was not fitted has no covariance.")
        every = self._modes(points_ct)[:, :3]
        _, turn = np.linalg.eigh(np.einsum("nxa,n,nxb->ab", every, weights, every, optimize=True))
        return every @ turn[:, ::-1]

    def _modes(self, points_ct: Points) -> Float64[np.ndarray, "n 6 q"]:
        """What one standard deviation of each of its independent unknowns does to places (mm) and
        the turn (rad), about the camera's axes."""
        assert self.covariance is not None
        places_mm = self.forward(points_ct)
        squares, axes = np.linalg.eigh(self.covariance)
        unknowns = axes * np.sqrt(np.maximum(squares, 0))
        moved = self.rotation @ self.effects(points_ct) @ unknowns
        turned = np.broadcast_to(self.rotation @ unknowns[3:POSE], moved.shape)
        columns = [self.std_scale * np.concatenate([moved, turned], axis=1)]
        for alternative, share in self.alternatives:
            away_mm = alternative.forward(points_ct) - places_mm
            away_rad = np.tile(_rotvec(alternative.rotation @ self.rotation.T), (len(away_mm), 1))
            away = np.concatenate([away_mm, away_rad], axis=1)
            columns.append(self.std_scale * np.sqrt(share) * away[:, :, None])
        along = np.pad(self.depth_share * places_mm, ((0, 0), (0, 3)))
        return np.concatenate([*columns, along[:, :, None]], axis=2)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All of a fitted motion but its shape, of which it has what was cut. ``places``: a row of
        it and of each alternative (that may have fewer coefficients): share, rotation, centre,
        coefficients."""
        assert self.covariance is not None
        every = (self, 1.0), *self.alternatives
        rows = np.zeros((len(every), 13 + len(self.coefficients)))
        for row, (motion, share) in zip(rows, every, strict=True):
            known = share, *motion.rotation.flat, *motion.centre_mm, *motion.coefficients
            row[: len(known)] = known
        scales = np.array([self.depth_share, self.std_scale])
        cut = self.shape.cut
        more = {} if cut is None else {"cut_ct": cut.points_ct, "kerf_mm": np.array(cut.kerf_mm)}
        return {"places": rows, "covariance": self.covariance, "scales": scales, **more}

    @classmethod
    def from_arrays(cls, shape: RestShape, arrays: dict[str, np.ndarray]) -> ElasticMotion:
        """The inverse of ``to_arrays``. Raises InputError: an array is missing, or none of such a
        motion of this shape."""
        names, size = ("places", "covariance", "scales"), POSE + shape.body.modes.shape[-1]
        rows, covariance, scales = (np.array(arrays.get(name, ()), float) for name in names)
        fits = rows.ndim == 2 and len(rows) and rows.shape[1] == 13 - POSE + size
        if not fits or (covariance.shape, scales.shape) != ((size, size), (2,)):
            raise InputError(f"a motion does not fit a body of {size - POSE} modes; locate again.")
        turns = rows[:, 1:10].reshape(-1, 3, 3)
        unit = np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-6)
        if not unit or (np.linalg.det(turns) < 0).any() or (rows[:, 0] < 0).any():
            raise InputError("a motion's rotations or shares are none; locate again.")
        first, *others = (
            cls(shape, turn, row[10:13], row[13:]) for turn, row in zip(turns, rows, strict=True)
        )
        first = replace(first, alternatives=tuple(zip(others, rows[1:, 0].tolist(), strict=True)))
        depth_share, std_scale = scales.tolist()
        return replace(first, covariance=covariance, depth_share=depth_share, std_scale=std_scale)

    def _spread(
        self, points: Float32[np.ndarray, "n 3"], out: Float64[np.ndarray, "n 3 3"]
    ) -> None:
        """The covariance of pose and state, organ's axes, not scaled."""
        assert self.covariance is not None
        effects = self.effects(points)
        spread = effects.reshape(-1, effects.shape[2]) @ self.covariance
        out[:] = spread.reshape(effects.shape) @ effects.transpose(0, 2, 1)

    def effects(self, points_ct: Points) -> Float64[np.ndarray, "n 3 p"]:
        """What shift, turn and coefficients each do to the place of points, organ's axes."""
        body, points = self.shape.body, np.array(points_ct, np.float32, order="C")
        modes, count = body.mode_field, body.modes.shape[-1]
        out = np.empty((len(points), 3, POSE + count))
        _effects(self._flow, modes, body.center_ct, points, np.empty(count, np.float32), out)
        return out

    def residual_rows(self, points_camera: Points, surface: int = 0) -> Float32[np.ndarray, "n q"]:
        """See ``residual_rows``; ``surface``: the organ's, or another of ``RestShape.field``."""
        points, modes = np.array(points_camera, np.float32, order="C"), self.shape.body.mode_field
        field = self.shape.field(surface)
        return residual_rows(modes, field, self._opposite, self._pose, points)

    def _moved(
        self, kernel: Callable[..., None], flow: Flow, points_mm: Points
    ) -> Float64[np.ndarray, "n 3"]:
        points, out, pose = _given(points_mm), np.empty((len(points_mm), 3)), self._pose
        parallel_for(lambda part: kernel(flow, pose, points[part], out[part]), len(out), _AT_ONCE)
        return out

    @property
    def _pose(self) -> Pose:
        given = self.shape.body.center_ct, self.rotation, self.centre_mm
        return Pose(*(np.ascontiguousarray(part, float) for part in given))

    @cached_property
    def _flow(self) -> Flow:
        body = self.shape.body
        velocity = body.velocity(self.coefficients)
        steps = steps_for(velocity, body.spacing_mm)
        return Flow(velocity, body.origin_mm, np.float32(body.spacing_mm), steps)

    @property
    def _opposite(self) -> Flow:
        return self._flow._replace(velocity=-self._flow.velocity)


def _given(points_mm: Points) -> Float32[np.ndarray, "n 3"]:
    """A copy, in C's order. Raises InputError for what no kernel takes."""
    points = np.array(points_mm, np.float32, order="C")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points are n x 3, one a row, mm; these have the shape {points.shape}.")
    if not np.isfinite(points).all():
        bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
        raise InputError(f"{bad} of {len(points)} points have NaN or infinity; leave them out.")
    return points


def seen_from_first(motion: ElasticMotion, camera_from_view: Affine) -> ElasticMotion:
    """A motion before another camera, as the first one sees it."""
    turn = camera_from_view[:3, :3]
    centre_mm = turn @ motion.centre_mm + camera_from_view[:3, 3]
    alternatives = tuple(
        (seen_from_first(alternative, camera_from_view), share)
        for alternative, share in motion.alternatives
    )
    return replace(
        motion,
        rotation=turn @ motion.rotation,
        centre_mm=centre_mm,
        alternatives=alternatives,
        depth_share=0.0,  # of the first camera, which lies elsewhere
    )


def blend(a: ElasticMotion, b: ElasticMotion, share: float) -> ElasticMotion:
    """Between two motions of one shape: ``share`` 0 is ``a``, 1 is ``b``, whose covariance it
    has."""
    turn = _rotvec(a.rotation.T @ b.rotation)
    return replace(
        b,
        rotation=a.rotation @ turned_by(share * turn),
        centre_mm=(1 - share) * a.centre_mm + share * b.centre_mm,
        coefficients=(1 - share) * a.coefficients + share * b.coefficients,
    )


def _rotvec(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 3"]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_rotvec()
