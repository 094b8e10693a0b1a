"""The network: from a cloud to two hypotheses of the organ's pose and elastic state.

The cloud is turned about the camera's axis until its longest direction is x. That leaves two ways
round, half a turn apart. The network sees both, says how likely each is the right one (the organ's
long axis pointing to +x), and is trained to locate only in the right one: otherwise it learns to
undo a wrong turn by absurd deformations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Direction, Matrix, Points, Vector, perpendicular, unit
from tumortrack.models.config import NetworkConfig, RegistrationHeadConfig
from tumortrack.models.layers import Layer
from tumortrack.models.model import Network, OnnxParts
from tumortrack.models.normalisation import Aligned, normalised
from tumortrack.registration.rest_shape import RestShape

_LARGEST = 4.0  # coefficients lie within so many standard deviations of the library's mean
_SMALL_START = 0.3  # of the last layer's weights
_STEP = 0.5  # of the organ's half length: what an output of 1 moves it by
_BEHIND = 0.3  # of the half length: the organ's middle lies about so far behind the cloud's
POSE_OUTPUTS = 10  # before the coefficients: rotation 6, place 3, way round 1
_HUBER_MM = 5.0  # errors beyond count by their size, not its square
_RIGID_SHARE = 0.5  # of the loss: the organ's pose without its deformation
_WAY_SHARE = 0.2  # of the loss: which way round is right
_FLIPPED_SHARE = 4  # one cloud in so many is shown the wrong way round as well


@dataclass(frozen=True, eq=False)
class AlignedCloud:
    """A batch of clouds in the network's frame: centred, scaled, turned."""

    points: Tensor  # (B, N, 3)
    centre_mm: Tensor  # (B, 3), camera frame
    turn: Tensor  # (2, B, 1): cosine and sine of the turn about z

    def flipped(self, sign: Tensor) -> AlignedCloud:
        """Half a turn about z where ``sign`` (B,) is -1."""
        flip = torch.stack([sign, sign, torch.ones_like(sign)], -1)[:, None]
        return AlignedCloud(self.points * flip, self.centre_mm, self.turn * sign[None, :, None])


class PoseHypothesis(NamedTuple):
    """Where organs lie and how they are deformed: rotation and centre (camera frame, mm), so that
    a point x of the CT, deformed to y, lies at ``rotation (y - center_ct) + centre_mm``. The fields
    are also what an ONNX file gives."""

    rotation: Tensor  # (B, 3, 3)
    centre_mm: Tensor  # (B, 3)
    coefficients: Tensor  # (B, M)
    right_way: Tensor  # (B,), logit


class RegistrationNetwork(Network):
    """Clouds -> hypotheses. What describes the organ is set by ``initialize``: the centre and axes,
    the points (P, 3; about the centre) whose places before the camera the loss compares, the body's
    modes at these points (P, 3, M), its states' mean and spread."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        head, kind = config.decoder, config.normalisation
        if not isinstance(head, RegistrationHeadConfig) or not isinstance(kind, Aligned):
            raise InputError("a registration network needs the decoder `warp` and aligned clouds.")
        self.config, self.scale_mm = config, kind.scale_mm
        modes, width = head.modes, head.width
        self.encoder = config.encoder.build()
        self.hidden = nn.Sequential(
            Layer(config.encoder.latent_size, width, "none"), Layer(width, width, "none")
        )
        self.output = nn.Linear(width, POSE_OUTPUTS + modes)
        with torch.no_grad():
            self.output.weight.mul_(_SMALL_START)
            self.output.bias.zero_()
        self.center_ct = nn.Buffer(torch.zeros(3))
        self.points = nn.Buffer(torch.zeros(head.points, 3))
        self.modes = nn.Buffer(torch.zeros(head.points, 3, modes))
        self.mean = nn.Buffer(torch.zeros(modes))
        self.std = nn.Buffer(torch.ones(modes))
        self.facing = nn.Buffer(torch.eye(3))
        self.long_axis = nn.Buffer(torch.tensor([1.0, 0.0, 0.0]))

    def initialize(self, shape: RestShape, up_lps: Direction, points_ct: Points) -> None:
        """Take over what does not have to be learnt, with these points (CT frame)."""
        body = shape.body
        known = {
            "center_ct": body.center_ct,
            "points": points_ct - body.center_ct,
            "modes": body.modes_at(points_ct),
            "mean": body.states.mean(0),
            "std": body.states.std(0),
            "facing": facing_rotation(up_lps, shape.long_axis),
            "long_axis": shape.long_axis,
        }
        for name, value in known.items():
            getattr(self, name).copy_(torch.as_tensor(np.array(value, np.float32)))

    def align(self, points_mm: Tensor) -> AlignedCloud:
        """Clouds (B, N, 3), camera frame, mm, in the network's frame."""
        points, centre_mm, _, turn = normalised(points_mm, self.config.normalisation)
        assert turn is not None
        return AlignedCloud(points, centre_mm[:, 0], turn)

    def flip_sign(self, aligned: AlignedCloud, rotation: Tensor) -> Tensor:
        """+1 where the organ's long axis points to +x in the network's frame, else -1; (B,)."""
        axis = rotation @ self.long_axis
        along = axis[:, 0] * aligned.turn[0, :, 0] + axis[:, 1] * aligned.turn[1, :, 0]
        return torch.where(along >= 0, 1.0, -1.0)

    def forward(self, aligned: AlignedCloud) -> PoseHypothesis:
        """What is seen, if the clouds lie the right way round."""
        out = self.output(self.hidden(self.encoder(aligned.points)))
        with torch.autocast(out.device.type, enabled=False):  # bf16 would round to 0.2 mm
            return self._hypothesis(out.float(), aligned)

    def _hypothesis(self, out: Tensor, aligned: AlignedCloud) -> PoseHypothesis:
        first = functional.normalize(out[:, :3] + out.new_tensor([1.0, 0.0, 0.0]), dim=1)
        second = out[:, 3:6] + out.new_tensor([0.0, 1.0, 0.0])
        second = second - (first * second).sum(1, keepdim=True) * first
        second = functional.normalize(second, dim=1)
        third = torch.cross(first, second, dim=1)
        back = _about_z(aligned.turn)
        rotation = back @ torch.stack([first, second, third], -1) @ self.facing
        place = (out[:, 6:9] * _STEP + out.new_tensor([0.0, 0.0, _BEHIND])) * self.scale_mm
        centre_mm = aligned.centre_mm + (back @ place[..., None])[..., 0]
        bounded = _LARGEST * torch.tanh(out[:, POSE_OUTPUTS:] / _LARGEST)
        return PoseHypothesis(rotation, centre_mm, self.mean + self.std * bounded, out[:, 9])

    def loss(self, *scenes: Tensor, first: int = 0) -> Tensor:
        """How far the known points (B, P, 3) are from where the hypotheses carry them, with and
        without deformation, and how well the right way round is told. Labels are not used. The
        deformation counts to first order: the displacement at the points' places at rest. The mean
        of equal shares' losses is the whole batch's."""
        clouds_mm, points_mm, _, camera_from_ct = scenes
        aligned = self.align(clouds_mm)
        with torch.autocast(clouds_mm.device.type, enabled=False):
            true_rotation = camera_from_ct[:, :3, :3]
            true_centre = true_rotation @ self.center_ct + camera_from_ct[:, :3, 3]
            sign = self.flip_sign(aligned, true_rotation)
        found = self(aligned.flipped(sign))
        told_wrong = self._flipped_loss(aligned.flipped(-sign), first)
        with torch.autocast(clouds_mm.device.type, enabled=False):
            moved = self.points + torch.einsum("pdm,bm->bpd", self.modes, found.coefficients)
            error = _size(_placed(moved, found.rotation, found.centre_mm) - points_mm)
            rigid = _placed(self.points, found.rotation, found.centre_mm)
            rigid_error = _size(rigid - _placed(self.points, true_rotation, true_centre))
            told = functional.softplus(-found.right_way).mean() + told_wrong
            return error + _RIGID_SHARE * rigid_error + _WAY_SHARE * told

    def _flipped_loss(self, wrong: AlignedCloud, first: int) -> Tensor:
        """How well the wrong way round is told, by some of the clouds: the same ones in every
        sharing of the batch, so that a small share may have none."""
        rows = slice(-first % _FLIPPED_SHARE, None, _FLIPPED_SHARE)
        few = AlignedCloud(wrong.points[rows], wrong.centre_mm[rows], wrong.turn[:, rows])
        if not len(few.points):
            return wrong.points.new_zeros(())
        told = functional.softplus(self(few).right_way).sum()
        return told / (len(wrong.points) / _FLIPPED_SHARE)

    def onnx_parts(self, cloud_mm: Tensor) -> OnnxParts:
        """See ``Network``: clouds in, hypotheses of both ways round out."""
        names = {"input_names": ["cloud_mm"], "output_names": list(PoseHypothesis._fields)}
        return _Exported(self).cpu().eval(), (cloud_mm,), names

    def flip_hypotheses(self, points_mm: Tensor) -> PoseHypothesis:
        """Hypotheses (2B) for clouds (B, N, 3) as they were turned, then for half a turn more; in
        one batch: a network this small takes as long for two clouds as for one."""
        one = self.align(points_mm)
        other = one.flipped(-torch.ones_like(one.centre_mm[:, 0]))
        points, centre_mm = torch.cat([one.points, other.points]), one.centre_mm.repeat(2, 1)
        return self(AlignedCloud(points, centre_mm, torch.cat([one.turn, other.turn], 1)))


class _Exported(nn.Module):
    """A cloud (1, N, 3) -> the arrays of ``flip_hypotheses``, (2, ...) each."""

    def __init__(self, network: RegistrationNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, cloud_mm: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.network.flip_hypotheses(cloud_mm))


def facing_rotation(up_lps: Direction, long_axis: Vector) -> Matrix:
    """The rotation that an organ of any patient has where it lies flat before the camera: its long
    axis along +x, its upper side towards the camera as far as the axis allows. How far the axis
    rises towards the upper side (25, 29 and 41 degrees in three patients, docs/method.md) is seen,
    and so is no part of the frame."""
    x = unit(np.asarray(long_axis, float))
    across = np.asarray(up_lps, float) - (np.asarray(up_lps, float) @ x) * x
    z = -unit(across) if np.linalg.norm(across) > 1e-6 else perpendicular(x)
    return np.stack([x, np.cross(z, x), z])


def _placed(points: Tensor, rotation: Tensor, centre_mm: Tensor) -> Tensor:
    """Points (P, 3) or (B, P, 3) about the organ's centre -> camera frame (B, P, 3)."""
    return points @ rotation.transpose(1, 2) + centre_mm[:, None]


def _size(offsets_mm: Tensor) -> Tensor:
    """Huber's mean of distances, about 1 for 7 mm."""
    distance = (offsets_mm.square().sum(-1) + 1e-6).sqrt()
    huber = functional.huber_loss(distance, torch.zeros_like(distance), delta=_HUBER_MM)
    return huber / _HUBER_MM


def _about_z(turn: Tensor) -> Tensor:
    """(2, B, 1) cosine and sine -> rotations (B, 3, 3) from the turned frame back."""
    cosine, sine = turn[..., 0]
    zero, one = torch.zeros_like(cosine), torch.ones_like(cosine)
    rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, one]
    return torch.stack(rows, -1).view(-1, 3, 3)
