"""What the organs of all patients have in common: one frame, one size, one set of displacements.

The upright frame: origin at the organ's centre, long axis along +x, upper side towards -z as far as
that allows (``network.facing_rotation``), lengths scaled so that half the organ's length along its
axis is ``UPRIGHT_MM``. There a displacement is a sum of smooth fields, polynomials of second
degree less rigid motion: stretches, shears, bends. They are the same for every organ, while each
organ's elastic modes are its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float

from tumortrack.core.geometry import Direction, Matrix, Points, Vector
from tumortrack.core.types import Mesh
from tumortrack.registration.network import POSE_OUTPUTS, RegistrationNetwork, facing_rotation

UPRIGHT_MM = 55.0  # half the length of every organ in its upright frame
FIELDS = 24  # second degree: 30 vector fields, less 6 of rigid motion
_RIGID = 6
_FIELD_MM = 0.6  # rms of one field at the points
_HALF_AXES = np.array([0.95, 0.5, 0.45]) * UPRIGHT_MM  # of the ellipsoid in which the points lie
_POINT_SEED = 0x6E0
_ERROR_MM = 1.0  # to which the fields are matched by the modes


@dataclass(frozen=True, eq=False)
class CanonicalFrame:
    """An organ's upright frame: x upright = ``scale`` * ``facing`` (x_ct - ``center_ct``)."""

    facing: Matrix
    center_ct: Vector
    scale: float

    def in_ct(self, points: Points) -> Points:
        """Points of the upright frame in the CT's."""
        return points @ self.facing / self.scale + self.center_ct


def half_length_mm(organ_ct: Mesh, long_axis: Vector) -> float:
    """Half of the organ's length along its axis, however it is turned."""
    return float(np.ptp(organ_ct.vertices_mm @ long_axis)) / 2


def upright_of(
    organ_ct: Mesh, up_lps: Direction, center_ct: Vector, long_axis: Vector
) -> CanonicalFrame:
    """The upright frame of an organ."""
    scale = UPRIGHT_MM / half_length_mm(organ_ct, long_axis)
    return CanonicalFrame(facing_rotation(up_lps, long_axis), center_ct, scale)


def generic_points(count: int) -> Float[np.ndarray, "p 3"]:
    """Points in an organ of ordinary proportions, upright frame; always the same."""
    rng = np.random.default_rng(_POINT_SEED)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * np.cbrt(rng.uniform(size=(count, 1))) * _HALF_AXES


def generic_fields(points: Points) -> Float[np.ndarray, "n 3 24"]:
    """The displacement of points of the upright frame by one unit of each field."""
    return (_monomials(points) @ _mixture()).reshape(len(points), 3, FIELDS)


@cache
def _mixture() -> Float[np.ndarray, "30 24"]:
    """That makes the fields orthogonal to each other and to rigid motion, over a dense organ."""
    dense = generic_points(2000)
    _, triangle = np.linalg.qr(_monomials(dense))
    return np.linalg.inv(triangle)[:, _RIGID:] * _FIELD_MM * np.sqrt(len(dense))


def _monomials(points: Points) -> Float[np.ndarray, "m 30"]:
    """Vector fields, rigid ones first: constant, turns, stretches and shears, second degree."""
    x = points / UPRIGHT_MM
    eye = np.eye(3)
    turns = np.cross(eye[None], x[:, None])  # (n, 3 axes, 3)
    linear = np.einsum("ni,jd->nijd", x, eye)
    i, j = np.triu_indices(3)
    stretches = (linear[:, i, j] + linear[:, j, i]) / 2
    squares = np.einsum("nk,jd->nkjd", x[:, i] * x[:, j], eye).reshape(len(x), -1, 3)
    constant = np.tile(eye, (len(x), 1, 1))
    fields = np.concatenate([constant, turns, stretches, squares], axis=1)
    return fields.transpose(0, 2, 1).reshape(3 * len(x), -1)


@torch.no_grad()
def carry_over(
    network: RegistrationNetwork, weights: dict[str, torch.Tensor], upright: CanonicalFrame
) -> None:
    """Start a network that knows its organ from pretrained weights: encoder, hidden layers and pose
    are taken as they are; each field becomes the state of the organ's own modes that
    resembles it best, weighed against how the states spread."""
    state = network.state_dict()
    for name, value in weights.items():
        if name.startswith(("encoder.", "hidden.")):
            state[name].copy_(value)
    output, bias = weights["output.weight"], weights["output.bias"]
    network.output.weight[:POSE_OUTPUTS] = output[:POSE_OUTPUTS].to(network.output.weight)
    network.output.bias[:POSE_OUTPUTS] = bias[:POSE_OUTPUTS].to(network.output.bias)

    device = network.output.weight.device
    known = (network.points, network.modes, network.mean, network.std)
    points, modes, mean, std = (value.double().cpu().numpy() for value in known)
    fields = generic_fields(points @ upright.facing.T * upright.scale)
    wanted = np.einsum("pdf,dc->pcf", fields, upright.facing) / upright.scale  # CT frame, mm
    own = (modes * std).reshape(-1, modes.shape[-1])
    ridge = _ERROR_MM**2 * np.eye(own.shape[1])
    match = np.linalg.solve(own.T @ own + ridge, own.T @ wanted.reshape(len(own), -1))
    matched = torch.as_tensor(match.astype(np.float32), device=device)
    rest = torch.as_tensor((mean / std).astype(np.float32), device=device)
    network.output.weight[POSE_OUTPUTS:] = matched @ output[POSE_OUTPUTS:].to(device)
    network.output.bias[POSE_OUTPUTS:] = matched @ bias[POSE_OUTPUTS:].to(device) - rest
